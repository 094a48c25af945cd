"""Tables of a run comparison as text, Markdown and LaTeX."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Hashable, Mapping
from typing import Any, Final, NamedTuple

import pandas as pd

from cosim.results.compare import MIN_CHANGED, ComparedRun, RunComparison
from cosim.results.discerned import DISCERNED, DISCERNED_IN_WORDS
from cosim.results.intervals import BOOTSTRAP, MIN_N, Estimate
from cosim.results.metrics import SUCCESS_IN_WORDS
from cosim.results.table import summary_of
from cosim.spec.weather import WEATHERS

_HLINES: Final[list[Any]] = [
    {"selector": f"{rule}rule", "props": ":hline"} for rule in ("top", "mid", "bottom")
]
"""Rules of a LaTeX table that need no package."""
_SUITE_METRICS: Final = (
    "success",
    DISCERNED,
    "goal_reached",
    "route_completion",
    "spl",
    "failures_per_100m",
    "collisions_per_100m",
    "out_of_lane_per_100m",
    "freezings_per_100m",
    "falls_per_100m",
    "failures_per_100m_route",
    "velocity_mean_mps",
    "pedestrian_collision",
    "other_collision",
    "left_lane",
    "broke_rule",
    "red_light_entries",
    "pedestrian_distance_min_m",
    "clearance_min_m",
    "time_to_goal_s",
)
_GROUP_METRICS: Final = {
    "success": "SR",
    DISCERNED: "D",
    "route_completion": "RC",
    "failures_per_100m": "FC",
}
_WEATHER_METRICS: Final = {
    "success": "SR",
    "route_completion": "RC",
    "failures_per_100m": "FC",
    "velocity_mean_mps": "V, m/s",
}
_LATEX_ESCAPES: Final = {
    "\\": r"\textbackslash{}",
    "{": r"\{",
    "}": r"\}",
    "&": r"\&",
    "%": r"\%",
    "$": r"\$",
    "#": r"\#",
    "_": r"\_",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    '"': r"\textquotedbl{}",
}
_MARKDOWN_SPECIAL: Final = re.compile(r"([\\`*_{}\[\]#|~$&])")
_SIGNED_NUMBER: Final = re.compile(r"(?<!\S)[-+]\d[\d.]*(?!\S)")


class TextTable(NamedTuple):
    """Table of text cells.

    names: number of columns with names; the others are figures.
    """

    title: str
    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    names: int


def tables_of_comparison(result: RunComparison, other: ComparedRun) -> tuple[TextTable, ...]:
    """Build the tables of the first run against another: the whole suite by metric, then its
    groups.

    Metrics without a common episode are omitted.
    """
    is_other = result.differences["after"] == other.label
    rows = result.differences[is_other & (result.differences["n"] > 0)].to_dict("records")
    title = f"{other.label} (B) against {result.before.label} (A), suite {result.suite}"
    figures = ("A", "B", "B - A", "95 % of B - A", "n", "")
    whole = [row for row in rows if row["by"] == "suite" and row["metric"] in _SUITE_METRICS]
    tables = [
        TextTable(
            title, ("metric", *figures), tuple((row["metric"], *_figures(row)) for row in whole), 1
        )
    ]
    if grouped := [row for row in rows if row["by"] != "suite" and row["metric"] in _GROUP_METRICS]:
        named = " and ".join(dict.fromkeys(row["by"] for row in grouped))
        each = tuple(
            (row["group"], _GROUP_METRICS[row["metric"]], *_figures(row)) for row in grouped
        )
        tables.append(TextTable(f"{title}, by {named}", ("group", "", *figures), each, 2))
    return tuple(tables)


def _figures(row: Mapping[Hashable, Any]) -> tuple[str, ...]:
    """Return both values, their difference, its interval, n and verdict; of few pairs counts."""
    if row["n"] < MIN_N and row["counts_before"]:
        return (row["counts_before"], row["counts_after"], "-", "-", f"{row['n']}", row["verdict"])
    interval = "-" if pd.isna(row["low"]) else f"{_signed(row['low'])} to {_signed(row['high'])}"
    values = (_plain(row["value_before"]), _plain(row["value_after"]), _signed(row["difference"]))
    return (*values, interval, f"{row['n']}", row["verdict"])


def _plain(value: float) -> str:
    return f"{value:.2f}" if abs(value) < 100.0 else f"{value:.1f}"


def _signed(value: float) -> str:
    return f"{value + 0.0:+.{3 if abs(value) < 10.0 else 2 if abs(value) < 100.0 else 1}f}"


def summary_by_weather(result: RunComparison) -> pd.DataFrame:
    """Return a row for each weather, policy and metric of all runs: `summary_of` with these.

    Columns: weather, policy, metric, and those of `summary_of`; weathers in the order of
    `WEATHERS`. Where a policy has several runs in one weather, the runs' names stand for it.
    """
    runs = (result.before, *result.others)
    names = [str(run.table["policy"].iloc[0]) for run in runs]
    pairs = Counter(
        (weather, name)
        for run, name in zip(runs, names, strict=True)
        for weather in run.table["weather"].unique()
    )
    if any(count > 1 for count in pairs.values()):
        names = [run.label for run in runs]
    parts = []
    for weather in WEATHERS:
        for run, policy in zip(runs, names, strict=True):
            rows = run.table[run.table["weather"] == weather]
            if len(rows):
                part = summary_of(rows).reset_index()
                part.insert(0, "weather", weather)
                part.insert(1, "policy", policy)
                parts.append(part)
    return pd.concat(parts, ignore_index=True)


def summary_by_policy(result: RunComparison) -> pd.DataFrame:
    """Return a row for each run and metric: `summary_of` with the run's name as policy."""
    parts = []
    for run in (result.before, *result.others):
        part = summary_of(run.table).reset_index()
        part.insert(0, "policy", run.label)
        parts.append(part)
    return pd.concat(parts, ignore_index=True)


def table_by_weather(summary: pd.DataFrame) -> TextTable:
    """Build the table of `summary_by_weather`: a row for each weather and policy."""
    rows = []
    for (weather, policy), of in summary.groupby(["weather", "policy"], sort=False):
        figures = of.set_index("metric")[[*Estimate._fields]]
        found = {str(name): Estimate(*row) for name, *row in figures.itertuples()}
        cells = (
            _estimate_in_words(found[name]) if name in found else "-" for name in _WEATHER_METRICS
        )
        rows.append((str(weather), str(policy), *cells))
    heads = ("weather", "policy", *_WEATHER_METRICS.values())
    return TextTable("By weather: means, with 95 % intervals", heads, tuple(rows), 2)


def _estimate_in_words(found: Estimate) -> str:
    """Return a mean with its interval, or counts below MIN_N; "-" without a value."""
    interval = f" ({found.interval_in_words()})" if found.has_interval else ""
    return f"{found.in_words}{interval}"


def flips_in_words(result: RunComparison, other: ComparedRun) -> tuple[str, ...]:
    """Return which scenarios only one of two runs solved, by name, and then which decoys."""
    flipped = result.flipped[result.flipped["after"] == other.label]
    lines = []
    for decoys, of in ((False, ""), (True, "decoys ")):
        for flip, run in (("won", other), ("lost", result.before)):
            chosen = (flipped["flip"] == flip) & (flipped["decoy"] == decoys)
            names = flipped.loc[chosen, "scenario"].tolist()
            if names or not decoys:
                alone = f"{of}solved by {run.label} alone"
                lines.append(f"{alone}, {len(names)}: {', '.join(names) or 'none'}")
    return tuple(lines)


def how_to_read(result: RunComparison) -> str:
    """Return the explanation of the figures."""
    tables = [table for other in result.others for table in tables_of_comparison(result, other)]
    shown = sum(row[-3] != "-" for table in tables for row in table.rows)
    in_all = int(result.differences["low"].notna().sum())
    has_d = bool((result.differences["metric"] == DISCERNED).any())
    of_d = f"D {DISCERNED_IN_WORDS}, paired by event and decoy; " if has_d else ""
    return (
        "Paired by scenario, rates pooled; intervals by drawing scenarios again in pairs, "
        f"{BOOTSTRAP} times, always the same; below {MIN_N} scenarios only counts, and no verdict. "
        "Within noise: the interval holds 0. Too few: it does "
        f"not, but fewer than {MIN_CHANGED} scenarios changed (of a rate: of those with a "
        "failure). Differs: it does not, and there is no verdict. One interval in twenty misses "
        f"by chance alone: {shown} stand in these tables, {in_all} in a .csv, a row for every "
        f"metric of every group. SR {SUCCESS_IN_WORDS}; {of_d}RC share of the route done; FC "
        "failures per 100 m travelled; the scenarios of an event are those that have one on their "
        "way."
    )


def as_markdown(result: RunComparison) -> str:
    """Format the whole comparison as Markdown."""
    blocks = []
    for other in result.others:
        for table in tables_of_comparison(result, other):
            align = ["left"] * table.names + ["right"] * (len(table.heads) - table.names)
            rows = _frame(table, _in_markdown).to_markdown(
                index=False, colalign=align, disable_numparse=True
            )
            blocks.append(f"**{_in_markdown(table.title)}**\n\n{rows}")
        blocks.append(
            "\n".join(f"- {_in_markdown(line)}" for line in flips_in_words(result, other))
        )
    return "\n\n".join([*blocks, *map(_in_markdown, (*result.notes, how_to_read(result)))]) + "\n"


def as_latex(result: RunComparison) -> str:
    """Format the whole comparison as LaTeX for \\input; it needs no package."""
    blocks = []
    for other in result.others:
        for table in tables_of_comparison(result, other):
            style = _frame(table, _in_latex).style.hide(axis="index").set_table_styles(_HLINES)
            columns = "l" * table.names + "r" * (len(table.heads) - table.names - 1) + "l"
            title = _in_latex(table.title)
            blocks.append(
                style.to_latex(
                    column_format=columns, caption=title, position_float="centering"
                ).strip()
            )
        blocks.append("\n\n".join(map(_in_latex, flips_in_words(result, other))))
    return "\n\n".join([*blocks, *map(_in_latex, (*result.notes, how_to_read(result)))]) + "\n"


def _frame(table: TextTable, escaped: Callable[[str], str]) -> pd.DataFrame:
    """Return a table with its heads and cells escaped."""
    return pd.DataFrame(
        [[*map(escaped, row)] for row in table.rows], columns=[*map(escaped, table.heads)]
    )


def _in_latex(text: str) -> str:
    plain = "".join(_LATEX_ESCAPES.get(letter, letter) for letter in _one_line(text))
    return _SIGNED_NUMBER.sub(r"$\g<0>$", plain)


def _in_markdown(text: str) -> str:
    return _MARKDOWN_SPECIAL.sub(r"\\\1", _one_line(text)).replace("<", "&lt;").replace(">", "&gt;")


def _one_line(text: str) -> str:
    return " ".join(text.split())


FORMATS: Final[dict[str, Callable[[RunComparison], str]]] = {".md": as_markdown, ".tex": as_latex}
"""Formatters by file suffix."""
