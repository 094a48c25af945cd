"""Supervisor of one worker process, which leaves no process behind when it ends.

run -> supervisor -> worker -> processes of the policy

The supervisor forks the worker, writes its output to a log, and ends with the worker's exit code or
signal. First it kills the processes that the worker has left: orphans become children of the
supervisor, also those in a session of their own. It does the same on SIGTERM from the run, or when
the run dies. Supervisors that the worker has started for isolated policies end by SIGTERM, and have
a moment for the end of their logs.

A worker that a signal has stopped is continued after a moment.

It imports little but the standard library, and forks before it starts a thread.
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
from socket import socket
from types import FrameType
from typing import Any

from cosim.core.child_process import exit_with_parent

PR_SET_CHILD_SUBREAPER = 36
"""Option of `prctl` by which orphans become children of this process."""
FIRST_BYTES = LAST_BYTES = 2 << 20
"""Bytes of a worker's output that are logged from its beginning and from its end."""
CHUNK_BYTES = 1 << 16
"""Bytes of output that are read at a time."""
KILLING_S = 10.0
"""Timeout in seconds for the end of killed processes, which the kernel may delay."""
NESTED_END_S = 3.0
"""Seconds that a nested supervisor has to end its processes before it is killed."""
STOPPED_S = 2.0
"""Seconds after which a worker that a signal has stopped is continued."""
PR_SET_NAME = 15
"""Option of `prctl` that sets the name of this process in /proc."""
_NAME = "cosim-keeper"
"""Name of supervisors."""


def supervise_worker(
    entry_point: str,
    descriptors: tuple[int, ...],
    parent: int,
    sandbox: tuple[Any, ...] | None = None,
) -> None:
    """Run one worker, and end with its exit code or signal.

    Its output goes to this process's standard output.

    entry_point: function that the worker runs, as module:name.
    descriptors: its arguments, first the socket to the run.
    parent: process id of the run.
    sandbox: values of the `Sandbox` in which it runs, if any.
    """
    exit_with_parent(parent, signal.SIGTERM)
    ctypes.CDLL(None, use_errno=True).prctl(PR_SET_CHILD_SUBREAPER, 1)
    ctypes.CDLL(None, use_errno=True).prctl(PR_SET_NAME, _NAME.encode())
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    output_reader, output_writer = os.pipe()
    supervisor = os.getpid()
    worker_sandbox = None if sandbox is None else _WorkerSandbox(sandbox)
    pid = os.fork()
    if pid == 0:
        os.close(output_reader)
        _begin_worker(output_writer, supervisor)
        if worker_sandbox is not None:
            _end_as(worker_sandbox.run(entry_point, descriptors))
        module, _, function = entry_point.partition(":")
        getattr(importlib.import_module(module), function)(*descriptors)
        return
    for descriptor in (*descriptors, output_writer):
        os.close(descriptor)
    log = threading.Thread(target=_copy, args=(output_reader, BoundedLog(1)), daemon=True)
    log.start()
    status = int(signal.SIGTERM)
    with suppress(_Ended):
        signal.signal(signal.SIGTERM, _ended)
        status = _status_of(pid)
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
    kill_children()
    log.join(KILLING_S)
    if worker_sandbox is not None:
        worker_sandbox.close()
    _end_as(status)


class BoundedLog:
    """Log of bounded size that contains the first and the last bytes of a text.

    The last bytes are written when it is closed.
    """

    def __init__(self, descriptor: int, first: int = FIRST_BYTES, last: int = LAST_BYTES) -> None:
        self._descriptor = descriptor
        self._first_left = first
        self._last = last
        self._tail: deque[bytes] = deque()
        self._tail_bytes = self._dropped = 0

    def write(self, text: bytes) -> None:
        if self._first_left > 0:
            self._put(text[: self._first_left])
            text, self._first_left = text[self._first_left :], self._first_left - len(text)
        if text:
            self._tail.append(text)
            self._tail_bytes += len(text)
            while self._tail_bytes - len(self._tail[0]) >= self._last:
                self._tail_bytes -= len(self._tail[0])
                self._dropped += len(self._tail.popleft())

    def close(self) -> None:
        if self._dropped:
            self._put(f"\n[{self._dropped} bytes were printed here and left out]\n".encode())
        self._put(b"".join(self._tail))

    def _put(self, text: bytes) -> None:
        with suppress(OSError):  # the run reports a full disk
            while text:
                text = text[os.write(self._descriptor, text) :]


def kill_children() -> None:
    """Kill all descendants of this process, which become its children as their parents die.

    Nested supervisors are requested to end first, and killed after NESTED_END_S. A process that
    takes their name gains no more than that.
    """
    began = time.monotonic()
    requested: set[int] = set()
    while (passed := time.monotonic() - began) < KILLING_S:
        for child, name in _children():
            if name != _NAME or passed > NESTED_END_S:
                _send(child, signal.SIGKILL)
            elif child not in requested:
                requested.add(child)
                _send(child, signal.SIGTERM, signal.SIGCONT)
        try:
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
        except ChildProcessError:
            return
        time.sleep(0.002)


def _send(pid: int, *signals: signal.Signals) -> None:
    with suppress(ProcessLookupError):
        for number in signals:
            os.kill(pid, number)


def _children() -> list[tuple[int, str]]:
    """Return the process ids and names of the children of this process."""
    found = []
    me = str(os.getpid())
    for name in os.listdir("/proc"):  # noqa: PTH208  faster than Path.iterdir
        if name.isdigit():
            with suppress(OSError):
                stat = Path("/proc", name, "stat").read_text(errors="replace")
                called, _, after_name = stat.partition("(")[2].rpartition(")")
                if after_name.split()[1] == me:
                    found.append((int(name), called))
    return found


class _Ended(Exception):
    """The run has ended, or has sent SIGTERM."""


def _ended(number: int, frame: FrameType | None) -> None:
    signal.signal(number, signal.SIG_IGN)  # another SIGTERM may follow at once
    raise _Ended


class _WorkerSandbox:
    """Sandbox of a worker, and its folder outside."""

    def __init__(self, values: tuple[Any, ...]) -> None:
        # Imported only where needed: most workers have no sandbox.
        from scenarios.ipc.sandbox import Sandbox, work_folder

        self._sandbox = Sandbox(*values)
        self._folder = work_folder(self._sandbox)

    def run(self, entry_point: str, descriptors: tuple[int, ...]) -> int:
        """Run the worker inside; return its wait status."""
        from scenarios.ipc.sandbox import start

        return start(self._sandbox, entry_point, descriptors, self._folder, _refuse)

    def close(self) -> None:
        """Remove the folder."""
        from scenarios.ipc.sandbox import remove_work_folder

        remove_work_folder(self._folder)


def _refuse(connection: socket, why: str) -> None:
    """Report that a sandbox cannot be set up, as the worker's first message."""
    from bridge.policy_server import Refusal, encode_message
    from cosim.core.framing import MessageSocket

    with suppress(OSError):
        MessageSocket(connection).send(encode_message(Refusal("sandbox", why)))


def _begin_worker(output_writer: int, supervisor: int) -> None:
    """Begin the worker in the forked child: its session, its end and its output."""
    os.setsid()
    exit_with_parent(supervisor)
    ctypes.CDLL(None, use_errno=True).prctl(PR_SET_NAME, b"cosim-worker")
    os.dup2(output_writer, 1)
    os.dup2(output_writer, 2)
    os.close(output_writer)
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]


def _status_of(pid: int) -> int:
    """Wait for the worker, and reap other children; return its wait status.

    The worker is continued STOPPED_S after a signal has stopped it.
    """
    while True:
        ended, status = os.waitpid(-1, os.WUNTRACED)
        if os.WIFSTOPPED(status):
            waits = threading.Timer(STOPPED_S, _send, (ended, signal.SIGCONT))
            waits.daemon = True
            waits.start()
        elif ended == pid:
            return status


def _copy(output_reader: int, log: BoundedLog) -> None:
    """Copy a pipe to a log until it is closed."""
    while text := os.read(output_reader, CHUNK_BYTES):
        log.write(text)
    log.close()


def _end_as(status: int) -> None:
    """End with the exit code or signal of a wait status, without a core dump."""
    if os.WIFSIGNALED(status):
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        with suppress(OSError):  # SIGKILL has no handler
            signal.signal(os.WTERMSIG(status), signal.SIG_DFL)
        os.kill(os.getpid(), os.WTERMSIG(status))
    os._exit(os.waitstatus_to_exitcode(status))
