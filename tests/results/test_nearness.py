"""Distances to people, times to collision, and places on a route."""

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
    """People given as x, y, heading and speed."""
    x, y, heading, speed = np.array(rows, dtype=float).reshape(-1, 4).T
    names = tuple(f"p{i}" for i in range(len(rows)))
    return People.of(names, np.column_stack([x, y]), heading, speed, ("walk",) * len(rows))


def test_without_people_distances_and_times_are_infinite() -> None:
    """Without people there is neither distance nor time."""
    assert nearness(RobotState(Pose(0.0, 0.0, 0.0)), people(), FOOTPRINT) == Nearness(
        math.inf, math.inf, math.inf
    )


def test_a_head_on_approach_meets_halfway() -> None:
    """5 m apart at 1 m/s each with radii 0.35 and 0.3 m, the gap is 4.35 m, closed at 2 m/s."""
    near = nearness(
        RobotState(Pose(0.0, 0.0, 0.0), v_mps=1.0), people((5.0, 0.0, math.pi, 1.0)), FOOTPRINT
    )
    assert near == pytest.approx((5.0, 4.35, 2.175))


def test_passing_and_leaving_people_have_no_time_to_collision() -> None:
    """So do people ahead at the same pace, and those behind."""
    passing = people((5.0, 0.7, math.pi, 1.0), (3.0, 0.0, 0.0, 1.0), (-2.0, 0.0, 0.0, 0.0))
    near = nearness(RobotState(Pose(0.0, 0.0, 0.0), v_mps=1.0), passing, FOOTPRINT)
    assert (
        near.collision_in_s == math.inf
        and near.person_m == 2.0
        and near.clearance_m == pytest.approx(1.35)
    )


def test_the_gap_is_to_the_outline_not_to_the_nearest_centre() -> None:
    """A person 0.75 m ahead is nearer to the bumper than one 0.7 m aside is to the flank."""
    near = nearness(
        RobotState(Pose(0.0, 0.0, 0.0)),
        people((0.75, 0.0, 0.0, 0.0), (0.0, 0.7, 0.0, 0.0)),
        FOOTPRINT,
    )
    assert near.person_m == 0.7 and near.clearance_m == pytest.approx(0.1)


def test_the_gap_is_the_least_of_all_gaps() -> None:
    """In random crowds it equals the least of the single gaps, and an overlap has none."""
    rng = np.random.default_rng(0)
    for _ in range(200):
        pose = Pose(*rng.uniform(-1.0, 1.0, 2), rng.uniform(-math.pi, math.pi))
        crowd = people(*((x, y, 0.0, 0.0) for x, y in rng.uniform(-4.0, 4.0, (6, 2))))
        gaps = box_disk_gap(np.array([pose]), 0.35, 0.275, crowd.xy[None]) - 0.3
        assert nearness(RobotState(pose), crowd, FOOTPRINT).clearance_m == pytest.approx(
            max(float(gaps.min()), 0.0)
        )


def test_bodies_touch_at_the_time_to_collision() -> None:
    """For random motions the distance at that time is the radius, and before it is larger."""
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
def test_places_on_a_route_as_an_array_equal_single_ones(spacing_m: float) -> None:
    """On a winding way that returns near itself they are equal to the bit for poses on, off and
    beyond it."""
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
