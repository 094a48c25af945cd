"""Training a small policy on demonstrations: `cosim train`. Needs PyTorch, which the lock files
leave out."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from cosim.core.errors import CosimError
from cosim.core.packed_demos import Packed
from cosim.core.progress import ignore
from cosim.episode.interfaces import Observation
from cosim.policies.load import load_policy
from cosim.policies.onnx.feeding import Feeder
from cosim.policies.onnx.graph import TensorPort
from cosim.policies.onnx.manifest import BundleManifest
from cosim.spec.camera import CameraSpec
from cosim.spec.goal import PointGoal
from cosim.spec.robot import COURIER
from tests.conftest import Cosim

torch = pytest.importorskip("torch", reason="PyTorch is not installed: see `cosim train --help`")
onnx = pytest.importorskip("onnx")

from cosim.learning.bundle import bundle_facts, manifest_of, source_of  # noqa: E402
from cosim.learning.examples import Examples, mirror  # noqa: E402
from cosim.learning.graph import INPUTS, build_graph, load_parameters  # noqa: E402
from cosim.learning.network import CRUISE_MPS, HEIGHT_PX, WAYPOINTS, WIDTH_PX, new_parameters  # noqa: E402
from cosim.learning.settings import Training  # noqa: E402
from cosim.learning.small import SMALL  # noqa: E402
from cosim.learning.training import train  # noqa: E402

CPU = torch.device("cpu")
BRISK = Training(steps=4, batch=4, device="cpu")


def street(episodes: int = 12, length: int = 4, seed: int = 1) -> Packed:
    """Episodes in which a white person left or right makes the expert turn away, and a dark one
    ahead makes it stop."""
    draws = np.random.default_rng(seed)
    count = episodes * length
    scene = np.repeat(np.arange(episodes) % 3, length)
    frames = draws.integers(90, 110, (count, HEIGHT_PX, WIDTH_PX, 3)).astype(np.uint8)
    frames[scene == 0, 20:70, 10:60] = 250
    frames[scene == 1, 20:70, 100:150] = 250
    frames[scene == 2, 20:70, 60:100] = 10
    turn = np.array([-0.4, 0.4, 0.0], np.float32)[scene]
    speed = np.array([1.4, 1.4, 0.0], np.float32)[scene]
    ahead = 0.2 * np.arange(1, WAYPOINTS + 1, dtype=np.float32)
    way = np.stack([speed[:, None] * ahead, (speed * turn)[:, None] * ahead**2 / 2], 2)
    return Packed(
        frames=frames,
        state=np.stack([speed, turn], 1),
        goal=np.tile(np.float32([12.0, 0.0]), (count, 1)),
        command=np.stack([speed, turn], 1),
        waypoints=way,
        driven=np.full(count, WAYPOINTS, np.int32),
        disturbed=np.zeros(count, bool),
        episode=np.repeat(np.arange(episodes, dtype=np.int32), length),
        frame=np.tile(np.arange(length, dtype=np.int32), episodes),
        meta={
            "rate_hz": 5.0,
            "waypoint_s": 0.2,
            "goal": "route_point",
            "policy": ["orca"],
            "learner": [""],
            "robot": "courier",
            "camera": {"width": WIDTH_PX, "height": HEIGHT_PX, "fov_deg": 60.0, "mount": "front"},
        },
    )


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("packed") / "street.npz"
    street().save(path)
    return path


@pytest.fixture(scope="module")
def learned(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bundle trained on that street."""
    folder = tmp_path_factory.mktemp("learned")
    assert train(
        [data], folder, Training(steps=60, batch=12, rate=2e-3, device="cpu"), False, ignore
    ).whole
    return folder


def steps_of(folder: Path) -> list[str]:
    """Return the first column of a curve."""
    return [line.partition(",")[0] for line in (folder / "curve.csv").read_text().splitlines()]


def plans(folder: Path, rows: Sequence[int]) -> np.ndarray:
    """Return (rows, WAYPOINTS, 4) answers of the shipped graph to pictures of another street."""
    ort = pytest.importorskip("onnxruntime")
    path = folder / "unseen.npz"
    street(episodes=3, length=1, seed=9).save(path)
    batch = Examples([path], 0, CPU).rows(np.array(rows))
    session = ort.InferenceSession(folder / "model.onnx")
    inputs = [one.name for one in session.get_inputs()]
    return np.concatenate(
        [
            session.run(None, {name: getattr(batch, name)[i : i + 1].numpy() for name in inputs})[0]
            for i in rows
        ]
    )


def test_training_learns_to_turn_away_and_to_stop(learned: Path) -> None:
    """For pictures of an unseen street it turns to the free side, and for a person ahead it stops
    at a speed of 0."""
    left, right, ahead = plans(learned, [0, 1, 2])
    assert left[0, 3] < -0.1 and right[0, 3] > 0.1
    assert min(left[0, 2], right[0, 2]) > 0.5 * CRUISE_MPS
    np.testing.assert_array_equal(ahead, 0.0)


def test_the_bundle_is_accepted_by_runs(learned: Path) -> None:
    """Its manifest has the graph's size and hash, it is at most 8 MB, and its example gives the
    expected answers."""
    manifest = msgspec.json.decode((learned / "manifest.json").read_bytes(), type=BundleManifest)
    graph = (learned / "model.onnx").read_bytes()
    facts = manifest.files["model.onnx"]
    digest = hashlib.blake2b(graph, digest_size=32).hexdigest()
    assert (facts.bytes, facts.blake2b) == (len(graph), digest) and len(graph) < 8_000_000
    assert (manifest.goal, manifest.rate_hz, manifest.camera.spec.size) == (
        "route_point",
        5.0,
        (160, 90),
    )
    example = np.load(learned / "example.npz")
    session = pytest.importorskip("onnxruntime").InferenceSession(graph)
    answer = session.run(["plan"], {name: example[name] for name in manifest.inputs})[0]
    np.testing.assert_allclose(answer, example["expected.plan"], atol=1e-4)


def test_the_bundles_camera_equals_that_of_the_demonstrations() -> None:
    """Size, field of view, place and crop are the same."""
    camera = {
        "width": 160,
        "height": 120,
        "fov_deg": 60.0,
        "mount": "front",
        "crop": [0, 30, 160, 120],
        "depth": False,
    }
    manifest = msgspec.convert(
        manifest_of("small", street().meta | {"camera": camera}, "small policy", SMALL.inputs),
        BundleManifest,
    )
    assert manifest.camera.spec == CameraSpec(160, 120, 60.0, crop=(0, 30, 160, 120))


def test_a_stopped_and_resumed_training_equals_an_uninterrupted_one(
    data: Path, tmp_path: Path
) -> None:
    """Stopped after each step and resumed, it writes the same graph to the byte, and the same
    curve."""
    assert train([data], tmp_path / "whole", BRISK, False, ignore).whole
    pieces = 1
    while not train([data], tmp_path / "pieces", replace(BRISK, minutes=1e-9), True, ignore).whole:
        pieces += 1
    assert pieces == BRISK.steps
    for name in ("model.onnx", "curve.csv"):
        assert (tmp_path / "pieces" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


def test_a_training_killed_in_its_last_evaluation_loses_no_step(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At the time limit the checkpoint is written before the evaluation."""

    def killed(*_: object) -> dict[str, float]:
        raise KeyboardInterrupt

    brisk = replace(BRISK, minutes=1e-9)
    with monkeypatch.context() as patch:
        patch.setattr("cosim.learning.training.NETWORKS", {"small": replace(SMALL, errors=killed)})
        with pytest.raises(KeyboardInterrupt):
            train([data], tmp_path, brisk, False, ignore)
    assert train([data], tmp_path, brisk, True, ignore).step == 2


def test_a_training_at_its_time_limit_leaves_a_bundle_and_its_curve(
    data: Path, tmp_path: Path, cosim: Cosim
) -> None:
    """A too short --minutes exits with 4, and leaves a loadable bundle with its step, a curve, and
    a way to resume."""
    words = ("train", str(data), "-o", "small", "--batch", "4", "--device", "cpu", "--seed", "3")
    done = cosim(*words, "--steps", "3", "--minutes", "1e-9", cwd=tmp_path)
    assert (
        done.returncode == 4 and "stopped at step 1 of 3. Continue with --resume" in done.stderr
    ), done.stderr
    assert steps_of(tmp_path / "small") == ["step", "1"]
    manifest = json.loads((tmp_path / "small/manifest.json").read_bytes())
    assert manifest["source"] == "cosim train, seed 3, on what orca drove; step 1 of 3"
    assert load_policy(f"onnx:{tmp_path / 'small'}").manifest.name == "small"
    done = cosim(*words, "--resume", cwd=tmp_path)
    assert done.returncode == 0 and "more steps: --resume --steps 6" in done.stderr, done.stderr
    assert json.loads((tmp_path / "small/manifest.json").read_bytes())["source"].endswith(
        "on what orca drove"
    )


def test_a_finished_training_is_continued_with_more_steps(data: Path, tmp_path: Path) -> None:
    """Four steps, then six, give one reproducible curve and graph; fewer steps than are done are
    refused."""
    for name in ("one", "other"):
        assert train([data], tmp_path / name, BRISK, False, ignore).whole
        before = (tmp_path / name / "model.onnx").read_bytes()
        assert train([data], tmp_path / name, replace(BRISK, steps=6), True, ignore) == (6, 6)
        assert (tmp_path / name / "model.onnx").read_bytes() != before
    for name in ("model.onnx", "curve.csv"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "other" / name).read_bytes()
    assert steps_of(tmp_path / "one") == ["step", "4", "6"]
    assert bundle_facts(tmp_path / "one").name == "small"
    source = json.loads((tmp_path / "one/manifest.json").read_bytes())["source"]
    assert source.endswith("on what orca drove; 4 steps, continued to 6")
    with pytest.raises(
        CosimError, match=r"6 steps are done, and --steps asks for 5 in all: give more than 6"
    ):
        train([data], tmp_path / "one", replace(BRISK, steps=5), True, ignore)


def test_training_can_start_from_the_shipped_graph_alone(
    learned: Path, data: Path, tmp_path: Path
) -> None:
    """The graph holds the initial parameters, so that at a negligible rate it stays as it is."""
    parameters = load_parameters(learned / "model.onnx", new_parameters(0))
    assert train(
        [data], tmp_path / "on", replace(BRISK, begin=learned, rate=1e-12), False, ignore
    ).whole
    for name, value in load_parameters(tmp_path / "on" / "model.onnx", parameters).items():
        torch.testing.assert_close(value, parameters[name], atol=1e-6, rtol=0)
    drawn = new_parameters(3)
    (tmp_path / "drawn.onnx").write_bytes(build_graph(drawn))
    assert all(
        torch.equal(value, drawn[name])
        for name, value in load_parameters(tmp_path / "drawn.onnx", parameters).items()
    )


def test_the_mirror_exchanges_left_and_right_everywhere(data: Path) -> None:
    """It exchanges sides in picture, goal, speeds and waypoints, and twice it changes nothing."""
    batch = Examples([data], 0, CPU).rows(np.array([0, 4]))
    mirrored = mirror(batch)
    back = mirror(mirror(batch))
    assert all(torch.equal(value, getattr(back, name)) for name, value in vars(batch).items())
    bright = mirrored.pictures[0] > 0.8
    assert torch.equal(bright, batch.pictures[1] > 0.8)
    torch.testing.assert_close(mirrored.turn[0], batch.turn[1])
    torch.testing.assert_close(mirrored.way[0], batch.way[1])


def test_a_run_feeds_the_graph_its_training_inputs(tmp_path: Path) -> None:
    """An observation becomes its row of training numbers with history, at an episode's start and
    for far goals too."""
    draws = np.random.default_rng(5)
    packed = street(episodes=2, length=6)
    goals = draws.uniform(-30.0, 30.0, (12, 2)).astype(np.float32)
    packed = replace(
        packed, frames=draws.integers(0, 256, packed.frames.shape, np.uint8), goal=goals
    )
    packed.save(tmp_path / "street.npz")
    trained_on = Examples([tmp_path / "street.npz"], 0, CPU).rows(np.arange(12))
    manifest = msgspec.convert(
        manifest_of("small", packed.meta, "small policy", SMALL.inputs), BundleManifest
    )
    ports = {name: TensorPort(name, np.dtype(np.float32), shape) for name, shape in INPUTS.items()}
    feeder = Feeder(manifest.inputs, ports, 0)
    for row, (rgb, speeds, goal) in enumerate(
        zip(packed.frames, packed.state, packed.goal, strict=True)
    ):
        if packed.frame[row] == 0:
            feeder.clear()
        v_mps, w_radps, x_m, y_m = map(float, (*speeds, *goal))
        fed = feeder.feed(
            Observation(row, 0.0, rgb, v_mps, w_radps, COURIER, goal=PointGoal(x_m, y_m))
        )
        for name, tensor in fed.items():
            np.testing.assert_allclose(tensor[0], getattr(trained_on, name)[row], atol=1e-6)


def test_a_bundle_records_its_experts_and_drivers(
    learned: Path, data: Path, tmp_path: Path
) -> None:
    """It lists, for all training files, experts and driving learners, and the network that it began
    with."""
    again = street()
    replace(again, meta=again.meta | {"policy": ["orca-disturbed"], "learner": ["first"]}).save(
        tmp_path / "again.npz"
    )
    meta = Examples([data, tmp_path / "again.npz"], 0, CPU).meta
    assert source_of(street().meta, 0) == "cosim train, seed 0, on what orca drove"
    expected = (
        "cosim train, seed 1, on what orca, orca-disturbed drove, and would have done where "
        "first drove"
    )
    assert source_of(meta, 1) == expected
    assert source_of(meta, 1, bundle_facts(learned)) == f"{expected}; begun with small"


def test_a_batch_depends_on_seed_and_step_alone(data: Path) -> None:
    """The same step gives the same batch in any order, another step others, with values within 0
    and 1."""
    examples = Examples([data], 0, CPU)
    third = examples.drawn(0, 3, 8)
    other, again = examples.drawn(0, 4, 8), examples.drawn(0, 3, 8)
    assert all(torch.equal(value, getattr(again, name)) for name, value in vars(third).items())
    assert not torch.equal(third.pictures, other.pictures)
    assert float(third.pictures.min()) >= 0.0 and float(third.pictures.max()) <= 1.0
    assert not torch.equal(third.pictures, examples.rows(examples.learned[:8]).pictures)


def test_rows_where_the_expert_stops_are_oversampled(
    tmp_path: Path,
) -> None:
    """Stops are a sixteenth of all rows and a third of the drawn ones; without stops the sampling
    is unchanged."""
    going = street(length=16)
    going.state[:, 0] = going.command[:, 0] = 1.4
    going.save(tmp_path / "goes.npz")
    assert Examples([tmp_path / "goes.npz"], 0, CPU).drawn(0, 0, 64).stop.sum() == 0
    going.command[going.frame == 9, 0] = 0.0
    going.save(tmp_path / "stops.npz")
    share = float(Examples([tmp_path / "stops.npz"], 0, CPU).drawn(0, 0, 400).stop.mean())
    assert 0.25 < share < 0.45


def test_held_out_episodes_are_whole_and_never_trained_on(data: Path) -> None:
    """Each episode is on exactly one side."""
    examples = Examples([data, data], 0, CPU)
    episode = np.repeat(np.arange(24), 4)
    learned, held_out = (
        {*episode[rows].tolist()} for rows in (examples.learned, examples.held_out)
    )
    assert not learned & held_out and learned | held_out == {*range(24)} and held_out
    assert len(examples.learned) + len(examples.held_out) == 96


@pytest.mark.parametrize(
    ("wrong", "expected"),
    [
        (
            "size",
            r"other\.npz: pictures of 80 x 90 pixels, wanted are 160 x 90: cosim collect --camera 160x90",
        ),
        ("goal", r"other\.npz: goals are no points \(none\): cosim collect --goal route_point"),
        ("turn", r"other\.npz: the expert turns at 1\.20 rad/s, and this network at 0\.65 at most"),
        ("rate", r"other\.npz: rate_hz is 10\.0, and 5\.0 in .*street\.npz"),
        ("file", r"other\.npz: no packed demonstrations"),
        ("begin", r"model\.onnx: cannot be read: No such file"),
        ("graph", r"model\.onnx: no ONNX graph"),
        ("folder", r"holds a training: continue it by --resume"),
        ("another", r"of another training: seed 0, not 1"),
        ("other data", r"of another training: data [0-9a-f]{16}, not [0-9a-f]{16}:"),
        ("other begin", r"of another training: from None, not [0-9a-f]{16}:"),
        ("device", r"device 'abacus' is not to be had: .* try cpu"),
        ("steps", r"--steps must be above 0, not 0"),
    ],
)
def test_unusable_training_data_is_refused(
    learned: Path, data: Path, tmp_path: Path, wrong: str, expected: str
) -> None:
    """One line names file and field, what was found and what is required, and nothing is written."""
    packed = street(episodes=2)
    other = tmp_path / "other.npz"
    out = tmp_path / "out"
    if wrong == "size":
        packed = replace(packed, frames=packed.frames[:, :, ::2])
    elif wrong == "goal":
        packed = replace(packed, goal=packed.goal * np.nan, meta=packed.meta | {"goal": "none"})
    elif wrong == "turn":
        packed = replace(packed, command=packed.command * np.float32([1.0, 3.0]))
    elif wrong == "rate":
        packed = replace(packed, meta=packed.meta | {"rate_hz": 10.0})
    packed.save(other)
    if wrong == "file":
        other.write_bytes(b"PK")
    again = wrong in ("another", "other data", "other begin")
    if wrong == "folder" or again:
        train([data], out, replace(BRISK, minutes=1e-9), False, ignore)
    if wrong == "graph":
        (tmp_path / "model.onnx").write_bytes(b"\xff\xff")
    before = sorted(out.rglob("*"))
    files = [data, other] if wrong in ("size", "goal", "turn", "rate", "file") else [data]
    files = [other] if wrong == "other data" else files
    with pytest.raises(CosimError, match=expected):
        training = replace(
            BRISK,
            begin=tmp_path
            if wrong in ("begin", "graph")
            else learned
            if wrong == "other begin"
            else None,
            device="abacus" if wrong == "device" else "cpu",
            seed=int(wrong == "another"),
            steps=0 if wrong == "steps" else BRISK.steps,
        )
        train(
            files,
            out,
            training,
            again,
            ignore,
        )
    assert sorted(out.rglob("*")) == before


def test_training_needs_only_pytorch_numpy_and_onnx() -> None:
    """It imports no other dependency of the project, so that a GPU host's own Python can run it."""
    code = (
        "import sys, cosim.learning.training; print(sorted({m.partition('.')[0] for m in "
        "sys.modules} & {'msgspec', 'shapely', 'pandas', 'scipy', 'cv2', 'av', 'typer', 'rich', "
        "'onnxruntime', 'libsumo'}))"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == "[]"
