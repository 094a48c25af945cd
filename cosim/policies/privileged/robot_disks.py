"""Robot body as disks that cover it, rounded up to whole centimetres."""

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
        quarter_m, half_m = robot.length_m / 4, robot.width_m / 2
        return cls(
            _up(quarter_m),
            _up(math.hypot(quarter_m, half_m)),
            _up(math.hypot(2.0 * quarter_m, half_m)),
        )


def _up(length_m: float) -> float:
    return math.ceil(100.0 * length_m) / 100.0
