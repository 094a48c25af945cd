"""Obstacles that leave no straight lane of a short route free from start to goal."""

from __future__ import annotations

import itertools
import math
import zlib
from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Final, NamedTuple

import msgspec
import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import LineString, Point, Polygon

from cosim.core.errors import SpecError
from cosim.core.geometry import Floats, Polyline, wrap_angle
from cosim.core.state import PERSON_RADIUS_M
from cosim.place import overlay
from cosim.place.street_map import Lane, StreetMap, Strip
from cosim.spec.events import Event, EventKind
from cosim.spec.obstacle import OBSTACLE_FORMS, OBSTACLE_SIZES_M, Obstacle, footprint
from cosim.spec.robot import Robot, robot_called
from cosim.spec.scenario import Scenario
from physics.street.placement import driveway_ground
from scenarios.suites.obstacles import APART_M, AROUND_M, EDGE_M, Room, spans_m

LANES: Final = 9
"""Number of lanes parallel to a route, evenly spread over the walkable width."""
THINGS: Final = (2, 4)
"""Least and largest number of obstacles of a reactive scenario."""
ENDS_M: Final = 1.2
"""Least distance of obstacles from the outline of the robot at the start and from the goal, in
metres.
"""
EVENT_M: Final = 2.0
"""Least distance of obstacles from the place of an event on a sidewalk, in metres."""
_WAITING_M: Final = 0.3
"""Least distance of obstacles from people who wait for the event to begin, in metres."""
_MEETING_M: Final = (2.5, 4.0)
"""Length before and behind the place where the robot meets people who come towards it, in metres,
on which their side is clear of obstacles.
"""
_CROSSING_M: Final = 0.5
"""Least distance of obstacles from crossings, in metres."""
_AFTER_M: Final = 1.6
"""Least distance between two obstacles along the route, in metres."""
_DRAWS: Final = 40
_PLACES: Final = 20
_SHAPES: Final = 12
_ASKEW_RAD: Final = 0.15
_COVERS_M: Final = 0.03
"""Least overlap of an obstacle with a lane, in metres."""
_STEP_M: Final = 0.5
_WIDEST_M: Final = 6.0
"""Largest distance from the route that counts as its walkable width, in metres."""


class Lanes:
    """Lanes parallel to a straight route. width_m: width of the robot."""

    def __init__(self, route: Polyline, street_map: StreetMap, width_m: float) -> None:
        walkable = street_map.walkable_near(shapely.buffer(LineString(route.points), _WIDEST_M))
        right_m, left_m = walkable_width_m(route, walkable)
        half_m = 0.5 * width_m
        self.offsets_m: Floats = np.linspace(half_m - right_m, left_m - half_m, LANES)
        self._width_m = width_m
        self._swept = [_swept(route, left_m, width_m) for left_m in self.offsets_m.tolist()]
        self._inside = shapely.covers(shapely.buffer(walkable, 1e-3), self._swept)

    def free(self, grounds: Sequence[Polygon]) -> NDArray[np.bool_]:
        """Return which lanes (9,) are walkable and free of obstacles from start to goal."""
        whole = shapely.union_all([*grounds])
        found: NDArray[np.bool_] = self._inside & ~shapely.intersects(self._swept, whole)
        return found


def _swept(route: Polyline, left_m: float, width_m: float) -> Polygon:
    """Return the ground of a robot that drives straight, left_m beside the route."""
    ends = route.points[[0, -1]]
    along = (ends[1] - ends[0]) / np.hypot(*(ends[1] - ends[0]))
    line = LineString(ends + left_m * np.array([-along[1], along[0]]))
    return shapely.buffer(line, 0.5 * width_m, cap_style="flat")


def walkable_width_m(route: Polyline, walkable: shapely.Geometry) -> tuple[float, float]:
    """Return the walkable width to the right and left of a route: its medians, in metres."""
    at = [route.at(float(s_m)) for s_m in np.arange(0.25, route.length_m, _STEP_M)]
    found = []
    for side in (-1.0, 1.0):
        rays = [
            LineString(
                [
                    (x, y),
                    (x - side * _WIDEST_M * math.sin(on), y + side * _WIDEST_M * math.cos(on)),
                ]
            )
            for x, y, on in at
        ]
        starts = [Point(pose.xy) for pose in at]
        inside = shapely.intersection(rays, walkable)
        reached = [_reach_m(part, start) for part, start in zip(inside, starts, strict=True)]
        found.append(float(np.median(reached)))
    return found[0], found[1]


def _reach_m(inside: shapely.Geometry, start: Point) -> float:
    """Return the length of the part of a ray that begins at its start."""
    parts = shapely.get_parts(inside)
    return max((part.length for part in parts if part.distance(start) < 1e-6), default=0.0)


def free_lanes(scenario: Scenario, street_map: StreetMap) -> list[float]:
    """Return the offsets of the lanes of a scenario that obstacles leave free, left positive."""
    lanes = Lanes(scenario.route_line, street_map, robot_called(scenario.robot).width_m)
    free = lanes.free([footprint(one) for one in scenario.obstacles])
    return [float(left_m) for left_m in lanes.offsets_m[free]]


def with_lanes_blocked(scenario: Scenario, kind: EventKind, street_map: StreetMap) -> Scenario:
    """Return the scenario with 2 to 4 obstacles that leave no lane free.

    Its own obstacles are the fences of its event. A gap remains also beside people who stand, on
    either side. Raises SpecError if no such obstacles are found.
    """
    named = zlib.crc32(kind.name.encode())
    rng = np.random.default_rng([scenario.seed, scenario.place.seed, 0x1A7E, named])
    site = _Site(scenario, kind, street_map)
    if len(site.standing) > 1 and site.room.shares_way(scenario.obstacles, site.standing):
        raise SpecError("one way is free on both sides of the people")
    reason = "no obstacles block every lane"
    for _ in range(_DRAWS):
        if not (things := _drawn(site, scenario.obstacles, rng)):
            continue
        obstacles = (*scenario.obstacles, *things)
        if not site.room.keeps_resets(obstacles):
            reason = "obstacles cover two waypoints in a row"
        elif not all(site.room.passable(obstacles, people) for people in site.standing):
            reason = "no gap is left"
        else:
            return msgspec.structs.replace(scenario, obstacles=obstacles)
    raise SpecError(reason)


class _Site:
    """Ground of a reactive scenario on which obstacles may be placed."""

    def __init__(self, scenario: Scenario, kind: EventKind, street_map: StreetMap) -> None:
        self._scenario = scenario
        self._kind = kind
        self._street_map = street_map
        self.route = scenario.route_line
        self.robot = robot_called(scenario.robot)
        self.lanes = Lanes(self.route, street_map, self.robot.width_m)
        if not self.ground.area:
            raise SpecError("there is no ground for obstacles")

    @cached_property
    def room(self) -> Room:
        return Room(self._scenario, self._street_map)

    @cached_property
    def standing(self) -> list[list[shapely.Geometry]]:
        """Ground of the people who stand, for each free side."""
        (event,) = self._scenario.events
        blocks = event.free_side and self._kind.blocked is not None
        sides: tuple[int, ...] = (1, -1) if blocks else (event.free_side,)
        return [
            standing_ground(msgspec.structs.replace(event, free_side=side), self._kind)
            for side in sides
        ]

    @cached_property
    def ground(self) -> Polygon:
        """Walkable ground, clear of crossings, driveways, roads, furniture, ends and the event."""
        scenario, street_map = self._scenario, self._street_map
        area = shapely.buffer(LineString(scenario.route), AROUND_M)
        strips = [one for one in street_map.near("strip", area) if isinstance(one, Strip)]
        lanes = [one for one in street_map.near("lane", area) if isinstance(one, Lane)]
        start_m = ENDS_M + 0.5 * math.hypot(*self.robot.footprint_m)
        taken = [
            *(shapely.buffer(one.polygon, _CROSSING_M) for one in strips if one.kind == "crossing"),
            *(shapely.buffer(one.polygon, -EDGE_M) for one in lanes if one.kind == "road"),
            *(way for one in strips for way in driveway_ground(one)),
            *(shapely.buffer(prop, APART_M) for prop in self.room.props),
            shapely.buffer(Point(scenario.start[:2]), start_m),
            shapely.buffer(Point(scenario.goal), ENDS_M),
            *_event_ground(scenario.events[0], self._kind, self.robot),
        ]
        walkable = shapely.buffer(street_map.walkable_near(area), -EDGE_M)
        free: Polygon = overlay.difference(walkable, overlay.union_all(taken))
        shapely.prepare(free)
        return free


def _event_ground(event: Event, kind: EventKind, robot: Robot) -> Iterator[shapely.Geometry]:
    """Yield the ground that the people of an event need.

    Those who come towards the robot need the side to which they step aside in a decoy.
    """
    if kind.layout is not None and kind.layout.after_m < 0.0 and event.trigger_m is not None:
        share = event.speed_mps / (event.speed_mps + robot.cruise_mps)
        yield _beside(event, -share * event.trigger_m)
    for number in range(event.people):
        walker = kind.begin(event, number)
        yield shapely.buffer(Point(walker.x_m, walker.y_m), PERSON_RADIUS_M + _WAITING_M)
    if kind.layout is not None:
        yield shapely.buffer(Point(event.x_m, event.y_m), EVENT_M)


def _beside(event: Event, meets_m: float) -> shapely.Geometry:
    """Return the event's side of the way around a place along its heading."""
    cos, sin = math.cos(event.heading_rad), math.sin(event.heading_rad)
    ahead_m = meets_m - _MEETING_M[0], meets_m + _MEETING_M[1]
    aside_m = 0.0, event.side * event.half_width_m
    points = [
        (event.x_m + cos * on_m - sin * left_m, event.y_m + sin * on_m + cos * left_m)
        for on_m, left_m in itertools.product(ahead_m, aside_m)
    ]
    return shapely.MultiPoint(points).convex_hull


class _Shape(NamedTuple):
    """Kind, form and direction of an obstacle, with its extents along and across the route."""

    thing: Obstacle
    along_m: float
    across_m: float


def _drawn(
    site: _Site, fences: Sequence[Obstacle], rng: np.random.Generator
) -> tuple[Obstacle, ...]:
    """Draw obstacles one after another, each across the outermost lane that is still free.

    Returns none if they leave a lane free or do not fit.
    """
    count = max(int(rng.integers(THINGS[0], THINGS[1] + 1)) - len(fences), 1)
    grounds = [footprint(one) for one in fences]
    spans = [_span(site.route, ground) for ground in grounds]
    things: list[Obstacle] = []
    for left in range(count, 0, -1):
        free = np.flatnonzero(site.lanes.free(grounds))
        offsets = site.lanes.offsets_m[free] if len(free) else rng.choice(site.lanes.offsets_m, 1)
        shape = _drawn_shape(site, float(offsets[-1] - offsets[0]) / left, rng)
        side = 1.0 if rng.random() < 0.5 else -1.0
        outer_m = float(offsets[-1] if side > 0.0 else -offsets[0])
        covered_m = shape.across_m + site.robot.width_m
        to_spare_m = max(covered_m - float(offsets[-1] - offsets[0]) / left - _COVERS_M, _COVERS_M)
        over_m = float(rng.uniform(_COVERS_M, max(to_spare_m, 2.0 * _COVERS_M)))
        left_m = side * (outer_m + over_m - 0.5 * covered_m)
        placed = _placed(site, shape, left_m, spans, rng)
        if placed is None:
            return ()
        things.append(placed)
        grounds.append(footprint(placed))
        spans.append(_span(site.route, grounds[-1]))
    return () if site.lanes.free(grounds).any() else tuple(things)


def _drawn_shape(site: _Site, cover_m: float, rng: np.random.Generator) -> _Shape:
    """Draw an obstacle that covers lanes of a width; the widest of several draws if none does."""
    kinds = list(OBSTACLE_SIZES_M)
    found: list[_Shape] = []
    for _ in range(_SHAPES):
        kind = kinds[int(rng.integers(len(kinds)))]
        form = int(rng.integers(OBSTACLE_FORMS))
        turned_rad = float(rng.uniform(-_ASKEW_RAD, _ASKEW_RAD))
        turned_rad += 0.5 * math.pi * int(rng.integers(2))
        along_m, across_m = spans_m(kind, form, turned_rad)
        thing = Obstacle(kind=kind, x_m=0.0, y_m=0.0, heading_rad=turned_rad, form=form)
        found.append(_Shape(thing, along_m, across_m))
        if across_m + site.robot.width_m >= cover_m + 2.0 * _COVERS_M:
            return found[-1]
    return max(found, key=lambda shape: shape.across_m)


def _placed(
    site: _Site,
    shape: _Shape,
    left_m: float,
    spans: Sequence[tuple[float, float]],
    rng: np.random.Generator,
) -> Obstacle | None:
    """Place an obstacle at a drawn arc length, None if none of a few fits."""
    for s_m in rng.uniform(0.0, site.route.length_m, _PLACES).tolist():
        low_m, high_m = s_m - 0.5 * shape.along_m - _AFTER_M, s_m + 0.5 * shape.along_m + _AFTER_M
        if any(low_m < end_m and start_m < high_m for start_m, end_m in spans):
            continue
        x, y, along_rad = site.route.at(s_m)
        placed = msgspec.structs.replace(
            shape.thing,
            x_m=round(x - left_m * math.sin(along_rad), 3),
            y_m=round(y + left_m * math.cos(along_rad), 3),
            heading_rad=round(wrap_angle(along_rad + shape.thing.heading_rad), 4),
        )
        if site.ground.covers(footprint(placed)):
            return placed
    return None


def _span(route: Polyline, ground: Polygon) -> tuple[float, float]:
    """Return the arc lengths between which an obstacle lies beside a straight route."""
    ends = route.points[[0, -1]]
    along = (ends[1] - ends[0]) / np.hypot(*(ends[1] - ends[0]))
    s_m = (shapely.get_coordinates(ground) - ends[0]) @ along
    return float(s_m.min()), float(s_m.max())


def standing_ground(event: Event, kind: EventKind) -> list[shapely.Geometry]:
    """Return the ground that people of an event with a free side block; none for other events."""
    if kind.blocked is None or not event.free_side:
        return []
    right_m, left_m = kind.blocked(event)
    cos, sin = math.cos(event.heading_rad), math.sin(event.heading_rad)
    corners = itertools.product((-PERSON_RADIUS_M, PERSON_RADIUS_M), (right_m, left_m))
    points = [
        (event.x_m + cos * on_m - sin * aside_m, event.y_m + sin * on_m + cos * aside_m)
        for on_m, aside_m in corners
    ]
    return [shapely.MultiPoint(points).convex_hull]
