"""Runs scenarios in N environment processes on this machine.

A process that dies (SUMO and PyBullet can take it down) is replaced and its scenario tried once more; one that shows
no sign of life is killed. After the last attempt the episode is recorded as crashed, so that none is ever lost.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from pathlib import Path

import msgspec

from bridge.director import Outside
from cosim.errors import MachineError, unwritable
from cosim.injection import Live
from cosim.ports import Manifest
from cosim.record import begun
from cosim.runfolder import RunFolder
from cosim.scenario import Scenario
from physics.cameras import CameraName
from scenarios import worker
from scenarios.messages import Done, Job, Message, Unsaved, decode_message, encode

ATTEMPTS = 2
SILENCE_S = 300.0
"""A worker that says nothing for so long hangs; a slow policy says something once a simulated second."""

POLL_S = 1.0
KEPT = "Finished episodes are kept; make room and go on with --resume"

Tell = Callable[[Message], None]


@dataclass
class _Worker:
    """A worker process, its end of the pipe, and what it is busy with."""

    process: SpawnProcess
    pipe: Connection
    log: Path
    job: Scenario | None = None
    heard_at: float = field(default_factory=time.monotonic)


def run_all(
    folder: RunFolder,
    scenarios: Sequence[Scenario],
    policy: str,
    manifest: Manifest,
    *,
    jobs: int,
    tell: Tell,
    frames_every_s: float = 0.0,
    camera: CameraName = "bullet",
    live: Live | None = None,
    outside: Outside | None = None,
) -> None:
    """Run scenarios, `jobs` at a time, adding each record to the folder as it ends.

    outside: the director of the event pedestrians, when the episodes have none of their own.
    """
    pool = _Pool(folder, policy, manifest, tell, frames_every_s, camera, live, outside)
    waiting = deque(scenarios)
    attempts = dict.fromkeys((s.id for s in scenarios), 0)
    try:
        while waiting or pool.busy:
            while waiting and len(pool.busy) < jobs:
                pool.give(waiting.popleft())
            for scenario, why in pool.listen():
                attempts[scenario.id] += 1
                if attempts[scenario.id] < ATTEMPTS:
                    waiting.appendleft(scenario)
                else:
                    pool.give_up(scenario, f"{why}, {ATTEMPTS} times; see logs/ in the run folder")
    finally:
        pool.close()


class _Pool:
    """The workers of one run."""

    def __init__(
        self,
        folder: RunFolder,
        policy: str,
        manifest: Manifest,
        tell: Tell,
        frames_every_s: float,
        camera: CameraName,
        live: Live | None,
        outside: Outside | None,
    ) -> None:
        self._folder, self._policy, self._manifest = folder, policy, manifest
        self._tell, self._frames_every_s, self._camera, self._live = tell, frames_every_s, camera, live
        self._outside = outside
        self._workers: list[_Worker] = []
        self._started = 0

    @property
    def busy(self) -> list[_Worker]:
        return [w for w in self._workers if w.job is not None]

    def give(self, scenario: Scenario) -> None:
        """Hand a scenario to an idle worker, or to a new one."""
        idle = next((w for w in self._workers if w.job is None), None) or self._start()
        idle.job, idle.heard_at = scenario, time.monotonic()
        target = str(self._folder.episode_folder(scenario.id))
        (Path(target) / "record.json").unlink(missing_ok=True)
        try:
            suite_hash = self._folder.spec.suite_hash
            beside = self._folder.spec.counterfactual
            job = Job(
                scenario, suite_hash, target, self._frames_every_s, self._camera, self._live, self._outside, beside
            )
            idle.pipe.send_bytes(encode(job))
        except BrokenPipeError:
            idle.heard_at = time.monotonic()  # it died while idle: `listen` finds that out

    def listen(self) -> list[tuple[Scenario, str]]:
        """Take in what the workers say. Returns the scenarios whose worker was lost, and why."""
        lost = []
        wait([w.pipe for w in self.busy], timeout=POLL_S)
        for one in self.busy:
            if self._hear(one):
                continue
            why = self._death(one)
            self._workers.remove(one)
            if one.job is None:
                continue
            if self._folder.adopt(one.job.id):
                self._tell(Done(one.job.id, "done"))
            else:
                lost.append((one.job, why))
        return lost

    def _hear(self, one: _Worker) -> bool:
        """Everything a worker has said since; False when its pipe is closed or it has been silent."""
        try:
            while one.pipe.poll():
                message = decode_message(one.pipe.recv_bytes())
                one.heard_at = time.monotonic()
                if isinstance(message, Unsaved):
                    raise MachineError(f"{message.reason}. {KEPT}.")
                if isinstance(message, Done):
                    self._folder.adopt(message.scenario)
                    one.job = None
                self._tell(message)
        except (EOFError, ConnectionResetError):
            one.process.join(5.0)
            return False
        return one.job is None or time.monotonic() - one.heard_at < SILENCE_S

    def _death(self, one: _Worker) -> str:
        """How a worker ended; a hanging one is killed."""
        one.pipe.close()
        if one.process.is_alive():
            one.process.kill()
            one.process.join()
            return "the environment process showed no sign of life"
        code = one.process.exitcode or 0
        if code < 0:
            return f"the environment process was killed by {signal.Signals(-code).name}"
        return f"the environment process ended with exit code {code}"

    def give_up(self, scenario: Scenario, reason: str) -> None:
        """Record a scenario that no worker survives as crashed."""
        record = begun(scenario, self._manifest, self._folder.spec.suite_hash)
        record = msgspec.structs.replace(record, reason=reason)
        target = self._folder.episode_folder(scenario.id)
        try:
            target.mkdir(parents=True, exist_ok=True)
            record.save(target / "record.json")
        except OSError as error:
            raise unwritable(target, error, KEPT) from error
        self._folder.add(record)
        self._tell(Done(scenario.id, "crashed"))

    def close(self) -> None:
        """End every worker: idle ones by closing their pipe, busy ones by force."""
        for one in self._workers:
            if one.job is not None:
                one.process.kill()
            one.pipe.close()
        for one in self._workers:
            one.process.join(10.0)
            if one.process.is_alive():
                one.process.kill()
                one.process.join()
        self._workers.clear()

    def _start(self) -> _Worker:
        context = multiprocessing.get_context("spawn")
        mine, theirs = context.Pipe()
        log = self._folder.path / "logs" / f"worker-{self._started}.log"
        process = context.Process(
            target=worker.main,
            args=(theirs, self._policy, str(log), os.getpid()),
            name=f"cosim-env-{self._started}",
            daemon=True,
        )
        process.start()
        theirs.close()
        self._started += 1
        one = _Worker(process, mine, log)
        self._workers.append(one)
        return one
