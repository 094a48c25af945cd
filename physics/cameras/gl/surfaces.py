"""Textures of ground, walls, objects and facades on the graphics card, shared by all cameras of a
process.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import moderngl
import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from physics.cameras.gl.context import is_card
from physics.cameras.gl.corners import CornerRows
from physics.cameras.gl.shading import FACADES_UNIT, FINISH_UNIT, SURFACES_UNIT, Pass, programs
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


class TileLayer:
    """Meshes of the surrounding tiles, uploaded when the tiles change.

    One call draws those in view.
    layout: of a row, for moderngl
    """

    def __init__(
        self, context: moderngl.Context, shaders: SurfaceShaders, layout: tuple[str, ...]
    ) -> None:
        self._context = context
        self._shaders = shaders
        self._layout = layout
        self._buffers: list[moderngl.Buffer] = []
        self._arrays: list[moderngl.VertexArray] = []
        self._draws = np.zeros((0, 5), dtype=np.uint32)
        self._counts = {"colour": 0, "still": 0}

    def hold(self, tiles: Sequence[TileRows | None], middles: Floats) -> None:
        """Replace all tiles. middles: (T, 2) world metres of each."""
        self.release()
        self._middles = middles
        held = [tile for tile in tiles if tile is not None]
        if not held:
            return
        ends = np.cumsum(
            [(0, 0)] + [(len(t[0]), len(t[1])) if t else (0, 0) for t in tiles], axis=0
        )
        self._draws = np.zeros((len(tiles), 5), dtype=np.uint32)
        self._draws[:, 0], self._draws[:, 1], self._draws[:, 2:4] = (
            np.diff(ends[:, 1]),
            1,
            ends[:-1, ::-1],
        )
        self._draws[:, 4] = np.arange(len(tiles))
        rows, triangles = (
            self._context.buffer(np.concatenate(part).tobytes()) for part in zip(*held, strict=True)
        )
        self._place = self._context.buffer(reserve=16 * len(tiles))
        self._commands = {
            name: self._context.buffer(reserve=20 * len(tiles)) for name in self._counts
        }
        self._buffers = [rows, triangles, self._place, *self._commands.values()]
        content = [(rows, *self._layout), (self._place, "2f 2f /i", "middle", "middle_in_world")]
        self._arrays = [
            self._context.vertex_array(one, content, triangles, skip_errors=True)
            for one in self._shaders.programs
        ]

    def place(self, anchor: Floats) -> None:
        """Set the anchor that all tiles are relative to."""
        if self._arrays:
            self._place.write(np.hstack([self._middles - anchor, self._middles]).astype(np.float32))

    def show(self, stage: Pass, tiles: NDArray[np.intp]) -> None:
        """Select the tiles to draw from now on, in this order."""
        if self._arrays:
            draws = self._draws[tiles]
            draws = draws[draws[:, 0] > 0]
            self._commands[stage].write(draws)
            self._counts[stage] = len(draws)

    def draw(self, stage: Pass) -> None:
        if self._counts.get(stage, 0):
            self._render(stage, self._arrays[stage != "colour"])

    def _render(self, stage: Pass, array: moderngl.VertexArray) -> None:
        count = self._counts[stage]
        array.render_indirect(self._commands[stage], moderngl.TRIANGLES, count=count)

    def draw_seen(self) -> None:
        """Draw the picture of surfaces that hide one another, and shade only what is seen.

        The depth comes first on a software renderer, which spends its time on shading.
        """
        gl = self._context
        if not self._counts["colour"]:
            return
        if is_card(gl):
            self.draw("colour")
            return
        frame = gl.fbo
        frame.color_mask = False, False, False, False
        frame.use()
        self._render("colour", self._arrays[1])
        frame.color_mask = True, True, True, True
        frame.use()
        gl.depth_func = "<="
        self.draw("colour")
        gl.depth_func = "<"

    def release(self) -> None:
        for array in self._arrays:
            array.release()
        for buffer in self._buffers:
            buffer.release()
        self._arrays = []
        self._buffers = []
        self._counts = {"colour": 0, "still": 0}


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
    count, size, _, channels = texels.shape
    array = context.texture_array((size, size, count), channels, texels.tobytes())
    array.build_mipmaps()
    # Steps between mipmap levels are invisible; a software renderer then reads half as much.
    array.filter = (
        moderngl.LINEAR_MIPMAP_LINEAR if is_card(context) else moderngl.LINEAR_MIPMAP_NEAREST,
        moderngl.LINEAR,
    )
    array.repeat_x = array.repeat_y = True
    return array
