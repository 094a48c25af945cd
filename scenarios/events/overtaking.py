"""`overtaking`: sets out when the robot has just passed it, comes from behind, faster, passes close
by, and cuts in.

Before the robot it slows down to half of the robot's speed, whatever that becomes. A robot that
only keeps its course, at whatever speed or by fits and starts, runs into it then; one that slows
down for it until it has been let in, or goes round it, does not. Then it walks on at its own pace.
"""

from __future__ import annotations

from typing import Final

import msgspec

from cosim.core.state import PERSON_RADIUS_M
from cosim.spec.events import Event, EventKind, EventQuery, EventState, SidewalkLayout, Walker
from scenarios.events.sight import sight_of
from scenarios.events.walking import (
    along_m,
    edge_m,
    left_m,
    pressed_on,
    spot,
    walked_on,
    walked_to,
    walker_at,
)

_FASTER_MPS: Final = 0.8
_FASTEST_MPS: Final = 3.3
"""It is so much faster than the robot, up to a jogger's pace."""
WAITS_ASIDE_M: Final = 1.2
BESIDE_ROBOT_M: Final = 0.95
"""Between its middle and the robot's as it passes."""
_CUTS_IN_M: Final = 1.0
_BEFORE_ROBOT_M: Final = 1.5
"""Its lead when it turns to the robot's line, and when it slows down there."""
ON_LINE_M: Final = 0.15
SLOWED: Final = 0.5
_CREEPS_MPS: Final = 0.1
_EASES_MPS2: Final = 0.6
"""How fast its pace goes with the robot's from then on."""
YIELDED_S: Final = 5.0
_NEARER_M: Final = 0.1
"""A robot that for so long has not come nearer by this has let it in."""
_LOOK_AHEAD_M: Final = 1.5


def _begin(event: Event, number: int) -> Walker:
    return walker_at(event, 0.0, event.side * min(edge_m(event), WAITS_ASIDE_M), 0.0)


def _step(event: Event, state: EventState, number: int, query: EventQuery) -> Walker:
    walker = state.walkers[number]
    sight = sight_of(event, number, query)
    if state.phase == "over":
        return walked_on(walker, event.heading_rad, event.speed_mps, sight)
    if walker.pace_mps is not None:
        return pressed_on(_eased(event, walker, query), event.heading_rad, walker.pace_mps, sight)
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
    pace_mps = min(max(event.speed_mps, query.robot_v_mps + _FASTER_MPS), _FASTEST_MPS)
    aim = spot(event, along_m(event, walker.x_m, walker.y_m) + _LOOK_AHEAD_M, line_m)
    return walked_to(walker, *aim, pace_mps, sight)


def _eased(event: Event, walker: Walker, query: EventQuery) -> Walker:
    """Its pace goes with the robot's; it counts how long the robot has come no nearer."""
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
    return max(SLOWED * query.robot_v_mps, _CREEPS_MPS)


def _beside_m(event: Event, line_m: float) -> float:
    """How far left of the middle it passes a robot: on its side, if there is room."""
    room_m = event.half_width_m - PERSON_RADIUS_M
    on_its_side = line_m + event.side * BESIDE_ROBOT_M
    return on_its_side if abs(on_its_side) <= room_m else line_m - event.side * BESIDE_ROBOT_M


def _lead_m(event: Event, walker: Walker, query: EventQuery) -> float:
    return along_m(event, walker.x_m, walker.y_m) - along_m(event, query.robot_x_m, query.robot_y_m)


def _ends(event: Event, state: EventState, query: EventQuery) -> bool:
    """The robot has let it in, or has passed it in turn."""
    (walker,) = state.walkers
    passed = walker.pace_mps is not None and _lead_m(event, walker, query) < -1.0
    return passed or walker.counted_ticks * query.tick_ms / 1000 >= YIELDED_S


OVERTAKING: Final = EventKind(
    name="overtaking",
    layout=SidewalkLayout((18.0, 20.0), (1.5, 3.0), half_width_m=1.4),
    trigger_m=-1.0,
    begin=_begin,
    step=_step,
    ends=_ends,
)
