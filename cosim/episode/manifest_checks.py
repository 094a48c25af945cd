"""What a manifest asks for beside a picture: whether it can be had, and how a camera is told."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from cosim.core.errors import UsageError, unknown
from cosim.core.state import frozen
from cosim.spec.camera import Calibration, CameraSpec
from cosim.spec.goal import GOALS, GoalProtocol, goal_called
from cosim.spec.manifest import Manifest
from cosim.spec.odometry import ODOMETRY
from cosim.spec.robot import Robot


def with_goal(manifest: Manifest, goal: GoalProtocol | None) -> Manifest:
    """A policy's manifest, with the goals of the run if that names some. Raises UsageError, with
    the valid names, for goals or odometry that there are none of; for goals that the policy cannot
    do with; for pictures as goals, and further cameras, of a policy without a camera.
    """
    settled = manifest if goal is None else replace(manifest, goal=goal)
    kind = GOALS[goal_called(settled.goal)]
    if settled.odometry not in ODOMETRY:
        raise unknown("odometry", settled.odometry, ODOMETRY)
    if settled.goals and settled.goal not in settled.goals:
        wanted = " or ".join(settled.goals)
        raise UsageError(
            f"policy '{manifest.name}' wants goals {wanted}, and gets '{settled.goal}': "
            f"choose --goal"
        )
    if settled.cameras and settled.camera is None:
        raise UsageError(
            f"policy '{manifest.name}' has cameras, but no camera: give its manifest one of "
            f"them as that"
        )
    if kind.of_camera and settled.camera is None:
        others = ", ".join(one.name for one in GOALS.values() if not one.of_camera)
        raise UsageError(
            f"policy '{manifest.name}' has no camera, and goal protocol '{settled.goal}' gives "
            f"what its camera would show: give its manifest a camera, or choose one of {others}"
        )
    return settled


def calibration_of(spec: CameraSpec, robot: Robot) -> Calibration:
    """A camera on a robot as computer vision has it.

    >>> from cosim.spec.robot import COURIER
    >>> calibration_of(CameraSpec(width=96, height=96, fov_deg=90.0), COURIER).matrix[0].tolist()
    [48.0, 0.0, 47.5]
    """
    mount = spec.on(robot)
    focal_px = 0.5 * spec.height / math.tan(math.radians(0.5 * spec.fov_deg))
    matrix = np.array(
        [
            [focal_px, 0.0, 0.5 * spec.width - 0.5],
            [0.0, focal_px, 0.5 * spec.height - 0.5],
            [0.0, 0.0, 1.0],
        ]
    )
    matrix[:2, 2] -= (spec.crop or (0, 0))[:2]
    down, left = math.radians(mount.pitch_down_deg), math.radians(mount.yaw_left_deg)
    on_robot = np.eye(4)
    on_robot[:3, 0] = math.sin(left), -math.cos(left), 0.0
    on_robot[:3, 2] = (
        math.cos(down) * math.cos(left),
        math.cos(down) * math.sin(left),
        -math.sin(down),
    )
    on_robot[:3, 1] = np.cross(on_robot[:3, 2], on_robot[:3, 0])
    on_robot[:3, 3] = mount.at_m
    return Calibration(
        frozen(matrix),
        frozen(np.array([spec.lens.k1, spec.lens.k2, 0.0, 0.0, 0.0])),
        frozen(on_robot),
    )
