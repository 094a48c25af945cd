"""Curves of a sweep: one panel per metric, first field on the x axis, one line per other value."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pandas as pd

from cosim.core.errors import MachineError
from cosim.results.intervals import MIN_N

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_TITLES: Final = {
    "success": "success (SR)",
    "discerned": "events and decoys both solved (D)",
    "spl": "success by path length (SPL)",
    "route_completion": "share of the route done (RC)",
    "failures_per_100m": "failures per 100 m, pooled (FC)",
    "pedestrian_distance_min_m": "nearest to a person's centre, m",
    "time_to_goal_s": "time to the goal, s",
}
DRAWN: Final = tuple(name for name in _TITLES if name != "discerned")
"""Metrics of a picture."""
DRAWN_BY_POLICY: Final = ("success", "discerned", "route_completion", "failures_per_100m")
"""Metrics of a picture of policies; `discerned` only if there are decoys."""
_SHARES: Final = ("success", "discerned", "spl", "route_completion")
_COLOURS: Final = (
    "#0072b2",
    "#d55e00",
    "#009e73",
    "#cc79a7",
    "#56b4e9",
    "#e69f00",
    "#555555",
    "#882255",
)
_MARKS: Final = "osD^v<>P"
_MAX_NAMED: Final = 16
"""Maximum number of lines with a legend."""
_PANEL_LETTERS = 44
"""Characters of tick labels that fit horizontally below a panel."""
_PANEL_LINES = 24
"""Lines of vertical tick labels that fit below a panel."""
_UPRIGHT_LETTERS = 26
"""Characters of a vertical tick label before it wraps."""
_TITLE_LETTERS = 120
"""Characters of the title before it wraps."""
_LEGEND_LETTERS = 168
"""Characters that fit into one row of the legend."""
_HEIGHT = 7.4
"""Figure height, inches, with horizontal tick labels."""
_TALL_HEIGHT = 10.4
"""Figure height, inches, with vertical tick labels."""
_OFFSET: Final = 0.012
"""Horizontal offset between lines, as a share of the panel width, to separate their intervals."""


def draw_curves(
    summary: pd.DataFrame,
    fields: Sequence[str],
    metrics: Sequence[str],
    title: str,
    joined: bool = True,
) -> bytes:
    """Draw the means with their intervals as PNG.

    Metrics without any mean have no panel, unless no metric has one.

    summary: rows of fields, metric, mean, low, high, n
    joined: whether lines join the means

    Raises MachineError if matplotlib is not installed.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MachineError(
            "no picture of the sweep: matplotlib is missing: `pip install matplotlib`, then "
            "the same with --resume"
        ) from error
    known = set(summary.loc[summary["mean"].notna(), "metric"])
    metrics = [metric for metric in metrics if metric in known] or metrics
    first, *others = fields
    x, ticks = _x_positions(summary[first])
    whole = summary.assign(_along=x)
    lines = list(whole.groupby(others, sort=False)) if others else [((), whole)]
    figure = Figure(
        figsize=(13.0, _HEIGHT if ticks is None or _fit_horizontally(ticks) else _TALL_HEIGHT),
        dpi=120,
        layout="constrained",
    )
    FigureCanvasAgg(figure)
    panels = figure.subplots(2, -(-len(metrics) // 2)).flat
    for panel in panels[len(metrics) :]:
        panel.set_axis_off()
    for panel, metric in zip(panels, metrics, strict=False):
        shift = _OFFSET * (float(np.ptp(x)) or 1.0)
        for number, (values, rows) in enumerate(lines):
            colour, marker = _COLOURS[number % len(_COLOURS)], _MARKS[number % len(_MARKS)]
            points = rows[(rows["metric"] == metric) & rows["mean"].notna()]
            line_x = points["_along"] + shift * (number - (len(lines) - 1) / 2)
            error_bars = [points["mean"] - points["low"], points["high"] - points["mean"]]
            named = _line_label(others, values)
            panel.errorbar(
                line_x,
                points["mean"],
                error_bars,
                color=colour,
                marker=marker,
                capsize=3,
                lw=1.6,
                linestyle="-" if joined else "",
                elinewidth=1.6,
                ms=5,
                label=named,
            )
        panel.set_title(_TITLES.get(metric, metric), fontsize=11)
        panel.set_xlabel(first)
        panel.grid(alpha=0.3)
        if ticks is not None:
            _name_ticks(panel, ticks)
        if metric in _SHARES:
            panel.set_ylim(-0.03, 1.03)
        else:
            panel.set_ylim(0.0, top_of(whole[whole["metric"] == metric]))
    if others and len(lines) <= _MAX_NAMED:
        handles, names = figure.axes[0].get_legend_handles_labels()
        columns = min(len(names), 4, max(1, _LEGEND_LETTERS // (6 + max(map(len, names)))))
        figure.legend(handles, names, loc="outside lower center", ncols=columns, fontsize=9)
    figure.suptitle(
        textwrap.fill(
            f"{title}: means with 95 % intervals from {MIN_N} episodes on", _TITLE_LETTERS
        ),
        fontsize=12,
    )
    picture = io.BytesIO()
    figure.savefig(picture, format="png")
    return picture.getvalue()


def top_of(rows: pd.DataFrame) -> float:
    """Return the upper end of an axis from 0, with room above all means and intervals.

    rows: columns mean, high; NaN where unknown
    """
    highest = float(np.nan_to_num(rows[["mean", "high"]].to_numpy(float)).max(initial=0.0))
    return 1.08 * highest or 1.0


def _name_ticks(panel: Axes, names: Sequence[str]) -> None:
    """Label the ticks of a panel: horizontal if they fit, else vertical, wrapped and thinned."""
    if _fit_horizontally(names):
        panel.set_xticks(range(len(names)), names)
        return
    folded = [textwrap.fill(name, _UPRIGHT_LETTERS) for name in names]
    lines = max(name.count("\n") + 1 for name in folded)
    every = -(-len(names) * lines // _PANEL_LINES)
    panel.set_xticks(range(0, len(names), every), folded[::every], rotation=90, fontsize=9)


def _fit_horizontally(names: Sequence[str]) -> bool:
    """Return whether labels fit horizontally below a panel."""
    return sum(map(len, names)) + 2 * len(names) <= _PANEL_LETTERS


def _x_positions(values: pd.Series[Any]) -> tuple[np.ndarray, list[str] | None]:
    """Return x positions: numbers as they are, words as 0, 1, ... with their labels."""
    numbers = pd.to_numeric(values, errors="coerce")
    if numbers.notna().all() and not values.map(lambda value: isinstance(value, bool)).any():
        return numbers.to_numpy(dtype=float), None
    names = list(dict.fromkeys(map(str, values)))
    return np.array([names.index(str(value)) for value in values], dtype=float), names


def _line_label(fields: Sequence[str], values: Any) -> str:
    """Return the legend label of a line."""
    values = values if isinstance(values, tuple) else (values,)
    return ", ".join(f"{field} {value}" for field, value in zip(fields, values, strict=True))
