"""EventKind: all there is to one kind of event, a row of a table.

The table that ships is `scenarios.events.EVENT_KINDS`. Whoever draws, directs, judges or shows
events is handed one, so that a kind is added by its row alone: `EVENT_KINDS | {MINE.name: MINE}`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from cosim.core.state import Age, Doing
from cosim.spec.events import Event, EventQuery, EventState, Walker


class SidewalkLayout(NamedTuple):
    """Where a drawn event is along a sidewalk. way_m: length of the way, shortest and longest;
    event_m: from the start to the event's place, nearest and farthest, farther than its trigger
    reaches; half_width_m: least half of the sidewalk's width."""

    way_m: tuple[float, float]
    event_m: tuple[float, float]
    half_width_m: float = 1.3


@dataclass(frozen=True, kw_only=True)
class EventKind:
    """One kind of event.

    name: in scenarios, on the command line, in tables. people: fewest and most. layout: where a
    reactive scenario has it, and the room that it needs on a long way; None over a crosswalk.
    group(half_width_m, rng) -> how many people a drawn one has; None: any number.

    trigger_m: it begins when the robot is so far before its place along the route; below 0, when
    the robot has just come so far past it; None, when the robot is on the crosswalk. begin(event,
    number) -> person `number` before that. step(event, state, number, query) -> the same person a
    tick on, from the trigger on. ends(event, state, query) -> whether what began is over: its
    people go their ways, and once they are out of sight they are gone. pose, age: what its people
    show who stand while it goes on, and how old they look.

    passed_round: the robot is to pass round all of its people, never between two. ends_at: a
    reactive scenario of it ends at the goal, or when the robot has stopped before its people.
    """

    name: str
    people: tuple[int, int] = (1, 1)
    layout: SidewalkLayout | None
    group: Callable[[float, np.random.Generator], int] | None = None
    trigger_m: float | None
    begin: Callable[[Event, int], Walker]
    step: Callable[[Event, EventState, int, EventQuery], Walker]
    ends: Callable[[Event, EventState, EventQuery], bool]
    pose: Doing = "stand"
    age: Age = Age.ADULT
    passed_round: bool = False
    ends_at: Literal["goal", "stop"] = "goal"


EventKinds = Mapping[str, EventKind]
"""The table: kinds of events by their names."""
