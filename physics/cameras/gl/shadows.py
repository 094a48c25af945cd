"""Shadow maps from the sun: one for static objects and one for moving objects.

Both maps cover one box around a point of a coarse lattice near the eye.
The box is aligned to whole texels, so that shadows do not shimmer.
The static map is redrawn only when that point changes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final

import moderngl
import numpy as np

from cosim.core.geometry import Floats
from physics.cameras.gl.lighting import Lighting
from physics.cameras.gl.shading import MOVING_UNIT, STILL_UNIT, Pass

SHADOW_REACH_M: Final = 32.0
"""Half the side of the square that has shadows, metres."""
STEP_M: Final = 8.0
"""Spacing of the lattice of shadow box middles, metres."""
_DEEP_M: Final = 80.0
_STILL_PX: Final = 2048
_MOVING_PX: Final = 512
_SMALL_PX: Final = (300, 160)
"""Picture heights up to which a half-size map looks the same: static map, moving map."""
TO_TEXTURE: Final = np.array(
    [[0.5, 0.0, 0.0, 0.5], [0.0, 0.5, 0.0, 0.5], [0.0, 0.0, 0.5, 0.5], [0.0, 0.0, 0.0, 1.0]]
)
"""Matrix from clip space to texture space."""


def middle_of(eye_m: Floats) -> Floats:
    """Return the (3,) middle of the space with shadows around an eye, world metres."""
    return np.asarray(np.round(eye_m / STEP_M) * STEP_M)


def shadow_matrix(
    middle: Floats, anchor: Floats, to_sun: Floats, side_px: int = _STILL_PX
) -> Floats:
    """Return the (4, 4) matrix from metres relative to the anchor to the clip space of the maps.

    side_px: side of the finer map
    """
    sun = to_sun / np.linalg.norm(to_sun)
    across = np.cross((0.0, 0.0, 1.0), sun)
    across = (
        across / np.linalg.norm(across)
        if np.linalg.norm(across) > 1e-6
        else np.array([1.0, 0.0, 0.0])
    )
    rows = np.stack([across, np.cross(sun, across), -sun])
    texel = 2.0 * SHADOW_REACH_M / side_px
    centre = rows @ middle
    centre[:2] = np.round(centre[:2] / texel) * texel
    shift = rows @ np.array([*anchor, 0.0]) - centre
    scale = np.array([1.0 / SHADOW_REACH_M, 1.0 / SHADOW_REACH_M, 1.0 / _DEEP_M])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rows * scale[:, None], shift * scale
    return matrix


@contextmanager
def casting(context: moderngl.Context) -> Iterator[None]:
    """Set the GL state for drawing shadow maps within a `with` block."""
    context.enable_only(moderngl.DEPTH_TEST)
    context.depth_func = "<"
    context.polygon_offset = 1.5, 4.0
    yield
    context.polygon_offset = 0.0, 0.0


class ShadowMaps:
    """Two depth maps from the sun. high_px: height of the pictures that use them."""

    def __init__(self, context: moderngl.Context, high_px: int) -> None:
        self._context = context
        self._side_px, moving_px = (
            px // 2 if high_px <= small_px else px
            for px, small_px in zip((_STILL_PX, _MOVING_PX), _SMALL_PX, strict=True)
        )
        self._still, self._moving = self._texture(self._side_px), self._texture(moving_px)
        self._frames = {
            "still": context.framebuffer(depth_attachment=self._still),
            "moving": context.framebuffer(depth_attachment=self._moving),
        }
        self._drawn_for: tuple[float, ...] | None = None
        self._matrices_for: tuple[float, ...] | None = None
        self._matrices: tuple[Floats, Floats] = np.eye(4), TO_TEXTURE

    def _texture(self, pixels: int) -> moderngl.Texture:
        texture = self._context.depth_texture((pixels, pixels))
        texture.compare_func = "<="
        texture.filter = moderngl.LINEAR, moderngl.LINEAR
        texture.repeat_x = texture.repeat_y = False
        return texture

    def matrices(self, middle: Floats, anchor: Floats, light: Lighting) -> tuple[Floats, Floats]:
        """Return `shadow_matrix`, and the same to texture space; the last ones are cached."""
        key = (*middle.tolist(), *anchor.tolist())
        if key != self._matrices_for:
            from_at = shadow_matrix(middle, anchor, light.to_sun, self._side_px)
            self._matrices_for = key
            self._matrices = (from_at, TO_TEXTURE @ from_at)
        return self._matrices

    def draw(
        self, middle: Floats, anchor: Floats, light: Lighting, draw: Callable[[Pass], None]
    ) -> None:
        """Update the maps, within `casting`.

        The scene block must hold their matrix as its camera.
        """
        key = (*middle.tolist(), *anchor.tolist(), *light.to_sun.tolist())
        if key != self._drawn_for:
            self._draw("still", draw)
            self._drawn_for = key
        self._draw("moving", draw)

    def _draw(self, stage: Pass, draw: Callable[[Pass], None]) -> None:
        frame = self._frames[stage]
        frame.use()
        frame.clear(depth=1.0)
        draw(stage)

    def bind(self) -> None:
        self._still.use(STILL_UNIT)
        self._moving.use(MOVING_UNIT)

    def release(self) -> None:
        for frame in self._frames.values():
            frame.release()
        self._still.release()
        self._moving.release()
