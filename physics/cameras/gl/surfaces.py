"""Textures of ground, walls, objects and facades on the graphics card, shared by all cameras of a
process.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import moderngl
import numpy as np
from numpy.typing import NDArray

from physics.cameras.gl.context import is_card
from physics.cameras.gl.corners import CornerRows
from physics.cameras.gl.mipmaps import mipmapped
from physics.cameras.gl.shading import FACADES_UNIT, FINISH_UNIT, SURFACES_UNIT, programs
from physics.textures.decals import decal_layers
from physics.textures.facades import facade_layers
from physics.textures.ground import ground_layers
from physics.textures.layers import Layers, join_layers
from physics.textures.walls import prop_layers, wall_layers

SIZE_PX: Final = 256
LAYERS_MAX: Final = 96

LOOKED_UP: Final = f"""
layout(binding = {SURFACES_UNIT}) uniform sampler2DArray surfaces;
"""
"""Fragment shader code: `texture(surfaces, vec3(metres / side, layer))`, still to be `decoded`."""

KNOWN: Final = f"""
uniform vec4 layers[{LAYERS_MAX}];
vec3 tint_of(vec3 colour, int layer) {{ return decoded(colour) / layers[layer].rgb; }}
"""
"""Vertex shader code: for each layer, its linear mean colour and its side in metres."""


@dataclass(frozen=True, slots=True)
class Surfaces:
    """Textures of a context.

    surfaces: layers of ground, walls and objects
    facades: bays of facades
    known: the uniform `layers`, (LAYERS_MAX, 4)
    """

    surfaces: Layers
    facades: Layers
    known: bytes
    _arrays: tuple[moderngl.TextureArray, ...]

    def bind(self) -> None:
        for array, unit in zip(
            self._arrays, (SURFACES_UNIT, FACADES_UNIT, FINISH_UNIT), strict=True
        ):
            array.use(unit)


class SurfaceShaders:
    """Programs with surface textures, for buffers with positions relative to the tile's middle.

    vertex: declares `in vec2 middle` (from the anchor), and `in vec2 middle_in_world` if needed
    """

    def __init__(
        self,
        context: moderngl.Context,
        surfaces: Surfaces,
        vertex: str,
        fragment: str,
        shadows: int,
    ) -> None:
        self.surfaces = surfaces
        self.programs = programs(context, KNOWN + vertex, LOOKED_UP + fragment, shadows)
        for uniform in self.programs.uniforms("layers"):
            if uniform is not None:
                uniform.write(surfaces.known)


TileRows = tuple[CornerRows, NDArray[np.uint32]]
"""Joined meshes of one tile: vertex rows relative to the tile's middle, and flat triangles."""


@lru_cache(maxsize=1)
def surfaces(context: moderngl.Context) -> Surfaces:
    """Return the context's textures, created once and with the same lifetime."""
    flat = join_layers(
        *(make(SIZE_PX) for make in (ground_layers, wall_layers, prop_layers, decal_layers))
    )
    facades = facade_layers(SIZE_PX)
    known = np.ones((LAYERS_MAX, 4), dtype=np.float32)
    known[: len(flat), :3], known[: len(flat), 3] = flat.mean, flat.metres[:, 0]
    assert facades.finish is not None
    arrays = tuple(_array(context, texels) for texels in (flat.rgba, facades.rgba, facades.finish))
    return Surfaces(flat, facades, known.tobytes(), arrays)


def _array(context: moderngl.Context, texels: NDArray[np.uint8]) -> moderngl.TextureArray:
    array = mipmapped(context, texels)
    # Steps between mipmap levels are invisible; a software renderer then reads half as much.
    array.filter = (
        moderngl.LINEAR_MIPMAP_LINEAR if is_card(context) else moderngl.LINEAR_MIPMAP_NEAREST,
        moderngl.LINEAR,
    )
    array.repeat_x = array.repeat_y = True
    return array
