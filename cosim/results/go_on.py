"""Go-on rule of decoys: pass a person who gives no reason to stop, without a stop.

The rule covers the ticks from the trigger until the robot has passed the people of the event. The
mean speed along the route must reach `Scenario.go_on_mps`. The robot must not stop either, because
a fast robot could reach the mean speed in spite of a stop.

An event with `Scenario.go_on_mps` has the opposite rule: the robot must give way, so it must be
slower or stop. If the robot alone ends the window, the same motion cannot meet both rules.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple

import numpy as np

from cosim.core.geometry import Floats, Polyline
from cosim.spec.events import Event, EventKind
from cosim.spec.scenario import Scenario

PAST_M: Final = 1.0
"""Arc length, metres, that the robot must be beyond a person to have passed."""
OVERTAKEN_M: Final = 7.8
"""Length of route, metres, after the trigger on which a person from behind overtakes the robot. A
robot of up to 2 m/s that drives straight ahead meets a person who cuts in there."""
STOP_MPS: Final = 0.1
"""Speed along the robot's heading below which it stops."""
STOP_S: Final = 0.5
"""Duration, seconds, from which slow ticks in a row are a stop."""
_SEARCH_M: Final = 40.0
"""Range of arc length around the robot, metres, in which people are searched."""


class Passing(NamedTuple):
    """Motion of the robot while it passes the people of an event.

    mean_mps: progress along the route / time
    stopped_s: longest time in a row slower than STOP_MPS
    """

    mean_mps: float
    stopped_s: float

    def goes_on(self, least_mps: float) -> bool:
        """Return whether the robot met the go-on rule with this mean speed."""
        return self.mean_mps >= least_mps and self.stopped_s < STOP_S


def passing_of(
    route_s_m: Floats, v_mps: Floats, tick_s: float, first: int, end: int
) -> Passing | None:
    """Return the motion in the ticks first to end - 1; None for an impossible range.

    route_s_m, v_mps: (T,) arc length and speed at the end of each tick of the episode
    """
    if not 0 <= first < end <= len(route_s_m):
        return None
    begun_m = float(route_s_m[first - 1]) if first else 0.0
    mean_mps = (float(route_s_m[end - 1]) - begun_m) / ((end - first) * tick_s)
    stopped = longest = 0
    for slow in (np.asarray(v_mps[first:end]) < STOP_MPS).tolist():
        stopped = stopped + 1 if slow else 0
        longest = max(longest, stopped)
    return Passing(mean_mps, longest * tick_s)


def is_measured(event: Event, scenario: Scenario) -> bool:
    """Return whether the passing of an event is measured: in decoys without a reason to stop, and
    in scenarios with a rule."""
    return event.decoy or scenario.go_on_mps > 0.0


def rule_met(event: Event, passing: Passing | None, go_on_mps: float) -> bool:
    """Return whether the robot went on in a decoy, or gave way in an event.

    It is False if the robot did not pass. go_on_mps: see `Scenario`.
    """
    return passing is not None and passing.goes_on(go_on_mps) == event.decoy


def overtaken_at_m(event: Event, kind: EventKind) -> float | None:
    """Return the arc length, metres, at which the window of an event from behind ends.

    It is None for people in front of the robot.
    """
    trigger_m = kind.trigger_m_of(event)
    if trigger_m is None or trigger_m >= 0.0:
        return None
    return event.route_s_m - trigger_m + OVERTAKEN_M


class PassingWindow:
    """Finds the tick at which the robot has passed all people of an event, from their positions.

    A person is passed when the robot is PAST_M beyond along the route. A person who has left the
    street is passed, too. For people who come from behind, the window ends OVERTAKEN_M after the
    trigger, wherever they are: the person of an event stays in front of the robot.
    """

    def __init__(self, route: Polyline, event: Event, kind: EventKind) -> None:
        self._overtaken_at_m = overtaken_at_m(event, kind)
        self._route = route
        self._passed = [False] * event.people
        self.end: int | None = None
        """Number of the tick after the last one; None until all people are passed."""

    def update(self, tick: int, route_s_m: float, people: Mapping[int, Floats]) -> None:
        """Process a tick after the trigger.

        route_s_m: robot's arc length at the end of the tick
        people: positions (2,) at the end of the tick, by the person's number in the event
        """
        if self.end is not None:
            return
        if self._overtaken_at_m is not None:
            self.end = tick + 1 if route_s_m >= self._overtaken_at_m else None
            return
        near = route_s_m - _SEARCH_M, route_s_m + _SEARCH_M
        for person in np.flatnonzero(~np.array(self._passed, dtype=bool)).tolist():
            if person not in people:
                self._passed[person] = True
                continue
            x_m, y_m = people[person].tolist()
            ahead_m = self._route.project(x_m, y_m, near)[0] - route_s_m
            self._passed[person] = ahead_m <= -PAST_M
        if all(self._passed):
            self.end = tick + 1
