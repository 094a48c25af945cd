"""Table of robots; everything that depends on the robot is derived from it.

A new robot is a row of `ROBOTS` and a URDF; `physics.robots.check` checks both. The base frame is
on the ground in the middle of the robot, x ahead, y left, z up. Mounts and boxes are given in it.
The frame of the URDF's base link depends on the drive:

- Wheels: it is the base frame. The link's centre of mass is `com_height_m` above it. Wheels turn
  forward for positive joint speeds.
- Legs: it is in the middle of the trunk, `Legs.stand_m` above the base frame at rest. Its axes are
  the principal axes of the link's inertia. Joint angles are those of `Legs.rest_rad` when the robot
  is put on the ground.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from cosim.core.errors import unknown


@dataclass(frozen=True, slots=True)
class Skid:
    """Skid-steering drive: fixed wheels that turn the robot by their speeds.

    span_m: length and width of the rectangle of the wheels' contacts.
    torque_nm: limit of one wheel's motor.
    left, right: names of the wheels' joints, front first.
    """

    wheel_radius_m: float
    span_m: tuple[float, float]
    torque_nm: float
    left: tuple[str, ...] = ("wheel_front_left", "wheel_rear_left")
    right: tuple[str, ...] = ("wheel_front_right", "wheel_rear_right")

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of all motor joints, in the order of `physics.dynamics.drive`."""
        return self.left + self.right

    @property
    def pivot_m(self) -> float:
        """Height in metres of the point about which the robot leans: the ground."""
        return 0.0

    @property
    def cycle_s(self) -> float:
        """Duration of a gait cycle: 0, without a gait."""
        return 0.0

    @property
    def stride_m(self) -> tuple[float, float]:
        """Length and width of the rectangle of the contacts in motion: that at rest."""
        return self.span_m


@dataclass(frozen=True, slots=True)
class Legs:
    """Legs: joints that follow the angles of a gait by torques.

    The torque of a joint is kp * (target - angle) - kd * speed, within its limit.

    joints: names of the joints, in the order of all values per joint.
    rest_rad: angles at rest, with the feet on the ground.
    kp, kd: gains per joint, Nm/rad and Nm s/rad.
    torque_nm: limit per joint.
    feet: links on which the robot walks.
    trunk: links that touch the ground only in a fall; "base" is the base link.
    stand_m: height of the base link's frame above the ground at rest.
    span_m: length and width of the rectangle of the feet at rest.
    stride_m: length and width of the rectangle that the legs fill in walking and turning, measured,
        for planning. It is centred on the base frame.
    cycle_s: duration of a cycle of its own gait, over which speeds and positions are averaged.
    gait: row of `physics.dynamics.legs.GAITS`.
    """

    joints: tuple[str, ...]
    rest_rad: tuple[float, ...]
    kp: tuple[float, ...]
    kd: tuple[float, ...]
    torque_nm: tuple[float, ...]
    feet: tuple[str, ...]
    trunk: tuple[str, ...]
    stand_m: float
    span_m: tuple[float, float]
    stride_m: tuple[float, float]
    cycle_s: float
    gait: Literal["trot", "network"]

    @property
    def pivot_m(self) -> float:
        """Height in metres of the point about which the robot leans: the middle of the trunk."""
        return self.stand_m


@dataclass(frozen=True, slots=True)
class Mount:
    """Place of a camera on a robot, with the limits of the camera.

    at_m: (x, y, z) in the base frame, metres.
    pitch_down_deg: downward tilt.
    yaw_left_deg: angle to the left of ahead.
    fov_deg: smallest and largest vertical field of view.
    most_px: largest (width, height) in pixels.
    most_hz: largest rate of pictures.

    >>> Mount((0.3, 0.0, 0.62), pitch_down_deg=10.0).at_m[2]
    0.62
    """

    at_m: tuple[float, float, float]
    pitch_down_deg: float = 0.0
    yaw_left_deg: float = 0.0
    fov_deg: tuple[float, float] = (20.0, 120.0)
    most_px: tuple[int, int] = (1280, 960)
    most_hz: float = 20.0

    @property
    def in_words(self) -> str:
        """Description of place and limits."""
        at = ", ".join(f"{m:g}" for m in self.at_m)
        side = (
            f", {abs(self.yaw_left_deg):g} deg to the "
            f"{'left' if self.yaw_left_deg > 0 else 'right'}"
        )
        return (
            f"at ({at}) m, {self.pitch_down_deg:g} deg down{side if self.yaw_left_deg else ''}; up "
            f"to {self.most_px[0]} x {self.most_px[1]} px, {self.fov_deg[0]:g} to "
            f"{self.fov_deg[1]:g} deg, {self.most_hz:g} Hz"
        )


@dataclass(frozen=True, slots=True)
class Robot:
    """Robot with its size, drive, camera mounts and limits.

    urdf: file in `physics/robots`, or an absolute path.
    length_m, width_m, height_m: box around the collision body, centred on the base frame.
    com_height_m: height of the base link's centre of mass at rest.
    drive: how it moves. Its counterpart in the engine is in `physics.dynamics.drive`.
    mounts: camera mounts by name. Every robot has "front", the default of policies.
    cruise_mps: travelling speed.
    v_max_mps, w_max_radps: largest commands, as magnitudes.
    acceleration_mps2, acceleration_radps2: ramps of the motors.

    >>> robot_called("scout").footprint_m
    (0.5, 0.4)
    """

    name: str
    urdf: str
    length_m: float
    width_m: float
    height_m: float
    com_height_m: float
    drive: Skid | Legs
    mounts: Mapping[str, Mount]
    cruise_mps: float
    v_max_mps: float
    w_max_radps: float
    acceleration_mps2: float
    acceleration_radps2: float

    @property
    def footprint_m(self) -> tuple[float, float]:
        """Length and width in metres."""
        return self.length_m, self.width_m

    def mount(self, name: str) -> Mount:
        """Return the mount with a name. Raises UsageError with the valid names."""
        if name not in self.mounts:
            raise unknown(f"camera mount of robot '{self.name}'", name, self.mounts)
        return self.mounts[name]


COURIER = Robot(
    name="courier",
    urdf="courier.urdf",
    length_m=0.70,
    width_m=0.55,
    height_m=0.50,
    com_height_m=0.20,
    drive=Skid(wheel_radius_m=0.12, span_m=(0.42, 0.46), torque_nm=7.0),
    mounts={
        "front": Mount((0.30, 0.0, 0.62), 10.0),
        "low": Mount((0.33, 0.0, 0.30), most_hz=10.0),
        "left": Mount((0.10, 0.25, 0.58), 10.0, 60.0, most_hz=10.0),
        "right": Mount((0.10, -0.25, 0.58), 10.0, -60.0, most_hz=10.0),
        "mast": Mount((-0.28, 0.0, 1.20), 15.0, fov_deg=(20.0, 90.0)),
    },
    cruise_mps=1.5,
    v_max_mps=2.5,
    w_max_radps=0.65,
    acceleration_mps2=2.5,
    acceleration_radps2=3.0,
)
"""Default robot: a four-wheeled delivery robot of 0.70 m x 0.55 m."""

SCOUT = Robot(
    name="scout",
    urdf="scout.urdf",
    length_m=0.50,
    width_m=0.40,
    height_m=0.36,
    com_height_m=0.14,
    drive=Skid(wheel_radius_m=0.10, span_m=(0.30, 0.34), torque_nm=4.0),
    mounts={
        "front": Mount((0.22, 0.0, 0.40), 6.0),
        "left": Mount((0.08, 0.18, 0.36), 6.0, 60.0, most_hz=10.0),
        "right": Mount((0.08, -0.18, 0.36), 6.0, -60.0, most_hz=10.0),
        "mast": Mount((-0.20, 0.0, 0.85), 12.0, fov_deg=(20.0, 90.0)),
    },
    cruise_mps=2.0,
    v_max_mps=2.0,
    w_max_radps=1.2,
    acceleration_mps2=3.0,
    acceleration_radps2=4.0,
)
"""Smaller and more agile robot of 0.50 m x 0.40 m."""

_DOG_LEGS = ("front_left", "front_right", "rear_left", "rear_right")

DOG = Robot(
    name="dog",
    urdf="dog.urdf",
    length_m=0.74,
    width_m=0.33,
    height_m=0.37,
    com_height_m=0.27,
    drive=Legs(
        joints=tuple(f"{leg}_{part}" for leg in _DOG_LEGS for part in ("hip", "thigh", "calf")),
        rest_rad=4 * (0.0, 0.9495, -1.899),
        kp=12 * (174.0,),
        kd=12 * (2.0,),
        torque_nm=4 * (23.7, 23.7, 35.55),
        feet=tuple(f"{leg}_foot" for leg in _DOG_LEGS),
        trunk=("base",),
        stand_m=0.27,
        span_m=(0.3868, 0.284),
        stride_m=(0.83, 0.39),
        cycle_s=0.21,
        gait="trot",
    ),
    mounts={
        "front": Mount((0.30, 0.0, 0.37)),
        "left": Mount((0.20, 0.10, 0.36), yaw_left_deg=60.0, most_hz=10.0),
        "right": Mount((0.20, -0.10, 0.36), yaw_left_deg=-60.0, most_hz=10.0),
    },
    cruise_mps=1.2,
    v_max_mps=1.5,
    w_max_radps=0.65,
    acceleration_mps2=2.0,
    acceleration_radps2=3.0,
)
"""Quadruped of 15 kg with the published masses and lengths of a Go2."""

WALKER = Robot(
    name="walker",
    urdf="walker.urdf",
    length_m=0.26,
    width_m=0.40,
    height_m=1.32,
    com_height_m=0.93,
    drive=Legs(
        joints=tuple(
            f"{side}_{part}"
            for side in ("left", "right")
            for part in ("hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll")
        ),
        rest_rad=2 * (-0.12, 0.0, 0.0, 0.30, -0.18, 0.0),
        kp=2 * (120.0, 120.0, 120.0, 180.0, 48.0, 48.0),
        kd=2 * (2.0, 2.0, 2.0, 4.0, 2.0, 2.0),
        torque_nm=2 * (88.0, 139.0, 88.0, 139.0, 50.0, 50.0),
        feet=("left_foot", "right_foot"),
        trunk=("base",),
        stand_m=0.7846,
        span_m=(0.17, 0.237),
        stride_m=(0.65, 0.36),
        cycle_s=0.8,
        gait="network",
    ),
    mounts={
        "front": Mount((0.09, 0.0, 1.20), 10.0),
        "left": Mount((0.02, 0.09, 1.19), 10.0, 60.0, most_hz=10.0),
        "right": Mount((0.02, -0.09, 1.19), 10.0, -60.0, most_hz=10.0),
    },
    cruise_mps=0.9,
    v_max_mps=1.2,
    w_max_radps=0.65,
    acceleration_mps2=1.5,
    acceleration_radps2=4.0,
)
"""Humanoid of 32 kg with the published masses and lengths of a G1."""

ROBOTS: Mapping[str, Robot] = {one.name: one for one in (COURIER, SCOUT, DOG, WALKER)}
"""Robots by name."""


def robot_called(name: str) -> Robot:
    """Return the robot with a name. Raises UsageError with the valid names."""
    if name not in ROBOTS:
        raise unknown("robot", name, ROBOTS)
    return ROBOTS[name]
