"""Recompute every metric of a run from its trajectories and compare with the recorded values.

No engine is started: only record, scenario and trajectory are read. Any difference to record.json,
results.sqlite and results.csv is reported, down to the last bit.
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
from cosim.results.metrics import COUNTERFACTUAL, METRICS, EpisodeFacts, compute_metrics
from cosim.results.record import Record
from cosim.results.rejudge import contradictions
from cosim.results.run_folder import load_log
from cosim.results.table import table_of
from cosim.results.validity import why_bypassed, why_invalid
from cosim.results.verified_run import VerifiedRun, read_verified_run
from cosim.spec.scenario import Scenario

_TABLE = "results.csv"


class Difference(NamedTuple):
    """Value that differs from the recomputed one.

    file: file of the run with the recorded value
    computed: value that follows from the trajectory
    """

    file: str
    episode: str
    metric: str
    recorded: str
    computed: str


class ScoreResult(NamedTuple):
    """Result of recomputing a run.

    episodes, without_trajectory: number of ended episodes with and without a trajectory
    untested: measures that cannot be computed from a trajectory
    table: whether results.csv was compared
    """

    episodes: int
    without_trajectory: int
    scheduled: int
    untested: tuple[str, ...]
    table: bool
    differences: tuple[Difference, ...]


def score_run(path: Path, progress: Progress = ignore) -> ScoreResult:
    """Recompute every metric of a run.

    Raises what `read_verified_run` raises, and RunError for a missing or damaged trajectory.
    """
    run = read_verified_run(path)
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
    return ScoreResult(
        driven, len(computed) - driven, len(run.spec.scenarios), untested, has_table, tuple(found)
    )


def _scored(
    run: VerifiedRun, scenario: Scenario, record: Record
) -> tuple[Record, list[Difference]]:
    """Return the recomputed record of an episode and its differences."""
    measures: dict[str, float | None] = {}
    found: list[tuple[str, object, object]] = []
    if record.ended is not None:
        log = load_log(run.path, record.scenario.id)
        found = [
            (what, recorded, shown)
            for what, recorded, shown in contradictions(record, scenario, log)
        ]
        if not found:
            measures = compute_metrics(EpisodeFacts.of(record, scenario, log))
            measures |= {
                name: value for name, value in record.measures.items() if name in COUNTERFACTUAL
            }
            invalid = why_invalid(record, scenario)
            reason = invalid or why_bypassed(record, scenario)
            status = "invalid" if invalid else "done"
            if record.status != status:
                found = [("status", record.status, status)]
            elif record.reason != reason:
                found = [("reason", record.reason, reason)]
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


def _cells_that_differ(file: Path, computed: list[Record]) -> Iterator[Difference]:
    """Yield the cells in which results.csv differs from the recomputed table, as text."""
    expected_text = table_of(computed).to_csv(index=False)
    recorded_text = file.read_bytes().decode(errors="replace")
    if recorded_text == expected_text:
        return
    expected = _rows_of(expected_text)
    try:
        recorded = _rows_of(recorded_text)
    except csv.Error:
        recorded = {}
    if not recorded.keys() <= expected.keys() or not recorded:
        raise RunError(
            f"{file}: not the table of this run: remove it, and give the command of the run "
            f"with --resume"
        )
    columns = next(iter(recorded.values()))
    for name, row in expected.items():
        recorded_row = recorded.get(name, {})
        # All metrics; other columns only if the run's version wrote them.
        for column, value in row.items():
            if (column in METRICS or column in columns) and recorded_row.get(column) != value:
                yield Difference(
                    file.name,
                    name,
                    column,
                    recorded_row.get(column) or "nothing",
                    value or "nothing",
                )


def _rows_of(table: str) -> dict[str, dict[str, str]]:
    """Return the rows of a CSV table by scenario."""
    return {row["scenario"]: row for row in csv.DictReader(io.StringIO(table)) if "scenario" in row}
