"""Read an ONNX file without a runtime: its weights, and the names of files with further weights.

An ONNX file is a protobuf message. Only the fields below are read, by their numbers in onnx.proto.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

_PARTS: Final[Mapping[str, Mapping[int, str]]] = {
    "model": {7: "graph", 20: "training", 25: "function"},
    "training": {1: "graph", 2: "graph"},
    "function": {7: "node", 11: "attribute"},
    "graph": {1: "node", 5: "tensor", 15: "sparse tensor"},
    "node": {5: "attribute"},
    "attribute": {
        5: "tensor",
        6: "graph",
        10: "tensor",
        11: "graph",
        22: "sparse tensor",
        23: "sparse tensor",
    },
    "sparse tensor": {1: "tensor", 2: "tensor"},
}
"""Fields of each message that may contain tensors."""
_TYPE = 2
_FLOATS = 4
_NAME = 8
_RAW = 9
_DOUBLES = 10
_EXTERNAL = 13
"""Fields of a tensor."""
_KEY = 1
_VALUE = 2
"""Fields of an entry of external data."""
_FLOAT = 1
_FLOAT16 = 10
_DOUBLE = 11
_BFLOAT16 = 16
"""Types of a tensor's numbers."""
_DTYPES: Final = {_FLOAT: "<f4", _FLOAT16: "<f2", _DOUBLE: "<f8", _BFLOAT16: "<u2"}

_Field = tuple[int, int | memoryview]


def external_files(data: bytes) -> list[str]:
    """Return names of files with weights of the graph. Raises ValueError for an invalid file."""
    found = set[str]()
    for tensor in _tensors(memoryview(data)):
        for number, entry in fields(tensor):
            if number == _EXTERNAL and isinstance(entry, memoryview):
                texts = {
                    key: bytes(text).decode()
                    for key, text in fields(entry)
                    if isinstance(text, memoryview)
                }
                if texts.get(_KEY) == "location":
                    found.add(texts.get(_VALUE, ""))
    return sorted(found)


def non_finite_weights(data: bytes) -> list[str]:
    """Return names of weights with NaN or infinities. Raises ValueError for an invalid file.

    Minus infinity is allowed, because attention masks contain it.
    """
    return [_name(tensor) for tensor in _tensors(memoryview(data)) if not _is_finite(tensor)]


def _is_finite(tensor: memoryview) -> bool:
    found = dict(fields(tensor))
    kind, raw = found.get(_TYPE), found.get(_RAW)
    if kind not in _DTYPES:
        return True
    raw = found.get({_FLOAT: _FLOATS, _DOUBLE: _DOUBLES}.get(kind, _RAW), raw)
    if not isinstance(raw, memoryview) or len(raw) % np.dtype(_DTYPES[kind]).itemsize:
        return True
    numbers: NDArray[Any] = np.frombuffer(raw, _DTYPES[kind])
    if kind == _BFLOAT16:
        numbers = (numbers.astype(np.uint32) << 16).view(np.float32)
    return not bool(np.isnan(numbers).any() or np.isposinf(numbers).any())


def _name(tensor: memoryview) -> str:
    name = dict(fields(tensor)).get(_NAME, b"")
    return bytes(name).decode(errors="replace") if isinstance(name, memoryview) else ""


def _tensors(model: memoryview) -> Iterator[memoryview]:
    """Yield all tensors of a model, including those of constants, functions and subgraphs."""
    if not any(_PARTS["model"].get(number) == "graph" for number, _ in fields(model)):
        raise ValueError("has no graph")
    messages = [("model", model)]
    while messages:
        kind, message = messages.pop()
        if kind == "tensor":
            yield message
            continue
        for number, part in fields(message):
            if (held := _PARTS[kind].get(number)) is not None:
                if not isinstance(part, memoryview):
                    raise ValueError(f"has a {held} that is none")
                messages.append((held, part))


def fields(message: memoryview) -> Iterator[_Field]:
    """Yield number and value of each field of a protobuf message. Raises ValueError if invalid."""
    at = 0
    while at < len(message):
        key, at = varint(message, at)
        number = key >> 3
        wire = key & 7
        if wire == 0:
            value, at = varint(message, at)
            yield number, value
            continue
        if wire == 2:
            length, at = varint(message, at)
        elif wire in (1, 5):
            length = 8 if wire == 1 else 4
        else:
            raise ValueError(f"is no protobuf message: wire type {wire}")
        if not number or at + length > len(message):
            raise ValueError("is no protobuf message, or ends too early")
        yield number, message[at : at + length]
        at += length


def varint(message: memoryview, at: int) -> tuple[int, int]:
    """Return a number of variable length, and the offset of its end."""
    value = 0
    for shift in range(0, 70, 7):
        if at >= len(message):
            raise ValueError("is no protobuf message, or ends too early")
        value |= (message[at] & 0x7F) << shift
        at += 1
        if message[at - 1] < 0x80:
            return value, at
    raise ValueError("is no protobuf message")
