"""The paper's three tables for the runs of a report, as HTML: our figures with intervals, the
paper's own below."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from itertools import groupby
from typing import Final, NamedTuple

import numpy as np
import pandas as pd

from cosim.report.page.paper import (
    EVENT_COLUMNS,
    LONG_OF_PAPER,
    REACTIVE_OF_PAPER,
    UNIT_OF_PAPER,
    Row,
)
from cosim.report.page.runs import OF_THE_PAPER, PaperTable, ReportedRun
from cosim.results.table import ORACLE, not_to_be_quoted, summary_of

UNIT_COLUMNS: Final = ("straight", "curve", "crosswalk")
_SHARES: Final = {"success": "SR", "spl": "SPL", "route_completion": "RC"}
RATES: Final = {
    "failures_per_100m": "FC",
    "collisions_per_100m": "C",
    "out_of_lane_per_100m": "OL",
    "freezings_per_100m": "F",
    "velocity_mean_mps": "V",
}
_FIRST: Final = {
    "success": "SR",
    "route_completion": "RC",
    "failures_per_100m": "FC /100 m",
    "velocity_mean_mps": "V m/s",
}
_PLACES: Final = ((False, "Generated places"), (True, "Real places"))
_BESIDE: Final = (
    "the paper's models, in another engine with other pictures: for the shape, not to be compared"
)


class MeanOfEpisodes(NamedTuple):
    """A mean, its interval, and of how many episodes."""

    mean: float
    low: float
    high: float
    n: int


_NOTHING: Final = MeanOfEpisodes(np.nan, np.nan, np.nan, 0)


class _Column(NamedTuple):
    """One column: the rows of a table that it is about, and the metric. over, group: what stands
    over its head."""

    over: str
    group: str
    head: str
    of: Mapping[str, object]
    metric: str


def tables_html(runs: Sequence[ReportedRun]) -> str:
    """All tables that the runs have rows for."""
    parts = [_unit(runs), *_reactive(runs), _long(runs), _other(runs)]
    return "\n".join(part for part in parts if part)


def summary_html(runs: Sequence[ReportedRun], colours: Mapping[str, str]) -> str:
    """A row for each run: the figures that are asked for first. colours: of the labels."""
    words = ("scored", "invalid", *_FIRST.values())
    heads = '<th scope="col">run</th><th scope="col" class="word">suite</th>'
    heads += "".join(f'<th scope="col">{word}</th>' for word in words)
    rows = []
    for run in runs:
        invalid = int((run.table["status"] == "invalid").sum())
        cells = "".join(_cell(cell_of(run.table, metric)) for metric in _FIRST)
        dot = f'<i class="dot" style="background:{colours[run.label]}"></i>'
        rows.append(
            f'<tr><th scope="row">{dot}{escape(run.label)}</th><td '
            f'class="word">{escape(run.spec.suite)}</td>'
            f"<td>{len(run.table) - invalid}</td><td>{invalid}</td>{cells}</tr>"
        )
    title = "All episodes of each run"
    note = (
        "SR success; RC share of the route done; FC failures per 100 m travelled, pooled; V mean "
        "speed. Small figures are 95 % bootstrap intervals over episodes."
    )
    return titled_html(title, note, wide_html(title, f"<tr>{heads}</tr>", rows))


def cell_of(table: pd.DataFrame, metric: str) -> MeanOfEpisodes:
    """A metric over the rows of a table."""
    if not len(table):
        return _NOTHING
    mean, low, high, n = summary_of(table, [metric]).iloc[0]
    return MeanOfEpisodes(float(mean), float(low), float(high), int(n))


def episodes_of(runs: Iterable[ReportedRun], family: PaperTable) -> dict[str, pd.DataFrame]:
    """By label the episodes of one family; labels without any are left out."""
    found: dict[str, list[pd.DataFrame]] = {}
    for run in runs:
        part = run.table[run.table["family"] == family]
        if len(part):
            found.setdefault(run.label, []).append(part)
    return {label: pd.concat(parts) for label, parts in found.items()}


def kind_in_words(kind: str) -> str:
    """As a head of a column."""
    return kind.replace("ped_", "ped. ")


def _unit(runs: Sequence[ReportedRun]) -> str:
    columns = [
        _Column(words, kind, head, {"real": real, "kind": kind}, metric)
        for real, words in _PLACES
        for kind in UNIT_COLUMNS
        for metric, head in _SHARES.items()
    ]
    note = "SR success, SPL success weighted by path length, RC share of the route done."
    return _table("Unit tests", note, runs, "unit", columns, UNIT_OF_PAPER)


def _reactive(runs: Sequence[ReportedRun]) -> Iterable[str]:
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
    for metric, (title, note) in titles.items():
        columns = [
            _Column("", "", kind_in_words(kind), {"kind": kind}, metric) for kind in EVENT_COLUMNS
        ]
        yield _table(title, note, runs, "reactive", columns, REACTIVE_OF_PAPER[metric])


def _long(runs: Sequence[ReportedRun]) -> str:
    columns = [
        _Column("", words, head, {"real": real}, metric)
        for real, words in _PLACES
        for metric, head in RATES.items()
    ]
    note = (
        "Failures per 100 m travelled, pooled over all metres: FC all, C collisions, OL off the "
        "sidewalk, F freezings; V mean speed, m/s."
    )
    return _table("Long ways", note, runs, "long", columns, LONG_OF_PAPER)


def _other(runs: Sequence[ReportedRun]) -> str:
    """What is of no kind that the paper has: a row for each, with success and completion."""
    known = {"unit": UNIT_COLUMNS, "reactive": EVENT_COLUMNS, "long": ("route",)}
    found: dict[str, pd.DataFrame] = {}
    for run in runs:
        for (family, kind), part in run.table.groupby(["family", "kind"], sort=False):
            if run.spec.suite not in OF_THE_PAPER or kind not in known[str(family)]:
                found[f"{run.label}: {kind}"] = part
    if not found:
        return ""
    columns = [_Column("", "", head, {}, metric) for metric, head in (_SHARES | RATES).items()]
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
) -> str:
    ours = episodes_of([run for run in runs if run.spec.suite in OF_THE_PAPER], family)
    return _framed(title, note, columns, ours, paper) if ours else ""


def _framed(
    title: str,
    note: str,
    columns: Sequence[_Column],
    ours: Mapping[str, pd.DataFrame],
    paper: Mapping[str, Row],
) -> str:
    edge = [
        ' class="edge"'
        if k and (c.over, c.group) != (columns[k - 1].over, columns[k - 1].group)
        else ""
        for k, c in enumerate(columns)
    ]
    head = _spans([(c.over,) for c in columns]) + _spans([(c.over, c.group) for c in columns])
    heads = "".join(
        f'<th scope="col"{edge[k]}>{escape(c.head)}</th>' for k, c in enumerate(columns)
    )
    body = []
    for label, table in ours.items():
        cells = "".join(
            _cell(cell_of(_part(table, c), c.metric), edge[k]) for k, c in enumerate(columns)
        )
        body.append(f'<tr><th scope="row">{escape(label)}{_marks(table)}</th>{cells}</tr>')
    if paper:
        body.append(
            f'<tr class="divide"><th colspan="{len(columns) + 1}" '
            f'scope="rowgroup"><span>{_BESIDE}</span></th></tr>'
        )
    for name, row in paper.items():
        cells = "".join(f"<td{edge[k]}>{_number(value)}</td>" for k, value in enumerate(row))
        body.append(f'<tr class="paper"><th scope="row">{escape(name)}</th>{cells}</tr>')
    heads = f"{head}<tr><td></td>{heads}</tr>"
    return titled_html(
        title, note, wide_html(title, heads, body, "tight" if len(columns) > 12 else "")
    )


def titled_html(title: str, note: str, inner: str) -> str:
    """A figure with a title and a note above it."""
    words = f"<h3>{escape(title)}</h3><p>{escape(note)}</p>"
    return f'<figure class="table"><figcaption>{words}</figcaption>{inner}</figure>'


def wide_html(name: str, heads: str, rows: Iterable[str], style: str = "") -> str:
    """A table that scrolls where it is wider than the page. heads, rows: as HTML."""
    style = f' class="{style}"' if style else ""
    return (
        f'<div class="wide" tabindex="0" role="region" aria-label="{escape(name)}"><table{style}>'
        f"<thead>{heads}</thead><tbody>{''.join(rows)}</tbody></table></div>"
    )


def _spans(names: Sequence[tuple[str, ...]]) -> str:
    """A line of heads over neighbouring columns of one name; nothing where they have none."""
    if not any(name[-1] for name in names):
        return ""
    spans = [(name[-1], len(list(same))) for name, same in groupby(names)]
    cells = "".join(
        f'<th colspan="{count}" scope="colgroup">{escape(words)}</th>' for words, count in spans
    )
    return f"<tr><td></td>{cells}</tr>"


def _part(table: pd.DataFrame, column: _Column) -> pd.DataFrame:
    for name, value in column.of.items():
        table = table[table[name] == value]
    return table


def _marks(table: pd.DataFrame) -> str:
    """What a reader must know of a row: how many episodes, and who knew more than a robot can."""
    notes = [f"{len(table)} episode{'s' * (len(table) != 1)}"]
    notes += ["crowd added"] * bool(table["crowd_added"].any())
    if table["privileged"].any():
        notes.append("oracle, privileged" if ORACLE in {*table["policy"]} else "privileged")
    notes += ["nonstandard camera"] * bool((table["nonstandard"] != "").any())
    return f"<small>{', '.join(notes)}</small>"


def _cell(cell: MeanOfEpisodes, edge: str = "") -> str:
    if not cell.n or np.isnan(cell.mean):
        return f"<td{edge}>&ndash;</td>"
    tip = f"{cell.mean:.3f} ({cell.low:.3f} to {cell.high:.3f}), n = {cell.n}"
    interval = f"{_number(cell.low)}&ndash;{_number(cell.high)}"
    return f'<td{edge} title="{tip}">{_number(cell.mean)}<small>{interval}</small></td>'


def _number(value: float | None) -> str:
    return "&ndash;" if value is None else f"{value:.2f}"


def warnings_html(runs: Sequence[ReportedRun]) -> str:
    """Why figures of a run are not to be quoted, a line for each such run, and which runs of a
    suite are of other scenarios of it; nothing where all are sound."""
    told = [(run, not_to_be_quoted(run.table, len(run.spec.scenarios))) for run in runs]
    lines = [
        f"<li><b>{escape(run.label)}, {escape(run.spec.suite)}</b>: not to be quoted, "
        f"{escape(why)}.</li>"
        for run, why in told
        if why
    ]
    suites: dict[str, list[ReportedRun]] = {}
    for run in runs:
        suites.setdefault(run.spec.suite, []).append(run)
    for suite, of in suites.items():
        if len({frozenset(run.spec.scenarios) for run in of}) > 1:
            counts = ", ".join(f"{escape(run.label)} {len(run.spec.scenarios)}" for run in of)
            lines.append(
                f"<li><b>{escape(suite)}</b>: not all runs are of the same scenarios ({counts}). "
                "Their rows are not to be compared one with another; <code>cosim compare</code> "
                "takes the scenarios that both have.</li>"
            )
    return f'<ul class="warn">{"".join(lines)}</ul>' if lines else ""
