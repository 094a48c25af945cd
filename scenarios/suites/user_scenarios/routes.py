"""Route of a user scenario: drawn, found between two points, or given."""

from __future__ import annotations

import itertools
import math
from typing import Final, NamedTuple, cast

import msgspec
import numpy as np
import shapely
from shapely.geometry import LineString, Point

from cosim.core.errors import SpecError
from cosim.core.geometry import Floats, Polyline
from cosim.place.route_line import way_line
from cosim.place.street_map import Port, StreetMap, Strip
from cosim.place.walk_graph import walk_graph_of
from cosim.spec.robot import Robot
from cosim.spec.scenario import Barrier, Place, RouteCrossing, Scenario
from scenarios.suites.crossings import build_all
from scenarios.suites.drawing import bare_scenario
from scenarios.suites.long_horizon import (
    WAY_SPARE_M,
    build_long_horizon,
    fences_along,
    route_crossings,
)
from scenarios.suites.unit import Structure, build_unit
from scenarios.suites.user_scenarios.format import OwnWay, PointXY

_NEAREST_M: Final = 8.0
"""Largest distance between a start or goal and the sidewalk to which it is moved, in metres."""
_END_M: Final = 0.5
"""Least distance of a start or goal from the ends of its sidewalk, in metres."""
_EXACT_M: Final = 0.05
_REDRAWN: Final = 20
"""Largest number of ways that are drawn to find one with signals, or without, as requested."""
_ANOTHER: Final = 1_000_003
"""Difference between the seeds of consecutive draws."""


class _Spot(NamedTuple):
    """Place on the middle of a sidewalk."""

    strip: Strip
    s_m: float

    def from_port(self, port: Port) -> float:
        """Return the distance from an end of the strip, in metres."""
        return self.s_m if port.end == 0 else self.strip.length_m - self.s_m


def build_way(
    way: OwnWay, where: Place, street_map: StreetMap, seed: int, robot: Robot
) -> Scenario:
    """Build a scenario along the way with only its fences. Raises CosimError if no such way
    exists.
    """
    if way.kind is not None:
        return _drawn(way, where, street_map, seed, robot)
    barriers: tuple[Barrier, ...] = ()
    if way.route:
        route = Polyline(way.route)
        crossings = _crossed(street_map, route)
    else:
        route, crossings, barriers = _between(way, street_map, robot)
    if not _has_wanted_signals(way, crossings):
        raise SpecError(
            f"way signals '{way.signals}': it leads over {_crossings_in_words(crossings)}"
        )
    bare = _bare(route, crossings, where, street_map, seed, robot)
    return msgspec.structs.replace(bare, barriers=barriers)


def _bare(
    route: Polyline,
    crossings: tuple[RouteCrossing, ...],
    where: Place,
    street_map: StreetMap,
    seed: int,
    robot: Robot,
) -> Scenario:
    return bare_scenario(
        route,
        crossings,
        where,
        street_map,
        suite="own",
        seed=seed,
        scenario_id="own",
        time_limit_s=60.0,
        robot=robot,
    )


def _drawn(way: OwnWay, where: Place, street_map: StreetMap, seed: int, robot: Robot) -> Scenario:
    """Draw a way of a kind with the builders of the suites. Raises CosimError if no draw
    succeeds.
    """
    graph = walk_graph_of(street_map)
    if way.kind == "crosswalk" and way.signals == "with":
        (found,) = build_all(where, street_map, graph, seed, 1)
        return msgspec.structs.replace(found, seed=seed, robot=robot.name, structure="crosswalk")
    if way.kind != "route":
        spans = (
            {}
            if way.length_m is None
            else {"way_m": (way.length_m - _EXACT_M, way.length_m + _EXACT_M)}
        )
        kind = cast(Structure, way.kind)
        short = build_unit(kind, where, street_map, graph, seed, "own", robot, **spans)
        return msgspec.structs.replace(short, obstacles=(), ends_on_failure=False)
    if way.signals == "with" and not any(
        street_map.strips[name].signalised for name in graph.main_strips
    ):
        raise SpecError(
            f"way signals 'with': map '{street_map.name}' has no crossing with signals that "
            f"one can walk to"
        )
    for again in range(_REDRAWN):
        drawn = (seed + again * _ANOTHER) % 2**32
        long = build_long_horizon(
            where, street_map, graph, drawn, "own", robot, length_m=way.length_m
        )
        if _has_wanted_signals(way, long.crossings):
            return msgspec.structs.replace(long, obstacles=(), events=(), seed=seed)
    raise SpecError(
        f"way signals '{way.signals}': {_REDRAWN} ways that were drawn are not so: give "
        f"another seed, or start and goal"
    )


def _has_wanted_signals(way: OwnWay, crossings: tuple[RouteCrossing, ...]) -> bool:
    signals = any(crossing.signalised for crossing in crossings)
    return way.signals == "any" or signals == (way.signals == "with")


def _crossings_in_words(crossings: tuple[RouteCrossing, ...]) -> str:
    with_signals = sum(crossing.signalised for crossing in crossings)
    return f"{len(crossings)} crossings, {with_signals} of them with signals"


def _between(
    way: OwnWay, street_map: StreetMap, robot: Robot
) -> tuple[Polyline, tuple[RouteCrossing, ...], tuple[Barrier, ...]]:
    """Return the shortest way from start to goal over plain ground. Raises CosimError with a
    remedy.
    """
    assert way.start is not None and way.goal is not None
    spots = []
    faults = []
    for name, xy in (("start", way.start), ("goal", way.goal)):
        try:
            spots.append(_spot(street_map, name, xy))
        except SpecError as error:
            faults.append(str(error))
    if faults:
        raise SpecError("\n".join(faults))
    start, goal = spots
    if start.strip.id == goal.strip.id:
        route = _along_one(start, goal)
        ends = [Port(start.strip.id, 0)]
        return (
            route,
            (),
            fences_along(street_map, route, ends, _half_m(robot)) if way.fences else (),
        )
    ports = _shortest(street_map, start, goal, with_signals=way.signals != "without")
    first = ports[0]
    last = ports[-1]
    line = way_line(street_map, ports, start.from_port(first), goal.from_port(last))
    route = Polyline(np.round(line.points, 3))
    barriers = fences_along(street_map, route, ports, _half_m(robot)) if way.fences else ()
    return route, route_crossings(street_map, route, ports), barriers


def _half_m(robot: Robot) -> float:
    return robot.width_m / 2 + WAY_SPARE_M


def _along_one(start: _Spot, goal: _Spot) -> Polyline:
    """Return the way along one sidewalk."""
    line = Polyline(start.strip.line[:, :2])
    if abs(start.s_m - goal.s_m) < 1.0:
        raise SpecError(
            "way: start and goal are on one spot of the same sidewalk: put them farther apart"
        )
    steps = np.linspace(start.s_m, goal.s_m, max(round(abs(goal.s_m - start.s_m)), 1) + 1)
    return Polyline(np.round([line.at(float(s_m)).xy for s_m in steps], 3))


def _spot(street_map: StreetMap, name: str, xy: PointXY) -> _Spot:
    """Return the middle of the nearest sidewalk.

    Raises SpecError, with the nearest sidewalk, if it is too far.
    """
    strips = [
        strip
        for strip in street_map.strips.values()
        if strip.kind == "sidewalk" and strip.going == "plain" and strip.id not in street_map.steep
        if strip.length_m > 2.0 * _END_M
    ]
    if not strips:
        raise SpecError(f"map '{street_map.name}' has no sidewalk to start on")
    apart = shapely.distance(np.array([strip.polygon for strip in strips], dtype=object), Point(xy))
    nearest = strips[int(np.argmin(apart))]
    line = Polyline(nearest.line[:, :2])
    s_m = min(max(line.project(*xy)[0], _END_M), line.length_m - _END_M)
    if float(apart.min()) > _NEAREST_M:
        x_m, y_m, _ = line.at(s_m)
        raise SpecError(
            f"way.{name} ({xy[0]:g}, {xy[1]:g}) is {float(apart.min()):.0f} m from the nearest "
            f"sidewalk, on which ({x_m:.1f}, {y_m:.1f}) is the nearest place: `cosim scenario draw "
            "--whole` shows where one can walk"
        )
    return _Spot(nearest, s_m)


def _shortest(
    street_map: StreetMap, start: _Spot, goal: _Spot, *, with_signals: bool
) -> list[Port]:
    """Return the ports of the shortest way between two sidewalks, without stairs, bridges and steep
    land.

    Raises SpecError if no way exists.
    """
    barred = {strip.id for strip in street_map.strips.values() if strip.going != "plain"} - {
        start.strip.id
    }
    if not with_signals:
        barred |= {strip.id for strip in street_map.strips.values() if strip.signalised}
    shut = street_map.too_steep | {
        port for name in barred for port in (Port(name, 0), Port(name, 1))
    }
    graph = walk_graph_of(street_map)
    best_m = math.inf
    best: list[Port] = []
    for leave in (Port(start.strip.id, 0), Port(start.strip.id, 1)):
        reach = graph.reach(leave, frozenset(shut | {leave.other}))
        for enter in (Port(goal.strip.id, 0), Port(goal.strip.id, 1)):
            path = reach.path(enter)
            far_m = start.from_port(leave) + reach.to(enter) + goal.from_port(enter)
            if path is not None and far_m < best_m and _passes_once(path):
                best, best_m = path, far_m
    if not best:
        over = "" if with_signals else " that crosses at no signal"
        raise SpecError(
            f"way: no way leads from start to goal{over}, over plain ground: they lie on pieces "
            "that are not connected (see `cosim map check`): move one of them"
        )
    return best


def _passes_once(path: list[Port]) -> bool:
    """Return whether a way leaves its first strip and enters its last one only once."""
    return len({port.strip for port in path}) * 2 == len(path) + 2


def _crossed(street_map: StreetMap, route: Polyline) -> tuple[RouteCrossing, ...]:
    """Return the crossings that a route crosses from end to end."""
    line = LineString(route.points)
    strips = [
        s for s in street_map.near("strip", line) if isinstance(s, Strip) and s.kind == "crossing"
    ]
    over = [
        strip for strip in strips if line.intersection(strip.polygon).length > 0.5 * strip.length_m
    ]
    ports = itertools.chain.from_iterable((Port(strip.id, 0), Port(strip.id, 1)) for strip in over)
    return route_crossings(street_map, route, list(ports))


def moved_m(way: OwnWay, scenario: Scenario) -> list[tuple[str, float]]:
    """Return how far start and goal were moved to the middle of a sidewalk, in metres."""
    ends: list[tuple[str, PointXY | None, Floats]] = [
        ("start", way.start, np.array(scenario.start[:2])),
        ("goal", way.goal, np.array(scenario.goal)),
    ]
    return [
        (name, float(np.hypot(*(at - np.array(xy))))) for name, xy, at in ends if xy is not None
    ]
