"""`overtaking`: sets out when the robot has just passed it, comes from behind, faster, passes and walks on."""

from __future__ import annotations

import math
from typing import Final

import msgspec

from cosim.core.state import Doing
from cosim.spec.events import Event, EventQuery, EventState, Walker
from scenarios.events.behavior import Behavior, once_behind
from scenarios.events.sight import sight_of
from scenarios.events.walking import edge_m, walked_to, walker_at

OVERTAKING_TRIGGER_M: Final = 1.0
FASTER_MPS: Final = 0.4
_FASTEST_MPS: Final = 2.2
"""It walks so much faster than the robot drives, up to a brisk jog."""
CUTS_IN_M: Final = 2.5
"""Ahead of the robot by this much, it turns back to the middle of the sidewalk."""
_LOOK_AHEAD_M: Final = 3.0


def _begin(event: Event) -> tuple[Walker, ...]:
    return (walker_at(event, 0.0, event.side * edge_m(event), 0.0),)


def _act(event: Event, state: EventState, query: EventQuery) -> EventState:
    (walker,) = state.walkers
    cos, sin = math.cos(event.heading_rad), math.sin(event.heading_rad)
    along_m = cos * (walker.x_m - event.x_m) + sin * (walker.y_m - event.y_m)
    robot_m = cos * (query.robot_x_m - event.x_m) + sin * (query.robot_y_m - event.y_m)
    lead_m = along_m - robot_m
    if state.phase == "acting" and lead_m > CUTS_IN_M:
        state = msgspec.structs.replace(state, phase="over", since_tick=query.tick)
    left_m = event.side * edge_m(event) if state.phase == "acting" else 0.0
    ahead_m = along_m + _LOOK_AHEAD_M
    aim = (event.x_m + cos * ahead_m - sin * left_m, event.y_m + sin * ahead_m + cos * left_m)
    pace_mps = min(max(event.speed_mps, query.robot_v_mps + FASTER_MPS), _FASTEST_MPS)
    return msgspec.structs.replace(state, walkers=(walked_to(walker, *aim, pace_mps, sight_of(event, 0, query)),))


def _doing(event: Event, state: EventState, number: int) -> Doing:
    return "stand"


OVERTAKING: Final = Behavior(once_behind(OVERTAKING_TRIGGER_M), _begin, _act, _doing)
