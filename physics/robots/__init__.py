"""Robots by name: a literal table. Each has a URDF beside this file, written for this project.

Convention of the URDFs: the base frame lies on the ground between the wheels, x ahead, y left, z up; the base
link's centre of mass is `com_height_m` above it; wheels turn forward for positive joint speeds.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from cosim.core.errors import unknown


@dataclass(frozen=True, slots=True)
class RobotModel:
    """A wheeled robot with skid steering. left, right: names of the wheel joints. torque_nm: limit of one wheel."""

    name: str
    urdf: Path
    length_m: float
    width_m: float
    wheel_radius_m: float
    track_m: float
    wheelbase_m: float
    com_height_m: float
    left: tuple[str, ...]
    right: tuple[str, ...]
    torque_nm: float
    v_max_mps: float = 2.5
    w_max_radps: float = 0.65
    acceleration_mps2: float = 2.5
    acceleration_radps2: float = 3.0


ROBOTS: Mapping[str, RobotModel] = MappingProxyType(
    {
        "courier": RobotModel(
            name="courier",
            urdf=Path(__file__).parent / "courier.urdf",
            length_m=0.70,
            width_m=0.55,
            wheel_radius_m=0.12,
            track_m=0.46,
            wheelbase_m=0.42,
            com_height_m=0.20,
            left=("wheel_front_left", "wheel_rear_left"),
            right=("wheel_front_right", "wheel_rear_right"),
            torque_nm=7.0,
        )
    }
)


def robot(name: str) -> RobotModel:
    """The robot called `name`. Raises UsageError listing the names."""
    if name not in ROBOTS:
        raise unknown("robot", name, ROBOTS)
    return ROBOTS[name]
