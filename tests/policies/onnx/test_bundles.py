"""ONNX bundles as policies: loaded completely, or refused with a reason before anything is driven."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from onnx import TensorProto, helper

import cosim
from cosim.core.errors import UsageError
from cosim.core.state import WaypointCommand
from cosim.episode.manifest_checks import with_goal
from cosim.policies.load import load_policy, shipped_bundles
from cosim.policies.onnx.graph import Graph
from cosim.policies.onnx.manifest import file_facts
from cosim.policies.onnx.policy import (
    OnnxBatchPolicy,
    OnnxPolicy,
    example_differences,
    example_observation,
)
from tests.support.graphs import (
    PICTURE,
    POINT,
    bundle,
    echo,
    external,
    graph_bytes,
    port,
    tiny_graph,
)

NAN = np.full((6 * 4 * 8, 1), np.nan, np.float32)
HALF_NAN = np.array([1.0, np.nan], np.float16)
FOREIGN = [helper.make_node("Bar", ["obs"], ["action"], domain="com.foo")]
OVERFLOWS = [helper.make_node("Exp", ["obs"], ["action"])]
CONDITIONAL = [helper.make_node("Reshape", ["obs", "shape"], ["action"])]
OBS = port("obs", 1, 5, 2)
WAYPOINTS = {"what": "waypoints", "name": "action"}
ONES: dict[str, Any] = {
    "inputs": {"obs": {"what": "constant", "value": 1000}},
    "goal": "none",
    "camera": None,
}
REFUSED: dict[str, tuple[bytes, dict[str, Any], str]] = {
    "no-goal-input": (
        tiny_graph(),
        {"inputs": {"obs": PICTURE}},
        "the graph wants 'goal' float32 (any, 2), of which",
    ),
    "other-input": (
        tiny_graph(),
        {"inputs": {"obs": PICTURE, "goal": POINT, "mask": {"what": "mask"}}},
        "inputs: the graph has no input 'mask'. Valid choices: obs, goal",
    ),
    "three-frames": (
        tiny_graph(),
        {"inputs": {"obs": {**PICTURE, "frames": 3}, "goal": POINT}},
        "inputs.obs: the graph wants float32 (any, 6, 4, 8), and layout 'N(TC)HW' gives (1, "
        "9, 4, 8)",
    ),
    "three-values": (
        tiny_graph(),
        {"inputs": {"obs": PICTURE, "goal": {**POINT, "values": ["distance", "cos", "sin"]}}},
        "inputs.goal: the graph wants float32 (any, 2), and the manifest gives 1 x 3 numbers",
    ),
    "other-output": (
        tiny_graph(),
        {"output": {**WAYPOINTS, "name": "plan"}},
        "the graph has no output 'plan'. Valid choices: action",
    ),
    "sixth-waypoint": (
        tiny_graph(),
        {"output": {**WAYPOINTS, "index": 5}},
        "'action' holds 5 waypoints, and waypoint 5 (from 0) is followed",
    ),
    "four-columns": (
        tiny_graph(),
        {"output": {**WAYPOINTS, "columns": ["x", "y", "cos", "sin"]}},
        "'action' is (1, 5, 2), and its last axis should hold the 4 columns",
    ),
    "bytes": (
        echo(1, 6, 4, 8, kind=TensorProto.UINT8),
        {"inputs": {"obs": PICTURE}, "goal": "none"},
        "inputs.obs: the graph wants uint8 (1, 6, 4, 8), whole numbers: say scale 1, without "
        "mean and std",
    ),
    "nan": (
        tiny_graph(bright=NAN),
        {},
        "model.onnx: weights are NaN or infinite: bright; export it again",
    ),
    "half-nan": (tiny_graph(unused=HALF_NAN), {}, "weights are NaN or infinite: unused"),
    "text": (b"once upon a time", {}, "model.onnx: is no ONNX graph: is no protobuf message"),
    "empty": (b"", {}, "model.onnx: is no ONNX graph: has no graph; 0 bytes"),
    "cut": (tiny_graph()[:-40], {}, "ends too early"),
    "garbled": (
        tiny_graph().replace(b"goal", b"go\xffl"),
        {},
        "model.onnx: is refused by onnxruntime (1.",
    ),
    "operator": (
        graph_bytes(FOREIGN, [OBS], [port("action", 1, 5, 2)]),
        ONES,
        "com.foo:Bar(-1) is not a registered",
    ),
    "opset": (
        graph_bytes(OVERFLOWS, [OBS], [port("action", 1, 5, 2)], opset=99),
        ONES,
        "): ONNX Runtime only",
    ),
    "overflow": (
        graph_bytes(OVERFLOWS, [OBS], [port("action", 1, 5, 2)]),
        ONES,
        "in a grey street the policy output 'action' of the graph holds NaN or infinity: are "
        "its weights intact?",
    ),
    "reshape": (
        graph_bytes(
            CONDITIONAL, [OBS], [port("action", "n", "m", 2)], {"shape": np.array([1, 7, 2])}
        ),
        ONES,
        "cannot be run by onnxruntime",
    ),
    "text-output": (
        echo(1, 2, kind=TensorProto.STRING),
        ONES,
        "'obs' is a tensor(string): inputs and outputs are",
    ),
    "size": (
        tiny_graph(),
        {"files": {"model.onnx": {"bytes": 7, "blake2b": "0" * 64}}},
        "is another file than the manifest of 'tiny' says: files.model.onnx.bytes is 7 there",
    ),
    "hash": (
        tiny_graph(),
        {"files": {"model.onnx": {"bytes": len(tiny_graph()), "blake2b": "0" * 64}}},
        "files.model.onnx.blake2b is 0000",
    ),
    "no-weights": (
        tiny_graph(),
        {
            "model": "gnm.onnx",
            "source": "https://example.org",
            "files": {"gnm.onnx": {"bytes": 7, "blake2b": "0" * 64}},
        },
        "policy 'tiny': gnm.onnx is missing, 7 bytes, BLAKE2b 0000",
    ),
    "rate": (tiny_graph(), {"rate_hz": 7}, "usual policy rates are 4, 5, 10, 20 Hz"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_bundle_that_cannot_be_driven_is_refused_when_it_is_loaded(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], name: str
) -> None:
    """One message has the bundle, the place, what was found and what is required; the runtime
    prints nothing."""
    graph, fields, expected = REFUSED[name]
    place = bundle(tmp_path / "net", graph, **fields)
    with pytest.raises(UsageError) as caught:
        load_policy(f"onnx:{place}")
    assert f"policy 'onnx:{place}': " in str(caught.value) and expected in str(caught.value)
    assert capfd.readouterr() == ("", "")


def test_a_folder_without_a_manifest_is_no_bundle(tmp_path: Path) -> None:
    """The message names the missing file."""
    with pytest.raises(UsageError, match=r"no bundle: has no manifest\.json"):
        load_policy(f"onnx:{tmp_path}")


def test_a_bundle_is_a_policy_from_python_too(tmp_path: Path) -> None:
    """Its waypoint is the share of the goal that the graph answers, in units of its manifest."""
    policy = cosim.load_policy(
        f"onnx:{bundle(tmp_path, tiny_graph(bright=np.zeros((192, 1), np.float32)))}"
    )
    policy.reset("a", 0)
    answer = policy.act(example_observation(policy.manifest))
    assert isinstance(answer, WaypointCommand)
    np.testing.assert_allclose(answer.waypoints, [[0.2 * i, 0.0] for i in range(1, 6)], atol=1e-6)
    assert answer.v_mps == pytest.approx(0.6 / 0.25)


def test_the_hash_of_a_bundle_covers_all_that_decides_its_answers(tmp_path: Path) -> None:
    """It covers manifest, graph, and external weights, but not the folder's path."""

    def hash_of(place: Path) -> str:
        return load_policy(f"onnx:{place}").source_hash

    first = hash_of(bundle(tmp_path / "a", tiny_graph()))
    assert first == hash_of(bundle(tmp_path / "b", tiny_graph())) and len(first) == 16
    assert first != hash_of(
        bundle(tmp_path / "b", tiny_graph(bright=np.ones((192, 1), np.float32)))
    )
    assert first != hash_of(bundle(tmp_path / "b", tiny_graph(), version="2"))
    beside = external(tmp_path / "c")
    before = hash_of(beside)
    data = bytearray((beside / "model.onnx.data").read_bytes())
    data[2] ^= 1
    (beside / "model.onnx.data").write_bytes(data)
    assert hash_of(beside) != before


def test_weights_are_found_in_a_separate_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Weights that are not next to the manifest come from $COSIM_WEIGHTS and are checked against
    their hash."""
    files = {"tiny.onnx": {"bytes": len(tiny_graph()), "blake2b": file_facts(tiny_graph()).blake2b}}
    place = bundle(tmp_path / "net", tiny_graph(), model="tiny.onnx", files=files)
    (tmp_path / "weights").mkdir()
    shutil.move(place / "model.onnx", tmp_path / "weights" / "tiny.onnx")
    monkeypatch.setenv("COSIM_WEIGHTS", str(tmp_path / "weights"))
    assert load_policy(f"onnx:{place}").manifest.name == "tiny"
    (tmp_path / "weights" / "tiny.onnx").write_bytes(
        tiny_graph(bright=np.ones((192, 1), np.float32))
    )
    with pytest.raises(UsageError, match="is another file than the manifest of 'tiny' says"):
        load_policy(f"onnx:{place}")


def test_a_bundle_in_the_policies_folder_has_a_plain_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its name is that of its folder, and is listed where a name is unknown."""
    (tmp_path / "bundles").mkdir()
    bundle(tmp_path / "bundles" / "tiny", tiny_graph())
    monkeypatch.setattr("cosim.policies.load.shipped_bundles", lambda: shipped_bundles(tmp_path))
    assert load_policy("tiny").manifest.name == "tiny"
    with pytest.raises(UsageError, match=r"unknown policy 'tinny'.* tiny.*Did you mean tiny\?"):
        load_policy("tinny")


def test_a_run_with_goals_that_a_bundle_cannot_take_is_refused(tmp_path: Path) -> None:
    """The run is accepted only if the manifest declares a substitute for the goals."""
    driver = load_policy(f"onnx:{bundle(tmp_path / 'a', tiny_graph())}")
    with pytest.raises(
        UsageError, match="wants goals route_point or final_point or random_point, and gets 'image'"
    ):
        with_goal(driver.manifest, "image")
    inputs = {"obs": PICTURE, "goal": {**POINT, "missing": [1, 0]}}
    other = load_policy(f"onnx:{bundle(tmp_path / 'b', tiny_graph(), inputs=inputs)}")
    assert with_goal(other.manifest, "image").goal == "image"


def test_a_provider_that_the_runtime_lacks_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The message lists the available ones."""
    monkeypatch.setenv("COSIM_ONNX_PROVIDERS", "NoSuchExecutionProvider")
    with pytest.raises(
        UsageError,
        match=r"has no NoSuchExecutionProvider here\. Valid choices: .*CPUExecutionProvider",
    ):
        load_policy(f"onnx:{bundle(tmp_path, tiny_graph())}")


def test_a_graph_off_the_cpu_answers_for_many_episodes_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each has its own history and answer; with a fixed first axis, and on the CPU, they are
    queried one by one."""
    place = bundle(tmp_path / "a", tiny_graph())
    fixed = bundle(tmp_path / "b", echo(1, 5, 2), **ONES, output=WAYPOINTS)
    assert not load_policy(f"onnx:{place}").batches
    monkeypatch.setenv("COSIM_ONNX_PROVIDERS", "AzureExecutionProvider,CPUExecutionProvider")
    assert not load_policy(f"onnx:{fixed}").batches and load_policy(f"onnx:{place}").batches
    together = OnnxBatchPolicy(place)
    alone = {name: OnnxPolicy(place) for name in "abc"}
    draws = np.random.default_rng(0)
    for name, policy in alone.items():
        together.reset(name, 0)
        policy.reset(name, 0)
    for step in range(3):
        if step == 2:
            together.on_reset("b")
            alone["b"].on_reset()
        grey = example_observation(together.manifest)
        observations = [
            replace(grey, episode=name, rgb=draws.integers(0, 255, (32, 32, 3)).astype(np.uint8))
            for name in "cab"
        ]
        answers = together.act_batch(observations)
        for one, answer in zip(observations, answers, strict=True):
            np.testing.assert_allclose(answer, alone[one.episode].act(one), rtol=1e-6)
    together.ended("a")


@pytest.fixture
def bundle_with_example(tmp_path: Path) -> Callable[..., OnnxPolicy]:
    """Return a bundle with an example of these arrays."""

    def policy_with_example(**arrays: np.ndarray[Any, Any]) -> OnnxPolicy:
        place = bundle(tmp_path / "net", tiny_graph())
        np.savez(place / "example.npz", **arrays)
        return OnnxPolicy(place)

    return policy_with_example


def test_the_example_of_a_bundle_is_compared_with_its_graph(
    bundle_with_example: Callable[..., OnnxPolicy],
) -> None:
    """The largest difference of each output is reported, and so is an example that does not fit."""
    obs = np.ones((1, 6, 4, 8), np.float32)
    goal = np.array([[1, 0]], np.float32)
    right = bundle_with_example(obs=obs, goal=goal)
    answer = right.graph.run({"obs": obs, "goal": goal}, ["action"])["action"]
    expected = {"expected.action": answer + np.float32(0.5)}
    assert example_differences(
        bundle_with_example(obs=obs, goal=goal, **expected)
    ) == pytest.approx({"action": 0.5})
    with pytest.raises(UsageError, match=r"example\.npz: has no array 'goal'"):
        example_differences(bundle_with_example(obs=obs, **expected))
    with pytest.raises(UsageError, match="does not fit the graph"):
        example_differences(bundle_with_example(obs=obs[:, :3], goal=goal, **expected))


def test_the_hash_of_a_bundle_depends_on_the_processors_rounding(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A runtime that rounds otherwise makes another policy of the same files."""
    folder = bundle(tmp_path / "tiny", tiny_graph())
    here = OnnxPolicy(folder).digest
    run = Graph.run

    def next_number(graph: Graph, *words: Any) -> dict[str, Any]:
        return {
            name: np.nextafter(output, output.dtype.type(9))
            for name, output in run(graph, *words).items()
        }

    assert OnnxPolicy(folder).digest == here
    monkeypatch.setattr(Graph, "run", next_number)
    assert OnnxPolicy(folder).digest != here
