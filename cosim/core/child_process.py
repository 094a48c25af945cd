"""Forked child processes with limits, and processes that end with their parent."""

from __future__ import annotations

import ctypes
import os
import resource
import signal
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from cosim.core.framing import MessageSocket

_PR_SET_PDEATHSIG = 1
"""Number of Linux's prctl operation that sends a signal when the parent dies."""
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Environment variables with the number of threads of numerical libraries."""
_EXIT_TIMEOUT_S = 5.0
"""Time that a child has to exit after closing its socket, in seconds; then it is killed."""
_POLL_INTERVAL_S = 0.001
"""Interval at which an exiting child is polled, in seconds."""


def limit_threads() -> None:
    """Let child processes compute with one thread each, unless the environment sets a number."""
    for name in _THREADS:
        os.environ.setdefault(name, "1")


def exit_with_parent(parent: int, signal_number: signal.Signals = signal.SIGKILL) -> None:
    """Let Linux signal this process when its parent dies; exit at once if the parent is dead.

    parent: process id of the parent.
    signal_number: signal that this process gets.
    """
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal_number)
    if os.getppid() != parent:
        os._exit(1)


def exit_in_words(code: int) -> str:
    """Return how a process with this exit code ended, such as "was killed by SIGSEGV"."""
    return (
        f"was killed by {signal.Signals(-code).name}"
        if code < 0
        else f"ended with exit code {code}"
    )


class ForkedChild:
    """Forked child process that answers messages over a socket, without output of its own.

    It ends with its parent, or when it is closed.

    serves: function that the child runs with its end of the socket. It shares what this process has
        loaded, but no threads.
    room_bytes: memory that the child may allocate in addition to this process's.
    """

    def __init__(self, serves: Callable[[MessageSocket], None], room_bytes: int) -> None:
        ours, theirs = socket.socketpair()
        parent = os.getpid()
        # Python drops an exception that is raised in its own calls after a fork, Ctrl-C included.
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            self._pid = os.fork()
            if self._pid == 0:
                ours.close()
                _run_child(serves, theirs, parent, room_bytes)
            theirs.close()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
        self.wire = MessageSocket(ours)

    def close(self) -> None:
        """Kill the child."""
        self.wire.close()
        if self._pid:
            os.kill(self._pid, signal.SIGKILL)
            self.ended()

    def ended(self) -> str:
        """Return how the child ended, once its socket has closed; a child that does not exit is
        killed."""
        pid = self._pid
        self._pid = 0
        until_s = time.monotonic() + _EXIT_TIMEOUT_S
        try:
            while True:
                ended, status = os.waitpid(pid, os.WNOHANG)
                if ended:
                    return exit_in_words(os.waitstatus_to_exitcode(status))
                if time.monotonic() > until_s:
                    os.kill(pid, signal.SIGKILL)
                time.sleep(_POLL_INTERVAL_S)
        except ChildProcessError:  # other code in this process reaped the child
            return "has ended"


def _run_child(
    serves: Callable[[MessageSocket], None], end: socket.socket, parent: int, room_bytes: int
) -> None:
    """Run the child's function with its limits, then exit."""
    code = 1
    try:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        exit_with_parent(parent)
        null_device = os.open(os.devnull, os.O_RDWR)
        for descriptor in range(3):
            os.dup2(null_device, descriptor)
        with suppress(OSError):  # a sandbox without /proc has its own limit
            pages = int(Path("/proc/self/statm").read_text().split()[0])
            _limit(resource.RLIMIT_AS, pages * resource.getpagesize() + room_bytes)
        _limit(resource.RLIMIT_CORE, 0)
        serves(MessageSocket(end))
        code = 0
    except BaseException:  # noqa: BLE001  the child must exit here
        pass
    finally:
        os._exit(code)


def _limit(what: int, most: int) -> None:
    """Lower a resource limit of this process, unless it is lower already."""
    _, hard = resource.getrlimit(what)
    least = most if hard == resource.RLIM_INFINITY else min(most, hard)
    resource.setrlimit(what, (least, least))
