"""Standard output and error of the command line: what cannot be written ends the program in one line, or in silence."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

from cosim.core.errors import BROKEN_MACHINE, UNREAD


class Unwritable(Exception):
    """A stream took no more. No OSError, so that nobody on the way takes it for one of a file."""

    def __init__(self, stream: Stream, reason: OSError) -> None:
        super().__init__(str(reason))
        self.stream, self.reason = stream, reason


class Stream:
    """A text stream that raises Unwritable, and shows as an escape what its encoding does not have."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream
        if getattr(stream, "errors", "") == "strict":
            stream.reconfigure(errors="backslashreplace")

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        try:
            return int(self._stream.write(text))
        except OSError as error:
            raise Unwritable(self, error) from None

    def flush(self) -> None:
        try:
            self._stream.flush()
        except OSError as error:
            raise Unwritable(self, error) from None

    def let_go(self) -> None:
        """Let what is still to be written go nowhere: the interpreter would complain of it when it ends."""
        with suppress(OSError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._stream.fileno())
            os.close(nowhere)


@contextmanager
def told_streams() -> Iterator[None]:
    """Run a program whose output may find no room (one line, exit code 3) or no reader (silence, UNREAD)."""
    before = sys.stdout, sys.stderr
    out, err = (Stream(stream) if stream is not None else None for stream in before)
    sys.stdout, sys.stderr = out, err
    try:
        try:
            yield
        finally:
            if out is not None:
                out.flush()
    except Unwritable as lost:
        lost.stream.let_go()
        if isinstance(lost.reason, BrokenPipeError):
            raise SystemExit(UNREAD) from None
        with suppress(Unwritable):
            print(f"error: standard output cannot be written: {lost.reason.strerror}", file=err, flush=True)
        if err is not None:
            err.let_go()
        raise SystemExit(BROKEN_MACHINE) from None
    finally:
        sys.stdout, sys.stderr = before
