"""Odometers: from where the robot truly is to what its sensors say."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from cosim.core.geometry import Pose, wrap_angle
from cosim.spec.goal import seen_from
from cosim.spec.odometry import GpsNoise, Odometry, OdometryKind, WheelNoise


class Odometer(Protocol):
    """One kind of odometry through an episode."""

    def moved(self, before: Pose, after: Pose) -> None:
        """The robot has driven from one pose to another, in one tick."""

    def read(self, pose: Pose, time_s: float) -> Odometry | None:
        """What it says of a robot that is truly at a pose."""


def odometer_for(kind: OdometryKind, start: Pose, draws: np.random.Generator) -> Odometer:
    """The odometer of an episode that begins at a pose. draws: where its errors come from."""
    if kind == "wheel":
        return WheelOdometer(draws)
    return Gps(start, draws) if kind == "gps" else _Errorless(start, told=kind == "exact")


class _Errorless:
    def __init__(self, start: Pose, told: bool) -> None:
        self._start = start
        self._told = told

    def moved(self, before: Pose, after: Pose) -> None:
        """Nothing is counted."""

    def read(self, pose: Pose, time_s: float) -> Odometry | None:
        place = seen_from(self._start, pose)
        turned = wrap_angle(pose.heading_rad - self._start.heading_rad)
        return Odometry(place.x_m, place.y_m, turned) if self._told else None


class WheelOdometer:
    """Counts what the wheels have turned: being carried is not counted."""

    def __init__(self, draws: np.random.Generator, noise: WheelNoise = WheelNoise()) -> None:  # noqa: B008
        self._draws = draws
        self._noise = noise
        errors = draws.standard_normal(3).tolist()
        self._scale = 1.0 + noise.scale * errors[0]
        self._turn_scale = 1.0 + noise.turn_scale * errors[1]
        self._drift_radpm = noise.drift_radpm * errors[2]
        self._x_m = self._y_m = self._heading_rad = 0.0

    def moved(self, before: Pose, after: Pose) -> None:
        along_m = seen_from(before, after).x_m
        turned = wrap_angle(after.heading_rad - before.heading_rad)
        far_m = abs(along_m)
        (one, two) = self._draws.standard_normal(2).tolist()
        counted_m = self._scale * along_m + self._noise.along_m * math.sqrt(far_m) * one
        turn = (
            self._turn_scale * turned
            + self._drift_radpm * far_m
            + self._noise.heading_rad * math.sqrt(far_m) * two
        )
        middle = self._heading_rad + 0.5 * turn
        self._x_m += counted_m * math.cos(middle)
        self._y_m += counted_m * math.sin(middle)
        self._heading_rad = wrap_angle(self._heading_rad + turn)

    def read(self, pose: Pose, time_s: float) -> Odometry:
        return Odometry(self._x_m, self._y_m, self._heading_rad)


class Gps:
    """Fixes of where the robot is; being carried is seen."""

    def __init__(
        self, start: Pose, draws: np.random.Generator, noise: GpsNoise = GpsNoise()
    ) -> None:
        self._start = start
        self._draws = draws
        self._noise = noise
        self._bias_m = noise.bias_m * draws.standard_normal(2)
        self._time_s = 0.0

    def moved(self, before: Pose, after: Pose) -> None:
        """Nothing is counted."""

    def read(self, pose: Pose, time_s: float) -> Odometry:
        kept = math.exp(-(time_s - self._time_s) / self._noise.bias_s)
        fresh = math.sqrt(1.0 - kept * kept) * self._noise.bias_m
        self._bias_m = kept * self._bias_m + fresh * self._draws.standard_normal(2)
        self._time_s = time_s
        place = seen_from(self._start, pose)
        x_m, y_m = (self._bias_m + self._noise.noise_m * self._draws.standard_normal(2)).tolist()
        return Odometry(place.x_m + x_m, place.y_m + y_m, None)
