"""Draw obstacles on the sidewalks of a route, with a gap for the robot that is proved.

Obstacles are at the house side, at the kerb, or on the middle of the route. They are never at
corners, crossings or driveways, nor near the start, the goal, events and furniture. Counts and
shares are decisions of this benchmark.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from typing import Final, Literal, NamedTuple

import msgspec
import numpy as np
import shapely
from shapely.geometry import LineString, MultiPolygon, Point, Polygon

from cosim.core.errors import SpecError
from cosim.core.geometry import Floats, Polyline, wrap_angle
from cosim.place import overlay
from cosim.place.barriers import outline, without_barriers
from cosim.place.street_map import Lane, StreetMap, Strip
from cosim.results.referee import FREE_OF_OBSTACLES_M, WAYPOINT_STEP_M
from cosim.spec.obstacle import (
    OBSTACLE_FORMS,
    OBSTACLE_VARIANTS,
    Obstacle,
    ObstacleKind,
    footprint,
    obstacle_size_m,
)
from cosim.spec.robot import Robot, robot_called
from cosim.spec.scenario import Scenario
from physics.street.furniture import footprints
from physics.street.placement import driveway_ground
from scenarios.places.nets import make_surface

PER_100M: Final = (4.0, 8.0)
"""Least and largest number of obstacles along 100 m of sidewalk. Each scenario draws its own
density. The fences of a construction site count as _SITE together.
"""
_SITE: Final = 2
TO_SPARE_M: Final = 0.5
"""Width of the gap at every obstacle in addition to the width of the robot, in metres."""
ENDS_FREE_M: Final = 2.0
"""Least distance of obstacles from the outline of the robot at the start and from the goal, in
metres.
"""
EVENT_FREE_M: Final = 5.0
"""Least distance of obstacles from the place of an event, in metres."""
BESIDE_FREE_M: Final = 1.0
"""Least distance of obstacles from the middle of the route if none may be in the way, in metres."""
_IN_THE_WAY: Final = 0.4
"""Share of the groups that are placed where a robot in the middle of the route hits them."""
_CORNER_FREE_M: Final = 2.0
_BEYOND_M: Final = 6.0
"""Length beyond the ends of the route along which obstacles are placed too, in metres."""
APART_M: Final = 0.2
"""Least distance between two groups, and between a group and other objects, in metres."""
EDGE_M: Final = 0.05
AROUND_M: Final = 8.0
"""Distance around the route in which a path is searched, in metres."""
_DRAWS: Final = 12
"""Number of draws for each obstacle."""

_Side = Literal["house", "kerb"]


class _Habit(NamedTuple):
    """Placement of one kind of obstacle.

    weight: relative frequency of its groups.
    group: smallest and largest size of a group.
    sides: possible sides of the sidewalk.
    turned_rad: angle from the direction of the street.
    askew_rad: largest random deviation from that angle.
    """

    weight: float
    group: tuple[int, int]
    sides: tuple[_Side, ...]
    turned_rad: float = 0.0
    askew_rad: float = 0.0


_HABITS: Final[dict[ObstacleKind, _Habit]] = {
    "bin": _Habit(3.0, (1, 3), ("house", "kerb"), math.pi / 2, 0.15),
    "bike": _Habit(2.0, (1, 2), ("house", "kerb"), 0.0, 0.12),
    "sign": _Habit(2.0, (1, 1), ("house", "kerb"), 0.0, 0.25),
    "planter": _Habit(1.5, (1, 2), ("house", "kerb"), 0.0, 0.03),
    "box": _Habit(1.5, (1, 2), ("house",), 0.0, 0.5),
    "fence": _Habit(1.5, (3, 4), ("house", "kerb")),
    "scooter": _Habit(2.0, (1, 2), ("house", "kerb"), 0.0, math.pi),
    "cafe": _Habit(1.5, (1, 2), ("house",), 0.0, 0.1),
}


class _Stretch(NamedTuple):
    """Part of a sidewalk along the route, from low_m to high_m of its line. The road is to the
    right.
    """

    line: Polyline
    half_m: float
    low_m: float
    high_m: float
    polygon: Polygon | MultiPolygon
    has_road: bool

    def put(
        self, kind: ObstacleKind, form: int, s_m: float, left_m: float, turned_rad: float
    ) -> Obstacle:
        """Return an obstacle at an arc length of the line and left_m to its left."""
        x, y, along = self.line.at(s_m)
        return Obstacle(
            kind=kind,
            x_m=round(x - left_m * math.sin(along), 3),
            y_m=round(y + left_m * math.cos(along), 3),
            heading_rad=round(wrap_angle(along + turned_rad), 4),
            form=form,
        )


def with_obstacles(
    scenario: Scenario,
    street_map: StreetMap,
    *,
    per_100m: float | None = None,
    beside: bool = False,
    to_spare_m: float = TO_SPARE_M,
) -> Scenario:
    """Return the scenario with obstacles, drawn from its seed and that of its place.

    See `obstacles_along`.
    """
    rng = np.random.default_rng([scenario.seed, scenario.place.seed, 0x0B57])
    obstacles = obstacles_along(
        scenario, street_map, rng, per_100m=per_100m, beside=beside, to_spare_m=to_spare_m
    )
    return msgspec.structs.replace(scenario, obstacles=obstacles)


def obstacles_along(
    scenario: Scenario,
    street_map: StreetMap,
    rng: np.random.Generator,
    *,
    per_100m: float | None = None,
    beside: bool = False,
    to_spare_m: float = TO_SPARE_M,
) -> tuple[Obstacle, ...]:
    """Draw obstacles for a scenario that has its route, crossings, barriers and events already.

    per_100m: obstacles along 100 m of its sidewalks; drawn from PER_100M if None.
    beside: place none within BESIDE_FREE_M of the middle of the route.
    to_spare_m: width of the gap in addition to the robot's.

    Returns the obstacles of the scenario and the drawn ones. Without `beside`, at least one is in
    the way if any fits there. None is added if the route is no wider than the gap.
    """
    density = float(rng.uniform(*PER_100M)) if per_100m is None else per_100m
    stretches = _stretches(scenario, street_map, _BEYOND_M if beside else 0.0)
    lengths = np.array([stretch.high_m - stretch.low_m for stretch in stretches])
    room = _Sites(scenario, street_map, beside=beside, to_spare_m=to_spare_m)
    standing = scenario.obstacles
    if not stretches or not room.passable(standing):
        return standing
    count = int(density * lengths.sum() / 100.0 + rng.random())
    count = count if beside else max(count, 1)
    counted = 0
    for draw in range(_DRAWS * count):
        if counted >= count:
            break
        first = not standing and draw < _DRAWS * count // 2
        in_the_way = not beside and (first or bool(rng.random() < _IN_THE_WAY))
        stretch = stretches[int(rng.choice(len(stretches), p=lengths / lengths.sum()))]
        group = _drawn_group(stretch, rng, room.gap_m, in_the_way=in_the_way)
        more = _counted(group)
        if more <= max(count - counted, _SITE) and room.takes(group, standing, stretch.polygon):
            standing += group
            counted += more
    return standing


def prove_gap(scenario: Scenario, street_map: StreetMap, to_spare_m: float = TO_SPARE_M) -> None:
    """Check that the robot fits past every obstacle.

    The obstacles are removed from the walkable area. The rest is eroded by half the width of the
    robot and to_spare_m. Raises SpecError unless start and goal stay connected.
    """
    room = Room(scenario, street_map, to_spare_m)
    if not room.passable(scenario.obstacles):
        what = "its obstacles leave" if scenario.obstacles else "there is"
        raise SpecError(
            f"scenario '{scenario.id}': {what} no gap of {room.gap_m:.2f} m between start and "
            "goal: move or remove obstacles in the narrowest place"
        )


class Room:
    """Ground around a route. gap_m: width of the gap that obstacles must leave.

    props: footprints of the furniture near the route.
    """

    def __init__(
        self, scenario: Scenario, street_map: StreetMap, to_spare_m: float = TO_SPARE_M
    ) -> None:
        robot = robot_called(scenario.robot)
        area = shapely.buffer(LineString(scenario.route), AROUND_M)
        self.gap_m = robot.width_m + to_spare_m
        self._width_m = robot.width_m
        self._start = Point(scenario.start[:2])
        self._goal = Point(scenario.goal)
        standing = footprints(make_surface(scenario.place, street_map).standing(area))
        self.props = [ground for ground in standing if area.intersects(ground)]
        walkable = without_barriers(street_map.walkable_near(area), scenario.barriers)
        self._free = overlay.difference(
            overlay.intersection(walkable, area), overlay.union_all(self.props)
        )
        self._waypoints = _Waypoints(scenario, robot)

    def keeps_resets(self, obstacles: Sequence[Obstacle]) -> bool:
        """Return whether each waypoint that obstacles cover has a free one next to it."""
        return self._waypoints.enough(obstacles)

    def passable(
        self, obstacles: Iterable[Obstacle], people: Iterable[shapely.Geometry] = ()
    ) -> bool:
        """Return whether a path as wide as the gap leads from start to goal.

        people: ground of people who stand.
        """
        free = self._free_ground(obstacles, people)
        return self._connects(shapely.buffer(free, -0.5 * self.gap_m))

    def shares_way(
        self, obstacles: Sequence[Obstacle], people: Iterable[Sequence[shapely.Geometry]]
    ) -> bool:
        """Return whether the robot can drive one way from start to goal among all groups of people.

        Each group is there in another episode.
        """
        half_m = 0.5 * self._width_m
        grounds = [shapely.buffer(self._free_ground(obstacles, group), -half_m) for group in people]
        common = grounds[0]
        for ground in grounds[1:]:
            common = overlay.intersection(common, ground)
        return self._connects(common)

    def _connects(self, ground: shapely.Geometry) -> bool:
        """Return whether one part of the ground has both start and goal."""
        parts = shapely.get_parts(ground)
        return any(part.covers(self._start) and part.covers(self._goal) for part in parts)

    def _free_ground(
        self, obstacles: Iterable[Obstacle], people: Iterable[shapely.Geometry] = ()
    ) -> Polygon | MultiPolygon:
        """Return the walkable ground without furniture, obstacles and people."""
        things = [*(footprint(one) for one in obstacles), *people]
        free: Polygon | MultiPolygon = self._free
        return overlay.difference(free, overlay.union_all(things)) if things else free


class _Sites(Room):
    """Room with the ground on which no obstacle of a route may be placed."""

    def __init__(
        self, scenario: Scenario, street_map: StreetMap, *, beside: bool, to_spare_m: float
    ) -> None:
        super().__init__(scenario, street_map, to_spare_m)
        robot = robot_called(scenario.robot)
        area = shapely.buffer(LineString(scenario.route), AROUND_M)
        fences = [outline(barrier) for barrier in scenario.barriers]
        taken = [shapely.buffer(thing, APART_M) for thing in (*self.props, *fences)]
        taken += _streets(street_map, area)
        taken += [shapely.buffer(self._start, ENDS_FREE_M + 0.5 * math.hypot(*robot.footprint_m))]
        taken += [shapely.buffer(self._goal, ENDS_FREE_M)]
        taken += [
            shapely.buffer(Point(event.x_m, event.y_m), EVENT_FREE_M) for event in scenario.events
        ]
        if beside:
            line = _extended(scenario.route_line)
            taken.append(shapely.buffer(line, BESIDE_FREE_M, cap_style="flat"))
        self._taken = shapely.STRtree(taken)

    def takes(
        self,
        group: Sequence[Obstacle],
        standing: Sequence[Obstacle],
        sidewalk: Polygon | MultiPolygon,
    ) -> bool:
        """Return whether a group fits on a sidewalk with all other obstacles and leaves a gap."""
        grounds = [footprint(one) for one in group]
        others = [footprint(one, APART_M) for one in standing]
        return (
            bool(group)
            and all(sidewalk.contains_properly(ground) for ground in grounds)
            and not len(self._taken.query(grounds, predicate="intersects")[0])
            and not any(ground.intersects(other) for ground in grounds for other in others)
            and not any(one.intersects(other) for one, other in itertools.combinations(grounds, 2))
            and self.keeps_resets((*standing, *group))
            and self.passable((*standing, *group))
        )


class _Waypoints:
    """Waypoints to which the referee may move the robot after a failure."""

    def __init__(self, scenario: Scenario, robot: Robot) -> None:
        route = scenario.route_line
        s_m = np.arange(
            0.0, max(route.length_m - 2 * scenario.goal_radius_m, 0.0) + 1e-9, WAYPOINT_STEP_M
        )
        self._at = shapely.points([route.at(s).xy for s in s_m.tolist()])
        self._reach_m = 0.5 * math.hypot(*robot.footprint_m) + FREE_OF_OBSTACLES_M
        self._usable = np.ones(len(s_m), dtype=bool)
        for crossing in scenario.crossings:
            over = (s_m > crossing.enter_s_m - robot.length_m / 2) & (
                s_m < crossing.leave_s_m + robot.length_m / 2
            )
            self._usable &= ~over

    def enough(self, obstacles: Sequence[Obstacle]) -> bool:
        """Return whether each waypoint that obstacles cover has a free one next to it."""
        ground = shapely.union_all([footprint(one) for one in obstacles])
        free = self._usable & (shapely.distance(self._at, ground) > self._reach_m)
        beside = np.concatenate([[False], free[:-1]]) | np.concatenate([free[1:], [False]])
        return bool((free | beside | ~self._usable).all())


def _drawn_group(
    stretch: _Stretch, rng: np.random.Generator, gap_m: float, *, in_the_way: bool
) -> tuple[Obstacle, ...]:
    """Draw a group of obstacles of one kind; empty if the sidewalk is too narrow for them."""
    kinds = list(_HABITS)
    weights = np.array([_HABITS[kind].weight for kind in kinds])
    kind = kinds[int(rng.choice(len(kinds), p=weights / weights.sum()))]
    habit = _HABITS[kind]
    side = habit.sides[int(rng.integers(len(habit.sides)))] if stretch.has_road else "house"
    left = 1.0 if side == "house" and (stretch.has_road or rng.random() < 0.5) else -1.0
    s_m = float(rng.uniform(stretch.low_m, stretch.high_m))
    form = int(rng.integers(OBSTACLE_FORMS))
    if kind == "fence":
        return _site(stretch, rng, left, s_m, form, gap_m)
    group: list[Obstacle] = []
    inner_m = float(rng.uniform(min(gap_m + 0.03 - stretch.half_m, 0.12), 0.12))
    for _ in range(int(rng.integers(habit.group[0], habit.group[1] + 1))):
        turned = habit.turned_rad + float(rng.uniform(-habit.askew_rad, habit.askew_rad))
        if kind != "bin":
            form = int(rng.integers(OBSTACLE_FORMS))
        along_m, across_m = spans_m(kind, form, turned)
        at_edge_m = stretch.half_m - EDGE_M - 0.5 * across_m - float(rng.uniform(0.0, 0.15))
        away_m = max(inner_m, -0.5 * across_m) + 0.5 * across_m if in_the_way else at_edge_m
        s_m += 0.5 * along_m if group else 0.0
        group.append(stretch.put(kind, form, s_m, left * min(away_m, at_edge_m), turned))
        s_m += 0.5 * along_m + float(rng.uniform(0.06, 0.25))
    return tuple(group)


def _site(
    stretch: _Stretch, rng: np.random.Generator, left: float, s_m: float, form: int, gap_m: float
) -> tuple[Obstacle, ...]:
    """Draw a construction site: fences around a piece of the sidewalk, half as wide if the gap
    permits.
    """
    paint = form - form % OBSTACLE_VARIANTS
    lengths = [obstacle_size_m("fence", variant)[0] for variant in range(OBSTACLE_VARIANTS)]
    depth_m = obstacle_size_m("fence", 0)[1]
    widest_m = min(stretch.half_m + 0.1, 2.0 * stretch.half_m - gap_m - depth_m - 2.0 * EDGE_M)
    fitting = [variant for variant, length in enumerate(lengths) if length <= widest_m]
    if not fitting:
        return ()
    wide_m = lengths[fitting[-1]]
    count = int(rng.integers(1, 3))
    outer_m = stretch.half_m - EDGE_M
    inner_m = outer_m - wide_m
    long_m = count * (lengths[-1] + 0.05)
    ends = [
        stretch.put("fence", paint + fitting[-1], s, left * (outer_m - 0.5 * wide_m), math.pi / 2)
        for s in (s_m, s_m + long_m + depth_m + 0.1)
    ]
    along = [
        stretch.put(
            "fence",
            paint + OBSTACLE_VARIANTS - 1,
            s_m + 0.5 * depth_m + 0.05 + (k + 0.5) * long_m / count,
            left * (inner_m - 0.5 * depth_m + 0.2),
            0.0,
        )
        for k in range(count)
    ]
    return (*ends, *along)


def _counted(group: Sequence[Obstacle]) -> int:
    return _SITE if group and group[0].kind == "fence" else len(group)


def spans_m(kind: ObstacleKind, form: int, turned_rad: float) -> tuple[float, float]:
    """Return the extent of an obstacle along the street and across it, in metres."""
    length, depth, _ = obstacle_size_m(kind, form % OBSTACLE_VARIANTS)
    cos, sin = abs(math.cos(turned_rad)), abs(math.sin(turned_rad))
    return cos * length + sin * depth, sin * length + cos * depth


def _stretches(scenario: Scenario, street_map: StreetMap, beyond_m: float) -> list[_Stretch]:
    """Return the parts of sidewalks along the route, with `beyond_m` more at either end."""
    route = scenario.route_line
    steps = route.resampled(1.0).points
    found: dict[str, list[float]] = {}
    for x_m, y_m in steps.tolist():
        strip = street_map.strips.get(street_map.locate(x_m, y_m, 0.05).edge)
        if strip is not None and strip.kind == "sidewalk" and strip.going == "plain":
            found.setdefault(strip.id, []).append(_oriented(strip).project(x_m, y_m)[0])
    stretches = []
    for name, at_m in found.items():
        strip = street_map.strips[name]
        line = _oriented(street_map.strips[name])
        low = min(at_m) - beyond_m
        high = max(at_m) + beyond_m
        low = max(low, _CORNER_FREE_M)
        high = min(high, line.length_m - _CORNER_FREE_M)
        if high - low > 1.0:
            stretches.append(
                _Stretch(line, 0.5 * strip.width_m, low, high, strip.polygon, strip.road_side != 0)
            )
    return stretches


def _oriented(strip: Strip) -> Polyline:
    """Return the middle line of a sidewalk with the road to its right."""
    line = strip.line[:, :2]
    return Polyline(line if strip.road_side <= 0 else line[::-1])


def _streets(street_map: StreetMap, area: Polygon) -> list[shapely.Geometry]:
    """Return where obstacles are forbidden: roads, driveways, and corners and crossings with the
    ground before them.
    """
    strips = [strip for strip in street_map.near("strip", area) if isinstance(strip, Strip)]
    lanes = [
        lane
        for lane in street_map.near("lane", area)
        if isinstance(lane, Lane) and lane.kind == "road"
    ]
    crossings = [strip.polygon for strip in strips if strip.kind == "crossing"]
    corners = [corner.polygon for corner in street_map.near("corner", area)]
    return [
        *(shapely.buffer(lane.polygon, -EDGE_M) for lane in lanes),
        *(shapely.buffer(piece, _CORNER_FREE_M) for piece in (*crossings, *corners)),
        *(way for strip in strips for way in driveway_ground(strip)),
    ]


def _extended(route: Polyline) -> LineString:
    """Return the route with _BEYOND_M more at either end, straight on."""
    ends = [(route.at(0.0), -_BEYOND_M), (route.at(route.length_m), _BEYOND_M)]
    first, last = (
        (p.x_m + d * math.cos(p.heading_rad), p.y_m + d * math.sin(p.heading_rad)) for p, d in ends
    )
    points: Floats = np.vstack([first, route.points, last])
    return LineString(points)
