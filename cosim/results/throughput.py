"""Throughput of a run: figures.json of its folder, one entry per session."""

from __future__ import annotations

import statistics
import time
from collections.abc import Collection, Iterable, Mapping
from datetime import UTC, datetime
from pathlib import Path

import msgspec

from cosim.core.clock import Clock
from cosim.core.errors import unwritable
from cosim.core.files import write_atomic
from cosim.core.log_event import log_event
from cosim.core.units import milliseconds
from cosim.results.record import Record
from cosim.results.run_folder import read_records

_FILE = "figures.json"


class Throughput(msgspec.Struct, frozen=True, kw_only=True):
    """Throughput of one session of a run.

    began: UTC
    wall_s: wall time of the session
    simulated_s: simulated time of all episodes
    setup_s, driving_s: process time before and after the first observation
    retried: number of attempts repeated
    given_up: number of scenarios given up after the last attempt
    answer_ms: median over episodes of the median answer time of the policy; None if unknown
    """

    began: str
    wall_s: float
    episodes: int
    simulated_s: float
    episodes_per_hour: float
    times_real: float
    setup_s: float
    driving_s: float
    retried: int
    given_up: int
    answer_ms: float | None = None

    @property
    def in_words(self) -> str:
        """Figures in one line."""
        busy_s = self.setup_s + self.driving_s
        setup = f", {100.0 * self.setup_s / busy_s:.0f} % of it setting up" if busy_s else ""
        return (
            f"{self.episodes} episodes in {self.wall_s:.0f} s: {self.episodes_per_hour:,.0f} an "
            f"hour, {self.times_real:.1f} x real time; processes were busy for {busy_s:.0f} "
            f"s{setup}; {self.retried} retried, {self.given_up} given up"
            + (
                ""
                if self.answer_ms is None
                else f"; the median answer took {milliseconds(self.answer_ms)}"
            )
        )


class ThroughputTimer:
    """Session of a run that starts now.

    todo: scenarios to run
    counts: number of events by log name
    figures: throughput, once the session has ended with at least one episode
    """

    def __init__(self, folder: Path, todo: Collection[str], counts: Mapping[str, int]) -> None:
        self._folder = folder
        self._todo = frozenset(todo)
        self._counts = counts
        self._began = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
        self._began_s = time.monotonic()
        self.figures: Throughput | None = None

    def end(self) -> None:
        """Compute and store the figures. Raises MachineError."""
        ended = [
            record for record in read_records(self._folder) if record.scenario.id in self._todo
        ]
        log_event("run over", episodes=len(ended), of=len(self._todo), folder=str(self._folder))
        if ended:
            wall_s = max(time.monotonic() - self._began_s, 1e-3)
            self.figures = _figures_of(ended, self._began, wall_s, self._counts)
            append_throughput(self._folder, self.figures)


def _figures_of(
    records: Collection[Record], began: str, wall_s: float, counts: Mapping[str, int]
) -> Throughput:
    """Compute the figures of the episodes that ended in one session."""
    simulated_s = sum(Clock().time_s(record.ticks) for record in records)
    setup_s = sum(record.clock.get("setup_s", 0.0) for record in records)
    return Throughput(
        began=began,
        wall_s=wall_s,
        episodes=len(records),
        simulated_s=simulated_s,
        episodes_per_hour=3600.0 * len(records) / wall_s,
        times_real=simulated_s / wall_s,
        setup_s=setup_s,
        driving_s=sum(record.clock.get("wall_s", 0.0) for record in records) - setup_s,
        retried=counts.get("retried", 0),
        given_up=counts.get("given up", 0),
        answer_ms=median_answer_ms(records),
    )


def median_answer_ms(records: Iterable[Record]) -> float | None:
    """Return the median over episodes of the median answer time; None if unknown."""
    medians = [record.clock["answer_ms"] for record in records if "answer_ms" in record.clock]
    return statistics.median(medians) if medians else None


def append_throughput(folder: Path, figures: Throughput) -> None:
    """Append an entry to figures.json; replace an unreadable file. Raises MachineError."""
    path = folder / _FILE
    try:
        before = msgspec.json.decode(path.read_bytes(), type=list[Throughput])
    except (OSError, msgspec.DecodeError):
        before = []
    try:
        write_atomic(
            path, msgspec.json.format(msgspec.json.encode([*before, figures]), indent=1) + b"\n"
        )
    except OSError as error:
        raise unwritable(path, error) from error
