"""Camera with PyBullet's software renderer, which needs no GPU or system library, or its EGL
plugin.

A picture is a function of the robot's state and the street alone.
The same values give the same pixels, independent of previous pictures.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import EngineError
from cosim.core.state import LABELS, Frame, RobotState, Street
from cosim.spec.camera import CameraSpec
from physics.cameras.camera_base import WorldCamera
from physics.cameras.canvas import BulletCanvas
from physics.cameras.posture import posture_of
from physics.cameras.scene import BulletScene
from physics.cameras.view import FAR_PLANE_M, NEAR_PLANE_M, Shot
from physics.dynamics.world import BulletWorld

_HAZE: Final = np.array([206.0, 216.0, 226.0], dtype=np.float32)
_ZENITH: Final = np.array([92.0, 142.0, 205.0], dtype=np.float32)
_TILES_MAX: Final = 150
"""Number of built tiles before the renderer restarts.

PyBullet frees the memory of drawn shapes only at a restart.
"""
_CLEAR_M: Final = 20.0
_HAZE_M: Final = 110.0


class BulletCamera(WorldCamera):
    """Robot camera with PyBullet's renderer.

    Use it in a `with` block; the world need not be running.
    """

    def __init__(
        self, world: BulletWorld, spec: CameraSpec, depth: bool = False, egl: bool = False
    ) -> None:
        super().__init__(world, spec, depth)
        self._egl = egl
        self._canvas: BulletCanvas | None = None
        self._scene: BulletScene | None = None

    def __enter__(self) -> Self:
        if self._canvas is None:
            self._canvas = BulletCanvas(self._egl)
            self._scene = BulletScene(self._canvas, self._world)
        return self

    def close(self) -> None:
        """Close the renderer; a second call does nothing."""
        if self._canvas is not None:
            self._canvas.close()
            self._canvas = self._scene = None

    def _drawn(self, taken: Shot, street: Street, robot: RobotState | None, body: bool) -> Frame:
        if self._scene is not None and self._scene.built > _TILES_MAX:
            self.close()
            self.__enter__()
        if self._canvas is None or self._scene is None:
            raise EngineError("the camera is not running: use BulletCamera in a 'with' block")
        self._scene.arrange(taken.view, street)
        if robot is not None and body:
            self._scene.show_robot(posture_of(self._world.surface, self._world.robot, robot))
        rgb, labels, depth = self._canvas.draw(
            taken.eye_m, taken.target_m, taken.size, taken.fov_deg, NEAR_PLANE_M, FAR_PLANE_M
        )
        nothing = labels == LABELS["sky"]
        sky, below = _sky(taken.size[1], taken.fov_deg, round(taken.steep_rad, 4))
        rgb = _hazy(rgb, depth)
        rgb[nothing] = np.broadcast_to(sky, rgb.shape)[nothing]
        labels[nothing & below] = LABELS["ground"]
        return Frame(rgb, labels, depth if self._depth else None)


def _hazy(rgb: NDArray[np.uint8], depth: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Fade colours with distance to hide the edge of the drawn world."""
    share = np.clip((depth - _CLEAR_M) / _HAZE_M, 0.0, 0.85).astype(np.float32)[..., None]
    faded: NDArray[np.uint8] = (rgb * (1.0 - share) + _HAZE * share).astype(np.uint8)
    return faded


@lru_cache(maxsize=8)
def _sky(
    height: int, fov_deg: float, steep_rad: float
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Return (H, 1, 3) sky colours, haze at the horizon and blue above, and a mask.

    The mask (H, 1) marks the rows below the horizon.
    """
    rows = (0.5 - (np.arange(height) + 0.5) / height) * 2.0 * math.tan(math.radians(0.5 * fov_deg))
    rise = np.arctan(rows) - steep_rad
    up = np.clip(rise / 0.7, 0.0, 1.0)[:, None, None]
    colours: NDArray[np.uint8] = (_HAZE * (1.0 - up) + _ZENITH * up).astype(np.uint8)
    return colours, (rise < 0.0)[:, None]
