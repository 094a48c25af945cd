"""Tables about events: success by kind, and what was measured of each; the part of the command line about them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pandas as pd
from rich import box
from rich.console import Console
from rich.table import Column, Table

from cosim.scenario import Scenario, read_suite

BY_KIND = (("success", "SR"), ("collisions", "C"), ("out_of_lane", "OL"), ("freezings", "F"), ("rules_broken", "rules"))
"""Means over the episodes of a kind of event."""


def kinds_of(folder: Path) -> Mapping[str, str]:
    """The kind of event that each scenario of a run is about; empty where they are about the way."""
    return {s.id: s.events[0].kind for s in read_suite(folder / "scenarios.json").scenarios if about_one_event(s)}


def about_one_event(scenario: Scenario) -> bool:
    """Whether a scenario is there for its one event."""
    return scenario.ends_on_failure and len(scenario.events) == 1


def print_by_kind(out: Console, table: pd.DataFrame, kinds: Mapping[str, str]) -> None:
    """A row per kind of event: how many episodes, and their means. Nothing for fewer than two kinds."""
    from cosim.results import interval_of

    if len(set(kinds.values())) < 2:
        return
    shown = Table("event", "n", *(head for _, head in BY_KIND), "95 % of SR", "invalid", "least m", box=box.SIMPLE_HEAD)
    for kind in dict.fromkeys(kinds.values()):
        part = table[table["scenario"].map(kinds) == kind]
        values = {name: pd.to_numeric(part[name], errors="coerce").dropna() for name, _ in BY_KIND}
        low, high = interval_of(values["success"].to_numpy(dtype=float))
        nearest = pd.to_numeric(part["pedestrian_distance_min_m"], errors="coerce").min()
        means = (f"{values[name].mean():.2f}" if len(values[name]) else "-" for name, _ in BY_KIND)
        interval = f"{low:.2f} to {high:.2f}" if len(values["success"]) else "-"
        invalid = str((part["status"] == "invalid").sum())
        shown.add_row(kind, str(len(part)), *means, interval, invalid, "-" if pd.isna(nearest) else f"{nearest:.2f}")
    out.print(shown)


def print_sheet(out: Console, folder: Path) -> None:
    """What was measured of each event of a run, and a summary by kind."""
    from scenarios.eventsheet import sheet_of_run, summary

    sheet = sheet_of_run(folder)
    heads = ("trigger m", "error", "tick", "m/s", "stated", "left m", "angle", "least m")
    rows = Table(Column("episode", no_wrap=True), "event", *heads, box=box.SIMPLE_HEAD)
    for row in sheet.itertuples(index=False):
        numbers = (f"{value:.3f}" if i in (1, 2) else f"{value:.2f}" for i, value in enumerate(row[2:]))
        rows.add_row(row[0], row[1], *("-" if n == "nan" else n for n in numbers))
    out.print(rows)
    short = summary(sheet)
    table = Table(*short.columns, box=box.SIMPLE_HEAD)
    for row in short.itertuples(index=False):
        table.add_row(*(str(value) for value in row))
    out.print(table)
