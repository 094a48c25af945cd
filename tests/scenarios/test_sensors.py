"""Sensors in episodes: the simulation does not depend on them, and readings are repeatable."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import msgspec
import numpy as np
import pytest

import cosim as product
from cosim.core.state import Command
from cosim.episode.interfaces import Observation
from cosim.episode.loop import Step
from cosim.results.referee import Verdict
from cosim.results.run_folder import read_records
from cosim.spec.camera import CameraSpec
from cosim.spec.manifest import Manifest
from cosim.spec.options import EpisodeOptions
from cosim.spec.scenario import CrowdSpec, Scenario, Suite, write_suite
from cosim.spec.sensors import ScanSpec
from scenarios.episodes.episode import Episode
from scenarios.episodes.replay import load_recorded, replay_episode
from scenarios.episodes.sensor_replay import sensor_replay
from scenarios.tools.verify.doctor import small_scenario
from tests.conftest import Cosim

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
    """A blind policy and one with all sensors have the same hash under the same commands. The same
    seed repeats the readings, and another seed gives others."""
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
    """Scans, tracks and fixes are the same with and without the other sensors."""
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
        ({"camera": None, "cameras": {"left": CameraSpec()}}, "picture"),
        ({"scan": ScanSpec()}, "lidar"),
        ({"camera": None, "scan": ScanSpec(), "people": "seen"}, "people"),
        ({"scan": ScanSpec(), "people": "seen", "privileged": True}, "privileged"),
        ({"camera": CameraSpec(labels=True)}, "privileged"),
    ],
    ids=["nothing", "inertial", "camera", "left camera", "lidar", "people", "privileged", "labels"],
)
def test_the_sensor_track_is_that_of_the_strongest_source(
    sensors: dict[str, object], track: str
) -> None:
    """A camera beside a lidar is in the track of the lidar; an inertial sensor alone is blind;
    labels are privileged."""
    manifest = dataclasses.replace(Manifest("mine", camera=CameraSpec()), **sensors)  # type: ignore[arg-type]
    assert manifest.track == track


class Sensing:
    """Drives a bend, and stores its readings."""

    manifest = dataclasses.replace(SENSING, rate_hz=5.0, goal="random_point")

    def __init__(self) -> None:
        self.seen: list[Observation] = []

    def reset(self, episode_id: str, seed: int) -> None:
        self.seen = []

    def act(self, observation: Observation) -> Command:
        self.seen.append(observation)
        return Command(0.7, 0.2)


@pytest.mark.engine
def test_a_replay_repeats_the_readings_of_the_recorded_policy(tmp_path: Path) -> None:
    """Readings that are computed again from the files of a run have the same bits at the same
    ticks, across resets of the robot."""
    scenario = msgspec.structs.replace(crowded(), time_limit_s=4.0)
    policy = Sensing()
    product.run(
        Suite(name="brief", version="1", scenarios=(scenario,)), policy, out=tmp_path / "run"
    )
    recorded = load_recorded(tmp_path / "run", scenario.id)
    found: list[Observation] = []
    with sensor_replay(recorded) as sensors:
        assert sensors is not None
        episode, replayed = replay_episode(recorded)

        def keep(step: Step, verdict: Verdict) -> None:
            if (seen := sensors.read(step, verdict)) is not None:
                found.append(seen)

        with episode:
            episode.watch(keep)
            observation = episode.reset()
            while not episode.over:
                observation = episode.advance(replayed.act(observation))
    assert [one.tick for one in found] == [one.tick for one in policy.seen]
    assert bytes_of(found) == bytes_of(policy.seen)


MINE = """
import numpy as np
import cosim


class Mine:
    manifest = cosim.Manifest(
        "mine", rate_hz=5.0, camera=None, scan=cosim.ScanSpec(rays=90), imu="noisy", people="seen"
    )

    def reset(self, episode_id, seed):
        pass

    def act(self, seen):
        scan, people = np.asarray(seen.scan), np.asarray(seen.people)
        turn = float(scan[0, 45:60].min(initial=9.0) - scan[0, 30:45].min(initial=9.0))
        turn += float(people.sum()) + float(seen.people.ids.sum()) + seen.imu.gyro_radps[2]
        return cosim.Command(0.7, 0.01 * turn)
"""


@pytest.mark.engine
def test_an_isolated_policy_gets_the_same_readings(tmp_path: Path, cosim: Cosim) -> None:
    """A policy that drives by its sensors reaches the same state hash here and in a sandbox, and
    its row has its sensors and track."""
    scenario = msgspec.structs.replace(crowded(), time_limit_s=3.0)
    write_suite(Suite(name="brief", version="1", scenarios=(scenario,)), tmp_path / "brief.json")
    (tmp_path / "mine.py").write_text(MINE)
    hashes = set()
    for out, more in (("here", ()), ("afar", ("--isolated",))):
        words = (
            "run",
            "brief.json",
            "--policy",
            "mine.py:Mine",
            "--seed",
            "3",
            "--out",
            out,
            *more,
        )
        done = cosim(*words, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        (record,) = read_records(tmp_path / out)
        assert record.status == "done" and record.manifest.track == "people"
        hashes.add(record.state_hash)
    assert len(hashes) == 1
    row = (tmp_path / "here/results.csv").read_text()
    assert "people,none,5.0" in row and "90 rays, 20 m, at 0.3 m, noise 0.02 m" in row
