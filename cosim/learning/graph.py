"""The network as an ONNX graph: written node by node from its parameters, and these read back out
of one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from cosim.core.errors import RunError
from cosim.learning.network import (
    CRUISE_MPS,
    HEIGHT_PX,
    HISTORY,
    SHARPNESS,
    STRIDES,
    WAYPOINTS,
    WIDTH_PX,
    Parameters,
    new_parameters,
    turns_radps,
)

INPUTS: Final = {
    "pictures": (1, 3 * HISTORY, HEIGHT_PX, WIDTH_PX),
    "goal": (1, 2),
    "speeds": (1, 2),
}
PLAN: Final = "plan"
_OPSET: Final = 17
_IR: Final = 8
"""Old enough for every runtime of the last years."""


class _Writer:
    """Nodes in their order, each named by what it makes."""

    def __init__(self, parameters: Parameters) -> None:
        self.nodes: list[Any] = []
        self.constants = [
            numpy_helper.from_array(value.detach().cpu().float().numpy(), name)
            for name, value in parameters.items()
        ]

    def made(self, kind: str, inputs: Sequence[str], output: str = "", **attributes: Any) -> str:
        output = output or f"{kind.lower()}{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, list(inputs), [output], **attributes))
        return output

    def constant(self, name: str, value: Any, dtype: Any = np.float32) -> str:
        self.constants.append(numpy_helper.from_array(np.asarray(value, dtype), name))
        return name

    def convolved(self, x: str, name: str, size: int = 3) -> str:
        inputs = [x, f"{name}.weight", f"{name}.bias"]
        return self.made("Conv", inputs, strides=[STRIDES.get(name, 1)] * 2, pads=[size // 2] * 4)

    def linear(self, x: str, name: str) -> str:
        return self.made("Gemm", [x, f"{name}.weight", f"{name}.bias"], transB=1)

    def relu(self, x: str) -> str:
        return self.made("Relu", [x])


def graph_of(parameters: Parameters) -> bytes:
    """The graph, its inputs and output as `network.answers` and `network.plan` have them, for one
    at a time."""
    g = _Writer(parameters)
    x = g.made(
        "Mul", [g.made("Sub", ["pictures", g.constant("grey", 0.5)]), g.constant("contrast", 4.0)]
    )
    for name, size in (("stem", 5), ("down1", 3), ("down2", 3)):
        x = g.relu(g.convolved(x, name, size))
    x = g.made("Add", [x, g.convolved(g.relu(g.convolved(x, "block2a")), "block2b")])
    x = g.relu(g.convolved(g.relu(x), "down3"))
    x = g.made("Add", [x, g.convolved(g.relu(g.convolved(x, "block3a")), "block3b")])
    x = g.relu(g.convolved(g.relu(x), "narrow", 1))
    seen = g.relu(g.linear(g.made("Flatten", [x]), "seen"))
    told = g.relu(g.linear(g.made("Concat", ["goal", "speeds"], axis=1), "told"))
    joined = g.relu(g.linear(g.made("Concat", [seen, told], axis=1), "joined"))

    sharp = g.made("Mul", [g.linear(joined, "turn"), g.constant("sharpness", SHARPNESS)])
    turn = g.made(
        "MatMul",
        [
            g.made("Softmax", [sharp], axis=1),
            g.constant("turns", turns_radps().reshape(-1, 1).numpy()),
        ],
    )
    speed = g.made("Mul", [g.relu(g.linear(joined, "speed")), g.constant("cruise", CRUISE_MPS)])
    both = g.made("Concat", [speed, turn], axis=1)
    tiled = g.made("Tile", [both, g.constant("times", [1, WAYPOINTS], np.int64)])
    shape = g.constant("rows", [1, WAYPOINTS, 2], np.int64)
    ways = g.made("Reshape", [g.linear(joined, "way"), shape])
    rows = g.made("Concat", [ways, g.made("Reshape", [tiled, shape])], axis=2)
    stops = g.made("Greater", [g.linear(joined, "stop"), g.constant("even", 0.0)])
    goes = g.made("Cast", [g.made("Not", [stops])], to=TensorProto.FLOAT)
    g.made("Mul", [rows, goes], PLAN)

    floats = TensorProto.FLOAT
    graph = helper.make_graph(
        g.nodes,
        "small",
        [helper.make_tensor_value_info(name, floats, shape) for name, shape in INPUTS.items()],
        [helper.make_tensor_value_info(PLAN, floats, (1, WAYPOINTS, 4))],
        g.constants,
    )
    model = helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=_IR
    )
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString())


def parameters_of(path: Path) -> dict[str, torch.Tensor]:
    """The parameters in a graph that `graph_of` wrote. Raises RunError for any other."""
    wanted = new_parameters(0)
    try:
        held = {one.name: numpy_helper.to_array(one) for one in onnx.load(path).graph.initializer}
    except OSError as error:
        raise RunError(f"{path}: cannot be read: {error.strerror or error}") from error
    except Exception as error:
        raise RunError(f"{path}: no ONNX graph: {error}") from error
    found: dict[str, torch.Tensor] = {}
    for name, like in wanted.items():
        shape = held[name].shape if name in held else None
        if shape != tuple(like.shape):
            told = "is not there" if shape is None else f"has the shape {shape}"
            raise RunError(
                f"{path}: {name} {told}, and is wanted as {tuple(like.shape)}: train on from a "
                "bundle that this version of cosim train made"
            )
        found[name] = torch.from_numpy(np.array(held[name], np.float32))
    return found


def run_graph(graph: bytes, inputs: dict[str, NDArray[np.float32]]) -> NDArray[np.float32]:
    """The plan by the graph, computed by onnx's own reference."""
    from onnx.reference import ReferenceEvaluator

    (plan,) = ReferenceEvaluator(onnx.load_model_from_string(graph)).run([PLAN], inputs)
    return np.asarray(plan, np.float32)
