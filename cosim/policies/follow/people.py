"""People in a picture: what YOLOX-nano answers, made boxes.

Source: Z. Ge et al., "YOLOX: exceeding YOLO series in 2021", arXiv 2107.08430. For each cell of three grids the network
tells the middle of a box in cells from the cell's corner, the logarithm of its size in cells, how sure it is that there
is anything, and of which of COCO's 80 classes.
"""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from cosim.policies.onnx.graph import Graph
from cosim.policies.onnx.inputs import PictureInput
from cosim.policies.onnx.pictures import picture_numbers

_SIDE_PX: Final = 416
_HOW: Final = PictureInput(size=(_SIDE_PX, _SIDE_PX), fit="corner", resample="linear", colour="bgr", scale=1.0)
_STRIDES_PX: Final = (8, 16, 32)
_PERSON: Final = 5
"""The column of class 0, behind middle, size and whether there is anything."""
_SURE: Final = 0.35
_OVERLAP: Final = 0.45


def people_in(rgb: NDArray[np.uint8], network: Graph) -> Floats:
    """(N, 4): left, top, right, bottom of each person in a picture (H, W, 3), in its pixels."""
    tensor = np.ascontiguousarray(picture_numbers(rgb, _HOW).transpose(2, 0, 1)[None], np.float32)
    told = network.ask({"images": tensor}, ["output"])["output"][0]
    return boxes_of(told, _SIDE_PX / max(rgb.shape[:2]))


def boxes_of(told: NDArray[np.float32], scale: float) -> Floats:
    """(N, 4): left, top, right, bottom of each person in an answer (3549, 85) on a picture that was scaled so; of those
    that overlap the surest."""
    corner, stride = _grid()
    sure = told[:, 4] * told[:, _PERSON]
    kept = sure > _SURE
    middle = (told[kept, :2] + corner[kept]) * stride[kept, None]
    size = np.exp(told[kept, 2:4]) * stride[kept, None]
    boxes = np.concatenate([middle - 0.5 * size, size], axis=1).astype(float) / scale
    if not len(boxes):
        return np.zeros((0, 4))
    chosen = np.array(cv2.dnn.NMSBoxes(boxes.tolist(), sure[kept].tolist(), _SURE, _OVERLAP)).ravel()
    best: Floats = boxes[chosen]
    best[:, 2:] += best[:, :2]
    return best


def _grid() -> tuple[Floats, Floats]:
    """The corner (x, y) of each cell, in cells, and its side in pixels, in the order of an answer's rows."""
    corners, strides = [], []
    for stride in _STRIDES_PX:
        side = _SIDE_PX // stride
        rows, columns = np.mgrid[:side, :side]
        corners.append(np.stack([columns.ravel(), rows.ravel()], axis=1).astype(float))
        strides.append(np.full(side * side, float(stride)))
    return np.concatenate(corners), np.concatenate(strides)
