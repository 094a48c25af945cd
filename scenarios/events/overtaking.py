"""`overtaking`: sets out when the robot has just passed it, comes from behind, faster, passes and walks on."""

from __future__ import annotations

from typing import Final

from cosim.spec.event_kind import EventKind, SidewalkLayout
from cosim.spec.events import Event, EventQuery, EventState, Walker
from scenarios.events.sight import sight_of
from scenarios.events.walking import along_m, edge_m, spot, walked_to, walker_at

FASTER_MPS: Final = 0.4
_FASTEST_MPS: Final = 2.2
"""It walks so much faster than the robot drives, up to a brisk jog."""
CUTS_IN_M: Final = 2.5
"""Ahead of the robot by this much, it turns back to the middle of the sidewalk."""
_LOOK_AHEAD_M: Final = 3.0


def _begin(event: Event, number: int) -> Walker:
    return walker_at(event, 0.0, event.side * edge_m(event), 0.0)


def _step(event: Event, state: EventState, number: int, query: EventQuery) -> Walker:
    walker = state.walkers[number]
    left_m = event.side * edge_m(event) if state.phase == "acting" else 0.0
    aim = spot(event, along_m(event, walker.x_m, walker.y_m) + _LOOK_AHEAD_M, left_m)
    pace_mps = min(max(event.speed_mps, query.robot_v_mps + FASTER_MPS), _FASTEST_MPS)
    return walked_to(walker, *aim, pace_mps, sight_of(event, number, query))


def _ends(event: Event, state: EventState, query: EventQuery) -> bool:
    (walker,) = state.walkers
    robot_m = along_m(event, query.robot_x_m, query.robot_y_m)
    return along_m(event, walker.x_m, walker.y_m) - robot_m > CUTS_IN_M


OVERTAKING: Final = EventKind(
    name="overtaking",
    layout=SidewalkLayout((18.0, 20.0), (1.5, 3.0), half_width_m=1.4),
    trigger_m=-1.0,
    begin=_begin,
    step=_step,
    ends=_ends,
)
