"""Distances to people and times to collision, and places on a route."""

from __future__ import annotations

import math

import numpy as np
import pytest

from cosim.core.geometry import Polyline, Pose, box_disk_gap
from cosim.core.state import People, RobotState
from cosim.episode.loop import place_on_route
from cosim.results.log import Nearness, nearness, time_to_collision_s
from cosim.results.rejudge import places_on_route

FOOTPRINT = (0.7, 0.55)


def people(*rows: tuple[float, float, float, float]) -> People:
    """x, y, heading, speed of each."""
    x, y, heading, speed = np.array(rows, dtype=float).reshape(-1, 4).T
    names = tuple(f"p{i}" for i in range(len(rows)))
    return People.of(names, np.column_stack([x, y]), heading, speed, ("walk",) * len(rows))


def test_nobody_is_infinitely_far() -> None:
    """Without people there is neither distance nor time."""
    assert nearness(RobotState(Pose(0.0, 0.0, 0.0)), people(), FOOTPRINT) == Nearness(
        math.inf, math.inf, math.inf
    )


def test_two_who_drive_at_each_other_meet_halfway() -> None:
    """5 m apart at 1 m/s each, radii 0.35 and 0.3 m: 4.35 m at 2 m/s. The gap before the robot is
    4.35 m as well."""
    near = nearness(
        RobotState(Pose(0.0, 0.0, 0.0), v_mps=1.0), people((5.0, 0.0, math.pi, 1.0)), FOOTPRINT
    )
    assert near == pytest.approx((5.0, 4.35, 2.175))


def test_who_passes_aside_or_walks_away_is_never_met() -> None:
    """A person who passes aside, walks ahead at the same pace or is behind has no time to
    collision."""
    passing = people((5.0, 0.7, math.pi, 1.0), (3.0, 0.0, 0.0, 1.0), (-2.0, 0.0, 0.0, 0.0))
    near = nearness(RobotState(Pose(0.0, 0.0, 0.0), v_mps=1.0), passing, FOOTPRINT)
    assert (
        near.collision_in_s == math.inf
        and near.person_m == 2.0
        and near.clearance_m == pytest.approx(1.35)
    )


def test_the_gap_is_to_the_outline_not_to_the_nearest_centre() -> None:
    """One 0.75 m ahead is nearer to the bumper than one 0.7 m aside is to the flank."""
    near = nearness(
        RobotState(Pose(0.0, 0.0, 0.0)),
        people((0.75, 0.0, 0.0, 0.0), (0.0, 0.7, 0.0, 0.0)),
        FOOTPRINT,
    )
    assert near.person_m == 0.7 and near.clearance_m == pytest.approx(0.1)


def test_the_gap_is_the_least_of_all_gaps() -> None:
    """On random crowds, against every gap taken by itself; one that overlaps has none."""
    rng = np.random.default_rng(0)
    for _ in range(200):
        pose = Pose(*rng.uniform(-1.0, 1.0, 2), rng.uniform(-math.pi, math.pi))
        crowd = people(*((x, y, 0.0, 0.0) for x, y in rng.uniform(-4.0, 4.0, (6, 2))))
        gaps = box_disk_gap(np.array([pose]), 0.35, 0.275, crowd.xy[None]) - 0.3
        assert nearness(RobotState(pose), crowd, FOOTPRINT).clearance_m == pytest.approx(
            max(float(gaps.min()), 0.0)
        )


def test_at_the_time_that_is_told_they_touch() -> None:
    """On random ways: at that time the distance is the radius, and before it larger."""
    rng = np.random.default_rng(1)
    offset, velocity = rng.uniform(-5.0, 5.0, (500, 2)), rng.uniform(-2.0, 2.0, (500, 2))
    in_s = time_to_collision_s(offset, velocity, 0.65)
    meets = np.isfinite(in_s) & (in_s > 0.0)
    assert 20 < meets.sum() < 400
    for share, least in ((1.0, 0.65 - 1e-9), (0.5, 0.65)):
        at = offset[meets] + share * in_s[meets, None] * velocity[meets]
        assert (np.hypot(at[:, 0], at[:, 1]) >= least).all()
    never = ~np.isfinite(in_s)
    for t in np.linspace(0.0, 20.0, 400):
        assert (np.hypot(*(offset[never] + t * velocity[never]).T) > 0.65).all()


@pytest.mark.parametrize("spacing_m", [0.3, 1.0, 25.0])
def test_all_places_on_a_route_are_those_that_are_found_one_by_one(spacing_m: float) -> None:
    """To the bit: on a way that winds, comes back near itself and ends, from poses on it, off it
    and beyond it."""
    rng = np.random.default_rng(2)
    turns = np.cumsum(rng.normal(0.0, 0.4, 300))
    route = Polyline(np.cumsum(spacing_m * np.column_stack([np.cos(turns), np.sin(turns)]), axis=0))
    last_m = rng.uniform(-15.0, route.length_m + 15.0, 5000)
    at = np.array([route.at(s_m) for s_m in last_m.tolist()])
    pose = at + rng.normal(0.0, 1.0, at.shape) * rng.choice([0.0, 0.5, 8.0], len(at))[:, None]
    found = places_on_route(route, pose, last_m)
    one_by_one = [
        place_on_route(route, Pose(*p), s_m)
        for p, s_m in zip(pose.tolist(), last_m.tolist(), strict=True)
    ]
    assert found.tolist() == one_by_one
    assert places_on_route(route, pose[:0], last_m[:0]).shape == (0,)
