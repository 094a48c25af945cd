"""Map of the ground in front of the robot: walkable cells and people.

The ground is assumed to be a plane; the robot's tilt is unknown.
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
from cosim.spec.camera import Calibration

GROUND_CELL_M: Final = 0.1
"""Side of a cell in metres."""
GROUND_AHEAD_M: Final = 8.0
"""Metres ahead of the robot's centre covered by the map."""
GROUND_ASIDE_M: Final = 4.0
"""Metres to either side covered by the map."""
_STREET_INPUT: Final = PictureInput(size=(512, 256), mean=(0.485, 0.456, 0.406), std=(0.229, 0.224, 0.225))
"""Preprocessing of the picture for ESPNetv2."""
_ROAD = 0
_SIDEWALK = 1
_LIGHT = 6
_SIGN = 7
_SKY = 10
_NO_OBSTACLE: Final = (_ROAD, _SIDEWALK, _LIGHT, _SIGN, _SKY)
"""Classes of Cityscapes that are not obstacles. A network trained on cars labels most of a near
sidewalk road. Lights, signs and sky are false detections in the joints of a pavement."""
_SPECKS: Final = 5
"""Size of the median filter in pixels."""


def walkable_pixels(rgb: NDArray[np.uint8], network: Graph) -> NDArray[np.bool_]:
    """Return (128, 256): whether a picture (H, W, 3) shows walkable area."""
    tensor = np.ascontiguousarray(picture_numbers(rgb, _STREET_INPUT).transpose(2, 0, 1)[None], np.float32)
    kinds = network.ask({"picture": tensor}, ["scores"])["scores"][0].argmax(axis=0)
    free = np.isin(kinds, _NO_OBSTACLE).astype(np.uint8)
    return np.asarray(cv2.medianBlur(free, _SPECKS), np.bool_)


class Ground:
    """Map with cells of `GROUND_CELL_M`: rows ahead from the robot's centre, columns from right to
    left.

    size: Width and height of the picture.
    """

    def __init__(self, camera: Calibration, size: tuple[int, int]) -> None:
        self._camera = camera
        self._size = size
        ahead = np.arange(0.0, GROUND_AHEAD_M, GROUND_CELL_M) + 0.5 * GROUND_CELL_M
        aside = np.arange(-GROUND_ASIDE_M, GROUND_ASIDE_M, GROUND_CELL_M) + 0.5 * GROUND_CELL_M
        x, y = np.meshgrid(ahead, aside, indexing="ij")
        points = np.stack([x, y, np.zeros_like(x), np.ones_like(x)], axis=-1)
        in_camera = points @ np.linalg.inv(camera.on_robot).T
        depth = in_camera[..., 2]
        pixels = (in_camera[..., :3] @ camera.matrix.T)[..., :2] / np.where(
            depth > 0.0, depth, 1.0
        )[..., None]
        inside = ((pixels >= 0.0) & (pixels <= np.array(size) - 1.0)).all(axis=-1)
        self._seen = inside & (depth > 0.0)
        self._share = np.clip(pixels / np.array(size), 0.0, 0.999)

    def free(self, walkable: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return (80, 80): whether cells are walkable; invisible cells count as walkable."""
        rows, columns = walkable.shape
        there = walkable[
            (self._share[..., 1] * rows).astype(int), (self._share[..., 0] * columns).astype(int)
        ]
        return np.asarray(there | ~self._seen)

    def feet_of(self, boxes: Floats) -> Floats:
        """Return (N, 2) ground positions in the robot's frame of people in boxes (N, 4).

        People whose feet are above the horizon or beyond `GROUND_AHEAD_M` are left out.
        """
        if not len(boxes):
            return np.zeros((0, 2))
        bottom = np.minimum(boxes[:, 3], self._size[1] - 1.0)
        pixels = np.stack([0.5 * (boxes[:, 0] + boxes[:, 2]), bottom, np.ones(len(boxes))], axis=1)
        rays = pixels @ np.linalg.inv(self._camera.matrix).T @ self._camera.on_robot[:3, :3].T
        at = self._camera.on_robot[:3, 3]
        down = rays[:, 2] < -1e-6
        way = at[2] / -rays[down, 2]
        feet: Floats = at[:2] + rays[down, :2] * way[:, None]
        return feet[feet[:, 0] < GROUND_AHEAD_M]
