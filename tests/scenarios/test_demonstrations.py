"""Demonstrations and data sets of known pictures and known drives; no engine runs."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pyarrow.parquet as pq
import pytest

from cosim.cli.collect import DemoConfig, _source
from cosim.core.errors import CosimError, RunError, SpecError, UsageError
from cosim.core.packed_demos import FREE_RAYS, LABELLED_PEOPLE, read_packed
from cosim.core.progress import ignore
from cosim.core.state import Command
from cosim.policies.load import load_policy
from cosim.spec.camera import CameraSpec
from cosim.spec.demo_options import DemoOptions, recording_manifest
from cosim.spec.goal import GOALS, goal_called
from cosim.spec.manifest import Manifest
from cosim.spec.options import EpisodeOptions
from cosim.spec.robot import COURIER
from cosim.spec.run_config import RunConfig
from cosim.spec.scenario import Suite, write_suite
from cosim.spec.sensors import PEOPLE_ROWS, ScanSpec
from scenarios.episodes.clip import _OPTIONS, Clip, _planes_of, _rgb_of, read_pictures
from scenarios.episodes.demonstration import (
    Demonstration,
    drives_ahead,
    glimpse,
    waypoints_ahead,
)
from scenarios.episodes.demonstrator import Demonstrator, _Bursts
from scenarios.suites.new_scenarios import new_cities, new_scenarios
from scenarios.tools.dataset.collect import _Rounds
from scenarios.tools.dataset.collected import Collected
from scenarios.tools.dataset.lerobot import Filmed, write_lerobot
from scenarios.tools.dataset.pack import pack_raw
from scenarios.tools.dataset.read import packed_sets, read_back, read_data_set
from sumo_nets.city.store import SEEDS
from tests.run_specs import record_of
from tests.support.driven_runs import short_way

FPS = 5
TICK_S = 0.05
LENGTHS = (7, 12, 3)
ABOUT = {
    "rate_hz": 5.0,
    "waypoint_s": 0.2,
    "waypoints": 2,
    "goal": "route_point",
    "camera": {"width": 64, "height": 48},
    "robot": "courier",
    "policy": "p",
    "noise": 0.0,
}


def known_pictures(episode: int, count: int) -> np.ndarray:
    """Return (count, 48, 64, 3) pictures: a smooth pattern of the episode that moves by 4 pixels
    from picture to picture."""
    small = np.random.default_rng(episode).integers(30, 226, (4, 6, 3), np.uint8)
    wide = cv2.resize(small, (64 + 4 * count, 48), interpolation=cv2.INTER_CUBIC)
    return np.stack([wide[:, 4 * k : 4 * k + 64] for k in range(count)])


def known_demonstration(episode: int, count: int) -> Demonstration:
    """Return an episode of known pictures; its numbers identify the row and the episode."""
    clip = Clip((64, 48), FPS)
    pictures = known_pictures(episode, count)
    for one in pictures:
        clip.add(one)
    rows = np.column_stack([np.full(count, episode), np.arange(count)]).astype(np.float32)
    return Demonstration(
        state=rows,
        goal=rows + 0.25,
        command=rows + 0.5,
        waypoints=np.stack([rows, rows + 0.75], axis=1),
        driven=np.full(count, 2, np.int32),
        disturbed=rows[:, 1] == 1,
        instruction=np.array([""] * count),
        glimpses=np.stack([glimpse(one) for one in pictures]),
        colours=np.stack([np.bincount(pictures[..., c].ravel(), minlength=256) for c in range(3)]),
        clip=np.frombuffer(clip.finished(), np.uint8),
    )


def episodes_of(demonstrations: Sequence[Demonstration]) -> list[Collected]:
    found = []
    for k, one in enumerate(demonstrations):
        scenario = short_way(f"s-{k:03d}").in_weather("rain" if k == 1 else "")
        record = record_of(scenario, Manifest("p"))
        found.append(Collected(scenario, record, lambda one=one: one))  # type: ignore[misc]
    return found


def written(
    folder: Path, demonstrations: Sequence[Demonstration], about: dict[str, Any] = ABOUT
) -> Path:
    folder.mkdir()
    write_lerobot(
        folder, episodes_of(demonstrations), Filmed("front", (64, 48), FPS), "courier", about
    )
    return folder


@pytest.fixture(scope="module")
def demonstrations() -> list[Demonstration]:
    return [known_demonstration(episode, count) for episode, count in enumerate(LENGTHS)]


@pytest.fixture(scope="module")
def data_set(tmp_path_factory: pytest.TempPathFactory, demonstrations: list[Demonstration]) -> Path:
    return written(tmp_path_factory.mktemp("sets") / "one", demonstrations)


def test_decoded_pictures_match_their_rows_and_times(
    data_set: Path, demonstrations: list[Demonstration]
) -> None:
    """Picture k of a decoded .mp4, at k / 5 s, is that of row k within the codec's loss. It is
    nearer to it than to those of adjacent rows, across the borders of episodes too."""
    (film,) = read_data_set(data_set).films
    drawn = np.concatenate([known_pictures(k, count) for k, count in enumerate(LENGTHS)]).astype(
        float
    )
    times, seen = zip(*read_pictures(film), strict=True)
    assert list(times) == [Fraction(k, FPS) for k in range(sum(LENGTHS))]
    off = np.array([[np.abs(one - other).mean() for other in drawn] for one in seen])
    assert off.diagonal().max() < 5.0
    assert (off.argmin(axis=1) == np.arange(len(drawn))).all()
    assert read_back(data_set, episodes_of(demonstrations)).rows == len(drawn)


def test_a_data_set_has_the_same_bytes_whenever_it_is_written(
    data_set: Path, tmp_path: Path
) -> None:
    """Encoded and written again, every file is the same."""
    again = written(
        tmp_path / "again",
        [known_demonstration(episode, count) for episode, count in enumerate(LENGTHS)],
    )
    files = sorted(path.relative_to(data_set) for path in data_set.rglob("*") if path.is_file())
    assert len(files) == 7
    assert files == sorted(path.relative_to(again) for path in again.rglob("*") if path.is_file())
    assert all((data_set / name).read_bytes() == (again / name).read_bytes() for name in files)


def test_a_clip_is_the_same_whatever_instructions_the_processor_has(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """With the instructions of older processors, or without any fast ones, the encoder writes the
    same bytes."""
    rng = np.random.default_rng(0)
    known = known_pictures(5, 12)
    pictures = [
        cv2.add(one, cv2.blur(rng.integers(0, 90, one.shape, np.uint8), (3, 3))) for one in known
    ]

    def clip_of(params: str) -> bytes:
        monkeypatch.setitem(_OPTIONS, "x264-params", params)
        clip = Clip((64, 48), FPS)
        for one in pictures:
            clip.add(one)
        return clip.finished()

    asked = _OPTIONS["x264-params"]
    made = {
        clip_of(asked),
        *(clip_of(f"{asked}:asm={instructions}") for instructions in ("AVX2", "SSE2", "0")),
    }
    assert len(made) == 1
    assert clip_of("asm=0:subme=0") not in made


def test_a_clip_is_the_same_wherever_its_pictures_lie_in_memory() -> None:
    """Pictures at any address give the same bytes, and grey and coloured pictures keep their
    colours to 2 levels of 255."""
    pictures = known_pictures(5, 6)

    def clip_of(shift: int) -> bytes:
        clip = Clip((64, 48), FPS)
        memory = np.empty(pictures[0].size + shift, np.uint8)
        for one in pictures:
            moved = memory[shift:].reshape(one.shape)
            moved[:] = one
            clip.add(moved)
        return clip.finished()

    assert len({clip_of(shift) for shift in range(9)}) == 1
    grey = np.full((48, 64, 3), 128, np.uint8)
    assert np.abs(_rgb_of(_planes_of(grey)).astype(int) - grey).max() <= 1
    flat = np.broadcast_to(np.array([200, 90, 30], np.uint8), (48, 64, 3))
    assert np.abs(_rgb_of(_planes_of(np.ascontiguousarray(flat))).astype(int) - flat).max() <= 2


def test_tables_match_info_json(data_set: Path) -> None:
    """Every feature except the film is a column of its type and length, and episodes state the
    range of their rows."""
    info = json.loads((data_set / "meta/info.json").read_text())
    table = pq.read_table(data_set / info["data_path"].format(chunk_index=0, file_index=0))
    key = "observation.images.front"
    assert set(table.column_names) == set(info["features"]) - {key}
    for name in table.column_names:
        kind = table.schema.field(name).type
        feature = info["features"][name]
        is_list = feature["shape"] != [1]
        assert (kind.list_size if is_list else 1) == feature["shape"][0]
        assert str(kind.value_type if is_list else kind) == {"float32": "float"}.get(
            feature["dtype"], feature["dtype"]
        )
    (path,) = (data_set / "meta/episodes").rglob("*.parquet")
    episodes = pq.read_table(path).to_pylist()
    assert [one["length"] for one in episodes] == list(LENGTHS)
    assert [one["dataset_to_index"] for one in episodes] == np.cumsum(LENGTHS).tolist()
    assert [one[f"videos/{key}/from_timestamp"] for one in episodes] == [0.0, 1.4, 3.8]
    stats = json.loads((data_set / "meta/stats.json").read_text())
    pictures = np.concatenate([known_pictures(k, count) for k, count in enumerate(LENGTHS)]) / 255.0
    np.testing.assert_allclose(np.ravel(stats[key]["mean"]), pictures.mean(axis=(0, 1, 2)))
    np.testing.assert_allclose(np.ravel(stats[key]["std"]), pictures.std(axis=(0, 1, 2)))
    np.testing.assert_allclose(
        stats["action"]["mean"], np.stack(table["action"].to_numpy()).mean(axis=0)
    )


def test_packed_rows_equal_those_of_the_data_sets(
    data_set: Path, demonstrations: list[Demonstration]
) -> None:
    """Two data sets in one file have their arrays one after the other, with continuous episode
    numbers and each episode's weather. Pictures are made smaller on request."""
    packed = packed_sets([data_set, data_set], (32, 24))
    for name in ("state", "goal", "command", "waypoints", "driven", "disturbed"):
        once = np.concatenate([getattr(one, name) for one in demonstrations])
        np.testing.assert_array_equal(getattr(packed, name), np.concatenate([once, once]))
    assert np.bincount(packed.episode).tolist() == [*LENGTHS, *LENGTHS]
    assert packed.frames.shape == (2 * sum(LENGTHS), 24, 32, 3)
    assert packed.meta["scenarios"] == ["s-000", "s-001", "s-002"] * 2
    assert packed.meta["weathers"] == ["clear", "rain", "clear"] * 2


def test_sensors_are_packed_as_they_were_recorded(tmp_path: Path) -> None:
    """Distances by ring and ray, inertial readings, people and labels are read back equal; data
    sets with other sensors are not packed together."""
    draws = np.random.default_rng(3)
    shapes = {"scan": (2, 8), "imu": (6,), "people": (PEOPLE_ROWS, 5)}
    shapes |= {"near": (LABELLED_PEOPLE, 6), "free": (FREE_RAYS,), "scene": (2,)}
    sensors = {name: draws.random((7, *shape), np.float32) for name, shape in shapes.items()}
    columns = {**sensors, "scan": sensors["scan"].reshape(7, -1)}
    lidar = msgspec.to_builtins(ScanSpec(rays=8, rings=2, elevation_deg=(-5.0, 5.0)))
    about = {**ABOUT, "lidar": lidar, "imu": "exact", "people": "seen"}
    folder = written(tmp_path / "one", [replace(known_demonstration(0, 7), **columns)], about)
    packed_sets([folder]).save(tmp_path / "demos.npz")
    packed = read_packed(tmp_path / "demos.npz")
    for name, readings in sensors.items():
        np.testing.assert_array_equal(getattr(packed, name), readings)
    assert (packed.meta["lidar"]["rings"], packed.meta["imu"]) == (2, "exact")
    with pytest.raises(SpecError, match=r"lidar is .* here and None there"):
        packed_sets([folder, written(tmp_path / "other", [known_demonstration(0, 3)])])


def test_waypoints_end_at_a_reset_of_the_robot() -> None:
    """The robot drives east at 2 m/s, is reset by 4 m after tick 9, rests for a tick and drives on.
    No waypoint crosses the reset, and later waypoints are of the drive after it."""
    x_m = [0.1 * k for k in range(11)] + [-3.0 + 0.1 * k for k in range(10)]
    pose = np.array([[x, 0.0, 0.0] for x in x_m])
    ticks, begins = np.array([0, 4, 8, 10, 14]), np.array([True, False, False, True, False])
    command, calm = np.tile([2.0, 0.0], (5, 1)), np.zeros(5, bool)
    waypoints, driven = drives_ahead(
        pose, np.array([9]), ticks, begins, command, calm, 3, 4, TICK_S
    )
    assert driven.tolist() == [2, 1, 0, 2, 1]
    np.testing.assert_allclose(waypoints[:3, :, 0], np.tile([0.4, 0.8, 1.2], (3, 1)), atol=1e-5)
    np.testing.assert_allclose(waypoints[3, :2, 0], [0.3, 0.7], atol=1e-5)
    plain = waypoints_ahead(pose[:11], ticks[:3], command[:3], calm[:3], 3, 4, TICK_S)
    np.testing.assert_array_equal(waypoints[:3], plain[0])


def test_raw_demonstrations_are_packed_in_parts(
    tmp_path: Path, demonstrations: list[Demonstration]
) -> None:
    """The finished episodes of a collection are packed in the order of its scenarios, by two
    processes as by one. An episode with a reset is two; old parts are deleted; an empty folder is
    named."""
    ways = [short_way(f"s-{k:03d}") for k in range(4)]
    ways[1] = ways[1].in_weather("rain")
    run = tmp_path / "raw/runs/00"
    run.mkdir(parents=True)
    write_suite(Suite(name="ways", version="1", scenarios=tuple(ways)), run / "scenarios.json")
    (tmp_path / "raw/about.json").write_text(json.dumps(ABOUT))
    with pytest.raises(RunError, match="no episode is finished: continue the collection"):
        pack_raw([tmp_path / "raw"], tmp_path / "d.npz")
    begins = np.zeros(LENGTHS[1], bool)
    begins[[0, 8]] = True
    stored = [demonstrations[0], replace(demonstrations[1], begins=begins), demonstrations[2]]
    for way, one in zip(ways[:3], stored, strict=True):
        folder = run / "episodes" / way.id
        folder.mkdir(parents=True)
        (folder / "demonstration.npz").write_bytes(one.encoded())
    parts = pack_raw([tmp_path / "raw"], tmp_path / "d.npz", part=2, jobs=2)
    assert [(one.path.name, one.episodes, one.rows) for one in parts] == [
        ("d-000.npz", 2, LENGTHS[0] + LENGTHS[1]),
        ("d-001.npz", 1, LENGTHS[2]),
    ]
    first, second = (read_packed(one.path) for one in parts)
    assert first.meta["weathers"] == ["clear", "rain", "rain"] and second.meta["scenarios"] == [
        "s-002"
    ]
    np.testing.assert_array_equal(second.command, demonstrations[2].command)
    assert np.bincount(first.episode).tolist() == [LENGTHS[0], 8, LENGTHS[1] - 8]
    assert first.frame[LENGTHS[0] + 8] == 0
    seen = np.stack([glimpse(rgb) for rgb in first.frames[LENGTHS[0] :]]).astype(float)
    assert np.abs(seen - demonstrations[1].glimpses).mean() < 4.0
    (tmp_path / "e-f-001.npz").touch()
    pack_raw([tmp_path / "raw"], tmp_path / "e.npz", part=1)
    pack_raw([tmp_path / "raw"], tmp_path / "e.npz", (32, 24), part=9)
    assert [path.name for path in sorted(tmp_path.glob("e-*"))] == ["e-000.npz", "e-f-001.npz"]
    assert read_packed(tmp_path / "e-000.npz").frames.shape == (sum(LENGTHS), 24, 32, 3)
    for number, way in ((100, ways[3]), (11, ways[2])):
        one_way = Suite(name="ways", version="1", scenarios=(way,))
        folder = tmp_path / f"many/runs/{number:02d}"
        (folder / "episodes" / way.id).mkdir(parents=True)
        write_suite(one_way, folder / "scenarios.json")
        (folder / f"episodes/{way.id}/demonstration.npz").write_bytes(demonstrations[0].encoded())
    (tmp_path / "many/about.json").write_text(json.dumps(ABOUT))
    (part,) = pack_raw([tmp_path / "many"], tmp_path / "m.npz")
    assert read_packed(part.path).meta["scenarios"] == ["s-002", "s-003"]
    with pytest.raises(RunError, match="no collection of the format raw"):
        pack_raw([tmp_path], tmp_path / "d.npz")


def test_incompatible_data_sets_are_not_packed_together(data_set: Path, tmp_path: Path) -> None:
    """Another rate and other waypoints are named with both values; a folder without a data set is
    named."""
    other = written(tmp_path / "other", [known_demonstration(0, 3)])
    (other / "meta/cosim.json").write_text(json.dumps({**ABOUT, "waypoint_s": 0.5}))
    with pytest.raises(SpecError, match=r"waypoint_s is 0\.2 here and 0\.5 there"):
        packed_sets([data_set, other])
    (other / "meta/info.json").unlink()
    with pytest.raises(RunError, match="other: no data set of `cosim collect`, or not whole yet"):
        packed_sets([other])


def _rows_moved(demonstration: Demonstration) -> Demonstration:
    return replace(demonstration, command=np.roll(demonstration.command, 1, axis=0))


def _pictures_moved(demonstration: Demonstration) -> Demonstration:
    return replace(demonstration, glimpses=np.roll(demonstration.glimpses, 4, axis=0))


@pytest.mark.parametrize(
    ("moved", "words"),
    [
        (_rows_moved, "the rows of episode 1"),
        (_pictures_moved, "of episode 1, s-001, is not that of its row"),
    ],
    ids=["rows", "pictures"],
)
def test_shifted_rows_or_pictures_are_found_when_a_data_set_is_read(
    data_set: Path,
    demonstrations: list[Demonstration],
    moved: Callable[[Demonstration], Demonstration],
    words: str,
) -> None:
    """Changed rows or pictures of one episode are refused with its name."""
    kept = [demonstrations[0], moved(demonstrations[1]), demonstrations[2]]
    with pytest.raises(RunError, match=words):
        read_back(data_set, episodes_of(kept))


def test_waypoints_are_where_the_robot_is_later_in_its_own_frame() -> None:
    """On a circle to the left, waypoints are later places on the circle, and after the end the same
    circle continues by the last command."""
    v_mps = 1.0
    w_radps = 0.5
    angle = w_radps * TICK_S * np.arange(41)
    pose = np.column_stack(
        [v_mps / w_radps * np.sin(angle), v_mps / w_radps * (1.0 - np.cos(angle)), angle]
    )
    ticks = np.arange(0, 40, 4)
    command = np.tile([v_mps, w_radps], (10, 1))
    ahead, driven = waypoints_ahead(pose, ticks, command, np.zeros(10, bool), 3, 4, TICK_S)
    later = w_radps * 0.2 * np.arange(1, 4)
    circle = np.column_stack([2.0 * np.sin(later), 2.0 * (1.0 - np.cos(later))])
    np.testing.assert_allclose(ahead, np.tile(circle, (10, 1, 1)), atol=1e-6)
    assert driven.tolist() == [3] * 8 + [2, 1]


def test_waypoints_are_never_those_of_a_disturbed_drive() -> None:
    """Waypoints before and in a burst of noise continue straight ahead, as the expert would; those
    after it are driven."""
    disturbed = np.array([False, False, True, False, False])
    pose = np.zeros((21, 3))
    pose[:, 0] = 0.05 * np.arange(21)
    pose[9:, 1] = 0.3
    ahead, driven = waypoints_ahead(
        pose, np.arange(0, 20, 4), np.tile([1.0, 0.0], (5, 1)), disturbed, 2, 4, TICK_S
    )
    assert driven.tolist() == [2, 1, 0, 2, 1]
    np.testing.assert_allclose(ahead, np.tile([[0.2, 0.0], [0.4, 0.0]], (5, 1, 1)), atol=1e-6)


def test_noise_bursts_have_their_share_of_the_time_and_depend_on_the_seed() -> None:
    """With --noise 0.2 a fifth of the commands over many episodes is disturbed, and one seed gives
    one drive. A robot that the expert stops is not moved."""
    answer = Command(1.0, 0.1)
    collecting = DemoOptions(noise=0.2)
    drives = [[bursts.driven(answer, COURIER) for _ in range(60)] for bursts in _each(collecting)]
    assert drives == [
        [bursts.driven(answer, COURIER) for _ in range(60)] for bursts in _each(collecting)
    ]
    assert np.mean([one is not answer for drive in drives for one in drive]) == pytest.approx(
        0.2, abs=0.02
    )
    assert {bursts.driven(Command(0.0, 0.0), COURIER).v_mps for bursts in _each(collecting)} == {
        0.0
    }
    assert all(bursts.driven(answer, COURIER) is answer for bursts in _each(DemoOptions()))


def test_an_exploring_learner_stops_and_starts_at_times() -> None:
    """Commands are changed for their share of the time, and half of the changes set the speed."""
    collecting = DemoOptions(explore=0.3, learner="small", unsolved=True)
    found = {}
    for v_mps in (0.0, 1.0):
        answer = Command(v_mps, 0.1)
        drives = [[one.driven(answer, COURIER) for _ in range(60)] for one in _each(collecting)]
        found[v_mps] = [one for drive in drives for one in drive]
        changed = np.mean([one is not answer for one in found[v_mps]])
        assert changed == pytest.approx(0.3, abs=0.03)
    assert np.mean([one.v_mps == 1.0 for one in found[0.0]]) == pytest.approx(0.075, abs=0.02)
    assert np.mean([one.v_mps == 0.0 for one in found[1.0]]) == pytest.approx(0.075, abs=0.02)


def _each(collecting: DemoOptions) -> list[_Bursts]:
    return [_Bursts(seed, collecting) for seed in range(300)]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"rate_hz": 3.0}, "1, 2, 4, 5, 10, 20 pictures a second, not 3"),
        ({"noise": 1.5}, r"noise must be in \[0, 0\.9\]"),
        ({"noise": float("nan")}, r"noise must be in \[0, 0\.9\]"),
        ({"explore": 1.5}, r"explore must be in \[0, 0\.9\]"),
        ({"explore": 0.3, "learner": "small"}, "give --learner and --unsolved, and no --noise"),
        ({"waypoints": 0}, r"waypoints must be in \[1, 100\], not 0"),
        ({"waypoint_s": 0.12}, r"whole number of ticks of 0\.05 s, up to 10 s, not 0\.12 s"),
        (
            {"camera": CameraSpec(width=97, height=96)},
            "even sides of 16 pixels or more, not 97 x 96",
        ),
    ],
    ids=[
        "rate",
        "much noise",
        "no number",
        "much exploration",
        "solved ones alone",
        "no waypoints",
        "waypoints between ticks",
        "odd picture",
    ],
)
def test_invalid_options_of_a_collection_are_refused(
    options: dict[str, object], words: str
) -> None:
    """An invalid rate, share of noise, waypoints or size is refused with the valid range."""
    with pytest.raises(SpecError, match=words):
        DemoOptions(**options)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "goal", [kind.name for kind in GOALS.values() if not kind.has_data_set_column]
)
def test_goals_that_rows_cannot_store_are_refused(goal: str) -> None:
    """Picture goals, and points that the expert does not drive to, are refused with the valid
    goals."""
    with pytest.raises(
        CosimError, match="give --goal, one of none, route_point, final_point, instruction"
    ):
        recording_manifest(Manifest("p", goal=goal_called(goal)), DemoOptions())


def test_an_expert_with_a_camera_is_queried_at_its_own_rate() -> None:
    """Another rate is refused for an expert with a memory of pictures; a blind expert accepts any
    rate."""
    with pytest.raises(
        CosimError, match="policy 'p' sees, and answers 4 times a second, not 5: give --rate 4"
    ):
        recording_manifest(Manifest("p", rate_hz=4.0), DemoOptions())
    assert recording_manifest(Manifest("p", rate_hz=4.0), DemoOptions(rate_hz=4.0)).rate_hz == 4.0
    assert (
        recording_manifest(Manifest("p", rate_hz=20.0, camera=None), DemoOptions()).rate_hz == 5.0
    )


@pytest.mark.parametrize(
    "words", ["70:90", "1:2", "7000:7002", "40", "9:9", "a:b", "-4:3", "900:100000"]
)
def test_cities_of_the_suites_are_refused(words: str) -> None:
    """Seeds that a suite uses, and text that is no range of seeds, are refused with a valid
    example."""
    with pytest.raises(CosimError, match=f"--cities {words}: .*900:940"):
        new_cities(words)


@pytest.mark.parametrize(
    ("suite", "more", "words"),
    [
        ("reactive", {"weathers": "rain,fog"}, "--weathers and --weather do not go together"),
        ("unit", {"cities": "900:901", "decoys": True}, "new scenarios of unit have no decoys"),
    ],
    ids=["weathers", "decoys"],
)
def test_options_that_contradict_each_other_are_refused(
    suite: str, more: dict[str, Any], words: str
) -> None:
    """Two ways to set the weather are refused, and so are decoys of a suite without any."""
    with pytest.raises(UsageError, match=words):
        _source(RunConfig(suite=suite, weather="snow"), DemoConfig(**more))


def test_raw_demonstrations_name_the_robot_of_their_scenarios(tmp_path: Path) -> None:
    """The robot is that of the suite's scenarios, unless another one is requested."""
    way = short_way("s").driven_by("scout")
    suite = Suite(name="ways", version="1", scenarios=(way,))
    demonstrator = Demonstrator(load_policy("orca"), DemoOptions(format="raw"), "route_point")
    for requested, robot in (("", "scout"), ("courier", "courier")):
        options = EpisodeOptions(robot=requested)
        rounds = _Rounds(suite, tmp_path, "orca", demonstrator, options, 1, math.inf, ignore)
        assert rounds.robot == robot


def test_fresh_scenarios_take_structures_and_cities_in_turn() -> None:
    """Structures take turns, then cities, and then both again; no city belongs to a suite."""
    drawn = new_scenarios("reactive", new_cities("900:902"), ["gesturing", "static"])
    assert drawn.structures == ("gesturing", "static")
    assert not {*drawn.seeds} & {*SEEDS}
    with pytest.raises(
        CosimError,
        match=r"unknown structure of 'unit' 'gesturing'\. Valid choices: crosswalk, curve",
    ):
        new_scenarios("unit", (900,), ["gesturing"])
    with pytest.raises(
        CosimError,
        match=r"unknown suite for --cities 'scans'\. Valid choices: long-horizon, reactive, unit",
    ):
        new_scenarios("scans", (900,))
    with_decoys = new_scenarios("reactive", (900,), ["gesturing", "static"], decoys=True)
    assert with_decoys.structures == ("gesturing", "gesturing-decoy", "static")
    assert new_scenarios("long-horizon", (900,)).structures == ("route",)


def test_a_damaged_demonstration_is_named(demonstrations: list[Demonstration]) -> None:
    """A truncated file is refused with its name, and a complete one decodes to what was encoded."""
    data = demonstrations[0].encoded()
    assert data == demonstrations[0].encoded()
    assert Demonstration.decoded(data, "here").encoded() == data
    with pytest.raises(RunError, match="here: no demonstration"):
        Demonstration.decoded(data[:-100], "here")
