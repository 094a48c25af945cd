"""Those who stand in the way: `obstructing`, `conversing`, `queueing`, `gesturing`.

They wait at the edge of the sidewalk, step to their places when triggered, stay for their time, and step back.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

import msgspec

from cosim.core.geometry import wrap_angle
from cosim.core.state import PERSON_RADIUS_M, Doing
from cosim.spec.events import Event, EventQuery, EventState, Walker
from scenarios.events.behavior import Behavior, ahead
from scenarios.events.sight import sight_of
from scenarios.events.walking import edge_m, spot, turned, walked_to, walker_at

STANDING_TRIGGER_M: Final = 10.0
LOOK_PERIOD_S: Final = 4.0
LOOK_SWING_RAD: Final = 1.0
TALK_M: Final = 0.62
"""From the middle of a group of talkers to each of them; a little more for four."""
QUEUE_M: Final = 0.65
"""From one person of a queue to the next: tight, and more than two radii."""
WAITING_M: Final = 0.8
"""From one to the next of those who wait at the edge."""

_Place = tuple[float, float]
"""Metres along the event's heading and to the left."""
Facing = Callable[[Event, Walker, EventQuery, EventState], float]


def talking_places(event: Event) -> tuple[_Place, ...]:
    """Evenly on a circle round the middle of the sidewalk, two of them abreast of the robot's way."""
    radius_m = TALK_M * (1.15 if event.people == 4 else 1.0)
    angles = [math.pi / 2 + 2.0 * math.pi * k / event.people for k in range(event.people)]
    return tuple((radius_m * math.cos(a), radius_m * math.sin(a)) for a in angles)


def queue_places(event: Event) -> tuple[_Place, ...]:
    """A tight line across the sidewalk that begins at the edge of its side."""
    first_m = event.half_width_m - PERSON_RADIUS_M
    return tuple((0.0, event.side * (first_m - k * QUEUE_M)) for k in range(event.people))


def middle(event: Event) -> tuple[_Place, ...]:
    """One person, in the middle."""
    return ((0.0, 0.0),)


def _aside(event: Event, number: int) -> _Place:
    """Where somebody waits for the trigger: along the edge."""
    return (WAITING_M * (number - (event.people - 1) / 2), event.side * edge_m(event))


def _begin(event: Event) -> tuple[Walker, ...]:
    return tuple(walker_at(event, *_aside(event, k), math.pi) for k in range(event.people))


def _standing(places: Callable[[Event], tuple[_Place, ...]], facing: Facing, doing: Doing) -> Behavior:
    """The behaviour of those who step to `places`, face somewhere there, and show what they do."""

    def act(event: Event, state: EventState, query: EventQuery) -> EventState:
        tick_s = query.tick_ms / 1000
        if state.phase == "acting" and (query.tick - state.since_tick) * tick_s >= event.hold_s:
            state = msgspec.structs.replace(state, phase="over", since_tick=query.tick)
        goals = places(event) if state.phase == "acting" else [_aside(event, k) for k in range(event.people)]
        walkers = []
        for number, (walker, goal) in enumerate(zip(state.walkers, goals, strict=True)):
            x_m, y_m = spot(event, *goal)
            if (walker.x_m, walker.y_m) != (x_m, y_m):
                insisting = state.phase == "acting"
                waited_s = (query.tick - state.since_tick) * tick_s if insisting else 0.0
                sight = sight_of(event, number, query, waited_s)
                walkers.append(walked_to(walker, x_m, y_m, event.speed_mps, sight, insisting=insisting))
            elif state.phase == "acting":
                heading = turned(walker.heading_rad, facing(event, walker, query, state), tick_s)
                walkers.append(msgspec.structs.replace(walker, heading_rad=heading))
            else:
                walkers.append(walker)
        return msgspec.structs.replace(state, walkers=tuple(walkers))

    def shown(event: Event, state: EventState, number: int) -> Doing:
        return doing if state.phase == "acting" else "stand"

    return Behavior(ahead(STANDING_TRIGGER_M), _begin, act, shown)


def _about(event: Event, walker: Walker, query: EventQuery, state: EventState) -> float:
    """Against the robot's way, swinging to either side."""
    phase = 2 * math.pi * (query.tick - state.since_tick) * query.tick_ms / 1000 / LOOK_PERIOD_S
    return event.heading_rad + math.pi + LOOK_SWING_RAD * math.sin(phase)


def _inward(event: Event, walker: Walker, query: EventQuery, state: EventState) -> float:
    """To the middle of the group."""
    return math.atan2(event.y_m - walker.y_m, event.x_m - walker.x_m)


def _forward(event: Event, walker: Walker, query: EventQuery, state: EventState) -> float:
    """To the head of the queue, at its side of the sidewalk."""
    return wrap_angle(event.heading_rad + event.side * math.pi / 2)


def _at_robot(event: Event, walker: Walker, query: EventQuery, state: EventState) -> float:
    """At the robot."""
    return math.atan2(query.robot_y_m - walker.y_m, query.robot_x_m - walker.x_m)


OBSTRUCTING: Final = _standing(middle, _about, "look")
CONVERSING: Final = _standing(talking_places, _inward, "talk")
QUEUEING: Final = _standing(queue_places, _forward, "queue")
GESTURING: Final = _standing(middle, _at_robot, "stop")
