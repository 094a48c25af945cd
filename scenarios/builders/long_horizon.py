"""Builder of long-horizon scenarios: start and goal far apart in a city, one walkable path, street life, events."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence, Set
from typing import NamedTuple

import msgspec
import numpy as np
import shapely
from shapely.geometry import LineString

from cosim.core.errors import MapError, SpecError
from cosim.core.geometry import Polyline
from cosim.place.map_check import ROUTE_M, START_M, on_road_shares
from cosim.place.route_line import way_line
from cosim.place.street_map import Lane, Port, StreetMap, Strip
from cosim.place.walk_graph import WalkGraph
from cosim.spec.event_kind import EventKinds
from cosim.spec.events import Event
from cosim.spec.robot import COURIER, Robot
from cosim.spec.scenario import Barrier, CrowdSpec, Place, RouteCrossing, Scenario
from scenarios.builders.barriers import barrier_at, branches, ground_around, prove_single_path
from scenarios.builders.drawing import TRIES, Refusals, bare_scenario, first_of, people_of, wider_m
from scenarios.builders.hems import hem
from scenarios.builders.obstacles import with_obstacles
from scenarios.events import EVENT_KINDS

_TO_SPARE_M = 0.045
"""The way is wider than the robot by this on either side."""
IN_GROUPS = 0.3
"""Share of the walkers that walk in groups of two and three."""

ON_ROAD_M = 2.0
"""So much of a route may lie on lanes that are driven on, where foreign maps draw sidewalks on the carriageway."""

CROSSING_EVERY_M = 160.0
EVENT_EVERY_M = 90.0
BESIDE_EVENT_M = 0.95
"""Events take place on sidewalks whose halves are wider than the robot by this: there is room to pass."""

SEARCHES = 150
"""So many ways are searched for where no draw fits."""
AVOIDED_SHARE = 0.3
"""Sidewalks with more of their area on roads are not searched."""
REMEDIES = {
    "no way of the drawn length": "the walkable pieces are too small or have too few crossings: import a larger area",
    "every long sidewalk": "import another area, or a net with sidewalks beside its roads",
    "the way lies on a road": "its sidewalks are drawn on the carriageway: see `cosim map check MAP -o map.png`",
    "the way would need": "its sidewalks lie over one another: see `cosim map check MAP -o map.png`; import a part",
    "": "see `cosim map check MAP -o map.png` for narrow, torn or stacked sidewalks; another --seed or a part may do",
}
"""What would help, by how the most frequent reason begins."""

EVENT_STRAIGHT_M = 24.0
EVENT_BEND_M = 0.4


class _Draft(NamedTuple):
    """What every draw of a scenario has in common."""

    place: Place
    street_map: StreetMap
    graph: WalkGraph
    seed: int
    scenario_id: str
    robot: Robot
    kinds: EventKinds

    @property
    def half_width_m(self) -> float:
        """Half of what the way is wide, at least."""
        return self.robot.width_m / 2 + _TO_SPARE_M


_Fences = Callable[[_Draft, Polyline, Sequence[Port]], tuple[Barrier, ...]]


def build_long_horizon(
    place: Place,
    street_map: StreetMap,
    graph: WalkGraph,
    seed: int,
    scenario_id: str,
    robot: Robot = COURIER,
    kinds: EventKinds = EVENT_KINDS,
) -> Scenario:
    """A scenario drawn from `seed`; where no draw has exactly one path to the goal, ways are searched for that can be
    fenced in all along. Raises SpecError with the reason that stands in the way most often, and what would help."""
    rng = np.random.default_rng([seed, place.seed, 0x10E6])
    candidates = sorted(
        strip_id
        for strip_id in graph.main_strips
        if street_map.strips[strip_id].kind == "sidewalk" and street_map.strips[strip_id].length_m >= START_M
        if strip_id not in street_map.steep
    )
    if not candidates:
        raise MapError(f"map '{street_map.name}' has no sidewalk of {START_M:g} m to start on")
    draft = _Draft(place, street_map, graph, seed, scenario_id, robot, kinds)
    drawn, searched = Refusals(), Refusals()
    draws = (lambda: _along(draft, rng, draw_way(street_map, graph, rng, candidates), _barriers) for _ in range(TRIES))
    found = first_of(draws, drawn) or first_of(_search(draft, candidates), searched)
    if found is None:
        reason = searched.most_frequent
        remedy = next((words for start, words in REMEDIES.items() if reason.startswith(start)), REMEDIES[""])
        failure = f"no long-horizon route on '{street_map.name}' with seed {seed} in {TRIES} draws ({drawn})"
        raise SpecError(f"{failure}, and none was found by searching ({searched}): {remedy}")
    return found


def _along(
    draft: _Draft, rng: np.random.Generator, drawn: tuple[Sequence[Port], float, float], fences: _Fences
) -> Scenario:
    """The scenario along a way, as `draw_way` gives it. Raises SpecError when the way does not do."""
    (way, *ends_m), street_map = drawn, draft.street_map
    route = Polyline(np.round(way_line(street_map, way, *ends_m).points, 3))
    if not ROUTE_M[0] <= route.length_m <= 1.2 * ROUTE_M[1]:
        raise SpecError("length of the line does not fit")
    crossings = route_crossings(street_map, route, way)
    if on_road_m(street_map, route, crossings) > ON_ROAD_M:
        raise SpecError("the way lies on a road: cars drive through who walks there")
    barriers = fences(draft, route, way)
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
    events = draw_events(street_map, route, way, rng, draft.robot, draft.kinds)
    whole = msgspec.structs.replace(bare, barriers=barriers, events=events, crowd=CrowdSpec(groups=IN_GROUPS))
    return with_obstacles(whole, street_map)


def _search(draft: _Draft, candidates: Sequence[str]) -> Iterator[Callable[[], Scenario]]:
    """More draws: of ways that keep off roads, stairs and bridges, fenced in all along where need be."""
    street_map = draft.street_map
    rng = np.random.default_rng([draft.seed, draft.place.seed, 0x10E6, 1])
    sidewalks = [strip for strip in street_map.strips.values() if strip.kind == "sidewalk"]
    shares = dict(zip([s.id for s in sidewalks], on_road_shares(street_map, sidewalks), strict=True))
    avoided = {s.id for s in street_map.strips.values() if s.going != "plain" or shares.get(s.id, 0.0) > AVOIDED_SHARE}
    usable = [strip for strip in candidates if strip not in avoided]

    def draw() -> Scenario:
        if not usable:
            raise SpecError("every long sidewalk is a stair, a bridge, a tunnel or on a road")
        return _along(draft, rng, search_way(street_map, draft.graph, rng, usable, avoided), _hemmed)

    return (draw for _ in range(SEARCHES if usable else 1))


def _hemmed(draft: _Draft, route: Polyline, way: Sequence[Port]) -> tuple[Barrier, ...]:
    """Barriers at the branches where they do, else all along the way. Raises SpecError when neither leave one path."""
    try:
        return _barriers(draft, route, way)
    except SpecError:
        fences = hem(draft.street_map, way)
        prove_single_path(draft.street_map, route, fences, way, draft.half_width_m)
        return fences


def _barriers(draft: _Draft, route: Polyline, way: Sequence[Port]) -> tuple[Barrier, ...]:
    """Barriers that leave one path, square to their strips if possible. Raises SpecError when there are none."""
    street_map = draft.street_map
    ports, ground = branches(street_map, way), ground_around(street_map, route, way)
    barriers = tuple(barrier_at(street_map, port) for port in ports)
    try:
        prove_single_path(street_map, route, barriers, way, draft.half_width_m, ground)
    except SpecError:
        barriers = tuple(barrier_at(street_map, port, slanting=True) for port in ports)
        prove_single_path(street_map, route, barriers, way, draft.half_width_m, ground)
    return barriers


def draw_way(
    street_map: StreetMap, graph: WalkGraph, rng: np.random.Generator, candidates: Sequence[str]
) -> tuple[list[Port], float, float]:
    """(way, start_m, goal_m): a shortest way of a drawn length that crosses a street, as `way_line` takes it."""
    target_m = rng.uniform(*ROUTE_M)
    strip = street_map.strips[candidates[int(rng.integers(len(candidates)))]]
    leave = Port(strip.id, 1 if rng.random() < 0.5 else 0)
    start_m = float(rng.uniform(0.4, 0.7)) * strip.length_m
    closed = street_map.too_steep | {leave.other}
    reach = graph.reach(leave, closed, limit_m=target_m + 60.0)
    goals = [port for port in reach.within(target_m - start_m - 60.0, target_m - start_m) if port.strip in candidates]
    if not goals:
        raise SpecError("no goal at the drawn distance")
    goal = goals[int(rng.integers(len(goals)))]
    way = reach.path(goal)
    if way is None or len({port.strip for port in way}) * 2 != len(way) + 2:
        raise SpecError("the way passes its goal")
    if any(street_map.strips[port.strip].going != "plain" for port in way):
        raise SpecError("the way leads over stairs, a bridge or a tunnel")
    crossed = sum(street_map.strips[port.strip].kind == "crossing" for port in way) // 2
    if crossed < max(1, round(target_m / CROSSING_EVERY_M)):
        raise SpecError("the way crosses too few streets")
    goal_strip = street_map.strips[goal.strip]
    return way, start_m, float(rng.uniform(0.4, 0.7)) * goal_strip.length_m


def search_way(
    street_map: StreetMap, graph: WalkGraph, rng: np.random.Generator, candidates: Sequence[str], avoided: Set[str]
) -> tuple[list[Port], float, float]:
    """As `draw_way`, but over none of the `avoided` strips, and to any goal within reach that does."""
    target_m = rng.uniform(*ROUTE_M)
    strip = street_map.strips[candidates[int(rng.integers(len(candidates)))]]
    leave = Port(strip.id, 1 if rng.random() < 0.5 else 0)
    start_m = float(rng.uniform(0.4, 0.7)) * strip.length_m
    closed = street_map.too_steep | {leave.other} | {port for s in avoided for port in (Port(s, 0), Port(s, 1))}
    reach = graph.reach(leave, closed, limit_m=target_m + 60.0)
    ends = set(candidates)
    goals = [port for port in reach.within(target_m - start_m - 60.0, target_m - start_m) if port.strip in ends]
    for i in rng.permutation(len(goals)):
        way = reach.path(goals[i])
        if way is None or len({port.strip for port in way}) * 2 != len(way) + 2:
            continue
        crossed = sum(street_map.strips[port.strip].kind == "crossing" for port in way) // 2
        if crossed >= max(1, round(target_m / CROSSING_EVERY_M)):
            return way, start_m, float(rng.uniform(0.4, 0.7)) * street_map.strips[goals[i].strip].length_m
    raise SpecError("no way of the drawn length crosses a street every 160 m")


def route_crossings(street_map: StreetMap, route: Polyline, way: Sequence[Port]) -> tuple[RouteCrossing, ...]:
    """The crossings of a way, in order, with the arc lengths between which the route is on them."""
    found = []
    for port in way[::2]:
        strip = street_map.strips[port.strip]
        if strip.kind != "crossing":
            continue
        ends = sorted(route.project(*strip.line[i, :2])[0] for i in (0, -1))
        found.append(RouteCrossing(id=strip.id, enter_s_m=ends[0], leave_s_m=ends[1], signalised=strip.signalised))
    return tuple(sorted(found, key=lambda crossing: crossing.enter_s_m))


def on_road_m(street_map: StreetMap, route: Polyline, crossings: Sequence[RouteCrossing]) -> float:
    """Metres of a route that lie on lanes of roads, crossings and the interior of junctions apart."""
    s_m = np.arange(0.5, route.length_m, 1.0)
    for crossing in crossings:
        s_m = s_m[(s_m < crossing.enter_s_m - 1.0) | (s_m > crossing.leave_s_m + 1.0)]
    x, y = (np.interp(s_m, route.s_m, route.points[:, k]) for k in (0, 1))
    lanes = [lane for lane in street_map.near("lane", LineString(route.points)) if isinstance(lane, Lane)]
    on_road = np.zeros(len(s_m), dtype=bool)
    for lane in lanes:
        if lane.kind == "road" and not lane.internal:
            on_road |= shapely.contains_xy(lane.polygon, x, y)
    return float(on_road.sum())


def draw_events(
    street_map: StreetMap,
    route: Polyline,
    way: Sequence[Port],
    rng: np.random.Generator,
    robot: Robot,
    kinds: EventKinds,
) -> tuple[Event, ...]:
    """Events about every EVENT_EVERY_M metres, on straight pieces of sidewalk wide enough for event and robot."""
    layouts = {kind.name: kind.layout for kind in kinds.values() if kind.on_long_ways and kind.layout is not None}
    if not layouts:
        return ()
    places, wide_m = [], 2.0 * (robot.width_m + BESIDE_EVENT_M)
    for s_m in np.arange(35.0, route.length_m - 25.0, 5.0):
        strip = _sidewalk_at(street_map, way, route, float(s_m))
        if strip is not None and strip.width_m >= wide_m and _is_straight(route, float(s_m)):
            places.append((float(s_m), strip.width_m / 2))
    events: list[Event] = []
    next_s_m = 0.0
    names = rng.permutation([*layouts]).tolist()
    for s_m, half_width_m in places:
        name = names[len(events) % len(names)]
        if s_m < next_s_m or half_width_m < layouts[name].half_width_m + wider_m(robot):
            continue
        pose = route.at(s_m)
        events.append(
            Event(
                id=f"e{len(events)}",
                kind=name,
                x_m=pose.x_m,
                y_m=pose.y_m,
                heading_rad=pose.heading_rad,
                route_s_m=s_m,
                half_width_m=half_width_m,
                people=people_of(kinds[name], half_width_m, robot, rng),
                speed_mps=float(rng.uniform(1.1, 1.65)),
                side=1 if rng.random() < 0.5 else -1,
            )
        )
        next_s_m = s_m + float(rng.uniform(0.6, 1.4)) * EVENT_EVERY_M
    return tuple(events)


def _sidewalk_at(street_map: StreetMap, way: Sequence[Port], route: Polyline, s_m: float) -> Strip | None:
    """The sidewalk of the way at an arc length of the route, None on corners and crossings."""
    pose = route.at(s_m)
    strip = street_map.strips.get(street_map.locate(pose.x_m, pose.y_m, 0.05).edge)
    return strip if strip is not None and strip.kind == "sidewalk" and strip.id in {p.strip for p in way} else None


def _is_straight(route: Polyline, s_m: float) -> bool:
    """Whether the route bends by less than EVENT_BEND_M in the stretch before and a little behind a place."""
    from_m, to_m = s_m - EVENT_STRAIGHT_M, s_m + 5.0
    chord = Polyline([route.at(from_m).xy, route.at(to_m).xy])
    between = route.points[(route.s_m > from_m) & (route.s_m < to_m)]
    return all(abs(chord.project(x, y)[1]) < EVENT_BEND_M for x, y in between)
