"""Robots: one frozen value each, in one literal table. Whatever depends on which robot drives takes it from here.

A new robot is a row of `ROBOTS` and a URDF. Convention of the URDFs: the base frame lies on the ground in the middle of
the robot, x ahead, y left, z up; the base link's centre of mass is `com_height_m` above it; wheels turn forward for
positive joint speeds.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from cosim.core.errors import unknown


@dataclass(frozen=True, slots=True)
class Skid:
    """Wheels that do not steer: it turns by their speeds. left, right: names of their joints, fore before aft.

    torque_nm: limit of one wheel's motor. span_m: (length, width) of the rectangle of the wheels' contacts.
    """

    wheel_radius_m: float
    span_m: tuple[float, float]
    torque_nm: float
    left: tuple[str, ...] = ("wheel_front_left", "wheel_rear_left")
    right: tuple[str, ...] = ("wheel_front_right", "wheel_rear_right")

    @property
    def joints(self) -> tuple[str, ...]:
        """All that its motors turn, in the order of `physics.world.drive`."""
        return self.left + self.right


@dataclass(frozen=True, slots=True)
class Mount:
    """Where a camera sits: (x, y, z) in the base frame, metres, and how far it looks down.

    >>> Mount((0.3, 0.0, 0.62), pitch_down_deg=10.0).at_m[2]
    0.62
    """

    at_m: tuple[float, float, float]
    pitch_down_deg: float = 0.0


@dataclass(frozen=True, slots=True)
class Robot:
    """A robot. length_m, width_m, height_m: of the box around its collision body, in whose middle the base frame lies.

    urdf: a file in `physics/robots`, or an absolute path. mounts: its cameras' places by name; a policy's camera sits
    at "front" unless it says otherwise. cruise_mps: the pace at which it travels; v_max_mps, w_max_radps: the most that
    a command can ask of it, as magnitudes; acceleration_mps2, acceleration_radps2: of its motors' ramps. drive: how it
    moves; one that does not skid needs a class beside `Skid`, and one beside `physics.world.drive.SkidDrive`.

    >>> robot_called("scout").footprint_m
    (0.5, 0.4)
    """

    name: str
    urdf: str
    length_m: float
    width_m: float
    height_m: float
    com_height_m: float
    drive: Skid
    mounts: Mapping[str, Mount]
    cruise_mps: float
    v_max_mps: float
    w_max_radps: float
    acceleration_mps2: float
    acceleration_radps2: float

    @property
    def footprint_m(self) -> tuple[float, float]:
        """Length and width."""
        return self.length_m, self.width_m

    def mount(self, name: str) -> Mount:
        """The mount called `name`. Raises UsageError listing the names."""
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
    mounts={"front": Mount((0.30, 0.0, 0.62), 10.0)},
    cruise_mps=1.5,
    v_max_mps=2.5,
    w_max_radps=0.65,
    acceleration_mps2=2.5,
    acceleration_radps2=3.0,
)

SCOUT = Robot(
    name="scout",
    urdf="scout.urdf",
    length_m=0.50,
    width_m=0.40,
    height_m=0.36,
    com_height_m=0.14,
    drive=Skid(wheel_radius_m=0.10, span_m=(0.30, 0.34), torque_nm=4.0),
    mounts={"front": Mount((0.22, 0.0, 0.40), 6.0)},
    cruise_mps=2.0,
    v_max_mps=2.0,
    w_max_radps=1.2,
    acceleration_mps2=3.0,
    acceleration_radps2=4.0,
)

ROBOTS: Mapping[str, Robot] = {one.name: one for one in (COURIER, SCOUT)}


def robot_called(name: str) -> Robot:
    """The robot called `name`. Raises UsageError listing the names."""
    if name not in ROBOTS:
        raise unknown("robot", name, ROBOTS)
    return ROBOTS[name]
