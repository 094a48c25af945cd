"""Runs scenarios in N environment processes on this machine.

A process that dies (SUMO and PyBullet can take it down) is replaced and its scenario tried once more; an engine that
shows no sign of life is killed. After the last attempt the episode is recorded as crashed, so that none is ever lost.
A policy that gives no answer in time is not asked again: its episode has crashed.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from multiprocessing.connection import wait

import msgspec

from cosim.core.errors import MachineError, UsageError, unwritable
from cosim.episode.driver import Driver
from cosim.records.record import begun
from cosim.records.run_folder import RunFolder
from cosim.spec.options import EpisodeOptions
from cosim.spec.scenario import Scenario
from scenarios.execution.asked import Patience, Question
from scenarios.execution.messages import Done, Hello, Job, Message, Ready, Unable, Unsaved
from scenarios.execution.process import Process

ATTEMPTS = 2
SILENCE_S = 300.0
"""A worker that says nothing for so long, while its policy has nothing to answer, hangs in an engine."""

POLL_S = 1.0
_KEPT = "finished episodes are kept; make room and go on with --resume"

_Tell = Callable[[Message], None]


def run_all(
    folder: RunFolder,
    scenarios: Sequence[Scenario],
    policy: str,
    driver: Driver,
    *,
    jobs: int,
    tell: _Tell,
    options: EpisodeOptions = EpisodeOptions(),  # noqa: B008  a frozen value
    patience: Patience = Patience(),  # noqa: B008  a frozen value
) -> None:
    """Run scenarios, `jobs` at a time, adding each record to the folder as it ends.

    driver: the policy as it was loaded here; every process loads its own. Raises UsageError when a process cannot load
    the policy, MachineError when none can be started."""

    def job(scenario: Scenario) -> Job:
        return Job(scenario, str(folder.episode_folder(scenario.id)), options)

    pool = _Pool(folder, Hello(policy, driver.manifest, driver.source_hash), job, tell, patience)
    waiting = deque(scenarios)
    attempts = dict.fromkeys((s.id for s in scenarios), 0)
    try:
        while waiting or pool.busy:
            while waiting and len(pool.busy) < jobs:
                pool.give(waiting.popleft())
            for scenario, why in pool.listen():
                attempts[scenario.id] += bool(why)
                if attempts[scenario.id] < ATTEMPTS:
                    waiting.appendleft(scenario)
                else:
                    pool.give_up(scenario, f"{why}, {ATTEMPTS} times; see logs/ in the run folder")
    finally:
        pool.close()


class _Worker:
    """An environment process and what it is busy with."""

    def __init__(self, process: Process) -> None:
        self.process = process
        self.ready = False
        self.job: Scenario | None = None
        self.heard_at = time.monotonic()


class _Pool:
    """The workers of one run."""

    def __init__(
        self, folder: RunFolder, hello: Hello, job_of: Callable[[Scenario], Job], tell: _Tell, patience: Patience
    ) -> None:
        self._folder, self._hello, self._job_of = folder, hello, job_of
        self._tell, self._patience = tell, patience
        self._workers: list[_Worker] = []
        self._started = self._failed_starts = 0

    @property
    def busy(self) -> list[_Worker]:
        return [w for w in self._workers if w.job is not None]

    def give(self, scenario: Scenario) -> None:
        """Hand a scenario to an idle worker, or to a new one."""
        idle = next((w for w in self._workers if w.job is None), None) or self._start()
        idle.job, idle.heard_at = scenario, time.monotonic()
        self._folder.forget(scenario.id)
        idle.process.send(self._job_of(scenario))

    def listen(self) -> list[tuple[Scenario, str]]:
        """Take in what the workers say. Returns the scenarios whose worker was lost, and why; "" if it never began."""
        lost = []
        wait([w.process.pipe for w in self.busy], timeout=POLL_S)
        for one in self.busy:
            if not self._hear(one):
                lost += self._lost(one, one.process.end())
            elif one.job is None:
                continue
            elif (question := one.process.asked.question) is not None:
                one.heard_at = time.monotonic()
                if question.overdue(self._patience):
                    self._leave_unanswered(one, one.job, question)
            elif time.monotonic() - one.heard_at > SILENCE_S:
                one.process.kill()
                lost += self._lost(one, "the environment process showed no sign of life")
        return lost

    def _hear(self, one: _Worker) -> bool:
        """Everything a worker has said since; False when its pipe is closed."""
        for message in one.process.messages():
            if message is None:
                return False
            one.heard_at = time.monotonic()
            if isinstance(message, Unable):
                raise UsageError(message.reason) if message.blames_policy else MachineError(message.reason)
            if isinstance(message, Unsaved):
                raise MachineError(f"{message.reason}: {_KEPT}")
            if isinstance(message, Ready):
                one.ready, self._failed_starts = True, 0
                continue
            if isinstance(message, Done) and one.job is not None:
                scenario, one.job = one.job, None
                if not self._folder.adopt(scenario.id):
                    self.give_up(scenario, "its record was gone or damaged right after it had been written")
                    continue
            self._tell(message)
        return True

    def _lost(self, one: _Worker, why: str) -> list[tuple[Scenario, str]]:
        """A worker has ended. Returns its scenario if that is not done, and why."""
        self._workers.remove(one)
        if one.job is None:
            return []
        if self._folder.adopt(one.job.id):
            self._tell(Done(one.job.id, "done"))
            return []
        if one.ready:
            return [(one.job, why)]
        self._not_started(one, why)
        return [(one.job, "")]

    def _leave_unanswered(self, one: _Worker, scenario: Scenario, question: Question) -> None:
        """The policy takes too long: its process is killed, and its episode has crashed, once."""
        one.process.kill()
        self._workers.remove(one)
        silent = f"policy '{self._hello.manifest.name}' gave no answer for {self._patience.of(question.doing):g} s"
        if question.doing == "loading":
            raise UsageError(f"{silent} while it was loaded in an environment process: give a longer --start-timeout")
        self.give_up(scenario, f"{silent} in {question.when} of {scenario.id}")

    def _not_started(self, one: _Worker, why: str) -> None:
        """A worker that ended before it was ready. Raises the run's error when the next one has done so too."""
        self._failed_starts += 1
        if self._failed_starts < ATTEMPTS:
            return
        told = f"{why} before it was ready, {ATTEMPTS} times: see {one.process.log}"
        if one.process.question is not None:
            raise UsageError(f"policy '{self._hello.policy}' cannot be loaded: {told}")
        raise MachineError(f"{told}, and `cosim doctor`")

    def give_up(self, scenario: Scenario, reason: str) -> None:
        """Record a scenario as crashed: no worker survives it, or the policy does not answer."""
        record = begun(scenario, self._hello.manifest, self._folder.spec.suite_hash, self._hello.source_hash)
        record = msgspec.structs.replace(record, reason=reason)
        target = self._folder.episode_folder(scenario.id)
        try:
            target.mkdir(parents=True, exist_ok=True)
            record.save(target / "record.json")
        except OSError as error:
            raise unwritable(target, error, _KEPT) from error
        self._folder.add(record)
        self._tell(Done(scenario.id, "crashed"))

    def close(self) -> None:
        """End every worker: idle ones by closing their pipe, busy ones by force."""
        for one in self._workers:
            if one.job is not None:
                one.process.kill(wait=False)
            one.process.hang_up()
        for one in self._workers:
            one.process.end()
        self._workers.clear()

    def _start(self) -> _Worker:
        log = self._folder.path / "logs" / f"worker-{self._started}.log"
        one = _Worker(Process(log))
        one.process.send(self._hello)
        self._started += 1
        self._workers.append(one)
        return one
