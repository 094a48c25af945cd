"""What every camera shares: where a picture is taken from, what can be in it, and how large it may
be."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cosim.core.errors import UsageError
from cosim.core.geometry import Floats
from cosim.core.state import RobotState
from cosim.spec.camera import CameraSpec
from cosim.spec.robot import Robot
from physics.street.surface import Surface

VISIBLE_M: Final = 50.0
"""How far around the eye the ground is drawn, and what stands on it."""
FORGET_M: Final = 70.0
NEAR_PLANE_M: Final = 0.05
FAR_PLANE_M: Final = 160.0
PERSON_MARGIN_M: Final = 1.0
VEHICLE_MARGIN_M: Final = 6.0
PROP_MARGIN_M: Final = 2.5
SIDE_MAX: Final = 4096
_FOV_DEG: Final = (5.0, 150.0)
_MOUNT_M: Final = 3.0
"""No robot carries its camera higher above the ground."""


@dataclass(frozen=True, slots=True)
class View:
    """The wedge of ground that a picture shows. eye_m: (3,); heading_rad; half_angle_rad: half its
    width; behind_m: how far behind the eye a picture from above reaches."""

    eye_m: Floats
    heading_rad: float
    half_angle_rad: float
    behind_m: float = 0.0

    def rows(self, xy: Floats, margin_m: float) -> NDArray[np.intp]:
        """Which of (N, 2) points can be in the picture, things of radius `margin_m` standing on
        them."""
        return self.sees(xy, margin_m).nonzero()[0]

    def sees(self, xy: Floats, margin_m: float, reach_m: float = VISIBLE_M) -> NDArray[np.bool_]:
        """Whether each of (N, 2) points can be in a picture that reaches so far."""
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
    """A picture to be taken: (3,) eye_m and target_m; width and height in pixels; vertical field of
    view."""

    eye_m: Floats
    target_m: Floats
    size: tuple[int, int]
    fov_deg: float

    def __post_init__(self) -> None:
        check_size(*self.size, self.fov_deg)

    @property
    def steep_rad(self) -> float:
        """How far the view points below the horizon."""
        ahead = self.target_m - self.eye_m
        return math.atan2(-ahead[2], math.hypot(ahead[0], ahead[1]))

    @property
    def half_picture(self) -> tuple[float, float]:
        """Tangents of the angles from the middle to the right and to the upper edge."""
        tall = math.tan(math.radians(0.5 * self.fov_deg))
        return tall * self.size[0] / self.size[1], tall

    @cached_property
    def view(self) -> View:
        ahead = self.target_m - self.eye_m
        half_up = math.radians(0.5 * self.fov_deg)
        lowest = max(math.cos(abs(self.steep_rad) + half_up), 0.05)
        half_wide = math.atan(math.tan(half_up) * self.size[0] / self.size[1] / lowest)
        heading_rad = (
            math.atan2(ahead[1], ahead[0])
            if math.hypot(ahead[0], ahead[1]) > 0.0
            else 0.5 * math.pi
        )
        past_rad = self.steep_rad + half_up - 0.5 * math.pi
        if past_rad <= 0.0:
            return View(self.eye_m, heading_rad, half_wide)
        return View(
            self.eye_m, heading_rad, 0.5 * math.pi, max(-ahead[2], _MOUNT_M) * math.tan(past_rad)
        )

    @cached_property
    def axes(self) -> Floats:
        """(3, 3) unit vectors right, up in the picture, ahead. A view straight down has north
        above."""
        x, y, z = (self.target_m - self.eye_m).tolist()
        flat = math.hypot(x, y)
        long = math.hypot(x, y, z)
        x, y, z = x / long, y / long, z / long
        rx, ry = (y * long / flat, -x * long / flat) if flat > 1e-6 * long else (1.0, 0.0)
        return np.array([[rx, ry, 0.0], [ry * z, -rx * z, rx * y - ry * x], [x, y, z]])


def check_size(width: int, height: int, fov_deg: float) -> None:
    """Raises UsageError for a picture that nobody can mean."""
    if not (1 <= width <= SIDE_MAX and 1 <= height <= SIDE_MAX):
        raise UsageError(
            f"a picture of {width} x {height} pixels: each side must be 1 to {SIDE_MAX}"
        )
    if not _FOV_DEG[0] <= fov_deg <= _FOV_DEG[1]:
        raise UsageError(
            f"a field of view of {fov_deg:g} degrees: it must be {_FOV_DEG[0]:g} to {_FOV_DEG[1]:g}"
        )


def robot_shot(surface: Surface, model: Robot, spec: CameraSpec, robot: RobotState) -> Shot:
    """What a robot's camera looks at from its mount; it leans with the ground."""
    turn = _attitude(surface, model, robot)
    mount = spec.on(model)
    x, y, z = mount.at_m
    down, left = math.radians(mount.pitch_down_deg), math.radians(mount.yaw_left_deg)
    ahead = math.cos(down) * math.cos(left)
    aside = math.cos(down) * math.sin(left)
    below = math.sin(down)
    foot = robot.pose.x_m, robot.pose.y_m, robot.z_m
    eye = np.array([at + a * x + b * y + c * z for at, (a, b, c) in zip(foot, turn, strict=True)])
    way = np.array([a * ahead + b * aside - c * below for a, b, c in turn])
    return Shot(eye, eye + way, (spec.width, spec.height), spec.fov_deg)


def shot(eye_m: ArrayLike, target_m: ArrayLike, size: tuple[int, int], fov_deg: float) -> Shot:
    """A view from (3,) `eye_m` towards (3,) `target_m`."""
    return Shot(np.asarray(eye_m, dtype=float), np.asarray(target_m, dtype=float), size, fov_deg)


def _attitude(
    surface: Surface, model: Robot, robot: RobotState
) -> tuple[tuple[float, float, float], ...]:
    """Rows of the rotation from the base frame to the world: heading, and the slope of the
    surface."""
    _, roll, pitch = surface.lean(robot.pose, model.drive.span_m)
    cz, sz = math.cos(robot.pose.heading_rad), math.sin(robot.pose.heading_rad)
    cy = math.cos(pitch)
    sy = math.sin(pitch)
    cx = math.cos(roll)
    sx = math.sin(roll)
    return (
        (cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx),
        (sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx),
        (-sy, cy * sx, cy * cx),
    )
