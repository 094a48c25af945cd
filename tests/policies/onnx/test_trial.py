"""Trial queries of graphs: hanging, memory-hungry and crashing ones are refused and leave nothing."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from onnx import TensorProto, helper

from cosim.core.errors import UsageError
from cosim.policies.onnx.graph import Graph
from cosim.policies.onnx.policy import OnnxPolicy
from tests.conftest import PATIENCE_S, ROOT, WIDE, Cosim, still_runs
from tests.support.graphs import bundle, graph_bytes, port, tiny_graph

OBS, ACTION = port("obs", 1, 5, 2), port("action", 1, 5, 2)


def repeated_input(value: float) -> dict[str, Any]:
    """The fields of a manifest whose graph gets this value so many times."""
    return {
        "inputs": {"obs": {"what": "constant", "value": value}},
        "goal": "none",
        "camera": None,
        "output": {"what": "waypoints", "name": "action"},
    }


def endless() -> bytes:
    """A graph that loops as long as the sum of its input is more than 0."""
    body = helper.make_graph(
        [
            helper.make_node("Identity", ["on"], ["still_on"]),
            helper.make_node("Identity", ["x"], ["same_x"]),
        ],
        "body",
        [port("i", kind=TensorProto.INT64), port("on", kind=TensorProto.BOOL), port("x", 1, 5, 2)],
        [port("still_on", kind=TensorProto.BOOL), port("same_x", 1, 5, 2)],
    )
    nodes = [
        helper.make_node("ReduceSum", ["obs"], ["sum"], keepdims=0),
        helper.make_node("Greater", ["sum", "zero"], ["positive"]),
        helper.make_node("Loop", ["", "positive", "obs"], ["action"], body=body),
    ]
    return graph_bytes(nodes, [OBS], [ACTION], {"zero": np.float32(0.0)})


def hungry() -> bytes:
    """A graph that fills 32 GiB with ones."""
    nodes = [
        helper.make_node("ConstantOfShape", ["many"], ["ones"]),
        helper.make_node("ReduceSum", ["ones"], ["sum"], keepdims=0),
        helper.make_node("Add", ["obs", "sum"], ["action"]),
    ]
    return graph_bytes(nodes, [OBS], [ACTION], {"many": np.array([1 << 33])})


def test_a_graph_that_never_answers_is_refused(tmp_path: Path, cosim: Cosim) -> None:
    """After the start timeout, before the run, the exit code is 2 and the message says how to
    extend it."""
    place = bundle(tmp_path / "net", endless(), **repeated_input(1.0))
    before = {*psutil.Process().children()}
    result = cosim(
        "run",
        "unit",
        "--policy",
        f"onnx:{place}",
        "--episodes",
        "1",
        "--start-timeout",
        "0.5",
        cwd=tmp_path,
    )
    expected = (
        f"{place}/model.onnx: gives no answer within 0.5 s, to be loaded and to answer: it may "
        f"hold a loop without end"
    )
    assert (
        result.returncode == 2 and expected in result.stderr and "--start-timeout" in result.stderr
    ), result
    assert {path.name for path in tmp_path.iterdir()} == {"net"} and {
        *psutil.Process().children()
    } <= before


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL], ids=lambda how: how.name)
def test_a_graph_that_never_answers_is_ended_with_its_command(
    tmp_path: Path, how: signal.Signals
) -> None:
    """Ctrl-C and kill -9 of the command end its child at once, too."""
    place = bundle(tmp_path / "net", endless(), **repeated_input(1.0))
    words = [
        sys.executable,
        "-m",
        "cosim",
        "run",
        "unit",
        "--policy",
        f"onnx:{place}",
        "--episodes",
        "1",
    ]
    if how == signal.SIGKILL:  # from Python it is the same
        words[1:] = ["-c", f"import cosim; cosim.load_policy('onnx:{place}')"]
    environment = {**os.environ, **WIDE, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(words, cwd=tmp_path, env=environment, stderr=subprocess.PIPE) as command:
        until_s = time.monotonic() + PATIENCE_S
        while not (children := psutil.Process(command.pid).children()):
            assert time.monotonic() < until_s and command.poll() is None
            time.sleep(0.01)
        os.kill(command.pid, how)
        code = command.wait(PATIENCE_S)
        assert (
            code == (-how if how == signal.SIGKILL else 130)
            and b"Traceback" not in (command.stderr or b"").read()
        )
    while any(still_runs(child.pid) for child in children):
        assert time.monotonic() < until_s
        time.sleep(0.01)


def test_a_graph_that_asks_for_too_much_memory_is_refused(tmp_path: Path) -> None:
    """The message has the runtime's error and the limit of a graph."""
    place = bundle(tmp_path / "net", hungry(), **repeated_input(1.0))
    with pytest.raises(
        UsageError,
        match=r"cannot be run by onnxruntime: .*allocate.* \(a graph may use 4 GiB and 8 times",
    ):
        OnnxPolicy(place)


def test_a_graph_that_ends_its_process_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a fault as of compiled code this process continues, and the signal is named."""
    place = bundle(tmp_path / "net", tiny_graph())
    monkeypatch.setattr(Graph, "run", lambda *_: os.kill(os.getpid(), signal.SIGKILL))
    with pytest.raises(
        UsageError, match="ends onnxruntime: the process that ran it was killed by SIGKILL"
    ):
        OnnxPolicy(place)


def test_a_trial_answers_with_the_bits_of_this_process(tmp_path: Path) -> None:
    """The hash of a policy is the same with and without a trial, and in a worker, which is limited
    by its run."""
    place = bundle(
        tmp_path / "net",
        tiny_graph(bright=np.random.default_rng(0).random((192, 1)).astype(np.float32)),
    )
    assert OnnxPolicy(place).digest == OnnxPolicy(place, within_s=None).digest
