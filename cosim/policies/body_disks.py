"""Disks that cover a robot, for distances to people and objects."""

from __future__ import annotations

import math
from typing import NamedTuple

from cosim.spec.robot import Robot


class BodyDisks(NamedTuple):
    """Disks that cover a robot.

    nose_m: Distance of two disks before and behind the base centre.
    radius_m: Radius of those disks.
    around_m: Radius of a single disk around the base centre.
    """

    nose_m: float
    radius_m: float
    around_m: float

    @classmethod
    def of(cls, robot: Robot) -> BodyDisks:
        nose_m, half_m = _up(robot.length_m / 4), robot.width_m / 2
        return cls(
            nose_m, _up(math.hypot(nose_m, half_m)), _up(math.hypot(robot.length_m / 2, half_m))
        )


def _up(length_m: float) -> float:
    return math.ceil(100.0 * length_m) / 100.0
