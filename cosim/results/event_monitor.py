"""Watches the events of an episode: when they triggered, whether the camera could see them, whether
their rules held.

Positions are those that the street showed, not what the director says of itself.

Seen is an event once a tenth of the body of one of its people was unhidden in the picture of the
standard camera, at most SEEN_WITHIN_M away: found by rays, so that it is the same for a policy
without a camera and for every renderer.

Rules beyond the goal (the paper's table): the robot passes round the whole group of `conversing`
and the whole line of `queueing` (`EventKind.passed_round`), never between two of them. (`gesturing`
ends its episode by a stop: see the referee.)
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats, Pose
from cosim.core.state import PersonKind, RobotState
from cosim.episode.loop import Step
from cosim.results.record import Record, TriggeredEvent
from cosim.spec.camera import CameraSpec
from cosim.spec.events import Event, EventKinds, EventState
from cosim.spec.robot import Mount, Robot
from cosim.spec.scenario import Scenario

SEEN_WITHIN_M: Final = 20.0
"""Farther away nobody counts as seen; so far the engine has everything that can hide somebody."""
_UNHIDDEN: Final = 0.1
"""Share of a body that must be in the picture and unhidden."""
STANDARD_CAMERA: Final = CameraSpec()
_BODY_M: Final = np.stack(
    np.meshgrid(np.linspace(-0.2, 0.2, 4), np.linspace(0.1, 1.6, 10)), axis=-1
).reshape(-1, 2)
"""Points of a body as it is seen: metres to its left and up."""
PASSED_M: Final = 5.0
"""An event lies behind once the robot is this far beyond its place."""
_MOVED_M: Final = 1e-6
_MOVED: Final = np.full(2, np.nan)

Hidden = Callable[[Floats, Floats], NDArray[np.bool_]]
"""Whether something solid stands between an eye (3,) and each of (N, 3) points, metres."""


class EventMonitor:
    """Watches the steps of one episode, in order. kinds: the table of its events; robot: who
    carries the camera; hidden: asked about the moment at which a Step ends."""

    def __init__(
        self, scenario: Scenario, kinds: EventKinds, robot: Robot, hidden: Hidden, tick_ms: int
    ) -> None:
        self._events = scenario.events
        self._mount = STANDARD_CAMERA.on(robot)
        self._hidden = hidden
        self._round = [kinds[event.kind].passed_round for event in scenario.events]
        self._tick_ms = tick_ms
        self._states: tuple[EventState, ...] = ()
        self._seen = [False] * len(self._events)
        self._between = [False] * len(self._events)
        self._furthest_m = 0.0
        self._waiting: dict[tuple[int, int], Floats] = {}
        self._tracks: list[tuple[float, ...]] = []

    def see(self, step: Step) -> None:
        """Take in what happened in a tick."""
        self._states = step.events.states
        self._furthest_m = max(self._furthest_m, step.route_s_after_m)
        people = step.street_after.people
        rows = np.flatnonzero(people.are(PersonKind.EVENT)).tolist()
        shown = {people.ids[row]: people.xy[row] for row in rows}
        before = step.robot.pose
        after = step.motion.robot.pose
        for i, (event, state) in enumerate(zip(self._events, self._states, strict=True)):
            places = {k: shown[name] for k, name in enumerate(event.names) if name in shown}
            self._track(step.tick, i, places)
            if state.phase not in ("acting", "over"):
                continue
            bodies = np.array(list(places.values())).reshape(-1, 2)
            self._seen[i] = self._seen[i] or self._sees(step.motion.robot, bodies)
            if state.phase == "acting" and self._round[i]:
                self._between[i] |= went_between(before.xy, after.xy, bodies)

    def _track(self, tick: int, event: int, places: Mapping[int, Floats]) -> None:
        """Keep where the people of an event are, each from its first move on."""
        for person, xy in places.items():
            waits_at = self._waiting.setdefault((event, person), xy)
            if waits_at is _MOVED or np.abs(xy - waits_at).max() > _MOVED_M:
                self._waiting[event, person] = _MOVED
                self._tracks.append((tick, event, person, *xy))

    def _sees(self, robot: RobotState, bodies: Floats) -> bool:
        """Whether one of the (N, 2) bodies is in the picture, a tenth of it unhidden."""
        eye = eye_of(robot, self._mount)
        height_m = robot.z_m
        for xy in bodies[np.hypot(*(bodies - robot.pose.xy).T) <= SEEN_WITHIN_M]:
            points = body_points(eye, xy, height_m)
            inside = points[in_picture(robot.pose, self._mount, STANDARD_CAMERA, points - eye)]
            least = _UNHIDDEN * len(points)
            if len(inside) >= least and (~self._hidden(eye, inside)).sum() >= least:
                return True
        return False

    @property
    def tracks(self) -> Floats:
        """(E, 5) tick, number of the event, number of the person in it, x m, y m; from each one's
        first move on."""
        return np.array(self._tracks, dtype=float).reshape(-1, 5)

    def outcomes(self) -> tuple[TriggeredEvent, ...]:
        """What became of each event."""
        return tuple(
            TriggeredEvent(
                id=event.id,
                kind=event.kind,
                passed=self._furthest_m >= event.route_s_m + PASSED_M,
                triggered_at_s=None
                if state.triggered_tick is None
                else state.triggered_tick * self._tick_ms / 1000,
                trigger_distance_m=state.trigger_distance_m,
                seen=seen,
                rule_met=not between if judged else None,
            )
            for event, state, seen, judged, between in zip(
                self._events, self._states, self._seen, self._round, self._between, strict=True
            )
        )


def eye_of(robot: RobotState, mount: Mount) -> Floats:
    """(3,) where a camera at a mount of the robot is, metres."""
    ahead, left, up = mount.at_m
    cos, sin = math.cos(robot.pose.heading_rad), math.sin(robot.pose.heading_rad)
    x, y = robot.pose[:2]
    return np.array([x + cos * ahead - sin * left, y + sin * ahead + cos * left, robot.z_m + up])


def body_points(eye: Floats, xy: Floats, ground_m: float) -> Floats:
    """(N, 3) points of somebody at (2,) who stands on the ground and is seen from an eye."""
    to = (xy - eye[:2]) / max(float(np.hypot(*(xy - eye[:2]))), 1e-9)
    left = np.array([-to[1], to[0]])
    return np.column_stack([xy + _BODY_M[:, :1] * left, ground_m + _BODY_M[:, 1]])


def in_picture(robot: Pose, mount: Mount, camera: CameraSpec, rays: Floats) -> NDArray[np.bool_]:
    """Which of (N, 3) rays from the eye of a camera end in its picture."""
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


def went_between(before: Floats, after: Floats, people: Floats) -> bool:
    """Whether a step (2,) -> (2,) crosses the line between any two of (N, 2) people."""
    return any(_cross(before, after, a, b) for a, b in itertools.combinations(people, 2))


def _cross(a: Floats, b: Floats, c: Floats, d: Floats) -> bool:
    """Whether the step ab leads over the open segment cd; one that ends on it, or the next one, but
    not both."""
    over = (_side(c, d, a) >= 0.0) != (_side(c, d, b) >= 0.0)
    return bool(over and _side(a, b, c) * _side(a, b, d) < 0.0)


def _side(a: Floats, b: Floats, p: Floats) -> float:
    return float((b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0]))


def why_invalid(record: Record, scenario: Scenario) -> str:
    """Why an episode that is about its event says nothing about the robot that came by; "" if it
    does. Whoever fails before it comes by has failed.

    A long way has events that a robot may fail to come to; there this makes nothing invalid.
    """
    if not scenario.ends_on_failure or record.failures or record.ended not in ("goal", "stop"):
        return ""
    reasons = [
        why_unseen(event, outcome)
        for event, outcome in zip(scenario.events, record.events, strict=True)
    ]
    return "; ".join(filter(None, reasons))


def why_unseen(event: Event, outcome: TriggeredEvent) -> str:
    """Why an event says nothing about the robot that came by, in words; "" if it does."""
    if outcome.triggered_at_s is None:
        return f"event {event.id} ({event.kind}) never triggered"
    return "" if outcome.seen else f"nobody of event {event.id} ({event.kind}) could be seen"
