"""Shadow maps from the sun: one for static objects and one for moving objects.

Scenes whose pictures are drawn as layers share arrays of maps; others have two maps of their own.

Both maps cover one box around a point of a coarse lattice near the eye.
The box is aligned to whole texels, so that shadows do not shimmer.
The static map is redrawn only when that point changes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from itertools import count
from typing import Final

import moderngl
import numpy as np

from cosim.core.geometry import Floats
from physics.cameras.gl.gl_state import polygon_offset
from physics.cameras.gl.layers import DepthLayers
from physics.cameras.gl.lighting import Lighting
from physics.cameras.gl.shading import MOVING_UNIT, STILL_UNIT, Pass
from physics.cameras.gl.shots import Lattice

SHADOW_REACH_M: Final = 32.0
"""Half the side of the square that has shadows, metres."""
_DEEP_M: Final = 80.0
_STILL_PX: Final = 2048
_MOVING_PX: Final = 768
_SMALL_PX: Final = (300, 160)
"""Picture heights up to which maps have half these sides: static map, moving map."""
TO_TEXTURE: Final = np.array(
    [[0.5, 0.0, 0.0, 0.5], [0.0, 0.5, 0.0, 0.5], [0.0, 0.0, 0.5, 0.5], [0.0, 0.0, 0.0, 1.0]]
)
"""Matrix from clip space to texture space."""
NO_SUN: Final = np.eye(4)
"""Matrix of a shadow pass that is never drawn."""


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


def sides_px(high_px: int) -> tuple[int, int]:
    """Return the sides of the static and the moving map of pictures of a height."""
    still, moving = (
        px // 2 if high_px <= small_px else px
        for px, small_px in zip((_STILL_PX, _MOVING_PX), _SMALL_PX, strict=True)
    )
    return still, moving


@contextmanager
def casting(context: moderngl.Context) -> Iterator[None]:
    """Set the GL state for drawing shadow maps within a `with` block."""
    context.enable_only(moderngl.DEPTH_TEST)
    context.depth_func = "<"
    with polygon_offset(context, 1.5, 4.0):
        yield


class SunView:
    """View of a scene from the sun. side_px: side of the static map."""

    def __init__(self, side_px: int) -> None:
        self._side_px = side_px
        self._matrices_for: tuple[object, ...] | None = None
        self._matrices: tuple[Floats, Floats] = np.eye(4), TO_TEXTURE

    def matrices(self, lattice: Lattice, light: Lighting) -> tuple[Floats, Floats]:
        """Return `shadow_matrix`, and the same to texture space; the last ones are cached."""
        key = lattice.anchor, lattice.middle
        if key != self._matrices_for:
            middle, anchor = np.array(lattice.middle), np.array(lattice.anchor)
            from_at = shadow_matrix(middle, anchor, light.to_sun, self._side_px)
            self._matrices_for = key
            self._matrices = (from_at, TO_TEXTURE @ from_at)
        return self._matrices


class ShadowMaps(SunView):
    """Two depth maps from the sun of one scene. high_px: height of the pictures that use them."""

    def __init__(self, context: moderngl.Context, high_px: int) -> None:
        self._context = context
        still_px, moving_px = sides_px(high_px)
        super().__init__(still_px)
        self._still, self._moving = self._texture(still_px), self._texture(moving_px)
        self._frames = {
            "still": context.framebuffer(depth_attachment=self._still),
            "moving": context.framebuffer(depth_attachment=self._moving),
        }
        self._drawn_for: tuple[float, ...] | None = None

    def _texture(self, pixels: int) -> moderngl.Texture:
        texture = self._context.depth_texture((pixels, pixels))
        texture.compare_func = "<="
        texture.filter = moderngl.LINEAR, moderngl.LINEAR
        texture.repeat_x = texture.repeat_y = False
        return texture

    def draw(self, lattice: Lattice, light: Lighting, draw: Callable[[Pass], None]) -> None:
        """Update the maps, within `casting`.

        The scene block must hold their matrix as its camera.
        """
        key = (*lattice.anchor, *lattice.middle, *light.to_sun.tolist())
        if key != self._drawn_for:
            self._drawn_for = None
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


class ShadowSlot(SunView):
    """A scene in `ShadowLayers`. layer: of its static map; to_sun: x, y, z"""

    def __init__(self, maps: ShadowLayers, light: Lighting) -> None:
        super().__init__(maps.sides_px[0])
        self.maps = maps
        self.layer = maps.take()
        self.to_sun: tuple[float, ...] = tuple(light.to_sun.tolist())

    def release(self) -> None:
        self.maps.give(self.layer)


class ShadowLayers:
    """Shadow maps as layers of two arrays: static ones by scene, moving ones by picture."""

    def __init__(self, context: moderngl.Context, sides: tuple[int, int]) -> None:
        self.sides_px = sides
        self._still, self._moving = (
            DepthLayers(context, (side, side), shadow=True) for side in sides
        )
        self._taken: set[int] = set()
        self._drawn: dict[int, object] = {}

    def take(self) -> int:
        """Return an unused layer of the static maps."""
        layer = next(i for i in count() if i not in self._taken)
        self._taken.add(layer)
        return layer

    def give(self, layer: int) -> None:
        """Return a layer from `take`."""
        self._taken.remove(layer)
        self._drawn.pop(layer, None)

    @contextmanager
    def begin_still(self, wanted: Mapping[int, object]) -> Iterator[list[int]]:
        """Clear the static maps to be drawn within a `with` block, and return their layers.

        wanted: what the map of each layer depends on
        """
        if self._still.room(max(self._taken, default=0) + 1):
            self._drawn.clear()
        changed = [layer for layer, key in wanted.items() if self._drawn.get(layer) != key]
        for layer in changed:
            self._drawn.pop(layer, None)
            self._still.clear(layer)
        if changed:
            self._still.use()
        yield changed
        self._drawn.update((layer, wanted[layer]) for layer in changed)

    def begin_moving(self, pictures: int, clear: bool) -> None:
        """Draw into the maps of the moving objects of a batch from now on."""
        self._moving.room(pictures)
        self._moving.use()
        if clear:
            self._moving.clear_all()

    def bind(self) -> None:
        self._still.bind(STILL_UNIT)
        self._moving.bind(MOVING_UNIT)


def shadow_layers(context: moderngl.Context, high_px: int) -> ShadowLayers:
    """Return the context's maps for pictures of a height, with the same lifetime."""
    return _layers_of(context, sides_px(high_px))


@lru_cache(maxsize=8)
def _layers_of(context: moderngl.Context, sides: tuple[int, int]) -> ShadowLayers:
    return ShadowLayers(context, sides)
