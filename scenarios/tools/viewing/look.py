"""Draw one picture of a scenario at a moment of an episode: from the robot, behind or above."""

from __future__ import annotations

import math
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike

from cosim.core.clock import Clock
from cosim.core.geometry import Floats
from cosim.core.progress import Progress, ignore
from cosim.core.state import RobotState
from cosim.policies.load import load_policy
from cosim.report.legend import Image
from cosim.spec.camera import CameraSpec
from cosim.spec.options import EpisodeOptions
from cosim.spec.run_config import Appearance, CameraChoice
from cosim.spec.scenario import Scenario
from scenarios.episodes.episode import Episode
from scenarios.places.nets import place

Viewpoint = Literal["robot", "follow", "above"]
VIEWS: Final[tuple[Viewpoint, ...]] = ("robot", "follow", "above")
BEHIND_M: Final = 4.6
ABOVE_M: Final = 2.5
_AHEAD_M: Final = 3.0
HIGH_M: Final = 24.0
OVER_SLANT: Final = 0.22
"""Distance of the eye behind its target, as a share of its height. It is small, because a house may
block the view.
"""


def look_at(
    scenario: Scenario,
    policy: str,
    at_s: float,
    view: Viewpoint,
    size: tuple[int, int],
    camera_name: CameraChoice = "auto",
    progress: Progress = ignore,
    appearance: Appearance = "splats",
) -> tuple[Image, float]:
    """Return the picture `at_s` seconds into an episode, or at its end if that comes first.

    policy: name of the policy that drives until then.
    size: width and height in pixels.
    progress: receives the running step.
    appearance: of scanned places.

    Returns ((H, W, 3) uint8 RGB, seconds).
    """
    caller = load_policy(policy)
    last = Clock().ticks(at_s)
    spec = (
        CameraSpec(*size)
        if caller.manifest.camera is None
        else CameraSpec(*size, caller.manifest.camera.fov_deg)
    )
    progress(f"reading the street map of {scenario.place.name}")
    place(scenario.place)
    progress("starting SUMO, PyBullet and the camera")
    options = EpisodeOptions(camera=camera_name, appearance=appearance)
    with (
        Episode(scenario, caller.manifest, options) as episode,
        episode.eyes(spec) as camera,
    ):
        caller.reset(episode.id, episode.seed)
        observation = episode.reset()
        while not episode.over and episode.moment.tick < last:
            progress(f"simulating to {at_s:g} s", episode.moment.tick / last)
            observation = episode.advance(caller.act(observation), until_tick=last)
        robot, street = episode.moment.robot, episode.moment.street
        progress("drawing")
        if view == "robot":
            return camera.render(robot, street).rgb, episode.time_s
        eye, target = eye_behind(robot) if view == "follow" else over(robot)
        return camera.picture(eye, target, street, robot, size).rgb, episode.time_s


def eye_behind(robot: RobotState, ahead: Floats | None = None) -> tuple[Floats, Floats]:
    """Return eye and target, (3,) metres, of a view from behind and above the robot, looking ahead.

    ahead: (2,), by default its heading.
    """
    way = _way(robot, ahead)
    foot = robot.pose.xy
    return np.append(foot - BEHIND_M * way, robot.z_m + ABOVE_M), np.append(
        foot + _AHEAD_M * way, robot.z_m + 0.5
    )


def over(
    robot: RobotState,
    ahead: Floats | None = None,
    at_m: ArrayLike = (0.0, 0.0, HIGH_M),
) -> tuple[Floats, Floats]:
    """Return eye and target, (3,) metres, of a view from high above and a little behind the robot.

    at_m: (3,) metres ahead and to the left of the robot at the target, and height of the eye.
    """
    way = _way(robot, ahead)
    forward_m, left_m, high_m = np.asarray(at_m, dtype=float).tolist()
    foot = robot.pose.xy + forward_m * way + left_m * np.array([-way[1], way[0]])
    return np.append(foot - OVER_SLANT * high_m * way, robot.z_m + high_m), np.append(
        foot, robot.z_m
    )


def _way(robot: RobotState, ahead: Floats | None) -> Floats:
    heading = robot.pose.heading_rad
    return (
        np.array([math.cos(heading), math.sin(heading)])
        if ahead is None
        else ahead / np.hypot(*ahead)
    )
