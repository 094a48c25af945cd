"""An observation as it arrives at a policy that is asked from another process, made what `act` is
given in one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from bridge.policy_server import AboutEpisode, AskAct
from cosim.core.state import frozen
from cosim.episode.interfaces import Observation
from cosim.spec.camera import Calibration, CameraPicture
from cosim.spec.goal import Goal, ImageGoal, Instruction, PointGoal, RoutePatch
from cosim.spec.odometry import Odometry
from cosim.spec.robot import Robot, robot_called

GOAL: Final = "goal"
"""What the array of a goal is called; those of further cameras begin with the camera's name and a
slash."""


def told_goal(goal: Goal | None) -> tuple[dict[str, Any] | None, np.ndarray[Any, Any] | None]:
    """A goal as it travels, and its array."""
    match goal:
        case PointGoal(x_m, y_m):
            return {"type": "point", "x_m": x_m, "y_m": y_m}, None
        case Instruction(text):
            return {"type": "instruction", "text": text}, None
        case ImageGoal(rgb):
            return {"type": "image"}, rgb
        case RoutePatch(pixels):
            return {"type": "route_patch"}, pixels
    return None, None


def told_about(seen: Observation) -> AboutEpisode:
    """What stays as it is while an episode lasts."""
    robot = {name: getattr(seen.robot, name) for name in _OF_A_ROBOT}
    cameras = {name: _told_camera(one.camera) for name, one in seen.pictures.items()}
    if seen.camera is not None:
        cameras[""] = _told_camera(seen.camera)
    return AboutEpisode(robot, cameras)


def seen_from_afar(
    episode: str, about: AboutEpisode, told: AskAct, arrays: Mapping[str, Any]
) -> Observation:
    """What the policy is given. Raises ValueError, KeyError and TypeError for what is no
    observation."""
    cameras = {
        name: Calibration(*map(frozen, map(np.array, one))) for name, one in about.cameras.items()
    }
    robot = robot_called(str(about.robot["name"]))
    pictures = {
        name: CameraPicture(
            arrays[f"{name}/rgb"], arrays.get(f"{name}/labels"), arrays.get(f"{name}/depth"), camera
        )
        for name, camera in cameras.items()
        if name
    }
    return Observation(
        tick=told.tick,
        time_s=told.time_s,
        rgb=arrays.get("rgb"),
        v_mps=told.v_mps,
        w_radps=told.w_radps,
        robot=robot,
        episode=episode,
        reset=told.reset,
        goal=_goal(told.goal, arrays.get(GOAL)),
        odometry=None if told.odometry is None else Odometry(*told.odometry),
        camera=cameras.get(""),
        depth=arrays.get("depth"),
        labels=arrays.get("labels"),
        pictures=pictures,
    )


def arrays_of(seen: Observation) -> dict[str, np.ndarray[Any, Any]]:
    """All arrays of an observation but its goal's, by the names by which they travel."""
    found = {"rgb": seen.rgb, "depth": seen.depth, "labels": seen.labels}
    for name, one in seen.pictures.items():
        found |= {f"{name}/rgb": one.rgb, f"{name}/depth": one.depth, f"{name}/labels": one.labels}
    return {name: array for name, array in found.items() if array is not None}


def _goal(told: Mapping[str, Any] | None, array: Any) -> Goal | None:
    match told:
        case None:
            return None
        case {"type": "point", "x_m": x_m, "y_m": y_m}:
            return PointGoal(x_m, y_m)
        case {"type": "instruction", "text": text}:
            return Instruction(text)
        case {"type": "image"}:
            return ImageGoal(array)
        case {"type": "route_patch"}:
            return RoutePatch(array)
    raise ValueError("a goal of no known kind")


def _told_camera(camera: Calibration) -> tuple[list[list[float]], list[float], list[list[float]]]:
    return camera.matrix.tolist(), camera.distortion.tolist(), camera.on_robot.tolist()


_OF_A_ROBOT: Final = tuple(
    name for name in Robot.__dataclass_fields__ if name not in ("urdf", "drive", "mounts")
)
