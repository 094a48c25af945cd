"""The textures of ground, walls, things and facades on the graphics card, shared by all cameras of a process."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import moderngl
import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from physics.cameras.gl.corners import CornerRows, joined_corners
from physics.cameras.gl.shading import FACADES_UNIT, FINISH_UNIT, SURFACES_UNIT, Pass, programs
from physics.textures.facades import facade_layers
from physics.textures.ground import ground_layers
from physics.textures.layers import Layers, joined_layers
from physics.textures.walls import prop_layers, wall_layers
from physics.world.mesh import Mesh

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


class TileBuffers:
    """Meshes of one tile with their rows as vertices, uploaded once and drawn in their order. layout: of a row, as
    moderngl wants it; middle: (2,) world metres of the tile's, from which positions are measured."""

    def __init__(
        self,
        context: moderngl.Context,
        shaders: SurfaceShaders,
        layout: tuple[str, ...],
        parts: Sequence[tuple[Mesh, CornerRows]],
        middle: Floats,
    ) -> None:
        self._middle, self._anchor = middle, np.full(2, np.nan)
        self._place = context.buffer(reserve=16)
        self._buffers = [self._place]
        self._arrays: list[moderngl.VertexArray] = []
        if parts:
            rows, triangles = (context.buffer(held.tobytes()) for held in joined_corners(parts))
            self._buffers += [rows, triangles]
            content = [(rows, *layout), (self._place, "2f 2f /i", "middle", "middle_in_world")]
            self._arrays = [context.vertex_array(one, content, triangles, skip_errors=True) for one in shaders.programs]

    def draw(self, stage: Pass, anchor: Floats) -> None:
        if self._arrays and stage != "moving":
            if anchor is not self._anchor:
                self._anchor = anchor
                self._place.write(np.concatenate([self._middle - anchor, self._middle]).astype(np.float32))
            self._arrays[stage != "colour"].render()

    def release(self) -> None:
        for array in self._arrays:
            array.release()
        for buffer in self._buffers:
            buffer.release()


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
