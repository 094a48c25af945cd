"""Length-prefixed messages over a socket between two processes of one machine."""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Iterator
from contextlib import suppress
from typing import Final

_LENGTH: Final = struct.Struct("!I")
_CHUNK_BYTES: Final = 1 << 16
"""Bytes read at a time. Larger buffers make the kernel allocate memory for each read, which is
slower."""
MAX_MESSAGE_BYTES: Final = 1 << 30
"""Maximum length of a message in bytes. A longer one means that a policy wrote to its process's
socket."""


class MessageSocket:
    """One end of a message socket. Messages longer than `max_bytes` are refused.

    Only `send` and `receive` wait: the sender of a message may be stopped in the middle of it.
    """

    def __init__(self, end: socket.socket, max_bytes: int = MAX_MESSAGE_BYTES) -> None:
        self._end = end
        self._incoming = bytearray()
        self._outgoing = bytearray()
        self._max_bytes = max_bytes

    def fileno(self) -> int:
        return self._end.fileno()

    def send(self, message: bytes) -> None:
        """Send a message; wait for space in the buffer. Raises OSError when the other end is
        closed."""
        self._end.settimeout(None)
        self._end.sendall(_LENGTH.pack(len(message)) + message)

    def post(self, message: bytes) -> None:
        """Send a message without waiting; `flush` sends the rest. Raises OSError as `send` does."""
        self._outgoing += _LENGTH.pack(len(message)) + message
        self.flush()

    def flush(self) -> None:
        """Send as much of the posted messages as the buffer takes."""
        self._end.setblocking(False)
        with suppress(BlockingIOError):
            while self._outgoing:
                del self._outgoing[: self._end.send(self._outgoing)]

    def receive(self, within_s: float | None = None) -> bytes:
        """Wait for the next message and return it.

        Raises EOFError when the other end is closed, TimeoutError after `within_s` seconds.
        """
        until_s = None if within_s is None else time.monotonic() + within_s
        while (message := self._next_message()) is None:
            self._end.settimeout(None if until_s is None else max(until_s - time.monotonic(), 1e-3))
            self._read_chunk()
        return message

    def received(self) -> Iterator[bytes]:
        """Yield the messages that have arrived. Raises EOFError after the last one if the other end
        is closed."""
        self._end.setblocking(False)
        try:
            while True:
                while (message := self._next_message()) is not None:
                    yield message
                self._read_chunk()
        except BlockingIOError:
            return

    def close(self) -> None:
        self._end.close()

    def _read_chunk(self) -> None:
        try:
            chunk = self._end.recv(_CHUNK_BYTES)
        except ConnectionResetError:
            chunk = b""
        if not chunk:
            raise EOFError
        self._incoming += chunk

    def _next_message(self) -> bytes | None:
        if len(self._incoming) < _LENGTH.size:
            return None
        end = _LENGTH.size + int(_LENGTH.unpack_from(self._incoming)[0])
        if end > self._max_bytes:
            raise EOFError
        if len(self._incoming) < end:
            return None
        message = bytes(self._incoming[_LENGTH.size : end])
        del self._incoming[:end]
        return message
