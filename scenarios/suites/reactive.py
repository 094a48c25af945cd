"""Builder of reactive scenarios: 12 to 30 m of straight route with one event and no other people.

Length, event position and sides are drawn before the place, so that they have the same
distribution for all kinds. Obstacles leave no straight lane free from start to goal. The scenarios
end on the first failure.
"""

from __future__ import annotations

import itertools
import math
import zlib
from collections.abc import Iterator
from typing import Final, Literal, NamedTuple

import msgspec
import numpy as np
import shapely
from shapely.geometry import LineString

from cosim.core.errors import MapError, SpecError
from cosim.core.geometry import Floats, Polyline, Pose
from cosim.place.street_map import Port, StreetMap, Strip
from cosim.place.walk_graph import WalkGraph
from cosim.spec.events import Event, EventKind, SidewalkLayout
from cosim.spec.obstacle import Obstacle
from cosim.spec.robot import COURIER, Robot
from cosim.spec.scenario import CrowdSpec, Place, RouteCrossing, Scenario
from scenarios.suites.drawing import (
    SCAN_TRIES,
    TRIES,
    bare_scenario,
    first_that_fits,
    people_of,
    wider_m,
)
from scenarios.suites.gate_fences import Gate, drawn_gate
from scenarios.suites.lanes import with_lanes_blocked
from scenarios.suites.long_horizon import route_crossings
from scenarios.suites.stretches import middle_at, sidewalks_of, straight_along

LIMIT_S = 60.0
"""Time limit of a scenario that the expert has not solved yet."""
NO_CROWD = CrowdSpec(persons=0, vehicles=0)
"""Crowd without vehicles and with no people but those of the event, as in the paper."""
WAY_M: Final = (12.0, 30.0)
"""Least and largest length of a route in metres."""
BESIDE_CROSSING_M = (2.0, 5.0)
"""Least and largest length of a unit route before and after a crosswalk, in metres."""
ROUND_CROSSING_M: Final = (3.5, 2.3)
"""Least length of a reactive route before and after a crosswalk, in metres."""
_ROOM_M = 0.35
"""Half the width of the walkable ground before and after a crosswalk, in metres."""
_SHORTEST_M = 10.0
_CROSSING_M: Final = (5.0, 12.0)
_ASLANT: Final = tuple(
    sorted(
        itertools.product(np.radians(np.arange(-8, 9)).tolist(), np.arange(-4, 5) * 0.3),
        key=lambda one: abs(one[0]) / math.radians(8.0) + abs(one[1]) / 1.2,
    )
)
"""Ways over a crosswalk that are tried in this order: angle to its line, offset from its middle in
metres.
"""
_STEP_M: Final = 3.0
"""Distance between the points of a straight route, in metres: the suite's file stays small."""
_SPEEDS_MPS = (1.1, 1.65)
"""Least and largest walking speed in the paper, in m/s."""
PATIENCE_S: Final = (2.0, 4.0)
"""Least and largest time for which a person waits in front of a standing robot."""
_TRIGGER_SHARE: Final = (0.6, 1.0)
"""Least and largest trigger distance, as a share of the kind's."""
_NEAREST_TRIGGER_M: Final = 3.0
"""Least trigger distance in metres, if the kind's is larger: people must be in the picture."""
_BEFORE_TRIGGER_M: Final = 1.0
"""Least length of route before the trigger, in metres."""
_BAND_M: Final = 1.0
"""Least range of positions in which an event is drawn, in metres."""


class Wanted(NamedTuple):
    """Properties of a reactive scenario that are drawn before its place.

    length_m: length of the route.
    share: position of the event, as a share of the range in which it fits on the route.
    side, free_side: see `Event`.
    """

    length_m: float
    share: float
    side: Literal[-1, 1]
    free_side: Literal[-1, 1]


class EventSpot(NamedTuple):
    """Way with the place of the event on it.

    route: (N, 2) m.
    half_width_m, half_length_m, trigger_m: see `Event`.
    fences: obstacles that narrow the way at the event.
    """

    route: Floats
    pose: Pose
    route_s_m: float
    half_width_m: float
    half_length_m: float = 0.0
    crossings: tuple[RouteCrossing, ...] = ()
    trigger_m: float | None = None
    fences: tuple[Obstacle, ...] = ()


def build_reactive(
    kind: EventKind,
    place: Place,
    street_map: StreetMap,
    graph: WalkGraph,
    seed: int,
    scenario_id: str,
    robot: Robot = COURIER,
    wanted: Wanted | None = None,
) -> Scenario:
    """Draw a scenario of one kind of event from `seed`.

    wanted: properties that are drawn before the place; drawn from `seed` if None.

    Raises SpecError if no place is found.
    """
    named = zlib.crc32(kind.name.encode())
    rng = np.random.default_rng([seed, place.seed, 0x4EAC7, named])
    strips = strips_of(kind, street_map, graph)
    if not strips:
        what = "crossing" if kind.layout is None else "sidewalk"
        raise MapError(f"map '{street_map.name}' has no {what} for '{kind.name}'")
    properties = (
        itertools.repeat(wanted)
        if wanted
        else _wanted_in_turn(
            np.random.default_rng([seed, place.seed, 0xD4A3, named]), scanned=street_map.scanned
        )
    )
    in_turn = _in_turn([one for one in strips if _may_hold(kind, one)] or strips, rng)

    def draw() -> Scenario:
        strip, now = next(in_turn), next(properties)
        return reactive_on(
            strip, kind, place, street_map, rng, seed, scenario_id, robot=robot, wanted=now
        )

    return first_that_fits(
        draw,
        f"no place for '{kind.name}' on '{street_map.name}' with seed {seed}",
        SCAN_TRIES if street_map.scanned else TRIES,
    )


def reactive_on(
    strip: Strip,
    kind: EventKind,
    place: Place,
    street_map: StreetMap,
    rng: np.random.Generator,
    seed: int,
    scenario_id: str,
    *,
    robot: Robot = COURIER,
    wanted: Wanted | None = None,
) -> Scenario:
    """Draw a scenario of one kind of event on a strip. Raises SpecError if it does not fit.

    wanted: what was drawn before the place; drawn here if None.
    """
    if wanted is None:
        wanted = drawn_wanted(rng)
    at = event_spot(kind, strip, street_map, rng, robot, wanted)
    bare = bare_scenario(
        Polyline(at.route),
        at.crossings,
        place,
        street_map,
        suite="reactive",
        seed=seed,
        scenario_id=scenario_id,
        time_limit_s=LIMIT_S,
        robot=robot,
    )
    of_kind = {"structure": kind.name, "ends_at": kind.ends_at}
    scenario = msgspec.structs.replace(
        bare,
        crowd=NO_CROWD,
        ends_on_failure=True,
        obstacles=at.fences,
        events=(_event_at(kind, at, wanted, rng, robot),),
        **of_kind,
    )
    return with_lanes_blocked(scenario, kind, street_map)


def _wanted_in_turn(rng: np.random.Generator, *, scanned: bool) -> Iterator[Wanted]:
    """Yield drawn properties for one draw after another: always the first ones.

    On a scan, others follow after a while. It has few places, and may have none for a long route.
    """
    first = drawn_wanted(rng)
    for number in itertools.count():
        yield drawn_wanted(rng) if scanned and number >= TRIES // 4 else first


def drawn_wanted(rng: np.random.Generator) -> Wanted:
    """Draw what is drawn before the place: each uniformly."""
    length_m, share = float(rng.uniform(*WAY_M)), float(rng.random())
    side, free_side = rng.integers(2, size=2).tolist()
    return Wanted(length_m, share, 1 if side else -1, 1 if free_side else -1)


def strips_of(kind: EventKind, street_map: StreetMap, graph: WalkGraph) -> list[Strip]:
    """Return the strips on which a kind of event may fit, sorted by id. Nothing is drawn for this
    check.
    """
    if kind.layout is not None:
        return sidewalks_of(street_map, graph)
    strips = [
        street_map.strips[strip_id] for strip_id in sorted(graph.main_strips - street_map.steep)
    ]
    return [strip for strip in strips if strip.kind == "crossing" and strip.going == "plain"]


def _may_hold(kind: EventKind, strip: Strip) -> bool:
    """Return whether a way over a crosswalk may be as short as a route."""
    return kind.layout is not None or (
        not strip.signalised
        and None not in strip.corners
        and _CROSSING_M[0] <= strip.length_m <= _CROSSING_M[1]
    )


def _in_turn(strips: list[Strip], rng: np.random.Generator) -> Iterator[Strip]:
    """Return the strips in a drawn order, again and again."""
    order = rng.permutation(len(strips)).tolist()
    return (strips[i] for i in itertools.cycle(order))


def event_spot(
    kind: EventKind,
    strip: Strip,
    street_map: StreetMap,
    rng: np.random.Generator,
    robot: Robot,
    wanted: Wanted | None = None,
) -> EventSpot:
    """Draw a way along a strip and the place of an event on it.

    wanted: what was drawn before the place; drawn here if None. Raises SpecError if it does not
    fit.
    """
    if wanted is None:
        wanted = drawn_wanted(rng)
    if kind.layout is None:
        return _over(street_map, strip, rng, robot, wanted)
    return _along(kind, kind.layout, strip, rng, robot, wanted)


def _event_at(
    kind: EventKind, at: EventSpot, wanted: Wanted, rng: np.random.Generator, robot: Robot
) -> Event:
    return Event(
        id="e0",
        kind=kind.name,
        x_m=at.pose.x_m,
        y_m=at.pose.y_m,
        heading_rad=at.pose.heading_rad,
        route_s_m=at.route_s_m,
        half_width_m=at.half_width_m,
        half_length_m=at.half_length_m,
        people=people_of(kind, at.half_width_m, robot, rng),
        speed_mps=float(rng.uniform(*_SPEEDS_MPS)),
        side=wanted.side,
        free_side=wanted.free_side if kind.has_free_side else 0,
        trigger_m=at.trigger_m,
        patience_s=float(rng.uniform(*PATIENCE_S)),
    )


def _along(
    kind: EventKind,
    layout: SidewalkLayout,
    strip: Strip,
    rng: np.random.Generator,
    robot: Robot,
    wanted: Wanted,
) -> EventSpot:
    gate = layout.gate_half_m
    least_m = (layout.half_width_m if gate is None else gate[0]) + wider_m(robot)
    narrow = SpecError(f"the sidewalk is narrower than {2.0 * least_m:.2g} m")
    if strip.width_m / 2 < least_m:
        raise narrow
    assert kind.trigger_m is not None
    trigger_m = _drawn_trigger_m(kind.trigger_m, layout.after_m, wanted.length_m, rng)
    low_m, high_m = event_range_m(trigger_m, layout.after_m, wanted.length_m)
    event_m = low_m + wanted.share * (high_m - low_m)
    line, half_m = straight_along(strip, max(wanted.length_m, event_m), rng)
    if half_m < least_m:
        raise narrow
    pose = line.at(event_m)
    found = Gate(0.0, half_m)
    if gate is not None:
        pose, half_m = middle_at(strip, pose, half_m)
        found = drawn_gate(gate, half_m, pose, rng, robot)
    sin, cos = math.sin(pose.heading_rad), math.cos(pose.heading_rad)
    aside = pose.x_m - found.left_m * sin, pose.y_m + found.left_m * cos
    return EventSpot(
        route_points(line, wanted.length_m, _STEP_M),
        Pose(*aside, pose.heading_rad),
        event_m,
        found.half_m,
        trigger_m=trigger_m,
        fences=found.fences,
    )


def _drawn_trigger_m(
    kind_m: float, after_m: float, length_m: float, rng: np.random.Generator
) -> float:
    """Draw the distance before an event at which it begins, short enough for the route."""
    low_m, high_m = sorted(share * kind_m for share in _TRIGGER_SHARE)
    low_m = max(low_m, min(kind_m, _NEAREST_TRIGGER_M))
    most_m = length_m - after_m - _BEFORE_TRIGGER_M - _BAND_M
    if most_m < low_m:
        raise SpecError("the route is too short for the event")
    return float(rng.uniform(low_m, min(high_m, most_m)))


def event_range_m(trigger_m: float, after_m: float, length_m: float) -> tuple[float, float]:
    """Return the least and largest arc length of an event on a route, in metres."""
    return max(trigger_m, 0.0) + _BEFORE_TRIGGER_M, length_m - after_m


def event_share(scenario: Scenario, kind: EventKind) -> float:
    """Return the position of a scenario's event, as a share of the range in which it fits.

    It is 0.5 if the range is too small to draw from.
    """
    (event,) = scenario.events
    length_m = scenario.route_line.length_m
    trigger_m = kind.trigger_m_of(event)
    if kind.layout is None or trigger_m is None:
        low_m = ROUND_CROSSING_M[0] + event.half_length_m
        high_m = length_m - ROUND_CROSSING_M[1] - event.half_length_m
    else:
        low_m, high_m = event_range_m(trigger_m, kind.layout.after_m, length_m)
    if high_m - low_m < 0.9 * _BAND_M:
        return 0.5
    return (event.route_s_m - low_m) / (high_m - low_m)


def route_points(line: Polyline, length_m: float, step_m: float = 1.0) -> Floats:
    """Return points of a straight line up to a length, (N, 2), at most step_m apart, in whole
    millimetres.
    """
    steps = np.linspace(0.0, length_m, math.ceil(length_m / step_m) + 1)
    return np.round([line.at(float(s)).xy for s in steps], 3)


def _over(
    street_map: StreetMap, strip: Strip, rng: np.random.Generator, robot: Robot, wanted: Wanted
) -> EventSpot:
    """Draw a straight way over a crosswalk whose place on the way is wanted."""
    leave, ends = _crossed(strip, rng)
    over_m = float(np.hypot(*(ends[1] - ends[0])))
    before_m, after_m = ROUND_CROSSING_M
    spare_m = wanted.length_m - over_m - before_m - after_m
    if spare_m < 0.0:
        raise SpecError("the route is too short for the crossing")
    from_m = before_m + wanted.share * spare_m + over_m / 2
    room_m = _ROOM_M + 0.5 * wider_m(robot)
    to_m = wanted.length_m - from_m
    route = _straight_way(street_map, ends, from_m, to_m, room_m)
    line = LineString(route.points)
    near = (one for one in street_map.near("strip", line) if isinstance(one, Strip))
    if any(one.kind == "crossing" and one.polygon.intersects(line) for one in near if one != strip):
        raise SpecError("the way leads over two crossings")
    return _spot_over(
        street_map, strip, leave, Polyline(route_points(route, route.length_m, _STEP_M))
    )


def _crossed(strip: Strip, rng: np.random.Generator) -> tuple[Literal[0, 1], Floats]:
    """Draw the end of a crosswalk at which it is left; return it and both ends in order."""
    leave: Literal[0, 1] = 1 if rng.random() < 0.5 else 0
    if not _CROSSING_M[0] <= strip.length_m <= _CROSSING_M[1] or None in strip.corners:
        raise SpecError("the crossing is too short or too long")
    if strip.signalised:
        raise SpecError("the crossing has signals: waiting there takes longer than the episode")
    return leave, strip.line[[0, -1], :2] if leave else strip.line[[-1, 0], :2]


def _straight_way(
    street_map: StreetMap, ends: Floats, before_m: float, after_m: float, room_m: float
) -> Polyline:
    """Return a straight way over a crosswalk, with lengths before and after its middle.

    Raises SpecError unless the ground is walkable with `room_m` on either side.
    """
    middle = ends.mean(axis=0)
    along_rad = math.atan2(*(ends[1] - ends[0])[::-1].tolist())
    around = shapely.buffer(LineString(ends), max(before_m, after_m) + 1.0)
    walkable = street_map.walkable_near(around)
    shapely.prepare(walkable)
    lines = []
    for turn_rad, shift_m in _ASLANT:
        along = np.array([math.cos(along_rad + turn_rad), math.sin(along_rad + turn_rad)])
        at = middle + shift_m * np.array([-along[1], along[0]])
        lines.append(np.stack([at - before_m * along, at + after_m * along]))
    swept = shapely.buffer(shapely.linestrings(lines), room_m, cap_style="flat")
    fitting = np.flatnonzero(shapely.covers(walkable, swept))
    if not len(fitting):
        raise SpecError("there is no room straight on beside the crossing")
    return Polyline(lines[int(fitting[0])])


def over_crossing(
    street_map: StreetMap, strip: Strip, rng: np.random.Generator, robot: Robot
) -> EventSpot:
    """Draw the way of a unit scenario over a crosswalk. Raises SpecError if it does not fit."""
    leave, ends = _crossed(strip, rng)
    route = Polyline(
        np.round(_straight_over(street_map, ends, _ROOM_M + 0.5 * wider_m(robot)), 3)
    ).resampled(0.99)
    return _spot_over(street_map, strip, leave, Polyline(np.round(route.points, 3)))


def _spot_over(
    street_map: StreetMap, strip: Strip, leave: Literal[0, 1], route: Polyline
) -> EventSpot:
    """Return the place of an event on the crosswalk that a straight route leaves at an end."""
    enter: Literal[0, 1] = 0 if leave else 1
    crossings = route_crossings(street_map, route, [Port(strip.id, enter), Port(strip.id, leave)])
    enter_m, leave_m = crossings[0].enter_s_m, crossings[0].leave_s_m
    middle_m = 0.5 * (enter_m + leave_m)
    half_length_m = 0.5 * (leave_m - enter_m)
    pose = route.at(middle_m)
    return EventSpot(route.points, pose, middle_m, strip.width_m / 2, half_length_m, crossings)


def _straight_over(street_map: StreetMap, ends: Floats, room_m: float) -> Floats:
    """Return a straight way over a crosswalk, from before its first end to beyond its second.

    It is (2, 2) in metres. It reaches as far as the ground is walkable straight on, with `room_m`
    on either side. Raises SpecError if it is too short.
    """
    along = (ends[1] - ends[0]) / np.hypot(*(ends[1] - ends[0]))
    walkable = street_map.walkable_near(
        shapely.buffer(LineString(ends), BESIDE_CROSSING_M[1] + 1.0)
    )
    reached = []
    for end, outward in ((ends[0], -along), (ends[1], along)):
        for far_m in np.arange(BESIDE_CROSSING_M[1], BESIDE_CROSSING_M[0] - 1e-9, -0.25):
            beyond = shapely.buffer(LineString([end, end + far_m * outward]), room_m)
            if shapely.covers(walkable, beyond):
                reached.append(end + far_m * outward)
                break
        else:
            raise SpecError("there is no room straight on beside the crossing")
    if np.hypot(*(reached[1] - reached[0])) < _SHORTEST_M:
        raise SpecError("the way over the crossing is too short")
    return np.array(reached)
