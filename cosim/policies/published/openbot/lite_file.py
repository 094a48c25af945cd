"""Read tensors and operators of a TensorFlow Lite file.

The file is a FlatBuffer. Only the fields below are read, by their numbers in schema.fbs.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

_MARK: Final = b"TFL3"
_CODES = 1
_GRAPHS = 2
_BUFFERS = 4
"""Fields of a model."""
_CODE: Final = 0
"""Field of an operator code."""
_TENSORS = 0
_INPUTS = 1
_OUTPUTS = 2
_OPERATORS = 3
"""Fields of a graph."""
_SHAPE = 0
_TYPE = 1
_BUFFER = 2
_NAME = 3
_QUANTIZATION = 4
"""Fields of a tensor."""
_SCALE = 2
_ZERO = 3
"""Fields of a quantization."""
_OPCODE = 0
_TAKEN = 1
_MADE = 2
_OPTIONS = 4
"""Fields of an operator."""
_PADDING = 0
_STRIDE_W = 1
_STRIDE_H = 2
"""Fields of the options of a convolution; padding 0 keeps the size."""
_DATA: Final = 0
"""Field of a buffer."""
_FLOAT32 = 0
_INT8 = 9
"""Types of a tensor's numbers."""
_DTYPES: Final = {_FLOAT32: "<f4", _INT8: "i1"}

LiteKind = Literal["add", "concat", "conv", "dense", "mul"]
_KINDS: Final[dict[int, LiteKind]] = {0: "add", 2: "concat", 3: "conv", 9: "dense", 18: "mul"}
_ACTIVATION: Final[dict[LiteKind, int]] = {"add": 0, "concat": 1, "conv": 3, "dense": 0, "mul": 0}
"""Field of the activation in the options of each operator: 0 is none, 1 is ReLU."""


@dataclass(frozen=True)
class LiteTensor:
    """Tensor.

    numbers: float32, dequantized if int8 in the file; None for computed tensors.
    """

    name: str
    shape: tuple[int, ...]
    numbers: NDArray[np.float32] | None


@dataclass(frozen=True)
class LiteOperator:
    """Operator.

    inputs, output: Indices of tensors.
    relu: Whether the output passes through a ReLU.
    strides: Down and right.
    """

    kind: LiteKind
    inputs: tuple[int, ...]
    output: int
    relu: bool
    strides: tuple[int, int]


@dataclass(frozen=True)
class LiteModel:
    """Model.

    inputs, outputs: Indices of tensors.
    """

    tensors: tuple[LiteTensor, ...]
    inputs: tuple[int, ...]
    outputs: tuple[int, ...]
    operators: tuple[LiteOperator, ...]


def read_lite_file(data: bytes) -> LiteModel:
    """Read a model with one graph. Raises ValueError for an invalid file or unknown operators."""
    if data[4:8] != _MARK:
        raise ValueError("is no TensorFlow Lite file: it begins otherwise")
    try:
        model = _Row(data, int.from_bytes(data[:4], "little"))
        (graph,) = model.rows(_GRAPHS)
        buffers = model.rows(_BUFFERS)
        codes = [code.number(_CODE, "b") for code in model.rows(_CODES)]
        return LiteModel(
            tuple(_tensor(row, buffers) for row in graph.rows(_TENSORS)),
            graph.numbers(_INPUTS),
            graph.numbers(_OUTPUTS),
            tuple(_operator(row, codes) for row in graph.rows(_OPERATORS)),
        )
    except (struct.error, IndexError, TypeError) as error:
        raise ValueError(f"is no whole TensorFlow Lite file: {error}") from None


def _tensor(row: _Row, buffers: list[_Row]) -> LiteTensor:
    name = row.text(_NAME)
    shape = row.numbers(_SHAPE)
    kind = row.number(_TYPE, "b")
    raw = buffers[row.number(_BUFFER, "I")].array(_DATA, "u1").tobytes()
    if not raw:
        return LiteTensor(name, shape, None)
    if kind not in _DTYPES or len(raw) != math.prod(shape) * np.dtype(_DTYPES[kind]).itemsize:
        raise ValueError(
            f"'{name}' holds {len(raw)} bytes, of type {kind}; wanted are float32 or int8, {shape}"
        )
    numbers = np.frombuffer(raw, _DTYPES[kind]).astype(np.float32).reshape(shape)
    if kind == _INT8:
        (scale,), (zero,) = (
            row.row(_QUANTIZATION).array(*how) for how in ((_SCALE, "<f4"), (_ZERO, "<i8"))
        )
        numbers = (numbers - np.float32(zero)) * scale
    return LiteTensor(name, shape, numbers)


def _operator(row: _Row, codes: list[int]) -> LiteOperator:
    code = codes[row.number(_OPCODE, "I")]
    (output,) = row.numbers(_MADE)
    if code not in _KINDS:
        raise ValueError(f"has an operator of kind {code}. Known are {', '.join(map(str, _KINDS))}")
    kind = _KINDS[code]
    options = row.row(_OPTIONS)
    activation = options.number(_ACTIVATION[kind], "b")
    strides = (1, 1)
    if kind == "conv":
        strides = options.number(_STRIDE_H, "i"), options.number(_STRIDE_W, "i")
        if options.number(_PADDING, "b"):
            raise ValueError("has a convolution without padding, which is not known")
    if activation not in (0, 1):
        raise ValueError(f"has an operator with the activation {activation}, which is not known")
    return LiteOperator(kind, row.numbers(_TAKEN), output, activation == 1, strides)


class _Row:
    """FlatBuffer table at an offset of the file; missing fields are 0 or empty."""

    def __init__(self, data: bytes, at: int) -> None:
        from flatbuffers.table import Table

        self._table: Any = Table(data, at)

    def number(self, field: int, kind: str) -> int:
        """Return a number.

        kind: format character of `struct`.
        """
        at = self._at(field)
        return (
            int(struct.unpack_from(f"<{kind}", self._table.Bytes, at + self._table.Pos)[0])
            if at
            else 0
        )

    def text(self, field: int) -> str:
        at = self._at(field)
        return str(self._table.String(at + self._table.Pos), "utf-8", "replace") if at else ""

    def row(self, field: int) -> _Row:
        at = self._at(field)
        if not at:
            raise IndexError(f"a table has no field {field}")
        return _Row(self._table.Bytes, self._table.Indirect(at + self._table.Pos))

    def rows(self, field: int) -> list[_Row]:
        begins = self.array(field, "<u4")
        first = self._table.Vector(self._at(field)) if len(begins) else 0
        return [
            _Row(self._table.Bytes, first + 4 * i + int(begin)) for i, begin in enumerate(begins)
        ]

    def numbers(self, field: int) -> tuple[int, ...]:
        return tuple(map(int, self.array(field, "<i4")))

    def array(self, field: int, dtype: str) -> NDArray[Any]:
        at = self._at(field)
        if not at:
            return np.zeros(0, dtype)
        return np.frombuffer(
            self._table.Bytes, dtype, self._table.VectorLen(at), self._table.Vector(at)
        )

    def _at(self, field: int) -> int:
        return int(self._table.Offset(4 + 2 * field))
