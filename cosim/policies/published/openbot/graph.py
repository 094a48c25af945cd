"""Build the graph of OpenBot's driving network.

Source: M. Müller and V. Koltun, "OpenBot: turning smartphones into robots", arXiv 2008.10631:
convolutions of the picture, with the command as input of three layers. The file is converted
operator by operator. Tensor 7 is named t7; the weights of operator 7 are w7 and b7, or p7.

Most weights are int8 with a scale. The graph computes in float32 with dequantized weights, while
TensorFlow Lite also quantizes the activations. Its wheel speeds differ by up to 0.02.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

from cosim.policies.onnx.converting import Converter, GraphWriter, PortShapes, graph_of_bundle
from cosim.policies.onnx.manifest import FileFacts
from cosim.policies.onnx.weights import NetworkFile
from cosim.policies.published.openbot.lite_file import (
    LiteModel,
    LiteOperator,
    LiteTensor,
    read_lite_file,
)

_INPUTS: Final = {"img_input": ("img", (96, 256, 3)), "cmd_input": ("cmd", (1,))}
"""Names and shapes, without the first axis, of the file's inputs."""
_OUTPUT: Final = ("left_right", (2,))
"""Name and shape, without the first axis, of the output."""


def openbot_graph(model: LiteModel) -> bytes:
    """Build the ONNX graph. Raises ValueError for a model with other inputs, outputs or operators.

    Inputs are `img` (N, 96, 256, 3), RGB / 255, and `cmd` (N, 1): -1 left, 0 straight, 1 right.
    Output `left_right` (N, 2) is the wheel speeds.
    """
    return _Translation(model).serialized()


class _Translation:
    """Converts operators to ONNX; channels are last in the file and first in ONNX."""

    def __init__(self, model: LiteModel) -> None:
        self._model = model
        self._writer = GraphWriter("openbot_cil_mobile")
        self._names: dict[int, str] = {}

    def serialized(self) -> bytes:
        shapes = {self._tensor(i).name: self._tensor(i).shape for i in self._model.inputs}
        wanted = {name: (1, *shape) for name, (_, shape) in _INPUTS.items()}
        found = [self._tensor(i).shape for i in self._model.outputs]
        name, shape = _OUTPUT
        if shapes != wanted or found != [(1, *shape)]:
            raise ValueError(
                f"has inputs {shapes} and outputs {found}; wanted are {wanted} and {[(1, *shape)]}"
            )
        self._names = {i: _INPUTS[self._tensor(i).name][0] for i in self._model.inputs}
        for i in self._model.inputs:
            if len(self._tensor(i).shape) == 4:
                called = self._names[i]
                self._names[i] = self._writer.operator(
                    "Transpose", f"{called}_nchw", called, perm=[0, 3, 1, 2]
                )
        for number, operator in enumerate(self._model.operators):
            self._names[operator.output] = self._translated(number, operator)
        self._writer.operator("Identity", name, self._name(self._model.outputs[0]))
        inputs: PortShapes = {called: ("N", *sides) for called, sides in _INPUTS.values()}
        return self._writer.serialized(inputs, {name: ("N", *shape)})

    def _translated(self, number: int, operator: LiteOperator) -> str:
        """Convert an operator; return the name of its output."""
        out = f"t{operator.output}"
        made = f"{out}_" if operator.relu else out
        if operator.kind == "concat":
            self._writer.operator("Concat", made, *map(self._name, operator.inputs), axis=1)
        elif operator.kind in ("add", "mul"):
            self._by_channel(made, number, operator)
        elif operator.kind == "conv":
            numbers = self._weights(number, operator)
            x = self._name(operator.inputs[0])
            self._writer.operator(
                "Conv", made, x, *numbers, strides=list(operator.strides), auto_pad="SAME_UPPER"
            )
        else:
            x = self._flat(operator.inputs[0])
            self._writer.operator("Gemm", made, x, *self._weights(number, operator), transB=1)
        return self._writer.operator("Relu", out, made) if operator.relu else out

    def _by_channel(self, made: str, number: int, operator: LiteOperator) -> None:
        """Add a sum or product with one number per channel."""
        x, by = operator.inputs
        numbers = self._tensor(by).numbers
        axes = len(self._tensor(x).shape)
        if numbers is None or numbers.ndim != 1:
            raise ValueError(
                f"operator {number}: does not {operator.kind} a number for each channel"
            )
        param = self._writer.constant(f"p{number}", numbers.reshape(1, -1, *[1] * (axes - 2)))
        self._writer.operator(operator.kind.capitalize(), made, self._name(x), param)

    def _flat(self, tensor: int) -> str:
        """Flatten a picture with its channels last."""
        x = self._name(tensor)
        if len(self._tensor(tensor).shape) == 4:
            x = self._writer.operator(
                "Flatten",
                f"{x}_f",
                self._writer.operator("Transpose", f"{x}_nhwc", x, perm=[0, 2, 3, 1]),
            )
        return x

    def _weights(self, number: int, operator: LiteOperator) -> list[str]:
        """Return kernel and bias of a convolution or matrix product."""
        kernel, bias = (self._tensor(i).numbers for i in operator.inputs[1:])
        if kernel is None or bias is None or kernel.ndim != (4 if operator.kind == "conv" else 2):
            raise ValueError(f"operator {number}: is a {operator.kind} without weights")
        if operator.kind == "conv":
            kernel = kernel.transpose(0, 3, 1, 2)
        return [
            self._writer.constant(f"w{number}", kernel),
            self._writer.constant(f"b{number}", bias),
        ]

    def _name(self, tensor: int) -> str:
        if tensor not in self._names:
            raise ValueError(f"takes tensor {tensor} before it is made")
        return self._names[tensor]

    def _tensor(self, i: int) -> LiteTensor:
        return self._model.tensors[i]


OPENBOT: Final = Converter(
    "cosim.policies.published.openbot",
    NetworkFile(
        "autopilot_float.tflite",
        "isl-org/OpenBot, commit 30ab3bd1, android/app/src/main/assets/networks (MIT)",
        FileFacts(
            bytes=1304192,
            blake2b="9d5d9f52e2cc37b820c6774c3a0e5bdb6fd6f8cb69c08650b27e9362967236cb",
        ),
    ),
    lambda data: openbot_graph(read_lite_file(data)),
    lambda: graph_of_bundle(Path(__file__).parent),
)
