"""`frontal`: walks at the robot's current position, commits to a line, passes and walks on.

A person who avoids others on the way takes aim again. A robot that has stood for a second is
avoided. A person who touches the robot stops, waits, gives up and walks around it.
"""

from __future__ import annotations

import math
from typing import Final

from cosim.spec.events import Event, EventKind, EventQuery, EventState, SidewalkLayout, Walker
from scenarios.events.sight import sight_of
from scenarios.events.walking import aim_at_robot, gives_up, walk_on, walk_straight, walker_at

COMMIT_M: Final = 5.0
"""Distance in metres to the robot below which the person stops aiming and keeps its line."""


def _begin(event: Event, number: int) -> Walker:
    return walker_at(event, 0.0, 0.0, math.pi)


def _step(event: Event, state: EventState, number: int, query: EventQuery) -> Walker:
    walker = state.walkers[number]
    sight = sight_of(event, number, query)
    on_rad = event.heading_rad + math.pi
    if state.phase == "over":
        return walk_on(walker, on_rad, event.speed_mps, sight)
    walker, heading_rad = (
        (walker, on_rad) if sight.robot_stands else aim_at_robot(walker, query, COMMIT_M)
    )
    return walk_straight(walker, heading_rad, event.speed_mps, sight)


def _ends(event: Event, state: EventState, query: EventQuery) -> bool:
    (walker,) = state.walkers
    dx, dy = query.robot_x_m - walker.x_m, query.robot_y_m - walker.y_m
    back_rad = event.heading_rad + math.pi
    passed = dx * math.cos(back_rad) + dy * math.sin(back_rad) < -1.0
    return passed or gives_up(walker, query)


FRONTAL: Final = EventKind(
    name="frontal",
    layout=SidewalkLayout((18.0, 20.0), (21.0, 22.0), after_m=-4.0),
    trigger_m=20.0,
    begin=_begin,
    step=_step,
    ends=_ends,
)
