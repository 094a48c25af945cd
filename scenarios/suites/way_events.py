"""Place events along a long route, on straight sidewalks with room to pass and unsignalised
crosswalks.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from cosim.core.geometry import Polyline
from cosim.place.street_map import Port, StreetMap, Strip
from cosim.spec.events import Event, EventKind, EventKinds
from cosim.spec.robot import Robot
from cosim.spec.scenario import RouteCrossing
from scenarios.suites.drawing import people_of, wider_m

EVENT_EVERY_M: Final = 90.0
BESIDE_EVENT_M: Final = 0.95
"""Least difference between half the width of a sidewalk with an event and the robot, in metres. It
leaves room to pass.
"""
_APART_M: Final = 45.0
"""Least distance between two events along the route, in metres."""
_FROM_START_M = 30.0
_FROM_GOAL_M = 20.0
_LOOK_M: Final = 45.0
"""Distance ahead in which room for an event is searched, for one kind after the other, in
metres.
"""
_STEP_M: Final = 2.5
BENDS_M: Final = 0.4
_SLACK_M: Final = 2.0
_SPEEDS_MPS: Final = (1.1, 1.65)
_CROSSING_M: Final = (5.0, 12.0)
_ON_CROSSWALKS: Final = 0.4
"""Share of the straight crosswalks without signals on which people come towards the robot."""
_CROSSING_BEND_M: Final = 0.6
_BESIDE_CROSSING_M: Final = 1.0
"""Length of straight route before and behind such a crosswalk, in metres, as in reactive
scenarios.
"""


class WaySpot(NamedTuple):
    """Possible place of an event. half_length_m: half the length of a crosswalk, else 0."""

    s_m: float
    half_width_m: float
    half_length_m: float = 0.0


def draw_events(
    street_map: StreetMap,
    route: Polyline,
    way: Sequence[Port],
    crossings: Sequence[RouteCrossing],
    rng: np.random.Generator,
    robot: Robot,
    kinds: EventKinds,
) -> tuple[Event, ...]:
    """Draw events about every EVENT_EVERY_M metres.

    The kinds take turns in a drawn order. Each is placed where it has enough room.
    """
    on_crosswalks = [kind for kind in kinds.values() if kind.layout is None]
    turns = [kind for kind in kinds.values() if kind.layout is not None]
    turns = [turns[int(i)] for i in rng.permutation(len(turns))]
    chosen: list[tuple[WaySpot, EventKind]] = []
    for spot in crosswalk_spots(street_map, route, crossings):
        inside = _FROM_START_M <= spot.s_m <= route.length_m - _FROM_GOAL_M
        if on_crosswalks and inside and rng.random() < _ON_CROSSWALKS and _apart(spot, chosen):
            chosen.append((spot, on_crosswalks[int(rng.integers(len(on_crosswalks)))]))
    wide_m = 2.0 * (robot.width_m + BESIDE_EVENT_M)
    spots = [
        WaySpot(s_m, strip.width_m / 2)
        for s_m in np.arange(_FROM_START_M, route.length_m - _FROM_GOAL_M, _STEP_M).tolist()
        if (strip := _sidewalk_at(street_map, way, route, s_m)) is not None
        and strip.width_m >= wide_m
    ]
    next_s_m = _FROM_START_M
    while next_s_m < route.length_m:
        near = [
            spot
            for spot in spots
            if next_s_m <= spot.s_m < next_s_m + _LOOK_M and _apart(spot, chosen)
        ]
        fitting = (
            (spot, kind) for kind in turns for spot in near if _has_room(kind, spot, route, robot)
        )
        found = next(fitting, None)
        if found is None:
            next_s_m += _LOOK_M
            continue
        chosen.append(found)
        turns.remove(found[1])
        turns.append(found[1])
        next_s_m = found[0].s_m + float(rng.uniform(0.6, 1.4)) * EVENT_EVERY_M
    chosen.sort(key=lambda one: one[0].s_m)
    return tuple(
        _event(f"e{n}", kind, spot, route, robot, rng) for n, (spot, kind) in enumerate(chosen)
    )


def _event(
    event_id: str,
    kind: EventKind,
    spot: WaySpot,
    route: Polyline,
    robot: Robot,
    rng: np.random.Generator,
) -> Event:
    pose = route.at(spot.s_m)
    before, behind = (route.at(spot.s_m + d_m) for d_m in (-spot.half_length_m, spot.half_length_m))
    along_rad = math.atan2(behind.y_m - before.y_m, behind.x_m - before.x_m)
    return Event(
        id=event_id,
        kind=kind.name,
        x_m=pose.x_m,
        y_m=pose.y_m,
        heading_rad=along_rad if spot.half_length_m else pose.heading_rad,
        route_s_m=spot.s_m,
        half_width_m=spot.half_width_m,
        half_length_m=spot.half_length_m,
        people=people_of(kind, spot.half_width_m, robot, rng),
        speed_mps=float(rng.uniform(*_SPEEDS_MPS)),
        side=1 if rng.random() < 0.5 else -1,
    )


def _apart(spot: WaySpot, chosen: Sequence[tuple[WaySpot, EventKind]]) -> bool:
    return all(abs(spot.s_m - other.s_m) >= _APART_M for other, _ in chosen)


def crosswalk_spots(
    street_map: StreetMap, route: Polyline, crossings: Sequence[RouteCrossing]
) -> list[WaySpot]:
    """Return the crossings without signals that the route crosses straight and that have a usual
    length.
    """
    found = []
    for crossing in crossings:
        strip = street_map.strips[crossing.id]
        half_m = 0.5 * (crossing.leave_s_m - crossing.enter_s_m)
        from_m = crossing.enter_s_m - _BESIDE_CROSSING_M
        to_m = crossing.leave_s_m + _BESIDE_CROSSING_M
        fits = not crossing.signalised and _CROSSING_M[0] <= 2.0 * half_m <= _CROSSING_M[1]
        if fits and is_straight_between(route, from_m, to_m, _CROSSING_BEND_M):
            found.append(WaySpot(crossing.enter_s_m + half_m, strip.width_m / 2, half_m))
    return found


def _has_room(kind: EventKind, spot: WaySpot, route: Polyline, robot: Robot) -> bool:
    """Return whether the sidewalk is wide enough for a kind of event.

    It must also be straight as far before and behind the event as in the scenarios of that kind.
    """
    layout = kind.layout
    if layout is None or spot.half_width_m < layout.half_width_m + wider_m(robot):
        return False
    from_m = spot.s_m - layout.event_m[1] - _SLACK_M
    to_m = spot.s_m + max(2.0 * _STEP_M, layout.way_m[0] - layout.event_m[0])
    return from_m >= 0.0 and to_m <= route.length_m and is_straight_between(route, from_m, to_m)


def _sidewalk_at(
    street_map: StreetMap, way: Sequence[Port], route: Polyline, s_m: float
) -> Strip | None:
    """Return the sidewalk of the way at an arc length of the route, None on corners and
    crossings.
    """
    pose = route.at(s_m)
    strip = street_map.strips.get(street_map.locate(pose.x_m, pose.y_m, 0.05).edge)
    return (
        strip
        if strip is not None and strip.kind == "sidewalk" and strip.id in {p.strip for p in way}
        else None
    )


def is_straight_between(
    route: Polyline, from_m: float, to_m: float, bend_m: float = BENDS_M
) -> bool:
    """Return whether the route bends by less than `bend_m` between two arc lengths."""
    chord = Polyline([route.at(from_m).xy, route.at(to_m).xy])
    between = route.points[(route.s_m > from_m) & (route.s_m < to_m)]
    return all(abs(chord.project(x, y)[1]) < bend_m for x, y in between)
