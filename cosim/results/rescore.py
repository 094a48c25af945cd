"""Score a run: every metric computed again from the recorded trajectories, and held against what
the run recorded.

No engine is started. Of an episode its record, its scenario and its trajectory are read; where what
follows from these is not, to the last bit, what record.json, results.sqlite and results.csv hold,
it is told.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import msgspec

from cosim.core.errors import RunError
from cosim.core.progress import Progress, ignore
from cosim.results.event_monitor import why_invalid
from cosim.results.finished_run import WholeRun, read_whole_run
from cosim.results.log import Log
from cosim.results.metrics import COUNTERFACTUAL, METRICS, EpisodeFacts, every_metric
from cosim.results.record import Record
from cosim.results.rejudge import contradictions
from cosim.results.run_folder import RUN_AGAIN, TRAJECTORY, record_file
from cosim.results.table import table_of
from cosim.spec.scenario import Scenario

_TABLE = "results.csv"


class Difference(NamedTuple):
    """file: which of the run's differs; recorded: what it has; computed: what follows from the
    trajectory."""

    file: str
    episode: str
    metric: str
    recorded: str
    computed: str


class Scored(NamedTuple):
    """episodes, without_trajectory: that have ended; untested: measures that no trajectory can
    tell; table: whether the run is whole, and has its table."""

    episodes: int
    without_trajectory: int
    scheduled: int
    untested: tuple[str, ...]
    table: bool
    differences: tuple[Difference, ...]


def score_run(path: Path, progress: Progress = ignore) -> Scored:
    """Compute every metric of a run again. Raises what `read_whole_run` raises, and RunError for a
    trajectory that is missing or damaged."""
    run = read_whole_run(path)
    computed: list[Record] = []
    found: list[Difference] = []
    for done, (name, record) in enumerate(run.records.items()):
        progress("computing", done / len(run.records))
        again, differences = _scored(run, run.scenarios[name], record)
        computed.append(again)
        found += differences
    has_table = len(computed) == len(run.spec.scenarios) and (path / _TABLE).exists()
    if has_table:
        found += _cells_that_differ(path / _TABLE, computed)
    driven = sum(record.ended is not None for record in computed)
    untested = tuple(n for n in COUNTERFACTUAL if any(n in record.measures for record in computed))
    return Scored(
        driven, len(computed) - driven, len(run.spec.scenarios), untested, has_table, tuple(found)
    )


def _scored(run: WholeRun, scenario: Scenario, record: Record) -> tuple[Record, list[Difference]]:
    """The record of an episode as it follows from its trajectory, and where it is another."""
    measures: dict[str, float | None] = {}
    found = []
    if record.ended is not None:
        log = _trajectory(run.path, record.scenario.id)
        found = [(what, told, shown) for what, told, shown in contradictions(record, scenario, log)]
        if not found:
            measures = every_metric(EpisodeFacts.of(record, scenario, log))
            measures |= {
                name: value for name, value in record.measures.items() if name in COUNTERFACTUAL
            }
            status = "invalid" if why_invalid(record, scenario) else "done"
            found = [("status", record.status, status)] if record.status != status else []
    found = found or [
        (name, record.measures.get(name), measures.get(name))
        for name in dict.fromkeys([*measures, *record.measures])
        if repr(record.measures.get(name)) != repr(measures.get(name))
    ]
    differences = [
        Difference("record.json", record.scenario.id, what, repr(a), repr(b))
        for what, a, b in found
    ]
    return msgspec.structs.replace(record, measures=measures), differences


def _trajectory(path: Path, scenario_id: str) -> Log:
    file = record_file(path, scenario_id).with_name(TRAJECTORY)
    try:
        return Log.load(file)
    except RunError as error:
        raise RunError(f"{error}: {RUN_AGAIN}") from error


def _cells_that_differ(file: Path, computed: list[Record]) -> Iterator[Difference]:
    """Where the table that the run has written is another; it is compared as it is written, digit
    by digit."""
    follows = table_of(computed).to_csv(index=False)
    told = file.read_bytes().decode(errors="replace")
    if told == follows:
        return
    mine = _rows_of(follows)
    try:
        theirs = _rows_of(told)
    except csv.Error:
        theirs = {}
    if not theirs.keys() <= mine.keys() or not theirs:
        raise RunError(
            f"{file}: not the table of this run: remove it, and give the command of the run "
            f"with --resume"
        )
    columns = next(iter(theirs.values()))
    for name, row in mine.items():
        other = theirs.get(name, {})
        for (
            column,
            value,
        ) in row.items():  # all metrics, and of the others those that the run's version had
            if (column in METRICS or column in columns) and other.get(column) != value:
                yield Difference(
                    file.name, name, column, other.get(column) or "nothing", value or "nothing"
                )


def _rows_of(table: str) -> dict[str, dict[str, str]]:
    """The rows of a table, by scenario."""
    return {row["scenario"]: row for row in csv.DictReader(io.StringIO(table)) if "scenario" in row}
