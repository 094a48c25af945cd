"""`cosim collect` writes what was driven, after interruptions and with any number of processes."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
import pytest

from cosim.core.errors import SpecError, UsageError
from cosim.core.packed_demos import Packed, read_packed
from cosim.core.state import Command
from cosim.episode.interfaces import Observation, Policy
from cosim.episode.policy_caller import PolicyCaller
from cosim.place.walk_graph import WalkGraph
from cosim.policies.load import load_policy
from cosim.results.log import Log
from cosim.results.run_folder import DEMONSTRATION
from cosim.spec.camera import CameraSpec
from cosim.spec.demo_options import DemoOptions
from cosim.spec.manifest import Manifest
from cosim.spec.options import EpisodeOptions
from cosim.spec.scenario import City, Scenario, Suite, write_suite
from cosim.spec.sensors import ScanSpec
from scenarios.episodes.demonstration import Demonstration
from scenarios.episodes.demonstrator import Demonstrator
from scenarios.episodes.reward import tick_rewards
from scenarios.episodes.run_episode import run_episode
from scenarios.places.nets import place
from scenarios.suites.decoys import DRAWN_GO_ON_MPS
from scenarios.suites.unit import build_unit
from scenarios.tools.dataset.read import read_data_set
from tests.conftest import WIDE, Cosim

pytestmark = pytest.mark.engine
NOISY = DemoOptions(
    camera=CameraSpec(width=64, height=48),
    noise=0.3,
    scan=ScanSpec(rays=60),
    imu="exact",
    people="seen",
)
ASKED = (
    "collect",
    "ways.json",
    "--episodes",
    "3",
    "--camera",
    "64x48",
    "--noise",
    "0.3",
    "--lidar",
    "60",
    "--imu",
    "exact",
    "--people",
    "seen",
    "--out",
    "demos",
)


class Collection(NamedTuple):
    """A folder with ways.json and three demonstrations collected from it. ways: 3 to 4 m straight
    ahead; the second of the four has too little time."""

    folder: Path
    ways: tuple[Scenario, ...]
    output: str

    @property
    def solved(self) -> tuple[Scenario, ...]:
        return self.ways[0], *self.ways[2:]

    def episode_folder(self, way: Scenario) -> Path:
        (folder,) = self.folder.glob(f"demos/runs/*/episodes/{way.id}")
        return folder


@pytest.fixture(scope="module")
def collection(tmp_path_factory: pytest.TempPathFactory, cosim: Cosim) -> Collection:
    """Return a collection that two processes began, that was killed after one episode, and that one
    process resumed."""
    folder = tmp_path_factory.mktemp("desk")
    where = City(seed=1, size_m=500.0)
    _, street_map = place(where)
    graph = WalkGraph(street_map)
    drawn = [
        build_unit("straight", where, street_map, graph, k, f"way-{k}", way_m=(3.0, 4.0))
        for k in range(4)
    ]
    ways = (drawn[0], msgspec.structs.replace(drawn[1], time_limit_s=0.5), *drawn[2:])
    write_suite(Suite(name="ways", version="1", scenarios=ways), folder / "ways.json")
    command = [sys.executable, "-m", "cosim", *ASKED, "--jobs", "2"]
    with subprocess.Popen(
        command,
        cwd=folder,
        env=os.environ | WIDE,
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
    ) as begun:
        assert begun.stderr is not None
        assert any("done, 1 of 3" in line for line in begun.stderr)
        begun.kill()
    assert not (folder / "demos/meta").exists()
    result = cosim(*ASKED, "--resume", cwd=folder)
    assert result.returncode == 0, result.stderr
    return Collection(folder, ways, result.stdout)


@pytest.fixture(scope="module")
def packed(collection: Collection, cosim: Cosim) -> Packed:
    result = cosim("dataset", "pack", "demos", "-o", "demos.npz", cwd=collection.folder)
    assert result.returncode == 0, result.stderr
    return read_packed(collection.folder / "demos.npz")


def demonstration_here(
    way: Scenario,
    expert: PolicyCaller,
    collecting: DemoOptions = NOISY,
    learner: Policy | None = None,
) -> Demonstration:
    """Return the demonstration of an episode that this process drives."""
    beside = None if learner is None else PolicyCaller.of(learner)
    demonstrator = Demonstrator(expert, collecting, "route_point", beside)
    options = EpisodeOptions(goal="route_point", seed=0)
    outcome = run_episode(way, demonstrator, options)
    return Demonstration.decoded(
        demonstrator.encoded_demonstration(way, outcome.record, outcome.log), way.id
    )


def test_a_resumed_collection_equals_that_of_one_process(
    collection: Collection, packed: Packed
) -> None:
    """Each demonstration has the bytes of one that is driven here, and the data set has its rows in
    the order of the suite. Unsolved scenarios are reported and left out, and a further scenario
    replaces each."""
    shown = [demonstration_here(way, load_policy("orca")) for way in collection.solved]
    kept = [
        (collection.episode_folder(way) / DEMONSTRATION).read_bytes() for way in collection.solved
    ]
    assert not [
        way.id
        for way, file, one in zip(collection.solved, kept, shown, strict=True)
        if file != one.encoded()
    ]
    for name in ("state", "goal", "command", "waypoints", "driven", "disturbed"):
        np.testing.assert_array_equal(
            getattr(packed, name), np.concatenate([getattr(one, name) for one in shown])
        )
    assert packed.meta["scenarios"] == [way.id for way in collection.solved]
    assert "(3 episodes, " in collection.output
    assert "Dropped 1 that were not solved: ended by timeout: 1" in collection.output
    assert not (collection.episode_folder(collection.ways[1]) / DEMONSTRATION).exists()


def test_rows_are_of_the_ticks_at_which_their_pictures_were_taken(
    collection: Collection, packed: Packed
) -> None:
    """Row k of an episode is of tick 4 k: its speeds are those of the trajectory, its command is
    the driven one unless it was disturbed, and its next waypoint is the position 4 ticks later."""
    assert packed.disturbed.any()
    for number, way in enumerate(collection.solved):
        log = Log.load(collection.episode_folder(way) / "trajectory.npz")
        rows = packed.episode == number
        speed, pose = (
            np.vstack([first, all_]) for first, all_ in (((0, 0), log.speed), (way.start, log.pose))
        )
        ticks = 4 * packed.frame[rows]
        np.testing.assert_allclose(packed.state[rows], speed[ticks], atol=1e-6)
        as_driven = np.abs(packed.command[rows] - log.command[ticks]).max(axis=1) < 1e-6
        assert (as_driven | packed.disturbed[rows]).all()
        driven = packed.driven[rows] > 0
        far_m = np.hypot(*(pose[ticks[driven] + 4] - pose[ticks[driven]])[:, :2].T)
        np.testing.assert_allclose(np.hypot(*packed.waypoints[rows][driven, 0].T), far_m, atol=1e-5)


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (
            ("--resume", "--noise", "0.1"),
            "is of another data set: its noise is 0.3, and this command has 0.1.",
        ),
        (
            ("--resume", "--policy", "social_force"),
            "its policy is orca, and this command has social_force.",
        ),
        (
            ("--resume", "--seed", "5"),
            "is of another data set: its seed is 0, and this command has 5.",
        ),
        ((), "demos already holds a data set, or a part of one. Add --resume"),
        (("--out", "."), ". exists and is no data set. Choose another --out."),
        (("--goal", "image"), "give --goal, one of none, route_point, final_point, instruction"),
        (("--camera", "160"), "--camera 160: give width x height in pixels, such as 160x90"),
        (
            ("--cities", "900:901"),
            "unknown suite for --cities 'ways.json'. Valid choices: long-horizon, reactive, unit",
        ),
        (("--cities", "900:901", "--split", "val"), "--cities and --split do not go together"),
    ],
    ids=[
        "noise",
        "policy",
        "seed",
        "no resume",
        "used folder",
        "goal",
        "camera",
        "no kind",
        "split of cities",
    ],
)
def test_a_folder_with_another_data_set_is_refused(
    collection: Collection, cosim: Cosim, more: tuple[str, ...], words: str
) -> None:
    """Other settings, a used folder and contradictory options are refused in one line, and no file
    changes."""
    before = sorted((path, path.stat().st_mtime_ns) for path in collection.folder.rglob("*"))
    result = cosim(*ASKED, *more, cwd=collection.folder)
    assert result.returncode == 2
    assert words in result.stderr
    assert "Traceback" not in result.stderr
    assert before == sorted(
        (path, path.stat().st_mtime_ns) for path in collection.folder.rglob("*")
    )


def test_recorded_sensors_are_columns_of_the_data_set(
    collection: Collection, packed: Packed
) -> None:
    """Each row has the lidar's distances (its range without a return), the inertial reading and 32
    people, and so have packed rows."""
    held = read_data_set(collection.folder / "demos")
    scans, readings = held.rows["observation.scan"], held.rows["observation.imu"]
    assert scans.shape == (len(held), 60) and scans.min() > 0.0 and scans.max() == 20.0
    assert readings.shape == (len(held), 6) and abs(readings[:, 5].mean() - 9.81) < 0.2
    assert held.rows["observation.people"].shape == (len(held), 160)
    assert held.info["features"]["observation.imu"]["names"][2] == "gyro_z"
    assert (packed.scan[:, 0] == scans).all() and (packed.imu == readings).all()
    assert packed.people.shape == (len(held), 32, 5)


def test_an_incomplete_data_set_is_written_again(collection: Collection, cosim: Cosim) -> None:
    """Without meta/ a data set is incomplete: --resume drives nothing again and writes the same
    bytes."""
    made = collection.folder / "demos"
    files_written = [
        path
        for name in ("meta", "data", "videos")
        for path in (made / name).rglob("*")
        if path.is_file()
    ]
    files = {path: path.read_bytes() for path in files_written}
    shutil.rmtree(made / "meta")
    (made / "writing").mkdir()
    (made / "writing/half").write_bytes(b"")
    result = cosim(*ASKED, "--resume", cwd=collection.folder)
    assert result.returncode == 0, result.stderr
    assert "done, " not in result.stderr
    assert files == {path: path.read_bytes() for path in files}
    assert not (made / "writing").exists()


def test_fresh_scenarios_do_not_depend_on_how_they_are_divided() -> None:
    """Two structures in two small cities have a name and a light each, and drawing them in two
    parts gives the same scenarios."""
    from scenarios.suites.new_scenarios import NewScenarios

    fresh = NewScenarios(kind="unit", structures=("straight", "curve"), seeds=(1, 2), size_m=500.0)
    drawn = fresh.drawn(0, 5)
    assert {one.id for one in drawn} <= {
        "straight-1-000",
        "curve-1-000",
        "straight-2-000",
        "curve-2-000",
        "straight-1-001",
    }
    assert len({one.light for one in drawn}) == len(drawn) >= 3
    assert [*fresh.drawn(0, 2), *fresh.drawn(2, 3)] == drawn


def test_drawn_events_have_the_rules_of_the_suite() -> None:
    """Decoys in which nothing happens, and events that need the robot to give way, require a pace;
    others require none. Without it, a learner is rewarded for stopping."""
    from scenarios.suites.new_scenarios import new_scenarios

    drawn = new_scenarios("reactive", (1000,), ("overtaking", "lateral", "queueing"), 500.0, True)
    paces = {
        one.structure + "-decoy" * bool(one.decoy_of): one.go_on_mps for one in drawn.drawn(0, 6)
    }
    assert {name for name, pace in paces.items() if pace == DRAWN_GO_ON_MPS} == {
        "overtaking",
        "overtaking-decoy",
        "lateral-decoy",
    }
    assert paces["lateral"] == paces["queueing"] == paces["queueing-decoy"] == 0.0


class SeeingExpert:
    """An expert with a camera of its own."""

    manifest = Manifest("sees", camera=CameraSpec(width=32, height=32), goal="final_point")

    def reset(self, episode_id: str, seed: int) -> None:
        self.shapes: list[tuple[int, ...]] = []

    def act(self, observation: Observation) -> Command:
        assert observation.rgb is not None
        self.shapes.append(observation.rgb.shape)
        return Command(1.4, 0.0)


def test_an_expert_that_sees_keeps_its_own_camera(collection: Collection) -> None:
    """The expert gets pictures of its own size, and the data set has those of the collecting
    camera."""
    expert = SeeingExpert()
    kept = DemoOptions(camera=CameraSpec(width=64, height=48), rate_hz=4.0, unsolved=True)
    shown = demonstration_here(collection.ways[0], PolicyCaller.of(expert), kept)
    assert set(expert.shapes) == {(32, 32, 3)}
    assert len(expert.shapes) == len(shown) > 5
    assert shown.colours.sum() == len(shown) * 64 * 48 * 3


class StandingExpert:
    """An expert that never drives."""

    manifest = Manifest("stands", camera=None, goal="route_point")

    def reset(self, episode_id: str, seed: int) -> None:
        """Keeps no state."""

    def act(self, observation: Observation) -> Command:
        return Command(0.0, 0.0)


class Learner(StandingExpert):
    """A learner that drives straight ahead by its picture alone. asked: the ticks of an episode."""

    manifest = Manifest(
        "learner", rate_hz=5.0, camera=CameraSpec(width=64, height=48), goal="route_point"
    )

    def reset(self, episode_id: str, seed: int) -> None:
        self.asked: list[int] = []

    def act(self, observation: Observation) -> Command:
        assert observation.privileged is None
        assert observation.rgb is not None and observation.rgb.shape == (48, 64, 3)
        self.asked.append(observation.tick)
        return Command(0.7, 0.1)


def test_a_learner_drives_and_the_expert_labels_each_row(collection: Collection) -> None:
    """The expert is queried at every picture, and the learner drives its share of the time in
    stretches of seconds. The same seed gives the same bytes."""
    kept = DemoOptions(
        camera=CameraSpec(width=64, height=48), noise=0.6, learner="learner", unsolved=True
    )
    way = msgspec.structs.replace(collection.ways[0], time_limit_s=20.0)
    learner = Learner()
    shown = demonstration_here(way, PolicyCaller.of(StandingExpert()), kept, learner)
    assert learner.asked == sorted(set(learner.asked)) and len(learner.asked) == len(shown) > 20
    assert not shown.command.any()
    assert 0.3 < shown.disturbed.mean() < 0.9
    begins = np.flatnonzero(shown.disturbed[1:] & ~shown.disturbed[:-1])
    assert begins.size and shown.disturbed.sum() / (begins.size + 1) >= 5
    assert (
        shown.state[1:, 0][shown.disturbed[:-1]].mean()
        > 0.4
        > shown.state[1:, 0][~shown.disturbed[:-1]].mean()
    )
    assert (
        demonstration_here(way, PolicyCaller.of(StandingExpert()), kept, learner).encoded()
        == shown.encoded()
    )


def test_an_exploring_learner_drives_alone_and_its_commands_have_rewards(
    collection: Collection,
) -> None:
    """Rows have the driven commands; rewards cover its progress, the time and its end."""
    kept = DemoOptions(
        camera=CameraSpec(width=64, height=48), explore=0.3, learner="learner", unsolved=True
    )
    way = msgspec.structs.replace(collection.ways[0], time_limit_s=6.0)
    demonstrator = Demonstrator(
        PolicyCaller.of(StandingExpert()), kept, "route_point", PolicyCaller.of(Learner())
    )
    outcome = run_episode(way, demonstrator, EpisodeOptions(goal="route_point", seed=0))
    assert outcome.log is not None
    shown = Demonstration.decoded(
        demonstrator.encoded_demonstration(way, outcome.record, outcome.log), way.id
    )
    assert not shown.disturbed.any() and shown.driven.min() != shown.driven.max()
    np.testing.assert_allclose(shown.command, outcome.log.command[::4], atol=1e-6)
    plain = np.isclose(shown.command, [0.7, 0.1]).all(axis=1)
    assert 0.2 < plain.mean() < 1.0
    total = float(tick_rewards(outcome.record, outcome.log).sum())
    assert shown.reward.shape == (len(shown), 1)
    assert float(shown.reward.sum()) == pytest.approx(total, abs=1e-3)


BESIDE = """
import os, signal
from cosim.core.state import Command
from cosim.spec.camera import CameraSpec
from cosim.spec.manifest import Manifest


class Learner:
    manifest = Manifest("learner", rate_hz=5.0, camera=CameraSpec(width=64, height=48), goal="route_point")

    def reset(self, episode_id, seed):
        self.asked = 0

    def act(self, observation):
        self.asked += 1
        return Command(0.7, 0.3 - 0.1 * (self.asked % 7))


class Another(Learner):
    manifest = Manifest(f"learner-{os.getpid()}", rate_hz=5.0, camera=Learner.manifest.camera, goal="route_point")


class Dies(Learner):
    def act(self, observation):
        os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_learner_drives_the_same_in_every_process(
    collection: Collection, cosim: Cosim, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two processes with a user's learner write the bytes of one process. The data set names the
    learner, and is not resumed with another one or with an edited one."""
    (collection.folder / "beside.py").write_text(BESIDE)
    some = ("--scenario", "way-0", "--scenario", "way-2")
    asked = (
        "collect",
        "ways.json",
        *some,
        "--camera",
        "64x48",
        "--noise",
        "0.6",
        "--unsolved",
        "--out",
        "taught",
    )
    result = cosim(*asked, "--learner", "beside:Learner", "--jobs", "2", cwd=collection.folder)
    assert result.returncode == 0, result.stderr
    monkeypatch.syspath_prepend(collection.folder)
    learner = load_policy("beside:Learner")
    kept = DemoOptions(
        camera=CameraSpec(width=64, height=48), noise=0.6, learner="beside:Learner", unsolved=True
    )
    for way in (collection.ways[0], collection.ways[2]):
        shown = demonstration_here(way, load_policy("orca"), kept, learner)
        assert shown.disturbed.any()
        assert (
            collection.folder / f"taught/runs/00/episodes/{way.id}" / DEMONSTRATION
        ).read_bytes() == shown.encoded()
    about = json.loads((collection.folder / "taught/meta/cosim.json").read_bytes())
    assert (about["learner"], about["learner_source"]) == ("learner", learner.source_hash)

    result = cosim(*asked, "--learner", "beside:Another", "--resume", cwd=collection.folder)
    assert (
        result.returncode == 2
        and "its learner is beside:Learner, and this command has beside:Another" in result.stderr
    )
    (collection.folder / "beside.py").write_text(BESIDE.replace("0.7", "0.6"))
    result = cosim(*asked, "--learner", "beside:Learner", "--resume", cwd=collection.folder)
    assert (
        result.returncode == 2 and "is of another data set: its learner_source is" in result.stderr
    )


def test_a_learner_with_another_camera_is_refused() -> None:
    """The message says what to set. A learner beside an expert with its own camera is refused, and
    so is a blind learner."""
    asked = DemoOptions(camera=CameraSpec(width=80, height=60), noise=0.6, learner="learner")
    expert, learner = PolicyCaller.of(StandingExpert()), PolicyCaller.of(Learner())
    with pytest.raises(
        UsageError,
        match=r"front, 80 x 60 px.* give --camera 64x48 --fov 75 --mount front --rate 5$",
    ):
        Demonstrator(expert, asked, None, learner)
    learner.manifest = replace(learner.manifest, camera=CameraSpec(80, 60, crop=(0, 20, 80, 60)))
    with pytest.raises(
        UsageError,
        match=r"crop 0 20 80 60, 5 Hz, collected is .*: such pictures cannot be collected",
    ):
        Demonstrator(expert, asked, None, learner)
    learner.manifest = replace(learner.manifest, camera=asked.camera, goals=("final_point", "none"))
    with pytest.raises(
        UsageError, match="cannot do with goal 'route_point': give --goal, one of final_point, none"
    ):
        Demonstrator(expert, asked, None, learner)
    with pytest.raises(
        UsageError,
        match="'stands' is no policy that drives by one camera, speeds, a goal and recorded sensors alone",
    ):
        Demonstrator(expert, asked, None, PolicyCaller.of(StandingExpert()))
    with pytest.raises(UsageError, match="expert 'sees' sees by a camera of its own"):
        Demonstrator(
            PolicyCaller.of(SeeingExpert()),
            msgspec.structs.replace(asked, rate_hz=4.0),
            None,
            learner,
        )
    with pytest.raises(SpecError, match="give --noise"):
        msgspec.structs.replace(asked, noise=0.0)


def test_the_lerobot_package_reads_a_data_set(collection: Collection, packed: Packed) -> None:
    """The package's LeRobotDataset has the rows and pictures that are packed. Skipped where lerobot
    is not installed."""
    datasets = pytest.importorskip(
        "lerobot.datasets.lerobot_dataset", reason="lerobot is not installed"
    )
    read = datasets.LeRobotDataset("cosim/demos", root=collection.folder / "demos")
    assert len(read) == len(packed)
    for row, one in ((row, read[row]) for row in range(len(read))):
        np.testing.assert_array_equal(one["action"].numpy(), packed.command[row])
        picture = 255.0 * one["observation.images.front"].numpy().transpose(1, 2, 0)
        assert np.abs(picture - packed.frames[row]).mean() < 2.0


@pytest.mark.parametrize(
    "words",
    [
        ("collect", "reactive", "--episodes", "1", "--out", "d"),
        ("dataset", "pack", "demos", "-o", "d.npz"),
    ],
)
def test_a_data_set_without_pyarrow_is_refused_in_one_line(
    tmp_path: Path, words: tuple[str, ...]
) -> None:
    """The error names the package and the command that installs it; exit code 3, no traceback."""
    code = (
        "import sys, importlib.util\nfound = importlib.util.find_spec\nimportlib.util.find_spec = "
        "lambda name, *rest: None if name == 'pyarrow' else found(name, "
        "*rest)\nsys.modules['pyarrow'] = None\nfrom cosim.__main__ import main\nsys.exit(main())"
    )
    command = [sys.executable, "-c", code, *words]
    done = subprocess.run(
        command,
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])},
        capture_output=True,
        text=True,
    )
    assert (
        done.returncode == 3
        and "pip install 'pyarrow<24'" in done.stderr
        and "Traceback" not in done.stderr
    ), done
