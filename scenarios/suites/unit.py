"""Builder of unit scenarios: 10 to 20 m straight on, round a corner or over a crosswalk.

There are no people. They end on the first failure.
"""

from __future__ import annotations

import math
import zlib
from functools import partial
from typing import Final, Literal, get_args

import msgspec
import numpy as np

from cosim.core.errors import MapError, SpecError
from cosim.core.geometry import Polyline, wrap_angle
from cosim.place.route_line import way_line
from cosim.place.street_map import Port, StreetMap, Strip
from cosim.place.walk_graph import WalkGraph
from cosim.spec.robot import COURIER, Robot
from cosim.spec.scenario import Place, RouteCrossing, Scenario
from scenarios.suites.drawing import SCAN_TRIES, TRIES, Refusals, bare_scenario, first_of
from scenarios.suites.long_horizon import TURNED_OVER_M, on_car_paths_m, on_road_m
from scenarios.suites.obstacles import with_obstacles
from scenarios.suites.reactive import (
    LIMIT_S,
    NO_CROWD,
    over_crossing,
    route_points,
)
from scenarios.suites.stretches import sidewalks_of, straight_along

Structure = Literal["straight", "curve", "crosswalk"]
STRUCTURES: Final[tuple[Structure, ...]] = get_args(Structure)
WAY_M: Final = (10.0, 20.0)
TURN_RAD: Final = (math.radians(45.0), math.radians(150.0))
"""Least and largest turn of a curve, from its first metres to its last."""
_ENDS_M: Final = 2.0
"""Length at either end of a route from which its direction is measured, in metres."""
_OFF_ROAD_M: Final = 0.5
_BESIDE_ROBOT_M: Final = 0.7
"""Least distance between the robot and either edge of a sidewalk, in metres: room for an object."""


def build_unit(
    structure: Structure,
    place: Place,
    street_map: StreetMap,
    graph: WalkGraph,
    seed: int,
    scenario_id: str,
    robot: Robot = COURIER,
    way_m: tuple[float, float] = WAY_M,
) -> Scenario:
    """Draw a scenario of one structure from `seed`.

    The class of the street is drawn first, so that all classes are equally frequent. way_m:
    shortest and longest straight way. Raises SpecError if no place is found.
    """
    named = zlib.crc32(f"{structure} {place.name}".encode())
    rng = np.random.default_rng([seed, place.seed, 0x0417, named])
    classes: dict[str, list[Strip]] = {}
    for strip in strips_for(structure, street_map, graph, robot):
        classes.setdefault(strip.street_class, []).append(strip)
    if not classes:
        raise MapError(f"map '{street_map.name}' has no {lies_on(structure)} for '{structure}'")

    def draw(strips: list[Strip]) -> Scenario:
        strip = strips[int(rng.integers(len(strips)))]
        route, crossings = drawn_along(structure, strip, street_map, graph, rng, robot, way_m)
        return unit_along(structure, route, crossings, place, street_map, seed, scenario_id, robot)

    refusals = Refusals()
    tries = SCAN_TRIES if street_map.scanned else TRIES
    for name in rng.permutation(sorted(classes)).tolist():
        if found := first_of((partial(draw, classes[name]) for _ in range(tries)), refusals):
            return found
    raise SpecError(
        f"no place for '{structure}' on '{street_map.name}' with seed {seed}: {refusals}"
    )


def unit_along(
    structure: Structure,
    route: Polyline,
    crossings: tuple[RouteCrossing, ...],
    place: Place,
    street_map: StreetMap,
    seed: int,
    scenario_id: str,
    robot: Robot = COURIER,
) -> Scenario:
    """Build the scenario along a route of `drawn_along`. Raises SpecError if obstacles do not
    fit."""
    bare = bare_scenario(
        route,
        crossings,
        place,
        street_map,
        suite="unit",
        seed=seed,
        scenario_id=scenario_id,
        time_limit_s=LIMIT_S,
        robot=robot,
    )
    scenario = msgspec.structs.replace(
        bare, crowd=NO_CROWD, ends_on_failure=True, structure=structure
    )
    return with_obstacles(scenario, street_map)


def lies_on(structure: Structure) -> Literal["sidewalk", "crossing"]:
    """Return the kind of strip on which a structure is drawn."""
    return "crossing" if structure == "crosswalk" else "sidewalk"


def strips_for(
    structure: Structure, street_map: StreetMap, graph: WalkGraph, robot: Robot
) -> list[Strip]:
    """Return the strips on which a structure may fit, sorted by id. Nothing is drawn for this
    check.
    """
    if structure == "straight":
        usable = sidewalks_of(street_map, graph)
    else:
        strips = [
            street_map.strips[strip_id] for strip_id in sorted(graph.main_strips - street_map.steep)
        ]
        usable = [
            strip for strip in strips if strip.kind == lies_on(structure) and strip.going == "plain"
        ]
    return [strip for strip in usable if _may_be(strip, structure, robot)]


def drawn_along(
    structure: Structure,
    strip: Strip,
    street_map: StreetMap,
    graph: WalkGraph,
    rng: np.random.Generator,
    robot: Robot,
    way_m: tuple[float, float] = WAY_M,
) -> tuple[Polyline, tuple[RouteCrossing, ...]]:
    """Draw a route along a strip, with its crossings. Raises CosimError if it is unsuitable."""
    if structure == "straight":
        route, crossings = _straight(strip, rng, robot, way_m)
    elif structure == "curve":
        route = _round_corner(street_map, graph, strip, rng, robot)
        crossings = ()
    else:
        route, crossings = _crosswalk(street_map, strip, rng, robot)
    if not way_m[0] <= route.length_m <= way_m[1]:
        raise SpecError("the way is too short or too long")
    if on_road_m(street_map, route, crossings) > _OFF_ROAD_M:
        raise SpecError("the way lies on a road")
    if on_car_paths_m(street_map, route, crossings, robot) > TURNED_OVER_M:
        raise SpecError("cars turn over the way")
    return route, crossings


def turn_rad(route: Polyline) -> float:
    """Return the turn of a route from its first metres to its last, left positive."""
    first = route.at(0.0)
    last = route.at(_ENDS_M)
    before = route.at(route.length_m - _ENDS_M)
    end = route.at(route.length_m)
    out = math.atan2(last.y_m - first.y_m, last.x_m - first.x_m)
    return wrap_angle(math.atan2(end.y_m - before.y_m, end.x_m - before.x_m) - out)


def _may_be(strip: Strip, structure: Structure, robot: Robot) -> bool:
    """Return whether a structure may fit on a strip. Nothing is drawn for this check."""
    if structure == "crosswalk":
        return not strip.signalised and None not in strip.corners
    return strip.width_m >= _least_width_m(robot)


def _least_width_m(robot: Robot) -> float:
    return robot.width_m + 2.0 * _BESIDE_ROBOT_M


def _straight(
    strip: Strip, rng: np.random.Generator, robot: Robot, way_m: tuple[float, float]
) -> tuple[Polyline, tuple[RouteCrossing, ...]]:
    length_m = float(rng.uniform(*way_m))
    line, half_m = straight_along(strip, length_m, rng)
    if 2.0 * half_m < _least_width_m(robot):
        raise SpecError(f"the sidewalk is narrower than {_least_width_m(robot):.2g} m")
    return Polyline(route_points(line, length_m)), ()


def _crosswalk(
    street_map: StreetMap, strip: Strip, rng: np.random.Generator, robot: Robot
) -> tuple[Polyline, tuple[RouteCrossing, ...]]:
    spot = over_crossing(street_map, strip, rng, robot)
    return Polyline(spot.route), spot.crossings


def _round_corner(
    street_map: StreetMap, graph: WalkGraph, strip: Strip, rng: np.random.Generator, robot: Robot
) -> Polyline:
    """Draw a route from a sidewalk round one of its corners to another sidewalk in another
    direction.

    Raises SpecError if none fits.
    """
    leave = Port(strip.id, 1 if rng.random() < 0.5 else 0)
    onward = [
        port for port in graph.others(leave) if _leads_round(street_map, strip, leave, port, robot)
    ]
    if not onward:
        raise SpecError("no sidewalk leads round this corner")
    enter = onward[int(rng.integers(len(onward)))]
    wanted_m = float(rng.uniform(*WAY_M))
    before_m, behind_m = (
        min(0.5 * street_map.strips[port.strip].length_m, WAY_M[1]) for port in (leave, enter)
    )
    whole = way_line(street_map, [leave, enter], before_m, behind_m)
    # The corner is near the middle of the route.
    corner_s_m = whole.project(*graph.point(leave))[0]
    from_m = corner_s_m - float(rng.uniform(0.3, 0.6)) * wanted_m
    from_m = max(0.0, min(from_m, whole.length_m - wanted_m))
    steps = np.linspace(from_m, from_m + wanted_m, round(wanted_m) + 1)
    if steps[-1] > whole.length_m:
        raise SpecError("the sidewalks at the corner are too short")
    route = Polyline(np.round([whole.at(float(s_m)).xy for s_m in steps], 3))
    if not TURN_RAD[0] <= abs(turn_rad(route)) <= TURN_RAD[1]:
        raise SpecError("the way turns too little, or back")
    return route


def _leads_round(
    street_map: StreetMap, strip: Strip, leave: Port, port: Port, robot: Robot
) -> bool:
    """Return whether a port leads to another sidewalk that is wide enough and turns as a curve
    does.
    """
    other = street_map.strips[port.strip]
    if (
        other.kind != "sidewalk"
        or other.going != "plain"
        or other.id in street_map.steep
        or other.id == strip.id
    ):
        return False
    if not _may_be(other, "curve", robot):
        return False
    out, on = (_heading_out(street_map.strips[p.strip], p) for p in (leave, port))
    return abs(wrap_angle(on + math.pi - out)) >= TURN_RAD[0]


def _heading_out(strip: Strip, port: Port) -> float:
    """Return the heading on leaving a strip by a port."""
    line = Polyline(strip.line[:, :2] if port.end == 1 else strip.line[::-1, :2])
    return line.at(line.length_m).heading_rad
