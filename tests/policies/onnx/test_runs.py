"""Runs with an ONNX bundle equal those of the same policy as a class, wherever it is hosted."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray
from onnx import helper

from cosim import policies
from cosim.episode.interfaces import Observation
from cosim.policies.load import load_policy
from cosim.policies.onnx.policy import OnnxPolicy, example_differences
from cosim.results.run_folder import read_records
from cosim.spec.camera import CameraSpec
from cosim.spec.goal import PointGoal
from cosim.spec.manifest import Manifest, WaypointRule
from cosim.spec.scenario import Scenario, Suite, write_suite
from scenarios.episodes.run_episode import run_episode
from scenarios.tools.verify.doctor import small_scenario
from tests.conftest import Cosim
from tests.support.documents import blocks, shell_lines
from tests.support.graphs import bundle, graph_bytes, port, tiny_graph

BLIND = tiny_graph(bright=np.zeros((6 * 4 * 8, 1), np.float32))
SEED = ("--seed", "5")
LEARNED = Path(policies.__file__).parent / "learned"


class Twin:
    """The graph `BLIND`, written as a class."""

    manifest = Manifest(
        "tiny",
        camera=CameraSpec(32, 32),
        goal="route_point",
        waypoints=WaypointRule(index=2, unit_m=1.0, dt_s=0.25),
    )

    def reset(self, episode_id: str, seed: int) -> None:
        """Nothing to forget."""

    def act(self, observation: Observation) -> NDArray[np.float32]:
        assert isinstance(observation.goal, PointGoal)
        goal = np.array([observation.goal.x_m / 10, observation.goal.y_m / 10]).astype(np.float32)
        return goal * (np.arange(1, 6)[:, None] / 5).astype(np.float32)


def second(name: str) -> Scenario:
    """A scenario of one second."""
    return msgspec.structs.replace(small_scenario(), id=name, time_limit_s=1.0)


@pytest.mark.engine
def test_a_bundle_drives_like_the_same_policy_as_a_class(tmp_path: Path) -> None:
    """Answers and state hash are equal, and the record has camera, goal and waypoint rule of the
    manifest."""
    graph = run_episode(second("a"), load_policy(f"onnx:{bundle(tmp_path / 'net', BLIND)}")).record
    twin = run_episode(second("a"), Twin()).record
    assert graph.state_hash == twin.state_hash and graph.status == "done", graph.reason
    assert (graph.manifest.camera, graph.manifest.goal, graph.manifest.waypoints) == (
        twin.manifest.camera,
        "route_point",
        twin.manifest.waypoints,
    )


@pytest.mark.parametrize("name", ["small", "small-reactive", "sidewalk"])
def test_networks_that_ship_answer_as_in_training(name: str) -> None:
    """The answers to the example of each bundle are PyTorch's, up to rounding."""
    differences = example_differences(OnnxPolicy(LEARNED / name))
    assert differences and max(differences.values()) < 1e-3


@pytest.mark.engine
def test_sidewalk_passes_an_obstacle(tmp_path: Path, cosim: Cosim) -> None:
    """The shipped network, which needs no PyTorch, solves a way on which `straight` fails."""
    for policy in ("sidewalk", "straight"):
        words = ("run", "unit", "--scenario", "straight-7015", "--policy", policy)
        ran = cosim(*words, "--out", policy, cwd=tmp_path)
        (record,) = read_records(tmp_path / policy)
        assert record.measures["success"] == (policy == "sidewalk"), ran.stderr


@pytest.mark.engine
def test_a_bundle_drives_alike_isolated_and_in_several_processes(
    tmp_path: Path, cosim: Cosim
) -> None:
    """A graph that uses the picture gives the same bits with --jobs 2 and with --isolated."""
    bundle(tmp_path / "net", tiny_graph())
    write_suite(
        Suite(name="two", version="1", scenarios=(second("a"), second("b"))), tmp_path / "two.json"
    )
    words = ("run", "two.json", "--policy", "onnx:net", *SEED)
    both = cosim(*words, "--jobs", "2", "--out", "both", cwd=tmp_path)
    alone = cosim(*words, "--scenario", "b", "--isolated", "--out", "alone", cwd=tmp_path)
    assert (both.returncode, alone.returncode) == (0, 0), both.stderr + alone.stderr
    hashes = {one.scenario.id: one.state_hash for one in read_records(tmp_path / "both")}
    (isolated,) = read_records(tmp_path / "alone")
    assert (
        isolated.setup.policy_runs.startswith("isolated: ")
        and isolated.state_hash == hashes["b"]
        and len(hashes) == 2
    )


@pytest.mark.engine
def test_the_documented_bundle_runs_as_written(tmp_path: Path, cosim: Cosim) -> None:
    """Its manifest and command work on a short suite with a graph of those inputs and that output."""
    ((_, _, _, manifest),) = blocks("json", "docs/onnx.md")
    (command,) = (
        words for _, words in shell_lines("docs/onnx.md") if words[-1] == "onnx:my_network"
    )
    assert len(manifest.splitlines()) < 10
    frames = port("frames", 1, 12, 90, 160)
    goal = port("goal", 1, 3)
    plan = port("waypoints", 1, 8, 2)
    nodes = [
        helper.make_node("ReduceMean", ["frames"], ["light"]),
        helper.make_node("MatMul", ["goal", "way"], ["ahead"]),
        helper.make_node("Add", ["ahead", "light"], ["row"]),
        helper.make_node("Reshape", ["row", "shape"], ["waypoints"]),
    ]
    weights = {"way": np.ones((3, 16), np.float32), "shape": np.array([1, 8, 2])}
    bundle(
        tmp_path / "my_network",
        graph_bytes(nodes, [frames, goal], [plan], weights),
        json.loads(manifest),
    )
    write_suite(
        Suite(name="reactive", version="1", scenarios=(second("a"),)), tmp_path / "one.json"
    )
    result = cosim(
        *["one.json" if word == "reactive" else word for word in command[1:]],
        "--out",
        "run",
        cwd=tmp_path,
    )
    (record,) = read_records(tmp_path / "run")
    assert result.returncode == 0 and (record.manifest.name, record.status) == (
        "my-network",
        "done",
    ), result.stderr


def test_a_run_that_a_bundle_cannot_drive_is_refused_before_it_begins(
    tmp_path: Path, cosim: Cosim
) -> None:
    """Unsupported goals and a file that is no graph give exit code 2, one line, and no folder."""
    bundle(tmp_path / "net", tiny_graph())
    write_suite(Suite(name="one", version="1", scenarios=(second("a"),)), tmp_path / "one.json")
    bundle(tmp_path / "text", b"once upon a time")
    for words, expected in (
        (
            ("--policy", "onnx:net", "--goal", "image"),
            "policy 'tiny' wants goals route_point or final_point or random",
        ),
        (("--policy", "onnx:text"), "policy 'onnx:text': text/model.onnx: is no ONNX graph"),
        (
            ("--policy", "onnx:nowhere"),
            "policy 'onnx:nowhere': nowhere: no bundle: has no manifest.json",
        ),
    ):
        result = cosim("run", "one.json", "--out", "run", *words, cwd=tmp_path)
        assert result.returncode == 2 and f"error: {expected}" in result.stderr, result.stderr
        assert not (tmp_path / "run").exists()
