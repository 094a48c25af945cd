"""Those who stand in the way: `obstructing`, `conversing`, `queueing`, `gesturing`.

They wait at the edge of the sidewalk, step to their places when triggered, stay for their time, and step back.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

import msgspec
import numpy as np

from cosim.core.geometry import wrap_angle
from cosim.core.state import PERSON_RADIUS_M
from cosim.spec.event_kind import EventKind, SidewalkLayout
from cosim.spec.events import Event, EventQuery, EventState, Walker
from scenarios.events.sight import sight_of
from scenarios.events.walking import edge_m, spot, turned, walked_to, walker_at

_TRIGGER_M: Final = 10.0
LOOK_PERIOD_S: Final = 4.0
LOOK_SWING_RAD: Final = 1.0
TALK_M: Final = 0.62
"""From the middle of a group of talkers to each of them; a little more for four."""
QUEUE_M: Final = 0.65
"""From one person of a queue to the next: tight, and more than two radii."""
OPEN_M: Final = 1.25
"""Width that a drawn queue leaves beside it."""
GROUP_M: Final = 1.95
"""Half the width of a sidewalk on which one can pass round a group of talkers in its middle."""
WAITING_M: Final = 0.8
"""From one to the next of those who wait at the edge."""

_Place = tuple[float, float]
"""Metres along the event's heading and to the left."""
_Facing = Callable[[Event, Walker, EventQuery, EventState], float]
_PASSABLE: Final = SidewalkLayout((18.0, 20.0), (11.0, 13.0))


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


def _begin(event: Event, number: int) -> Walker:
    return walker_at(event, *_aside(event, number), math.pi)


def _ends(event: Event, state: EventState, query: EventQuery) -> bool:
    return (query.tick - state.since_tick) * query.tick_ms / 1000 >= event.hold_s


def _standing(
    places: Callable[[Event], tuple[_Place, ...]], facing: _Facing
) -> Callable[[Event, EventState, int, EventQuery], Walker]:
    """The steps of those who go to `places` and face somewhere there."""

    def step(event: Event, state: EventState, number: int, query: EventQuery) -> Walker:
        walker, acting = state.walkers[number], state.phase == "acting"
        tick_s = query.tick_ms / 1000
        x_m, y_m = spot(event, *(places(event)[number] if acting else _aside(event, number)))
        if (walker.x_m, walker.y_m) != (x_m, y_m):
            sight = sight_of(event, number, query, (query.tick - state.since_tick) * tick_s if acting else 0.0)
            return walked_to(walker, x_m, y_m, event.speed_mps, sight, insisting=acting)
        if acting:
            heading = turned(walker.heading_rad, facing(event, walker, query, state), tick_s)
            return msgspec.structs.replace(walker, heading_rad=heading)
        return walker

    return step


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


def _queue(half_width_m: float, rng: np.random.Generator) -> int:
    """As long as leaves OPEN_M beside it, past the middle."""
    return max(2, min(5, int((2 * half_width_m - OPEN_M - 2 * PERSON_RADIUS_M) / QUEUE_M) + 1))


OBSTRUCTING: Final = EventKind(
    name="obstructing",
    layout=_PASSABLE,
    on_long_ways=True,
    trigger_m=_TRIGGER_M,
    begin=_begin,
    step=_standing(middle, _about),
    ends=_ends,
    pose="look",
)
CONVERSING: Final = EventKind(
    name="conversing",
    people=(2, 4),
    layout=SidewalkLayout((18.0, 20.0), (11.5, 13.0), GROUP_M),
    trigger_m=_TRIGGER_M,
    begin=_begin,
    step=_standing(talking_places, _inward),
    ends=_ends,
    pose="talk",
    passed_round=True,
)
QUEUEING: Final = EventKind(
    name="queueing",
    people=(2, 5),
    layout=_PASSABLE._replace(half_width_m=1.4),
    group=_queue,
    trigger_m=_TRIGGER_M,
    begin=_begin,
    step=_standing(queue_places, _forward),
    ends=_ends,
    pose="queue",
    passed_round=True,
)
GESTURING: Final = EventKind(
    name="gesturing",
    layout=_PASSABLE,
    trigger_m=_TRIGGER_M,
    begin=_begin,
    step=_standing(middle, _at_robot),
    ends=_ends,
    pose="stop",
    ends_at="stop",
)
