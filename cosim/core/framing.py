"""Wire: whole messages over a socket between two processes of a machine."""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Iterator
from contextlib import suppress
from typing import Final

_LENGTH: Final = struct.Struct("!I")
_CHUNK_BYTES: Final = 1 << 16
"""Taken at a time: of more a process asks the kernel for memory each time, which takes longer than
most messages."""
MOST_WIRED_BYTES: Final = 1 << 30
"""A message that says it is longer is none: a policy has written to its process's socket."""


class Wire:
    """One end. Each message has its length before it, and is refused if that is more than
    most_bytes.

    Nothing here waits for the rest of a message unless it is told to: who sends one may be stopped
    in the middle of it.
    """

    def __init__(self, end: socket.socket, most_bytes: int = MOST_WIRED_BYTES) -> None:
        self._end = end
        self._held = bytearray()
        self._unsent = bytearray()
        self._most_bytes = most_bytes

    def fileno(self) -> int:
        return self._end.fileno()

    def send(self, message: bytes) -> None:
        """Send a message; waits for room. Raises OSError when the other end is gone."""
        self._end.settimeout(None)
        self._end.sendall(_LENGTH.pack(len(message)) + message)

    def post(self, message: bytes) -> None:
        """Send a message without waiting: what there is no room for goes with `flush`. Raises
        OSError likewise."""
        self._unsent += _LENGTH.pack(len(message)) + message
        self.flush()

    def flush(self) -> None:
        """Send of what was posted as much as there is room for."""
        self._end.setblocking(False)
        with suppress(BlockingIOError):
            while self._unsent:
                del self._unsent[: self._end.send(self._unsent)]

    def receive(self, within_s: float | None = None) -> bytes:
        """The next message, waited for. Raises EOFError when none will come, TimeoutError when it
        takes too long."""
        until_s = None if within_s is None else time.monotonic() + within_s
        while (message := self._next()) is None:
            self._end.settimeout(None if until_s is None else max(until_s - time.monotonic(), 1e-3))
            self._take()
        return message

    def received(self) -> Iterator[bytes]:
        """The messages that have come. Raises EOFError, after the last of them, when no more
        will."""
        self._end.setblocking(False)
        try:
            while True:
                while (message := self._next()) is not None:
                    yield message
                self._take()
        except BlockingIOError:
            return

    def close(self) -> None:
        self._end.close()

    def _take(self) -> None:
        try:
            chunk = self._end.recv(_CHUNK_BYTES)
        except ConnectionResetError:
            chunk = b""
        if not chunk:
            raise EOFError
        self._held += chunk

    def _next(self) -> bytes | None:
        if len(self._held) < _LENGTH.size:
            return None
        end = _LENGTH.size + int(_LENGTH.unpack_from(self._held)[0])
        if end > self._most_bytes:
            raise EOFError
        if len(self._held) < end:
            return None
        message = bytes(self._held[_LENGTH.size : end])
        del self._held[:end]
        return message
