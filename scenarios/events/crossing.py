"""`ped_crossing`: people cross from both ends when the robot enters the crosswalk.

The first comes from the front, in the middle or on the robot's line. Every second one comes from
behind.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from cosim.spec.events import Event, EventKind, EventQuery, EventState, Walker
from scenarios.events.sight import sight_of
from scenarios.events.walking import (
    along_m,
    edge_m,
    gives_up,
    left_m,
    meeting_offset_m,
    walk_on,
    walk_straight,
    walker_at,
)

_BEFORE_M: Final = 0.8
"""Metres before the crosswalk where each person waits, and after it where they have crossed."""
BEHIND_ROBOT_M: Final = 1.6
"""Extra metres for people from behind, because the robot has just passed them."""
LARGEST_MEETING_GROUP: Final = 2
"""Largest group whose first person walks on the robot's line.

In larger groups it walks in the middle, because others meet a robot at the side.
"""
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
    if from_front(number) and not gives_up(walker, query) and not _passed(event, walker, query):
        if number == 0:
            room_m = edge_m(event) if event.people <= LARGEST_MEETING_GROUP else 0.0
            off_m = left_m(event, walker.x_m, walker.y_m) - meeting_offset_m(state.lane_m, room_m)
            heading_rad += math.atan2(off_m, TO_LINE_M)
        return walk_straight(walker, heading_rad, event.speed_mps, sight)
    if _across(event, walker, number):
        return walker
    return walk_on(walker, heading_rad, event.speed_mps, sight)


def _ends(event: Event, state: EventState, query: EventQuery) -> bool:
    return all(_across(event, walker, number) for number, walker in enumerate(state.walkers))


def _passed(event: Event, walker: Walker, query: EventQuery) -> bool:
    here = along_m(event, walker.x_m, walker.y_m)
    return here < along_m(event, query.robot_x_m, query.robot_y_m) - 1.0


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
)
