"""Lidar, inertial sensor and tracked people have exactly their declared errors."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from cosim.core.errors import SpecError
from cosim.core.geometry import Floats, Pose
from cosim.core.state import Command, People, PersonKind, RobotState, Street
from cosim.episode.sensing import InertialSensor, Lidar, Tracker
from cosim.spec.robot import COURIER
from cosim.spec.sensors import (
    AT_REST,
    Imu,
    ImuNoise,
    Scan,
    ScanSpec,
    TrackNoise,
    Tracks,
    clear_scan,
)
from physics.dynamics.world import BulletWorld
from physics.street.street_surface import StreetSurface
from tests.support.tiny_street import tiny_map

ROBOT = RobotState(Pose(3.0, 4.0, 0.5 * math.pi))


class OpenStreet:
    """An open street where every person is visible, walls are 5 m away, and nothing is ahead."""

    def distances(
        self,
        robot: RobotState,
        street: Street,
        height_m: float,
        directions: Floats,
        range_m: float,
    ) -> Floats:
        return np.where(directions[0] > 0.99, np.inf, 5.0)

    def seen_people(
        self, robot: RobotState, street: Street, height_m: float, range_m: float
    ) -> NDArray[np.intp]:
        return np.arange(len(street.people))


def walking(*kinds: PersonKind, far_m: float = 6.0, east_m: float = 0.0) -> Street:
    """Return people abreast, 4 m from each other, ahead of the robot, facing north.

    east_m: how far they have walked to the east.
    """
    count = len(kinds)
    xy = [(3.0 + east_m + 4.0 * k, 4.0 + far_m) for k in range(count)]
    people = People.of(
        tuple(f"{kind.name}{k}" for k, kind in enumerate(kinds)),
        xy,
        [0.5 * math.pi] * count,
        [0.7] * count,
        ("walk",) * count,
        kind=kinds,
    )
    return Street(0, people)


def test_a_scan_has_declared_noise_and_no_return_where_there_is_none() -> None:
    """Over 200 scans distances of 5 m have the mean and deviation of the spec, and the same seed
    repeats them."""
    spec = ScanSpec(rays=64, noise_m=0.05)
    lidar, again = (Lidar(spec, OpenStreet(), np.random.default_rng(7)) for _ in range(2))
    scans = np.stack([lidar.read(ROBOT, Street(0)).ranges_m[0] for _ in range(200)])
    assert scans.dtype == np.float32 and np.isinf(scans[:, 32]).all()
    hit = scans[np.isfinite(scans)]
    assert hit.mean() == pytest.approx(5.0, abs=2e-3)
    assert hit.std() == pytest.approx(0.05, rel=0.03)
    assert (again.read(ROBOT, Street(0)).ranges_m == scans[0]).all()


def test_tracks_have_declared_errors_misses_and_switches() -> None:
    """In 4,000 observations of two people errors, misses and switches are as declared; velocity
    follows motion, not facing."""
    tracker = Tracker(COURIER, OpenStreet(), np.random.default_rng(1))
    street = walking(PersonKind.CROWD, PersonKind.EVENT)
    for ticks in range(9, 0, -1):
        tracker.moved(walking(PersonKind.CROWD, PersonKind.EVENT, east_m=-0.075 * ticks))
    noise = TrackNoise()
    seen = [tracker.read(ROBOT, street, 0.1 * k) for k in range(4000)]
    near = np.array([one.positions_m[0] for one in seen if len(one.ids) == 2])
    speed = np.concatenate([one.velocities_mps for one in seen])
    assert near.mean(axis=0) == pytest.approx([6.0, 0.0], abs=0.02)
    assert near.std(axis=0) == pytest.approx([noise.position_m] * 2, rel=0.06)
    assert speed.mean(axis=0) == pytest.approx([0.0, -1.5], abs=0.02)
    assert speed.std(axis=0) == pytest.approx([noise.velocity_mps] * 2, rel=0.06)
    shown = sum(len(one.ids) for one in seen)
    assert 1.0 - shown / 8000 == pytest.approx(noise.miss, abs=0.01)
    ids = len({int(i) for one in seen for i in one.ids}) - 2
    assert ids == pytest.approx(noise.switch_hz * 0.95 * 800.0, rel=0.5)


def test_tracks_do_not_reveal_event_pedestrians() -> None:
    """The same people with other names, kinds and order in the table have the same ids by distance."""
    first, second = (
        Tracker(COURIER, OpenStreet(), np.random.default_rng(5)).read(ROBOT, street, 0.0)
        for street in (
            walking(PersonKind.CROWD, PersonKind.CROWD, PersonKind.CROWD),
            walking(PersonKind.EVENT, PersonKind.CROWD, PersonKind.INJECTED),
        )
    )
    assert first.ids.tolist() == second.ids.tolist() == sorted(first.ids.tolist())
    assert (np.asarray(first) == np.asarray(second)).all()
    assert (np.diff(np.hypot(*first.positions_m.T)) > 0.0).all()


def test_neighbours_swap_ids_and_lost_people_get_new_ones() -> None:
    """A switch exchanges the ids of two neighbours; 1 s out of sight gives a new id; rare
    observations lose no visible person."""
    street = walking(PersonKind.CROWD)
    both = Street(0, People.of(("a", "b"), [(3, 8), (3, 8.5)], [0, 0], [0, 0], ("stand",) * 2))
    swaps = TrackNoise(position_m=0.0, miss=0.0, switch_hz=1e9)
    tracker = Tracker(COURIER, OpenStreet(), np.random.default_rng(0), swaps)
    assert tracker.read(ROBOT, both, 0.0).ids.tolist() == [0, 1]
    assert set(tracker.read(ROBOT, both, 0.1).ids.tolist()) == {0, 1}
    calm = TrackNoise(miss=0.0, switch_hz=0.0)
    tracker = Tracker(COURIER, OpenStreet(), np.random.default_rng(0), calm)
    found = []
    seen = [(0.0, street), (0.5, Street(0)), (0.9, street), (3.0, street), (3.5, Street(0))]
    for time_s, shown in (*seen, (4.1, street)):
        found.append(tracker.read(ROBOT, shown, time_s).ids.tolist())
    assert found == [[0], [], [0], [0], [], [1]]
    tracker.on_reset()
    assert tracker.read(ROBOT, street, 4.2).ids.tolist() == [2]


@pytest.mark.engine
def test_an_inertial_sensor_integrates_to_the_motion_of_the_robot() -> None:
    """At rest it shows gravity, and sums of yaw rate and acceleration equal heading and speed."""
    sensor = InertialSensor("exact", np.random.default_rng(0))
    with BulletWorld(StreetSurface(tiny_map(), seed=0)) as world:
        robot = world.place(Pose(-20.0, 1.0, 0.0))
        still = sensor.read(robot, 0.0)
        turn = speed = 0.0
        for tick in range(40):
            motion = world.step(Command(0.8, 0.4), Street(tick), Street(tick + 1), 10)
            sensor.moved(robot, motion.robot)
            robot = motion.robot
            read = sensor.read(robot, 0.05 * (tick + 1))
            turn += 0.05 * read.gyro_radps[2]
            speed += 0.05 * read.accel_mps2[0]
    assert np.asarray(still) == pytest.approx(np.asarray(AT_REST), abs=0.02)
    assert turn == pytest.approx(robot.pose.heading_rad, abs=0.01) and turn > 0.3
    assert speed == pytest.approx(robot.v_mps, abs=0.05) and speed > 0.6


def test_a_noisy_inertial_sensor_has_declared_noise_and_a_slow_bias() -> None:
    """In 2,000 readings at rest differences of neighbours have the noise, and means of episodes
    have the bias."""
    noise = ImuNoise()
    sensor = InertialSensor("noisy", np.random.default_rng(2))
    reads = np.array([np.asarray(sensor.read(ROBOT, 0.05 * k)) for k in range(2000)])
    apart = np.diff(reads, axis=0).std(axis=0) / math.sqrt(2.0)
    assert apart == pytest.approx([noise.gyro_radps] * 3 + [noise.accel_mps2] * 3, rel=0.1)
    first = [
        np.asarray(InertialSensor("noisy", np.random.default_rng(k)).read(ROBOT, 0.0))
        for k in range(400)
    ]
    offset = (np.array(first) - np.asarray(AT_REST)).std(axis=0)
    gyro = math.hypot(noise.gyro_radps, noise.gyro_bias_radps)
    accel = math.hypot(noise.accel_mps2, noise.accel_bias_mps2)
    assert offset == pytest.approx([gyro] * 3 + [accel] * 3, rel=0.15)


def test_mirrored_readings_are_of_the_mirrored_street() -> None:
    """Walls, turns and pushes change sides, and mirroring twice changes nothing."""
    spec = ScanSpec(rays=8)
    scan = Scan(np.where(spec.angles_rad == math.pi / 2, 1.0, 9.0).astype(np.float32)[None], spec)
    mirrored = scan.mirrored()
    assert mirrored.ranges_m[0, np.isclose(spec.angles_rad, -math.pi / 2)] == 1.0
    assert (mirrored.mirrored().ranges_m == scan.ranges_m).all()
    assert Imu((0.1, 0.2, 0.3), (1.0, 2.0, 9.0)).mirrored() == Imu((-0.1, 0.2, -0.3), (1, -2, 9))
    tracks = Tracks(np.array([4], np.int32), *np.ones((2, 1, 2), np.float32))
    assert np.asarray(tracks.mirrored()).tolist() == [[1.0, -1.0, 1.0, -1.0]]


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"rays": 7}, r"scan rays must be in \[8, 4096\], not 7"),
        ({"rays": 90.5}, "scan rays must be a whole number, not 90.5"),
        ({"rings": 65}, r"scan rings must be in \[1, 64\], not 65"),
        ({"range_m": 101.0}, r"scan range_m must be in \[0.5, 100\], not 101"),
        ({"range_m": math.nan}, r"scan range_m must be in \[0.5, 100\], not nan"),
        ({"height_m": 4.0}, r"scan height_m must be in \[0.05, 3\], not 4"),
        ({"noise_m": -1.0}, r"scan noise_m must be in \[0, 1\], not -1"),
        ({"elevation_deg": (5.0, -5.0), "rings": 2}, "scan elevation_deg must rise"),
        ({"elevation_deg": (-5.0, 5.0)}, "one ring has one elevation"),
        ({"rays": 4096, "rings": 64}, "a scan has at most 131072 distances"),
    ],
    ids=lambda value: "" if isinstance(value, str) else "-".join(value),
)
def test_a_lidar_beyond_the_limits_is_refused(fields: dict[str, object], words: str) -> None:
    """The message names the field, its range and the value."""
    with pytest.raises(SpecError, match=words):
        ScanSpec(**fields)  # type: ignore[arg-type]
    assert np.isinf(np.asarray(clear_scan(ScanSpec(rays=8)))).all()
