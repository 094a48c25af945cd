"""Sensors of an episode with their errors: lidar, inertial sensor and tracked people."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence, Set
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.core.clock import Clock
from cosim.core.geometry import Floats
from cosim.core.state import People, RobotState, Street, Trunk
from cosim.episode.interfaces import RangeSensor
from cosim.spec.manifest import Manifest
from cosim.spec.robot import Robot
from cosim.spec.sensors import (
    MAX_TRACKS,
    TRACKING_RANGE_M,
    Imu,
    ImuKind,
    ImuNoise,
    Scan,
    ScanSpec,
    TrackNoise,
    Tracks,
)

_GRAVITY_MPS2: Final = 9.81
_TICK_S: Final = Clock().tick_ms / 1000
_VELOCITY_TICKS: Final = 8
"""Ticks over which a tracked person's velocity is the mean displacement."""


def sensing_range_m(manifest: Manifest) -> float:
    """Return the largest range of a policy's lidar and tracked people; 0 without either."""
    lidar_m = 0.0 if manifest.scan is None else manifest.scan.range_m
    return max(lidar_m, TRACKING_RANGE_M if manifest.people != "none" else 0.0)


class Lidar:
    """Lidar of an episode.

    draws: generator of its errors.
    """

    def __init__(self, spec: ScanSpec, rays: RangeSensor, draws: np.random.Generator) -> None:
        self._spec = spec
        self._rays = rays
        self._draws = draws

    def read(self, robot: RobotState, street: Street) -> Scan:
        """Return the scan at a moment; all rays are of this moment."""
        spec = self._spec
        distances = self._rays.distances(
            robot, street, spec.height_m, spec.directions, spec.range_m
        )
        noise = spec.noise_m * self._draws.standard_normal(len(distances))
        ranges = np.maximum(distances + noise, 0.0).astype(np.float32)
        ranges[ranges > np.float32(spec.range_m)] = np.inf
        return Scan(ranges.reshape(spec.rings, spec.rays), spec)


class Tracker:
    """Tracker of the people around a robot.

    It sees from the height of the robot's front camera, above the middle of the robot.
    draws: generator of its errors.
    """

    def __init__(
        self,
        robot: Robot,
        rays: RangeSensor,
        draws: np.random.Generator,
        noise: TrackNoise = TrackNoise(),  # noqa: B008
    ) -> None:
        self._eye_m = robot.mount("front").at_m[2]
        self._rays = rays
        self._draws = draws
        self._noise = noise
        self._tracks: dict[str, tuple[int, float]] = {}
        self._past: deque[People] = deque(maxlen=_VELOCITY_TICKS)
        self._time_s = 0.0
        self._next = 0

    def moved(self, before: Street) -> None:
        """Record the people before a tick, for velocities."""
        self._past.append(before.people)

    def on_reset(self) -> None:
        """Forget all tracks: the robot was put elsewhere."""
        self._tracks.clear()

    def read(self, robot: RobotState, street: Street, time_s: float) -> Tracks:
        """Return the tracks of the people that are visible at a moment."""
        people, draws, noise = street.people, self._draws, self._noise
        rows = self._rays.seen_people(robot, street, self._eye_m, TRACKING_RANGE_M)
        seen = draws.random(len(rows)) >= noise.miss
        before_s, self._time_s = self._time_s, time_s
        switch = draws.random(len(rows)) < -math.expm1(
            -noise.switch_hz * max(time_s - before_s, 0.0)
        )
        errors = draws.standard_normal((4, len(rows)))
        cos, sin = math.cos(robot.pose.heading_rad), math.sin(robot.pose.heading_rad)
        x, y = people.xy[rows, 0] - robot.pose.x_m, people.xy[rows, 1] - robot.pose.y_m
        east, north = self._velocities(people, rows)
        positions = np.stack([cos * x + sin * y, cos * y - sin * x])
        positions += noise.position_m * errors[:2]
        velocities = np.stack([cos * east + sin * north, cos * north - sin * east])
        velocities += noise.velocity_mps * errors[2:]
        far = np.hypot(*positions)
        order = np.argsort(far, kind="stable")
        order = order[seen[order]][:MAX_TRACKS]
        self._keep({people.ids[i] for i in rows.tolist()}, time_s, before_s)
        names = [people.ids[i] for i in rows[order].tolist()]
        ids = self._ids(names, switch[order], positions.T[order], time_s)
        return Tracks(
            ids,
            positions.T[order].astype(np.float32),
            velocities.T[order].astype(np.float32),
        )

    def _velocities(self, people: People, rows: NDArray[np.intp]) -> Floats:
        """Return (2, N) mean velocities in map axes since the oldest recorded tick with them."""
        found = np.zeros((2, len(rows)))
        missing: Sequence[int] = range(len(rows))
        for ticks, past in zip(range(len(self._past), 0, -1), self._past, strict=True):
            if not missing:
                break
            row_of = {name: row for row, name in enumerate(past.ids)}
            left = []
            for i in missing:
                row = row_of.get(people.ids[rows[i]])
                if row is None:
                    left.append(i)
                else:
                    found[:, i] = (people.xy[rows[i]] - past.xy[row]) / (ticks * _TICK_S)
            missing = left
        return found

    def _keep(self, visible: Set[str], time_s: float, before_s: float) -> None:
        """Drop tracks of people that were out of sight for long; a missed person is in sight.

        before_s: time of the last observation: people in sight then and now have not been away.
        """
        since_s = min(time_s - self._noise.forget_s, before_s)
        self._tracks = {
            name: (own, time_s if name in visible else seen_s)
            for name, (own, seen_s) in self._tracks.items()
            if seen_s >= since_s
        }

    def _ids(
        self, names: list[str], switch: NDArray[np.bool_], positions: Floats, time_s: float
    ) -> NDArray[np.int32]:
        """Return the ids of people, nearest first, and record that they are tracked now."""
        ids = [self._tracks[name][0] if name in self._tracks else self._new_id() for name in names]
        for i in np.flatnonzero(switch).tolist():
            off = np.hypot(*(positions - positions[i]).T)
            off[i] = math.inf
            other = int(off.argmin())
            if off[other] <= self._noise.swap_m:
                ids[i], ids[other] = ids[other], ids[i]
            else:
                ids[i] = self._new_id()
        self._tracks |= {name: (own, time_s) for name, own in zip(names, ids, strict=True)}
        return np.array(ids, dtype=np.int32)

    def _new_id(self) -> int:
        self._next += 1
        return self._next - 1


class InertialSensor:
    """Inertial sensor in the middle of the robot's trunk.

    A reading is the mean over the last tick of the simulation.
    draws: generator of its errors.
    """

    def __init__(
        self,
        kind: ImuKind,
        draws: np.random.Generator,
        noise: ImuNoise = ImuNoise(),  # noqa: B008
    ) -> None:
        self._draws = draws
        self._noise = noise if kind == "noisy" else None
        self._time_s = 0.0
        self._motion: tuple[Trunk, Trunk] | None = None
        biases = np.repeat([noise.gyro_bias_radps, noise.accel_bias_mps2], 3)
        self._bias_scale = biases
        self._bias = biases * draws.standard_normal(6)

    def moved(self, before: RobotState, after: RobotState) -> None:
        """Record the motion of one tick."""
        one, two = before.trunk, after.trunk
        self._motion = None if one is None or two is None else (one, two)

    def on_reset(self) -> None:
        """Forget the motion: the robot was put elsewhere, at rest."""
        self._motion = None

    def read(self, robot: RobotState, time_s: float) -> Imu:
        """Return the reading of a robot; at rest before its first tick."""
        still = (0.0, 0.0, 0.0)
        rotation = _LEVEL if robot.trunk is None else robot.trunk.rotation
        before, after = self._motion or (Trunk(rotation, still, still),) * 2
        gyro = _turn(before.rotation, after.rotation, _TICK_S)
        pull = [
            (v - u) / _TICK_S for u, v in zip(before.velocity_mps, after.velocity_mps, strict=True)
        ]
        pull[2] += _GRAVITY_MPS2
        values = [*gyro, *_inverse_rotated(after.rotation, pull)]
        if self._noise is not None:
            values = self._disturbed(values, self._noise, time_s)
        return Imu((values[0], values[1], values[2]), (values[3], values[4], values[5]))

    def _disturbed(self, values: list[float], noise: ImuNoise, time_s: float) -> list[float]:
        """Return a reading with errors."""
        decay = math.exp(-(time_s - self._time_s) / noise.bias_s)
        self._time_s = time_s
        fresh = math.sqrt(1.0 - decay * decay) * self._bias_scale
        self._bias = decay * self._bias + fresh * self._draws.standard_normal(6)
        scale = np.repeat([noise.gyro_radps, noise.accel_mps2], 3)
        errors = self._bias + scale * self._draws.standard_normal(6)
        return [v + e for v, e in zip(values, errors.tolist(), strict=True)]


_Rotation = tuple[
    tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]
]
_LEVEL: Final[_Rotation] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def _inverse_rotated(turn: _Rotation, v: list[float]) -> list[float]:
    """Return a world vector in the frame whose axes are the columns of `turn`."""
    return [sum(turn[i][k] * v[i] for i in range(3)) for k in range(3)]


def _turn(before: _Rotation, after: _Rotation, duration_s: float) -> list[float]:
    """Return the mean angular velocity between two attitudes, in the frame of the body, rad/s."""
    change = [
        [sum(before[n][i] * after[n][k] for n in range(3)) for k in range(3)] for i in range(3)
    ]
    axis = [
        change[2][1] - change[1][2],
        change[0][2] - change[2][0],
        change[1][0] - change[0][1],
    ]
    sine = 0.5 * math.hypot(*axis)
    cosine = 0.5 * (change[0][0] + change[1][1] + change[2][2] - 1.0)
    scale = 0.5 * math.atan2(sine, cosine) / sine if sine > 1e-12 else 0.5
    return [scale * a / duration_s for a in axis]
