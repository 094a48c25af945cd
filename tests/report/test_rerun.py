"""Recordings for the Rerun viewer: their content, read back by its own SDK, and refusals."""

from __future__ import annotations

import importlib.util
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

import cosim as product
from cosim.cli.options import check_rerun
from cosim.core.errors import MachineError, UsageError
from cosim.core.state import LABELS
from cosim.results.log import Log
from cosim.spec.scenario import Suite
from cosim.spec.sensors import ScanSpec
from scenarios.tools.verify.doctor import small_scenario
from tests.conftest import Cosim
from tests.support.blind_policy import BEND, Blind


@pytest.mark.parametrize(
    "name, episodes, expected",
    [
        ("e.mp4", 1, "use a name that ends in .rrd"),
        ("e.rrd", 0, "and none are chosen"),
        ("e.rrd", 3, "and 3 are chosen"),
    ],
    ids=["another ending", "no episode", "several"],
)
def test_a_recording_needs_one_episode_and_an_rrd_file(
    tmp_path: Path, name: str, episodes: int, expected: str
) -> None:
    """Anything else is refused before a simulation starts."""
    with pytest.raises(UsageError, match=expected):
        check_rerun(tmp_path / name, episodes)


def test_a_missing_package_is_reported_with_the_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The extra that installs it is named."""
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MachineError, match=r"pip install -e '\.\[rerun\]' in the checkout"):
        check_rerun(tmp_path / "e.rrd", 1)


class Tape:
    """A recording read back: for each entity the columns of its rows, in the order of writing."""

    def __init__(self, path: Path) -> None:
        from rerun.chunk import RrdReader

        self.rows: Counter[str] = Counter()
        self.timelines: dict[str, set[str]] = {}
        self._columns: dict[tuple[str, str], list[Any]] = {}
        for chunk in RrdReader(path).stream().to_chunks():
            batch = chunk.to_record_batch()
            self.rows[chunk.entity_path] += chunk.num_rows
            self.timelines.setdefault(chunk.entity_path, set()).update(chunk.timeline_names)
            for name in batch.schema.names:
                self._columns.setdefault((chunk.entity_path, name), []).extend(
                    batch.column(name).to_pylist()
                )

    def column(self, entity: str, name: str) -> list[Any]:
        return self._columns[entity, name]


class Sensing(Blind):
    """A policy that drives as the blind one, with every sensor but a camera."""

    manifest = replace(Blind.manifest, scan=ScanSpec(rays=90), imu="noisy", people="seen")


@pytest.mark.engine
def test_a_recording_holds_the_episode_on_one_timeline(tmp_path: Path, cosim: Cosim) -> None:
    """Ground, poses, people, velocities, plots, pictures, waypoints and sensors are read back; a
    changed record leaves no file."""
    pytest.importorskip("rerun")
    scenario = msgspec.structs.replace(small_scenario(), time_limit_s=2.0)
    suite = Suite(name="brief", version="1", scenarios=(scenario,))
    product.run(suite, Sensing(), out=tmp_path / "run")
    result = cosim("show", "run", "--episode", scenario.id, "--rerun", "e.rrd", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    tape = Tape(tmp_path / "e.rrd")
    log = Log.load(tmp_path / "run" / "episodes" / scenario.id / "trajectory.npz")
    moving = ("robot", "robot/plan", "people", "people/velocity", "vehicles", "signals")
    for entity in (
        *(f"/world/{name}" for name in moving),
        "/plots/speed/robot",
        "/plots/turn/command",
        "/plots/way/done",
    ):
        assert (tape.rows[entity], tape.timelines[entity]) == (len(log), {"time", "tick"}), entity
    at = np.array([place for (place,) in tape.column("/world/robot", "Transform3D:translation")])
    assert np.allclose(at[:, :2], log.pose[:, :2], atol=1e-3)
    assert tape.column("/world/robot", "tick") == [*range(1, len(log) + 1)]
    dots = [
        np.array(one)[:, :2] for one in tape.column("/world/waypoints/points", "Points3D:positions")
    ]
    for dot, (x_m, y_m, heading_rad) in zip(
        dots, log.pose[19:39:4], strict=True
    ):  # at the end of the tick before
        cos, sin = np.cos(heading_rad), np.sin(heading_rad)
        assert np.allclose(dot, BEND @ [[cos, sin], [-sin, cos]] + (x_m, y_m), atol=1e-3)
    assert tape.column("/world/waypoints/points", "tick") == [21, 25, 29, 33, 37]
    query_ticks = [*range(0, len(log), 4)]
    for entity in ("/world/robot/scan", "/world/robot/tracks", "/plots/imu/gyro_z"):
        assert tape.column(entity, "tick") == query_ticks, entity
    returns = tape.column("/world/robot/scan", "Points3D:positions")
    assert all(10 < len(one) <= 90 for one in returns)
    speeds = [speed for (speed,) in tape.column("/plots/speed/robot", "Scalars:scalars")]
    assert np.array_equal(speeds, log.speed[:, 0])
    people = tape.column("/world/people", "Capsules3D:translations")
    velocities = tape.column("/world/people/velocity", "Arrows3D:vectors")
    assert [len(one) for one in people] == [len(one) for one in velocities] and any(
        len(one) for one in people
    )
    camera = "/world/robot/camera"
    pictures = len(log) // 5
    for name in ("rgb", "depth", "labels"):
        assert tape.rows[f"{camera}/{name}"] == pictures + 1  # and its lens
    (seen,) = tape.column(f"{camera}/labels", "SegmentationImage:buffer")[-1]
    assert {LABELS["sidewalk"], LABELS["building"]} <= {*bytes(seen)}
    for name in ("sidewalks", "crossings", "roads", "route", "goal", "fences", "obstacles"):
        assert tape.rows[f"/world/map/{name}"] == 1 and not tape.timelines[f"/world/map/{name}"]
    assert ["ended: timeout"] in tape.column("/told", "TextLog:text")
    record = tmp_path / "run" / "episodes" / scenario.id / "record.json"
    record.write_text(record.read_text().replace('"state_hash": "', '"state_hash": "f'))
    again = cosim("show", "run", "--episode", scenario.id, "--rerun", "other.rrd", cwd=tmp_path)
    assert again.returncode == 2 and "was not the same when it was replayed" in again.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["e.rrd", "run"]
