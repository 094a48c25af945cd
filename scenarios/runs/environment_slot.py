"""Environment slot: runs jobs in an environment process that is watched and replaced.

The local pool, a Zenoh worker and a Ray actor use the same slot. It decides, on the machine of the
process, whether its end or timeout is a failure. `scenarios.ipc.faults` limits the attempts.

After the last attempt the next process simulates the logged commands again, before it loads the
policy. If the simulator fails at the same tick, it is at fault, otherwise the policy is.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from logging import WARNING
from pathlib import Path
from typing import Final, NamedTuple

import msgspec

from cosim.core.errors import MachineError, UsageError
from cosim.core.log_event import log_event
from scenarios.ipc.child_process import (
    SILENCE_S,
    TICK_S,
    WORKER,
    ChildProcess,
    ProcessEnd,
    Watchdog,
)
from scenarios.ipc.command_log import Driven
from scenarios.ipc.faults import RULES, AttemptFailure, failure_of_result
from scenarios.ipc.messages import (
    Done,
    Hello,
    Job,
    LostRenderer,
    Message,
    MessageHandler,
    Repeat,
    Repeated,
    encode_message,
)

STARTS: Final = 2
"""Number of processes in a row that may end before they are ready."""
REPLAYS: Final = 2
"""Number of replays of a failed episode; another one if the first ends at another tick or was
killed by a signal."""
SURVIVES: Final = "the policy is at fault, because the simulator survives its commands without it"
FAILS_ELSEWHERE: Final = "the simulator fails without the policy, too, but at another tick"
FAILS_AGAIN: Final = "the simulator is at fault, because it fails there without the policy, too"
"""Results of a replay in words."""


def start_environment(log: Path, hello: Hello) -> ChildProcess:
    """Start an environment process on this machine."""
    process = ChildProcess(log, WORKER, "environment")
    process.send(encode_message(hello))
    return process


class _Suspect(NamedTuple):
    """A failed attempt whose commands are simulated again without the policy.

    driven: what was driven up to the failure.
    replays: number of replays so far.
    """

    failure: AttemptFailure
    driven: Driven
    replays: int = 1


class EnvironmentSlot:
    """Worker that runs one job at a time in an environment process
    (`scenarios.runs.transport.Worker`).

    start: starts an environment process.
    Raises UsageError when the policy cannot be loaded, MachineError when no process can be started.
    """

    ended = False

    def __init__(self, start: Callable[[Hello], ChildProcess], hello: Hello) -> None:
        self.job: Job | None = None
        self.log = ""
        self._start_process = start
        self._hello = hello
        self._watchdog: Watchdog | None = None
        self._failed_starts = 0
        self._ran = False
        self._given_s = 0.0
        self._second_half: bool | None = None
        self._suspect: _Suspect | None = None
        self._reported: Done | Repeated | None = None

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
            process = self._start(self._hello)
            if self.job is not None:
                process.give(self.job)

    def _start(self, hello: Hello) -> ChildProcess:
        process = self._start_process(hello)
        self._watchdog = Watchdog(process, hello.patience, SILENCE_S, TICK_S)
        self.log = process.log
        self._ran = False
        return process

    def give(self, job: Job) -> None:
        """Run a job, in a new process if there is none, or if the job is of the other half of its
        run."""
        if self._second_half is not None and self._second_half != job.second:
            self.stop()
            self.end()
        self._second_half = job.second
        self.job = job
        if self._watchdog is None:
            self.start()
        else:
            self._watchdog.process.give(job)
            self._given_s = self._watchdog.last_message_s = time.monotonic()

    def poll(self, handle: MessageHandler) -> AttemptFailure | None:
        """Pass on messages about the job, enforce deadlines, and return the failure of the job if
        it has failed."""
        watchdog = self._watchdog
        if watchdog is None:
            return None
        end = watchdog.poll(
            partial(self._handle_message, handle), idle=watchdog.ready and self.job is None
        )
        if watchdog.ready:
            self._failed_starts = 0
        reported, self._reported = self._reported, None
        if isinstance(reported, Repeated):
            if end is not None:
                self._watchdog = None
            return self._attribute(reported.error, watchdog.process.driven, record=reported.record)
        if isinstance(reported, Done):
            return self._replay_reported_error(watchdog, reported)
        return None if end is None else self._handle_end(watchdog, end)

    def cancel(self) -> None:
        """Kill the process, and forget the job."""
        self.job = self._suspect = None
        watchdog = self._watchdog
        self._watchdog = None
        if watchdog is not None:
            watchdog.process.kill()

    def stop(self) -> None:
        """Request the process to end, by force if it is busy, without waiting."""
        if self._watchdog is not None:
            if self.job is not None or not self._watchdog.ready:
                self._watchdog.process.kill(wait=False)
            self._watchdog.process.hang_up()

    def end(self) -> None:
        """Wait until the process has ended."""
        watchdog = self._watchdog
        self._watchdog = None
        if watchdog is not None:
            watchdog.process.end()

    def _handle_message(self, handle: MessageHandler, message: Message) -> None:
        if self.job is None:
            return
        if isinstance(message, Repeated) or (
            isinstance(message, Done) and self._needs_replay(message)
        ):
            self._reported = message
            return
        if isinstance(message, Done | LostRenderer):
            self.job = None
            self._ran = True
        handle(message)

    def _needs_replay(self, done: Done) -> bool:
        """Return whether a result is the last attempt's engine error, so that its cause must be
        found."""
        last = self.job is not None and self.job.last_attempt and self._suspect is None
        return last and done.again and done.status == "invalid"

    def _replay_reported_error(self, watchdog: Watchdog, done: Done) -> AttemptFailure | None:
        """Find the cause of an engine error that a process has reported."""
        self._watchdog = None
        driven = watchdog.process.driven
        watchdog.process.kill()
        why = msgspec.json.decode(done.record, type=_Reason).reason
        return self._failed(failure_of_result(done.status, why), driven)

    def _failed(self, failure: AttemptFailure, driven: Driven | None) -> AttemptFailure | None:
        """Return a failure, or start its replay if it is the last one."""
        job = self.job
        last = RULES[failure.fault].attempts == 1 or (job is not None and job.last_attempt)
        if job is None or driven is None or not last:
            self.job = None
            return failure
        self._replay(_Suspect(failure, driven), job)
        return None

    def _replay(self, suspect: _Suspect, job: Job) -> None:
        self._suspect = suspect
        repeat = Repeat(job, suspect.driven.commands)
        self._start(msgspec.structs.replace(self._hello, repeat=repeat))

    def _attribute(
        self, error: str, driven: Driven | None, *, record: bytes = b"", killed: bool = False
    ) -> AttemptFailure | None:
        """Return the failure of a job after its replay; None if another replay was started.

        error: why the replay has failed, "" if the simulator survived.
        driven: what was driven in the replay.
        killed: whether the replay's process ended without a fault of its own, so that something
        else may have killed it.
        """
        suspect, job = self._suspect, self.job
        if suspect is None or job is None:
            return None
        failure = suspect.failure
        at_same_tick = bool(error) and driven is not None and driven.ticks == suspect.driven.ticks
        may_repeat = suspect.replays < REPLAYS and self._watchdog is None
        if RULES[failure.fault].attempts == 1:
            failure = failure._replace(driven=record)
        elif error and may_repeat and (killed or not at_same_tick):
            self._replay(suspect._replace(replays=suspect.replays + 1), job)
            return None
        elif at_same_tick:
            failure = AttemptFailure("engine_failed", failure.why, FAILS_AGAIN, record)
        else:
            found = FAILS_ELSEWHERE if error else SURVIVES
            failure = AttemptFailure("process_ended", failure.why, found, record)
        self.job = self._suspect = None
        return failure

    def _handle_end(self, watchdog: Watchdog, end: ProcessEnd) -> AttemptFailure | None:
        """Return the failure of a started job; give a job that was not started to a new process."""
        self._watchdog = None
        if self._suspect is not None:
            log_event("replay ended", WARNING, log=Path(self.log).name, why=end.words)
            return self._attribute(end.words, end.driven, killed=not end.in_engine)
        idle = (
            self._ran
            and watchdog.last_message_s <= self._given_s
            and end.pending_call is None
            and not end.hung
        )
        if end.allowed_s is not None or (watchdog.ready and not idle and self.job is not None):
            return self._failed(self._failure(self.job, end), end.driven)
        if not watchdog.ready:
            self._count_failed_start(end)
        log_event("process replaced", WARNING, log=Path(self.log).name, why=end.words)
        if self.job is not None:
            self.start()
        return None

    def _failure(self, job: Job | None, end: ProcessEnd) -> AttemptFailure:
        if end.allowed_s is None or end.pending_call is None:
            if end.in_policy:
                return AttemptFailure("policy_ended", end.words)
            return AttemptFailure("engine_failed" if end.in_engine else "process_ended", end.words)
        words = no_answer(self._hello, end.allowed_s)
        if end.pending_call.kind == "loading" or job is None:
            raise UsageError(
                f"{words} while it was loaded in an environment process: give a longer "
                f"--start-timeout"
            )
        return AttemptFailure(
            "policy_timeout", f"{words} in {end.pending_call.when} of {job.scenario.id}"
        )

    def _count_failed_start(self, end: ProcessEnd) -> None:
        self._failed_starts += 1
        if self._failed_starts < STARTS:
            return
        words = f"{end.words} before it was ready, {STARTS} times: see {self.log}"
        if end.pending_call is not None:
            raise UsageError(f"policy '{self._hello.policy}' cannot be loaded: {words}")
        raise MachineError(f"{words}, and `cosim doctor`")


class _Reason(msgspec.Struct):
    """The reason in a record."""

    reason: str


def no_answer(hello: Hello, allowed_s: float) -> str:
    """Return the reason of a policy timeout, in words."""
    return f"policy '{hello.manifest.name}' gave no answer for {allowed_s:g} s"


def new_output(log: Path, begin: int, max_bytes: int) -> tuple[bytes, int]:
    """Return the last bytes of a log that were added after byte `begin`, and the log's size."""
    try:
        with log.open("rb") as file:
            size = file.seek(0, 2)
            file.seek(max(begin, size - max_bytes))
            return file.read(max_bytes), size
    except OSError:
        return b"", begin
