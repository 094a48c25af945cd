"""Event pedestrians as pure state machines: (event, state, what the robot does) -> (state, pedestrians).

A further event is one more `Behavior` in the table at the end. Definitions and triggers follow the paper's table
of event-based behaviours; every constant that the paper leaves open stands here with its unit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import NamedTuple

import msgspec
import numpy as np

from cosim.errors import SpecError
from cosim.events import Actor, Event, EventQuery, EventReply, EventState
from cosim.geometry import Pose, wrap_angle
from cosim.giveway import Body, stepped_round, touches
from cosim.state import PERSON_RADIUS_M, Doing

SHOWN_AHEAD_M = 60.0
SHOWN_BEHIND_M = 30.0
"""An event's pedestrians exist while the robot is within these arc lengths of its place."""

LEAVES_M = 15.0
"""One whose event is over is gone for good when the robot is this far away: behind it, out of its sight."""

COMMIT_M = 5.0
"""`frontal` aims at the robot's current position until this close, then keeps its line as people do."""

GIVES_UP_S = 2.0
"""How long a `frontal` pedestrian stands against a robot that it has run into before it goes round."""

EDGE_GAP_M = 0.1
LOOK_PERIOD_S = 4.0
LOOK_SWING_RAD = 1.0
TURN_RADPS = math.pi


class Behavior(NamedTuple):
    """One kind of event. trigger_m: arc length from robot to event at which it begins.

    begin(event) -> state before the trigger. act(event, state, query) -> next state once triggered.
    """

    trigger_m: float
    begin: Callable[[Event], EventState]
    act: Callable[[Event, EventState, EventQuery], EventState]
    doing: Callable[[Event, EventState], Doing]


def react(query: EventQuery) -> EventReply:
    """One tick of every event. A pure function of the query. Raises SpecError for a kind without a behaviour."""
    states = query.states or tuple(behavior_of(event).begin(event) for event in query.events)
    if len(states) != len(query.events):
        raise SpecError(f"{len(query.events)} events came with {len(states)} states")
    new = tuple(_advance(event, state, query) for event, state in zip(query.events, states, strict=True))
    actors = tuple(
        _shown(event, before, after, query)
        for event, before, after in zip(query.events, states, new, strict=True)
        if _present(event, after, query)
    )
    return EventReply(episode=query.episode, tick=query.tick, states=new, actors=actors)


def behavior_of(event: Event) -> Behavior:
    """The behaviour of an event's kind. Raises SpecError when this version has none."""
    if event.kind not in BEHAVIORS:
        raise SpecError(f"event '{event.id}': no behaviour '{event.kind}'. Valid kinds: {', '.join(sorted(BEHAVIORS))}")
    return BEHAVIORS[event.kind]


def _advance(event: Event, state: EventState, query: EventQuery) -> EventState:
    behavior = behavior_of(event)
    if state.phase == "waiting":
        ahead_m = event.route_s_m - query.route_s_m
        if not 0.0 <= ahead_m <= behavior.trigger_m:
            return state
        state = msgspec.structs.replace(
            state, phase="acting", since_tick=query.tick, triggered_tick=query.tick, trigger_distance_m=ahead_m
        )
    far_m = math.hypot(state.x_m - query.robot_x_m, state.y_m - query.robot_y_m)
    if state.phase == "gone" or (state.phase == "over" and far_m > LEAVES_M):
        return state if state.phase == "gone" else msgspec.structs.replace(state, phase="gone", since_tick=query.tick)
    return behavior.act(event, state, query)


def _shown(event: Event, before: EventState, after: EventState, query: EventQuery) -> Actor:
    moved_m = math.hypot(after.x_m - before.x_m, after.y_m - before.y_m)
    return Actor(
        id=event.id,
        x_m=after.x_m,
        y_m=after.y_m,
        heading_rad=after.heading_rad,
        speed_mps=moved_m * 1000 / query.tick_ms,
        doing=behavior_of(event).doing(event, after) if moved_m < 1e-6 else "walk",
    )


def _present(event: Event, state: EventState, query: EventQuery) -> bool:
    if not -SHOWN_BEHIND_M <= event.route_s_m - query.route_s_m <= SHOWN_AHEAD_M:
        return False
    return state.phase != "gone"


def _aside(event: Event, lateral_m: float, heading_rad: float) -> EventState:
    """Waiting at the event's place, `lateral_m` to the left of the middle of the sidewalk."""
    return EventState(
        phase="waiting",
        since_tick=0,
        x_m=event.x_m - lateral_m * math.sin(event.heading_rad),
        y_m=event.y_m + lateral_m * math.cos(event.heading_rad),
        heading_rad=wrap_angle(heading_rad),
    )


def _edge_m(event: Event) -> float:
    """How far from the middle one can stand with both shoulders on the sidewalk."""
    return max(event.half_width_m - PERSON_RADIUS_M - EDGE_GAP_M, 0.0)


def _walk_to(state: EventState, x_m: float, y_m: float, speed_mps: float, query: EventQuery) -> EventState:
    """One tick towards a point, facing it, round the robot if that is in the way; exactly there when in reach."""
    tick_s = query.tick_ms / 1000
    dx, dy = x_m - state.x_m, y_m - state.y_m
    far_m = math.hypot(dx, dy)
    share = min(speed_mps * tick_s / max(far_m, 1e-9), 1.0)
    wanted = (x_m, y_m) if share == 1.0 else (state.x_m + share * dx, state.y_m + share * dy)
    heading = state.heading_rad if share == 1.0 else _turned(state.heading_rad, math.atan2(dy, dx), tick_s)
    return _stepped(state, wanted, heading, query)


def _stepped(state: EventState, wanted: tuple[float, float], heading_rad: float, query: EventQuery) -> EventState:
    """The state one step on, with the step led round the robot."""
    before, after = np.array([[state.x_m, state.y_m]]), np.array([wanted])
    x_m, y_m = stepped_round(before, after, _robot(query))[0].tolist()
    return msgspec.structs.replace(state, x_m=x_m, y_m=y_m, heading_rad=heading_rad)


def _robot(query: EventQuery) -> Body:
    pose = Pose(query.robot_x_m, query.robot_y_m, query.robot_heading_rad)
    return Body(pose, (query.robot_length_m / 2, query.robot_width_m / 2), query.robot_v_mps)


def _turned(heading_rad: float, wanted_rad: float, tick_s: float) -> float:
    """Heading after one tick of turning at a human rate."""
    error = wrap_angle(wanted_rad - heading_rad)
    return wrap_angle(heading_rad + max(-TURN_RADPS * tick_s, min(TURN_RADPS * tick_s, error)))


# --- obstructing: steps into the middle of the sidewalk and stands there, looking around; later steps aside -------


def _obstructing_begin(event: Event) -> EventState:
    return _aside(event, event.side * _edge_m(event), event.heading_rad + math.pi)


def _obstructing_act(event: Event, state: EventState, query: EventQuery) -> EventState:
    tick_s = query.tick_ms / 1000
    if state.phase == "acting" and (query.tick - state.since_tick) * tick_s >= event.hold_s:
        state = msgspec.structs.replace(state, phase="over", since_tick=query.tick)
    if state.phase == "over":
        home = _obstructing_begin(event)
        return _walk_to(state, home.x_m, home.y_m, event.speed_mps, query)
    if (state.x_m, state.y_m) != (event.x_m, event.y_m):
        return _walk_to(state, event.x_m, event.y_m, event.speed_mps, query)
    phase = 2 * math.pi * (query.tick - state.since_tick) * tick_s / LOOK_PERIOD_S
    facing = event.heading_rad + math.pi + LOOK_SWING_RAD * math.sin(phase)
    return msgspec.structs.replace(state, heading_rad=_turned(state.heading_rad, facing, tick_s))


def _obstructing_doing(event: Event, state: EventState) -> Doing:
    return "look" if state.phase == "acting" else "stand"


# --- frontal: walks straight at the robot's current position, commits to a line, passes and walks on; one that has
# --- run into the robot does not push it: it stands, gives up, and goes round


def _frontal_begin(event: Event) -> EventState:
    return _aside(event, 0.0, event.heading_rad + math.pi)


def _frontal_act(event: Event, state: EventState, query: EventQuery) -> EventState:
    tick_s = query.tick_ms / 1000
    step_m = event.speed_mps * tick_s
    dx, dy = query.robot_x_m - state.x_m, query.robot_y_m - state.y_m
    back_rad = event.heading_rad + math.pi
    passed = dx * math.cos(back_rad) + dy * math.sin(back_rad) < -1.0
    if state.phase == "acting" and (passed or state.blocked_ticks * tick_s >= GIVES_UP_S):
        state = msgspec.structs.replace(state, phase="over", since_tick=query.tick)
    if state.phase == "over":
        heading = _turned(state.heading_rad, back_rad, tick_s)
        onward = (state.x_m + math.cos(back_rad) * step_m, state.y_m + math.sin(back_rad) * step_m)
        return _stepped(state, onward, heading, query)
    if touches(np.array([state.x_m, state.y_m]), _robot(query)):
        return msgspec.structs.replace(state, blocked_ticks=state.blocked_ticks + 1)
    heading = state.aim_rad if state.aim_rad is not None else math.atan2(dy, dx)
    if state.aim_rad is None and math.hypot(dx, dy) <= COMMIT_M:
        state = msgspec.structs.replace(state, aim_rad=heading)
    return msgspec.structs.replace(
        state,
        x_m=state.x_m + math.cos(heading) * step_m,
        y_m=state.y_m + math.sin(heading) * step_m,
        heading_rad=heading,
    )


def _frontal_doing(event: Event, state: EventState) -> Doing:
    return "stand"


BEHAVIORS: Mapping[str, Behavior] = MappingProxyType(
    {
        "obstructing": Behavior(10.0, _obstructing_begin, _obstructing_act, _obstructing_doing),
        "frontal": Behavior(20.0, _frontal_begin, _frontal_act, _frontal_doing),
    }
)
