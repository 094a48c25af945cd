"""Convert published weights of ESPNetv2 for streets to an ONNX graph.

    python -m cosim.policies.follow.espnetv2 espnetv2_s_1.0_city_512x256.pth [-o FOLDER]

Source: S. Mehta et al., "ESPNetv2: a light-weight, power efficient, and general purpose
convolutional neural network", arXiv 1811.11431. The encoder has EESP units; strided ones also get
the resized picture. The decoder has efficient pyramids of pooled sizes, for 20 classes of
Cityscapes. It needs no PyTorch, but `pip install -e '.[convert]'`.
"""

from __future__ import annotations

import math
import sys
from itertools import count
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cosim.policies.follow.networks import ESPNET_GRAPH, ESPNET_WEIGHTS
from cosim.policies.onnx.converting import Converter, GraphWriter, PublishedArrays
from cosim.policies.onnx.torch_file import read_torch_file

HEIGHT: Final = 256
"""Height of the picture in pixels."""
WIDTH: Final = 512
"""Width of the picture in pixels."""
_CLASSES: Final = 20
_SCALES: Final = (2.0, 1.5, 1.0, 0.5, 0.1)
"""Relative sizes at which a pyramid processes its input."""
_PLANES: Final = 10
"""Channels of a pyramid at each size."""
_DECODER: Final = ((64, 64), (48, 16), (32, 32))
"""Channels of each decoder step, and groups of the convolution of the encoder's output."""


def street_graph(weights: dict[str, NDArray[Any]]) -> bytes:
    """Build the ONNX graph.

    Input `picture` (1, 3, 256, 512) is RGB / 255, normalised as for ImageNet. Output `scores` (1,
    20, 128, 256) has half the size. Raises ValueError for weights of another network.
    """
    return _Builder(weights).street()


class _Builder:
    """Builds the graph; tensors are identified by name."""

    def __init__(self, weights: dict[str, NDArray[Any]]) -> None:
        self._weights = PublishedArrays(weights)
        self._writer = GraphWriter("espnetv2")
        self._tensors = count()
        self._constants = count()

    def street(self) -> bytes:
        picture = "picture"
        sizes = {1: (HEIGHT // 2, WIDTH // 2)}
        first = self._conv_act(picture, "base_net.level1", stride=2)
        quarter = self._halved(self._halved(picture))
        second = self._down(first, "base_net.level2_0", quarter)
        eighth = self._halved(quarter)
        third = self._down(second, "base_net.level3_0", eighth)
        for i in range(3):
            third = self._unit(third, f"base_net.level3.{i}", (1, 2, 3, 4))
        fourth = self._down(third, "base_net.level4_0", self._halved(eighth))
        for i in range(7):
            fourth = self._unit(fourth, f"base_net.level4.{i}", (1, 1, 2, 3))
        sizes = {n: (HEIGHT >> n, WIDTH >> n) for n in (1, 2, 3, 4)}
        out = self._pyramid(fourth, "bu_dec_l1", sizes[4])
        for step, (encoded, (planes, groups)) in enumerate(
            zip((third, second, first), _DECODER, strict=True), 2
        ):
            size = sizes[5 - step]
            merged = self._merged(encoded, f"merge_enc_dec_l{step}", groups)
            out = self._op("Add", merged, self._resized(out, planes, size))
            out = self._act(self._norm(out, f"bu_br_l{step}.0"), f"bu_br_l{step}.1")
            out = self._pyramid(out, f"bu_dec_l{step}", size)
        # The file contains a last activation of strided units, which the network does not use.
        unused = tuple(f"base_net.level{n}_0.eesp.module_act.weight" for n in (2, 3, 4))
        self._weights.check_all_used(
            lambda name: name in unused or name.endswith(".num_batches_tracked")
        )
        self._writer.operator("Identity", "scores", out)
        return self._writer.serialized(
            {"picture": (1, 3, HEIGHT, WIDTH)}, {"scores": (1, _CLASSES, HEIGHT // 2, WIDTH // 2)}
        )

    def _unit(self, x: str, name: str, dilations: tuple[int, ...], stride: int = 1) -> str:
        """Add an EESP unit: grouped projection, summed dilated convolutions, grouped expansion."""
        groups = len(dilations)
        projected = self._conv_act(x, f"{name}.proj_1x1", groups=groups)
        planes = self._weights.take(f"{name}.spp_dw.0.conv.weight").shape[0]
        seen: list[str] = []
        for i, dilation in enumerate(dilations):
            one = self._conv(
                projected,
                f"{name}.spp_dw.{i}.conv",
                stride=stride,
                groups=planes,
                dilation=dilation,
            )
            seen.append(self._op("Add", one, seen[-1]) if seen else one)
        joined = self._norm(self._op("Concat", *seen, axis=1), f"{name}.br_after_cat.bn")
        joined = self._conv(
            self._act(joined, f"{name}.br_after_cat.act"),
            f"{name}.conv_1x1_exp.conv",
            groups=groups,
        )
        joined = self._norm(joined, f"{name}.conv_1x1_exp.bn")
        return joined if stride > 1 else self._act(self._op("Add", joined, x), f"{name}.module_act")

    def _down(self, x: str, name: str, picture: str) -> str:
        """Add a strided unit, concatenated with the averaged input, plus the resized picture."""
        strided = self._unit(x, f"{name}.eesp", (1, 2, 3, 4), stride=2)
        both = self._op("Concat", self._halved(x), strided, axis=1)
        again = self._conv(
            self._conv_act(picture, f"{name}.inp_reinf.0"), f"{name}.inp_reinf.1.conv"
        )
        return self._act(
            self._op("Add", both, self._norm(again, f"{name}.inp_reinf.1.bn")), f"{name}.act"
        )

    def _pyramid(self, x: str, name: str, size: tuple[int, int]) -> str:
        """Add an efficient pyramid: few channels at five sizes, shuffled and merged."""
        x = self._conv_act(x, f"{name}.projection_layer", "cbr.0", "cbr.1", "cbr.2")
        seen = []
        for i, scale in enumerate(_SCALES):
            there = max(math.ceil(size[0] * scale), 5), max(math.ceil(size[1] * scale), 5)
            stage = f"{name}.stages.{i}"
            if scale > 1.0:
                one = self._conv(self._resized(x, _PLANES, there), stage, groups=_PLANES)
                seen.append(self._pooled(one, there, size))
            elif scale < 1.0:
                one = self._conv(self._pooled(x, size, there), stage, groups=_PLANES)
                seen.append(self._resized(one, _PLANES, size))
            else:
                seen.append(self._conv(x, stage, groups=_PLANES))
        merge = f"{name}.merge_layer"
        joined = self._norm(self._op("Concat", *seen, axis=1), f"{merge}.0.br.0")
        joined = self._act(joined, f"{merge}.0.br.1")
        joined = self._op(
            "Reshape", joined, self._constant(np.array([1, len(_SCALES), _PLANES, *size]))
        )
        joined = self._op("Transpose", joined, perm=[0, 2, 1, 3, 4])
        joined = self._op(
            "Reshape", joined, self._constant(np.array([1, len(_SCALES) * _PLANES, *size]))
        )
        joined = self._conv_act(joined, f"{merge}.2", "cbr.0", "cbr.1", "cbr.2", groups=_PLANES)
        if f"{merge}.3.bias" in self._weights:
            return self._conv(joined, f"{merge}.3", bias=True)
        return self._act(
            self._norm(self._conv(joined, f"{merge}.3"), f"{name}.br.br.0"), f"{name}.br.br.1"
        )

    def _merged(self, x: str, name: str, groups: int) -> str:
        """Weight the encoder's output by channel."""
        weight = self._op(
            "Sigmoid", self._conv(self._op("GlobalAveragePool", x), f"{name}.wt_layer.1")
        )
        wide = self._conv_act(
            x, f"{name}.expansion_layer", "cbr.0", "cbr.1", "cbr.2", groups=groups
        )
        return self._op("Mul", wide, weight)

    def _conv_act(
        self,
        x: str,
        name: str,
        conv: str = "conv",
        norm: str = "bn",
        act: str = "act",
        stride: int = 1,
        groups: int = 1,
    ) -> str:
        x = self._conv(x, f"{name}.{conv}", stride=stride, groups=groups)
        return self._act(self._norm(x, f"{name}.{norm}"), f"{name}.{act}")

    def _conv(
        self,
        x: str,
        name: str,
        stride: int = 1,
        groups: int = 1,
        dilation: int = 1,
        bias: bool = False,
    ) -> str:
        kernel = self._weights.take(f"{name}.weight")
        beside = (kernel.shape[2] - 1) // 2 * dilation
        inputs = [x, self._constant(kernel)] + (
            [self._constant(self._weights.take(f"{name}.bias"))] if bias else []
        )
        return self._op(
            "Conv",
            *inputs,
            strides=[stride] * 2,
            group=groups,
            dilations=[dilation] * 2,
            pads=[beside] * 4,
        )

    def _norm(self, x: str, name: str) -> str:
        fields = ("weight", "bias", "running_mean", "running_var")
        numbers = [self._constant(self._weights.take(f"{name}.{field}")) for field in fields]
        return self._op("BatchNormalization", x, *numbers, epsilon=1e-5)

    def _act(self, x: str, name: str) -> str:
        """Add PReLU as four operators: same bits as the operator, twice as fast in onnxruntime."""
        above = self._op("Relu", x)
        slope = self._constant(self._weights.take(f"{name}.weight").reshape(-1, 1, 1))
        return self._op("Add", above, self._op("Mul", self._op("Sub", x, above), slope))

    def _halved(self, x: str) -> str:
        return self._op(
            "AveragePool",
            x,
            kernel_shape=[3, 3],
            strides=[2, 2],
            pads=[1, 1, 1, 1],
            count_include_pad=1,
        )

    def _resized(self, x: str, planes: int, size: tuple[int, int]) -> str:
        corners = {"mode": "linear", "coordinate_transformation_mode": "align_corners"}
        return self._op(
            "Resize", x, "", "", self._constant(np.array([1, planes, *size])), **corners
        )

    def _pooled(self, x: str, size: tuple[int, int], to: tuple[int, int]) -> str:
        """Add adaptive average pooling as two matrix products."""
        rows = self._op("MatMul", self._constant(_parts(size[0], to[0])), x)
        return self._op(
            "MatMul", rows, self._constant(np.ascontiguousarray(_parts(size[1], to[1]).T))
        )

    def _constant(self, numbers: NDArray[Any]) -> str:
        return self._writer.constant(f"c{next(self._constants)}", numbers)

    def _op(self, kind: str, *inputs: str, **how: Any) -> str:
        return self._writer.operator(kind, f"t{next(self._tensors)}", *inputs, **how)


def _parts(count: int, parts: int) -> NDArray[np.float32]:
    """Return (parts, count): the averaging matrix of adaptive pooling; parts may overlap."""
    weights = np.zeros((parts, count), np.float32)
    for i in range(parts):
        begin = i * count // parts
        end = -(-(i + 1) * count // parts)
        weights[i, begin:end] = 1.0 / (end - begin)
    return weights


ESPNET: Final = Converter(
    "cosim.policies.follow.espnetv2",
    ESPNET_WEIGHTS,
    lambda data: street_graph(read_torch_file(data)),
    lambda: ESPNET_GRAPH,
)

if __name__ == "__main__":
    ESPNET.command(sys.argv[1:])
