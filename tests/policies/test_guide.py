"""Obstacles on the way: the clearance, the line led round them, and the oracle driven past them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
import shapely
from shapely import affinity
from shapely.geometry import LineString, MultiPolygon, Point, Polygon, box
from shapely.geometry.base import BaseGeometry

from cosim.core.geometry import Floats, Polyline, Pose
from cosim.core.state import NO_PEOPLE, NO_VEHICLES, Command, People, RobotState
from cosim.episode.interfaces import Observation, Privileged
from cosim.policies.privileged.orca import Orca
from cosim.policies.privileged.route_planner import DistanceField, RoutePlanner
from cosim.spec.robot import COURIER

GAP_M = COURIER.width_m + 0.5
"""Width in metres that remains free next to every obstacle."""


@dataclass(frozen=True)
class Course:
    """A walkway about a route with its obstacles, and where the robot's centre may be."""

    walk: Polygon
    route: Polyline
    solid: BaseGeometry

    @property
    def free(self) -> Polygon | MultiPolygon:
        return shapely.buffer(shapely.difference(self.walk, self.solid), -COURIER.width_m / 2)


def straight(*obstacles: Polygon, width_m: float = 3.0) -> Course:
    """A straight route of 20 m along the x axis."""
    route = Polyline([(0.0, 0.0), (20.0, 0.0)])
    return Course(
        box(-1.0, -width_m / 2, 21.0, width_m / 2), route, shapely.union_all(list(obstacles))
    )


def drawn(seed: int) -> Course:
    """25 m of a winding walkway with an obstacle every few metres, half of them in the middle, and
    GAP_M free."""
    random = np.random.default_rng(seed)
    width_m, radius_m = random.uniform(2.4, 4.0), random.uniform(8.0, 30.0)
    turn = np.linspace(0.0, 25.0 / radius_m, 60)
    route = Polyline(radius_m * np.column_stack([np.sin(turn), 1.0 - np.cos(turn)]))
    walk = LineString(route.points).buffer(width_m / 2, cap_style="square")
    solid: list[Polygon] = []
    for s_m in np.arange(4.0, 22.0, 1.5):
        at = route.at(s_m)
        aside_m = random.choice([random.normal(0.0, 0.2), random.uniform(-1.0, 1.0) * width_m / 2])
        length_m, depth_m = random.choice([(0.4, 0.4), (0.6, 1.8), (1.0, 0.5)])
        thing = affinity.rotate(
            box(-length_m / 2, -depth_m / 2, length_m / 2, depth_m / 2), random.uniform(0.0, 180.0)
        )
        x_m = at.x_m - aside_m * math.sin(at.heading_rad)
        y_m = at.y_m + aside_m * math.cos(at.heading_rad)
        more = [*solid, affinity.translate(thing, x_m, y_m)]
        if passable(walk, shapely.union_all(more), route):
            solid = more
    return Course(walk, route, shapely.union_all(solid))


def passable(walk: Polygon, solid: BaseGeometry, route: Polyline) -> bool:
    """Return whether a disk of diameter GAP_M gets from the start to the goal's radius."""
    room = shapely.buffer(shapely.difference(walk, solid), -GAP_M / 2)
    start = Point(route.points[0])
    goal = Point(route.points[-1])
    return any(part.covers(start) and part.distance(goal) < 0.1 for part in shapely.get_parts(room))


def driven(
    course: Course, pose: Pose, jump: tuple[float, Pose] | None = None, people: People = NO_PEOPLE
) -> Floats:
    """Return (N, 3) x, y, heading of the oracle every 0.05 s to the goal or 60 s; `jump` resets it
    once at a route place."""
    oracle = Orca()
    free = course.free
    route = course.route
    oracle.reset("", 0)
    period = round(20 / oracle.manifest.rate_hz)
    v = 0.0
    w = 0.0
    s_m = 0.0
    command = Command(0.0, 0.0)
    track = []
    for tick in range(1200):
        if jump is not None and s_m > jump[0]:
            pose = jump[1]
            jump = None
            v = 0.0
            w = 0.0
            s_m = route.project(pose.x_m, pose.y_m)[0]
        if tick % period == 0:
            s_m = route.project(pose.x_m, pose.y_m, (s_m - 2.0, s_m + 2.0))[0]
            known = Privileged(
                RobotState(pose, v, w), route, s_m, people, NO_VEHICLES, {}, (), free
            )
            command = oracle.act(Observation(tick, 0.05 * tick, None, v, w, COURIER, known))
        v += float(np.clip(command.v_mps - v, -0.1, 0.1))
        w += float(np.clip(np.clip(command.w_radps, -0.65, 0.65) - w, -0.15, 0.15))
        heading = pose.heading_rad + 0.05 * w
        pose = Pose(
            pose.x_m + 0.05 * v * math.cos(heading),
            pose.y_m + 0.05 * v * math.sin(heading),
            heading,
        )
        track.append(pose)
        if math.dist(pose[:2], route.points[-1]) < 1.0:
            break
    return np.array(track)


def bodies(track: Floats) -> list[Polygon]:
    """Return the robot's outline at each pose."""
    length, width = COURIER.footprint_m
    outline = box(-length / 2, -width / 2, length / 2, width / 2)
    return [
        affinity.translate(
            affinity.rotate(outline, heading, origin=(0.0, 0.0), use_radians=True), x, y
        )
        for x, y, heading in track
    ]


def test_clearance_is_the_distance_to_the_edge() -> None:
    """It is exact to 3 cm along straight edges, positive on free ground alone, and never positive
    far from the route."""
    course = straight(box(8.0, -0.5, 9.0, 0.5))
    clearance = DistanceField(course.free, course.route)
    points = np.random.default_rng(0).uniform((0.5, -1.4), (19.5, 1.4), (2000, 2))
    exact = shapely.distance(course.free.boundary, shapely.points(points))
    exact = np.where(shapely.contains_xy(course.free, *points.T), exact, -exact)
    off = np.abs(clearance.at(points) - exact)
    assert np.quantile(off, 0.9) < 0.03 and off.max() < 0.1
    assert (clearance.at(np.array([[10.0, 9.0], [-40.0, 0.0], [400.0, 900.0]])) < 0.0).all()


def test_the_line_follows_the_route_and_passes_obstacles() -> None:
    """A box in the middle of 3 m leaves a gap of 1.05 m on its left, whose middle the line takes."""
    bare = straight()
    blocked = straight(box(9.0, -1.5, 10.0, 0.45))
    lines = [
        RoutePlanner(DistanceField(c.free, c.route), c.route).path_from(c.route.points[0])
        for c in (bare, blocked)
    ]
    assert np.abs(lines[0].points[:, 1]).max() < 0.1
    in_gap = lines[1].points[np.abs(lines[1].points[:, 0] - 9.5) < 0.4]
    assert in_gap[:, 1] == pytest.approx(0.975, abs=0.08)
    for line in lines:
        assert line.points[-1] == pytest.approx((20.0, 0.0))


@pytest.mark.parametrize("seed", range(8))
def test_the_oracle_passes_obstacles_on_its_way(seed: int) -> None:
    """Nothing is touched, the base centre stays on the walkway, the goal is reached at a walking
    pace or faster."""
    course = drawn(seed)
    assert len(shapely.get_parts(course.solid)) >= 3
    track = driven(course, course.route.at(0.0))
    assert math.dist(track[-1, :2], course.route.points[-1]) < 1.0 and len(track) < 20 * 25
    assert min(course.solid.distance(body) for body in bodies(track)) > 0.0
    assert shapely.contains_xy(course.walk, track[:, 0], track[:, 1]).all()


def test_a_reset_robot_is_led_from_its_new_place() -> None:
    """Reset to a place before an obstacle that it had passed, it passes the obstacle again."""
    course = straight(box(8.0, -1.5, 9.0, 0.45), box(12.0, -0.45, 13.0, 1.5))
    track = driven(course, Pose(0.0, 0.0, 0.0), jump=(10.5, Pose(6.9, -1.0, 0.0)))
    assert math.dist(track[-1, :2], course.route.points[-1]) < 1.0
    assert np.ptp(np.flatnonzero(np.hypot(*np.diff(track[:, :2], axis=0).T) > 1.0)) == 0
    assert min(course.solid.distance(body) for body in bodies(track)) > 0.0


def test_another_way_is_found_where_a_person_blocks_the_first() -> None:
    """The oracle passes through another gap."""
    course = straight(box(5.0, -1.1, 17.0, 0.8), width_m=4.6)
    person = People.of(("p0",), [(15.0, 1.55)], [0.0], [0.0], ("stand",))
    track = driven(course, Pose(0.0, 0.0, 0.0), people=person)
    assert math.dist(track[-1, :2], course.route.points[-1]) < 1.0
    assert min(body.distance(Point(15.0, 1.55)) for body in bodies(track)) > 0.3
    assert min(course.solid.distance(body) for body in bodies(track)) > 0.0


def test_a_robot_that_had_to_pass_the_goal_comes_back_to_it() -> None:
    """Two talkers just before the goal are passed at more than a metre from it, and behind them the
    robot turns round."""
    talkers = People.of(
        ("p0", "p1"), [(19.6, -0.15), (19.6, 1.3)], [0.0, 0.0], [0.0, 0.0], ("talk", "talk")
    )
    track = driven(straight(width_m=3.6), Pose(5.0, 0.0, 0.0), people=talkers)
    assert math.dist(track[-1, :2], (20.0, 0.0)) < 1.0
