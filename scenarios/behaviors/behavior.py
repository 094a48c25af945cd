"""Behavior: what one kind of event is made of, and when it begins."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from cosim.events import Event, EventQuery, EventState, Walker
from cosim.state import Doing


class Behavior(NamedTuple):
    """One kind of event.

    trigger(event, query) -> metres along the route from the robot to the event, once it begins; None before.
    begin(event) -> its people before the trigger. act(event, state, query) -> the next state once triggered.
    doing(event, state, number) -> what person `number` shows while it stands.
    """

    trigger: Callable[[Event, EventQuery], float | None]
    begin: Callable[[Event], tuple[Walker, ...]]
    act: Callable[[Event, EventState, EventQuery], EventState]
    doing: Callable[[Event, EventState, int], Doing]


def ahead(within_m: float) -> Callable[[Event, EventQuery], float | None]:
    """Begins when the event's place is at most so far ahead of the robot along the route."""

    def trigger(event: Event, query: EventQuery) -> float | None:
        gap_m = event.route_s_m - query.route_s_m
        return gap_m if 0.0 <= gap_m <= within_m else None

    return trigger


def behind(within_m: float) -> Callable[[Event, EventQuery], float | None]:
    """Begins when the event's place is behind the robot, at most so far."""

    def trigger(event: Event, query: EventQuery) -> float | None:
        gap_m = event.route_s_m - query.route_s_m
        return gap_m if -within_m <= gap_m < 0.0 else None

    return trigger


def entered(event: Event, query: EventQuery) -> float | None:
    """Begins when the robot's base centre is on the crosswalk."""
    gap_m = event.route_s_m - query.route_s_m
    return gap_m if abs(gap_m) <= event.half_length_m else None
