"""Plots of a report as Plotly figures: plain values, drawn in the browser."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from itertools import compress
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from cosim.core.progress import Progress, ignore
from cosim.report.page.paper import EVENT_COLUMNS
from cosim.report.page.reasons import CAUSES, mishaps_of
from cosim.report.page.runs import LIGHT_KINDS, PaperTable, ReportedRun, table_of_paper
from cosim.report.page.three_tables import (
    UNIT_COLUMNS,
    cell_of,
    episodes_of,
    kind_in_words,
)
from cosim.results.discerned import DISCERNED
from cosim.results.intervals import MIN_N, NO_ESTIMATE, Estimate, estimate_of_rate
from cosim.results.record import Record, Recorder

RUN_COLOURS: Final = (
    "#1f5fa8",
    "#d9722b",
    "#3b8f5a",
    "#8a5aa8",
    "#b03a48",
    "#5b6770",
    "#b8912f",
    "#2a9d9d",
)
CAUSE_COLOURS: Final = dict(
    zip(
        ("success", *CAUSES, "invalid"),
        (
            "#a9cfae",
            "#c8452f",
            "#7b2d26",
            "#d99a3d",
            "#8a5aa8",
            "#4f86c6",
            "#3f9c8f",
            "#8b97a3",
            "#c06aa0",
            "#e3b7d2",
            "#333333",
            "#dddddd",
        ),
        strict=True,
    )
)
NEAR_M: Final = 10.0
_NEAR_EDGES: Final = (1.0, 3.0, 6.0, 10.0)
_NEAR_WORDS: Final = ("nobody", "1 to 2", "3 to 5", "6 to 9", "10 or more")
_SPEED_EDGES: Final = (0.25, 0.75, 1.25, 1.75)
_SPEED_WORDS: Final = ("below 0.25", "0.25 to 0.75", "0.75 to 1.25", "1.25 to 1.75", "above 1.75")
_MIN_M: Final = 20.0
"""Least distance travelled, metres, for a rate."""
_BAR_PX: Final = 40
_SHARES: Final = ("success", DISCERNED)
"""Metrics that are shares; the others of the plots are rates."""
_FAMILIES: Final[Mapping[PaperTable, str]] = {
    "unit": "unit tests",
    "reactive": "people in the way",
    "long": "long ways",
}


class Plot(NamedTuple):
    """Figure with title and note; data and layout in Plotly's format."""

    title: str
    note: str
    figure: dict[str, Any]


class Exposure(NamedTuple):
    """Failures (B,) and metres travelled (B,) of one episode by bin of a condition."""

    failures: Floats
    metres: Floats


def plots_of(
    runs: Sequence[ReportedRun], colours: Mapping[str, str], progress: Progress = ignore
) -> list[Plot]:
    """Build every plot for which the runs have data.

    colours: by run label.
    """
    rate = "Failures per 100 m"
    found = [
        _metric_plot(
            runs, colours, "unit", "kind", UNIT_COLUMNS, "success", "Success by structure"
        ),
        _metric_plot(
            runs, colours, "reactive", "kind", EVENT_COLUMNS, "success", "Success by event"
        ),
        _metric_plot(
            runs,
            colours,
            "reactive",
            "kind",
            EVENT_COLUMNS,
            DISCERNED,
            "Discerned by event: solved with its decoy",
        ),
        _endings_plot(runs),
        _cause_rates_plot(runs),
        _metric_plot(
            runs,
            colours,
            "unit",
            "light",
            LIGHT_KINDS,
            "success",
            "Success by light, unit tests",
        ),
        _metric_plot(
            runs,
            colours,
            "reactive",
            "light",
            LIGHT_KINDS,
            "success",
            "Success by light, people in the way",
        ),
        _metric_plot(
            runs,
            colours,
            "long",
            "light",
            LIGHT_KINDS,
            "failures_per_100m",
            f"{rate} by light, long ways",
        ),
    ]
    near, fast = _exposures(runs, progress)
    people = {label: parts for (label, family), parts in near.items() if family == "long"}
    speed: dict[str, dict[str, list[Exposure]]] = {"long ways": {}, "short ways": {}}
    for (label, family), parts in fast.items():
        speed["long ways" if family == "long" else "short ways"].setdefault(label, []).extend(parts)
    note = (
        "Pooled over episodes that ended: failures that happened so, on metres driven so, scaled "
        f"to those that count for rates; bars are 95 % intervals, from {MIN_N} episodes on."
    )
    moving = f"{note} Without freezings, which happen at no speed."
    found.append(
        _exposure_plot(
            people, colours, _NEAR_WORDS, f"{rate} by people within {NEAR_M:g} m, long ways", note
        )
    )
    for words, of in speed.items():
        found.append(
            _exposure_plot(
                of, colours, _SPEED_WORDS, f"{rate} by the robot's speed, m/s, {words}", moving
            )
        )
    return [plot for plot in found if plot is not None]


def people_nearby(pose: Floats, people_tick: NDArray[np.int64], people_xy: Floats) -> Floats:
    """Return (T,) the number of people within NEAR_M of the robot, recorded once a second.

    pose, people_tick, people_xy: columns of `Log`
    """
    away = people_xy - pose[people_tick, :2]
    close = people_tick[np.hypot(away[:, 0], away[:, 1]) < NEAR_M]
    every = Recorder.PEOPLE_EVERY_TICKS
    by_tick = np.bincount(close, minlength=len(pose))
    return by_tick[np.arange(len(pose)) // every * every].astype(float)


def exposure_of(
    record: Record, travelled_m: Floats, value: Floats, edges: Sequence[float], *, moving: bool
) -> Exposure:
    """Bin failures and metres of an episode by a value per tick.

    travelled_m, value: (T,) of each tick
    edges: inner edges of the bins
    moving: True to skip freezings, which have no metres
    """
    bins = np.digitize(value, edges)
    ticks = [
        f.tick
        for f in record.failures
        if f.tick < len(value) and not (moving and f.kind == "freezing")
    ]
    count = len(edges) + 1
    failures = np.bincount(bins[np.array(ticks, dtype=int)], minlength=count).astype(float)
    return Exposure(failures, np.bincount(bins, weights=travelled_m, minlength=count).astype(float))


_ByRun = dict[tuple[str, PaperTable], list[Exposure]]


def _exposures(runs: Sequence[ReportedRun], progress: Progress) -> tuple[_ByRun, _ByRun]:
    """Return exposures by people nearby and by speed, of every episode with a trajectory that is no
    decoy."""
    near: _ByRun = {}
    fast: _ByRun = {}
    for number, run in enumerate(runs):
        progress("reading trajectories", number / len(runs))
        for record, track in run.tracks():
            if record.scenario.decoy_of:
                continue
            key = run.label, table_of_paper(run.scenarios[record.scenario.id])
            travelled_m = track["travelled_m"] * _rated_share(record)
            speed = np.abs(track["speed"][:, 0])
            if key[1] == "long":
                people = people_nearby(track["pose"], track["people_tick"], track["people_xy"])
                near.setdefault(key, []).append(
                    exposure_of(record, travelled_m, people, _NEAR_EDGES, moving=False)
                )
            began = np.concatenate([speed[:1], speed[:-1]])
            fast.setdefault(key, []).append(
                exposure_of(record, travelled_m, began, _SPEED_EDGES, moving=True)
            )
    return near, fast


def _rated_share(record: Record) -> float:
    """Return the share of the metres of an episode that counts for rates."""
    travelled_m = record.measures.get("path_length_m") or 0.0
    return (record.measures.get("rated_m") or 0.0) / travelled_m if travelled_m else 1.0


def _exposure_plot(
    of: Mapping[str, list[Exposure]],
    colours: Mapping[str, str],
    words: Sequence[str],
    title: str,
    note: str,
) -> Plot | None:
    """Return the plot of failure rates by bin; None without a failure."""
    if not any(part.failures.any() for parts in of.values() for part in parts):
        return None
    cells: dict[str, list[Estimate]] = {}
    for label, parts in of.items():
        failures, metres = (
            np.array([p.failures for p in parts]),
            np.array([p.metres for p in parts]),
        )
        cells[label] = [
            estimate_of_rate(f[(m > 0.0) | (f > 0.0)], m[(m > 0.0) | (f > 0.0)])
            if m.sum() >= _MIN_M
            else NO_ESTIMATE
            for f, m in zip(failures.T, metres.T, strict=True)
        ]
    present = [k for k in range(len(words)) if any(row[k].n for row in cells.values())]
    if len(present) < 2:
        return None
    cells = {label: [row[k] for k in present] for label, row in cells.items()}
    return Plot(
        title, note, _points(cells, colours, [words[k] for k in present], "per 100 m", share=False)
    )


def _metric_plot(
    runs: Sequence[ReportedRun],
    colours: Mapping[str, str],
    family: PaperTable,
    column: str,
    order: Sequence[str],
    metric: str,
    title: str,
) -> Plot | None:
    """Return the plot of a metric by the values of a column; None for fewer than two values."""
    tables = episodes_of(runs, family)
    present = [
        value for value in order if any((table[column] == value).any() for table in tables.values())
    ]
    cells = {
        label: [cell_of(table[table[column] == value], metric) for value in present]
        for label, table in tables.items()
    }
    if metric == DISCERNED:
        paired = [any(row[k].n for row in cells.values()) for k in range(len(present))]
        present = [*compress(present, paired)]
        cells = {label: [*compress(row, paired)] for label, row in cells.items()}
    if len(present) < 2:
        return None
    share = metric in _SHARES
    note = (
        f"Points are means, bars 95 % intervals, from {MIN_N} episodes on; hover for figures."
        if share
        else f"Pooled; bars are 95 % intervals, from {MIN_N} episodes on."
    )
    words = [escape(kind_in_words(value)) for value in present]
    return Plot(
        title,
        note,
        _points(cells, colours, words, metric if share else "per 100 m", share=share),
    )


def _points(
    cells: Mapping[str, Sequence[Estimate]],
    colours: Mapping[str, str],
    words: Sequence[str],
    axis: str,
    *,
    share: bool,
) -> dict[str, Any]:
    """Return a figure with one row per word, with a point and interval per label."""
    data = []
    for label, row in cells.items():
        shown = [
            (word, cell)
            for word, cell in zip(words, row, strict=True)
            if cell.n and not np.isnan(cell.mean)
        ]
        data.append(
            {
                "type": "scatter",
                "mode": "markers",
                "orientation": "h",
                "name": escape(label),
                "offsetgroup": label,
                "cliponaxis": False,
                "x": [round(cell.mean, 4) for _, cell in shown],
                "y": [word for word, _ in shown],
                "error_x": {
                    "type": "data",
                    "symmetric": False,
                    "thickness": 1.6,
                    "width": 0,
                    "array": [_bar(cell, cell.high - cell.mean) for _, cell in shown],
                    "arrayminus": [_bar(cell, cell.mean - cell.low) for _, cell in shown],
                },
                "marker": {"size": 9, "color": colours[label]},
                "customdata": [_hover_of(cell) for _, cell in shown],
                "hovertemplate": "%{y}<br>%{customdata}",
            }
        )
    scale = {"range": [-0.02, 1.02], "tickformat": ".1f"} if share else {"rangemode": "tozero"}
    return {
        "data": data,
        "layout": {
            "height": 96 + len(words) * (16 + 15 * len(cells)),
            "meta": {"row": 16 + 15 * len(cells)},
            "scattermode": "group",
            "showlegend": len(cells) > 1,
            "xaxis": {"title": {"text": axis}, "zeroline": False, **scale},
            "yaxis": {
                "autorange": "reversed",
                "categoryorder": "array",
                "categoryarray": list(words),
            },
        },
    }


def _bar(cell: Estimate, length: float) -> float | None:
    """Return the length of an error bar; None without an interval."""
    return round(length, 4) if cell.has_interval else None


def _hover_of(cell: Estimate) -> str:
    interval = f" ({cell.interval_in_words()})" if cell.has_interval else ""
    return f"{cell.in_words}{interval}, n = {cell.n}"


def _stacked(rows: Mapping[str, Mapping[str, float]], axis: str, form: str) -> dict[str, Any]:
    """Return a figure with one stacked bar of causes per row.

    rows: by their Plotly label.
    """
    causes = [cause for cause in CAUSE_COLOURS if any(row.get(cause) for row in rows.values())]
    data = [
        {
            "type": "bar",
            "orientation": "h",
            "name": cause,
            "marker": {"color": CAUSE_COLOURS[cause]},
            "y": [*rows],
            "x": [round(row.get(cause, 0.0), 4) for row in rows.values()],
            "hovertemplate": f"%{{x:{form}}}",
        }
        for cause in causes
    ]
    yaxis = {"autorange": "reversed", "type": "category"}
    xaxis = {"title": {"text": axis}, "tickformat": form, "zeroline": False}
    layout = {
        "barmode": "stack",
        "height": 140 + _BAR_PX * len(rows),
        "bargap": 0.35,
        "showlegend": True,
    }
    return {
        "data": data,
        "layout": layout | {"meta": {"row": _BAR_PX}, "xaxis": xaxis, "yaxis": yaxis},
    }


def _endings_plot(runs: Sequence[ReportedRun]) -> Plot | None:
    """Return the plot of how short episodes ended, as shares."""
    rows: dict[str, dict[str, float]] = {}
    for run in runs:
        for record in run.records:
            family = table_of_paper(run.scenarios[record.scenario.id])
            if family != "long":
                words = "decoys" if record.scenario.decoy_of else _FAMILIES[family]
                row = rows.setdefault(f"{escape(run.label)}<br>{words}", {})
                went = mishaps_of(record)
                what = (
                    "invalid"
                    if record.status == "invalid"
                    else went[0].cause
                    if went
                    else "success"
                )
                row[what] = row.get(what, 0.0) + 1.0
    if not rows:
        return None
    shares = {
        name: {cause: n / sum(row.values()) for cause, n in row.items()}
        for name, row in rows.items()
    }
    note = "Share of episodes by how they ended; at the first failure they are over."
    return Plot("How short episodes end", note, _stacked(shares, "share of episodes", ".0%"))


def _cause_rates_plot(runs: Sequence[ReportedRun]) -> Plot | None:
    """Return the plot of failure rates by cause on long ways.

    An episode whose policy crashed has no metres; the note counts it.
    """
    counts: dict[str, dict[str, float]] = {}
    metres: dict[str, float] = {}
    crashed: dict[str, list[bool]] = {}
    for run in runs:
        for record in run.records:
            if table_of_paper(run.scenarios[record.scenario.id]) != "long":
                continue
            crashed.setdefault(run.label, []).append(record.status == "crashed")
            if record.status == "done":
                metres[run.label] = metres.get(run.label, 0.0) + (
                    record.measures.get("rated_m") or 0.0
                )
                row = counts.setdefault(run.label, {})
                for mishap in mishaps_of(record):
                    if mishap.failure is not None:
                        row[mishap.cause] = row.get(mishap.cause, 0.0) + 1.0
    rows = {
        escape(label): {cause: 100.0 * n / metres[label] for cause, n in row.items()}
        for label, row in counts.items()
        if metres[label] >= _MIN_M
    }
    if not any(rows.values()):
        return None
    note = (
        "Failures per 100 m, all metres of episodes that ended. After a failure the robot is put "
        "back and continues."
    )
    crash_counts = [
        f"{sum(which)} of {len(which)} of {label}" for label, which in crashed.items() if any(which)
    ]
    note += (
        f" Not in it are the episodes in which the policy crashed: {', '.join(crash_counts)}."
        if crash_counts
        else ""
    )
    return Plot("What goes wrong on long ways", note, _stacked(rows, "failures per 100 m", ".1f"))
