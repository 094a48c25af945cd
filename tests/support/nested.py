"""A worker that starts another one, which floods its output, as an isolated policy may."""

from __future__ import annotations

import os
import time
from socket import socket

from cosim.core.framing import MessageSocket
from scenarios.ipc.child_process import ChildProcess

FLOOD = b"flood\n" * 1_000_000


def starts_another(pipe: int, _call: int) -> None:
    """Wait until the other worker has flooded its output, send this process's id, and wait."""
    inner = ChildProcess(None, "tests.support.nested:floods", "policy")
    inner.wire.receive()
    MessageSocket(socket(fileno=pipe)).send(str(os.getpid()).encode())
    time.sleep(3600)


def floods(pipe: int, _call: int) -> None:
    print("the flood begins", flush=True)
    os.write(1, FLOOD)
    print("the flood ends", flush=True)
    MessageSocket(socket(fileno=pipe)).send(b"done")
    time.sleep(3600)
