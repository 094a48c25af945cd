"""`lateral`: crosses the robot's path at a right angle, so as to meet the robot.

Its speed follows the robot's: it slows down and stops with the robot, so slowing down does not let
it cross. Until late it also follows the robot's line, back and forth. It crosses first only after
the robot has stood near it for its patience: it walks to the other edge of the sidewalk and on
along it.

The person of a decoy walks up to the edge of the robot's path, and waits there until the robot has
passed.
"""

from __future__ import annotations

import math
from typing import Final

import msgspec

from cosim.core.state import PERSON_RADIUS_M
from cosim.spec.events import (
    Decoy,
    Event,
    EventKind,
    EventQuery,
    EventState,
    SidewalkLayout,
    Walker,
)
from scenarios.events.sight import sight_of
from scenarios.events.walking import (
    edge_m,
    left_m,
    lost_patience,
    robot_stands,
    waiting_for_robot,
    walk_on,
    walk_straight,
    walk_to,
    walker_at,
    world_point,
)

SLOWEST_MPS: Final = 0.05
"""Lower bound of its speed in m/s."""
_FASTEST_MPS: Final = 2.0
"""Upper bound of its speed in m/s, for very fast robots."""
_SQUARE: Final = 0.3
"""Smallest sine of the angle between both paths at which a meeting point is computed."""
COMMIT_M: Final = 1.5
"""Gap in metres between the robot and its path below which the person keeps its direction."""
STOPS_SHORT_M: Final = 0.22
"""Gap in metres between the person of a decoy and the robot's path."""
STOPS_BEFORE_M: Final = 2.6
"""Distance in metres of the robot's centre at which the person of a decoy has stopped, at last."""


class _Meeting:
    """Where a person meets the robot.

    to_line_m: distance in metres to walk across until the robot's line, negative beyond it.
    ahead_m: distance in metres of the robot's centre from that point.
    """

    def __init__(self, walker: Walker, across_rad: float, query: EventQuery) -> None:
        cos, sin = math.cos(query.robot_heading_rad), math.sin(query.robot_heading_rad)
        dx, dy = walker.x_m - query.robot_x_m, walker.y_m - query.robot_y_m
        across = cos * math.sin(across_rad) - sin * math.cos(across_rad)
        self.crosses = abs(across) >= _SQUARE
        self.to_line_m = (sin * dx - cos * dy) / across if self.crosses else 0.0
        self.ahead_m = cos * (dx + math.cos(across_rad) * self.to_line_m) + sin * (
            dy + math.sin(across_rad) * self.to_line_m
        )

    def pace_mps(self, query: EventQuery) -> float:
        """Return the speed in m/s at which the person is there together with the robot."""
        pace_mps = abs(self.to_line_m) * max(query.robot_v_mps, 0.0) / max(self.ahead_m, 1e-6)
        return min(max(pace_mps, SLOWEST_MPS), _FASTEST_MPS)


def _begin(event: Event, number: int) -> Walker:
    return walker_at(event, 0.0, event.side * edge_m(event), -event.side * math.pi / 2)


def _step(event: Event, state: EventState, number: int, query: EventQuery) -> Walker:
    walker = state.walkers[number]
    sight = sight_of(event, number, query)
    if state.phase == "over":
        return walk_on(walker, event.heading_rad + math.pi, event.speed_mps, sight)
    across_rad = event.heading_rad - event.side * math.pi / 2
    walker = waiting_for_robot(event, walker, query)
    meeting = _Meeting(walker, across_rad, query)
    if lost_patience(event, walker, query) or (meeting.crosses and meeting.ahead_m <= 0.0):
        return msgspec.structs.replace(
            walk_on(walker, across_rad, event.speed_mps, sight), aim_rad=None
        )
    if robot_stands(query):
        return walker
    walker = _on_course(walker, across_rad, meeting, query)
    assert walker.aim_rad is not None and walker.pace_mps is not None
    return walk_straight(walker, walker.aim_rad, walker.pace_mps, sight)


def _on_course(walker: Walker, across_rad: float, meeting: _Meeting, query: EventQuery) -> Walker:
    """Return the walker with heading and speed adapted to the robot, as far as it still adapts."""
    if not meeting.crosses:
        aim_rad = across_rad if walker.aim_rad is None else walker.aim_rad
        pace_mps = SLOWEST_MPS if walker.pace_mps is None else walker.pace_mps
        return msgspec.structs.replace(walker, aim_rad=aim_rad, pace_mps=pace_mps)
    if walker.aim_rad is None or walker.pace_mps is None or _adapts(meeting, query):
        aim_rad = across_rad if meeting.to_line_m >= 0.0 else across_rad + math.pi
        return msgspec.structs.replace(walker, aim_rad=aim_rad, pace_mps=meeting.pace_mps(query))
    comes = math.cos(walker.aim_rad - across_rad) * meeting.to_line_m > PERSON_RADIUS_M
    return msgspec.structs.replace(walker, pace_mps=meeting.pace_mps(query)) if comes else walker


def _adapts(meeting: _Meeting, query: EventQuery) -> bool:
    return meeting.ahead_m > query.robot_length_m / 2 + PERSON_RADIUS_M + COMMIT_M


def _ends(event: Event, state: EventState, query: EventQuery) -> bool:
    (walker,) = state.walkers
    return -event.side * left_m(event, walker.x_m, walker.y_m) >= edge_m(event)


def _decoy_step(event: Event, state: EventState, number: int, query: EventQuery) -> Walker:
    walker = state.walkers[number]
    if state.phase == "over":
        return _step(event, state, number, query)
    sight = sight_of(event, number, query)
    across_rad = event.heading_rad - event.side * math.pi / 2
    room_m = 0.5 * query.robot_width_m + PERSON_RADIUS_M + STOPS_SHORT_M
    line_m = event.side * left_m(event, query.robot_x_m, query.robot_y_m)
    short_m = min(max(line_m + room_m, 0.0), edge_m(event))
    meeting = _Meeting(walker, across_rad, query)
    stops = meeting.ahead_m <= STOPS_BEFORE_M
    if stops or event.side * left_m(event, walker.x_m, walker.y_m) <= short_m:
        return walker
    pace_mps = event.speed_mps if robot_stands(query) else meeting.pace_mps(query)
    return walk_to(walker, *world_point(event, 0.0, event.side * short_m), pace_mps, sight)


def _decoy_stays(event: Event, number: int) -> tuple[tuple[float, float], ...]:
    """Return the ends of the line on which it stops, by the robot's line."""
    return world_point(event, 0.0, 0.0), world_point(event, 0.0, event.side * edge_m(event))


def _passed(event: Event, state: EventState, query: EventQuery) -> bool:
    return query.route_s_m - event.route_s_m >= 1.0


LATERAL: Final = EventKind(
    name="lateral",
    layout=SidewalkLayout((15.0, 20.0), (8.0, 11.0)),
    trigger_m=4.0,
    begin=_begin,
    step=_step,
    ends=_ends,
    decoy=Decoy(_decoy_step, _passed, stays=_decoy_stays),
)
