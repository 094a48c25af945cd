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
from cosim.spec.goal import Goal, decoded_goal
from cosim.spec.odometry import Odometry
from cosim.spec.robot import Robot, robot_called

GOAL: Final = "goal."
"""Beginning of the names of a goal's arrays. Names of the arrays of further cameras are
"camera/array"."""


def told_goal(goal: Goal | None) -> tuple[dict[str, Any] | None, dict[str, np.ndarray[Any, Any]]]:
    """Return the plain fields of a goal as it is sent, and its arrays by the names by which they
    are sent."""
    if goal is None:
        return None, {}
    fields = goal.encoded()
    arrays = {
        name: fields.pop(name) for name, one in list(fields.items()) if isinstance(one, np.ndarray)
    }
    return fields, {f"{GOAL}{name}": array for name, array in arrays.items()}


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
        goal=_goal(told.goal, arrays),
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


def _goal(told: Mapping[str, Any] | None, arrays: Mapping[str, Any]) -> Goal | None:
    if told is None:
        return None
    own = {
        name.removeprefix(GOAL): array for name, array in arrays.items() if name.startswith(GOAL)
    }
    return decoded_goal({**told, **own})


def _told_camera(camera: Calibration) -> tuple[list[list[float]], list[float], list[list[float]]]:
    return camera.matrix.tolist(), camera.distortion.tolist(), camera.on_robot.tolist()


_OF_A_ROBOT: Final = tuple(
    name for name in Robot.__dataclass_fields__ if name not in ("urdf", "drive", "mounts")
)
