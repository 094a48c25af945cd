"""The network with a memory, `cosim train --network sidewalk`. Needs PyTorch, which the lock files
leave out."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from cosim.core.errors import CosimError, RunError, UsageError
from cosim.core.packed_demos import FREE_RAYS, LABELLED_PEOPLE, Packed
from cosim.core.progress import ignore
from cosim.core.state import Doing
from cosim.episode.interfaces import Observation
from cosim.policies.load import load_policy
from cosim.policies.onnx.feeding import Feeder
from cosim.policies.onnx.graph import TensorPort
from cosim.policies.onnx.manifest import BundleManifest
from cosim.results.run_folder import read_records
from cosim.spec.goal import PointGoal
from cosim.spec.robot import COURIER
from scenarios.episodes.labels import DOINGS, EVENT_NUMBERS, FREE_RANGE_M
from scenarios.tools.dataset.pack import pack_raw
from tests.conftest import Cosim

torch = pytest.importorskip("torch", reason="PyTorch is not installed: see `cosim train --help`")
ort = pytest.importorskip("onnxruntime")
onnx = pytest.importorskip("onnx")

from torch.nn import functional  # noqa: E402

from cosim.learning import memory_network  # noqa: E402
from cosim.learning.bundle import manifest_of, source_of, write_bundle  # noqa: E402
from cosim.learning.graph import load_parameters  # noqa: E402
from cosim.learning.memory_graph import MEMORY_INPUTS, build_memory_graph  # noqa: E402
from cosim.learning.memory_network import (  # noqa: E402
    DETAIL,
    EVENTS,
    GROWN,
    HALVED,
    MEMORY,
    SIZE_PX,
    forward_steps,
    new_memory_parameters,
    picture_of,
    views,
)
from cosim.learning.network import CRUISE_MPS, WAYPOINTS, plan  # noqa: E402
from cosim.learning.settings import Training  # noqa: E402
from cosim.learning.sidewalk import (  # noqa: E402
    FREE_UNIT_M,
    HAND,
    SIDEWALK,
    doing_loss,
    free_loss,
    near_loss,
)
from cosim.learning.training import _batches, train  # noqa: E402
from cosim.learning.windows import (  # noqa: E402
    WindowExamples,
    Windows,
    _drives_at_something,
    mirror_windows,
    split_episodes,
)

CPU = torch.device("cpu")
WIDTH_PX, HEIGHT_PX = SIZE_PX
BRISK = Training(network="sidewalk", steps=2, batch=2, device="cpu")
COLLECT = (
    "collect unit --event crosswalk --cities 900:901 --city-size 500 --episodes 2 "
    "--labels --format raw --camera 320x180 --astray 0.5"
)
NAMES = ("a", "b", "c", "d", "d-decoy", "e", "f", "g", "h", "i", "j", "k", "l", "m", "n", "o")


def saved_examples(demos: Packed, path: Path) -> WindowExamples:
    """Windows of demonstrations, by way of a file."""
    demos.save(path)
    return WindowExamples([path], BRISK, CPU)


def street(length: int = 6, labels: bool = True) -> Packed:
    """Episodes of random pictures, which do not determine expert and labels."""
    draws = np.random.default_rng(3)
    count = len(NAMES) * length

    def numbers(*shape: int) -> np.ndarray:
        return draws.uniform(-0.6, 0.6, (count, *shape)).astype(np.float32)

    near = numbers(LABELLED_PEOPLE, 6)
    near[:, :, 0] = np.arange(LABELLED_PEOPLE) < 2
    truth = {
        "near": near,
        "free": np.abs(numbers(FREE_RAYS)),
        "scene": np.ones((count, 2), np.float32),
    }
    return Packed(
        frames=draws.integers(0, 256, (count, HEIGHT_PX, WIDTH_PX, 3), np.uint8),
        state=numbers(2),
        goal=20.0 * numbers(2),
        command=numbers(2),
        waypoints=numbers(WAYPOINTS, 2),
        driven=np.full(count, WAYPOINTS, np.int32),
        disturbed=np.zeros(count, bool),
        episode=np.repeat(np.arange(len(NAMES), dtype=np.int32), length),
        frame=np.tile(np.arange(length, dtype=np.int32), len(NAMES)),
        meta={
            "rate_hz": 5.0,
            "waypoint_s": 0.2,
            "goal": "route_point",
            "policy": ["orca"],
            "learner": [""],
            "robot": "courier",
            "scenarios": list(NAMES),
            "weathers": ["clear", "rain"] * (len(NAMES) // 2),
            "camera": {"width": WIDTH_PX, "height": HEIGHT_PX, "fov_deg": 60.0, "mount": "front"},
        },
        **(truth if labels else {}),
    )


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("packed") / "street.npz"
    street().save(path)
    return path


def same(first: Windows, second: Windows) -> bool:
    """Compare all tensors of two batches."""

    def tensors(batch: Windows) -> list[torch.Tensor]:
        return [*batch.seen, *(value for name, value in vars(batch).items() if name != "seen")]

    pairs = zip(tensors(first), tensors(second), strict=True)
    return all(torch.equal(one, other) for one, other in pairs)


def session_of(graph: bytes) -> object:
    return ort.InferenceSession(graph, providers=["CPUExecutionProvider"])


@pytest.mark.parametrize("keeps", [True, False])
def test_a_step_by_step_memory_equals_that_of_the_whole_window(data: Path, keeps: bool) -> None:
    """The graph, queried per picture with its memory, gives PyTorch's plans of the window; without
    memory each picture decides alone."""
    parameters = new_memory_parameters(7)
    examples = WindowExamples([data], BRISK, CPU)
    batch = examples.windows(examples.held_out[:1], 6)
    pictures = picture_of(batch.seen.each(lambda one: one[0]))
    seen = views(pictures).each(lambda one: one[None])
    for rounded, exact in zip(batch.seen, seen, strict=True):
        torch.testing.assert_close(rounded, exact, rtol=0.0, atol=0.51 / 255.0)
    with torch.no_grad():
        window = forward_steps(
            parameters, seen, batch.goal, batch.speeds, torch.zeros(1, MEMORY), keeps
        )
    wanted = plan(window.plan).numpy()
    session = session_of(build_memory_graph(parameters, keeps))
    memory = np.zeros((1, MEMORY), np.float32)
    for step in range(6):
        inputs = {name: getattr(batch, name)[:, step].numpy() for name in ("goal", "speeds")}
        inputs["pictures"] = pictures[step : step + 1].numpy()
        found, memory, near = session.run(  # type: ignore[attr-defined]
            ["plan", "memory_next", "near"], inputs | {"memory": memory}
        )
        np.testing.assert_allclose(found[0], wanted[step], atol=1e-4)
        np.testing.assert_allclose(near[0], window.near[step].numpy(), atol=1e-4)
        assert memory.any() == keeps
    np.testing.assert_allclose(memory, window.memory.numpy(), atol=1e-4)


def test_a_run_feeds_the_graph_the_windows_of_training(data: Path) -> None:
    """Observations become the pictures, goals and speeds of an episode's first window, and a reset
    sets the memory to 0."""
    packed = street()
    examples = WindowExamples([data], BRISK, CPU)
    batch = examples.windows(np.array([0]), 6)
    manifest = msgspec.convert(
        manifest_of("sidewalk", packed.meta, "", SIDEWALK.inputs), BundleManifest
    )
    ports = {
        name: TensorPort(name, np.dtype(np.float32), shape) for name, shape in MEMORY_INPUTS.items()
    }
    feeder = Feeder(manifest.inputs, ports, 0)
    for row in range(6):
        v_mps, w_radps, x_m, y_m = map(float, (*packed.state[row], *packed.goal[row]))
        rgb = packed.frames[row]
        fed = feeder.feed(
            Observation(row, 0.0, rgb, v_mps, w_radps, COURIER, goal=PointGoal(x_m, y_m))
        )
        for name in ("goal", "speeds"):
            np.testing.assert_allclose(fed[name][0], getattr(batch, name)[0, row], atol=1e-6)
        for shown, trained in zip(
            views(torch.from_numpy(fed["pictures"])), batch.seen, strict=True
        ):
            torch.testing.assert_close(shown[0], trained[0, row], rtol=0.0, atol=0.51 / 255.0)
        assert fed["memory"].any() == (row > 0)
        feeder.remember({"memory_next": np.ones((1, MEMORY), np.float32)})
    feeder.clear()
    assert not feeder.feed(
        Observation(0, 0.0, packed.frames[0], 0.0, 0.0, COURIER, goal=PointGoal(1.0, 0.0))
    )["memory"].any()


def test_a_stopped_and_resumed_training_has_the_same_bits(data: Path, tmp_path: Path) -> None:
    """Two steps at once and one by one give the same graph and curve, in a valid bundle of at most
    25 MB."""
    assert train([data], tmp_path / "one", BRISK, False, ignore).whole
    first = train([data], tmp_path / "other", replace(BRISK, minutes=1e-9), False, ignore)
    assert first.step == 1
    assert train([data], tmp_path / "other", BRISK, True, ignore).whole
    for name in ("model.onnx", "curve.csv", "manifest.json"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "other" / name).read_bytes()
    assert (tmp_path / "one/model.onnx").stat().st_size <= 25e6
    policy = load_policy(f"onnx:{tmp_path / 'one'}")
    assert policy.manifest.name == "sidewalk" and not policy.manifest.privileged


def test_a_mean_over_no_held_out_row_is_no_number(tmp_path: Path) -> None:
    """Without a signal in the held-out episodes, their share of right signals is NaN in the curve,
    and is not printed."""
    packed = street()
    path = tmp_path / "nothing.npz"
    replace(packed, scene=np.zeros_like(packed.scene)).save(path)
    said: list[str] = []
    train([path], tmp_path / "net", BRISK, False, lambda words, _=None: said.append(words))
    names, *_, row = (tmp_path / "net/curve.csv").read_text().splitlines()
    curve = dict(zip(names.split(","), row.split(","), strict=True))
    assert curve["signals_right"] == curve["events_right"] == "nan"
    assert float(curve["held_out_loss"]) > 0.0
    assert any("held out loss" in one for one in said)
    assert not any("right nan" in one or "signals right" in one for one in said)


def test_windows_stay_in_their_episode(data: Path) -> None:
    """A window longer than its episode ends with it, and its first picture is repeated."""
    packed = street()
    examples = WindowExamples([data], BRISK, CPU)
    batch = examples.windows(np.array([6, 9]), 5)
    assert batch.valid.tolist() == [[True] * 5, [True] * 3 + [False] * 2]
    assert len(batch.speed) == 8 and len(batch.near) == 8
    np.testing.assert_array_equal(
        batch.turn.numpy(), packed.command[[6, 7, 8, 9, 10, 9, 10, 11], 1].clip(-0.65, 0.65)
    )
    for seen in batch.seen:
        assert torch.equal(seen[0, 0, :3], seen[0, 0, 3:])
        assert torch.equal(seen[1, 0, :3], seen[0, 2, 3:])


def test_both_views_are_shifted_mirrored_and_lit_alike(data: Path) -> None:
    """The detail, halved, is that part of the whole in each augmented window."""
    seen = WindowExamples([data], BRISK, CPU).drawn(0, 0, 40).seen
    rows, columns = (slice(one.start // HALVED, one.stop // HALVED) for one in DETAIL)
    whole = seen.whole[..., rows, columns].flatten(0, 1)
    detail = seen.detail.flatten(0, 1)
    halved = functional.avg_pool2d(detail, HALVED)
    unclipped = functional.max_pool2d(detail, HALVED) < 1.0
    assert unclipped.float().mean() > 0.5
    torch.testing.assert_close(halved[unclipped], whole[unclipped], rtol=0.0, atol=0.01)


def test_a_share_of_the_windows_shows_each_picture_twice(data: Path) -> None:
    """In these, all pairs of pictures are equal; in the others only the first one may be."""
    batch = WindowExamples([data], BRISK, CPU).drawn(0, 0, 40)
    earlier, newest = batch.seen.whole[:, 1:, :3], batch.seen.whole[:, 1:, 3:]
    equal = (earlier == newest).flatten(2).all(2)
    valid = batch.valid[:, 1:]
    frozen = torch.stack([row[there].all() for row, there in zip(equal, valid, strict=True)])
    moving = torch.stack([row[there].any() for row, there in zip(equal, valid, strict=True)])
    assert torch.equal(frozen, moving) and 8 <= int(frozen.sum()) <= 24


def test_an_expert_that_turns_almost_on_the_spot_does_not_wait(tmp_path: Path) -> None:
    """Commands of 0 m/s are stops, and 0.01 m/s, the slowest turn, is a speed to be learned."""
    packed = street()
    packed.command[:, 0] = np.where(np.arange(len(packed)) % 2, 0.01, 0.0)
    packed.save(tmp_path / "d.npz")
    batch = WindowExamples([tmp_path / "d.npz"], BRISK, CPU).windows(np.array([0]), 6)
    assert batch.stop.tolist() == [1.0, 0.0] * 3
    assert batch.speed[1::2].tolist() == pytest.approx([0.01 / CRUISE_MPS] * 3)


def test_the_mirror_exchanges_left_and_right_in_labels_too(data: Path) -> None:
    """Twice it changes nothing; once people change sides, and free distances their order."""
    examples = WindowExamples([data], BRISK, CPU)
    batch = examples.windows(np.array([0, 6]), 4)
    mirrored = mirror_windows(batch)
    back = mirror_windows(mirrored)
    assert same(batch, back)
    torch.testing.assert_close(mirrored.near[..., 2], -batch.near[..., 2])
    torch.testing.assert_close(mirrored.free[:, 0], batch.free[:, -1])
    torch.testing.assert_close(mirrored.near[..., 1], batch.near[..., 1])


def test_a_batch_depends_on_seed_and_step_alone(data: Path) -> None:
    """The same step gives the same windows, and another step gives others."""
    examples = WindowExamples([data], BRISK, CPU)
    third, other, again = (examples.drawn(0, step, 3) for step in (3, 4, 3))
    assert same(third, again)
    for ours, others in zip(third.seen, other.seen, strict=True):
        assert not torch.equal(ours, others)
        assert float(ours.min()) >= 0.0 and float(ours.max()) <= 1.0


def test_windows_in_which_the_robot_drives_at_something_near_are_oversampled(
    tmp_path: Path,
) -> None:
    """Without such a row, an episode of 15 has about a fifteenth of the windows; with the only one,
    it has over a quarter."""
    demos = street(length=4)
    demos.state[:, 0] = demos.command[:, 0] = 1.4
    demos.free[:] = 10.0
    examples = saved_examples(demos, tmp_path / "first.npz")
    episode = np.unique(examples.episode[examples.learned])[0]
    demos.goal[demos.episode == episode] = 5.0
    far = saved_examples(demos, tmp_path / "far.npz")
    demos.free[(demos.episode == episode) & (demos.frame == 2), FREE_RAYS // 2 + 1] = 1.9
    close = saved_examples(demos, tmp_path / "close.npz")
    before, after = (
        float((one.drawn(0, 0, 400).goal[:, 0].abs() == 0.5).all(1).float().mean())
        for one in (far, close)
    )
    assert 0.02 < before < 0.15 and 0.25 < after < 0.42


@pytest.mark.parametrize(
    ("speed_mps", "ray", "free_m", "counts"),
    [
        (1.4, FREE_RAYS // 2, 2.0, True),
        (1.4, FREE_RAYS // 2 - 1, 2.0, True),
        (1.4, FREE_RAYS // 2, 2.2, False),
        (1.4, FREE_RAYS // 2 + 2, 0.5, False),
        (0.4, FREE_RAYS // 2, 0.5, False),
        (1.4, FREE_RAYS // 2, 0.0, False),
    ],
)
def test_something_is_near_if_it_is_reached_straight_ahead_within_one_and_a_half_seconds(
    speed_mps: float, ray: int, free_m: float, counts: bool
) -> None:
    """It must be at most 7.5 degrees to the side. The robot must be on free ground, and faster than
    0.5 m/s."""
    demos = street(length=2)
    demos.state[:, 0] = 0.0
    demos.free[:] = 10.0
    demos.state[3, 0], demos.free[3, ray] = speed_mps, free_m
    assert np.flatnonzero(_drives_at_something(demos)).tolist() == [3] * counts


def test_windows_are_not_drawn_around_a_learners_own_faults(tmp_path: Path) -> None:
    """Rows with rewards have the command that was driven. Other rows count, also with
    `--no-auxiliary`."""
    demos = street(length=4)
    demos.state[:, 0] = 1.4
    demos.free[:] = 1.0
    reward = np.full((len(demos), 1), np.nan, np.float32)
    reward[demos.episode < 8] = 0.0
    replace(demos, reward=reward).save(tmp_path / "rewards.npz")
    examples = WindowExamples([tmp_path / "rewards.npz"], replace(BRISK, auxiliary=False), CPU)
    assert set(examples._close) == set(examples.learned) - set(np.flatnonzero(demos.episode < 8))


def test_an_error_of_a_free_distance_counts_relative_to_it() -> None:
    """A metre too much costs nine times more at 1 m than at 9 m, and most at 0 m."""
    at_0, at_1, at_9 = (torch.full((1, FREE_RAYS), far_m) for far_m in (0.0, 1.0, 9.0))

    def cost(labels: torch.Tensor, more_m: float) -> float:
        return float(free_loss((labels + more_m) / FREE_UNIT_M, labels))

    assert cost(at_1, 1.0) == pytest.approx(0.5 - 0.05)
    assert cost(at_9, 1.0) == pytest.approx(0.5 * 0.1**2 / 0.1)
    assert cost(at_0, 1.0) == pytest.approx(1.0 - 0.05)
    assert cost(at_0, 0.0) == cost(at_9, 0.0) == 0.0


def test_ablations_remove_only_training_episodes() -> None:
    """Held-out episodes and shares follow from names, with decoys on the side of their events and
    in any order of files; a smaller share is a subset of a larger one."""
    names = [f"{kind}-{k}{end}" for kind in "ab" for k in range(200) for end in ("", "-decoy")]
    weathers = ["clear", "clear", "rain", "rain"] * 200

    def split(**changes: object) -> tuple[np.ndarray, np.ndarray]:
        return split_episodes(names, weathers, replace(BRISK, **changes))  # type: ignore[arg-type]

    held_out, used = split()
    assert (held_out[::2] == held_out[1::2]).all() and 0.04 < held_out.mean() < 0.16
    assert (used == ~held_out).all()
    tenth, half = split(share=0.1)[1], split(share=0.5)[1]
    assert 0.05 < tenth.mean() < 0.15 and (half | ~tenth).all()
    assert (half[::2] == half[1::2]).all()
    names.reverse()
    assert (split(share=0.5)[1] == half[::-1]).all()
    names.reverse()
    assert not split(decoys=False)[1][1::2].any()
    assert not split(weather=False)[1][np.array(weathers) == "rain"].any()
    for changes in ({"share": 0.1}, {"decoys": False}, {"weather": False}):
        assert (split(**changes)[0] == held_out).all()


def test_numbers_of_labels_are_those_of_the_simulator() -> None:
    """A raised hand, the classes of activities and events, and the unit of free distances have the
    simulator's values."""
    assert 1 + DOINGS.index("stop") == HAND and Doing.__args__ == DOINGS  # type: ignore[attr-defined]
    assert len(DOINGS) == memory_network.DOINGS
    assert max(EVENT_NUMBERS.values()) + 1 == EVENTS and FREE_UNIT_M == FREE_RANGE_M


def test_missing_people_do_not_contribute_to_the_loss() -> None:
    """Without a person only presence is trained; with one the place is, too."""
    labels = torch.zeros(1, LABELLED_PEOPLE, 6)
    near = torch.zeros(1, 4, 6, requires_grad=True)
    near_loss(near, labels).backward()
    assert near.grad is not None and not near.grad[..., 1:].any() and near.grad[..., 0].all()
    labels[0, 0] = torch.tensor([1.0, 5.0, 1.0, 0.0, 0.0, HAND])
    near.grad = None
    near_loss(near, labels).backward()
    assert near.grad[0, 0, 1:4].all() and not near.grad[0, 1:, 1:].any()


def test_the_activity_of_each_person_is_learned() -> None:
    """Without a person the loss is 0; with one it falls with the odds of the right activity."""
    labels = torch.zeros(1, LABELLED_PEOPLE, 6)
    doing = torch.zeros(1, 4, len(DOINGS), requires_grad=True)
    assert doing_loss(doing, labels).item() == 0.0
    labels[0, 1] = torch.tensor([1.0, 5.0, 1.0, 0.0, 0.0, 1.0 + DOINGS.index("wave")])
    doing_loss(doing, labels).backward()
    assert doing.grad is not None and not doing.grad[0, [0, 2, 3]].any()
    assert (doing.grad[0, 1] < 0.0).nonzero().flatten().tolist() == [DOINGS.index("wave")]


def test_settings_of_ablations_are_checked(data: Path, tmp_path: Path) -> None:
    """Unknown networks, shares above 1, ablations of `small`, missing labels and another ablation
    on resuming are refused."""
    with pytest.raises(CosimError, match="unknown network 'large'"):
        Training(network="large")
    with pytest.raises(UsageError, match="--share must be at most 1"):
        replace(BRISK, share=1.5)
    with pytest.raises(UsageError, match="--network small has no memory: use sidewalk"):
        Training(memory=False)
    street(labels=False).save(tmp_path / "plain.npz")
    with pytest.raises(RunError, match="cosim collect --labels, or train with --no-auxiliary"):
        WindowExamples([tmp_path / "plain.npz"], BRISK, CPU)
    plain = replace(BRISK, auxiliary=False, steps=1, share=0.5)
    mixed = WindowExamples([data, tmp_path / "plain.npz"], plain, CPU)
    assert mixed.windows(np.array([0]), 2).scene.shape == (2, 0)
    assert train([tmp_path / "plain.npz"], tmp_path / "net", plain, False, ignore).whole
    with pytest.raises(RunError, match=r"of another training: share 0\.5, not 1\.0"):
        train([tmp_path / "plain.npz"], tmp_path / "net", replace(plain, share=1.0), True, ignore)


def test_rows_with_rewards_are_weighted_by_values(data: Path, tmp_path: Path) -> None:
    """Only training rows with rewards are reweighted, reproducibly; the driving bundle and such
    rows are required, figures are recorded."""
    plain = WindowExamples([data], BRISK, CPU)
    write_bundle(tmp_path, new_memory_parameters(7), plain, BRISK, "")
    rows = street()
    meta = rows.meta | {"policy": [""], "explorer": ["sidewalk"]}
    reward = (rows.frames[:, 45, 80, :1] > 127).astype(np.float32)
    replace(rows, meta=meta, reward=reward).save(tmp_path / "own.npz")
    tuned = replace(BRISK, begin=tmp_path, values=1.0)
    first, again = (SIDEWALK.examples([data, tmp_path / "own.npz"], tuned, CPU) for _ in "ab")
    own = first.learned[first.learned >= len(rows)]
    others = np.setdiff1d(np.arange(len(first.weight)), own)
    assert (first.weight[others] == 1.0).all() and first.weight[own].std() > 0.05
    assert abs(float(first.weight[own].mean()) - 1.0) < 1e-4
    assert torch.equal(first.weight, again.weight)
    source = source_of(first.meta, 0)
    assert "on what orca drove and on what sidewalk drove with rewards; the value exp" in source
    with pytest.raises(UsageError, match="--values needs --from"):
        replace(tuned, begin=None)
    with pytest.raises(RunError, match="0 training rows have rewards"):
        SIDEWALK.examples([data], tuned, CPU)


def test_prefetched_batches_are_the_same(data: Path) -> None:
    """A thread draws the batches of the steps in order."""
    examples = WindowExamples([data], BRISK, CPU)
    for ahead, alone in zip(
        _batches(examples, BRISK, 2, 5, True), _batches(examples, BRISK, 2, 5, False), strict=True
    ):
        assert same(ahead, alone)


def test_layers_that_an_earlier_bundle_lacks_begin_at_0(tmp_path: Path) -> None:
    """Layers that an earlier `sidewalk` lacks are 0, and all others are those of the file."""
    parameters = new_memory_parameters(7)
    graph = onnx.load_from_string(build_memory_graph(parameters))
    kept = [one for one in graph.graph.initializer if one.name.split(".")[0] not in GROWN]
    del graph.graph.initializer[:]
    graph.graph.initializer.extend(kept)
    onnx.save(graph, tmp_path / "model.onnx")
    found = load_parameters(tmp_path / "model.onnx", new_memory_parameters(0), SIDEWALK.grown)
    for name, value in parameters.items():
        begun = torch.zeros_like(value) if name.split(".")[0] in GROWN else value
        assert torch.equal(found[name], begun)


@pytest.mark.engine
def test_from_the_simulator_to_a_drive(tmp_path: Path, cosim: Cosim) -> None:
    """Demonstrations with labels are collected in two pieces, packed and trained on; the bundle
    drives and teaches in DAgger."""
    words = COLLECT.split()
    begun = cosim(*words, "--out", "demos", "--minutes", "1e-9", cwd=tmp_path)
    assert begun.returncode == 4 and "The time is up after 0 episodes" in begun.stderr
    done = cosim(*words, "--out", "demos", "--resume", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    parts = pack_raw([tmp_path / "demos"], tmp_path / "d.npz", part=1)
    assert [one.path.name for one in parts] == ["d-000.npz", "d-001.npz"]
    training = "train d-000.npz d-001.npz -o net --network sidewalk --steps 1 --batch 1"
    trained = cosim(*training.split(), "--device", "cpu", cwd=tmp_path)
    assert trained.returncode == 0, trained.stderr
    driving = "run unit --scenario crosswalk-7013 --policy onnx:net --out run"
    ran = cosim(*driving.split(), cwd=tmp_path)
    (record,) = read_records(tmp_path / "run")
    assert record.status == "done" and not record.manifest.privileged, ran.stderr
    shutil.rmtree(tmp_path / "demos")
    again = ("--noise", "0.7", "--learner", "onnx:net", "--unsolved", "--out", "demos")
    taught = cosim(*words, *again, cwd=tmp_path)
    assert taught.returncode == 0, taught.stderr
