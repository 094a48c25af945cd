"""Pictures of further cameras, and what a camera is to who computes with it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """A camera as computer vision has it (OpenCV): x to the right, y down, z ahead.

    matrix: (3, 3) K, in pixels, the middle of the upper left pixel at (0, 0). distortion: (5,) k1, k2, p1, p2, k3 of
    Brown's model. on_robot: (4, 4), from the camera's frame to the robot's (x ahead, y left, z up, the origin on the
    ground below its middle); the ground may lean the robot.

    >>> ahead = Calibration(np.eye(3), np.zeros(5), np.eye(4)).on_robot @ [0.0, 0.0, 1.0, 1.0]
    """

    matrix: Floats
    distortion: Floats
    on_robot: Floats

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """Raises TypeError: it is three arrays."""
        raise TypeError("a camera is no array: read .matrix (3, 3), .distortion (5,) or .on_robot (4, 4)")


@dataclass(frozen=True, slots=True, eq=False)
class CameraPicture:
    """What one camera gives: rgb (H, W, 3) uint8; labels (H, W) uint8 of `cosim.core.state.LABELS` and depth (H, W)
    float32, metres along the camera's axis, where its spec asks for them; and the camera.

    >>> camera = Calibration(np.eye(3), np.zeros(5), np.eye(4))
    >>> CameraPicture(np.zeros((48, 64, 3), np.uint8), None, None, camera).rgb.shape
    (48, 64, 3)
    """

    rgb: NDArray[np.uint8]
    labels: NDArray[np.uint8] | None
    depth: NDArray[np.float32] | None
    camera: Calibration

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """(H, W, 3) uint8: `rgb`."""
        return np.array(self.rgb, dtype, copy=copy)
