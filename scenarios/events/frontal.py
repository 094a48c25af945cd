"""`frontal`: walks at the robot, commits to a line late, passes and walks on.

It aims ahead of the robot by up to a second's way, because a robot that changes lanes would
otherwise pass the line to its current position.

A person who avoids others on the way takes aim again. While the robot stands farther away than
MET_M, the person waits. Before a robot that stands nearer it stops, waits for its patience, and
walks round it.

Its decoy walks in the same way, keeps to its own side of the way in good time, and passes.
"""

from __future__ import annotations

import math
from typing import Final

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
    aim_at_robot,
    along_m,
    come_at_robot,
    distance_m,
    edge_m,
    has_passed,
    lost_patience,
    waiting_for_robot,
    walk_on,
    walk_to,
    walker_at,
    world_point,
)

COMMIT_M: Final = 2.0
"""Distance in metres to the robot below which the person stops aiming and keeps its line."""
KEEPS_ASIDE_M: Final = 7.0
"""Distance in metres to the robot below which the person of a decoy keeps to its side."""
_LOOK_AHEAD_M: Final = 1.2
"""Metres ahead on its side that the person of a decoy aims at."""


def _begin(event: Event, number: int) -> Walker:
    return walker_at(event, 0.0, 0.0, math.pi)


def _step(event: Event, state: EventState, number: int, query: EventQuery) -> Walker:
    walker = state.walkers[number]
    sight = sight_of(event, number, query)
    on_rad = event.heading_rad + math.pi
    if state.phase == "over":
        return walk_on(walker, on_rad, event.speed_mps, sight)
    walker, heading_rad = aim_at_robot(waiting_for_robot(event, walker, query), query, COMMIT_M)
    return come_at_robot(walker, heading_rad, event.speed_mps, sight)


def _decoy_step(event: Event, state: EventState, number: int, query: EventQuery) -> Walker:
    walker = state.walkers[number]
    if state.phase == "acting" and distance_m(walker, query) > KEEPS_ASIDE_M:
        return _step(event, state, number, query)
    ahead_m = along_m(event, walker.x_m, walker.y_m) - _LOOK_AHEAD_M
    aside = world_point(event, ahead_m, event.side * edge_m(event))
    return walk_to(walker, *aside, event.speed_mps, sight_of(event, number, query))


def _ends(event: Event, state: EventState, query: EventQuery) -> bool:
    (walker,) = state.walkers
    return has_passed(event, walker, query) or lost_patience(event, walker, query)


def _decoy_ends(event: Event, state: EventState, query: EventQuery) -> bool:
    return has_passed(event, state.walkers[0], query)


FRONTAL: Final = EventKind(
    name="frontal",
    layout=SidewalkLayout((18.0, 20.0), (21.0, 22.0), after_m=-4.0),
    trigger_m=20.0,
    begin=_begin,
    step=_step,
    ends=_ends,
    decoy=Decoy(_decoy_step, _decoy_ends),
)
