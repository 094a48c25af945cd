"""Consoles, standard streams and logs of the command line."""

from __future__ import annotations

import json
import logging
import os
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, TextIO

import typer
from rich.console import Console

from cosim.core.errors import BROKEN_MACHINE, BROKEN_PIPE, unknown, unwritable
from cosim.core.log_event import LOGGER
from cosim.spec.run_config import help_of

out = Console(emoji=False)
err = Console(stderr=True, emoji=False)


def say(words: str) -> None:
    """Print a line on standard output, unwrapped and without markup."""
    out.print(words, soft_wrap=True, markup=False, highlight=False)


def notice(words: str, _share: float | None = None, /) -> None:
    """Print a line on standard error, unwrapped and without markup. Can serve as a `Progress`."""
    err.print(words, soft_wrap=True, markup=False, highlight=False)


_LEVELS = ("debug", "info", "warning", "error")
LogLevel = Annotated[str, typer.Option("--log-level", metavar="LEVEL", help=help_of("log_level"))]
LogJson = Annotated[
    Path | None, typer.Option("--log-json", metavar="FILE", help=help_of("log_json"))
]


@contextmanager
def logged(level: str, json_file: Path | None) -> Iterator[Counter[str]]:
    """Log events during the block, and yield the count of events by name.

    level: lowest level on standard error; "" for none there, and "info" in the file.
    json_file: file to append to, one JSON object per line.
    Raises UsageError, MachineError.
    """
    if level and level not in _LEVELS:
        raise unknown("log level", level, _LEVELS)
    lowest = getattr(logging, (level or "info").upper())
    counts: Counter[str] = Counter()
    with ExitStack() as stack:
        handlers: list[_Handler] = [_CountingHandler(counts)]
        if level:
            handlers.append(_TextHandler(lowest))
        if json_file is not None:
            try:
                handlers.append(
                    _JsonHandler(lowest, stack.enter_context(json_file.open("a", buffering=1)))
                )
            except OSError as error:
                raise unwritable(json_file, error) from error
        before = LOGGER.level
        LOGGER.setLevel(min(lowest, logging.INFO))
        for one in handlers:
            LOGGER.addHandler(one)
        try:
            yield counts
        finally:
            LOGGER.setLevel(before)
            for one in handlers:
                LOGGER.removeHandler(one)


class _Handler(logging.Handler):
    """Log handler that ignores write errors, because a full disk must not end an episode."""

    def handleError(self, record: logging.LogRecord) -> None:
        """Ignore the error: the run itself reports a full disk."""


class _CountingHandler(_Handler):
    def __init__(self, counts: Counter[str]) -> None:
        super().__init__(logging.DEBUG)
        self._counts = counts

    def emit(self, record: logging.LogRecord) -> None:
        self._counts[record.msg] += 1


class _TextHandler(_Handler):
    def emit(self, record: logging.LogRecord) -> None:
        facts = " ".join(f"{name}={_quoted(value)}" for name, value in _facts(record).items())
        words = f"{_time(record)} {record.levelname.lower():7} {record.msg} {facts}"
        err.print(words.rstrip(), soft_wrap=True, highlight=False, markup=False)


class _JsonHandler(_Handler):
    def __init__(self, level: int, file: TextIO) -> None:
        super().__init__(level)
        self._file = file

    def emit(self, record: logging.LogRecord) -> None:
        entry = {
            "time": _time(record),
            "level": record.levelname.lower(),
            "event": record.msg,
            **_facts(record),
        }
        try:
            self._file.write(json.dumps(entry, default=str) + "\n")
        except OSError:
            self.handleError(record)


def _facts(record: logging.LogRecord) -> dict[str, object]:
    return getattr(record, "facts", {})


def _time(record: logging.LogRecord) -> str:
    return datetime.fromtimestamp(record.created, UTC).strftime("%Y-%m-%dT%H:%M:%S.%f")[:-3] + "Z"


def _quoted(value: object) -> str:
    text = str(value)
    return json.dumps(text) if " " in text or not text else text


class Unwritable(Exception):
    """A standard stream cannot be written. Not an OSError, which would be reported as a file's."""

    def __init__(self, stream: Stream, reason: OSError) -> None:
        super().__init__(str(reason))
        self.stream = stream
        self.reason = reason


class Stream:
    """Text stream that raises Unwritable, and escapes characters that its encoding lacks."""

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

    def discard_rest(self) -> None:
        """Discard buffered output, which the interpreter would fail to write at its end."""
        with suppress(OSError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._stream.fileno())
            os.close(nowhere)


@contextmanager
def guarded_streams() -> Iterator[None]:
    """Run a block with guarded standard streams.

    Output that finds a full disk ends the program with one line and exit code 3. Output without a
    reader ends it silently with UNREAD.
    """
    before = sys.stdout, sys.stderr
    out, err = (Stream(stream) if stream is not None else None for stream in before)
    sys.stdout = out
    sys.stderr = err
    try:
        try:
            yield
        finally:
            if out is not None:
                out.flush()
    except Unwritable as lost:
        lost.stream.discard_rest()
        if isinstance(lost.reason, BrokenPipeError):
            raise SystemExit(BROKEN_PIPE) from None
        with suppress(Unwritable):
            print(
                f"error: standard output cannot be written: {lost.reason.strerror}",
                file=err,
                flush=True,
            )
        if err is not None:
            err.discard_rest()
        raise SystemExit(BROKEN_MACHINE) from None
    finally:
        sys.stdout, sys.stderr = before
