"""Figures of measurements, which are taken in fresh processes."""

from __future__ import annotations

import multiprocessing
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

import msgspec

from cosim.core.child_process import exit_in_words
from cosim.core.errors import EngineError, UsageError

LESS: Final = "<="
MORE: Final = ">="
ROOT: Final = Path(__file__).resolve().parents[3]
"""This checkout."""


class Figure(msgspec.Struct, frozen=True):
    """One figure of one round.

    limit: the same by the engine alone, where it exists
    limit_is: description of the limit
    reach: target on a quiet machine of two cores; with `reach_ratio`, target of the ratio to
        the limit on any machine
    """

    name: str
    value: float
    limit: float | None = None
    limit_is: str = ""
    reach: float | None = None
    better: str = LESS
    reach_ratio: bool = False

    @property
    def ratio(self) -> float | None:
        """Return the figure divided by its limit."""
        return None if self.limit is None else self.value / self.limit


class PartTimes(defaultdict[str, float]):
    """Seconds of each part, measured by a clock."""

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        super().__init__(float)
        self._clock = clock

    def timed(self, part: str, work: Callable[..., Any]) -> Callable[..., Any]:
        """Return `work` with its time added to `part`."""

        def run(*args: Any, **named: Any) -> Any:
            began = self._clock()
            try:
                return work(*args, **named)
            finally:
                self[part] += self._clock() - began

        return run


class TimedEngine:
    """An engine behind its port, with a stopwatch on one method."""

    def __init__(self, engine: object, method: str, part: str, spent: PartTimes) -> None:
        self._engine = engine
        self._methods = {method: spent.timed(part, getattr(engine, method))}

    def __getattr__(self, name: str) -> Any:
        return self._methods.get(name) or getattr(self._engine, name)


def measuring_module(checkout: Path) -> str:
    """Return the module of a checkout that takes measurements; older checkouts have another.

    Raises UsageError for a folder without one.
    """
    for package in ("scenarios.tools.bench", "scenarios.bench"):
        if (checkout / package.replace(".", "/") / "take.py").is_file():
            return f"{package}.take"
    raise UsageError(
        f"{checkout} cannot be compared: it holds no cosim with scenarios/tools/bench/take.py"
    )


def taken(name: str, checkout: Path = ROOT) -> list[Figure]:
    """Take a measurement of a checkout, in a fresh process.

    The process uses the virtual environment of the checkout, if it has one.

    Raises UsageError for a folder that has no such measurements, EngineError when its process
    fails.
    """
    python = checkout / ".venv" / "bin" / "python"
    with tempfile.TemporaryDirectory() as folder:
        found = Path(folder) / "figures.json"
        command = [
            str(python) if python.exists() else sys.executable,
            "-m",
            measuring_module(checkout),
            name,
        ]
        done = subprocess.run(
            [*command, repr(time.monotonic()), str(found)],
            cwd=checkout,
            env=os.environ | {"PYTHONPATH": str(checkout)},
            capture_output=True,
            text=True,
            check=False,
        )
        if found.exists():
            return msgspec.json.decode(found.read_bytes(), type=list[Figure])
    last = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
    raise EngineError(f"measurement '{name}' failed in {checkout}: {last}")


def spread(values: Sequence[float]) -> tuple[str, str]:
    """Return (median, "low to high") of a figure for a table."""
    digits = 0 if statistics.median(values) >= 100 else 2
    return (
        f"{statistics.median(values):.{digits}f}",
        f"{min(values):.{digits}f} to {max(values):.{digits}f}",
    )


def alone(work: Callable[[Any], Any], size: float) -> Any:
    """Run `work(size)` in a fresh process.

    Raises its exceptions, and EngineError when its process dies.
    """
    context = multiprocessing.get_context("spawn")
    mine, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_into, args=(theirs, work, size), daemon=True)
    process.start()
    theirs.close()
    try:
        found = mine.recv()
    except EOFError:
        process.join()
        how = exit_in_words(process.exitcode or 0)
        raise EngineError(f"the process that draws or measures it {how}") from None
    finally:
        process.kill()
        process.join()
    if isinstance(found, Exception):
        raise found
    return found


def _into(pipe: Connection, work: Callable[[Any], Any], size: float) -> None:
    """Send the result or the exception of `work(size)`."""
    try:
        found = work(size)
    except Exception as error:  # noqa: BLE001  the parent raises it again
        found = error
    pipe.send(found)
