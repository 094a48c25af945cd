"""Obstacles: the shown crowd, people of events and injected people walk round them."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
import shapely
from shapely.geometry import Polygon, box

from cosim.core.geometry import Floats
from cosim.core.state import PERSON_RADIUS_M
from cosim.people.yielding import StandingObstacles, standing_obstacles
from cosim.spec.events import EventQuery, Walker
from cosim.spec.obstacle import OBSTACLE_SIZES_M, Obstacle, footprint
from scenarios.events.sight import Sight
from scenarios.events.walking import walk_on, walk_straight
from sumo_nets.crowd.shown_people import PoseFilter

DT_S = 0.05
SIDEWALK = box(-20.0, -1.6, 20.0, 1.6)
TOUCHES_M = 0.02


def standing(*obstacles: Obstacle, area: Polygon = SIDEWALK) -> StandingObstacles:
    return standing_obstacles(obstacles, area)


def obstacle_at(
    kind: str, x_m: float = 0.0, y_m: float = 0.0, heading_rad: float = 0.3, form: int = 2
) -> Obstacle:
    return Obstacle(kind=kind, x_m=x_m, y_m=y_m, heading_rad=heading_rad, form=form)


def shown_track(
    obstacle_list: StandingObstacles, y_m: float, east: bool, seconds: float = 9.0
) -> Floats:
    """Return the track (T, 2) of a person whom SUMO moves along x at y_m, straight through every
    obstacle."""
    poses = PoseFilter(DT_S, obstacle_list)
    x = np.arange(-5.0, -5.0 + 1.3 * seconds, 1.3 * DT_S) * (1 if east else -1)
    rows = [
        poses.update(
            ("c1",), np.array([[at, y_m]]), np.array([1.3]), lambda _: 0.0 if east else math.pi
        )[0][0]
        for at in x.tolist()
    ]
    return np.array(rows)


def gap_m(track: Floats, *obstacles: Obstacle) -> float:
    """Return the least distance of a person's disk on a track from the obstacles."""
    ground = shapely.union_all([footprint(one) for one in obstacles])
    return float(shapely.distance(shapely.points(track), ground).min()) - PERSON_RADIUS_M


def test_cached_distances_do_not_change_a_step() -> None:
    """Obstacles used before give the bits of new ones, also where the number of people changes."""
    rng = np.random.default_rng(3)
    places = rng.uniform(-15.0, 15.0, (12, 2)).tolist()
    ground = box(-40.0, -40.0, 40.0, 40.0)
    obstacles = [obstacle_at("bin", x_m, y_m) for x_m, y_m in places]
    used = standing(*obstacles, area=ground)
    changed = 0
    for count in (30, 45, 1, 45):
        at = rng.uniform(-20.0, 20.0, (count, 2))
        step = rng.normal(0.0, 0.06, (count, 2))
        for _ in range(60):
            step = np.where(rng.random((count, 1)) < 0.02, rng.normal(0.0, 0.06, step.shape), step)
            stand = rng.random(count) < 0.1
            new = StandingObstacles(used.bodies).stepped_around(at, at + step, stand)
            at, before = used.stepped_around(at, at + step, stand), at
            assert np.array_equal(at, new)
            changed += not np.array_equal(at, before + step)
    assert changed > 20


@pytest.mark.parametrize("kind", sorted(OBSTACLE_SIZES_M))
def test_the_crowd_walks_round_obstacles(kind: str) -> None:
    """From either side and any offset people pass the obstacle and return to their track."""
    obstacle = obstacle_at(kind)
    for y_m in (-0.5, -0.1, 0.0, 0.3):
        for east in (True, False):
            track = shown_track(standing(obstacle), y_m, east)
            assert gap_m(track, obstacle) > -TOUCHES_M
            assert track[-1] == pytest.approx([6.6 if east else -6.6, y_m], abs=0.1)
            assert np.hypot(*np.diff(track, axis=0).T).max() <= 0.12
    through = shown_track(StandingObstacles(), 0.0, True)
    assert gap_m(through, obstacle) < -0.2


def test_an_obstacle_at_the_edge_is_passed_on_the_other_side() -> None:
    """Along a wall, people pass a row of bins on the open side and stay on the sidewalk."""
    row = [obstacle_at("bin", 0.75 * k, 1.15, 1.57) for k in range(3)]
    obstacle_list = standing(*row)
    (body,) = obstacle_list.bodies
    assert (body.closed_x, body.closed_y) == pytest.approx((0.0, 1.0), abs=0.05)
    for east in (True, False):
        for y_m in (1.2, 1.0, 0.7):
            track = shown_track(obstacle_list, y_m, east)
            assert gap_m(track, *row) > -TOUCHES_M and track[:, 1].max() < 1.6
            assert abs(track[-1, 0]) > 6.0


def test_people_walk_between_obstacles_where_they_fit() -> None:
    """Obstacles a person's width or more apart are two bodies, nearer ones are one."""
    apart = standing(obstacle_at("bin", 0.0, -0.8, 0.0), obstacle_at("bin", 0.0, 0.95, 0.0))
    near = standing(obstacle_at("bin", 0.0, -0.6, 0.0), obstacle_at("bin", 0.0, 0.6, 0.0))
    assert len(apart.bodies) == 2 and len(near.bodies) == 1
    assert np.abs(shown_track(apart, 0.1, True)[:, 1]).max() < 0.35


def query_with(obstacle_list: StandingObstacles) -> EventQuery:
    """A query with the robot far away."""
    return EventQuery(
        episode="t",
        tick=0,
        tick_ms=50,
        robot_x_m=-90.0,
        robot_y_m=0.0,
        robot_heading_rad=0.0,
        robot_v_mps=0.0,
        robot_w_radps=0.0,
        route_s_m=0.0,
        robot_length_m=0.7,
        robot_width_m=0.55,
        events=(),
        standing=obstacle_list.bodies,
    )


@pytest.mark.parametrize("kind", ["bike", "cafe", "fence"])
@pytest.mark.parametrize("moves", [walk_on, walk_straight], ids=["walks", "presses"])
def test_directed_people_walk_round_obstacles_too(kind: str, moves: object) -> None:
    """People of events pass the obstacles in the query and walk on, and without them walk straight
    through."""
    obstacle = obstacle_at(kind, 0.0, 0.05, 1.3)
    for obstacle_list in (standing(obstacle), StandingObstacles()):
        walker = Walker(x_m=-3.0, y_m=0.0, heading_rad=0.0)
        track = []
        for _ in range(160):
            walker = moves(walker, 0.0, 1.3, Sight(query_with(obstacle_list)))  # type: ignore[operator]
            track.append((walker.x_m, walker.y_m))
        assert walker.x_m > 3.0
        assert (gap_m(np.array(track), obstacle) > -TOUCHES_M) == bool(obstacle_list.bodies)


def test_a_query_holds_only_nearby_obstacles() -> None:
    """Of two obstacles the one near a person is in the query, and it survives encoding."""
    obstacle_list = standing(obstacle_at("bin", 0.0), obstacle_at("planter", 12.0))
    (near,) = obstacle_list.near(np.array([[0.8, 0.0], [5.0, 0.0]]))
    query = msgspec.structs.replace(query_with(obstacle_list), standing=(near,))
    assert (near.x_m, near.y_m) == pytest.approx((0.0, 0.0))
    assert msgspec.json.decode(msgspec.json.encode(query), type=EventQuery) == query
    assert (
        obstacle_list.near(np.array([[5.0, 0.0]])) == ()
        and obstacle_list.near(np.zeros((0, 2))) == ()
    )
