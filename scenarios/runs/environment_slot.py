"""Environment slot: runs jobs in an environment process that is watched and replaced.

The local pool, a Zenoh worker and a Ray actor use the same slot. It decides, on the machine of the
process, whether its end or timeout is a failure. `scenarios.ipc.faults` limits the attempts.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from logging import WARNING
from pathlib import Path
from typing import Final

from cosim.core.errors import MachineError, UsageError
from cosim.core.log_event import log_event
from scenarios.ipc.child_process import WORKER, ChildProcess, ProcessEnd, Watchdog
from scenarios.ipc.faults import Failure
from scenarios.ipc.messages import (
    Done,
    Hello,
    Job,
    LostRenderer,
    Message,
    MessageHandler,
    encode_message,
)

SILENCE_S = 300.0
"""Timeout in seconds of a process's heartbeats while no policy call is pending: an engine hangs."""
STARTS: Final = 2
"""Number of processes in a row that may end before they are ready."""


def start_environment(log: Path, hello: Hello) -> ChildProcess:
    """Start an environment process on this machine."""
    process = ChildProcess(log, WORKER, "environment")
    process.send(encode_message(hello))
    return process


class EnvironmentSlot:
    """Worker that runs one job at a time in an environment process
    (`scenarios.runs.transport.Worker`).

    Raises UsageError when the policy cannot be loaded, MachineError when no process can be started.
    """

    ended = False

    def __init__(self, start: Callable[[], ChildProcess], hello: Hello) -> None:
        self.job: Job | None = None
        self.log = ""
        self._start_process = start
        self._hello = hello
        self._watchdog: Watchdog | None = None
        self._failed_starts = 0
        self._ran = False
        self._given_s = 0.0

    @property
    def ready(self) -> bool:
        """Whether a process has loaded the engines and the policy."""
        return self._watchdog is not None and self._watchdog.ready

    @property
    def descriptor(self) -> int | None:
        """File descriptor that is readable when the process has a message; None without a
        process."""
        return None if self._watchdog is None else self._watchdog.process.descriptor

    def start(self) -> None:
        """Start a process, and give it the job, unless there is one."""
        if self._watchdog is None:
            process = self._start_process()
            self._watchdog = Watchdog(process, self._hello.patience, SILENCE_S)
            self.log = process.log
            self._ran = False
            if self.job is not None:
                process.give(self.job)

    def give(self, job: Job) -> None:
        """Run a job, in a new process if there is none."""
        self.job = job
        if self._watchdog is None:
            self.start()
        else:
            self._watchdog.process.give(job)
            self._given_s = self._watchdog.heard_s = time.monotonic()

    def poll(self, hear: MessageHandler) -> Failure | None:
        """Pass on messages about the job, enforce deadlines, and return the failure of the job if
        it has failed."""
        watchdog = self._watchdog
        if watchdog is None:
            return None
        end = watchdog.poll(partial(self._take, hear), idle=watchdog.ready and self.job is None)
        if watchdog.ready:
            self._failed_starts = 0
        return None if end is None else self._ended(watchdog, end)

    def cancel(self) -> None:
        """Kill the process, and forget the job."""
        self.job = None
        watchdog = self._watchdog
        self._watchdog = None
        if watchdog is not None:
            watchdog.process.kill()

    def stop(self) -> None:
        """Request the process to end, by force if it is busy, without waiting."""
        if self._watchdog is not None:
            if self.job is not None:
                self._watchdog.process.kill(wait=False)
            self._watchdog.process.hang_up()

    def end(self) -> None:
        """Wait until the process has ended."""
        watchdog = self._watchdog
        self._watchdog = None
        if watchdog is not None:
            watchdog.process.end()

    def _take(self, hear: MessageHandler, message: Message) -> None:
        if self.job is None:
            return
        if isinstance(message, Done | LostRenderer):
            self.job = None
            self._ran = True
        hear(message)

    def _ended(self, watchdog: Watchdog, end: ProcessEnd) -> Failure | None:
        """Return the failure of a started job; give a job that was not started to a new process."""
        self._watchdog = None
        idle = (
            self._ran
            and watchdog.heard_s <= self._given_s
            and end.question is None
            and not end.hung
        )
        if end.allowed_s is not None or (watchdog.ready and not idle and self.job is not None):
            job = self.job
            self.job = None
            return self._failure(job, end)
        if not watchdog.ready:
            self._count_failed_start(end)
        log_event("process replaced", WARNING, log=Path(self.log).name, why=end.words)
        if self.job is not None:
            self.start()
        return None

    def _failure(self, job: Job | None, end: ProcessEnd) -> Failure:
        if end.allowed_s is None or end.question is None:
            return Failure("engine_failed" if end.in_engine else "process_ended", end.words)
        words = no_answer(self._hello, end.allowed_s)
        if end.question.doing == "loading" or job is None:
            raise UsageError(
                f"{words} while it was loaded in an environment process: give a longer "
                f"--start-timeout"
            )
        return Failure("policy_timeout", f"{words} in {end.question.when} of {job.scenario.id}")

    def _count_failed_start(self, end: ProcessEnd) -> None:
        self._failed_starts += 1
        if self._failed_starts < STARTS:
            return
        words = f"{end.words} before it was ready, {STARTS} times: see {self.log}"
        if end.question is not None:
            raise UsageError(f"policy '{self._hello.policy}' cannot be loaded: {words}")
        raise MachineError(f"{words}, and `cosim doctor`")


def no_answer(hello: Hello, allowed_s: float) -> str:
    """Return the reason of a policy timeout, in words."""
    return f"policy '{hello.manifest.name}' gave no answer for {allowed_s:g} s"


def new_output(log: Path, begin: int, most_bytes: int) -> tuple[bytes, int]:
    """Return the last bytes of a log that were added after byte `begin`, and the log's size."""
    try:
        with log.open("rb") as file:
            size = file.seek(0, 2)
            file.seek(max(begin, size - most_bytes))
            return file.read(most_bytes), size
    except OSError:
        return b"", begin
