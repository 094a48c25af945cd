"""Film of an episode, drawn from behind, from above or from the robot while its record is replayed.

The replay is the same episode. Every tick is compared with the recorded trajectory, and at the end
the state hash with that of the record. A film that ends earlier stops the simulation at its last
picture. It has no state hash, but every tick of it is checked.
"""

from __future__ import annotations

import math
from collections import Counter
from contextlib import ExitStack
from pathlib import Path
from typing import Final, NamedTuple

import cv2
import numpy as np

from cosim.core.clock import Clock
from cosim.core.errors import RunError, listed
from cosim.core.geometry import Floats
from cosim.core.progress import Progress, ignore
from cosim.core.state import DIRECTED, RobotState, Street
from cosim.episode.interfaces import ViewCamera
from cosim.episode.loop import Step
from cosim.report import hud
from cosim.report.encoding import Video
from cosim.report.legend import Image
from cosim.report.minimap import PLANNED, Minimap
from cosim.report.page.reasons import mishaps_of, reason_of
from cosim.results.record import Record
from cosim.results.referee import Verdict
from cosim.results.run_folder import read_records, read_spec
from cosim.results.waypoint_replay import WaypointReplay
from cosim.spec.camera import CameraSpec
from cosim.spec.robot import Legs, robot_called
from cosim.spec.run_config import Appearance, CameraChoice
from physics.cameras.view import robot_shot
from scenarios.episodes.replay import (
    RecordedEpisode,
    ReplayChecker,
    check_state_hash,
    load_recorded,
    replay_episode,
)
from scenarios.places.nets import place, surface_of_place
from scenarios.tools.viewing.drawn_route import way_in_picture
from scenarios.tools.viewing.look import Viewpoint, eye_behind, over
from sumo_nets.maps.map_store import credit_of

EASE_S: Final = 0.5
"""Time constant with which the heading of the view follows that of the robot, in seconds."""
SMALLEST_PX: Final = (320, 180)
ROBOT_FOV_DEG: Final = 75.0
"""Vertical angle of view of the robot's camera at 4:3, in degrees. Wider pictures show no more to
the sides.
"""
ROBOT_ASIDE: Final = math.tan(math.radians(ROBOT_FOV_DEG / 2)) * 4.0 / 3.0
_FOV_DEG: Final = 62.0
"""Vertical angle of view from behind and from above, in degrees."""
ABOVE_REST: Final = (2.0, 0.0, 10.0)
"""Resting view from above: metres ahead and to the left of the robot, and height of the eye."""
ABOVE_HIGH_M: Final = (6.5, 12.0)
_NEAR_M: Final = 8.0
"""Distance within which people of events stay in the view from above, in metres."""
BEFORE_S = 10.0
AFTER_S = 2.0
"""Time before and after a failure that its film shows, in seconds."""


class Cut(NamedTuple):
    """Part of an episode that is filmed.

    from_s, to_s: simulated time.
    size: width and height in pixels.
    speed: factor of real time.
    camera: renderer.
    view: viewpoint.
    appearance: of scanned places, by default that of the run.
    """

    from_s: float = 0.0
    to_s: float = math.inf
    size: tuple[int, int] = (1280, 720)
    speed: int = 1
    camera: CameraChoice = "auto"
    view: Viewpoint = "follow"
    appearance: Appearance | None = None


class FilmedFailure(NamedTuple):
    """First failure of an episode: its time, its reason, and the seconds that a film of it
    shows.
    """

    scenario: str
    at_s: float
    reason: str
    from_s: float
    to_s: float


def failure_to_film(folder: Path, scenario_id: str | None) -> FilmedFailure:
    """Choose the first failure of an episode; by default of the first failed episode of the run.

    Raises UsageError for an unknown episode, and RunError with the outcomes if nothing failed.
    """
    records = {record.scenario.id: record for record in read_records(folder)}
    failed = [
        name for name in read_spec(folder).scenarios if name in records and _failed(records[name])
    ]
    if scenario_id is not None and scenario_id in records and scenario_id not in failed:
        others = f". Episodes that failed: {listed(scenario_id, failed)}" if failed else ""
        raise RunError(
            f"{folder}: '{scenario_id}' did not fail: {_outcome(records[scenario_id])}{others}"
        )
    if scenario_id is None and not failed:
        outcomes = Counter(
            "succeeded" if one.status == "done" else one.status for one in records.values()
        )
        counts = (
            ", ".join(f"{count} {outcome}" for outcome, count in outcomes.items())
            or "no episode has ended"
        )
        raise RunError(f"{folder}: no episode failed: {counts}. Name an EPISODE to film it")
    recorded = load_recorded(folder, scenario_id or failed[0])
    mishap = mishaps_of(recorded.record)[0]
    at_s = Clock().time_s(mishap.tick + 1)
    reason = reason_of(recorded.scenario, recorded.record, mishap, recorded.log)
    return FilmedFailure(
        recorded.record.scenario.id, at_s, reason, max(0.0, at_s - BEFORE_S), at_s + AFTER_S
    )


def _failed(record: Record) -> bool:
    """Return whether an episode came to its end and something went wrong in it."""
    return record.ended is not None and bool(mishaps_of(record))


def _outcome(record: Record) -> str:
    if record.status == "done":
        return f"it ended {'at the goal' if record.ended == 'goal' else f'by {record.ended}'}"
    return f"it is {record.status}: {record.reason}"


def make_film(
    folder: Path, scenario_id: str, output: Path, cut: Cut, progress: Progress = ignore
) -> float:
    """Write the film of a finished episode.

    Returns the simulated second at which it ends, infinite for the end of the episode. Raises
    RunError if the episode does not exist or the replay differs. No file is then written.
    """
    recorded = load_recorded(folder, scenario_id)
    scenario, log = recorded.scenario, recorded.log
    if not cut.from_s < cut.to_s:
        raise RunError(
            f"nothing lies between --from {cut.from_s:g} s and --to {cut.to_s:g} s: give a "
            f"later --to"
        )
    last = min(len(log), Clock().ticks(min(cut.to_s, 1e6)))
    if not 0.0 <= cut.from_s < Clock().time_s(last):
        raise RunError(
            f"'{scenario_id}' lasts {Clock().time_s(len(log)):.1f} s: nothing to film from "
            f"{cut.from_s:g} s on"
        )
    if cut.size[0] < SMALLEST_PX[0] or cut.size[1] < SMALLEST_PX[1]:
        least = "x".join(map(str, SMALLEST_PX))
        raise RunError(
            f"a film of {cut.size[0]}x{cut.size[1]} pixels: below {least} nothing can be read"
        )
    progress("reading the street map, starting SUMO, PyBullet and the camera")
    _, street_map = place(scenario.place)
    fps = round(1.0 / Clock().tick_s)
    with ExitStack() as stack:
        video = stack.enter_context(Video(output, cut.size, fps))
        episode, policy = replay_episode(recorded, cut.camera, appearance=cut.appearance)
        stack.enter_context(episode)
        camera = stack.enter_context(episode.eyes(robot_eye(cut)))
        minimap = Minimap(street_map, scenario, episode.footprint_m)
        reel = _Reel(recorded, minimap, camera, video, cut, last, progress)
        for watch in (ReplayChecker(folder, recorded).watch, reel.take):
            episode.watch(watch)
        observation = episode.reset()
        while not episode.over and episode.moment.tick < last:
            observation = episode.advance(policy.act(observation))
        if episode.over:
            check_state_hash(folder, recorded, episode.result()[0].state_hash)
    return math.inf if last == len(log) else Clock().time_s(last)


def robot_eye(cut: Cut) -> CameraSpec:
    """Return the camera of the robot in the size of the film."""
    layout = hud.Layout.of(*cut.size)
    area = layout.view if cut.view == "robot" else layout.second
    up = min(ROBOT_ASIDE * area.height / area.width, math.tan(math.radians(ROBOT_FOV_DEG / 2)))
    return CameraSpec(area.width, area.height, math.degrees(2.0 * math.atan(up)))


class _Reel:
    """Draws step after step. The follower's eye moves smoothly from picture to picture."""

    def __init__(
        self,
        recorded: RecordedEpisode,
        minimap: Minimap,
        camera: ViewCamera,
        video: Video,
        cut: Cut,
        last: int,
        progress: Progress,
    ) -> None:
        self._scenario = recorded.scenario
        self._record = recorded.record
        self._minimap = minimap
        self._following = WaypointReplay(recorded.log)
        self._credit = credit_of(recorded.scenario.place)
        self._plan: Floats | None = None
        self._camera = camera
        self._video = video
        self._cut = cut
        self._last = last
        self._progress = progress
        self._counts = {"collision": 0, "out_of_lane": 0, "freezing": 0}
        if isinstance(robot_called(recorded.scenario.robot).drive, Legs):
            self._counts["fall"] = 0
        self._triggered: set[str] = set()
        self._caption = ("", hud.INK)
        self._caption_until = -1
        self._ahead: Floats = np.zeros(2)
        self._over: Floats = np.array(ABOVE_REST)

    def take(self, step: Step, verdict: Verdict) -> None:
        """Process one tick of the episode; draw it if it lies within the cut."""
        self._note(step, verdict)
        self._plan = self._following.update(step, verdict.reset is not None)
        robot = step.motion.robot
        ahead = np.array([math.cos(robot.pose.heading_rad), math.sin(robot.pose.heading_rad)])
        share = Clock().tick_s / EASE_S
        self._ahead = (1.0 - share) * self._ahead + share * ahead if self._ahead.any() else ahead
        self._over = (1.0 - share) * self._over + share * _framed(robot, step.street_after)
        first = Clock().ticks(self._cut.from_s)
        if step.tick < first:
            self._progress(f"simulating to {self._cut.from_s:g} s", step.tick / first)
        if first <= step.tick < self._last and (step.tick - first) % self._cut.speed == 0:
            self._video.add(self._picture(step, robot, step.street_after))
            self._progress(
                f"filming {self._scenario.id}", (step.tick - first) / (self._last - first)
            )

    def _picture(self, step: Step, robot: RobotState, street: Street) -> Image:
        width, height = self._cut.size
        layout = hud.Layout.of(width, height)
        image: Image = np.zeros((height, width, 3), dtype=np.uint8)
        seen = self._seen(robot, street)
        if self._cut.view == "robot":
            hud.fill(image, layout.view, seen)
            hud.fill(
                image,
                layout.second,
                self._outside("follow", layout.second, robot, street),
                "from behind",
            )
        else:
            hud.fill(image, layout.view, self._outside(self._cut.view, layout.view, robot, street))
            hud.fill(image, layout.second, seen, "robot's camera")
        area = layout.map
        drawn = self._minimap.picture(
            robot, street, (area.width, area.height), self._ahead, self._plan
        )
        hud.fill(image, area, drawn, self._credit)
        time_s = Clock().time_s(step.tick)
        counts = "  ".join(f"{name.replace('_', ' ')} {n}" for name, n in self._counts.items())
        done = step.route_s_after_m / self._scenario.route_line.length_m
        left = (
            f"{self._scenario.id}  {self._record.manifest.name}  {time_s:5.1f} s  "
            f"{round(robot.v_mps, 1) + 0.0:.1f} m/s"
        )
        hud.bar(image, layout.bar, left, f"route {100.0 * done:.0f} %   {counts}", done)
        if step.tick < self._caption_until:
            hud.caption(image, layout.view, *self._caption)
        return image

    def _seen(self, robot: RobotState, street: Street) -> Image:
        """Draw the view of the robot's camera, with the waypoints that are followed."""
        seen = self._camera.render(robot, street).rgb
        if self._plan is None:
            return seen
        surface = surface_of_place(self._scenario.place)
        spec = robot_eye(self._cut)
        shot = robot_shot(surface, robot_called(self._scenario.robot), spec, robot)
        way = way_in_picture(
            shot, spec.lens, np.column_stack([self._plan, surface.heights(self._plan)])
        )
        drawn = seen.copy()
        wide = max(2, spec.width // 160)
        cv2.polylines(
            drawn,
            [np.int32(np.round(line)) for line in way.lines],
            False,
            PLANNED,
            wide,
            cv2.LINE_AA,
        )
        for x, y in np.round(way.points[1:][np.isfinite(way.points[1:, 0])]).astype(int).tolist():
            cv2.circle(drawn, (x, y), wide + 1, PLANNED, -1, cv2.LINE_AA)
        return drawn

    def _outside(self, view: Viewpoint, area: hud.Area, robot: RobotState, street: Street) -> Image:
        """Draw the view from behind the robot or from above it."""
        if view == "follow":
            eye, target = eye_behind(robot, self._ahead)
        else:
            eye, target = over(robot, self._ahead, self._over)
        return self._camera.picture(
            eye, target, street, robot, (area.width, area.height), _FOV_DEG
        ).rgb

    def _note(self, step: Step, verdict: Verdict) -> None:
        """Count failures, and choose the caption."""
        for event, state in zip(self._scenario.events, step.events.states, strict=True):
            if state.phase == "acting" and event.id not in self._triggered:
                self._triggered.add(event.id)
                decoy = " (decoy)" if self._scenario.decoy_of else ""
                self._say(step.tick, event.kind.replace("_", " ") + decoy, hud.INK)
        for failure in verdict.failures:
            self._counts[failure.kind] += 1
            other = f" with {failure.other_kind}" if failure.other_kind else ""
            self._say(step.tick, failure.kind.replace("_", " ") + other, hud.BAD)
        for contact in verdict.walked_into:
            self._say(step.tick, f"{contact.suffered} by pedestrian", hud.INK)
        if verdict.ended == "goal":
            self._say(step.tick, "goal", hud.GOOD)

    def _say(self, tick: int, text: str, colour: tuple[int, int, int]) -> None:
        self._caption = (text, colour)
        self._caption_until = tick + Clock().ticks(hud.CAPTION_S)


def _framed(robot: RobotState, street: Street) -> Floats:
    """Return a view of the robot and the event people near it.

    It is (3,) metres ahead and left of the robot, and height.
    """
    cos, sin = math.cos(robot.pose.heading_rad), math.sin(robot.pose.heading_rad)
    event = street.people.are(*DIRECTED)
    offset = (street.people.xy[event] - robot.pose.xy) @ np.array([[cos, -sin], [sin, cos]])
    near = offset[np.hypot(*offset.T) < _NEAR_M]
    if not len(near):
        return np.array(ABOVE_REST)
    every = np.vstack([near, (0.0, 0.0)])
    middle = 0.5 * (every.min(axis=0) + every.max(axis=0))
    reach_m = float(np.hypot(*(every - middle).T).max())
    return np.append(middle, np.clip(2.0 * reach_m + 3.0, *ABOVE_HIGH_M))
