"""`ped_crossing`: people cross from the far side and from behind when the robot enters the crosswalk.

The first comes from the front on the robot's own line; every second one comes from behind.
"""

from __future__ import annotations

import math
from typing import Final

import msgspec

from cosim.core.state import Doing
from cosim.spec.events import Event, EventQuery, EventState, Walker
from scenarios.events.behavior import Behavior, entered
from scenarios.events.sight import Sight, sight_of
from scenarios.events.walking import edge_m, gave_up, pressed_on, walked_on, walker_at

_BEFORE_M: Final = 0.8
"""How far before its end of the crosswalk each one waits, and behind its other end it is done."""
BEHIND_ROBOT_M: Final = 1.6
"""Those from behind wait this much farther back: the robot has just passed them."""
_ABREAST_M: Final = 0.75
"""Between the lines of two who walk the same way."""


def _begin(event: Event) -> tuple[Walker, ...]:
    return tuple(_waiting(event, number) for number in range(event.people))


def _waiting(event: Event, number: int) -> Walker:
    reach_m = event.half_length_m + _BEFORE_M
    left_m = max(-edge_m(event), min(edge_m(event), line_m(event, number)))
    if from_front(number):
        return walker_at(event, reach_m, left_m, math.pi)
    return walker_at(event, -reach_m - BEHIND_ROBOT_M, left_m, 0.0)


def from_front(number: int) -> bool:
    """Whether this person comes towards the robot."""
    return number % 2 == 0


def line_m(event: Event, number: int) -> float:
    """How far left of the middle of the crosswalk a person walks; the first one on the middle."""
    rank = number // 2
    if from_front(number):
        return -event.side * rank * _ABREAST_M
    return event.side * (rank + 1) * _ABREAST_M


def _act(event: Event, state: EventState, query: EventQuery) -> EventState:
    walkers = tuple(
        _crossed(event, walker, number, sight_of(event, number, query)) for number, walker in enumerate(state.walkers)
    )
    if state.phase == "acting" and all(_across(event, walker, number) for number, walker in enumerate(walkers)):
        return msgspec.structs.replace(state, phase="over", since_tick=query.tick, walkers=walkers)
    return msgspec.structs.replace(state, walkers=walkers)


def _crossed(event: Event, walker: Walker, number: int, sight: Sight) -> Walker:
    query = sight.query
    heading_rad = event.heading_rad + (math.pi if from_front(number) else 0.0)
    if from_front(number) and not gave_up(walker, query) and not _passed(event, walker, query):
        return pressed_on(walker, heading_rad, event.speed_mps, sight)
    if _across(event, walker, number):
        return walker
    return walked_on(walker, heading_rad, event.speed_mps, sight)


def _along_m(event: Event, x_m: float, y_m: float) -> float:
    return math.cos(event.heading_rad) * (x_m - event.x_m) + math.sin(event.heading_rad) * (y_m - event.y_m)


def _passed(event: Event, walker: Walker, query: EventQuery) -> bool:
    here = _along_m(event, walker.x_m, walker.y_m)
    return here < _along_m(event, query.robot_x_m, query.robot_y_m) - 1.0


def _across(event: Event, walker: Walker, number: int) -> bool:
    done_m = _along_m(event, walker.x_m, walker.y_m) * (-1.0 if from_front(number) else 1.0)
    return done_m >= event.half_length_m + _BEFORE_M


def _doing(event: Event, state: EventState, number: int) -> Doing:
    return "stand"


PED_CROSSING: Final = Behavior(entered, _begin, _act, _doing)
