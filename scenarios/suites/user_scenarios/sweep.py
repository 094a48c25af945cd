"""Summary of a sweep: means of the episodes for each value of its fields, as a table and as
files.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import pandas as pd

from cosim.core.errors import unwritable
from cosim.core.files import write_atomic
from cosim.report.curves import DRAWN, draw_curves
from cosim.results.table import crashed_in, summary_of
from scenarios.suites.user_scenarios.read import OwnFile, label

SWEPT: Final = ("success", "spl", "route_completion", "failures_per_100m")
"""Metrics that are printed; the file has every metric."""


def summary_of_sweep(own: OwnFile, table: pd.DataFrame) -> pd.DataFrame:
    """Return a row for each metric at each value of the sweep, or combination of values.

    table: results of the run, one row per episode.

    The fields come first. `episodes`, `crashed` and `invalid` follow: how many scenarios were
    built, and how many of them crashed or are invalid. The other columns are those of `summary_of`.
    """
    fields = [axis.field for axis in own.axes]
    parts = []
    for at, ids in _grouped(own):
        rows = table[table["scenario"].isin(ids)]
        part = summary_of(rows).reset_index()
        for place, field in enumerate(fields):
            part.insert(place, field, [at[place]] * len(part))
        part.insert(len(fields), "episodes", len(ids))
        part.insert(len(fields) + 1, "crashed", crashed_in(rows))
        part.insert(len(fields) + 2, "invalid", int((rows["status"] == "invalid").sum()))
        parts.append(part)
    return pd.concat(parts, ignore_index=True)


def write_sweep(summary: pd.DataFrame, own: OwnFile, folder: Path) -> list[Path]:
    """Write sweep.csv and sweep.png into a folder, each whole or not at all. Raises MachineError;
    without the library that draws, the table is written all the same."""
    fields = [axis.field for axis in own.axes]
    files = []
    try:
        files.append(folder / "sweep.csv")
        write_atomic(files[-1], summary.to_csv(index=False).encode())
        picture = draw_curves(summary, fields, DRAWN, own.name)
        files.append(folder / "sweep.png")
        write_atomic(files[-1], picture)
    except OSError as error:
        raise unwritable(files[-1], error) from error
    return files


def _grouped(own: OwnFile) -> Sequence[tuple[tuple[Any, ...], set[str]]]:
    """Return the values and the scenarios of each combination, in the order of the file."""
    groups: dict[tuple[str, ...], tuple[tuple[Any, ...], set[str]]] = {}
    for variant in own.variants:
        values = tuple(
            value if isinstance(value, int | float) else label(value)
            for value in variant.at.values()
        )
        groups.setdefault(tuple(map(str, values)), (values, set()))[1].add(variant.id)
    return list(groups.values())
