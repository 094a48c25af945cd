"""Views shared by all cameras: camera pose, visible area and limits of the picture size."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cosim.core.errors import UsageError
from cosim.core.geometry import Floats
from cosim.core.state import RobotState
from cosim.spec.camera import CameraSpec
from cosim.spec.robot import Robot
from physics.cameras.posture import posture_of
from physics.robots.kinematics import attitude
from physics.street.surface import Surface

VISIBLE_M: Final = 50.0
"""Radius around the eye in which the ground and objects on it are drawn, metres."""
FORGET_M: Final = 70.0
NEAR_PLANE_M: Final = 0.05
FAR_PLANE_M: Final = 160.0
PERSON_MARGIN_M: Final = 1.0
VEHICLE_MARGIN_M: Final = 6.0
PROP_MARGIN_M: Final = 2.5
SIDE_MAX: Final = 4096
_FOV_DEG: Final = (5.0, 150.0)
_MOUNT_M: Final = 3.0
"""Maximum height of a robot's camera above the ground, metres."""


@dataclass(frozen=True, slots=True)
class View:
    """Wedge of ground that a picture shows.

    eye_m: (3,)
    half_angle_rad: half its horizontal width
    behind_m: reach of a picture from above behind the eye, metres
    """

    eye_m: Floats
    heading_rad: float
    half_angle_rad: float
    behind_m: float = 0.0

    def rows(self, xy: Floats, margin_m: float) -> NDArray[np.intp]:
        """Return the rows of (N, 2) points that can be visible.

        margin_m: radius of the objects at the points
        """
        return self.sees(xy, margin_m).nonzero()[0]

    def sees(self, xy: Floats, margin_m: float, reach_m: float = VISIBLE_M) -> NDArray[np.bool_]:
        """Return a mask of (N, 2) points that can be in a picture of range `reach_m`."""
        offset = xy - self.eye_m[:2]
        cos, sin = math.cos(self.heading_rad), math.sin(self.heading_rad)
        ahead = offset @ np.array([cos, sin])
        aside = np.abs(offset @ np.array([-sin, cos]))
        inner = ahead + self.behind_m if self.behind_m else ahead
        wide = aside * math.cos(self.half_angle_rad) - inner * math.sin(self.half_angle_rad)
        seen = (wide < margin_m) & (inner > -margin_m)
        return np.asarray(
            seen if math.isinf(reach_m) else seen & (np.hypot(ahead, aside) < reach_m)
        )


@dataclass(frozen=True)
class Shot:
    """Picture to be taken.

    eye_m, target_m: (3,)
    size: width and height in pixels
    fov_deg: vertical field of view
    """

    eye_m: Floats
    target_m: Floats
    size: tuple[int, int]
    fov_deg: float

    def __post_init__(self) -> None:
        check_size(*self.size, self.fov_deg)

    @property
    def steep_rad(self) -> float:
        """Angle of the view below the horizon."""
        x, y, z = self._way
        return math.atan2(-z, math.hypot(x, y))

    @property
    def half_picture(self) -> tuple[float, float]:
        """Tangents of the angles from the middle to the right and to the upper edge."""
        tall = math.tan(math.radians(0.5 * self.fov_deg))
        return tall * self.size[0] / self.size[1], tall

    @cached_property
    def _way(self) -> tuple[float, float, float]:
        x, y, z = (self.target_m - self.eye_m).tolist()
        return x, y, z

    @cached_property
    def view(self) -> View:
        x, y, z = self._way
        half_up = math.radians(0.5 * self.fov_deg)
        steep_rad = self.steep_rad
        lowest = max(math.cos(abs(steep_rad) + half_up), 0.05)
        half_wide = math.atan(math.tan(half_up) * self.size[0] / self.size[1] / lowest)
        heading_rad = math.atan2(y, x) if math.hypot(x, y) > 0.0 else 0.5 * math.pi
        past_rad = steep_rad + half_up - 0.5 * math.pi
        if past_rad <= 0.0:
            return View(self.eye_m, heading_rad, half_wide)
        return View(self.eye_m, heading_rad, 0.5 * math.pi, max(-z, _MOUNT_M) * math.tan(past_rad))

    @cached_property
    def axes(self) -> Floats:
        """Unit vectors (3, 3): right, up in the picture, ahead.

        A view straight down has north at the top.
        """
        x, y, z = self._way
        flat = math.hypot(x, y)
        long = math.hypot(x, y, z)
        x, y, z = x / long, y / long, z / long
        rx, ry = (y * long / flat, -x * long / flat) if flat > 1e-6 * long else (1.0, 0.0)
        return np.array([[rx, ry, 0.0], [ry * z, -rx * z, rx * y - ry * x], [x, y, z]])


def check_size(width: int, height: int, fov_deg: float) -> None:
    """Raise UsageError for an invalid picture size or field of view."""
    if not (1 <= width <= SIDE_MAX and 1 <= height <= SIDE_MAX):
        raise UsageError(
            f"a picture of {width} x {height} pixels: each side must be 1 to {SIDE_MAX}"
        )
    if not _FOV_DEG[0] <= fov_deg <= _FOV_DEG[1]:
        raise UsageError(
            f"a field of view of {fov_deg:g} degrees: it must be {_FOV_DEG[0]:g} to {_FOV_DEG[1]:g}"
        )


def robot_shot(surface: Surface, model: Robot, spec: CameraSpec, robot: RobotState) -> Shot:
    """Return the view of a robot's camera from its mount.

    It tilts with the ground, or with the trunk of a robot with legs.
    """
    return mounted_shot(surface, model, Mounting.of(spec, model), robot)


class Mounting(NamedTuple):
    """Place of a camera on a robot, and its picture.

    at_m: from the robot's frame
    way: unit vector of the view: ahead, to the left, down
    """

    at_m: tuple[float, float, float]
    way: tuple[float, float, float]
    size: tuple[int, int]
    fov_deg: float

    @classmethod
    def of(cls, spec: CameraSpec, model: Robot) -> Mounting:
        """Return the place of a camera on a robot."""
        mount = spec.on(model)
        x, y, z = mount.at_m
        down, left = math.radians(mount.pitch_down_deg), math.radians(mount.yaw_left_deg)
        way = math.cos(down) * math.cos(left), math.cos(down) * math.sin(left), math.sin(down)
        at_m = x, y, z - model.drive.pivot_m
        return cls(at_m, way, (spec.width, spec.height), spec.fov_deg)


def mounted_shot(surface: Surface, model: Robot, mounting: Mounting, robot: RobotState) -> Shot:
    """Return the view of `robot_shot` of a camera whose place on the robot is known."""
    posture = posture_of(surface, model, robot)
    turn = attitude(posture.roll_rad, posture.pitch_rad, posture.heading_rad)
    (x, y, z), (ahead, aside, below), size, fov_deg = mounting
    eye = np.array(
        [at + a * x + b * y + c * z for at, (a, b, c) in zip(posture.at_m, turn, strict=True)]
    )
    way = np.array([a * ahead + b * aside - c * below for a, b, c in turn])
    return Shot(eye, eye + way, size, fov_deg)


def shot(eye_m: ArrayLike, target_m: ArrayLike, size: tuple[int, int], fov_deg: float) -> Shot:
    """Return a view from (3,) `eye_m` towards (3,) `target_m`."""
    return Shot(np.asarray(eye_m, dtype=float), np.asarray(target_m, dtype=float), size, fov_deg)
