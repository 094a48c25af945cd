"""`overtaking`: follows when the robot has just passed, overtakes closely and cuts in.

It follows the robot's line, also after it has cut in, and waits beside a robot that stands. In
front of the robot it slows down to half of the robot's current speed. A robot that keeps its course
at any speed collides. A robot that slows down until the person is let in does not. Then the person
continues at its own pace. In a reactive scenario the robot must give way like this: to pass the
person again without slowing down breaks a rule.

The person of a decoy overtakes in the same way, and walks on without cutting in.
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
from scenarios.events.sight import Sight, sight_of
from scenarios.events.walking import (
    along_m,
    distance_m,
    edge_m,
    left_m,
    lost_patience,
    robot_stands,
    robots_line_m,
    waiting_for_robot,
    walk_on,
    walk_straight,
    walk_to,
    walker_at,
    world_point,
)

_FASTER_MPS: Final = 1.4
"""Speed difference to the robot in m/s while overtaking."""
_FASTEST_MPS: Final = 4.0
"""Highest speed in m/s, a jogger's pace."""
WAITS_ASIDE_M: Final = 1.2
"""Largest distance in metres from the middle of the sidewalk where it waits."""
BESIDE_ROBOT_M: Final = 0.95
"""Lateral distance in metres between its centre and the robot's while it passes."""
_CUTS_IN_M: Final = 1.0
"""Lead in metres at which it turns to the robot's line."""
_BEFORE_ROBOT_M: Final = 1.5
"""Lead in metres at which it slows down on the robot's line."""
ON_LINE_M: Final = 0.15
"""Lateral distance in metres at which it counts as on the robot's line."""
SLOWED_FRACTION: Final = 0.5
"""Its speed after cutting in, as a fraction of the robot's."""
_CREEPS_MPS: Final = 0.1
"""Lowest speed in m/s after cutting in."""
_EASES_MPS2: Final = 0.6
"""Acceleration in m/s^2 with which its speed follows the robot's after cutting in."""
YIELDED_S: Final = 5.0
"""Seconds without an approach after which a robot that moves counts as having let it in."""
_NEARER_M: Final = 0.1
"""Metres by which the lead must shrink to count as an approach."""
_COMMIT_M: Final = 0.3
"""Gap in metres to the robot below which it no longer follows the robot's line."""
_TO_LINE_S: Final = 0.4
"""Time in seconds in which it steps back to the robot's line after cutting in."""
_SIDEWAYS_MPS: Final = 1.2
"""Highest speed in m/s at which it does so."""
_CLEAR_AHEAD_M: Final = 5.0
"""Lead in metres at which the person of a decoy has overtaken."""
_LOOK_AHEAD_M: Final = 1.2
"""Metres ahead on its line that it aims at, while the robot moves."""
_CUTS_SHORT_M: Final = 0.4
"""The same while the robot stands."""


def _begin(event: Event, number: int) -> Walker:
    return walker_at(event, 0.0, event.side * min(edge_m(event), WAITS_ASIDE_M), 0.0)


def _step(event: Event, state: EventState, number: int, query: EventQuery) -> Walker:
    walker = state.walkers[number]
    sight = sight_of(event, number, query)
    if state.phase == "over":
        return walk_on(walker, event.heading_rad, event.speed_mps, sight)
    if walker.pace_mps is not None:
        return _before_robot(event, waiting_for_robot(event, walker, query), query, sight)
    if robot_stands(query) and walker.aim_rad is None:
        return walker
    lead_m = _lead_m(event, walker, query)
    line_m = left_m(event, query.robot_x_m, query.robot_y_m)
    if walker.aim_rad is None and lead_m >= _CUTS_IN_M:
        walker = msgspec.structs.replace(walker, aim_rad=event.heading_rad)
    if walker.aim_rad is None:
        line_m = _beside_m(event, line_m)
    elif (
        lead_m >= _BEFORE_ROBOT_M
        and abs(left_m(event, walker.x_m, walker.y_m) - line_m) < ON_LINE_M
    ):
        return msgspec.structs.replace(walker, pace_mps=_slowed_mps(query))
    ahead_m = _CUTS_SHORT_M if robot_stands(query) else _LOOK_AHEAD_M
    aim = world_point(event, along_m(event, walker.x_m, walker.y_m) + ahead_m, line_m)
    return walk_to(walker, *aim, _passing_mps(event, query), sight)


def _before_robot(event: Event, walker: Walker, query: EventQuery, sight: Sight) -> Walker:
    """Move one tick in front of the robot: slowly, and on its line until the robot is near."""
    if robot_stands(query):
        return walker
    walker = _eased(event, walker, query)
    assert walker.pace_mps is not None
    sideways_mps = 0.0
    if distance_m(walker, query) > query.robot_length_m / 2 + PERSON_RADIUS_M + _COMMIT_M:
        line_m = robots_line_m(event, query, max(_lead_m(event, walker, query), 0.0))
        off_m = line_m - left_m(event, walker.x_m, walker.y_m)
        sideways_mps = max(-_SIDEWAYS_MPS, min(_SIDEWAYS_MPS, off_m / _TO_LINE_S))
    heading_rad = event.heading_rad + math.atan2(sideways_mps, walker.pace_mps)
    return walk_straight(walker, heading_rad, math.hypot(sideways_mps, walker.pace_mps), sight)


def _decoy_step(event: Event, state: EventState, number: int, query: EventQuery) -> Walker:
    walker = state.walkers[number]
    if state.phase == "over" or _lead_m(event, walker, query) < _CUTS_IN_M:
        return _step(event, state, number, query)
    sight = sight_of(event, number, query)
    return walk_on(walker, event.heading_rad, _passing_mps(event, query), sight)


def _decoy_ends(event: Event, state: EventState, query: EventQuery) -> bool:
    return _lead_m(event, state.walkers[0], query) >= _CLEAR_AHEAD_M


def _passing_mps(event: Event, query: EventQuery) -> float:
    return min(max(event.speed_mps, query.robot_v_mps + _FASTER_MPS), _FASTEST_MPS)


def _eased(event: Event, walker: Walker, query: EventQuery) -> Walker:
    """Adapt its speed to the robot's and count the ticks without an approach."""
    assert walker.pace_mps is not None
    change_mps = _EASES_MPS2 * query.tick_ms / 1000
    pace_mps = walker.pace_mps + max(
        -change_mps, min(change_mps, _slowed_mps(query) - walker.pace_mps)
    )
    lead_m = _lead_m(event, walker, query)
    if walker.nearest_m is None or lead_m < walker.nearest_m - _NEARER_M:
        return msgspec.structs.replace(walker, pace_mps=pace_mps, nearest_m=lead_m, counted_ticks=0)
    return msgspec.structs.replace(
        walker, pace_mps=pace_mps, counted_ticks=walker.counted_ticks + 1
    )


def _slowed_mps(query: EventQuery) -> float:
    return max(SLOWED_FRACTION * query.robot_v_mps, _CREEPS_MPS)


def _beside_m(event: Event, line_m: float) -> float:
    """Return the lateral offset in metres at which it passes, on its own side if there is room."""
    room_m = event.half_width_m - PERSON_RADIUS_M
    own_side_m = line_m + event.side * BESIDE_ROBOT_M
    return own_side_m if abs(own_side_m) <= room_m else line_m - event.side * BESIDE_ROBOT_M


def _lead_m(event: Event, walker: Walker, query: EventQuery) -> float:
    return along_m(event, walker.x_m, walker.y_m) - along_m(event, query.robot_x_m, query.robot_y_m)


def _ends(event: Event, state: EventState, query: EventQuery) -> bool:
    """Return whether the robot has let it in or has overtaken it."""
    (walker,) = state.walkers
    passed = walker.pace_mps is not None and _lead_m(event, walker, query) < -1.0
    waited = walker.counted_ticks * query.tick_ms / 1000 >= YIELDED_S
    return passed or waited or lost_patience(event, walker, query)


OVERTAKING: Final = EventKind(
    name="overtaking",
    layout=SidewalkLayout((18.0, 20.0), (1.5, 3.0), half_width_m=1.4, after_m=10.0),
    trigger_m=-1.0,
    begin=_begin,
    step=_step,
    ends=_ends,
    decoy=Decoy(_decoy_step, _decoy_ends),
    gives_way=True,
)
