"""Convert the ONNX graph of a gait to layers that `network.py` evaluates.

The graph is a chain from its first input to its first output. Other inputs and outputs are the
memory of recurrent layers.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cosim.core.network import Activation, Dense, Layer, Lstm, Network
from cosim.policies.onnx.graph_nodes import GraphNodes, Node, read_nodes

_SHAPERS: Final = ("Identity", "Squeeze", "Unsqueeze", "Flatten", "Reshape", "Dropout", "Cast")
"""Operators that change nothing but the shape of one vector."""
_ACTIVATIONS: Final[dict[str, Activation]] = {"Elu": "elu", "Relu": "relu", "Tanh": "tanh"}
_SHIFTS: Final = ("Add", "Sub", "Mul", "Div")
"""Operators with a constant vector, which are folded into the layer after them."""
_READ: Final = ("Gemm", "MatMul", "LSTM", *_ACTIVATIONS, *_SHIFTS, *_SHAPERS)

Floats64 = NDArray[np.float64]


def network_of_graph(data: bytes) -> Network:
    """Return the network of an ONNX file. Raises ValueError for a graph of another form."""
    return _Chain(read_nodes(data)).network()


class _Chain:
    """Reader of one graph. The current vector may have several names."""

    def __init__(self, graph: GraphNodes) -> None:
        if not graph.inputs or not graph.outputs:
            raise ValueError("has no input or no output")
        self._graph = graph
        self._names = {graph.inputs[0]}
        self._past: set[str] = set()
        self._layers: list[Layer] = []
        self._factor: Floats64 | None = None
        self._offset: Floats64 | None = None

    def network(self) -> Network:
        """Read all operators."""
        for node in self._graph.nodes:
            if node.kind == "LSTM" and node.inputs[:1] and node.inputs[0] in self._names:
                self._lstm(node)
            elif any(name in self._names for name in node.inputs):
                self._read(node)
            elif used := [name for name in node.inputs if name in self._past]:
                raise ValueError(f"is no chain: '{used[0]}' is used by another {node.kind}")
        if self._graph.outputs[0] not in self._names:
            raise ValueError(
                f"output '{self._graph.outputs[0]}' does not follow from the input "
                f"'{self._graph.inputs[0]}' by layers"
            )
        if self._factor is not None:
            raise ValueError("ends with a factor or a sum; put it into the last layer")
        return Network(tuple(self._layers))

    def _read(self, node: Node) -> None:
        if node.kind in _SHAPERS:
            self._names |= set(node.outputs)
            return
        if node.kind not in _READ:
            raise ValueError(f"has an operator {node.kind}; possible are {', '.join(_READ)}")
        if node.kind in _ACTIVATIONS:
            self._activate(node)
        elif node.kind in ("Gemm", "MatMul"):
            self._dense(node)
        else:
            self._shift(node)
        self._continue_with(node.outputs[:1])

    def _continue_with(self, names: Sequence[str]) -> None:
        self._past |= self._names
        self._names = {name for name in names if name}

    def _constant(self, node: Node, index: int) -> Floats64:
        """Return the constant input of an operator."""
        name = node.inputs[index] if index < len(node.inputs) else ""
        if name not in self._graph.constants:
            raise ValueError(f"{node.kind}: its input '{name}' is no constant")
        return np.asarray(self._graph.constants[name], np.float64)

    def _activate(self, node: Node) -> None:
        last = self._layers[-1] if self._layers else None
        if not isinstance(last, Dense) or last.activation != "linear" or self._factor is not None:
            raise ValueError(f"{node.kind} does not follow a layer")
        if node.kind == "Elu" and node.attributes.get("alpha", 1.0) != 1.0:
            raise ValueError(f"Elu has alpha {node.attributes['alpha']}; possible is 1")
        self._layers[-1] = Dense(last.weight, last.bias, _ACTIVATIONS[node.kind])

    def _dense(self, node: Node) -> None:
        turned = node.kind == "Gemm" and node.attributes.get("transB", 0) == 1
        if node.kind == "Gemm" and (
            node.attributes.get("transA", 0) != 0
            or node.attributes.get("alpha", 1.0) != 1.0
            or node.attributes.get("beta", 1.0) != 1.0
        ):
            raise ValueError("Gemm has transA, alpha or beta; possible is only transB")
        weight = self._constant(node, 1)
        if weight.ndim != 2 or node.inputs[0] not in self._names:
            raise ValueError(f"{node.kind} is no layer: its weight has shape {weight.shape}")
        weight = weight.T if turned else weight
        bias = self._constant(node, 2) if len(node.inputs) > 2 else np.zeros(weight.shape[1])
        weight, more = self._folded(weight)
        self._layers.append(Dense(_narrow(weight), _narrow(bias + more), "linear"))

    def _lstm(self, node: Node) -> None:
        """Read a recurrent layer; ONNX orders its gates input, output, forget, cell."""
        if node.attributes.get("direction", "forward") != "forward" or set(node.attributes) - {
            "direction",
            "hidden_size",
            "layout",
        }:
            raise ValueError("LSTM must be of one direction, with its usual activations")
        if len(node.inputs) > 7 and node.inputs[7]:
            raise ValueError("LSTM has peepholes, which are not read")
        given, own, bias = (self._constant(node, k) for k in (1, 2, 3))
        size = own.shape[-1] if own.ndim else 0
        shapes = given.shape[:2], own.shape, bias.shape
        if given.ndim != 3 or shapes != ((1, 4 * size), (1, 4 * size, size), (1, 8 * size)):
            raise ValueError(
                f"LSTM has weights {given.shape} and {own.shape}, and a bias {bias.shape}; "
                "expected (1, 4 n, inputs), (1, 4 n, n) and (1, 8 n)"
            )
        given, own, bias = given[0], own[0], bias[0]
        order = np.r_[0:size, 2 * size : 3 * size, 3 * size : 4 * size, size : 2 * size]
        weight, more = self._folded(given[order].T)
        total = (bias[: 4 * size] + bias[4 * size :])[order] + more
        self._layers.append(Lstm(_narrow(np.concatenate([weight, own[order].T])), _narrow(total)))
        self._continue_with(node.outputs[:2])

    def _shift(self, node: Node) -> None:
        """Add a constant to the last layer, or note a constant for the next one."""
        first = node.inputs[0] in self._names
        number = self._constant(node, 1 if first else 0).reshape(-1)
        last = self._layers[-1] if self._layers else None
        if not first and node.kind in ("Sub", "Div"):
            raise ValueError(f"{node.kind} must have its constant behind")
        if (
            node.kind == "Add"
            and isinstance(last, Dense)
            and last.activation == "linear"
            and self._factor is None
        ):
            self._layers[-1] = Dense(last.weight, _narrow(last.bias + number), "linear")
            return
        factor = np.ones(1) if self._factor is None else self._factor
        offset = np.zeros(1) if self._offset is None else self._offset
        if node.kind in ("Mul", "Div"):
            share = number if node.kind == "Mul" else 1.0 / number
            self._factor, self._offset = factor * share, offset * share
        else:
            shift = number if node.kind == "Add" else -number
            self._factor, self._offset = factor, offset + shift

    def _folded(self, weight: Floats64) -> tuple[Floats64, Floats64]:
        """Return the weight (inputs, outputs) after the noted constants, and a part of the bias."""
        if self._factor is None or self._offset is None:
            return weight, np.zeros(weight.shape[1])
        try:
            factor = np.broadcast_to(self._factor, weight.shape[:1])
            offset = np.broadcast_to(self._offset, weight.shape[:1])
        except ValueError:
            raise ValueError(
                f"a constant of {self._factor.size} numbers meets {weight.shape[0]} inputs"
            ) from None
        self._factor = self._offset = None
        more: Floats64 = (weight * offset[:, None]).sum(axis=0)
        return weight * factor[:, None], more


def _narrow(numbers: NDArray[Any]) -> NDArray[np.float32]:
    return np.ascontiguousarray(numbers, np.float32)
