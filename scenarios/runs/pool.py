"""Pool of workers that runs the scenarios of a run over a transport.

A worker reports the failure of its job (`scenarios.ipc.faults`). The scenario is retried, or
recorded after its last attempt with what was driven, so that none is lost. An episode that loses
the shared renderer is retried. A lost worker may still deliver its result, which is stored if it is
the first one. Only this process writes to the run folder.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from logging import ERROR, WARNING
from pathlib import Path
from typing import NamedTuple

import msgspec

from cosim.core.errors import RunError
from cosim.core.log_event import log_event
from cosim.episode.manifest_checks import with_goal
from cosim.results.record import Record, Status
from cosim.results.run_folder import FailedAttempt, RunFolder
from cosim.results.run_setup import NO_RENDERER
from cosim.spec.episode_id import drives_second, episode_id_of
from cosim.spec.options import EpisodeOptions
from cosim.spec.scenario import Scenario
from scenarios.ipc.faults import RULES, AttemptFailure, failure_of_result
from scenarios.ipc.messages import (
    Done,
    FrameDrawn,
    Hello,
    Job,
    LostRenderer,
    Message,
    MessageHandler,
)
from scenarios.runs.environment_slot import no_answer
from scenarios.runs.shared_renderer import SharedRenderer
from scenarios.runs.transport import LateResult, ResultOutcome, Transport, Worker

POLL_S = 1.0
"""Longest time in seconds between two polls of the workers."""


def run_all(
    folder: RunFolder,
    scenarios: Sequence[Scenario],
    hello: Hello,
    transport: Transport,
    *,
    handle: MessageHandler,
    options: EpisodeOptions = EpisodeOptions(),  # noqa: B008  a frozen value
    renderer: SharedRenderer | None = None,
    over: Callable[[], bool] = lambda: False,
) -> None:
    """Run scenarios, as many at a time as the transport has room for, and add each record to the
    folder.

    hello: introduces the policy as it was loaded here.
    handle: called with the messages about the episodes.
    renderer: draws for all episodes; the caller ends it.
    over: whether no further episode is to begin; those that run are finished.

    Raises UsageError when a worker cannot load the policy, MachineError when none can be started or
    a record cannot be written."""
    if renderer is not None:
        hello = msgspec.structs.replace(hello, renderer=renderer.at)
    queue = _AttemptQueue(folder, scenarios)
    pool = _Pool(folder, queue, hello, transport, options, handle, renderer)
    log_event("run begun", episodes=len(scenarios), policy=hello.policy, folder=str(folder.path))
    try:
        while pool.busy or (queue and not over()):
            while queue and not over() and transport.room(pool.busy) > 0:
                pool.give(queue.next())
            pool.poll()
            pool.take_unsolicited()
    finally:
        pool.close()
        folder.restore()


class _Pool:
    """The workers of one run."""

    def __init__(
        self,
        folder: RunFolder,
        queue: _AttemptQueue,
        hello: Hello,
        transport: Transport,
        options: EpisodeOptions,
        handle: MessageHandler,
        renderer: SharedRenderer | None,
    ) -> None:
        self._folder = folder
        self._queue = queue
        self._hello = hello
        self._transport = transport
        self._options = options
        self._handle = handle
        self._renderer = renderer
        self._setup = msgspec.structs.replace(folder.spec.setup, renderer=NO_RENDERER)
        self._workers: dict[Worker, Scenario | None] = {}
        self._without_renderer: list[tuple[Scenario, LostRenderer]] = []

    @property
    def busy(self) -> int:
        """Number of workers that have a job."""
        return sum(scenario is not None for scenario in self._workers.values())

    def give(self, scenario: Scenario) -> None:
        """Hand a scenario to an idle worker, or to a new one."""
        idle = (worker for worker, job in self._workers.items() if job is None)
        worker = next(idle, None) or self._transport.start(self._hello)
        self._workers[worker] = scenario
        self._folder.delete_episode(scenario.id)
        last, second_half = (
            self._queue.on_last_attempt(scenario),
            self._queue.in_second_half(scenario),
        )
        worker.give(
            Job(scenario, self._options, self._setup, last_attempt=last, second=second_half)
        )
        log_event("claimed", scenario=scenario.id, worker=Path(worker.log).stem)

    def poll(self) -> None:
        """Take in the workers' messages; queue or record the scenarios that failed."""
        self._transport.wait(POLL_S)
        self._folder.mend()
        if self._renderer is not None:
            self._renderer.check()
        for worker in list(self._workers):
            failure = worker.poll(partial(self._take, worker))
            scenario = self._workers[worker]
            if failure is not None and scenario is not None:
                self._workers[worker] = None
                if failure.fault != "policy_timeout":
                    log_event(
                        "lost",
                        WARNING,
                        worker=Path(worker.log).stem,
                        scenario=scenario.id,
                        why=failure.why,
                    )
                self._failed(scenario, failure)
            if worker.ended:
                del self._workers[worker]
        while self._without_renderer:
            scenario, lost = self._without_renderer.pop()
            self._failed(scenario, self._failure_of(scenario, lost))

    def take_unsolicited(self) -> None:
        """Adopt workers that run a scenario which waits, and keep late results."""
        for one in self._transport.unsolicited():
            if isinstance(one, LateResult):
                one.answer(self._take_late_result(one.done))
            elif (scenario := self._queue.named(one.scenario)) is None:
                one.worker.cancel()
            else:
                self._queue.remove(scenario)
                self._workers[one.worker] = scenario

    def close(self) -> None:
        """End all workers: idle ones by closing their connection, busy ones by force."""
        for worker in self._workers:
            worker.stop()
        for worker in self._workers:
            worker.end()
        self._workers.clear()

    def _take(self, worker: Worker, message: Message) -> None:
        busy_with = self._workers[worker]
        if busy_with is None or getattr(message, "scenario", busy_with.id) != busy_with.id:
            return  # written by a policy
        if isinstance(message, FrameDrawn):
            self._folder.write_frame(message.scenario, message.tick, message.png)
        elif not isinstance(message, Done | LostRenderer):
            self._handle(message)
        else:
            self._workers[worker] = None
            if isinstance(message, Done):
                self._keep(busy_with, message)
            else:
                self._without_renderer.append((busy_with, message))

    def _keep(self, scenario: Scenario, done: Done) -> None:
        """Write the record and the log of a scenario that is over."""
        record = self._record_of(scenario, done.record)
        if record is None:
            self._failed(
                scenario, AttemptFailure("damaged_result", "its record was damaged when it arrived")
            )
        elif done.again:
            self._failed(scenario, failure_of_result(record.status, record.reason))
        else:
            self._folder.write_episode(record, done.log, done.demonstration)
            self._over(scenario, record.status)

    def _record_of(self, scenario: Scenario, data: bytes) -> Record | None:
        """Return the record of a scenario from bytes; None if they are damaged, or of another
        scenario."""
        try:
            record = Record.decoded(data, self._folder.episode_folder(scenario.id))
        except RunError:
            return None
        return record if record.scenario.id == scenario.id else None

    def _failed(self, scenario: Scenario, failure: AttemptFailure) -> None:
        given_up = self._queue.failed(scenario, failure)
        if given_up is not None:
            self._give_up(scenario, given_up.reason, given_up.status, failure.driven)

    def _failure_of(self, scenario: Scenario, lost: LostRenderer) -> AttemptFailure:
        """Return the failure of an episode whose shared renderer has ended, the policy's if its
        call was pending."""
        assert self._renderer is not None
        end = self._renderer.end_of(lost.number)
        if end is None:
            words = "the environment process lost its connection to the shared renderer"
            return AttemptFailure("process_ended", words)
        if not lost.asked:
            return AttemptFailure("handed_back")
        if end.unanswered_s is None:
            return AttemptFailure("process_ended", end.words)
        words = no_answer(self._hello, end.unanswered_s)
        return AttemptFailure("policy_timeout", f"{words} in {lost.asked} of {scenario.id}")

    def _take_late_result(self, done: Done) -> ResultOutcome:
        """Store a late result if there is none, and cancel the worker that runs the scenario."""
        busy = (
            worker
            for worker, job in self._workers.items()
            if job is not None and job.id == done.scenario
        )
        worker = next(busy, None)
        scenario = self._queue.named(done.scenario) if worker is None else self._workers[worker]
        if scenario is None:
            return self._compare_with_stored(done)
        record = self._record_of(scenario, done.record)
        frames_may_be_lost = self._options.frames_every_s > 0.0
        if record is None or done.again or frames_may_be_lost:
            return "refused"
        if worker is None:
            self._queue.remove(scenario)
        else:
            worker.cancel()
            del self._workers[worker]
        self._folder.write_episode(record, done.log)
        self._over(scenario, record.status)
        return "kept"

    def _compare_with_stored(self, done: Done) -> ResultOutcome:
        """Compare a result with the one in the run folder: two episodes that ended must be
        equal."""
        if done.scenario not in self._folder.spec.scenarios:
            return "refused"
        try:
            stored = Record.load(self._folder.episode_folder(done.scenario) / "record.json")
            received = Record.decoded(done.record, self._folder.path)
        except RunError:
            return "refused"
        equal = msgspec.structs.replace(stored, clock={}) == msgspec.structs.replace(
            received, clock={}
        )
        comparable = None not in (stored.ended, received.ended) and not stored.setup.real_time
        return "conflict" if comparable and not equal else "duplicate"

    def _give_up(self, scenario: Scenario, reason: str, status: Status, driven: bytes) -> None:
        """Record a scenario after its last failed attempt. driven: record of what was driven."""
        log_event("given up", ERROR, scenario=scenario.id, why=reason, status=status)
        record = self._record_of(scenario, driven)
        if record is None:
            manifest = with_goal(self._hello.manifest, self._options.goal)
            record = Record.begun(scenario, manifest, self._setup)
        self._folder.write_episode(
            msgspec.structs.replace(
                record, status=status, reason=reason, ended=None, measures={}, clock={}
            )
        )
        self._over(scenario, status)

    def _over(self, scenario: Scenario, status: Status) -> None:
        log_event("done", scenario=scenario.id, status=status)
        if self._renderer is not None:
            self._renderer.episode_ended()
        self._handle(Done(scenario.id, status))


class _GivenUp(NamedTuple):
    """The status and the reason of an episode after its last failed attempt."""

    status: Status
    reason: str


class _AttemptQueue:
    """Queue of the scenarios of a run, with a count of their failed attempts.

    They are sorted by pseudonym, so that a policy cannot identify a scenario by counting episodes.
    With decoys they have two halves, with one of each pair, because both begin with the same view:
    a policy must not remember the first one.
    Failed attempts are stored in the run folder, so that a resumed run continues the count.
    """

    def __init__(self, folder: RunFolder, scenarios: Sequence[Scenario]) -> None:
        self._folder = folder
        self._seed = folder.spec.setup.seed
        self._has_decoys = any(one.decoy_of for one in scenarios)
        by_pseudonym = sorted(scenarios, key=partial(episode_id_of, self._seed))
        self._waiting = deque(sorted(by_pseudonym, key=self.in_second_half))
        self._failed = folder.failed_attempts()

    def __len__(self) -> int:
        return len(self._waiting)

    def next(self) -> Scenario:
        """Remove the first scenario, and return it."""
        return self._waiting.popleft()

    def named(self, name: str) -> Scenario | None:
        """Return the scenario of this name if it waits."""
        return next((scenario for scenario in self._waiting if scenario.id == name), None)

    def remove(self, scenario: Scenario) -> None:
        """Remove a scenario that waits."""
        self._waiting.remove(scenario)

    def in_second_half(self, scenario: Scenario) -> bool:
        """Return whether a scenario belongs to the second half."""
        return self._has_decoys and drives_second(self._seed, scenario)

    def on_last_attempt(self, scenario: Scenario) -> bool:
        """Return whether the next failure of a scenario is its last, unless its machine is lost."""
        attempts = RULES["process_ended"].attempts or 1
        return self._failed[FailedAttempt(scenario.id, away=False)] >= attempts - 1

    def failed(self, scenario: Scenario, failure: AttemptFailure) -> _GivenUp | None:
        """Queue a scenario again after a failed attempt; after the last one, return its status and
        reason."""
        rule = RULES[failure.fault]
        if rule.attempts == 1:
            return _GivenUp(rule.status, failure.why)
        attempt = FailedAttempt(scenario.id, failure.fault == "machine_lost")
        if rule.attempts is not None:
            self._failed[attempt] += 1
            self._folder.add_failed_attempt(attempt)
            if self._failed[attempt] >= rule.attempts:
                found = f": {failure.found}" if failure.found else ""
                times = f"{failure.why}, {rule.attempts} times{found}; see logs/ in the run folder"
                return _GivenUp(rule.status, times)
        facts = {"why": failure.why, "attempts": self._failed[attempt], "of": rule.attempts or 0}
        log_event("retried", WARNING, scenario=scenario.id, **facts)
        self._waiting.appendleft(scenario)
        return None
