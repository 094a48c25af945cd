"""The textures of ground, walls, things and facades on the graphics card, shared by all cameras of a process."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import moderngl
import numpy as np
from numpy.typing import NDArray

from cosim.geometry import Floats
from physics.gl.shading import FACADES_UNIT, FINISH_UNIT, SURFACES_UNIT, Stage, programs
from physics.textures.facades import facade_layers
from physics.textures.ground import ground_layers
from physics.textures.layers import Layers, joined
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

    vertex: declares the uniforms `middle` (from the anchor), and `middle_in_world` where it needs that.
    """

    def __init__(
        self, context: moderngl.Context, surfaces: Surfaces, vertex: str, fragment: str, shadows: bool
    ) -> None:
        self.surfaces = surfaces
        self.programs = programs(context, KNOWN + vertex, LOOKED_UP + fragment, shadows)
        self._middles, self._in_world, known = (
            self.programs.uniforms(name) for name in ("middle", "middle_in_world", "layers")
        )
        for uniform in known:
            if uniform is not None:
                uniform.write(surfaces.known)

    def place(self, stage: Stage, middle: Floats, anchor: Floats) -> None:
        """Draw at (2,) `middle` in world metres from now on."""
        which = stage != "colour"
        (x, y), (x0, y0) = middle.tolist(), anchor.tolist()
        for uniform, value in ((self._middles[which], (x - x0, y - y0)), (self._in_world[which], (x, y))):
            if uniform is not None:
                uniform.value = value


@lru_cache(maxsize=1)
def surfaces(context: moderngl.Context) -> Surfaces:
    """Made once in a context; they stay as long as it."""
    flat, facades = joined(ground_layers(SIZE_PX), wall_layers(SIZE_PX), prop_layers(SIZE_PX)), facade_layers(SIZE_PX)
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
