"""Monitor for the events of an episode: trigger time, visibility and rules.

All positions come from the street, not from the event director.

An event is seen once a tenth of one of its people is unoccluded in the picture of the standard
camera, at most SEEN_WITHIN_M away. Visibility is tested by rays, so it does not depend on the
renderer and also exists for policies without a camera.

The paper's table has rules beyond the goal: the robot passes around the whole group of `conversing`
and the whole line of `queueing` (`EventKind.passed_as_group`), never between two people.
`gesturing` ends its episode at a stop: see the referee. Decoys, and events that require the robot
to give way, have the rules of `cosim.results.go_on`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats, Pose
from cosim.core.state import PersonKind, RobotState
from cosim.episode.loop import Step
from cosim.results.go_on import (
    STOP_S,
    Passing,
    PassingWindow,
    is_measured,
    passing_of,
    rule_met,
)
from cosim.results.record import TriggeredEvent
from cosim.results.referee import Ended
from cosim.spec.camera import CameraSpec
from cosim.spec.events import Event, EventKinds, EventState
from cosim.spec.robot import Mount, Robot
from cosim.spec.scenario import Scenario

SEEN_WITHIN_M: Final = 20.0
"""Distance, metres, beyond which people do not count as seen; all occluders are loaded up to it."""
_VISIBLE_SHARE: Final = 0.1
"""Share of a body that must be in the picture and unoccluded."""
STANDARD_CAMERA: Final = CameraSpec()
_BODY_M: Final = np.stack(
    np.meshgrid(np.linspace(-0.2, 0.2, 4), np.linspace(0.1, 1.6, 10)), axis=-1
).reshape(-1, 2)
"""Sample points of a body as seen by the camera: metres to its left and up."""
PASSED_M: Final = 5.0
"""Distance, metres, that the robot must be beyond an event to have passed it."""

OcclusionTest = Callable[[Floats, Floats], NDArray[np.bool_]]
"""Occlusion test: for each of (N, 3) points, whether a solid is between it and the eye (3,),
metres."""


class EventMonitor:
    """Monitor of the steps of one episode, called in order.

    kinds: table of event kinds
    robot: the robot that carries the camera
    occluded: occlusion test at the end of the current step
    """

    def __init__(
        self,
        scenario: Scenario,
        kinds: EventKinds,
        robot: Robot,
        occluded: OcclusionTest,
        tick_ms: int,
    ) -> None:
        self._events = scenario.events
        self._mount = STANDARD_CAMERA.on(robot)
        self._occluded = occluded
        self._passed_round = [kinds[event.kind].passed_as_group for event in scenario.events]
        self._tick_ms = tick_ms
        self._go_on_mps = scenario.go_on_mps
        self._windows = [
            PassingWindow(scenario.route_line, event, kinds[event.kind])
            if is_measured(event, scenario)
            else None
            for event in scenario.events
        ]
        self._route_s_m: list[float] = []
        self._v_mps: list[float] = []
        self._states: tuple[EventState, ...] = ()
        self._can_begin = [begins_on_route(scenario, event, kinds) for event in scenario.events]
        self._came_near = [False] * len(self._events)
        self._seen = [False] * len(self._events)
        self._went_between = [False] * len(self._events)
        self._furthest_m = 0.0
        self._tracks: list[tuple[float, ...]] = []

    def update(self, step: Step) -> None:
        """Process one tick."""
        self._states = step.events.states
        self._furthest_m = max(self._furthest_m, step.route_s_after_m)
        self._route_s_m.append(step.route_s_after_m)
        self._v_mps.append(step.motion.robot.v_mps)
        people = step.street_after.people
        rows = np.flatnonzero(people.are(PersonKind.EVENT)).tolist()
        shown = {people.ids[row]: people.xy[row] for row in rows}
        before = step.robot.pose
        after = step.motion.robot.pose
        for i, (event, state) in enumerate(zip(self._events, self._states, strict=True)):
            if state.triggered_tick is None and state.phase not in ("acting", "over"):
                continue
            places = {k: shown[name] for k, name in enumerate(event.names) if name in shown}
            if state.triggered_tick is not None:
                self._tracks += [(step.tick, i, person, *xy) for person, xy in places.items()]
                if (window := self._windows[i]) is not None:
                    window.update(step.tick, step.route_s_after_m, places)
            if state.phase not in ("acting", "over"):
                continue
            bodies = np.array(list(places.values())).reshape(-1, 2)
            if not self._seen[i]:
                near = bodies[np.hypot(*(bodies - after.xy).T) <= SEEN_WITHIN_M]
                self._came_near[i] |= len(near) > 0
                self._seen[i] = self._camera_sees(step.motion.robot, near)
            if state.phase == "acting" and self._passed_round[i]:
                self._went_between[i] |= passed_between(before.xy, after.xy, bodies)

    @property
    def rule_is_broken(self) -> bool:
        """Whether a rule is already broken for good; False before all events were seen."""
        return all(self._seen) and any(map(self._breaks, range(len(self._events))))

    def _breaks(self, i: int) -> bool:
        """Return whether the rule of an event is broken for good."""
        window, first = self._windows[i], self._states[i].triggered_tick
        if self._went_between[i]:
            return True
        if self._go_on_mps <= 0.0 or window is None or first is None:
            return False
        passing = self._motion(first, window.end or len(self._v_mps))
        if passing is None:
            return False
        if window.end is not None:
            return not rule_met(self._events[i], passing, self._go_on_mps)
        return self._events[i].decoy and passing.stopped_s >= STOP_S

    def _camera_sees(self, robot: RobotState, near: Floats) -> bool:
        """Return whether the camera sees one of the (N, 2) bodies within SEEN_WITHIN_M."""
        eye = camera_position(robot, self._mount)
        height_m = robot.z_m
        for xy in near:
            points = body_points(eye, xy, height_m)
            inside = points[in_picture(robot.pose, self._mount, STANDARD_CAMERA, points - eye)]
            least = _VISIBLE_SHARE * len(points)
            if len(inside) >= least and (~self._occluded(eye, inside)).sum() >= least:
                return True
        return False

    @property
    def tracks(self) -> Floats:
        """Positions of event people from the triggers on, (E, 5): tick, event, person, x m, y m."""
        return np.array(self._tracks, dtype=float).reshape(-1, 5)

    def outcomes(self, ended: Ended | None) -> tuple[TriggeredEvent, ...]:
        """Return the outcome of each event.

        ended: how the episode ended
        """
        return tuple(self._outcome(i, ended) for i in range(len(self._events)))

    def _outcome(self, i: int, ended: Ended | None) -> TriggeredEvent:
        event, state = self._events[i], self._states[i]
        end, passing = self._passing(i, ended)
        rules = [not self._went_between[i]] if self._passed_round[i] else []
        if self._go_on_mps > 0.0:
            rules.append(rule_met(event, passing, self._go_on_mps))
        return TriggeredEvent(
            id=event.id,
            kind=event.kind,
            passed=self._furthest_m >= event.route_s_m + PASSED_M,
            triggered_at_s=self._time_s(state.triggered_tick),
            trigger_distance_m=state.trigger_distance_m,
            seen=self._seen[i],
            staged=self._can_begin[i] if state.triggered_tick is None else self._came_near[i],
            rule_met=all(rules) if rules else None,
            passed_at_s=self._time_s(end),
            passing_mps=None if passing is None else passing.mean_mps,
            stopped_s=None if passing is None else passing.stopped_s,
        )

    def _passing(self, i: int, ended: Ended | None) -> tuple[int | None, Passing | None]:
        """Return the end of an event's window and the motion in it; None if not passed.

        The goal ends the window: people still ahead did not keep the robot from it.
        """
        window, first = self._windows[i], self._states[i].triggered_tick
        if window is None or first is None:
            return None, None
        end = window.end
        if end is None and ended == "goal":
            end = len(self._route_s_m)
        if end is None:
            return None, None
        return end, self._motion(first, end)

    def _motion(self, first: int, end: int) -> Passing | None:
        """Return the motion in the ticks first to end - 1."""
        s_m, v_mps = np.array(self._route_s_m), np.array(self._v_mps)
        return passing_of(s_m, v_mps, self._tick_ms / 1000, first, end)

    def _time_s(self, tick: int | None) -> float | None:
        return None if tick is None else tick * self._tick_ms / 1000


def begins_on_route(scenario: Scenario, event: Event, kinds: EventKinds) -> bool:
    """Return whether a robot that follows the route triggers an event before it is at the goal."""
    trigger_m = kinds[event.kind].trigger_m_of(event)
    first_m = event.route_s_m - (event.half_length_m if trigger_m is None else trigger_m)
    return first_m <= scenario.route_line.length_m - scenario.goal_radius_m


def camera_position(robot: RobotState, mount: Mount) -> Floats:
    """Return the position (3,) of a camera mounted on the robot, metres."""
    ahead, left, up = mount.at_m
    cos, sin = math.cos(robot.pose.heading_rad), math.sin(robot.pose.heading_rad)
    x, y = robot.pose[:2]
    return np.array([x + cos * ahead - sin * left, y + sin * ahead + cos * left, robot.z_m + up])


def body_points(eye: Floats, xy: Floats, ground_m: float) -> Floats:
    """Return (N, 3) sample points of a person at (2,), facing the eye, metres."""
    to = (xy - eye[:2]) / max(float(np.hypot(*(xy - eye[:2]))), 1e-9)
    left = np.array([-to[1], to[0]])
    return np.column_stack([xy + _BODY_M[:, :1] * left, ground_m + _BODY_M[:, 1]])


def in_picture(robot: Pose, mount: Mount, camera: CameraSpec, rays: Floats) -> NDArray[np.bool_]:
    """Return which of (N, 3) rays from the camera's eye fall into its picture."""
    cos, sin = math.cos(robot.heading_rad), math.sin(robot.heading_rad)
    level = rays[:, 0] * cos + rays[:, 1] * sin
    left = -rays[:, 0] * sin + rays[:, 1] * cos
    down = math.radians(mount.pitch_down_deg)
    ahead = level * math.cos(down) - rays[:, 2] * math.sin(down)
    up = level * math.sin(down) + rays[:, 2] * math.cos(down)
    half = math.tan(math.radians(camera.fov_deg) / 2)
    aside = half * camera.width / camera.height
    inside: NDArray[np.bool_] = (
        (ahead > 0.0) & (np.abs(left) <= aside * ahead) & (np.abs(up) <= half * ahead)
    )
    return inside


def passed_between(before: Floats, after: Floats, people: Floats) -> bool:
    """Return whether a step (2,) -> (2,) crosses the line between any two of (N, 2) people."""
    return any(_cross(before, after, a, b) for a, b in itertools.combinations(people, 2))


def _cross(a: Floats, b: Floats, c: Floats, d: Floats) -> bool:
    """Return whether the step ab crosses the open segment cd.

    A crossing at an end of ab counts for one of two consecutive steps, not for both.
    """
    over = (_side(c, d, a) >= 0.0) != (_side(c, d, b) >= 0.0)
    return bool(over and _side(a, b, c) * _side(a, b, d) < 0.0)


def _side(a: Floats, b: Floats, p: Floats) -> float:
    return float((b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0]))
