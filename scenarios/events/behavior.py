"""Behavior: what one kind of event is made of, and when it begins."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from cosim.core.state import Doing
from cosim.spec.events import Event, EventQuery, EventState, Walker


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


def once_behind(by_m: float) -> Callable[[Event, EventQuery], float | None]:
    """Begins at the last tick at which the event's place is no farther behind the robot than this."""

    def trigger(event: Event, query: EventQuery) -> float | None:
        gap_m = event.route_s_m - query.route_s_m
        step_m = max(query.robot_v_mps, 0.0) * query.tick_ms / 1000
        return gap_m if -by_m - step_m <= gap_m < step_m - by_m else None

    return trigger


def entered(event: Event, query: EventQuery) -> float | None:
    """Begins when the robot's base centre is on the crosswalk."""
    gap_m = event.route_s_m - query.route_s_m
    return gap_m if abs(gap_m) <= event.half_length_m else None
