"""Stands between a run and one environment process, so that nothing of it is left when it ends.

run -> shepherd -> worker -> whatever the policy starts

The shepherd forks the worker, writes what it prints to its log, and ends as the worker ended: with
its exit code or by its signal. First it kills what the worker has left behind: children whose
parent is dead become the shepherd's, also those that made a session of their own. It does the same
when the run tells it to end (SIGTERM) or dies.

It imports little but the standard library: it is small, and forks before there is a thread.
"""

from __future__ import annotations

import ctypes
import importlib
import os
import resource
import signal
import sys
import threading
import time
from collections import deque
from contextlib import suppress
from pathlib import Path
from types import FrameType

from cosim.core.child_process import end_with

PR_SET_CHILD_SUBREAPER = 36
FIRST_BYTES = LAST_BYTES = 2 << 20
"""Of what a worker prints the beginning and the end are kept; what a policy pours out in between is
left out."""
CHUNK_BYTES = 1 << 16
KILLING_S = 10.0
"""A killed process is gone at once, unless the kernel holds it."""


def keep_worker(serves: str, descriptors: tuple[int, ...], parent: int) -> None:
    """Run one worker and end as it ended.

    serves: the function that is the worker, as module:name; descriptors: what it is called with, of
    its socket to the run first. parent: process id of the run. What the worker prints goes to this
    process's standard output."""
    end_with(parent, signal.SIGTERM)
    ctypes.CDLL(None, use_errno=True).prctl(PR_SET_CHILD_SUBREAPER, 1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    printed, prints = os.pipe()
    shepherd = os.getpid()
    pid = os.fork()
    if pid == 0:
        os.close(printed)
        _be_worker(serves, descriptors, prints, shepherd)
        return
    for descriptor in (*descriptors, prints):
        os.close(descriptor)
    log = threading.Thread(target=_keep, args=(printed, BoundedLog(1)), daemon=True)
    log.start()
    status = 0
    with suppress(_Ended):
        signal.signal(signal.SIGTERM, _ended)
        status = _status_of(pid)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    kill_children()
    log.join(KILLING_S)
    _end_as(status)


class BoundedLog:
    """A file that takes any amount of text: its first and last bytes are kept. The last ones are
    written at the end."""

    def __init__(self, descriptor: int, first: int = FIRST_BYTES, last: int = LAST_BYTES) -> None:
        self._descriptor = descriptor
        self._room = first
        self._last = last
        self._tail: deque[bytes] = deque()
        self._held = self._dropped = 0

    def write(self, text: bytes) -> None:
        if self._room > 0:
            self._put(text[: self._room])
            text, self._room = text[self._room :], self._room - len(text)
        if text:
            self._tail.append(text)
            self._held += len(text)
            while self._held - len(self._tail[0]) >= self._last:
                self._held -= len(self._tail[0])
                self._dropped += len(self._tail.popleft())

    def close(self) -> None:
        if self._dropped:
            self._put(f"\n[{self._dropped} bytes were printed here and left out]\n".encode())
        self._put(b"".join(self._tail))

    def _put(self, text: bytes) -> None:
        with suppress(OSError):  # a full disk: the worker's own report tells it
            while text:
                text = text[os.write(self._descriptor, text) :]


def kill_children() -> None:
    """Kill all children of this process, and theirs, which become this process's as their parents
    die."""
    deadline = time.monotonic() + KILLING_S
    while time.monotonic() < deadline:
        for child in _children():
            with suppress(ProcessLookupError):
                os.kill(child, signal.SIGKILL)
        try:
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
        except ChildProcessError:
            return
        time.sleep(0.002)


def _children() -> list[int]:
    """Process ids of the children of this process."""
    found = []
    me = str(os.getpid())
    for name in os.listdir("/proc"):  # noqa: PTH208  this much faster, and it is only names
        if name.isdigit():
            with suppress(OSError):
                after_name = (
                    Path("/proc", name, "stat").read_text(errors="replace").rpartition(")")[2]
                )
                if after_name.split()[1] == me:
                    found.append(int(name))
    return found


class _Ended(Exception):
    """The run is gone, or wants this to end."""


def _ended(number: int, frame: FrameType | None) -> None:
    raise _Ended


def _be_worker(serves: str, descriptors: tuple[int, ...], prints: int, shepherd: int) -> None:
    """What the forked child does, until its pipe is closed."""
    os.setsid()
    end_with(shepherd)
    os.dup2(prints, 1)
    os.dup2(prints, 2)
    os.close(prints)
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    module, _, function = serves.partition(":")
    getattr(importlib.import_module(module), function)(*descriptors)


def _status_of(pid: int) -> int:
    """Wait for the worker; others that end meanwhile are let go."""
    while True:
        ended, status = os.wait()
        if ended == pid:
            return status


def _keep(printed: int, log: BoundedLog) -> None:
    """Everything that comes out of a pipe goes to a log."""
    while text := os.read(printed, CHUNK_BYTES):
        log.write(text)
    log.close()


def _end_as(status: int) -> None:
    """End like a process with this wait status, without a core dump."""
    if os.WIFSIGNALED(status):
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        with suppress(OSError):  # of SIGKILL nothing can be changed
            signal.signal(os.WTERMSIG(status), signal.SIG_DFL)
        os.kill(os.getpid(), os.WTERMSIG(status))
    os._exit(os.waitstatus_to_exitcode(status))
