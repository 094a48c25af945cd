"""Runs scenarios by the workers that a transport reaches.

A worker that dies (SUMO and PyBullet can take its process down) is replaced and its scenario tried
once more; an engine that shows no sign of life is killed. After the last attempt the episode is
recorded, so that none is ever lost: as invalid if it was an engine that failed, as crashed if that
may have been the policy, which gets nothing out of ending its process. A worker that is lost
together with its machine is no attempt: its scenario goes to another one, and what the first one
still delivers is taken if it comes first. When a shared renderer dies, the episodes that it drew
for are run again. A policy that gives no answer in time is not asked again: its episode has
crashed. What comes out of an episode is written here, by the run's own process.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence
from functools import partial
from logging import ERROR, WARNING
from pathlib import Path
from typing import NamedTuple

import msgspec

from cosim.core.errors import MachineError, RunError, UsageError
from cosim.core.log_event import happened
from cosim.episode.manifest_checks import with_goal
from cosim.results.record import Record, Status, begun
from cosim.results.run_folder import FailedAttempt, RunFolder
from cosim.spec.episode_id import pseudonym_of
from cosim.spec.options import EpisodeOptions
from cosim.spec.scenario import Scenario
from scenarios.ipc.deadlines import Patience, Question
from scenarios.ipc.messages import (
    Done,
    FrameDrawn,
    Hello,
    Job,
    LostRenderer,
    Message,
    MessageHandler,
    Ready,
    Unable,
)
from scenarios.runs.shared_renderer import SharedRenderer
from scenarios.runs.transport import Late, Reception, Transport, Worker

ATTEMPTS = 2
LOSSES = 8
"""So many workers may be lost, each with all that is beside it, while they run one scenario."""
SILENCE_S = 300.0
"""A worker that says nothing for so long, while its policy has nothing to answer, hangs in an
engine."""

POLL_S = 1.0


def run_all(
    folder: RunFolder,
    scenarios: Sequence[Scenario],
    hello: Hello,
    transport: Transport,
    *,
    tell: MessageHandler,
    options: EpisodeOptions = EpisodeOptions(),  # noqa: B008  a frozen value
    patience: Patience = Patience(),
    renderer: SharedRenderer | None = None,
) -> None:
    """Run scenarios, as many at a time as the transport has room for, adding each record to the
    folder as it ends: in the order of what they are called before the policy, so that one that
    counts its episodes does not learn which they are.

    hello: the policy as it was loaded here. renderer: what draws for all of them; the caller ends
    it. Raises UsageError when a worker cannot load the policy, MachineError when none can be
    started or a record cannot be written."""
    if renderer is not None:
        hello = msgspec.structs.replace(hello, renderer=renderer.at)
        options = msgspec.structs.replace(options, renderer=renderer.at)
    options = msgspec.structs.replace(options, seed=folder.spec.seed)
    pool = _Pool(folder, hello, transport, options, tell, patience, renderer)
    waiting = deque(sorted(scenarios, key=partial(pseudonym_of, folder.spec.seed)))
    attempts = folder.failed_attempts()
    happened("run begun", episodes=len(scenarios), policy=hello.policy, folder=str(folder.path))
    try:
        while waiting or pool.busy:
            while waiting and transport.room(len(pool.busy)) > 0:
                pool.give(waiting.popleft())
            for lost in pool.listen():
                attempt = FailedAttempt(lost.scenario.id, lost.away)
                most = LOSSES if lost.away else ATTEMPTS
                if lost.why:
                    attempts[attempt] += 1
                    folder.keep_failed_attempt(attempt)
                if not lost.why or attempts[attempt] < most:
                    tried = attempts[attempt]
                    happened(
                        "retried",
                        WARNING,
                        scenario=lost.scenario.id,
                        why=lost.why,
                        attempts=tried,
                        of=most,
                    )
                    waiting.appendleft(lost.scenario)
                else:
                    why = f"{lost.why}, {most} times; see logs/ in the run folder"
                    pool.give_up(lost.scenario, why, "invalid" if lost.in_engine else "crashed")
            pool.take_unasked(waiting)
    finally:
        pool.close()


def _called(name: str, waiting: deque[Scenario]) -> Scenario | None:
    """The scenario of that name, if it waits."""
    return next((scenario for scenario in waiting if scenario.id == name), None)


class _Lost(NamedTuple):
    """A scenario that is not done, whose worker or whose engine failed. why: "" if it never began;
    in_engine: whether it was an engine for sure; away: see `Worker`."""

    scenario: Scenario
    why: str
    in_engine: bool = False
    away: bool = False


class _Slot:
    """A worker, and what it is busy with. ran: it has run an episode before; silent: it has said
    nothing since it was given the next."""

    def __init__(self, worker: Worker) -> None:
        self.worker = worker
        self.ready = self.ran = self.silent = False
        self.job: Scenario | None = None
        self.heard_at = time.monotonic()


class _Pool:
    """The workers of one run."""

    def __init__(
        self,
        folder: RunFolder,
        hello: Hello,
        transport: Transport,
        options: EpisodeOptions,
        tell: MessageHandler,
        patience: Patience,
        renderer: SharedRenderer | None,
    ) -> None:
        self._folder = folder
        self._hello = hello
        self._transport = transport
        self._options = options
        self._tell = tell
        self._patience = patience
        self._renderer = renderer
        self._bereft: list[tuple[Scenario, LostRenderer]] = []
        self._again: list[_Lost] = []
        self._workers: list[_Slot] = []
        self._failed_starts = 0

    @property
    def busy(self) -> list[_Slot]:
        return [w for w in self._workers if w.job is not None]

    def take_unasked(self, waiting: deque[Scenario]) -> None:
        """Take in workers that go on with what waits, and results that come late; what they are of
        waits no more."""
        for one in self._transport.unasked():
            if isinstance(one, Late):
                one.answer(self._late(one.done, waiting))
            elif (scenario := _called(one.scenario, waiting)) is None:
                one.worker.kill()
            else:
                waiting.remove(scenario)
                slot = _Slot(one.worker)
                slot.job = scenario
                self._workers.append(slot)

    def _late(self, done: Done, waiting: deque[Scenario]) -> Reception:
        """A result from a worker that its job had been taken from is kept if there is none. Who has
        that job now is freed."""
        busy = next(
            (slot for slot in self.busy if slot.job is not None and slot.job.id == done.scenario),
            None,
        )
        scenario = _called(done.scenario, waiting) if busy is None else busy.job
        if scenario is None:
            return self._second(done)
        record = self._record_of(scenario, done)
        if (
            record is None or done.again or self._options.frames_every_s
        ):  # of its frames some may have come nowhere
            return "refused"
        if busy is None:
            waiting.remove(scenario)
        else:
            busy.worker.kill()
            self._workers.remove(busy)
        self._folder.keep(record, done.log)
        self._over(scenario, record.status)
        return "kept"

    def _second(self, done: Done) -> Reception:
        """A result of a scenario that has one. Two episodes that came to their end must be
        alike."""
        if done.scenario not in self._folder.spec.scenarios:
            return "refused"
        try:
            kept = Record.load(self._folder.episode_folder(done.scenario) / "record.json")
            came = Record.decoded(done.record, self._folder.path)
        except RunError:
            return "refused"
        alike = msgspec.structs.replace(kept, clock={}) == msgspec.structs.replace(came, clock={})
        comparable = None not in (kept.ended, came.ended) and not kept.real_time
        return "conflict" if comparable and not alike else "duplicate"

    def give(self, scenario: Scenario) -> None:
        """Hand a scenario to an idle worker, or to a new one."""
        idle = next((w for w in self._workers if w.job is None), None) or self._start()
        idle.job = scenario
        idle.heard_at = time.monotonic()
        idle.silent = True
        self._folder.forget(scenario.id)
        happened("claimed", scenario=scenario.id, worker=Path(idle.worker.log).stem)
        idle.worker.give(Job(scenario, self._options))

    def listen(self) -> list[_Lost]:
        """Take in what the workers say. Returns the scenarios that are to be run again."""
        lost: list[_Lost] = []
        self._transport.wait(POLL_S)
        if self._renderer is not None:
            self._renderer.tend()
        for one in list(self._workers):
            if not one.worker.listen(partial(self._take, one)):
                why = one.worker.end()
                began = not (one.ran and one.silent) or one.worker.question is not None
                lost += self._lost(
                    one, why, began=began, in_engine=one.worker.in_engine, away=one.worker.away
                )
            elif one.job is None:
                continue
            elif (question := one.worker.question) is not None:
                one.heard_at = time.monotonic()
                if question.overdue(self._patience):
                    self._leave_unanswered(one, one.job, question)
            elif time.monotonic() - one.heard_at > SILENCE_S:
                one.worker.kill()
                lost += self._lost(
                    one, "the environment process showed no sign of life", in_engine=True
                )
        while self._bereft:
            lost += self._without_renderer(*self._bereft.pop())
        lost += self._again
        self._again.clear()
        return lost

    def _without_renderer(self, scenario: Scenario, lost: LostRenderer) -> list[_Lost]:
        """The shared renderer has ended in the middle of an episode, which is to be run again. It
        was an attempt if its policy was being asked; if that gave no answer in time it was the last
        one."""
        assert self._renderer is not None
        end = self._renderer.end_of(lost.number)
        if end is None:
            return [
                _Lost(
                    scenario, "the environment process lost its connection to the shared renderer"
                )
            ]
        if lost.asked and end.unanswered_s is not None:
            self.give_up(
                scenario, f"{self._silent(end.unanswered_s)} in {lost.asked} of {scenario.id}"
            )
            return []
        return [_Lost(scenario, end.words if lost.asked else "")]

    def _silent(self, allowed_s: float) -> str:
        return f"policy '{self._hello.manifest.name}' gave no answer for {allowed_s:g} s"

    def _take(self, one: _Slot, message: Message) -> None:
        """Something that a worker has said."""
        one.heard_at = time.monotonic()
        one.silent = False
        if isinstance(message, Unable):
            raise (
                UsageError(message.reason)
                if message.blames_policy
                else MachineError(message.reason)
            )
        if isinstance(message, Ready):
            one.ready = True
            self._failed_starts = 0
        elif isinstance(message, FrameDrawn):
            self._folder.keep_frame(message.scenario, message.tick, message.png)
        elif not isinstance(message, Done | LostRenderer):
            self._tell(message)
        elif one.job is not None:
            scenario = one.job
            one.job = None
            one.ran = True
            if isinstance(message, Done):
                self._keep(scenario, message)
            else:
                self._bereft.append((scenario, message))

    def _keep(self, scenario: Scenario, done: Done) -> None:
        """The record of a scenario that is over, and its log, are written and told."""
        record = self._record_of(scenario, done)
        if record is None:
            self.give_up(scenario, "its record was damaged when it arrived")
        elif done.again:
            self._again.append(_Lost(scenario, record.reason, in_engine=record.status == "invalid"))
        else:
            self._folder.keep(record, done.log, done.demonstration)
            self._over(scenario, record.status)

    def _record_of(self, scenario: Scenario, done: Done) -> Record | None:
        """The record in a result; None if it is damaged, or of another scenario."""
        try:
            record = Record.decoded(done.record, self._folder.episode_folder(scenario.id))
        except RunError:
            return None
        return record if record.scenario == scenario.id else None

    def _lost(
        self,
        one: _Slot,
        why: str,
        *,
        began: bool = True,
        in_engine: bool = False,
        away: bool = False,
    ) -> list[_Lost]:
        """A worker has ended. Returns its scenario if that is not done, and why, if it was
        begun."""
        if one.job is not None:
            happened(
                "lost", WARNING, worker=Path(one.worker.log).stem, scenario=one.job.id, why=why
            )
        self._workers.remove(one)
        if one.job is None:
            return []
        if one.ready:
            return [_Lost(one.job, why if began else "", in_engine, away)]
        self._not_started(one, why)
        return [_Lost(one.job, "")]

    def _leave_unanswered(self, one: _Slot, scenario: Scenario, question: Question) -> None:
        """The policy takes too long: its process is killed, and its episode has crashed, once."""
        one.worker.kill()
        self._workers.remove(one)
        silent = self._silent(self._patience.of(question.doing))
        if question.doing == "loading":
            raise UsageError(
                f"{silent} while it was loaded in an environment process: give a longer "
                f"--start-timeout"
            )
        self.give_up(scenario, f"{silent} in {question.when} of {scenario.id}")

    def _not_started(self, one: _Slot, why: str) -> None:
        """A worker that ended before it was ready. Raises the run's error when the next one has
        done so too."""
        self._failed_starts += 1
        if self._failed_starts < ATTEMPTS:
            return
        told = f"{why} before it was ready, {ATTEMPTS} times: see {one.worker.log}"
        if one.worker.question is not None:
            raise UsageError(f"policy '{self._hello.policy}' cannot be loaded: {told}")
        raise MachineError(f"{told}, and `cosim doctor`")

    def give_up(self, scenario: Scenario, reason: str, status: Status = "crashed") -> None:
        """Record a scenario that does not come to its end: no worker survives it, or the policy
        does not answer."""
        happened("given up", ERROR, scenario=scenario.id, why=reason, status=status)
        spec = self._folder.spec
        manifest = with_goal(self._hello.manifest, self._options.goal)
        record = begun(
            scenario,
            manifest,
            spec.suite_hash,
            self._hello.source_hash,
            spec.seed,
            spec.latency_ms,
            spec.real_time,
            spec.policy_runs,
        )
        self._folder.keep(msgspec.structs.replace(record, status=status, reason=reason))
        self._over(scenario, status)

    def _over(self, scenario: Scenario, status: Status) -> None:
        happened("done", scenario=scenario.id, status=status)
        if self._renderer is not None:
            self._renderer.episode_ended()
        self._tell(Done(scenario.id, status))

    def close(self) -> None:
        """End every worker: idle ones by closing their pipe, busy ones by force."""
        for one in self._workers:
            if one.job is not None:
                one.worker.kill(wait=False)
            one.worker.hang_up()
        for one in self._workers:
            one.worker.end()
        self._workers.clear()

    def _start(self) -> _Slot:
        one = _Slot(self._transport.start(self._hello))
        self._workers.append(one)
        return one
