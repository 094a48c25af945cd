"""Our walkers beside people: everything that `cosim bench people` shows."""

from __future__ import annotations

import multiprocessing
from typing import Final, NamedTuple

import numpy as np

from cosim.core.geometry import Floats
from cosim.core.progress import Progress
from cosim.core.state import PERSON_RADIUS_M
from scenarios.tools.bench.people.measures import (
    FRAMES_HZ,
    encroachments_s,
    free_speeds,
    in_bins,
    nearest_m,
    need_pedpy,
    on_ground,
    speeds_by_density,
)
from scenarios.tools.bench.people.observed import DENSITY_EDGES, MeanSd
from scenarios.tools.bench.people.walking import Flow, walk_across, walk_round

DENSITIES: Final = (0.25, 0.75, 1.25, 1.75, 2.25, 2.75)
"""Of the rings, persons per m2; what counts is the density in the window, moment by moment."""

LOOSE: Final = (0.05, 0.1, 0.15, 0.2, 0.3)
"""Of the rings on which nearest neighbours are looked for."""

GROUPS: Final = (0.0, 0.7)
"""Shares of those who walk in groups: as the suites have it, and as streets have it (see
`group_sampling`)."""

_WALK_S: Final = 40.0
_CROSS_S: Final = 1200.0
_FREE_M = 3.0
_FREE_S = 3.0
_FREE: Final = Flow(0.05, both_ways=False)
_FREE_SEEDS: Final = 4


class Nearest(NamedTuple):
    """Nearest neighbours (K,) in metres on the ring with this flow."""

    flow: Flow
    apart_m: Floats


class Comparison(NamedTuple):
    """What our walkers do.

    by_density: for each interval of DENSITY_EDGES the speed, m/s, and the person-seconds of it, one
    way and both ways. free_mps: the speed of each person walking alone. nearest: of each loose
    ring. person_first_s, vehicle_first_s: post-encroachment times. vehicles, people: how many came
    to the crossing.
    """

    by_density: tuple[list[tuple[MeanSd, float]], list[tuple[MeanSd, float]]]
    free_mps: Floats
    nearest: list[Nearest]
    person_first_s: Floats
    vehicle_first_s: Floats
    people: int
    vehicles: int


def watch_people(
    jobs: int, progress: Progress, walk_s: float = _WALK_S, cross_s: float = _CROSS_S
) -> Comparison:
    """Let people walk on every street, in so many processes. progress: receives how far it is."""
    need_pedpy()
    dense = [
        Flow(density, both_ways) for both_ways in (False, True) for density in reversed(DENSITIES)
    ]
    loose = [Flow(density, both_ways=True, groups=groups) for groups in GROUPS for density in LOOSE]
    with multiprocessing.get_context("spawn").Pool(jobs, maxtasksperchild=1) as pool:
        crossing = pool.apply_async(_crossing, (cross_s, 0))
        walking = [pool.apply_async(_density_speed, (flow, walk_s, 0)) for flow in dense]
        near = [pool.apply_async(_nearest, (flow, walk_s, 0)) for flow in loose]
        free = [pool.apply_async(_free_mps, (_FREE, walk_s, seed)) for seed in range(_FREE_SEEDS)]
        found = []
        for k, one in enumerate(tasks := [*walking, *near, *free]):
            progress(f"watching people: street {k + 1} of {len(tasks)}")
            found.append(one.get())
        person_first_s, vehicle_first_s, people, vehicles = crossing.get()
    one_way = found[: len(DENSITIES)]
    both_ways = found[len(DENSITIES) : len(dense)]
    nearest = found[len(dense) :]
    return Comparison(
        (_binned(one_way), _binned(both_ways)),
        np.concatenate(nearest[len(loose) :]),
        [Nearest(flow, apart_m) for flow, apart_m in zip(loose, nearest, strict=False)],
        person_first_s,
        vehicle_first_s,
        people,
        vehicles,
    )


def alike(nearest: list[Nearest], median_m: float) -> Nearest:
    """That of the rings whose median is nearest to one."""
    return min(nearest, key=lambda one: abs(float(np.median(one.apart_m)) - median_m))


def _binned(found: list[Floats]) -> list[tuple[MeanSd, float]]:
    return [
        (speed, count / FRAMES_HZ) for speed, count in in_bins(np.concatenate(found), DENSITY_EDGES)
    ]


def _density_speed(flow: Flow, seconds: float, seed: int) -> Floats:
    ring, tracks = walk_round(flow, seconds, seed)
    return speeds_by_density(tracks, ring.windows())


def _nearest(flow: Flow, seconds: float, seed: int) -> Floats:
    ring, tracks = walk_round(flow, seconds, seed)
    return nearest_m(tracks)[on_ground(tracks, ring.straights())]


def _free_mps(flow: Flow, seconds: float, seed: int) -> Floats:
    return free_speeds(walk_round(flow, seconds, seed)[1], _FREE_M, _FREE_S)


def _crossing(seconds: float, seed: int) -> tuple[Floats, Floats, int, int]:
    people, vehicles = walk_across(seconds, seed)
    return *encroachments_s(people, vehicles, PERSON_RADIUS_M), len(people), len(vehicles)
