"""The measurement `cosim bench people`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from cosim.cli import tables
from cosim.cli.console import out
from cosim.cli.progress import doing

if TYPE_CHECKING:
    from cosim.core.geometry import Floats
    from scenarios.tools.bench.people import Comparison
    from scenarios.tools.bench.people_data import MeanSd

_NOTES = (
    "Density and speed by pedpy, frame by frame, in a window of 2 x 3.2 m in the middle of a "
    "straight sidewalk that leads round a block; off: difference of the means in standard "
    "deviations of the data. Free speed: of people who walk for 3 s without others within 3 m. "
    "Nearest: the simulated street with the nearest median, because the density in the films is "
    "not known. Gaps: a marked crossing without signals, where vehicles yield; people and "
    "vehicles of each direction arrive every 10 s on average. Their rates in DUT, which has no "
    "markings, are not known: the low percentiles say most.",
    "Distances: for means and deviations the 2-Wasserstein distance between normal "
    "distributions, for percentiles the 1-Wasserstein distance, their mean difference.",
)


def bench_people(jobs: int) -> None:
    """Measure the walking of the crowd, and print it next to measurements of people."""
    from scenarios.tools.bench.people import watch_people

    with doing("simulating people") as progress:
        found = watch_people(jobs, progress)
    _show_by_density(found)
    _show_free(found)
    _show_nearest(found)
    _show_following(found)
    _show_gaps(found)
    for note in _NOTES:
        out.print(note, highlight=False)


def _show_by_density(found: Comparison) -> None:
    from scenarios.tools.bench.people_data import DENSITY_EDGES, SPEED_BY_DENSITY_MPS
    from scenarios.tools.bench.people_tracks import normal_distance

    rows = []
    for k, data in enumerate(SPEED_BY_DENSITY_MPS):
        cells = []
        for ours, _ in (way[k] for way in found.by_density):
            off = (ours.mean - data.mean) / data.sd
            cells += [_spread(ours), f"{normal_distance(ours, data):.2f}", f"{off:+.1f}"]
        rows.append((f"{DENSITY_EDGES[k]:g} to {DENSITY_EDGES[k + 1]:g}", _spread(data), *cells))
    person_s = [" ".join(f"{seconds:.0f}" for _, seconds in way) for way in found.by_density]
    heads = ("HERMES", "one way", "dist.", "off, sd", "both ways", "dist.", "off, sd")
    note = f"person-seconds: one way {person_s[0]}; both ways {person_s[1]}"
    columns = [*tables.names("persons/m2"), *tables.figures(*heads)]
    tables.show(out, columns, rows, title="Speed by density, m/s", note=note)


def _show_free(found: Comparison) -> None:
    from scenarios.tools.bench.people_data import FREE_SPEED_MPS
    from scenarios.tools.bench.people_tracks import mean_sd, normal_distance

    ours = mean_sd(found.free_mps)
    rows = [
        (name, _spread(data), _spread(ours), f"{normal_distance(ours, data):.2f}")
        for name, data in FREE_SPEED_MPS.items()
    ]
    columns = [*tables.names(""), *tables.figures("data", "ours", "dist.")]
    tables.show(out, columns, rows, title="Free speed, m/s")


def _show_nearest(found: Comparison) -> None:
    from scenarios.tools.bench.people import GROUPS, ring_with_median
    from scenarios.tools.bench.people_data import NEAREST_M, NEAREST_PERCENT
    from scenarios.tools.bench.people_tracks import percentile_distance

    rows = []
    for share in GROUPS:
        for name, data in NEAREST_M.items():
            flow, apart_m = ring_with_median(
                [one for one in found.nearest if one.flow.groups == share], data[-1]
            )
            far_m = percentile_distance(apart_m, NEAREST_PERCENT, data)
            ours = _percentiles(apart_m, NEAREST_PERCENT)
            numbers = (f"{far_m:.2f}", f"{100 * share:.0f} %", f"{flow.density:g}")
            rows.append((name, _list(data), ours, *numbers))
    heads = (_percent(NEAREST_PERCENT), "ours", "dist.", "in groups", "persons/m2")
    columns = [*tables.names(""), *tables.figures(*heads)]
    tables.show(out, columns, rows, title="Nearest neighbour, m")


def _show_following(found: Comparison) -> None:
    from scenarios.tools.bench.people import FOLLOWED, FOLLOWING_BIN_M, largest_share
    from scenarios.tools.bench.people_tracks import mean_sd

    out.print(
        f"People that follow each other within 2 m, at {FOLLOWED.density:g} persons/m2 in one "
        f"direction: {_spread(mean_sd(found.following_m))} m apart; at most "
        f"{largest_share(found.following_m):.1%} within {100 * FOLLOWING_BIN_M:g} cm.",
        highlight=False,
    )


def _show_gaps(found: Comparison) -> None:
    from scenarios.tools.bench.people_data import (
        PERSON_FIRST_PERCENT,
        PERSON_FIRST_S,
        VEHICLE_FIRST_PERCENT,
        VEHICLE_FIRST_S,
    )
    from scenarios.tools.bench.people_tracks import percentile_distance

    rows = []
    for name, percent, data, ours in (
        ("person first", PERSON_FIRST_PERCENT, PERSON_FIRST_S, found.person_first_s),
        ("vehicle first", VEHICLE_FIRST_PERCENT, VEHICLE_FIRST_S, found.vehicle_first_s),
    ):
        far_s = percentile_distance(ours, percent, data)
        cells = (_list(data), _percentiles(ours, percent), f"{far_s:.2f}", str(len(ours)))
        rows.append((f"{name}: {_percent(percent)}", *cells))
    title = "Gaps at a crossing without signals (post-encroachment times), s"
    columns = [*tables.names(""), *tables.figures("DUT", "ours", "dist.", "gaps")]
    tables.show(out, columns, rows, title=title)


def _spread(one: MeanSd) -> str:
    return f"{one.mean:.2f} ± {one.sd:.2f}"


def _percent(percent: Sequence[float]) -> str:
    return "/".join(f"{one:g}" for one in percent) + " %"


def _list(values: Sequence[float]) -> str:
    return " ".join(f"{value:.2f}" for value in values)


def _percentiles(values: Floats, percent: Sequence[float]) -> str:
    import numpy as np

    return _list(np.percentile(values, percent).tolist())
