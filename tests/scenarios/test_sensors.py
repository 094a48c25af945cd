"""Sensors in episodes: the simulation does not depend on them, and repeats their readings."""

from __future__ import annotations

import dataclasses

import msgspec
import numpy as np
import pytest

from cosim.core.state import Command
from cosim.episode.interfaces import Observation
from cosim.spec.camera import CameraSpec
from cosim.spec.manifest import Manifest
from cosim.spec.options import EpisodeOptions
from cosim.spec.scenario import CrowdSpec, Scenario
from cosim.spec.sensors import ScanSpec
from scenarios.episodes.episode import Episode
from scenarios.tools.verify.doctor import small_scenario

BLIND = Manifest("blind", rate_hz=10.0, camera=None)
SENSING = dataclasses.replace(
    BLIND, scan=ScanSpec(rays=90, range_m=40.0), imu="noisy", people="seen", odometry="gps"
)


def crowded(robot: str = "courier") -> Scenario:
    """Return a short scenario with people, for a robot."""
    crowd = CrowdSpec(persons=12, radius_m=25.0, vehicles=4)
    return msgspec.structs.replace(small_scenario(), crowd=crowd).driven_by(robot)


def driven(
    manifest: Manifest, seed: int = 3, robot: str = "courier"
) -> tuple[str, list[Observation]]:
    """Return the state hash after 2 s of the same commands, and the observations."""
    with Episode(crowded(robot), manifest, EpisodeOptions(seed=seed, camera="bullet")) as episode:
        seen = [episode.reset()]
        for k in range(20):
            if episode.over:
                break
            seen.append(episode.advance(Command(0.8, 0.3 * (-1) ** (k // 8))))
        return episode.driven().state_hash, seen


def bytes_of(seen: list[Observation]) -> list[bytes]:
    """Return the readings of all sensors."""
    return [
        b"".join(np.asarray(part).tobytes() for part in (one.scan, one.imu, one.people))
        for one in seen
    ]


@pytest.mark.engine
@pytest.mark.parametrize("robot", ["courier", "dog"])
def test_the_state_hash_does_not_depend_on_sensors(robot: str) -> None:
    """The same commands by a blind policy and by one with all sensors: the same hash; the same seed
    repeats the readings, and another one has others."""
    blind, _ = driven(BLIND, robot=robot)
    sensing, first = driven(SENSING, robot=robot)
    assert blind == sensing
    assert first[0].scan is not None and np.isfinite(first[0].scan.ranges_m).sum() > 20
    assert any(len(one.people.ids) for one in first if one.people is not None)
    again, second = driven(SENSING, robot=robot)
    assert again == blind and bytes_of(first) == bytes_of(second)
    assert bytes_of(driven(SENSING, seed=4, robot=robot)[1]) != bytes_of(first)


@pytest.mark.engine
def test_a_sensor_changes_no_reading_of_another() -> None:
    """Scans and tracks are the same with and without the others, and so are fixes."""
    _, everything = driven(SENSING)
    _, scans = driven(dataclasses.replace(SENSING, imu="none", people="none"))
    _, people = driven(dataclasses.replace(SENSING, scan=None, imu="none"))
    for one, scan, tracks in zip(everything, scans, people, strict=True):
        assert np.array_equal(np.asarray(one.scan), np.asarray(scan.scan))
        assert np.array_equal(np.asarray(one.people), np.asarray(tracks.people))
        assert one.odometry == scan.odometry == tracks.odometry


@pytest.mark.parametrize(
    ("sensors", "track"),
    [
        ({"camera": None}, "blind"),
        ({"camera": None, "imu": "exact"}, "blind"),
        ({}, "picture"),
        ({"scan": ScanSpec()}, "lidar"),
        ({"camera": None, "scan": ScanSpec(), "people": "seen"}, "people"),
        ({"scan": ScanSpec(), "people": "seen", "privileged": True}, "privileged"),
    ],
    ids=["nothing", "inertial", "camera", "lidar", "people", "privileged"],
)
def test_the_sensor_track_is_that_of_the_strongest_source(
    sensors: dict[str, object], track: str
) -> None:
    """A camera beside a lidar is in the track of the lidar; an inertial sensor alone is blind."""
    manifest = dataclasses.replace(Manifest("mine", camera=CameraSpec()), **sensors)  # type: ignore[arg-type]
    assert manifest.track == track
