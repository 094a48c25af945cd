"""An ONNX graph while it is written: operators one behind the other, and the numbers that they
take."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

PortShapes = Mapping[str, tuple[int | str, ...]]
"""Of tensors by their names; an axis that has a name may be of any length."""


class GraphWriter:
    """A graph with inputs and outputs of float32; a tensor is known by its name. The same calls
    give the same bytes."""

    def __init__(self, name: str) -> None:
        import onnx

        self._onnx = onnx
        self._name = name
        self._nodes: list[Any] = []
        self._constants: list[Any] = []

    def constant(self, name: str, numbers: NDArray[Any]) -> str:
        """Numbers that the graph holds."""
        self._constants.append(
            self._onnx.numpy_helper.from_array(np.ascontiguousarray(numbers), name)
        )
        return name

    def operator(self, kind: str, out: str, *inputs: str, **how: Any) -> str:
        """An operator with one output, `out`."""
        self._nodes.append(self._onnx.helper.make_node(kind, list(inputs), [out], **how))
        return out

    def whole(self, inputs: PortShapes, outputs: PortShapes) -> bytes:
        """The graph as a file. Raises ValueError where the parts do not fit together."""
        make = self._onnx.helper
        graph = make.make_graph(
            self._nodes, self._name, self._ports(inputs), self._ports(outputs), self._constants
        )
        model = make.make_model(graph, opset_imports=[make.make_opsetid("", 13)], ir_version=8)
        try:
            self._onnx.checker.check_model(model, full_check=True)
        except (
            self._onnx.checker.ValidationError,
            self._onnx.shape_inference.InferenceError,
        ) as error:
            raise ValueError(f"makes no graph: {' '.join(str(error).split())}") from error
        data: bytes = model.SerializeToString(deterministic=True)
        return data

    def _ports(self, shapes: PortShapes) -> list[Any]:
        number = self._onnx.TensorProto.FLOAT
        return [
            self._onnx.helper.make_tensor_value_info(name, number, list(shape))
            for name, shape in shapes.items()
        ]
