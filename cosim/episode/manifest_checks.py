"""Check a manifest's goals, odometry and cameras against a robot; build camera calibrations."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from cosim.core.errors import UsageError, unknown
from cosim.core.state import write_protect
from cosim.spec.camera import Calibration, CameraSpec
from cosim.spec.goal import GOALS, GoalProtocol, goal_called
from cosim.spec.manifest import Manifest
from cosim.spec.odometry import ODOMETRY
from cosim.spec.robot import Mount, Robot
from cosim.spec.sensors import ScanSpec, imu_called, people_called

MAX_CAMERA_PX = 4096
"""Largest side of a policy's camera, pixels."""


def check_unprivileged(name: str, manifest: Manifest, place: str, remedy: str = "") -> None:
    """Check that a policy needs no privileged state where it does not get any.

    place: "a remote one" or "an isolated one", in words
    remedy: command or option that helps
    Raises UsageError.
    """
    if manifest.privileged:
        raise UsageError(
            f"policy '{name}' needs privileged state, and {place} gets only observations"
            + (f": {remedy}" if remedy else "")
        )


def with_goal(manifest: Manifest, goal: GoalProtocol | None) -> Manifest:
    """Return a manifest with the goal protocol of the run, if there is one.

    Raises UsageError for an unknown goal protocol, odometry, inertial sensor or kind of tracked
    people, and for goals that the policy does not support. It also refuses picture goals and
    further cameras without a main camera.
    """
    settled = manifest if goal is None else replace(manifest, goal=goal)
    kind = GOALS[goal_called(settled.goal)]
    if settled.odometry not in ODOMETRY:
        raise unknown("odometry", settled.odometry, ODOMETRY)
    imu_called(settled.imu)
    people_called(settled.people)
    if not isinstance(settled.scan, ScanSpec | None):
        raise UsageError(
            f"policy '{manifest.name}': scan must be a cosim.ScanSpec or None, not {settled.scan!r}"
        )
    if settled.goals and settled.goal not in settled.goals:
        wanted = " or ".join(settled.goals)
        raise UsageError(
            f"policy '{manifest.name}' wants goals {wanted}, and gets '{settled.goal}': "
            f"choose --goal"
        )
    if settled.cameras and settled.camera is None:
        raise UsageError(
            f"policy '{manifest.name}' has further cameras, but no main camera: give its manifest "
            f"one of them as `camera`"
        )
    if kind.needs_camera and settled.camera is None:
        others = ", ".join(one.name for one in GOALS.values() if not one.needs_camera)
        raise UsageError(
            f"policy '{manifest.name}' has no camera, and goal protocol '{settled.goal}' gives "
            f"pictures of its camera: give its manifest a camera, or choose one of {others}"
        )
    return settled


def fault_of_values(manifest: Manifest) -> str:
    """Return the first fault in the values of a manifest's rate and cameras; "" if valid."""
    if not 0.0 < manifest.rate_hz < math.inf:
        return f"rate_hz must be a positive number, not {manifest.rate_hz}"
    cameras = [*([] if manifest.camera is None else [manifest.camera]), *manifest.cameras.values()]
    return next(filter(None, map(_camera_fault, cameras)), "")


def _camera_fault(camera: CameraSpec) -> str:
    """Return the first fault in a camera's values; "" if valid."""
    if not all(1 <= side <= MAX_CAMERA_PX for side in (camera.width, camera.height)):
        size = f"{camera.width} x {camera.height}"
        return f"camera must have sides of 1 to {MAX_CAMERA_PX} pixels, not {size}"
    if not 0.0 < camera.fov_deg < 180.0:
        return f"camera fov_deg must be between 0 and 180, not {camera.fov_deg}"
    mount = camera.mount
    if not isinstance(mount, str) and not all(
        map(math.isfinite, (*mount.at_m, mount.pitch_down_deg, mount.yaw_left_deg))
    ):
        angles = f"{mount.pitch_down_deg}, {mount.yaw_left_deg}"
        return (
            f"camera mount at_m, pitch_down_deg and yaw_left_deg must be finite, not "
            f"{mount.at_m}, {angles}"
        )
    return ""


def calibration_of(spec: CameraSpec, robot: Robot) -> Calibration:
    """Return the calibration of a camera on a robot, in OpenCV's convention.

    >>> from cosim.spec.robot import COURIER
    >>> spec = CameraSpec(width=96, height=96, fov_deg=90.0)
    >>> calibration_of(spec, COURIER).matrix[0].round(3).tolist()
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
        write_protect(matrix),
        write_protect(np.array([spec.lens.k1, spec.lens.k2, 0.0, 0.0, 0.0])),
        write_protect(on_robot),
    )


def nonstandard(manifest: Manifest, robot: Robot) -> str:
    """Return the cameras of a policy that exceed the robot's mounts, as text; "" if none do.

    Raises UsageError for an unknown mount.
    """
    cameras = [*([] if manifest.camera is None else [manifest.camera]), *manifest.cameras.values()]
    return " and ".join(
        filter(None, [_beyond(camera, manifest.rate_hz, robot) for camera in cameras])
    )


def check_camera(manifest: Manifest, robot: Robot, own_camera: bool) -> None:
    """Raise UsageError for a camera that the robot does not have, unless `own_camera` allows it.

    The message lists the robot's mounts and their limits.
    """
    odd = nonstandard(manifest, robot)
    if odd and not own_camera:
        mounts = "; ".join(f"'{name}' {mount.in_words}" for name, mount in robot.mounts.items())
        raise UsageError(
            f"policy '{manifest.name}' sees by {odd}, which robot '{robot.name}' does not have. It "
            f"has: {mounts}. Choose one of these, or give --own-camera "
            "(EpisodeOptions.own_camera), which marks every row as nonstandard"
        )


def _beyond(camera: CameraSpec, rate_hz: float, robot: Robot) -> str:
    """Return how one camera exceeds its mount, as text; "" if it does not."""
    mount = camera.on(robot)
    if isinstance(camera.mount, Mount):
        at = ", ".join(f"{m:g}" for m in mount.at_m)
        return (
            f"a camera of its own at ({at}) m, {mount.pitch_down_deg:g} deg down, "
            f"{mount.yaw_left_deg:g} to the left"
        )
    beyond = []
    if camera.width > mount.most_px[0] or camera.height > mount.most_px[1]:
        beyond.append(f"{camera.width} x {camera.height} px")
    if not mount.fov_deg[0] <= camera.fov_deg <= mount.fov_deg[1]:
        beyond.append(f"{camera.fov_deg:g} deg")
    if rate_hz > mount.most_hz:
        beyond.append(f"{rate_hz:g} Hz")
    return f"a camera of {', '.join(beyond)} at '{camera.mount}'" if beyond else ""
