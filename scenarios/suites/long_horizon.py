"""Builder of long-horizon scenarios.

Start and goal are far apart in a city with street life and events. One walkable path leads from one
to the other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence, Set
from typing import NamedTuple

import msgspec
import numpy as np
import shapely
from shapely.geometry import LineString

from cosim.core.errors import MapError, SpecError
from cosim.core.geometry import Polyline
from cosim.place.barriers import barrier_at, ground_around, ports_to_close, prove_single_path
from cosim.place.car_paths import CAR_WIDTH_M, distance_to_car_paths_m
from cosim.place.map_check import on_road_shares
from cosim.place.route_line import ROUTE_M, START_M, way_line
from cosim.place.street_map import Lane, Port, StreetMap, ports_of
from cosim.place.walk_graph import WalkGraph
from cosim.spec.events import EventKinds
from cosim.spec.robot import COURIER, Robot
from cosim.spec.scenario import Barrier, CrowdSpec, Place, RouteCrossing, Scenario
from scenarios.events import EVENT_KINDS
from scenarios.suites.drawing import (
    BESIDE_PERSON_M,
    TRIES,
    Refusals,
    bare_scenario,
    first_of,
    passing_width_m,
)
from scenarios.suites.edge_fences import edge_fences
from scenarios.suites.obstacles import TO_SPARE_M, with_obstacles
from scenarios.suites.way_events import draw_events

WAY_SPARE_M = 0.045
"""Least distance between the robot and either edge of the way, in metres."""
PERSONS_PER_1000_M2 = 22.0
"""Density of the crowd, persons per 1000 m2 of walkable ground: a mean of 50 persons within 80 m of
the robot on the routes of the generated cities.
"""
IN_GROUPS = 0.3
"""Share of the walkers that walk in groups of two and three."""

ON_ROAD_M = 2.0
"""Largest length of a route on lanes for vehicles, in metres. Imported maps draw some sidewalks on
the carriageway.
"""

TURNED_OVER_M = 0.5
"""Largest length of a route where cars turn, in metres. Imported maps draw such areas over
corners.
"""
_KERB_M = 0.5
"""Distance beyond the line of a crossing at which its ground ends, in metres."""
_SAMPLE_M = 0.5

CROSSING_EVERY_M = 160.0
SCAN_ROUTE_M = (60.0, ROUTE_M[1])
"""Minimum and maximum length of a route on a scan, in metres; it need not cross a street."""
LENGTH_SLACK_M = 3.0
"""Largest deviation of a way from its wanted length, in metres."""
_END_M = 8.0
"""Least distance of a goal from the ends of its sidewalk, in metres."""
_SHARES = (0.4, 0.7)
"""Range of the shares of the first and last sidewalk that a route uses."""
_SCAN_END_M = 1.5
"""The same as _END_M on a scan, where streets are short."""
_SCAN_SHARES = (0.4, 0.95)
"""The same as _SHARES on a scan."""
_SCAN_START_M = 5.0
"""Minimum length of the first and last sidewalk of a route on a scan, in metres."""

SEARCHES = 150
"""Number of ways that are searched if no draw fits."""
AVOIDED_SHARE = 0.3
"""Largest share of its area on roads with which a sidewalk is searched."""
REMEDIES = {
    "no way of the drawn length": "the walkable pieces are too small or have too few "
    "crossings: import a larger area",
    "every long sidewalk": "import another area, or a net with sidewalks beside its roads",
    "the way lies on a road": "its sidewalks are drawn on the carriageway: see `cosim map "
    "check MAP -o map.png`",
    "cars turn over the way": "its corners reach into junctions: see `cosim map "
    "check MAP -o map.png`",
    "the way doubles back": "its sidewalks touch one another: see `cosim map check MAP -o "
    "map.png`; import a part",
    "the way would need": "its sidewalks lie over one another: see `cosim map check MAP -o "
    "map.png`; import a part",
    "": "see `cosim map check MAP -o map.png` for narrow, torn or stacked sidewalks; another "
    "--seed or a part may do",
}
"""Remedies by the first words of the most frequent reason."""


class _Draft(NamedTuple):
    """Inputs that all draws of a scenario share."""

    place: Place
    street_map: StreetMap
    graph: WalkGraph
    seed: int
    scenario_id: str
    robot: Robot
    kinds: EventKinds
    length_m: float | None
    to_spare_m: float


_Fences = Callable[[StreetMap, Polyline, Sequence[Port], float], tuple[Barrier, ...]]


def build_long_horizon(
    place: Place,
    street_map: StreetMap,
    graph: WalkGraph,
    seed: int,
    scenario_id: str,
    robot: Robot = COURIER,
    kinds: EventKinds = EVENT_KINDS,
    length_m: float | None = None,
    roomy: bool = False,
) -> Scenario:
    """Draw a scenario from `seed`.

    If no draw has exactly one path to the goal, search for ways that can be fenced along both
    sides.

    length_m: length of the way; drawn by default.
    roomy: prefer sidewalks on which people can pass the robot, and leave room for a person to pass
        obstacles.

    Raises SpecError with the most frequent reason and a remedy.
    """
    rng = np.random.default_rng([seed, place.seed, 0x10E6])
    candidates = starts(street_map, graph)
    if not candidates:
        raise MapError(f"map '{street_map.name}' has no sidewalk of {START_M:g} m to start on")
    to_spare_m = BESIDE_PERSON_M if roomy else TO_SPARE_M
    draft = _Draft(place, street_map, graph, seed, scenario_id, robot, kinds, length_m, to_spare_m)
    if roomy and (found := _on_wide_sidewalks(draft, candidates)) is not None:
        return found
    drawn, searched = Refusals(), Refusals()
    draws = (
        lambda: _along(
            draft, rng, draw_way(street_map, graph, rng, candidates, length_m), _barriers
        )
        for _ in range(TRIES)
    )
    found = first_of(draws, drawn) or first_of(_search(draft, candidates), searched)
    if found is None:
        reason = searched.most_frequent
        remedy = next(
            (words for start, words in REMEDIES.items() if reason.startswith(start)), REMEDIES[""]
        )
        failure = (
            f"no long-horizon route on '{street_map.name}' with seed {seed} in {TRIES} draws "
            f"({drawn})"
        )
        raise SpecError(f"{failure}, and none was found by searching ({searched}): {remedy}")
    return found


def _on_wide_sidewalks(draft: _Draft, candidates: Sequence[str]) -> Scenario | None:
    """Return a scenario on sidewalks that are all wide enough for people to pass the robot.

    None where no sidewalk is narrower, or no way over wide ones is found.
    """
    street_map = draft.street_map
    least_m = passing_width_m(draft.robot)
    strips = street_map.strips.values()
    narrow = {strip.id for strip in strips if strip.kind == "sidewalk" and strip.width_m < least_m}
    wide = [strip for strip in candidates if strip not in narrow]
    if not narrow or not wide:
        return None
    rng = np.random.default_rng([draft.seed, draft.place.seed, 0x10E6, 2])

    def draw() -> Scenario:
        way = draw_way(street_map, draft.graph, rng, wide, draft.length_m, narrow)
        return _along(draft, rng, way, _barriers)

    return first_of((draw for _ in range(TRIES)), Refusals())


def starts(street_map: StreetMap, graph: WalkGraph) -> list[str]:
    """Return the sidewalks on which long ways start and end."""
    least_m = _SCAN_START_M if street_map.scanned else START_M
    return sorted(
        strip_id
        for strip_id in graph.main_strips
        if street_map.strips[strip_id].kind == "sidewalk"
        and street_map.strips[strip_id].length_m >= least_m
        if strip_id not in street_map.steep
    )


def _along(
    draft: _Draft,
    rng: np.random.Generator,
    drawn: tuple[Sequence[Port], float, float],
    fences: _Fences,
) -> Scenario:
    """Build the scenario along a way of `draw_way`. Raises SpecError if the way is unsuitable."""
    way = drawn[0]
    street_map = draft.street_map
    route, crossings, barriers = fenced_route(
        street_map, drawn, fences, draft.robot, draft.length_m
    )
    bare = bare_scenario(
        route,
        crossings,
        draft.place,
        street_map,
        suite="long-horizon",
        seed=draft.seed,
        scenario_id=draft.scenario_id,
        time_limit_s=max(300.0, route.length_m / 0.2),
        robot=draft.robot,
    )
    events = draw_events(street_map, route, way, crossings, rng, draft.robot, draft.kinds)
    parts = {
        "barriers": barriers,
        "events": events,
        "crowd": CrowdSpec(density=PERSONS_PER_1000_M2, groups=IN_GROUPS),
        "structure": "route",
    }
    return with_obstacles(
        msgspec.structs.replace(bare, **parts), street_map, to_spare_m=draft.to_spare_m
    )


def fenced_route(
    street_map: StreetMap,
    drawn: tuple[Sequence[Port], float, float],
    fences: _Fences,
    robot: Robot,
    length_m: float | None = None,
) -> tuple[Polyline, tuple[RouteCrossing, ...], tuple[Barrier, ...]]:
    """Return the route along a way of `draw_way`, its crossings, and fences that leave no other
    route.

    Raises SpecError if the way is unsuitable.
    """
    way, *ends_m = drawn
    route = _line(street_map, way, *ends_m)
    if length_m is not None:
        # Corners are cut; the last sidewalk is walked farther by the distance saved.
        ends_m[1] += length_m - route.length_m
        end_m = _SCAN_END_M if street_map.scanned else _END_M
        if not end_m <= ends_m[1] <= street_map.strips[way[-1].strip].length_m - end_m:
            raise SpecError("no goal at the wanted distance")
        route = _line(street_map, way, *ends_m)
        if abs(route.length_m - length_m) > LENGTH_SLACK_M:
            raise SpecError("the line is not of the wanted length")
    low_m, high_m = _lengths_m(street_map)
    if not low_m <= route.length_m <= 1.2 * high_m:
        raise SpecError("length of the line does not fit")
    crossings = route_crossings(street_map, route, way)
    if on_road_m(street_map, route, crossings) > ON_ROAD_M:
        raise SpecError("the way lies on a road: cars drive through pedestrians there")
    if on_car_paths_m(street_map, route, crossings, robot) > TURNED_OVER_M:
        raise SpecError("cars turn over the way")
    return route, crossings, fences(street_map, route, way, robot.width_m / 2 + WAY_SPARE_M)


def _line(street_map: StreetMap, way: Sequence[Port], start_m: float, goal_m: float) -> Polyline:
    """Return the route along a way, in whole centimetres."""
    return Polyline(np.round(way_line(street_map, way, start_m, goal_m).points, 2))


def _search(draft: _Draft, candidates: Sequence[str]) -> Iterator[Callable[[], Scenario]]:
    """Return more draws, of ways without roads, stairs and bridges, fenced on both sides if
    necessary.
    """
    street_map = draft.street_map
    rng = np.random.default_rng([draft.seed, draft.place.seed, 0x10E6, 1])
    avoided = avoided_strips(street_map)
    usable = [strip for strip in candidates if strip not in avoided]

    def draw() -> Scenario:
        if not usable:
            raise SpecError("every long sidewalk is a stair, a bridge, a tunnel or on a road")
        found = search_way(street_map, draft.graph, rng, usable, avoided, draft.length_m)
        return _along(draft, rng, found, fences_along)

    return (draw for _ in range(SEARCHES if usable else 1))


def avoided_strips(street_map: StreetMap) -> set[str]:
    """Return the strips that searches exclude: stairs, bridges, tunnels, sidewalks on roads, and
    crossings whose green is too short to walk.
    """
    sidewalks = [strip for strip in street_map.strips.values() if strip.kind == "sidewalk"]
    shares = dict(
        zip([s.id for s in sidewalks], on_road_shares(street_map, sidewalks), strict=True)
    )
    return {
        s.id
        for s in street_map.strips.values()
        if s.going != "plain" or s.short_green or shares.get(s.id, 0.0) > AVOIDED_SHARE
    }


def fences_along(
    street_map: StreetMap, route: Polyline, way: Sequence[Port], half_width_m: float
) -> tuple[Barrier, ...]:
    """Return barriers at the branches if they suffice, else along the whole way.

    Raises SpecError if neither leaves one path.
    """
    try:
        return _barriers(street_map, route, way, half_width_m)
    except SpecError:
        fences = edge_fences(street_map, way)
        prove_single_path(street_map, route, fences, way, half_width_m)
        return fences


def _barriers(
    street_map: StreetMap, route: Polyline, way: Sequence[Port], half_width_m: float
) -> tuple[Barrier, ...]:
    """Return barriers that leave one path, square to their strips if possible.

    Raises SpecError if no such barriers exist.
    """
    ports = ports_to_close(street_map, way)
    ground = ground_around(street_map, route, way)
    barriers = tuple(barrier_at(street_map, port) for port in ports)
    try:
        prove_single_path(street_map, route, barriers, way, half_width_m, ground)
    except SpecError:
        barriers = tuple(barrier_at(street_map, port, slanting=True) for port in ports)
        prove_single_path(street_map, route, barriers, way, half_width_m, ground)
    return barriers


def draw_way(
    street_map: StreetMap,
    graph: WalkGraph,
    rng: np.random.Generator,
    candidates: Sequence[str],
    length_m: float | None = None,
    avoided: Set[str] = frozenset(),
) -> tuple[list[Port], float, float]:
    """Draw a shortest way of a drawn length that crosses a street.

    length_m: wanted length, instead of a drawn one.
    avoided: strips that the way must not use.

    Returns (way, start_m, goal_m), as for `way_line`.
    """
    target_m = rng.uniform(*_lengths_m(street_map)) if length_m is None else length_m
    strip = street_map.strips[candidates[int(rng.integers(len(candidates)))]]
    leave = Port(strip.id, 1 if rng.random() < 0.5 else 0)
    start_m = float(rng.uniform(*_shares(street_map))) * strip.length_m
    closed = street_map.too_steep | {leave.other} | ports_of(avoided)
    reach = graph.reach(leave, closed, limit_m=target_m + 60.0)
    goals = [
        port
        for port in reach.within(target_m - start_m - 60.0, target_m - start_m)
        if port.strip in candidates
    ]
    if not goals:
        raise SpecError("no goal at the drawn distance")
    goal = goals[int(rng.integers(len(goals)))]
    way = reach.path(goal)
    if way is None or len({port.strip for port in way}) * 2 != len(way) + 2:
        raise SpecError("the way passes its goal")
    if any(street_map.strips[port.strip].going != "plain" for port in way):
        raise SpecError("the way leads over stairs, a bridge or a tunnel")
    if any(street_map.strips[port.strip].short_green for port in way):
        raise SpecError("the way crosses at a signal whose green is too short to walk")
    crossed = sum(street_map.strips[port.strip].kind == "crossing" for port in way) // 2
    if crossed < _least_crossings(street_map, target_m):
        raise SpecError("the way crosses too few streets")
    goal_strip = street_map.strips[goal.strip]
    if length_m is not None:
        return way, start_m, length_m - start_m - reach.to(goal)
    return way, start_m, float(rng.uniform(*_shares(street_map))) * goal_strip.length_m


def search_way(
    street_map: StreetMap,
    graph: WalkGraph,
    rng: np.random.Generator,
    candidates: Sequence[str],
    avoided: Set[str],
    length_m: float | None = None,
) -> tuple[list[Port], float, float]:
    """Search a way as `draw_way` does, but without the `avoided` strips and to any reachable
    goal.
    """
    target_m = rng.uniform(*_lengths_m(street_map)) if length_m is None else length_m
    strip = street_map.strips[candidates[int(rng.integers(len(candidates)))]]
    leave = Port(strip.id, 1 if rng.random() < 0.5 else 0)
    start_m = float(rng.uniform(*_shares(street_map))) * strip.length_m
    closed = street_map.too_steep | {leave.other} | ports_of(avoided)
    reach = graph.reach(leave, closed, limit_m=target_m + 60.0)
    ends = set(candidates)
    goals = [
        port
        for port in reach.within(target_m - start_m - 60.0, target_m - start_m)
        if port.strip in ends
    ]
    for i in rng.permutation(len(goals)):
        way = reach.path(goals[i])
        if way is None or len({port.strip for port in way}) * 2 != len(way) + 2:
            continue
        crossed = sum(street_map.strips[port.strip].kind == "crossing" for port in way) // 2
        if crossed >= _least_crossings(street_map, target_m):
            if length_m is not None:
                return way, start_m, length_m - start_m - reach.to(goals[i])
            return (
                way,
                start_m,
                float(rng.uniform(*_shares(street_map)))
                * street_map.strips[goals[i].strip].length_m,
            )
    raise SpecError("no way of the drawn length crosses a street every 160 m")


def _lengths_m(street_map: StreetMap) -> tuple[float, float]:
    """Return the minimum and maximum length of a drawn route, in metres."""
    if not street_map.scanned:
        return ROUTE_M
    low_m, high_m = SCAN_ROUTE_M
    whole_m = sum(strip.length_m for strip in street_map.strips.values())
    return low_m, min(max(whole_m, low_m), high_m)


def _shares(street_map: StreetMap) -> tuple[float, float]:
    return _SCAN_SHARES if street_map.scanned else _SHARES


def _least_crossings(street_map: StreetMap, length_m: float) -> int:
    """Return the least number of crossings on a route of a length."""
    return 0 if street_map.scanned else max(1, round(length_m / CROSSING_EVERY_M))


def route_crossings(
    street_map: StreetMap, route: Polyline, way: Sequence[Port]
) -> tuple[RouteCrossing, ...]:
    """Return the crossings of a way, in order, with the arc lengths of the route on them."""
    found = []
    for port in way[::2]:
        strip = street_map.strips[port.strip]
        if strip.kind != "crossing":
            continue
        ends = sorted(route.project(*strip.line[i, :2])[0] for i in (0, -1))
        found.append(
            RouteCrossing(
                id=strip.id, enter_s_m=ends[0], leave_s_m=ends[1], signalised=strip.signalised
            )
        )
    return tuple(sorted(found, key=lambda crossing: crossing.enter_s_m))


def on_road_m(street_map: StreetMap, route: Polyline, crossings: Sequence[RouteCrossing]) -> float:
    """Return the length of a route on lanes of roads, without crossings and junctions, in
    metres.
    """
    s_m = np.arange(0.5, route.length_m, 1.0)
    for crossing in crossings:
        s_m = s_m[(s_m < crossing.enter_s_m - 1.0) | (s_m > crossing.leave_s_m + 1.0)]
    x, y = (np.interp(s_m, route.s_m, route.points[:, k]) for k in (0, 1))
    lanes = [
        lane for lane in street_map.near("lane", LineString(route.points)) if isinstance(lane, Lane)
    ]
    on_road = np.zeros(len(s_m), dtype=bool)
    for lane in lanes:
        if lane.kind == "road" and not lane.internal:
            on_road |= shapely.contains_xy(lane.polygon, x, y)
    return float(on_road.sum())


def on_car_paths_m(
    street_map: StreetMap, route: Polyline, crossings: Sequence[RouteCrossing], robot: Robot
) -> float:
    """Return the length of a route in the path of cars inside junctions, without crossings, in
    metres.
    """
    s_m = np.arange(0.5 * _SAMPLE_M, route.length_m, _SAMPLE_M)
    for crossing in crossings:
        s_m = s_m[(s_m < crossing.enter_s_m - _KERB_M) | (s_m > crossing.leave_s_m + _KERB_M)]
    xy = np.column_stack([np.interp(s_m, route.s_m, route.points[:, k]) for k in (0, 1)])
    hit = distance_to_car_paths_m(street_map, xy) < 0.5 * (CAR_WIDTH_M + robot.width_m)
    return _SAMPLE_M * float(hit.sum())
