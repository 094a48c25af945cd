"""Child processes of a run: started, watched, and ended with all their own children."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import nullcontext, suppress
from functools import partial
from pathlib import Path
from signal import SIGABRT, SIGBUS, SIGFPE, SIGILL, SIGSEGV
from typing import Final, NamedTuple

import msgspec

from cosim.core.child_process import exit_in_words
from cosim.core.errors import MachineError, UsageError, unwritable
from cosim.core.framing import MAX_MESSAGE_BYTES, MessageSocket
from scenarios.ipc.command_log import LOG_BYTES, Driven, driven_of, progress_of
from scenarios.ipc.deadlines import Patience, PendingCall, PendingCallMemory
from scenarios.ipc.messages import (
    Job,
    Message,
    MessageHandler,
    Ready,
    Unable,
    decode_message,
    encode_message,
)
from scenarios.ipc.sandbox import Sandbox

WORKER: Final = "scenarios.runs.worker:serve_jobs"
"""The function of an environment process."""
ENDING_S: Final = 10.0
"""Seconds that a process may take to end before it is killed; then the same for its supervisor."""
_FAULTS: Final = tuple(-fault for fault in (SIGABRT, SIGBUS, SIGFPE, SIGILL, SIGSEGV))
"""Exit codes of a process that crashed in compiled code."""
SILENCE_S: Final = 300.0
"""Timeout in seconds of a process's heartbeats while no policy call is pending: an engine hangs."""
TICK_S: Final = 120.0
"""Timeout in seconds of a tick, which takes milliseconds; longer than that of a policy's answer."""
_CHECK_PERIOD_S: Final = 1.0
"""Seconds between two checks whether a supervisor was stopped by a signal."""
_CODE: Final = (
    "import sys; sys.path[:] = {path!r}; from scenarios.ipc.supervisor import supervise_worker; "
    "supervise_worker({entry_point!r}, {descriptors}, {run}, {sandbox})"
)


class ChildProcess:
    """A supervisor process and its worker (`scenarios.ipc.supervisor`).

    log: file of its output, None for this process's standard error.
    entry_point: function that the worker runs, as module:name.
    kind: kind of the process, for messages.
    descriptors: further descriptors to pass on.
    max_bytes: size limit of a message from it.
    sandbox: sandbox in which it runs, without the memory of the pending call.
    open: whether it is not known to have ended.
    """

    def __init__(
        self,
        log: Path | None,
        entry_point: str,
        kind: str,
        descriptors: tuple[int, ...] = (),
        max_bytes: int = MAX_MESSAGE_BYTES,
        sandbox: Sandbox | None = None,
    ) -> None:
        self.log = str(log)
        self.open = True
        self.kind = kind
        self._memory = PendingCallMemory.new(LOG_BYTES)
        self._last_pending_call: PendingCall | None = None
        self._last_driven: Driven | None = None
        self.in_engine = False
        self.in_policy = False
        ours, theirs = socket.socketpair()
        self.wire = MessageSocket(ours, max_bytes)
        call = () if sandbox is not None else (self._memory.descriptor,)
        inherited = (theirs.fileno(), *call, *descriptors)
        path = [str(Path(entry).absolute()) for entry in sys.path]
        values = None if sandbox is None else tuple(sandbox)
        code = _CODE.format(
            path=path,
            entry_point=entry_point,
            descriptors=inherited,
            run=os.getpid(),
            sandbox=values,
        )
        try:
            if log is not None:
                log.parent.mkdir(parents=True, exist_ok=True)  # a policy may have deleted it
            with nullcontext(2) if log is None else log.open("ab") as printed:
                self._child = subprocess.Popen(
                    [sys.executable, "-P", "-c", code],
                    stdin=subprocess.DEVNULL,
                    stdout=printed,
                    stderr=printed,
                    pass_fds=inherited,
                    start_new_session=True,
                )
        except OSError as error:
            raise unwritable(Path(self.log), error) from error
        finally:
            theirs.close()

    @property
    def pending_call(self) -> PendingCall | None:
        """Return the pending call of the policy; after the end, the one that was pending then."""
        return self._memory.pending_call if self.open else self._last_pending_call

    @property
    def driven(self) -> Driven | None:
        """Return what was driven of the last episode of an environment process; None if unknown."""
        return driven_of(self._memory) if self.open else self._last_driven

    @property
    def progress(self) -> tuple[int, bool]:
        """Return the ticks of the episode so far, and whether it is over."""
        return progress_of(self._memory)

    def wake(self) -> None:
        """Continue the supervisor, which continues the worker, if a signal has stopped it."""
        with suppress(OSError):
            if _is_stopped(self._child.pid):
                self._child.send_signal(signal.SIGCONT)

    @property
    def descriptor(self) -> int | None:
        """Return the file descriptor that is readable when it has a message; None if it has
        ended."""
        return self.wire.fileno() if self.open else None

    def give(self, job: Job) -> None:
        self.send(encode_message(job))

    def send(self, message: bytes) -> None:
        """Send it a message, without waiting. A process that has ended ignores it."""
        with suppress(OSError):
            self.wire.post(message)

    def listen(self, handle: MessageHandler) -> bool:
        """Pass on the messages that have arrived. Returns False if no more will."""
        with suppress(OSError):
            self.wire.flush()
        try:
            for message in self.wire.received():
                handle(decode_message(message))
        except (EOFError, msgspec.DecodeError):  # a policy can write garbage to the socket
            return False
        return True

    def hang_up(self) -> None:
        """Close the socket, after which an idle worker ends."""
        self.wire.close()

    def kill(self, *, wait: bool = True) -> None:
        """End it by force."""
        self._terminate()
        if wait:
            self.end()

    def end(self) -> str:
        """Wait for its end, by force if that takes too long. Returns the reason in words."""
        self.wire.close()
        self.wake()
        code = self._code(ENDING_S)
        if code is None:
            self._terminate()
            if self._code(2 * ENDING_S) is None:
                self._child.kill()
                self._child.wait()
        if self.open:
            self._last_pending_call = self._memory.pending_call
            self._last_driven = driven_of(self._memory)
            self.open = False
            self._memory.close()
        during = (
            f" in the policy's {self._last_pending_call.when}"
            if self._last_pending_call is not None
            else ""
        )
        self.in_engine = self._last_pending_call is None and code in _FAULTS
        by_itself = code is not None and (code >= 0 or code in _FAULTS)
        self.in_policy = self._last_pending_call is not None and by_itself
        return f"the {self.kind} process {_in_words(code)}{during}"

    def _terminate(self) -> None:
        """Request the supervisor to end everything, also if a signal has stopped it."""
        self._child.send_signal(signal.SIGTERM)
        self._child.send_signal(signal.SIGCONT)

    def _code(self, wait_s: float) -> int | None:
        """Return its exit code; None if it has not ended in time."""
        try:
            return self._child.wait(wait_s)
        except subprocess.TimeoutExpired:
            return None


def _is_stopped(pid: int) -> bool:
    """Return whether a signal has stopped a process."""
    after_name = Path("/proc", str(pid), "stat").read_text(errors="replace").rpartition(")")[2]
    return after_name.split()[0] == "T"


def _in_words(code: int | None) -> str:
    return "closed its pipe to the run" if code is None else exit_in_words(code)


class ProcessEnd(NamedTuple):
    """The end of a process, in words.

    pending_call: the policy call that was pending.
    in_engine: whether compiled code has ended it or hangs, while no policy call was pending.
    in_policy: whether it has ended by itself during a policy call.
    hung: whether it was killed because it sent nothing.
    allowed_s: the seconds that the policy had for its answer, if it was killed because there was
    none.
    driven: what was driven of its last episode; None if unknown.
    """

    words: str
    pending_call: PendingCall | None = None
    in_engine: bool = False
    hung: bool = False
    allowed_s: float | None = None
    driven: Driven | None = None
    in_policy: bool = False


class Watchdog:
    """Watches one process, and kills it when it hangs.

    silence_s: timeout in seconds of its heartbeats, unless a policy call is pending.
    tick_s: the same between two ticks of an episode.
    ready: whether it has loaded the engines and the policy.
    last_message_s: monotonic clock of its last message.
    """

    def __init__(
        self,
        process: ChildProcess,
        patience: Patience,
        silence_s: float,
        tick_s: float | None = None,
    ) -> None:
        self.process = process
        self.ready = False
        self.last_message_s = time.monotonic()
        self._patience = patience
        self._silence_s = silence_s
        self._tick_s = tick_s or silence_s
        self._progress = (0, False)
        self._next_check_s = 0.0

    def poll(self, handle: MessageHandler, *, idle: bool = False) -> ProcessEnd | None:
        """Pass on its messages. Returns its end, if it has ended or was killed because it hangs.

        idle: whether it may be silent.
        Raises UsageError if it cannot load the policy, MachineError if the machine lacks something.
        """
        if not self.process.listen(partial(self._handle_message, handle)):
            words = self.process.end()
            return self._ended(words, self.process.pending_call, self.process.in_engine)
        pending_call = self.process.pending_call
        now_s = time.monotonic()
        if idle:
            return None
        if now_s >= self._next_check_s:
            self._next_check_s = now_s + _CHECK_PERIOD_S
            self.process.wake()
        if pending_call is None:
            allowed_s = self._allowed_s()
            if now_s - self.last_message_s <= allowed_s:
                return None
            self.process.kill()
            words = f"the {self.process.kind} process showed no sign of life"
            return self._ended(words, in_engine=True, hung=True)
        self.last_message_s = now_s
        if not pending_call.overdue(self._patience):
            return None
        self.process.kill()
        words = f"the {self.process.kind} process was ended"
        return self._ended(words, pending_call, allowed_s=self._patience.of(pending_call.kind))

    def _allowed_s(self) -> float:
        """Return the timeout of its next heartbeat, after a look at the ticks, each of which is a
        heartbeat."""
        progress = self.process.progress
        if progress != self._progress:
            self._progress = progress
            self.last_message_s = time.monotonic()
        ticks, over = progress
        return self._tick_s if ticks and not over else self._silence_s

    def _ended(
        self,
        words: str,
        pending_call: PendingCall | None = None,
        in_engine: bool = False,
        hung: bool = False,
        allowed_s: float | None = None,
    ) -> ProcessEnd:
        driven, in_policy = self.process.driven, self.process.in_policy
        return ProcessEnd(words, pending_call, in_engine, hung, allowed_s, driven, in_policy)

    def _handle_message(self, handle: MessageHandler, message: Message) -> None:
        self.last_message_s = time.monotonic()
        if isinstance(message, Unable):
            raise_unable(message)
        if isinstance(message, Ready):
            self.ready = True
        else:
            handle(message)


def raise_unable(message: Unable) -> None:
    """Raise UsageError if the policy cannot be loaded, MachineError if the machine lacks
    something."""
    raise UsageError(message.reason) if message.blames_policy else MachineError(message.reason)
