"""Odometry: what a robot's sensors say of where it has gone, and how wrong they are."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final, Literal, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

OdometryKind = Literal["none", "exact", "wheel", "gps"]

ODOMETRY: Final[Mapping[str, str]] = MappingProxyType(
    {
        "none": "nothing",
        "exact": "where the robot is, without an error",
        "wheel": "what its wheels count, which does not notice that it was put elsewhere",
        "gps": "a position with noise and a slow bias, without a heading",
    }
)
"""What a policy gets by each kind, all in the frame of the start of the episode."""


class Odometry(msgspec.Struct, frozen=True):
    """Where the robot takes itself to be: metres ahead and to the left of its start, heading
    counter-clockwise from the
    start's, None for gps. Nothing in it tells where on the map that is.

    >>> pose = Odometry(12.0, 0.5, heading_rad=0.1)
    >>> pose.x_m, np.asarray(pose)
    (12.0, array([12. ,  0.5,  0.1]))
    """

    x_m: float
    y_m: float
    heading_rad: float | None

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """(3,) float64: x, y in metres, heading in radians; (2,) without a heading."""
        known = (self.x_m, self.y_m, self.heading_rad)[: 2 if self.heading_rad is None else 3]
        return np.array(known, dtype)


class WheelNoise(NamedTuple):
    """Standard deviations. For a whole episode: scale, of the distance; turn_scale, of turns;
    drift_radpm, of a turn with every metre. For each metre, growing with its square root: along_m,
    heading_rad."""

    scale: float = 0.02
    turn_scale: float = 0.03
    drift_radpm: float = 0.003
    along_m: float = 0.02
    heading_rad: float = 0.01


class GpsNoise(NamedTuple):
    """Standard deviations in metres, of x and of y: noise_m of each fix; bias_m of what lasts for
    about bias_s seconds (a Gauss-Markov process)."""

    noise_m: float = 0.5
    bias_m: float = 1.5
    bias_s: float = 60.0
