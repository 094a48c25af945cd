"""Build DroNet's graph.

Source: A. Loquercio et al., "DroNet: learning to fly by driving", IEEE Robotics and Automation
Letters 3 (2018). A ResNet of three blocks, each of which halves the size, then steering and the
probability of a collision. Tensors have the layer names of the weight file, connected as in the
published `model_struct.json`.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.policies.onnx.converting import Converter, GraphWriter, PublishedArrays, graph_of_bundle
from cosim.policies.onnx.manifest import FileFacts
from cosim.policies.onnx.weights import NetworkFile

_SIDE: Final = 200
"""Side of the picture in pixels."""
_PLANES: Final = (32, 32, 64, 128)
"""Channels of the first layer and of each block."""
_CELLS: Final = 7 * 7
"""Pixels after the last block."""
_EPSILON: Final = 1e-3
"""Epsilon of batch normalisation in Keras."""

KerasWeights = dict[str, NDArray[np.float32]]
"""Arrays by their path in the file, such as "conv2d_1/conv2d_1/kernel:0"."""


def read_keras_weights(data: bytes) -> KerasWeights:
    """Return all arrays of a Keras weight file. Raises ValueError for an invalid file."""
    import h5py

    found: KerasWeights = {}

    def keep(path: str, held: object) -> None:
        if isinstance(held, h5py.Dataset):
            found[path] = held[()]

    try:
        with h5py.File(io.BytesIO(data), "r") as file:
            file.visititems(keep)
    except (OSError, RuntimeError, KeyError) as error:
        raise ValueError(f"is no whole HDF5 file: {error}") from None
    return found


def dronet_graph(weights: KerasWeights) -> bytes:
    """Build the ONNX graph. Raises ValueError for weights of another network.

    Input `image` (N, 1, 200, 200) is grey / 255. Outputs are `steering` (N, 1) and `collision_prob`
    (N, 1).
    """
    return _Layers(weights).dronet()


class _Layers:
    """Builds layers by their names in the file; each returns the name of its output."""

    def __init__(self, weights: KerasWeights) -> None:
        self._writer = GraphWriter("dronet")
        self._weights = PublishedArrays(weights)

    def dronet(self) -> bytes:
        write = self._writer.operator
        x = self._conv("image", 1, 5, (1, _PLANES[0]), 2)
        x = write("MaxPool", "max_pooling2d_1", x, kernel_shape=[3, 3], strides=[2, 2])
        for i in (1, 2, 3):
            x = self._block(x, i, _PLANES[i - 1], _PLANES[i])
        x = write("Transpose", "flatten_1_t", x, perm=[0, 2, 3, 1])
        x = write("Relu", "activation_7", write("Flatten", "flatten_1", x))
        collision, steering = self._dense(x, 2), self._dense(x, 1)
        collision = write("Sigmoid", "activation_8", collision)
        write("Identity", "steering", steering)
        write("Identity", "collision_prob", collision)
        self._weights.check_all_used()
        return self._writer.serialized(
            {"image": ("N", 1, _SIDE, _SIDE)}, {"steering": ("N", 1), "collision_prob": ("N", 1)}
        )

    def _block(self, x: str, i: int, planes: int, more: int) -> str:
        """Add a residual block: two normalised convolutions with a 1 x 1 shortcut."""
        norm, conv = 2 * i - 1, 3 * i - 1
        y = self._conv(self._norm_relu(x, norm, planes), conv, 3, (planes, more), 2)
        y = self._norm_relu(y, norm + 1, more)
        beside = self._conv(x, conv + 2, 1, (planes, more), 2)
        return self._writer.operator(
            "Add", f"add_{i}", beside, self._conv(y, conv + 1, 3, (more, more), 1)
        )

    def _conv(self, x: str, number: int, side: int, planes: tuple[int, int], stride: int) -> str:
        layer = f"conv2d_{number}"
        kernel = self._take(layer, "kernel", (side, side, *planes)).transpose(3, 2, 0, 1)
        numbers = self._numbers(layer, w=kernel, b=self._take(layer, "bias", planes[1:]))
        return self._writer.operator(
            "Conv", layer, x, *numbers, strides=[stride] * 2, auto_pad="SAME_UPPER"
        )

    def _norm_relu(self, x: str, number: int, planes: int) -> str:
        layer = f"batch_normalization_{number}"
        fields = ("gamma", "beta", "moving_mean", "moving_variance")
        numbers = self._numbers(
            layer, **{field: self._take(layer, field, (planes,)) for field in fields}
        )
        normed = self._writer.operator("BatchNormalization", layer, x, *numbers, epsilon=_EPSILON)
        return self._writer.operator("Relu", f"activation_{number}", normed)

    def _dense(self, x: str, number: int) -> str:
        layer = f"dense_{number}"
        kernel = self._take(layer, "kernel", (_CELLS * _PLANES[-1], 1))
        return self._writer.operator(
            "Gemm", layer, x, *self._numbers(layer, w=kernel, b=self._take(layer, "bias", (1,)))
        )

    def _numbers(self, layer: str, **fields: NDArray[np.float32]) -> list[str]:
        return [
            self._writer.constant(f"{layer}_{name}", numbers) for name, numbers in fields.items()
        ]

    def _take(self, layer: str, field: str, shape: tuple[int, ...]) -> NDArray[np.float32]:
        return self._weights.take(f"{layer}/{layer}/{field}:0", shape)


DRONET: Final = Converter(
    "cosim.policies.published.dronet",
    NetworkFile(
        "model_weights.h5",
        "uzh-rpg/rpg_public_dronet, commit ac19c54b, model (MIT)",
        FileFacts(
            bytes=1362640,
            blake2b="e24a45d3441b90191be874643b33422ffc8416ee89d26808d03c2f1c6cf2f196",
        ),
    ),
    lambda data: dronet_graph(read_keras_weights(data)),
    lambda: graph_of_bundle(Path(__file__).parent),
)
