"""Odometry: the robot's own estimate of its pose, and its errors."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final, Literal, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

OdometryKind = Literal["none", "exact", "wheel", "gps"]
"""Names of the rows of `ODOMETRY`."""

ODOMETRY: Final[Mapping[str, str]] = MappingProxyType(
    {
        "none": "nothing",
        "exact": "where the robot is, without an error",
        "wheel": "what its wheels or legs count, which does not notice that it was put elsewhere",
        "gps": "a position with noise and a slow bias, without a heading",
    }
)
"""Kinds of odometry and their descriptions. All estimates are in the frame of the episode's start.
"""


class Odometry(msgspec.Struct, frozen=True):
    """Estimated pose relative to the start: metres ahead and to the left, heading
    counter-clockwise.

    heading_rad: None for gps.

    It does not reveal the position on the map.

    >>> pose = Odometry(12.0, 0.5, heading_rad=0.1)
    >>> pose.x_m, np.asarray(pose)
    (12.0, array([12. ,  0.5,  0.1]))
    """

    x_m: float
    y_m: float
    heading_rad: float | None

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """Return (3,) float64: x, y in metres, heading in radians; (2,) without a heading."""
        known = (self.x_m, self.y_m, self.heading_rad)[: 2 if self.heading_rad is None else 3]
        return np.array(known, dtype)


class DriftNoise(NamedTuple):
    """Standard deviations of odometry by wheels or legs.

    scale: relative error of the distance, constant in an episode.
    turn_scale: relative error of turns, constant in an episode.
    drift_radpm: turn per metre, constant in an episode.
    along_m: error of the distance after one metre, growing with the square root.
    heading_rad: error of the heading after one metre, growing with the square root.
    sideways: whether motion sideways is counted, as legs do.
    """

    scale: float = 0.02
    turn_scale: float = 0.03
    drift_radpm: float = 0.003
    along_m: float = 0.02
    heading_rad: float = 0.01
    sideways: bool = False


LEG_NOISE: Final = DriftNoise(
    scale=0.03,
    turn_scale=0.03,
    drift_radpm=math.radians(0.5),
    along_m=0.03,
    heading_rad=0.01,
    sideways=True,
)
"""Errors of odometry by legs: 3 % of the way and 0.5 degrees per metre, as feet slip."""


class GpsNoise(NamedTuple):
    """Standard deviations of GPS positions in x and in y.

    noise_m: independent error of each fix.
    bias_m: slow error, a Gauss-Markov process.
    bias_s: its time constant in seconds.
    """

    noise_m: float = 0.5
    bias_m: float = 1.5
    bias_s: float = 60.0
