"""The command line of `cosim bench people`: our walkers beside people, table after table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from rich import box
from rich.table import Column, Table

from cosim.cli.terminal.consoles import out
from cosim.cli.terminal.fitted import print_fitted
from cosim.cli.terminal.progress import doing

if TYPE_CHECKING:
    from cosim.core.geometry import Floats
    from scenarios.bench.people.comparison import Comparison
    from scenarios.bench.people.observed import MeanSd

_NOTES = (
    "Density and speed by pedpy. Speed by density: everybody in a window of 2 x 3.2 m in the middle of a straight "
    "sidewalk that leads round a block, frame by frame; off: how many of the data's standard deviations ours lies "
    "beside its mean. Free speed: of each person while nobody is within 3 m, of those who walk so for 3 s. "
    "Nearest: that of our streets whose median is nearest, for how dense the films were is not known. Gaps: a "
    "marked crossing without signals, where vehicles yield; people and vehicles of each direction come every 10 s "
    "on the mean. How often they came in DUT, where nothing is marked, is not known: the low percentiles say "
    "most.",
    "Distances: of means and deviations the 2-Wasserstein distance between normal distributions that have them, "
    "of percentiles the 1-Wasserstein distance over those given, their mean difference.",
)


def bench_people(jobs: int) -> None:
    """Let the crowd walk on sidewalks and over a crossing and print it beside what was measured of people."""
    from scenarios.bench.people.comparison import watch_people

    with doing("watching people") as tell:
        found = watch_people(jobs, lambda words: tell(f"watching people: {words}"))
    for table in (_by_density(found), _free(found), _nearest(found), _gaps(found)):
        print_fitted(out, table)
    for note in _NOTES:
        out.print(note, highlight=False)


def _by_density(found: Comparison) -> Table:
    from scenarios.bench.people.measures import normal_distance
    from scenarios.bench.people.observed import DENSITY_EDGES, SPEED_BY_DENSITY_MPS

    table = _table("persons/m2", "HERMES", "one way", "dist.", "off, sd", "both ways", "dist.", "off, sd")
    table.title = "Speed by density, m/s"
    for k, data in enumerate(SPEED_BY_DENSITY_MPS):
        cells = []
        for ours, _ in (way[k] for way in found.by_density):
            off = (ours.mean - data.mean) / data.sd
            cells += [_spread(ours), f"{normal_distance(ours, data):.2f}", f"{off:+.1f}"]
        table.add_row(f"{DENSITY_EDGES[k]:g} to {DENSITY_EDGES[k + 1]:g}", _spread(data), *cells)
    person_s = [" ".join(f"{seconds:.0f}" for _, seconds in way) for way in found.by_density]
    table.caption = f"person-seconds: one way {person_s[0]}; both ways {person_s[1]}"
    return table


def _free(found: Comparison) -> Table:
    from scenarios.bench.people.measures import mean_sd, normal_distance
    from scenarios.bench.people.observed import FREE_SPEED_MPS

    ours = mean_sd(found.free_mps)
    table = _table("", "data", "ours", "dist.")
    table.title = "Free speed, m/s"
    for name, data in FREE_SPEED_MPS.items():
        table.add_row(name, _spread(data), _spread(ours), f"{normal_distance(ours, data):.2f}")
    return table


def _nearest(found: Comparison) -> Table:
    from scenarios.bench.people.comparison import GROUPS, alike
    from scenarios.bench.people.measures import percentile_distance
    from scenarios.bench.people.observed import NEAREST_M, NEAREST_PERCENT

    table = _table("", _percent(NEAREST_PERCENT), "ours", "dist.", "in groups", "persons/m2")
    table.title = "Nearest neighbour, m"
    for share in GROUPS:
        for name, data in NEAREST_M.items():
            flow, apart_m = alike([one for one in found.nearest if one.flow.groups == share], data[-1])
            far_m = percentile_distance(apart_m, NEAREST_PERCENT, data)
            ours = _percentiles(apart_m, NEAREST_PERCENT)
            table.add_row(name, _list(data), ours, f"{far_m:.2f}", f"{100 * share:.0f} %", f"{flow.density:g}")
    return table


def _gaps(found: Comparison) -> Table:
    from scenarios.bench.people.measures import percentile_distance
    from scenarios.bench.people.observed import (
        PERSON_FIRST_PERCENT,
        PERSON_FIRST_S,
        VEHICLE_FIRST_PERCENT,
        VEHICLE_FIRST_S,
    )

    table = _table("", "DUT", "ours", "dist.", "gaps")
    table.title = "Gaps at a crossing without signals (post-encroachment times), s"
    for name, percent, data, ours in (
        ("person first", PERSON_FIRST_PERCENT, PERSON_FIRST_S, found.person_first_s),
        ("vehicle first", VEHICLE_FIRST_PERCENT, VEHICLE_FIRST_S, found.vehicle_first_s),
    ):
        far_s = percentile_distance(ours, percent, data)
        cells = (_list(data), _percentiles(ours, percent), f"{far_s:.2f}", str(len(ours)))
        table.add_row(f"{name}: {_percent(percent)}", *cells)
    return table


def _table(first: str, *others: str) -> Table:
    heads = [Column(head, no_wrap=True, justify="right") for head in others]
    return Table(
        Column(first, no_wrap=True),
        *heads,
        box=box.SIMPLE_HEAD,
        padding=0,
        title_justify="left",
        caption_justify="left",
    )


def _spread(one: MeanSd) -> str:
    return f"{one.mean:.2f} ± {one.sd:.2f}"


def _percent(percent: Sequence[float]) -> str:
    return "/".join(f"{one:g}" for one in percent) + " %"


def _list(values: Sequence[float]) -> str:
    return " ".join(f"{value:.2f}" for value in values)


def _percentiles(values: Floats, percent: Sequence[float]) -> str:
    import numpy as np

    return _list(np.percentile(values, percent).tolist())
