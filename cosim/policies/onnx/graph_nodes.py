"""Read the operators and constants of an ONNX file without a runtime."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cosim.policies.onnx.graph_file import fields, varint

_GRAPH: Final = 7
"""Field of a model."""
_NODES: Final = 1
_TENSORS: Final = 5
_INPUTS: Final = 11
_OUTPUTS: Final = 12
"""Fields of a graph."""
_DTYPES: Final = {1: "<f4", 6: "<i4", 7: "<i8", 11: "<f8"}
"""Types of a tensor's numbers."""
_NUMBERS: Final = {1: 4, 6: 5, 7: 7, 11: 10}
"""Field of the numbers that are not raw, by their type."""

Message = memoryview
Value = float | int | str | list[int] | NDArray[Any]


@dataclass(frozen=True)
class Node:
    """Operator with the names of its inputs and outputs; "" for an omitted one."""

    kind: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    attributes: Mapping[str, Value]


@dataclass(frozen=True)
class GraphNodes:
    """Operators of a graph in their order, its constants, and the names of inputs and outputs."""

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    nodes: tuple[Node, ...]
    constants: Mapping[str, NDArray[Any]]


def read_nodes(data: bytes) -> GraphNodes:
    """Read an ONNX file. Raises ValueError for an invalid file or constants in other files."""
    graph = next((part for part in _parts(memoryview(data), _GRAPH)), None)
    if graph is None:
        raise ValueError("has no graph")
    constants = dict(map(_tensor, _parts(graph, _TENSORS)))
    nodes = []
    for part in _parts(graph, _NODES):
        node = _node(part)
        value = node.attributes.get("value")
        if node.kind == "Constant" and isinstance(value, np.ndarray):
            if not node.outputs:
                raise ValueError("Constant has no output")
            constants[node.outputs[0]] = value
        else:
            nodes.append(node)
    inputs = [name for name in map(_name, _parts(graph, _INPUTS)) if name not in constants]
    outputs = map(_name, _parts(graph, _OUTPUTS))
    return GraphNodes(tuple(inputs), tuple(outputs), tuple(nodes), constants)


def _parts(message: Message, number: int) -> list[Message]:
    """Return the messages in a field that may be repeated."""
    return [part for key, part in fields(message) if key == number and isinstance(part, memoryview)]


def _text(message: Message, number: int) -> str:
    return "".join(bytes(part).decode() for part in _parts(message, number))


def _name(message: Message) -> str:
    return _text(message, 1)


def _node(message: Message) -> Node:
    inputs, outputs = (
        tuple(bytes(part).decode() for part in _parts(message, number)) for number in (1, 2)
    )
    attributes = {_name(part): _attribute(part) for part in _parts(message, 5)}
    return Node(_text(message, 4), inputs, outputs, attributes)


def _attribute(message: Message) -> Value:
    """Return a number, text, list of integers or tensor."""
    found = dict(fields(message))
    single, integer, tensor = found.get(2), found.get(3), found.get(5)
    if isinstance(single, memoryview):
        return float(np.frombuffer(single, "<f4")[0])
    if isinstance(tensor, memoryview):
        return _tensor(tensor)[1]
    if isinstance(integer, int):
        return integer
    if 4 in found:
        return _text(message, 4)
    return _integers(message, 8)


def _integers(message: Message, number: int) -> list[int]:
    """Return integers of a repeated field, packed or not."""
    numbers: list[int] = []
    for key, value in fields(message):
        if key != number:
            continue
        if isinstance(value, int):
            numbers.append(value)
            continue
        at = 0
        while at < len(value):
            one, at = varint(value, at)
            numbers.append(one)
    return [one - (1 << 64) if one >> 63 else one for one in numbers]


def _tensor(message: Message) -> tuple[str, NDArray[Any]]:
    """Return name and numbers of a tensor."""
    found = dict(fields(message))
    name, kind, raw = _text(message, 8), found.get(2), found.get(9)
    if kind not in _DTYPES:
        raise ValueError(f"'{name}' has numbers of type {kind}; float and integer are read")
    if 13 in found:
        raise ValueError(f"'{name}' is in another file; export the graph as one file")
    dtype = np.dtype(_DTYPES[kind])
    if not isinstance(raw, memoryview):
        raw = found.get(_NUMBERS[kind])
    numbers: NDArray[Any]
    if isinstance(raw, memoryview) and (9 in found or dtype.kind == "f"):
        if len(raw) % dtype.itemsize:
            raise ValueError(f"'{name}' ends too early")
        numbers = np.frombuffer(raw, dtype)
    else:
        numbers = np.array(_integers(message, _NUMBERS[kind]), dtype)
    shape = tuple(_integers(message, 1))
    if int(np.prod(shape)) != numbers.size or any(side < 0 for side in shape):
        raise ValueError(f"'{name}' should hold {shape}, and has {numbers.size} numbers")
    return name, numbers.reshape(shape)
