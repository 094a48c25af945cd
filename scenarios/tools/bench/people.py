"""Measures how the simulated crowd walks, and compares it with people: `cosim bench people`."""

from __future__ import annotations

import multiprocessing
from typing import Final, NamedTuple

import numpy as np

from cosim.core.geometry import Floats
from cosim.core.progress import Progress
from cosim.core.state import PERSON_RADIUS_M
from scenarios.tools.bench.people_data import DENSITY_EDGES, MeanSd
from scenarios.tools.bench.people_streets import SETTLE_S, Flow, walk_across, walk_round
from scenarios.tools.bench.people_tracks import (
    FRAMES_HZ,
    encroachments_s,
    following_m,
    free_speeds,
    in_bins,
    nearest_m,
    need_pedpy,
    on_ground,
    speeds_by_density,
)

FOLLOWING_M: Final = 2.0
"""Largest distance of a person that follows another, metres."""
FOLLOWING_BIN_M: Final = 0.02
"""Width of the intervals in which following distances are counted, metres."""
DENSITIES: Final = (0.25, 0.75, 1.25, 1.75, 2.25, 2.75)
"""Densities of the rings, persons per m2; speeds are sorted by the density in the window at each
moment."""
LOOSE: Final = (0.05, 0.1, 0.15, 0.2, 0.3)
"""Densities of the rings on which nearest neighbours are measured, persons per m2."""
GROUPS: Final = (0.0, 0.7)
"""Shares of people in groups: that of the suites, and that of real streets (`group_sampling`)."""
_WALK_S: Final = 40.0
_CROSS_S: Final = 1200.0
_FREE_M: Final = 3.0
"""Distance to the nearest other from which a person walks alone, metres."""
_FREE_S: Final = 3.0
"""Least time alone of a person whose free speed counts, seconds."""
_FREE_SEEDS: Final = 4
_FREE: Final = Flow(0.05, both_ways=False)
FOLLOWED: Final = Flow(0.2, both_ways=False)
"""Ring on which the distances of people that follow each other are measured."""


class Nearest(NamedTuple):
    """Nearest neighbours (K,) in metres on the ring with this flow."""

    flow: Flow
    apart_m: Floats


class Comparison(NamedTuple):
    """Measurements of the simulated walkers.

    by_density: one way and both ways: for each interval of DENSITY_EDGES speed, m/s, and
        person-seconds
    free_mps: speed of each person walking alone
    nearest: one of each loose ring
    following_m: (K,) distances to the nearest person ahead, below FOLLOWING_M, on FOLLOWED
    person_first_s, vehicle_first_s: post-encroachment times
    """

    by_density: tuple[list[tuple[MeanSd, float]], list[tuple[MeanSd, float]]]
    free_mps: Floats
    nearest: list[Nearest]
    following_m: Floats
    person_first_s: Floats
    vehicle_first_s: Floats


def watch_people(jobs: int, progress: Progress) -> Comparison:
    """Simulate people on every street, in `jobs` processes.

    progress: receives the stage
    """
    need_pedpy()
    dense = [
        Flow(density, both_ways) for both_ways in (False, True) for density in reversed(DENSITIES)
    ]
    loose = [Flow(density, both_ways=True, groups=groups) for groups in GROUPS for density in LOOSE]
    with multiprocessing.get_context("spawn").Pool(jobs, maxtasksperchild=1) as pool:
        crossing = pool.apply_async(_crossing, (_CROSS_S, 0))
        walking = [pool.apply_async(_density_speed, (flow, _WALK_S, 0)) for flow in dense]
        near = [pool.apply_async(_nearest, (flow, _WALK_S, 0)) for flow in loose]
        free = [pool.apply_async(_free_mps, (_FREE, _WALK_S, seed)) for seed in range(_FREE_SEEDS)]
        following = pool.apply_async(follow, (FOLLOWED, _WALK_S, 0))
        found = []
        for k, one in enumerate(tasks := [*walking, *near, *free]):
            progress(f"simulating people: street {k + 1} of {len(tasks)}")
            found.append(one.get())
        person_first_s, vehicle_first_s = crossing.get()
        behind_m = following.get()
    one_way = found[: len(DENSITIES)]
    both_ways = found[len(DENSITIES) : len(dense)]
    nearest = found[len(dense) :]
    return Comparison(
        (_binned(one_way), _binned(both_ways)),
        np.concatenate(nearest[len(loose) :]),
        [Nearest(flow, apart_m) for flow, apart_m in zip(loose, nearest, strict=False)],
        behind_m,
        person_first_s,
        vehicle_first_s,
    )


def ring_with_median(nearest: list[Nearest], median_m: float) -> Nearest:
    """Return the ring whose median is nearest to `median_m`."""
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


def follow(flow: Flow, seconds: float, seed: int, settle_s: float = SETTLE_S) -> Floats:
    """Return (K,) the distances below FOLLOWING_M to people ahead on straight sidewalks, metres."""
    ring, tracks = walk_round(flow, seconds, seed, settle_s)
    apart_m = following_m(tracks)[on_ground(tracks, ring.straights())]
    return apart_m[apart_m < FOLLOWING_M]


def largest_share(near_m: Floats) -> float:
    """Return the share of distances in their most frequent interval of FOLLOWING_BIN_M."""
    counts, _ = np.histogram(near_m, np.arange(0.0, FOLLOWING_M, FOLLOWING_BIN_M))
    return float(counts.max() / len(near_m))


def _free_mps(flow: Flow, seconds: float, seed: int) -> Floats:
    return free_speeds(walk_round(flow, seconds, seed)[1], _FREE_M, _FREE_S)


def _crossing(seconds: float, seed: int) -> tuple[Floats, Floats]:
    return encroachments_s(*walk_across(seconds, seed), PERSON_RADIUS_M)
