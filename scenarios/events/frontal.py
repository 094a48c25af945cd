"""`frontal`: walks straight at the robot's current position, commits to a line, passes and walks on.

Who steps round somebody on the way takes aim anew.

One that has run into the robot does not push it: it stands, gives up, and goes round.
"""

from __future__ import annotations

import math
from typing import Final

import msgspec

from cosim.core.state import Doing
from cosim.spec.events import Event, EventQuery, EventState, Walker
from scenarios.events.behavior import Behavior, ahead
from scenarios.events.sight import sight_of
from scenarios.events.walking import gave_up, pressed_on, walked_on, walker_at

FRONTAL_TRIGGER_M: Final = 20.0
COMMIT_M: Final = 5.0
"""It aims at the robot's current position until this close, then keeps its line as people do."""


def _begin(event: Event) -> tuple[Walker, ...]:
    return (walker_at(event, 0.0, 0.0, math.pi),)


def _act(event: Event, state: EventState, query: EventQuery) -> EventState:
    (walker,) = state.walkers
    sight = sight_of(event, 0, query)
    dx, dy = query.robot_x_m - walker.x_m, query.robot_y_m - walker.y_m
    back_rad = event.heading_rad + math.pi
    passed = dx * math.cos(back_rad) + dy * math.sin(back_rad) < -1.0
    if state.phase == "acting" and (passed or gave_up(walker, query)):
        state = msgspec.structs.replace(state, phase="over", since_tick=query.tick)
    if state.phase == "over":
        return msgspec.structs.replace(state, walkers=(walked_on(walker, back_rad, event.speed_mps, sight),))
    heading = walker.aim_rad if walker.aim_rad is not None else math.atan2(dy, dx)
    if walker.aim_rad is None and math.hypot(dx, dy) <= COMMIT_M:
        walker = msgspec.structs.replace(walker, aim_rad=heading)
    return msgspec.structs.replace(state, walkers=(pressed_on(walker, heading, event.speed_mps, sight),))


def _doing(event: Event, state: EventState, number: int) -> Doing:
    return "stand"


FRONTAL: Final = Behavior(ahead(FRONTAL_TRIGGER_M), _begin, _act, _doing)
