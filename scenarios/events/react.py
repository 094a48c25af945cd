"""Registry of event kinds, and one tick of all events: triggers, state machines, visible people."""

from __future__ import annotations

import math
import zlib
from types import MappingProxyType
from typing import Final

import msgspec

from cosim.core.errors import SpecError
from cosim.core.state import Doing, PersonKind
from cosim.spec.events import (
    Actor,
    Decoy,
    Event,
    EventKind,
    EventKinds,
    EventQuery,
    EventReply,
    EventState,
    Walker,
)
from scenarios.events.crossing import PED_CROSSING
from scenarios.events.frontal import FRONTAL
from scenarios.events.lateral import LATERAL
from scenarios.events.overtaking import OVERTAKING
from scenarios.events.standing import CONVERSING, GESTURING, OBSTRUCTING, QUEUEING
from scenarios.events.walking import left_m, robot_stands

_ROWS = (OBSTRUCTING, CONVERSING, QUEUEING, FRONTAL, LATERAL, OVERTAKING, PED_CROSSING, GESTURING)
EVENT_KINDS: Final[EventKinds] = MappingProxyType({kind.name: kind for kind in _ROWS})
"""Bundled event kinds by name; each is defined in its own module."""

SHOWN_AHEAD_M = 60.0
"""Metres of route ahead of the robot within which people of an event exist."""
SHOWN_BEHIND_M = 30.0
"""Metres of route behind the robot within which people of an event exist."""

REMOVED_BEYOND_M = 15.0
"""Distance in metres, out of the robot's sight, at which people of a finished event are removed."""


def react(query: EventQuery, kinds: EventKinds = EVENT_KINDS) -> EventReply:
    """Advance all events by one tick. A pure function of query and table.

    Raises SpecError if states do not match the events, or an event is not in the table.
    """
    if strange := sorted({event.kind for event in query.events} - kinds.keys()):
        raise SpecError(f"event '{strange[0]}' is none of {', '.join(kinds)}")
    rows = [kinds[event.kind] for event in query.events]
    states = query.states or tuple(map(_waiting, rows, query.events))
    if [len(s.walkers) for s in states] != [event.people for event in query.events]:
        raise SpecError(
            f"{len(query.events)} events came with {len(states)} states, or with other people"
        )
    before = list(zip(rows, query.events, states, strict=True))
    after = tuple(_advance(kind, event, state, query) for kind, event, state in before)
    actors = tuple(
        actor
        for (kind, event, old), new in zip(before, after, strict=True)
        if _present(event, new, query)
        for actor in _shown(kind, event, old, new, query)
    )
    return EventReply(episode=query.episode, tick=query.tick, states=after, actors=actors)


def _waiting(kind: EventKind, event: Event) -> EventState:
    """Return the initial state of an event."""
    walkers = tuple(kind.begin(event, number) for number in range(event.people))
    return EventState(phase="waiting", since_tick=0, walkers=walkers)


def _triggered_m(trigger_m: float | None, event: Event, query: EventQuery) -> float | None:
    """Return the route distance in metres from robot to event if the event triggers; else None."""
    gap_m = event.route_s_m - query.route_s_m
    if trigger_m is None:
        begins = abs(gap_m) <= event.half_length_m
    elif trigger_m >= 0.0:
        begins = 0.0 <= gap_m <= trigger_m
    else:
        step_m = max(query.robot_v_mps, 0.0) * query.tick_ms / 1000
        begins = trigger_m - step_m <= gap_m < step_m + trigger_m
    return gap_m if begins else None


def _advance(kind: EventKind, event: Event, state: EventState, query: EventQuery) -> EventState:
    if state.phase == "gone":
        return state
    state = msgspec.structs.replace(
        state, robot_stood_ticks=state.robot_stood_ticks + 1 if robot_stands(query) else 0
    )
    if state.phase == "waiting":
        gap_m = _triggered_m(kind.trigger_m_of(event), event, query)
        if gap_m is None:
            return state
        state = msgspec.structs.replace(
            state,
            phase="acting",
            since_tick=query.tick,
            triggered_tick=query.tick,
            trigger_distance_m=gap_m,
            lane_m=left_m(event, query.robot_x_m, query.robot_y_m),
        )
    if state.phase == "over" and all(
        math.hypot(w.x_m - query.robot_x_m, w.y_m - query.robot_y_m) > REMOVED_BEYOND_M
        for w in state.walkers
    ):
        return msgspec.structs.replace(state, phase="gone", since_tick=query.tick)
    acts = _acts(kind, event)
    if state.phase == "acting" and acts.ends(event, state, query):
        state = msgspec.structs.replace(state, phase="over", since_tick=query.tick)
    after = (acts.step(event, state, number, query) for number in range(event.people))
    walkers = tuple(
        _timed(old, new, query.tick_ms) for old, new in zip(state.walkers, after, strict=True)
    )
    return msgspec.structs.replace(state, walkers=walkers)


def _acts(kind: EventKind, event: Event) -> EventKind | Decoy:
    """Return the row with an event's behaviour. Raises SpecError for a decoy without one."""
    if not event.decoy:
        return kind
    if kind.decoy is None:
        raise SpecError(f"{event.prefix}'{event.kind}' has no behaviour of decoys")
    return kind.decoy


def pose_of(kind: EventKind, event: Event) -> Doing:
    """Return the activity of people who stand during an event."""
    acts = _acts(kind, event)
    if isinstance(acts, EventKind):
        return acts.pose
    place = f"{event.id} {event.x_m:.3f} {event.y_m:.3f}"
    return acts.poses[zlib.crc32(place.encode()) % len(acts.poses)]


def _timed(old: Walker, new: Walker, tick_ms: int) -> Walker:
    """Return a walker after its step with its velocity."""
    vx, vy = (new.x_m - old.x_m) * 1000 / tick_ms, (new.y_m - old.y_m) * 1000 / tick_ms
    return (
        new
        if (vx, vy) == (new.vx_mps, new.vy_mps)
        else msgspec.structs.replace(new, vx_mps=vx, vy_mps=vy)
    )


def _shown(
    kind: EventKind, event: Event, before: EventState, after: EventState, query: EventQuery
) -> list[Actor]:
    pose = pose_of(kind, event) if after.phase == "acting" else "stand"
    actors = []
    for name, old, new in zip(event.names, before.walkers, after.walkers, strict=True):
        moved_m = math.hypot(new.x_m - old.x_m, new.y_m - old.y_m)
        actors.append(
            Actor(
                id=name,
                x_m=new.x_m,
                y_m=new.y_m,
                heading_rad=new.heading_rad,
                speed_mps=moved_m * 1000 / query.tick_ms,
                doing=pose if moved_m < 1e-6 else "walk",
                kind=PersonKind.EVENT,
                age=kind.age,
            )
        )
    return actors


def _present(event: Event, state: EventState, query: EventQuery) -> bool:
    if not -SHOWN_BEHIND_M <= event.route_s_m - query.route_s_m <= SHOWN_AHEAD_M:
        return False
    return state.phase != "gone"
