"""One tick of every event: triggers, state machines, who is shown."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType

import msgspec

from cosim.core.errors import SpecError
from cosim.core.state import PersonKind
from cosim.spec.events import Actor, Event, EventName, EventQuery, EventReply, EventState
from scenarios.events.behavior import Behavior
from scenarios.events.crossing import PED_CROSSING
from scenarios.events.frontal import FRONTAL
from scenarios.events.lateral import LATERAL
from scenarios.events.overtaking import OVERTAKING
from scenarios.events.standing import CONVERSING, GESTURING, OBSTRUCTING, QUEUEING

SHOWN_AHEAD_M = 60.0
SHOWN_BEHIND_M = 30.0
"""An event's pedestrians exist while the robot is within these arc lengths of its place."""

LEAVES_M = 15.0
"""Those whose event is over are gone for good when the robot is this far from all of them: out of its sight."""

BEHAVIORS: Mapping[EventName, Behavior] = MappingProxyType(
    {
        "obstructing": OBSTRUCTING,
        "conversing": CONVERSING,
        "queueing": QUEUEING,
        "frontal": FRONTAL,
        "lateral": LATERAL,
        "overtaking": OVERTAKING,
        "ped_crossing": PED_CROSSING,
        "gesturing": GESTURING,
    }
)


def react(query: EventQuery) -> EventReply:
    """One tick of every event. A pure function of the query. Raises SpecError when states and events do not match."""
    states = query.states or tuple(_waiting(event) for event in query.events)
    if [len(s.walkers) for s in states] != [event.people for event in query.events]:
        raise SpecError(f"{len(query.events)} events came with {len(states)} states, or with other people")
    new = tuple(_advance(event, state, query) for event, state in zip(query.events, states, strict=True))
    actors = tuple(
        actor
        for event, before, after in zip(query.events, states, new, strict=True)
        if _present(event, after, query)
        for actor in _shown(event, before, after, query)
    )
    return EventReply(episode=query.episode, tick=query.tick, states=new, actors=actors)


def behavior_of(event: Event) -> Behavior:
    """The behaviour of an event's kind."""
    return BEHAVIORS[event.kind]


def _waiting(event: Event) -> EventState:
    return EventState(phase="waiting", since_tick=0, walkers=behavior_of(event).begin(event))


def _advance(event: Event, state: EventState, query: EventQuery) -> EventState:
    behavior = behavior_of(event)
    if state.phase == "waiting":
        gap_m = behavior.trigger(event, query)
        if gap_m is None:
            return state
        state = msgspec.structs.replace(
            state, phase="acting", since_tick=query.tick, triggered_tick=query.tick, trigger_distance_m=gap_m
        )
    if state.phase == "gone":
        return state
    if state.phase == "over" and all(
        math.hypot(w.x_m - query.robot_x_m, w.y_m - query.robot_y_m) > LEAVES_M for w in state.walkers
    ):
        return msgspec.structs.replace(state, phase="gone", since_tick=query.tick)
    return _timed(state, behavior.act(event, state, query), query)


def _timed(before: EventState, after: EventState, query: EventQuery) -> EventState:
    """The state with the velocities of this tick's steps in it."""
    walkers = []
    for old, new in zip(before.walkers, after.walkers, strict=True):
        vx, vy = (new.x_m - old.x_m) * 1000 / query.tick_ms, (new.y_m - old.y_m) * 1000 / query.tick_ms
        same = (vx, vy) == (new.vx_mps, new.vy_mps)
        walkers.append(new if same else msgspec.structs.replace(new, vx_mps=vx, vy_mps=vy))
    return msgspec.structs.replace(after, walkers=tuple(walkers))


def _shown(event: Event, before: EventState, after: EventState, query: EventQuery) -> list[Actor]:
    actors = []
    for number, (name, old, new) in enumerate(zip(event.names, before.walkers, after.walkers, strict=True)):
        moved_m = math.hypot(new.x_m - old.x_m, new.y_m - old.y_m)
        actors.append(
            Actor(
                id=name,
                x_m=new.x_m,
                y_m=new.y_m,
                heading_rad=new.heading_rad,
                speed_mps=moved_m * 1000 / query.tick_ms,
                doing=behavior_of(event).doing(event, after, number) if moved_m < 1e-6 else "walk",
                kind=PersonKind.EVENT,
            )
        )
    return actors


def _present(event: Event, state: EventState, query: EventQuery) -> bool:
    if not -SHOWN_BEHIND_M <= event.route_s_m - query.route_s_m <= SHOWN_AHEAD_M:
        return False
    return state.phase != "gone"
