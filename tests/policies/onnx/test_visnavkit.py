"""Exports of visnavkit are read unchanged: graph, metadata and example inputs side by side."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from onnx import ValueInfoProto, helper

from cosim.core.errors import UsageError
from cosim.core.state import WaypointCommand
from cosim.policies.load import load_policy
from cosim.policies.onnx.policy import example_differences, example_observation, read_bundle
from tests.support.graphs import graph_bytes, port

BOUNDS = np.array([[[0.0, -0.1, -0.1, 0.0, -0.9], [0.2, 0.1, 0.1, 2.8, 0.9]]], np.float32)
WINDOW = {
    "vision": (1, 4, 3, 18, 32),
    "route_patch": (1, 4, 80, 80),
    "goal": (1, 4, 3),
    "ego": (1, 4, 2),
    "action_bounds": (1, 2, 5),
}
FRAME = {"vision": (1, 3, 24, 32), "feature_buffer": (1, 3, 2), "goal": (1, 3)}


def exported(
    folder: Path, name: str, graph: bytes, shapes: Mapping[str, tuple[int, ...]], **metadata: Any
) -> Path:
    """The three files of an export; example inputs are 0, those of action bounds are the bounds."""
    folder.mkdir(exist_ok=True)
    (folder / f"{name}.onnx").write_bytes(graph)
    example = {one: np.zeros(shape, np.float32) for one, shape in shapes.items()}
    np.savez(
        folder / f"{name}.inputs.npz",
        **(example | ({"action_bounds": BOUNDS} if "action_bounds" in shapes else {})),
    )
    defaults = {
        "exp_name": "flowpilot dst",
        "model": "FlowPilotDST",
        "precision": "fp32",
        "seed": 0,
        "opset": 17,
        "onnx_sha256": hashlib.sha256(graph).hexdigest(),
        "input_names": list(shapes),
        "input_shapes": dict(shapes),
        "input_dtypes": dict.fromkeys(shapes, "float32"),
    }
    (folder / f"{name}.metadata.json").write_text(json.dumps(defaults | metadata))
    return folder


def ports(shapes: Mapping[str, tuple[int, ...]]) -> list[ValueInfoProto]:
    return [port(name, *shape) for name, shape in shapes.items()]


def window_export(folder: Path, **metadata: Any) -> Path:
    """A graph of two plans of eight steps: every step of both is [the mean of vision, of the goal's
    distances, of the route, the largest of the bounds, the newest w]; the second is the more
    probable."""
    columns = ("light", "far_m", "route", "fast", "turn")
    nodes = [
        helper.make_node("ReduceMean", ["vision"], ["light"], keepdims=0),
        helper.make_node("Gather", ["goal", "zero"], ["far"], axis=2),
        helper.make_node("ReduceMean", ["far"], ["far_m"], keepdims=0),
        helper.make_node("ReduceMean", ["route_patch"], ["route"], keepdims=0),
        helper.make_node("ReduceMax", ["action_bounds"], ["fast"], keepdims=0),
        helper.make_node("Slice", ["ego", "last", "end", "axes"], ["now"]),
        helper.make_node("ReduceSum", ["now"], ["turn"], keepdims=0),
        *(helper.make_node("Unsqueeze", [one, "zero"], [f"{one}1"]) for one in columns),
        helper.make_node("Concat", [f"{one}1" for one in columns], ["row"], axis=0),
        helper.make_node("Mul", ["row", "both"], ["modes"]),
        helper.make_node("Identity", ["scores"], ["probs"]),
    ]
    both = np.ones((1, 2, 8, 5), np.float32) * np.array([0.5, 1.0], np.float32)[None, :, None, None]
    weights = {
        "zero": np.array([0]),
        "last": np.array([3, 1]),
        "end": np.array([4, 2]),
        "axes": np.array([1, 2]),
        "both": both,
        "scores": np.array([[0.2, 0.7]], np.float32),
    }
    graph = graph_bytes(
        nodes, ports(WINDOW), [port("modes", 1, 2, 8, 5), port("probs", 1, 2)], weights
    )
    shapes = {"modes": (1, 2, 8, 5), "probs": (1, 2)}
    return exported(
        folder,
        "dst",
        graph,
        WINDOW,
        **{"output_shapes": shapes, "config": {"plan_len_seconds": 0.4}} | metadata,
    )


def frame_export(folder: Path) -> Path:
    """A graph of two modes of five points (x, y, v), whose buffer counts the answers: x of every
    point of the second, better one is the sum of the buffer's first column, y the goal's sine."""
    flat = 5 * 2 * 3 + 1
    way = np.zeros((2, 2 * flat), np.float32)
    way[0, flat : flat + 15 : 3], way[1, flat + 1 : flat + 15 : 3] = 1.0, 1.0
    score = np.zeros((1, 2 * flat), np.float32)
    score[0, -1] = 1.0
    nodes = [
        helper.make_node("ReduceSum", ["feature_buffer", "one"], ["summed"], keepdims=0),
        helper.make_node("Gather", ["summed", "zero"], ["answers"], axis=1),
        helper.make_node("Gather", ["goal", "two"], ["side"], axis=1),
        helper.make_node("Concat", ["answers", "side"], ["both"], axis=1),
        helper.make_node("MatMul", ["both", "way"], ["flat"]),
        helper.make_node("Add", ["flat", "score"], ["plan"]),
        helper.make_node("ReduceMean", ["vision"], ["light"], keepdims=0),
        helper.make_node("Mul", ["light", "none"], ["dark"]),
        helper.make_node("Add", ["dark", "token"], ["feat_out"]),
    ]
    weights = {
        "one": np.array([1]),
        "zero": np.array([0]),
        "two": np.array([2]),
        "way": way,
        "score": score,
        "none": np.zeros((1, 2), np.float32),
        "token": np.array([[1, 5]], np.float32),
    }
    graph = graph_bytes(
        nodes, ports(FRAME), [port("plan", 1, 2 * flat), port("feat_out", 1, 2)], weights
    )
    common = {"plan_len_seconds": 2, "plan_len_points": 5, "use_full_pose": True}
    return exported(
        folder,
        "policy",
        graph,
        FRAME,
        output_shapes={"plan": (1, 2 * flat), "feat_out": (1, 2)},
        config={"common": common},
    )


def test_the_graph_of_a_window_is_driven_by_the_first_speeds_of_its_best_plan(
    tmp_path: Path,
) -> None:
    """Every slot of 50 ms has frames, patches, goals and speeds; the bounds are as exported, and
    the goal is the run's."""
    driver = load_policy(f"onnx:{window_export(tmp_path)}")
    manifest = driver.manifest
    assert (manifest.name, manifest.rate_hz, manifest.goal) == (
        "flowpilot-dst",
        20.0,
        "route_patch",
    )
    assert manifest.camera is not None and manifest.camera.size == (32, 18)
    driver.reset("a", 0)
    answer = driver.act(replace(example_observation(manifest), w_radps=0.25))
    assert isinstance(answer, WaypointCommand) and answer.w_radps == pytest.approx(0.25)
    assert answer.v_mps == pytest.approx(2.5)  # 2.8, clipped
    np.testing.assert_allclose(answer.waypoints[:, :2], [[128 / 255, 20.0]] * 8, rtol=1e-5)


def test_the_graph_of_a_frame_gets_its_own_features_back(tmp_path: Path) -> None:
    """It gets the rows of the last three answers, zeros before, and the best-scored plan is
    followed at its time."""
    driver = load_policy(f"onnx:{frame_export(tmp_path)}")
    rule = driver.manifest.waypoints
    assert (rule.index, rule.dt_s, driver.manifest.goal) == (2, 0.5, "route_point")
    driver.reset("a", 0)
    seen = example_observation(driver.manifest)
    answers = [driver.policy.act(seen) for _ in range(5)]
    assert [float(np.asarray(one)[0, 0]) for one in answers] == [0, 1, 2, 3, 3]
    driver.reset("b", 0)
    assert float(np.asarray(driver.policy.act(seen))[0, 0]) == 0


def test_the_path_of_a_graph_names_one_of_several_exports(tmp_path: Path) -> None:
    """A folder of several is refused with their names, and metadata of an engine are not those of a
    graph."""
    frame_export(window_export(tmp_path))
    (tmp_path / "dst.fp16.metadata.json").write_text("{}")
    with pytest.raises(
        UsageError, match=r"several bundles: name one of .*dst\.onnx, .*policy\.onnx"
    ):
        load_policy(f"onnx:{tmp_path}")
    policy = load_policy(f"onnx:{tmp_path / 'policy.onnx'}")
    assert policy.manifest.waypoints.index == 2
    assert read_bundle(tmp_path / "policy.onnx").example == tmp_path / "policy.inputs.npz"
    assert example_differences(policy.policy) == {}  # type: ignore[arg-type]


BROKEN: dict[str, tuple[dict[str, Any], str]] = {
    "another-graph": ({"onnx_sha256": "0" * 64}, "onnx_sha256 is 0000000000000000... there"),
    "no-shapes": (
        {"input_shapes": None},
        "dst.metadata.json: cannot be read: Expected `object`, got `null`",
    ),
    "camera-matrix": (
        {"input_shapes": {**WINDOW, "intrinsics": (1, 3, 3)}},
        "nothing is known of input 'intrinsics' of shape [1, 3, 3]: write a manifest.json",
    ),
    "no-vision": (
        {"input_shapes": {"goal": (1, 3)}},
        "input_shapes has no vision of 4 or 5 axes: goal [1, 3]",
    ),
    "no-modes": (
        {"output_shapes": {"plan": (1, 10)}},
        "output_shapes has no probs, or no modes of (1, k, steps, 5)",
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_an_export_that_cannot_be_driven_is_refused(tmp_path: Path, name: str) -> None:
    """The message names its file and what was found."""
    fields, expected = BROKEN[name]
    with pytest.raises(UsageError) as caught:
        load_policy(f"onnx:{window_export(tmp_path, **fields)}")
    assert expected in str(caught.value)
