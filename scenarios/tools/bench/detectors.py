"""Networks that detect people in pictures, for `cosim bench realism`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from cosim.policies.follow.networks import YOLOX_NANO
from cosim.policies.follow.policy import detect_people
from cosim.policies.onnx.graph import Graph
from cosim.policies.onnx.inputs import PictureInput
from cosim.policies.onnx.manifest import FileFacts
from cosim.policies.onnx.pictures import picture_tensor
from cosim.policies.onnx.weights import NetworkFile, weights_file

FASTEST_DET: Final = NetworkFile(
    "FastestDet.onnx",
    "dog-qiuqiu/FastestDet, commit 50473cd1, example/onnx-runtime (BSD-3-Clause)",
    FileFacts(
        bytes=998169, blake2b="b7f38b7e0a69eeef1e77eedd7db0710d6aa1237f4c764bc38d5d712609f4c19e"
    ),
)
_SIDE_PX: Final = 352
"""Side of FastestDet's input in pixels."""
_INPUT: Final = PictureInput(
    size=(_SIDE_PX, _SIDE_PX), fit="stretch", resample="linear", colour="bgr"
)
_SURE: Final = 0.65
"""Lowest confidence of a box of FastestDet, the default of its authors."""
_OVERLAP: Final = 0.45
"""Overlap (IoU) above which the less confident of two boxes is dropped."""


REAL_HEIGHTS_PX: Final = (24.0, 28.0, 34.0, 42.0, 50.0, 60.0, 90.0)
"""Least heights of the classes of `Detector.real_recall`, in a picture of 512x288 pixels."""


@dataclass(frozen=True)
class Detector:
    """Network that detects people.

    file: its graph
    detect: function of a picture (H, W, 3) and the graph that returns boxes (N, 4) in pixels
    real_recall: share of real people that it finds, by `REAL_HEIGHTS_PX`
    """

    file: NetworkFile
    detect: Callable[[NDArray[np.uint8], Graph], Floats]
    real_recall: tuple[float, ...]

    def expected(self, heights_px: Floats) -> float:
        """Return how many of real people with these heights (N,) it would find."""
        rows = np.searchsorted(REAL_HEIGHTS_PX, heights_px, side="right") - 1
        return float(np.array([0.0, *self.real_recall])[rows + 1].sum())


def detect_fastest(rgb: NDArray[np.uint8], network: Graph) -> Floats:
    """Return (N, 4): left, top, right and bottom in pixels of people in a picture (H, W, 3)."""
    tensor = picture_tensor(rgb, _INPUT).transpose(2, 0, 1)[None]
    answer = network.run({"input.1": np.ascontiguousarray(tensor, np.float32)}, ["758"])["758"]
    return decode_fastest(answer[0], rgb.shape[1], rgb.shape[0])


def decode_fastest(output: NDArray[np.float32], width: int, height: int) -> Floats:
    """Decode the output (85, rows, columns) of FastestDet to boxes (N, 4) of people in pixels.

    Channels are the objectness, offset and size of a box in a cell, and 80 classes.
    """
    rows, columns = output.shape[1:]
    confidence = output[0] ** 0.6 * output[5:].max(axis=0) ** 0.4
    v, u = np.nonzero((confidence > _SURE) & (output[5:].argmax(axis=0) == 0))
    if not len(v):
        return np.zeros((0, 4))
    aside, down, wide, tall = output[1:5, v, u].astype(float)
    middle = np.stack(
        [(np.tanh(aside) + u) / columns * width, (np.tanh(down) + v) / rows * height], axis=1
    )
    size = np.stack([width / (1.0 + np.exp(-wide)), height / (1.0 + np.exp(-tall))], axis=1)
    corner = middle - 0.5 * size
    chosen = np.array(
        cv2.dnn.NMSBoxes(
            np.concatenate([corner, size], axis=1).tolist(),
            confidence[v, u].tolist(),
            _SURE,
            _OVERLAP,
        )
    ).ravel()
    return np.asarray(np.concatenate([corner, corner + size], axis=1)[chosen])


DETECTORS: Final[Mapping[str, Detector]] = MappingProxyType(
    {
        "YOLOX-nano": Detector(
            YOLOX_NANO, detect_people, (0.08, 0.26, 0.53, 0.75, 0.87, 0.94, 0.98)
        ),
        "FastestDet": Detector(
            FASTEST_DET, detect_fastest, (0.08, 0.17, 0.26, 0.46, 0.59, 0.78, 0.92)
        ),
    }
)
"""Detectors by name. Their boxes are compared with the same people.

Their recall on real people was measured on the Penn-Fudan pictures, scaled to these heights.
"""


def network_graph(network: NetworkFile, folder: Path | None) -> Graph:
    """Return a network's graph. Raises UsageError if its file is missing or differs.

    folder: searched before the folders of weights
    """
    beside = () if folder is None else (folder,)
    path = weights_file("bench realism", network.name, network.facts, network.source, beside)
    network.check(path, path.read_bytes())
    return Graph(path)
