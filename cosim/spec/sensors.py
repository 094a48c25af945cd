"""Lidar, inertial sensor and tracked people: what a manifest requests and an observation holds."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

ImuKind = Literal["none", "exact", "noisy"]
"""Names of the rows of `IMU`."""

PeopleKind = Literal["none", "seen"]
"""Names of the rows of `PEOPLE`."""

IMU: Final[Mapping[str, str]] = MappingProxyType(
    {
        "none": "nothing",
        "exact": "angular speed and specific force, without an error",
        "noisy": "angular speed and specific force, with noise and a slow bias",
    }
)
"""Kinds of inertial sensor and their descriptions."""

PEOPLE: Final[Mapping[str, str]] = MappingProxyType(
    {
        "none": "nothing",
        "seen": "tracks of unoccluded people in range, with noise, misses and id switches",
    }
)
"""Kinds of tracked people and their descriptions."""


class ScanSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A lidar.

    rays: rays of a ring, at equal angles over the whole turn.
    range_m: largest distance; a ray without a return is `inf`.
    height_m: height of the sensor above the ground under a level robot.
    rings: number of rings; one is a 2-D lidar.
    elevation_deg: elevation of the lowest and the highest ring.
    noise_m: standard deviation of a distance.

    >>> ScanSpec(rays=180, range_m=10.0).angles_rad.shape
    (180,)
    """

    rays: int = 360
    range_m: float = 20.0
    height_m: float = 0.3
    rings: int = 1
    elevation_deg: tuple[float, float] = (0.0, 0.0)
    noise_m: float = 0.02

    @property
    def angles_rad(self) -> NDArray[np.float64]:
        """(rays,) bearings from -pi, counter-clockwise; 0 is straight ahead."""
        return -math.pi + 2.0 * math.pi * np.arange(self.rays) / self.rays


class Scan(msgspec.Struct, frozen=True, eq=False):
    """One revolution of a lidar.

    ranges_m: (rings, rays) float32 distances; `inf` without a return.
    spec: the lidar; `spec.angles_rad` has the bearings.
    """

    ranges_m: NDArray[np.float32]
    spec: ScanSpec

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """Return `ranges_m`."""
        return np.array(self.ranges_m, dtype)


class Imu(msgspec.Struct, frozen=True):
    """Reading of the inertial sensor in the robot's frame: x forward, y left, z up.

    gyro_radps: angular speeds about x, y and z.
    accel_mps2: specific force; (0, 0, 9.81) for a robot at rest on level ground.
    """

    gyro_radps: tuple[float, float, float]
    accel_mps2: tuple[float, float, float]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """Return (6,) float64: angular speeds, then specific force."""
        return np.array((*self.gyro_radps, *self.accel_mps2), dtype)


class Tracks(msgspec.Struct, frozen=True, eq=False):
    """People that a tracker on the robot reports, nearest first.

    ids: (N,) int32 ids of tracks; a person may get another one.
    positions_m: (N, 2) float32 in the robot's frame: x forward, y left.
    velocities_mps: (N, 2) float32 velocities over the ground, in the axes of the robot's frame.
    """

    ids: NDArray[np.int32]
    positions_m: NDArray[np.float32]
    velocities_mps: NDArray[np.float32]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """Return (N, 4): positions and velocities."""
        return np.array(np.hstack([self.positions_m, self.velocities_mps]), dtype)
