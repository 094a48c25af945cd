"""The body that the baselines plan with: a robot as disks, in whole centimetres, so that nothing of
it sticks out."""

from __future__ import annotations

import math
from typing import NamedTuple

from cosim.spec.robot import Robot


class BodyDisks(NamedTuple):
    """Two disks, `nose_m` before and behind the base centre, and one around it, `around_m`, that
    hold the robot."""

    nose_m: float
    radius_m: float
    around_m: float

    @classmethod
    def of(cls, robot: Robot) -> BodyDisks:
        quarter_m, half_m = robot.length_m / 4, robot.width_m / 2
        return cls(
            _up(quarter_m),
            _up(math.hypot(quarter_m, half_m)),
            _up(math.hypot(2.0 * quarter_m, half_m)),
        )


def _up(length_m: float) -> float:
    return math.ceil(100.0 * length_m) / 100.0
