"""Children of this process: one that is forked and answers within bounds, and what ends with its
parent."""

from __future__ import annotations

import ctypes
import os
import resource
import signal
import socket
import time
from collections.abc import Callable
from pathlib import Path

from cosim.core.framing import Wire

_PR_SET_PDEATHSIG = 1
_ENDING_S = 5.0
_LOOK_S = 0.001


def end_with(parent: int, how: signal.Signals = signal.SIGKILL) -> None:
    """Ask Linux to signal this process when its parent dies, however that happens; end if it is
    dead already."""
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, how)
    if os.getppid() != parent:
        os._exit(1)


def ended_in_words(code: int) -> str:
    """How a process with this exit code has ended: "was killed by SIGSEGV"."""
    return (
        f"was killed by {signal.Signals(-code).name}"
        if code < 0
        else f"ended with exit code {code}"
    )


class ForkedChild:
    """A child that answers over its end of a wire. It prints nothing, and ends with this process or
    when it is closed.

    serves: what the child does with its end; it has what this process has loaded, but no thread of
    it. room_bytes: so much more memory than this process it may ask for. wire: this process's end.
    """

    def __init__(self, serves: Callable[[Wire], None], room_bytes: int) -> None:
        ours, theirs = socket.socketpair()
        parent = os.getpid()
        self._pid = os.fork()
        if self._pid == 0:
            ours.close()
            _be_child(serves, theirs, parent, room_bytes)
        theirs.close()
        self.wire = Wire(ours)

    def close(self) -> None:
        """End it, whatever it does."""
        self.wire.close()
        if self._pid:
            os.kill(self._pid, signal.SIGKILL)
            self.ended()

    def ended(self) -> str:
        """How it ended, after its end of the wire has closed; killed if it does not end by
        itself."""
        pid = self._pid
        self._pid = 0
        until_s = time.monotonic() + _ENDING_S
        try:
            while True:
                ended, status = os.waitpid(pid, os.WNOHANG)
                if ended:
                    return ended_in_words(os.waitstatus_to_exitcode(status))
                if time.monotonic() > until_s:
                    os.kill(pid, signal.SIGKILL)
                time.sleep(_LOOK_S)
        except ChildProcessError:  # another part of this process has waited for all of its children
            return "has ended"


def _be_child(
    serves: Callable[[Wire], None], end: socket.socket, parent: int, room_bytes: int
) -> None:
    """What the forked child does until it ends."""
    code = 1
    try:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        end_with(parent)
        nowhere = os.open(os.devnull, os.O_RDWR)
        for descriptor in range(3):
            os.dup2(nowhere, descriptor)
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        most = pages * resource.getpagesize() + room_bytes
        _limit(resource.RLIMIT_AS, most)
        _limit(resource.RLIMIT_CORE, 0)
        serves(Wire(end))
        code = 0
    except BaseException:  # noqa: BLE001  nothing of it goes on in this process
        pass
    finally:
        os._exit(code)


def _limit(what: int, most: int) -> None:
    """Lower a limit of this process, unless it is lower already."""
    _, hard = resource.getrlimit(what)
    least = most if hard == resource.RLIM_INFINITY else min(most, hard)
    resource.setrlimit(what, (least, least))
