"""The textures of ground, walls, things and facades on the graphics card, shared by all cameras of a process."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import moderngl
import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from physics.cameras.gl.shading import FACADES_UNIT, FINISH_UNIT, SURFACES_UNIT, programs
from physics.textures.facades import facade_layers
from physics.textures.ground import ground_layers
from physics.textures.layers import Layers, joined_layers
from physics.textures.walls import prop_layers, wall_layers

SIZE_PX: Final = 256
LAYERS_MAX: Final = 72

LOOKED_UP: Final = f"""
layout(binding = {SURFACES_UNIT}) uniform sampler2DArray surfaces;
"""
"""For fragment shaders: `texture(surfaces, vec3(metres / side, layer))`, still to be `decoded`."""

KNOWN: Final = f"""
uniform vec4 layers[{LAYERS_MAX}];
vec3 tint_of(vec3 colour, int layer) {{ return decoded(colour) / layers[layer].rgb; }}
"""
"""For vertex shaders: of each layer its linear mean colour, and its side in metres."""


@dataclass(frozen=True, slots=True)
class Surfaces:
    """surfaces: layers of ground, walls and things; facades: bays of facades; known: the uniform `layers`,
    (LAYERS_MAX, 4)."""

    surfaces: Layers
    facades: Layers
    known: bytes
    _arrays: tuple[moderngl.TextureArray, ...]

    def bind(self) -> None:
        for array, unit in zip(self._arrays, (SURFACES_UNIT, FACADES_UNIT, FINISH_UNIT), strict=True):
            array.use(unit)


class SurfaceShaders:
    """Programs that look surfaces up, for buffers whose positions are relative to the middle of their tile.

    vertex: declares `in vec2 middle` (from the anchor), and `in vec2 middle_in_world` where it needs that.
    """

    def __init__(
        self, context: moderngl.Context, surfaces: Surfaces, vertex: str, fragment: str, shadows: bool
    ) -> None:
        self.surfaces = surfaces
        self.programs = programs(context, KNOWN + vertex, LOOKED_UP + fragment, shadows)
        for uniform in self.programs.uniforms("layers"):
            if uniform is not None:
                uniform.write(surfaces.known)


class TilePlace:
    """Where a tile is, as its programs read it. middle: (2,) world metres."""

    def __init__(self, context: moderngl.Context, middle: Floats) -> None:
        self._middle, self._anchor = middle, np.full(2, np.nan)
        self._buffer = context.buffer(reserve=16)
        self.content = self._buffer, "2f 2f /i", "middle", "middle_in_world"

    def seen_from(self, anchor: Floats) -> None:
        """Be at the middle from (2,) `anchor` on."""
        if anchor is not self._anchor:
            self._anchor = anchor
            self._buffer.write(np.concatenate([self._middle - anchor, self._middle]).astype(np.float32))

    def release(self) -> None:
        self._buffer.release()


@lru_cache(maxsize=1)
def surfaces(context: moderngl.Context) -> Surfaces:
    """Made once in a context; they stay as long as it."""
    flat, facades = (
        joined_layers(ground_layers(SIZE_PX), wall_layers(SIZE_PX), prop_layers(SIZE_PX)),
        facade_layers(SIZE_PX),
    )
    known = np.ones((LAYERS_MAX, 4), dtype=np.float32)
    known[: len(flat), :3], known[: len(flat), 3] = flat.mean, flat.metres[:, 0]
    assert facades.finish is not None
    arrays = tuple(_array(context, texels) for texels in (flat.rgba, facades.rgba, facades.finish))
    return Surfaces(flat, facades, known.tobytes(), arrays)


def _array(context: moderngl.Context, texels: NDArray[np.uint8]) -> moderngl.TextureArray:
    count, size, _, channels = texels.shape
    array = context.texture_array((size, size, count), channels, texels.tobytes())
    array.build_mipmaps()
    array.filter = moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR
    array.repeat_x = array.repeat_y = True
    return array
