"""Odometry: exact to the bit, wheels and fixes as wrong as they are declared."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from cosim.core.geometry import Pose
from cosim.episode.observer import DeadReckoning, Gps, Odometer, odometer_for
from cosim.spec.odometry import LEG_NOISE, DriftNoise, GpsNoise, Odometry
from cosim.spec.robot import DOG

START = Pose(10.0, 20.0, 0.5 * math.pi)
"""The start pose, facing north."""


def driven(odometer: Odometer, poses: list[Pose]) -> Odometry | None:
    for before, after in itertools.pairwise(poses):
        odometer.moved(before, after)
    return odometer.read(poses[-1], 0.05 * (len(poses) - 1))


def straight(far_m: float, steps: int = 100) -> list[Pose]:
    return [
        Pose(10.0, 20.0 + d, 0.5 * math.pi) for d in np.linspace(0.0, far_m, steps + 1).tolist()
    ]


def test_exact_odometry_is_the_pose_relative_to_the_start() -> None:
    """3 m north and 2 m west of a start facing north is 3 m ahead and 2 m left, carried or driven."""
    reading = odometer_for("exact", START, np.random.default_rng(0)).read(
        Pose(8.0, 23.0, math.pi), 1.0
    )
    assert reading is not None and reading.heading_rad == pytest.approx(0.5 * math.pi)
    assert (reading.x_m, reading.y_m) == pytest.approx((3.0, 2.0))
    assert odometer_for("none", START, np.random.default_rng(0)).read(START, 1.0) is None


def test_wheels_without_errors_count_driving_and_not_resets() -> None:
    """A quarter circle of 5 m to the left and 2 m after a reset are counted, the reset is not."""
    counted = DeadReckoning(np.random.default_rng(0), DriftNoise(0.0, 0.0, 0.0, 0.0, 0.0))
    angles = np.linspace(0.0, 0.5 * math.pi, 200).tolist()
    reading = driven(counted, [Pose(5 * math.sin(a), 5 - 5 * math.cos(a), a) for a in angles])
    assert reading is not None and reading.heading_rad == pytest.approx(0.5 * math.pi)
    assert (reading.x_m, reading.y_m) == pytest.approx((5.0, 5.0), abs=1e-3)
    reading = driven(counted, straight(2.0))
    assert reading is not None and (reading.x_m, reading.y_m) == pytest.approx((5.0, 7.0), abs=1e-3)


def test_legs_count_steps_aside_and_drift_more_than_wheels() -> None:
    """1 m aside is counted within a few per cent, and over 30 m the heading drifts by 15 degrees."""
    aside = [
        driven(
            odometer_for("wheel", START, np.random.default_rng(seed), DOG),
            [START, Pose(9.0, 20.0, 0.5 * math.pi)],
        )
        for seed in range(200)
    ]
    counted = np.array([one.y_m for one in aside if one is not None])
    assert counted.mean() == pytest.approx(1.0, abs=0.02)
    assert counted.std() == pytest.approx(LEG_NOISE.scale, rel=0.2)
    ends = [
        driven(odometer_for("wheel", START, np.random.default_rng(seed), DOG), straight(30.0))
        for seed in range(200)
    ]
    headings = np.array([one.heading_rad for one in ends if one is not None], dtype=float)
    expected = math.hypot(LEG_NOISE.drift_radpm * 30.0, LEG_NOISE.heading_rad * math.sqrt(30.0))
    assert headings.std() == pytest.approx(expected, rel=0.15)


def test_wheel_errors_are_as_declared() -> None:
    """In 400 episodes of 100 m the errors of length and heading are those declared; a robot at rest
    has none."""
    noise = DriftNoise()
    far_m = 100.0
    ends = [
        driven(DeadReckoning(np.random.default_rng(seed)), straight(far_m)) for seed in range(400)
    ]
    headings = np.array([one.heading_rad for one in ends if one is not None], dtype=float)
    expected = math.hypot(noise.drift_radpm * far_m, noise.heading_rad * math.sqrt(far_m))
    assert (
        headings.std() == pytest.approx(expected, rel=0.1) and abs(headings.mean()) < 0.2 * expected
    )
    short = [
        driven(DeadReckoning(np.random.default_rng(seed)), straight(1.0)) for seed in range(400)
    ]
    lengths = np.array([math.hypot(one.x_m, one.y_m) for one in short if one is not None])
    assert lengths.std() == pytest.approx(math.hypot(noise.scale, noise.along_m), rel=0.1)
    assert driven(DeadReckoning(np.random.default_rng(1)), [START] * 100) == Odometry(0.0, 0.0, 0.0)


def test_position_fix_errors_are_as_declared() -> None:
    """In 400 episodes fixes have the declared noise and a bias that drifts over minutes, and no
    heading."""
    noise = GpsNoise()
    errors = []
    for seed in range(400):
        gps = Gps(START, np.random.default_rng(seed))
        fixes = [gps.read(Pose(10.0, 23.0, 0.0), time_s) for time_s in (0.0, 1.0, 61.0)]
        assert {one.heading_rad for one in fixes} == {None}
        errors.append([(one.x_m - 3.0, one.y_m) for one in fixes])
    off = np.array(errors)
    assert off.std(axis=0) == pytest.approx(
        np.full((3, 2), math.hypot(noise.noise_m, noise.bias_m)), rel=0.12
    )
    short, long = (off[:, 1] - off[:, 0]).std(), (off[:, 2] - off[:, 1]).std()
    correlation = math.exp(-1.0 / 60.0)
    assert short == pytest.approx(
        math.hypot(math.sqrt(2) * noise.noise_m, noise.bias_m * math.sqrt(2 - 2 * correlation)),
        rel=0.1,
    )
    assert long > 2.0 * short


@pytest.mark.parametrize("kind", ["exact", "wheel", "gps"])
def test_odometry_is_the_same_for_the_same_seed(kind: str) -> None:
    """Another seed gives another odometry, unless it has no error."""

    def reading(seed: int) -> Odometry | None:
        return driven(odometer_for(kind, START, np.random.default_rng(seed)), straight(30.0))  # type: ignore[arg-type]

    assert reading(3) == reading(3) and (reading(3) == reading(4)) == (kind == "exact")
