"""Lidar, inertial sensor and tracked people: what a manifest requests and an observation holds."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from functools import cached_property
from types import MappingProxyType
from typing import Annotated, Any, Final, Literal, NamedTuple, cast

import msgspec
import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import unknown
from cosim.core.geometry import Floats
from cosim.core.state import write_protect
from cosim.spec.validation import Ranged, Within

ImuKind = Literal["none", "exact", "noisy"]
"""Names of the rows of `IMU`."""

PeopleKind = Literal["none", "seen"]
"""Names of the rows of `PEOPLE`."""

SensorTrack = Literal["privileged", "people", "lidar", "picture", "blind"]
"""Sensor tracks, the strongest first. A policy is in the track of its strongest source of knowledge
of the street. `compare` gives a verdict within a track, and on a blind and an unprivileged policy.
"""

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


MAX_RETURNS: Final = 2**17
"""Largest number of distances in a scan."""


def imu_called(name: str) -> ImuKind:
    """Return a name as a row of `IMU`. Raises UsageError with the valid names."""
    if name not in IMU:
        raise unknown("inertial sensor (imu)", name, IMU)
    return cast(ImuKind, name)


def people_called(name: str) -> PeopleKind:
    """Return a name as a row of `PEOPLE`. Raises UsageError with the valid names."""
    if name not in PEOPLE:
        raise unknown("kind of tracked people", name, PEOPLE)
    return cast(PeopleKind, name)


class ScanSpec(Ranged, frozen=True, dict=True):
    """A lidar.

    rays: rays of a ring, at equal angles over the whole turn.
    range_m: largest distance; a ray without a return is `inf`.
    height_m: height of the sensor above the ground under a level robot.
    rings: number of rings; one is a 2-D lidar.
    elevation_deg: elevation of the lowest and the highest ring.
    noise_m: standard deviation of a distance.

    Raises SpecError for a value out of its range.

    >>> ScanSpec(rays=180, range_m=10.0).angles_rad.shape
    (180,)
    """

    rays: Annotated[int, Within(8, 4096)] = 360
    range_m: Annotated[float, Within(0.5, 100)] = 20.0
    height_m: Annotated[float, Within(0.05, 3)] = 0.3
    rings: Annotated[int, Within(1, 64)] = 1
    elevation_deg: tuple[float, float] = (0.0, 0.0)
    noise_m: Annotated[float, Within(0, 1)] = 0.02

    @property
    def prefix(self) -> str:
        return "scan "

    def contradictions(self) -> Iterator[str]:
        for field in ("rays", "rings"):
            if not isinstance(value := getattr(self, field), int):
                yield f"scan {field} must be a whole number, not {value}"
        low, high = self.elevation_deg
        if not -80.0 <= low <= high <= 80.0:
            yield (
                f"scan elevation_deg must rise from the lowest to the highest ring within "
                f"[-80, 80], not {low:g} to {high:g}"
            )
        elif self.rings == 1 and low != high:
            yield (
                f"scan elevation_deg is {low:g} to {high:g}, and one ring has one elevation: give "
                "rings, or the same value twice"
            )
        if self.rings * self.rays > MAX_RETURNS:
            yield (
                f"scan rings x rays is {self.rings * self.rays}, and a scan has at most "
                f"{MAX_RETURNS} distances"
            )

    @property
    def angles_rad(self) -> NDArray[np.float64]:
        """(rays,) bearings from -pi, counter-clockwise; 0 is straight ahead."""
        return -math.pi + 2.0 * math.pi * np.arange(self.rays) / self.rays

    @property
    def elevations_rad(self) -> NDArray[np.float64]:
        """(rings,) elevations, lowest first."""
        return np.radians(np.linspace(*self.elevation_deg, self.rings))

    @cached_property
    def directions(self) -> Floats:
        """(3, rings * rays) unit vectors in the frame of the robot's trunk, ring by ring."""
        up, turn = np.meshgrid(self.elevations_rad, self.angles_rad, indexing="ij")
        level = np.cos(up)
        vectors = np.stack([level * np.cos(turn), level * np.sin(turn), np.sin(up)])
        return write_protect(vectors.reshape(3, -1))

    @property
    def in_words(self) -> str:
        """Description for tables."""
        rings = f" x {self.rings} rings" if self.rings > 1 else ""
        return (
            f"{self.rays} rays{rings}, {self.range_m:g} m, at {self.height_m:g} m, noise "
            f"{self.noise_m:g} m"
        )


class Scan(msgspec.Struct, frozen=True, eq=False):
    """One revolution of a lidar.

    ranges_m: (rings, rays) float32 distances; `inf` without a return.
    spec: the lidar; `spec.angles_rad` has the bearings.

    >>> scan = Scan(np.full((1, 8), 2.5, np.float32), ScanSpec(rays=8))
    >>> float(np.asarray(scan).min()), scan.spec.angles_rad[4]
    (2.5, np.float64(0.0))
    """

    ranges_m: NDArray[np.float32]
    spec: ScanSpec

    def copied(self) -> Scan:
        """Return the same scan with an array of its own."""
        return Scan(self.ranges_m.copy(), self.spec)

    def mirrored(self) -> Scan:
        """Return the scan with left and right exchanged."""
        return Scan(self.ranges_m[:, -np.arange(self.spec.rays)], self.spec)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """Return `ranges_m`."""
        return np.array(self.ranges_m, dtype)


class Imu(msgspec.Struct, frozen=True):
    """Reading of the inertial sensor in the robot's frame: x forward, y left, z up.

    gyro_radps: angular speeds about x, y and z.
    accel_mps2: specific force; (0, 0, 9.81) for a robot at rest on level ground.

    >>> np.asarray(Imu((0.0, 0.0, 0.5), (0.2, 0.0, 9.81))).tolist()
    [0.0, 0.0, 0.5, 0.2, 0.0, 9.81]
    """

    gyro_radps: tuple[float, float, float]
    accel_mps2: tuple[float, float, float]

    def mirrored(self) -> Imu:
        """Return the reading with left and right exchanged."""
        (roll, pitch, yaw), (x, y, z) = self.gyro_radps, self.accel_mps2
        return Imu((-roll, pitch, -yaw), (x, -y, z))

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """Return (6,) float64: angular speeds, then specific force."""
        return np.array((*self.gyro_radps, *self.accel_mps2), dtype)


class Tracks(msgspec.Struct, frozen=True, eq=False):
    """People that a tracker on the robot reports, nearest first.

    ids: (N,) int32 ids of tracks; a person may get another one.
    positions_m: (N, 2) float32 in the robot's frame: x forward, y left.
    velocities_mps: (N, 2) float32 velocities over the ground, in the axes of the robot's frame.

    >>> one = np.array([[3.0, 1.0]], np.float32)
    >>> np.asarray(Tracks(np.array([7], np.int32), one, -one)).tolist()
    [[3.0, 1.0, -3.0, -1.0]]
    """

    ids: NDArray[np.int32]
    positions_m: NDArray[np.float32]
    velocities_mps: NDArray[np.float32]

    def copied(self) -> Tracks:
        """Return the same tracks with arrays of their own."""
        return Tracks(self.ids.copy(), self.positions_m.copy(), self.velocities_mps.copy())

    def mirrored(self) -> Tracks:
        """Return the tracks with left and right exchanged."""
        swap = np.array([1.0, -1.0], dtype=np.float32)
        return Tracks(self.ids, self.positions_m * swap, self.velocities_mps * swap)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """Return (N, 4): positions and velocities."""
        return np.array(np.hstack([self.positions_m, self.velocities_mps]), dtype)


TRACKING_RANGE_M: Final = 15.0
"""Horizontal range in metres within which people are tracked, in all directions."""

MAX_TRACKS: Final = 256
"""Largest number of tracks in an observation; the farthest people are left out."""


class TrackNoise(NamedTuple):
    """Errors of tracked people.

    position_m, velocity_mps: standard deviations in x and in y, independent at each observation.
    miss: probability that a visible person is missing from an observation.
    switch_hz: mean rate at which a track changes its id, with that of a neighbour within
        `swap_m` or for a new one.
    forget_s: time out of sight after which a person gets a new id.
    """

    position_m: float = 0.1
    velocity_mps: float = 0.15
    miss: float = 0.05
    switch_hz: float = 0.02
    swap_m: float = 1.0
    forget_s: float = 1.0


class ImuNoise(NamedTuple):
    """Standard deviations of an inertial sensor on each axis.

    gyro_radps, accel_mps2: independent errors of each reading.
    gyro_bias_radps, accel_bias_mps2: slow errors, Gauss-Markov processes.
    bias_s: their time constant in seconds.
    """

    gyro_radps: float = 0.005
    accel_mps2: float = 0.05
    gyro_bias_radps: float = 0.003
    accel_bias_mps2: float = 0.05
    bias_s: float = 100.0


AT_REST: Final = Imu((0.0, 0.0, 0.0), (0.0, 0.0, 9.81))
"""Reading of a robot at rest on level ground."""

NO_TRACKS: Final = Tracks(
    np.zeros(0, np.int32), np.zeros((0, 2), np.float32), np.zeros((0, 2), np.float32)
)
"""Tracks without a person."""


def clear_scan(spec: ScanSpec) -> Scan:
    """Return a scan without a return."""
    return Scan(np.full((spec.rings, spec.rays), np.inf, np.float32), spec)


PEOPLE_ROWS: Final = 32
"""Number of tracked people in arrays of fixed size, the nearest ones."""


def scan_row(scan: Scan) -> NDArray[np.float32]:
    """Return the distances of a scan, (rings, rays); without a return the range."""
    return np.minimum(scan.ranges_m, np.float32(scan.spec.range_m))


def people_rows(tracks: Tracks) -> NDArray[np.float32]:
    """Return the nearest people as (PEOPLE_ROWS, 5): 1, positions and velocities; else 0."""
    rows = np.zeros((PEOPLE_ROWS, 5), np.float32)
    numbers = np.asarray(tracks)[:PEOPLE_ROWS]
    rows[: len(numbers), 0] = 1.0
    rows[: len(numbers), 1:] = numbers
    return rows
