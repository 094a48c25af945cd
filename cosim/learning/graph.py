"""ONNX graph of the network: written node by node from its parameters, and read back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
    turns_radps,
)

Shapes = Mapping[str, tuple[int, ...]]

INPUTS: Final = {
    "pictures": (1, 3 * HISTORY, HEIGHT_PX, WIDTH_PX),
    "goal": (1, 2),
    "speeds": (1, 2),
}
MODEL: Final = "model.onnx"
"""File of the graph in a bundle."""
PLAN: Final = "plan"
_OPSET: Final = 17
_IR: Final = 8
"""ONNX IR version, old enough for common runtimes."""


class GraphWriter:
    """Builder of graph nodes, each named by its output."""

    def __init__(self, parameters: Parameters, strides: Mapping[str, int]) -> None:
        self._strides = strides
        self.nodes: list[Any] = []
        self.constants = [
            numpy_helper.from_array(value.detach().cpu().float().numpy(), name)
            for name, value in parameters.items()
        ]

    def add(self, kind: str, inputs: Sequence[str], output: str = "", **attributes: Any) -> str:
        output = output or f"{kind.lower()}{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, list(inputs), [output], **attributes))
        return output

    def constant(self, name: str, value: Any, dtype: Any = np.float32) -> str:
        self.constants.append(numpy_helper.from_array(np.asarray(value, dtype), name))
        return name

    def conv(self, x: str, name: str, size: int = 3) -> str:
        inputs = [x, f"{name}.weight", f"{name}.bias"]
        return self.add(
            "Conv", inputs, strides=[self._strides.get(name, 1)] * 2, pads=[size // 2] * 4
        )

    def linear(self, x: str, name: str) -> str:
        return self.add("Gemm", [x, f"{name}.weight", f"{name}.bias"], transB=1)

    def relu(self, x: str) -> str:
        return self.add("Relu", [x])

    def split(self, x: str, sides: str, outputs: Sequence[str]) -> None:
        """Add a split of the second axis. sides: name of the constant with its lengths."""
        self.nodes.append(helper.make_node("Split", [x, sides], list(outputs), axis=1))

    def plan(self, joined: str) -> None:
        """Add the heads of the plan, as in `network.plan`, and the output PLAN."""
        sharp = self.add(
            "Mul", [self.linear(joined, "turn"), self.constant("sharpness", SHARPNESS)]
        )
        turns = self.constant("turns", turns_radps().reshape(-1, 1).numpy())
        turn = self.add("MatMul", [self.add("Softmax", [sharp], axis=1), turns])
        fast = self.relu(self.linear(joined, "speed"))
        speed = self.add("Mul", [fast, self.constant("cruise", CRUISE_MPS)])
        both = self.add("Concat", [speed, turn], axis=1)
        tiled = self.add("Tile", [both, self.constant("times", [1, WAYPOINTS], np.int64)])
        shape = self.constant("rows", [1, WAYPOINTS, 2], np.int64)
        ways = self.add("Reshape", [self.linear(joined, "way"), shape])
        rows = self.add("Concat", [ways, self.add("Reshape", [tiled, shape])], axis=2)
        stops = self.add("Greater", [self.linear(joined, "stop"), self.constant("even", 0.0)])
        goes = self.add("Cast", [self.add("Not", [stops])], to=TensorProto.FLOAT)
        self.add("Mul", [rows, goes], PLAN)

    def finished(self, name: str, inputs: Shapes, outputs: Shapes) -> bytes:
        """Return the graph's bytes after a check. inputs, outputs: shapes by name."""

        def ports(shapes: Shapes) -> list[Any]:
            return [
                helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)
                for name, shape in shapes.items()
            ]

        graph = helper.make_graph(self.nodes, name, ports(inputs), ports(outputs), self.constants)
        model = helper.make_model(
            graph, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=_IR
        )
        onnx.checker.check_model(model, full_check=True)
        return bytes(model.SerializeToString())


def build_graph(parameters: Parameters) -> bytes:
    """Build the graph for batches of one, equal to `network.answers` and `network.plan`."""
    g = GraphWriter(parameters, STRIDES)
    x = g.add(
        "Mul", [g.add("Sub", ["pictures", g.constant("grey", 0.5)]), g.constant("contrast", 4.0)]
    )
    for name, size in (("stem", 5), ("down1", 3), ("down2", 3)):
        x = g.relu(g.conv(x, name, size))
    x = g.add("Add", [x, g.conv(g.relu(g.conv(x, "block2a")), "block2b")])
    x = g.relu(g.conv(g.relu(x), "down3"))
    x = g.add("Add", [x, g.conv(g.relu(g.conv(x, "block3a")), "block3b")])
    x = g.relu(g.conv(g.relu(x), "narrow", 1))
    image = g.relu(g.linear(g.add("Flatten", [x]), "seen"))
    inputs = g.relu(g.linear(g.add("Concat", ["goal", "speeds"], axis=1), "told"))
    joined = g.relu(g.linear(g.add("Concat", [image, inputs], axis=1), "joined"))

    g.plan(joined)
    return g.finished("small", INPUTS, {PLAN: (1, WAYPOINTS, 4)})


def load_parameters(
    path: Path, wanted: Parameters, grown: Sequence[str] = ()
) -> dict[str, torch.Tensor]:
    """Load the parameters from the graph of a bundle.

    wanted: parameters of these names and shapes
    grown: layers that earlier bundles lack; they are 0 then

    Raises RunError for a graph without them.
    """
    try:
        arrays = {one.name: numpy_helper.to_array(one) for one in onnx.load(path).graph.initializer}
    except OSError as error:
        raise RunError(f"{path}: cannot be read: {error.strerror or error}") from error
    except Exception as error:
        raise RunError(f"{path}: no ONNX graph: {error}") from error
    for layer in grown:
        names = [name for name in wanted if name.startswith(f"{layer}.")]
        if not arrays.keys() & set(names):
            arrays |= {name: np.zeros(wanted[name].shape, np.float32) for name in names}
    found: dict[str, torch.Tensor] = {}
    for name, like in wanted.items():
        shape = arrays[name].shape if name in arrays else None
        if shape != tuple(like.shape):
            problem = "is not there" if shape is None else f"has the shape {shape}"
            raise RunError(
                f"{path}: {name} {problem}, and is wanted as {tuple(like.shape)}: train on from a "
                "bundle of the same --network that this version of cosim train made"
            )
        found[name] = torch.from_numpy(np.array(arrays[name], np.float32))
    return found


def run_graph(
    graph: bytes, inputs: Mapping[str, NDArray[np.float32]], outputs: Sequence[str]
) -> dict[str, NDArray[np.float32]]:
    """Return outputs of the graph by name, computed by onnx's reference evaluator."""
    from onnx.reference import ReferenceEvaluator

    answers = ReferenceEvaluator(onnx.load_model_from_string(graph)).run(
        list(outputs), dict(inputs)
    )
    return {
        name: np.asarray(answer, np.float32) for name, answer in zip(outputs, answers, strict=True)
    }
