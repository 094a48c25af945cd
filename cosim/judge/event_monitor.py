"""Watches the events of an episode: when they triggered, whether the camera could see them, whether their rules held.

Rules beyond the goal (the paper's table): the robot passes round the whole group of `conversing` and the whole line of
`queueing` (`EventKind.passed_round`), never between two of them. (`gesturing` ends its episode by a stop: see the
referee.)
"""

from __future__ import annotations

import itertools
import math
from typing import Final

import numpy as np

from cosim.core.geometry import Floats, Pose, wrap_angle
from cosim.episode.step import Step
from cosim.records.record import TriggeredEvent
from cosim.spec.event_kind import EventKinds
from cosim.spec.events import Event, EventState, Walker
from cosim.spec.scenario import Scenario

_SEEN_M: Final = 30.0
"""Farther away nobody counts as seen."""
HALF_VIEW_RAD: Final = math.radians(45.0)
"""Half the width of a view in which everybody must have been once; narrower than every camera of the field."""
PASSED_M: Final = 5.0
"""An event lies behind once the robot is this far beyond its place."""


class EventMonitor:
    """Watches the steps of one episode, in order. kinds: the table of its events."""

    def __init__(self, scenario: Scenario, kinds: EventKinds, tick_ms: int) -> None:
        self._events = scenario.events
        self._round = [kinds[event.kind].passed_round for event in scenario.events]
        self._tick_ms = tick_ms
        self._states: tuple[EventState, ...] = ()
        self._seen = [False] * len(self._events)
        self._between = [False] * len(self._events)
        self._furthest_m = 0.0
        self._tracks: list[tuple[float, ...]] = []

    def see(self, step: Step) -> None:
        """Take in what happened in a tick."""
        self._states = step.events.states
        self._furthest_m = max(self._furthest_m, step.route_s_after_m)
        before, after = step.robot.pose, step.motion.robot.pose
        for i, state in enumerate(self._states):
            if state.phase not in ("acting", "over"):
                continue
            self._seen[i] |= any(in_view(before, walker) for walker in state.walkers)
            if state.phase == "acting" and self._round[i]:
                self._between[i] |= went_between(before.xy, after.xy, state.walkers)
            for k, walker in enumerate(state.walkers):
                self._tracks.append((step.tick, i, k, walker.x_m, walker.y_m))

    @property
    def tracks(self) -> Floats:
        """(E, 5) tick, number of the event, number of the person in it, x m, y m; from each trigger on."""
        return np.array(self._tracks, dtype=float).reshape(-1, 5)

    def outcomes(self) -> tuple[TriggeredEvent, ...]:
        """What became of each event."""
        return tuple(
            TriggeredEvent(
                id=event.id,
                kind=event.kind,
                passed=self._furthest_m >= event.route_s_m + PASSED_M,
                triggered_at_s=None if state.triggered_tick is None else state.triggered_tick * self._tick_ms / 1000,
                trigger_distance_m=state.trigger_distance_m,
                seen=seen,
                rule_met=not between if judged else None,
            )
            for event, state, seen, judged, between in zip(
                self._events, self._states, self._seen, self._round, self._between, strict=True
            )
        )


def in_view(robot: Pose, walker: Walker) -> bool:
    """Whether somebody is before the robot, within HALF_VIEW_RAD of its heading and SEEN_M."""
    dx, dy = walker.x_m - robot.x_m, walker.y_m - robot.y_m
    off = wrap_angle(math.atan2(dy, dx) - robot.heading_rad)
    return math.hypot(dx, dy) <= _SEEN_M and abs(off) <= HALF_VIEW_RAD


def went_between(before: Floats, after: Floats, walkers: tuple[Walker, ...]) -> bool:
    """Whether a step (2,) -> (2,) crosses the line between any two of them."""
    places = [np.array([w.x_m, w.y_m]) for w in walkers]
    return any(_cross(before, after, a, b) for a, b in itertools.combinations(places, 2))


def _cross(a: Floats, b: Floats, c: Floats, d: Floats) -> bool:
    """Whether the open segments ab and cd meet."""
    return bool(_side(a, b, c) * _side(a, b, d) < 0.0 and _side(c, d, a) * _side(c, d, b) < 0.0)


def _side(a: Floats, b: Floats, p: Floats) -> float:
    return float((b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0]))


def why_invalid(event: Event, outcome: TriggeredEvent) -> str:
    """Why an event says nothing about the robot, in words; "" if it does."""
    if outcome.triggered_at_s is None:
        return f"event {event.id} ({event.kind}) never triggered"
    return "" if outcome.seen else f"nobody of event {event.id} ({event.kind}) was ever in view"
