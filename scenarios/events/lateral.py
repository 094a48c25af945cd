"""`lateral`: crosses the robot's path at a right angle, on a collision course at constant velocity.

Its direction is fixed at the trigger, and again after it avoided a person. Its speed follows the
robot's: it slows down and stops with the robot, so slowing down does not let it cross. Once the
robot has stood for `CROSSES_AFTER_S`, it crosses to the other edge of the sidewalk and walks on
along it.
"""

from __future__ import annotations

import math
from typing import Final

import msgspec

from cosim.core.state import PERSON_RADIUS_M
from cosim.people.yielding import ROBOT_STANDS_MPS
from cosim.spec.events import Event, EventKind, EventQuery, EventState, SidewalkLayout, Walker
from scenarios.events.sight import sight_of
from scenarios.events.walking import edge_m, gives_up, walk_on, walk_straight, walker_at

SLOWEST_MPS: Final = 0.05
"""Lower bound of its speed in m/s."""
_FASTEST_MPS: Final = 2.0
"""Upper bound of its speed in m/s, for very fast robots."""
_SQUARE: Final = 0.3
"""Smallest sine of the angle between both paths at which a meeting point is computed."""
CROSSES_AFTER_S: Final = 2.5
"""Seconds that the robot must stand before the person crosses first."""


def _begin(event: Event, number: int) -> Walker:
    return walker_at(event, 0.0, event.side * edge_m(event), -event.side * math.pi / 2)


def _step(event: Event, state: EventState, number: int, query: EventQuery) -> Walker:
    walker = state.walkers[number]
    sight = sight_of(event, number, query)
    if state.phase == "over":
        return walk_on(walker, event.heading_rad + math.pi, event.speed_mps, sight)
    across_rad = event.heading_rad - event.side * math.pi / 2
    if state.robot_stood_ticks * query.tick_ms >= 1000 * CROSSES_AFTER_S:
        return msgspec.structs.replace(
            walk_on(walker, across_rad, event.speed_mps, sight), aim_rad=None
        )
    if walker.aim_rad is None or walker.pace_mps is None:
        aim_rad, pace_mps = _course(event, walker, query)
        walker = msgspec.structs.replace(walker, aim_rad=aim_rad, pace_mps=pace_mps)
    elif (now_mps := _pace_to_meet(walker, walker.aim_rad, query)) is not None:
        if query.robot_v_mps < ROBOT_STANDS_MPS:
            return walker
        walker = msgspec.structs.replace(walker, pace_mps=now_mps)
    assert walker.aim_rad is not None and walker.pace_mps is not None
    return walk_straight(walker, walker.aim_rad, walker.pace_mps, sight)


def _ends(event: Event, state: EventState, query: EventQuery) -> bool:
    (walker,) = state.walkers
    dx, dy = walker.x_m - event.x_m, walker.y_m - event.y_m
    left_m = -dx * math.sin(event.heading_rad) + dy * math.cos(event.heading_rad)
    return -event.side * left_m >= edge_m(event) or gives_up(walker, query)


def _course(event: Event, walker: Walker, query: EventQuery) -> tuple[float, float]:
    """Return heading and speed of the collision course.

    A person that avoided others and can no longer meet the robot walks straight across at its last
    speed.
    """
    aim_rad, pace_mps = collision_course(walker, query, event.side)
    if walker.pace_mps is None:
        return aim_rad, pace_mps
    across_rad = event.heading_rad - event.side * math.pi / 2
    dx, dy = walker.x_m - query.robot_x_m, walker.y_m - query.robot_y_m
    passed = math.cos(query.robot_heading_rad) * dx + math.sin(query.robot_heading_rad) * dy <= 0.0
    if passed or math.cos(aim_rad - across_rad) <= 0.0:
        return across_rad, walker.pace_mps
    return aim_rad, pace_mps


def _pace_to_meet(walker: Walker, aim_rad: float, query: EventQuery) -> float | None:
    """Return the speed in m/s to reach the robot's line together with the robot.

    None if the person is on the line already, or the robot is past it.
    """
    cos, sin = math.cos(query.robot_heading_rad), math.sin(query.robot_heading_rad)
    dx, dy = walker.x_m - query.robot_x_m, walker.y_m - query.robot_y_m
    across = cos * math.sin(aim_rad) - sin * math.cos(aim_rad)
    if abs(across) < _SQUARE:
        return None
    to_line_m = (sin * dx - cos * dy) / across
    ahead_m = cos * (dx + math.cos(aim_rad) * to_line_m) + sin * (
        dy + math.sin(aim_rad) * to_line_m
    )
    if to_line_m <= PERSON_RADIUS_M or ahead_m <= 0.0:
        return None
    return min(max(to_line_m * query.robot_v_mps / ahead_m, SLOWEST_MPS), _FASTEST_MPS)


def collision_course(walker: Walker, query: EventQuery, side: int) -> tuple[float, float]:
    """Return (heading, speed) at a right angle to the robot, to meet its centre.

    side: Side of the robot's path the walker comes from: left (1) or right (-1).
    """
    cos, sin = math.cos(query.robot_heading_rad), math.sin(query.robot_heading_rad)
    dx, dy = walker.x_m - query.robot_x_m, walker.y_m - query.robot_y_m
    ahead_m = cos * dx + sin * dy
    left_m = -sin * dx + cos * dy
    towards = -math.copysign(1.0, left_m if abs(left_m) > 1e-6 else side)
    arrival_s = max(ahead_m, 0.0) / max(query.robot_v_mps, 1e-6)
    pace_mps = abs(left_m) / max(arrival_s, 1e-6)
    return query.robot_heading_rad + towards * math.pi / 2, min(
        max(pace_mps, SLOWEST_MPS), _FASTEST_MPS
    )


LATERAL: Final = EventKind(
    name="lateral",
    layout=SidewalkLayout((15.0, 20.0), (8.0, 11.0)),
    trigger_m=4.0,
    begin=_begin,
    step=_step,
    ends=_ends,
)
