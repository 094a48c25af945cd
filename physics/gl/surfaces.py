"""The textures of ground, walls and facades on the graphics card, shared by all cameras of a process."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import moderngl
import numpy as np
from numpy.typing import NDArray

from physics.gl.shading import FACADES_UNIT, SURFACES_UNIT
from physics.textures.facades import facade_layers
from physics.textures.ground import ground_layers
from physics.textures.layers import Layers, joined
from physics.textures.walls import wall_layers

SIZE_PX: Final = 256
LAYERS_MAX: Final = 64

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
    """surfaces: layers of ground and walls; facades: bays of facades; known: the uniform `layers`, (LAYERS_MAX, 4)."""

    surfaces: Layers
    facades: Layers
    known: bytes
    _arrays: tuple[moderngl.TextureArray, moderngl.TextureArray]

    def bind(self) -> None:
        self._arrays[0].use(SURFACES_UNIT)
        self._arrays[1].use(FACADES_UNIT)


@lru_cache(maxsize=1)
def surfaces(context: moderngl.Context) -> Surfaces:
    """Made once in a context; they stay as long as it."""
    flat, facades = joined(ground_layers(SIZE_PX), wall_layers(SIZE_PX)), facade_layers(SIZE_PX)
    known = np.ones((LAYERS_MAX, 4), dtype=np.float32)
    known[: len(flat), :3], known[: len(flat), 3] = flat.mean, flat.metres[:, 0]
    return Surfaces(flat, facades, known.tobytes(), (_array(context, flat.rgba), _array(context, facades.rgba)))


def _array(context: moderngl.Context, rgba: NDArray[np.uint8]) -> moderngl.TextureArray:
    count, size, _, _ = rgba.shape
    array = context.texture_array((size, size, count), 4, rgba.tobytes())
    array.build_mipmaps()
    array.filter = moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR
    array.repeat_x = array.repeat_y = True
    return array
