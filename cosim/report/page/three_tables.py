"""Tables of a report like the paper's three: own figures with intervals, the paper's below."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby, pairwise
from types import MappingProxyType
from typing import Final, NamedTuple, get_args

import pandas as pd

from cosim.report.page.paper import (
    EVENT_COLUMNS,
    LONG_OF_PAPER,
    REACTIVE_OF_PAPER,
    UNIT_OF_PAPER,
    Row,
)
from cosim.report.page.runs import PAPER_SUITES, PaperTable, ReportedRun
from cosim.results.discerned import (
    DISCERNED,
    DISCERNED_IN_WORDS,
    episode_pairs,
    has_decoys,
    is_decoy,
    with_discerned,
)
from cosim.results.intervals import MIN_N, NO_ESTIMATE, Estimate
from cosim.results.run_setup import gait_in_words
from cosim.results.table import ORACLE, crashed_in, estimate_of, why_inconclusive
from cosim.spec.robot import COURIER
from cosim.spec.schedule import BEST_BLIND
from cosim.spec.sensors import SensorTrack
from cosim.spec.weather import CLEAR

UNIT_COLUMNS: Final = ("straight", "curve", "crosswalk")
_SHARES: Final = {"success": "SR", "spl": "SPL", "route_completion": "RC"}
RATES: Final = {
    "failures_per_100m": "FC",
    "collisions_per_100m": "C",
    "out_of_lane_per_100m": "OL",
    "freezings_per_100m": "F",
    "falls_per_100m": "FL",
    "velocity_mean_mps": "V",
}
_FIRST: Final = {
    "success": "SR",
    "route_completion": "RC",
    "failures_per_100m": "FC /100 m",
    "velocity_mean_mps": "V m/s",
}
_DISCERNED_TITLE: Final = (
    "People in the way: discerned",
    "Share of pairs of an event and its decoy in which both were solved. The paper has no decoys.",
)
_PLACES: Final = ((False, "Generated places"), (True, "Real places"))


BlindRows = Mapping[str, Mapping[str, Estimate]]
"""Success of the best blind schedules found, by suite and kind."""


class TableRow(NamedTuple):
    """Row of figures.

    notes: what a reader must know of it
    suite, track, colour: only in the summary of all runs
    """

    name: str
    cells: tuple[Estimate, ...]
    notes: str = ""
    suite: str = ""
    track: str = ""
    colour: str = ""
    scored: int = 0
    crashed: int = 0
    invalid: int = 0


class ReportTable(NamedTuple):
    """Table of the page.

    spans: lines of (words, columns) above the heads
    edges: for each column whether a group of columns begins with it
    paper: rows of the paper's models
    """

    title: str
    note: str
    heads: tuple[str, ...]
    rows: tuple[TableRow, ...]
    spans: tuple[tuple[tuple[str, int], ...], ...] = ()
    edges: tuple[bool, ...] = ()
    paper: Mapping[str, Row] = {}


class RunWarnings(NamedTuple):
    """Reasons why figures are inconclusive.

    unquotable: (run and suite, reason)
    mixed: (suite, number of scenarios of each run) if these differ
    """

    unquotable: tuple[tuple[str, str], ...]
    mixed: tuple[tuple[str, str], ...]


class _Column(NamedTuple):
    """Column of a table.

    over, group: words above its head
    of: column values that select its rows
    """

    over: str
    group: str
    head: str
    of: Mapping[str, object]
    metric: str


def tables_of(
    runs: Sequence[ReportedRun], blind: BlindRows = MappingProxyType({})
) -> list[ReportTable]:
    """Return all tables for which the runs have rows; a table has runs of one sensor track.

    blind: results of blind schedules, shown as a row of the tables of success.
    """
    by_track: dict[str, list[ReportedRun]] = {track: [] for track in get_args(SensorTrack)}
    for run in runs:
        by_track[track_of(run.table)].append(run)
    found = []
    for track, its in by_track.items():
        tables = [_unit(its, blind), *_reactive(its, blind), _long(its), _other(its)]
        title = "" if len(its) == len(runs) else f", sensor track {track}"
        found += [
            table._replace(title=table.title + title) for table in tables if table is not None
        ]
    return found


def track_of(table: pd.DataFrame) -> str:
    """Return the sensor track of a run's table; "blind" without an episode."""
    return str(table["track"].iloc[0]) if len(table) else "blind"


def summary_table(runs: Sequence[ReportedRun], colours: Mapping[str, str]) -> ReportTable:
    """Return a table with one row of main figures per run.

    colours: by run label.
    """
    decoys = any(has_decoys(run.table) for run in runs)
    first = with_discerned(_FIRST, decoys)
    rows = []
    for run in runs:
        invalid = int((run.table["status"] == "invalid").sum())
        rows.append(
            TableRow(
                run.label,
                tuple(cell_of(run.table, metric) for metric in first),
                suite=run.spec.suite,
                track=track_of(run.table),
                colour=colours[run.label],
                scored=len(run.table) - invalid,
                crashed=crashed_in(run.table),
                invalid=invalid,
            )
        )
    of_d = f"D {DISCERNED_IN_WORDS}; " if decoys else ""
    note = (
        f"SR success; {of_d}RC share of the route done; FC failures per 100 m travelled, pooled; "
        f"V mean speed. Small figures are 95 % intervals; below {MIN_N} episodes there are only "
        "counts. A crashed episode counts as failed, with SR, RC and V of 0; a run with one has "
        "no rates."
        + " Decoys are scored, but count in D alone; their crashes are not listed here."
        * decoys
    )
    heads = ("scored", "crashed", "invalid", *first.values())
    return ReportTable("All episodes of each run", note, heads, tuple(rows))


def cell_of(table: pd.DataFrame, metric: str) -> Estimate:
    """Return the mean of a metric over the rows of a table."""
    return estimate_of(table, metric) if len(table) else NO_ESTIMATE


def episodes_of(runs: Iterable[ReportedRun], family: PaperTable) -> dict[str, pd.DataFrame]:
    """Return the episodes of one family by run label; labels without episodes are omitted."""
    found: dict[str, list[pd.DataFrame]] = {}
    for run in runs:
        part = run.table[run.table["family"] == family]
        if len(part):
            found.setdefault(run.label, []).append(part)
    return {label: pd.concat(parts) for label, parts in found.items()}


def kind_in_words(kind: str) -> str:
    """Return a scenario kind as a column head."""
    return kind.replace("ped_", "ped. ")


def _with_blind(
    table: ReportTable | None, columns: Sequence[_Column], blind: Mapping[str, Estimate]
) -> ReportTable | None:
    """Add the row of blind schedules, if any; other metrics than success are empty in it."""
    if table is None or not blind:
        return table
    kinds = [str(column.of["kind"]) if column.metric == "success" else "" for column in columns]
    cells = tuple(blind.get(kind, NO_ESTIMATE) for kind in kinds)
    row = TableRow(BEST_BLIND, cells, "no camera, one schedule per kind, test")
    return table._replace(rows=(*table.rows, row))


def _unit(runs: Sequence[ReportedRun], blind: BlindRows) -> ReportTable | None:
    columns = [
        _Column(words, kind, head, {"real": real, "kind": kind}, metric)
        for real, words in _PLACES
        for kind in UNIT_COLUMNS
        for metric, head in _SHARES.items()
    ]
    note = "SR success, SPL success weighted by path length, RC share of the route done."
    table = _table("Unit tests", note, runs, "unit", columns, UNIT_OF_PAPER)
    # A schedule is searched over generated and real places together.
    generated = [column for column in columns if not column.of["real"]]
    padded = [column if column in generated else column._replace(metric="") for column in columns]
    return _with_blind(table, padded, blind.get("unit", {}))


def _reactive(runs: Sequence[ReportedRun], blind: BlindRows) -> Iterable[ReportTable | None]:
    titles = {
        "success": (
            "People in the way: success",
            "Share of episodes: at the goal in time, no failure, no rule broken.",
        ),
        "pedestrian_collision": (
            "People in the way: hit a person",
            "Share of episodes with a collision; lower is better.",
        ),
        "pedestrian_distance_min_success_m": (
            "People in the way: nearest person, m",
            "Least distance between centres, mean over the episodes that succeeded.",
        ),
    }
    if any(has_decoys(run.table) for run in runs):
        titles = {"success": titles["success"], DISCERNED: _DISCERNED_TITLE} | titles
    for metric, (title, note) in titles.items():
        columns = [
            _Column("", "", kind_in_words(kind), {"kind": kind}, metric) for kind in EVENT_COLUMNS
        ]
        table = _table(title, note, runs, "reactive", columns, REACTIVE_OF_PAPER.get(metric, {}))
        yield _with_blind(table, columns, blind.get("reactive", {}) if metric == "success" else {})


def _long(runs: Sequence[ReportedRun]) -> ReportTable | None:
    columns = [
        _Column("", words, head, {"real": real}, metric)
        for real, words in _PLACES
        for metric, head in RATES.items()
    ]
    note = (
        "Failures per 100 m travelled, pooled over all metres: FC all, C collisions, OL off the "
        "sidewalk, F freezings, FL falls of robots with legs; V mean speed, m/s."
    )
    paper = {model: _without_falls(row, columns) for model, row in LONG_OF_PAPER.items()}
    return _table("Long ways", note, runs, "long", columns, paper)


def _without_falls(row: Row, columns: Sequence[_Column]) -> Row:
    """Return a row of the paper, which counts no falls, with a cell for each column."""
    known = iter(row)
    return tuple(None if one.metric == "falls_per_100m" else next(known) for one in columns)


def _other(runs: Sequence[ReportedRun]) -> ReportTable | None:
    """Return a table of scenario kinds that the paper lacks, with success and completion."""
    known = {"unit": UNIT_COLUMNS, "reactive": EVENT_COLUMNS, "long": ("route",)}
    found: dict[str, pd.DataFrame] = {}
    for run in runs:
        for (family, kind), part in run.table.groupby(["family", "kind"], sort=False):
            if run.spec.suite not in PAPER_SUITES or kind not in known[str(family)]:
                found[f"{run.label}: {kind}"] = part
    if not found:
        return None
    shown = with_discerned(_SHARES | RATES, any(map(has_decoys, found.values())))
    columns = [_Column("", "", head, {}, metric) for metric, head in shown.items()]
    return _framed(
        "Other suites and kinds",
        "As above, by what the scenarios are examples of.",
        columns,
        found,
        {},
    )


def _table(
    title: str,
    note: str,
    runs: Sequence[ReportedRun],
    family: PaperTable,
    columns: Sequence[_Column],
    paper: Mapping[str, Row],
) -> ReportTable | None:
    ours = episodes_of([run for run in runs if run.spec.suite in PAPER_SUITES], family)
    return _framed(title, note, columns, ours, paper) if ours else None


def _framed(
    title: str,
    note: str,
    columns: Sequence[_Column],
    ours: Mapping[str, pd.DataFrame],
    paper: Mapping[str, Row],
) -> ReportTable:
    groups = [(column.over, column.group) for column in columns]
    rows = [
        TableRow(label, tuple(cell_of(_part(table, c), c.metric) for c in columns), _notes(table))
        for label, table in ours.items()
    ]
    lines: tuple[Sequence[tuple[str, ...]], ...] = ([(over,) for over, _ in groups], groups)
    return ReportTable(
        title,
        note,
        tuple(column.head for column in columns),
        tuple(rows),
        tuple(_spans(line) for line in lines if any(name[-1] for name in line)),
        (False, *(one != before for before, one in pairwise(groups))),
        paper,
    )


def _spans(names: Iterable[tuple[str, ...]]) -> tuple[tuple[str, int], ...]:
    """Return (words, columns) for neighbouring columns of one name."""
    return tuple((name[-1], len(list(same))) for name, same in groupby(names))


def _part(table: pd.DataFrame, column: _Column) -> pd.DataFrame:
    for name, value in column.of.items():
        table = table[table[name] == value]
    return table


def _notes(table: pd.DataFrame) -> str:
    """Return the notes of a row: episodes, sensor track, pairs, robots, gaits, crashes and so on.

    The default robot and a robot's own gait are not named.
    """
    episodes = int((~is_decoy(table)).sum())
    notes = [f"{episodes} episode{'s' * (episodes != 1)}"]
    notes += ["oracle"] * (ORACLE in {*table["policy"]})
    notes.append(track_of(table))
    notes += [episode_pairs(table).in_words] * has_decoys(table)
    notes += [f"robot {name}" for name in sorted({*table["robot"]} - {COURIER.name})]
    gaits = table[["gait", "gait_hash"]].drop_duplicates().itertuples(index=False)
    notes += [gait_in_words(*gait) for gait in gaits if gait[0]]
    crashed = crashed_in(table)
    of_decoys = int((table["status"] == "crashed").sum()) - crashed
    notes += [f"{crashed} crashed"] * bool(crashed)
    notes += [f"{of_decoys} crashed (decoys)"] * bool(of_decoys)
    notes += [f"weather {name}" for name in sorted({*table["weather"]} - {CLEAR})]
    notes += ["crowd added"] * bool(table["crowd_added"].any())
    notes += ["nonstandard camera"] * bool((table["nonstandard"] != "").any())
    return ", ".join(notes)


def warnings_of(runs: Sequence[ReportedRun]) -> RunWarnings:
    """Return which runs are inconclusive, and which suites were run with different scenarios."""
    reasons = [(run, why_inconclusive(run.table, len(run.spec.scenarios))) for run in runs]
    suites: dict[str, list[ReportedRun]] = {}
    for run in runs:
        suites.setdefault(run.spec.suite, []).append(run)
    return RunWarnings(
        tuple((f"{run.label}, {run.spec.suite}", why) for run, why in reasons if why),
        tuple(
            (suite, ", ".join(f"{run.label} {len(run.spec.scenarios)}" for run in of))
            for suite, of in suites.items()
            if len({frozenset(run.spec.scenarios) for run in of}) > 1
        ),
    )
