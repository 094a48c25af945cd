"""`ped_crossing`: people cross from both ends when the robot enters the crosswalk.

The first comes from the front on the robot's line, which it follows until late. Every second one
comes from behind. Those from the front wait while the robot stands farther away than MET_M. Before
a robot that stands nearer they stop, wait for their patience, and walk round it.

In a decoy they stay at the kerb. Those in the robot's way step aside and turn away.
"""

from __future__ import annotations

import math
from typing import Final

import msgspec
import numpy as np

from cosim.core.state import PERSON_RADIUS_M
from cosim.spec.events import Decoy, Event, EventKind, EventQuery, EventState, Walker
from scenarios.events.sight import sight_of
from scenarios.events.walking import (
    along_m,
    come_at_robot,
    edge_m,
    has_passed,
    lead_to_meeting_m,
    left_m,
    lost_patience,
    robots_line_m,
    turn_towards,
    waiting_for_robot,
    walk_on,
    walk_to,
    walker_at,
    world_point,
)

_BEFORE_M: Final = 0.8
"""Metres before the crosswalk where each person waits, and after it where they have crossed."""
BEHIND_ROBOT_M: Final = 1.6
"""Extra metres for people from behind, because the robot has just passed them."""
COMMIT_M: Final = 1.5
"""Gap in metres to the robot below which the first person keeps its line."""
PASSED_BY_M: Final = 3.0
"""Metres along the route beyond the crosswalk at which the robot has passed a decoy."""
TO_LINE_M: Final = 1.5
"""Look-ahead distance in metres at which a person aims for its line."""
_ABREAST_M: Final = 0.75
"""Metres between the lines of two people walking in the same direction."""


def _begin(event: Event, number: int) -> Walker:
    reach_m = event.half_length_m + _BEFORE_M
    left_m = max(-edge_m(event), min(edge_m(event), line_m(event, number)))
    if from_front(number):
        return walker_at(event, reach_m, left_m, math.pi)
    return walker_at(event, -reach_m - BEHIND_ROBOT_M, left_m, 0.0)


def from_front(number: int) -> bool:
    """Return whether this person walks towards the robot."""
    return number % 2 == 0


def line_m(event: Event, number: int) -> float:
    """Return the lateral offset in metres of a person's line, left of the middle."""
    rank = number // 2
    if from_front(number):
        return -event.side * rank * _ABREAST_M
    return event.side * (rank + 1) * _ABREAST_M


def _step(event: Event, state: EventState, number: int, query: EventQuery) -> Walker:
    walker = state.walkers[number]
    sight = sight_of(event, number, query)
    heading_rad = event.heading_rad + (math.pi if from_front(number) else 0.0)
    if from_front(number) and not has_passed(event, walker, query):
        walker = waiting_for_robot(event, walker, query)
        if not lost_patience(event, walker, query):
            if number == 0:
                walker, turn_rad = _to_robots_line(event, walker, query)
                heading_rad += turn_rad
            return come_at_robot(walker, heading_rad, event.speed_mps, sight)
    if _across(event, walker, number):
        return walker
    return walk_on(walker, heading_rad, event.speed_mps, sight)


def _to_robots_line(event: Event, walker: Walker, query: EventQuery) -> tuple[Walker, float]:
    """Return the walker and its turn (rad) towards the robot's line, which is fixed late."""
    gap_m = along_m(event, walker.x_m, walker.y_m) - along_m(
        event, query.robot_x_m, query.robot_y_m
    )
    late = gap_m < query.robot_length_m / 2 + PERSON_RADIUS_M + COMMIT_M
    if late and walker.aim_rad is not None:
        return walker, walker.aim_rad
    line_m = robots_line_m(event, query, lead_to_meeting_m(gap_m, query))
    turn_rad = math.atan2(left_m(event, walker.x_m, walker.y_m) - line_m, TO_LINE_M)
    return msgspec.structs.replace(walker, aim_rad=turn_rad), turn_rad


def _decoy_step(event: Event, state: EventState, number: int, query: EventQuery) -> Walker:
    """Step to the edge of the way in front of the robot, and turn away."""
    walker = state.walkers[number]
    if state.phase == "over" or not from_front(number):
        return walker
    (aside,) = _decoy_stays(event, number)
    if (walker.x_m, walker.y_m) != aside:
        sight = sight_of(event, number, query)
        return walk_to(walker, *aside, event.speed_mps, sight)
    heading_rad = turn_towards(walker.heading_rad, event.heading_rad, query.tick_ms / 1000)
    return msgspec.structs.replace(walker, heading_rad=heading_rad)


def _decoy_stays(event: Event, number: int) -> tuple[tuple[float, float], ...]:
    """Return the edge of the way for people from the front, and where the others wait."""
    if not from_front(number):
        waits = _begin(event, number)
        return ((waits.x_m, waits.y_m),)
    side = event.side if number == 0 else -event.side
    return (world_point(event, event.half_length_m + _BEFORE_M, side * edge_m(event)),)


def _decoy_ends(event: Event, state: EventState, query: EventQuery) -> bool:
    return query.route_s_m - event.route_s_m >= event.half_length_m + PASSED_BY_M


def _ends(event: Event, state: EventState, query: EventQuery) -> bool:
    return all(_across(event, walker, number) for number, walker in enumerate(state.walkers))


def _across(event: Event, walker: Walker, number: int) -> bool:
    done_m = along_m(event, walker.x_m, walker.y_m) * (-1.0 if from_front(number) else 1.0)
    return done_m >= event.half_length_m + _BEFORE_M


def _group(half_width_m: float, rng: np.random.Generator) -> int:
    """Draw a group size with at least one person from either side."""
    return int(rng.integers(2, 5))


PED_CROSSING: Final = EventKind(
    name="ped_crossing",
    people=(1, 4),
    layout=None,
    group=_group,
    trigger_m=None,
    begin=_begin,
    step=_step,
    ends=_ends,
    decoy=Decoy(_decoy_step, _decoy_ends, stays=_decoy_stays),
)
