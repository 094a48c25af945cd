"""Transports on this machine: environment processes, or the process of the run itself."""

from __future__ import annotations

from multiprocessing.connection import wait
from pathlib import Path

import msgspec

from cosim.episode.policy_caller import PolicyCaller
from scenarios.ipc.child_process import ChildProcess
from scenarios.ipc.messages import Hello, Job, MessageHandler
from scenarios.runs.environment_slot import EnvironmentSlot, start_environment
from scenarios.runs.worker import run_job


class LocalProcesses:
    """Transport to up to `jobs` environment processes; each has a log file in the folder `logs`."""

    def __init__(self, logs: Path, jobs: int = 1) -> None:
        self._logs = logs
        self._jobs = jobs
        self._started = 0
        self._slots: list[EnvironmentSlot] = []

    def room(self, busy: int) -> int:
        return self._jobs - busy

    def unsolicited(self) -> tuple[()]:
        return ()

    def start(self, hello: Hello) -> EnvironmentSlot:
        host = hello.host.of_job(len(self._slots))
        hello = msgspec.structs.replace(hello, host=host)

        def start_next(hello: Hello) -> ChildProcess:
            number = self._started
            self._started = self._started + 1
            return start_environment(self._logs / f"worker-{number}.log", hello)

        slot = EnvironmentSlot(start_next, hello)
        self._slots.append(slot)
        return slot

    def wait(self, timeout_s: float) -> None:
        descriptors = [slot.descriptor for slot in self._slots]
        wait([one for one in descriptors if one is not None], timeout_s)


class InProcess:
    """Transport that runs episodes in this process, one after another, with a loaded policy.

    An episode that hangs or dies ends the run, and no timeout of an answer is enforced.
    """

    def __init__(self, caller: PolicyCaller) -> None:
        self._caller = caller

    def room(self, busy: int) -> int:
        return 1 - busy

    def unsolicited(self) -> tuple[()]:
        return ()

    def start(self, hello: Hello) -> _ThisProcess:
        return _ThisProcess(self._caller)

    def wait(self, timeout_s: float) -> None:
        """Do nothing: the next poll runs the next job."""


class _ThisProcess:
    """Worker that runs its job when it is polled."""

    log = "this process's own output"
    ended = False

    def __init__(self, caller: PolicyCaller) -> None:
        self._caller = caller
        self._job: Job | None = None

    def give(self, job: Job) -> None:
        self._job = job

    def poll(self, handle: MessageHandler) -> None:
        job = self._job
        self._job = None
        if job is not None:
            done, _ = run_job(job, self._caller, handle)
            handle(done)

    def cancel(self) -> None:
        """Do nothing: nothing else runs while it works."""

    def stop(self) -> None:
        """Do nothing: this process continues."""

    def end(self) -> None:
        """Do nothing: this process continues."""
