"""Pictures in weather: drawn as linear light, then seen through rain, fog, drops and a sensor.

Labels and depth are those of the drawn picture.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import Final

import moderngl

from physics.cameras.gl.full_screen import VERTEX as FULL_SCREEN
from physics.cameras.gl.shading import SKY_UNIT, programs
from physics.cameras.gl.targets import Frame, Target
from physics.cameras.gl.variants import Variant
from physics.cameras.gl.weather_shaders import (
    AIR_COLOUR_UNIT,
    AIR_DEPTH_UNIT,
    AIR_FRAGMENT,
)

_SIZES_MAX: Final = 4


class LinearTarget(Frame):
    """Framebuffer of linear radiances with labels as fourth channel. size: width and height."""

    def __init__(self, context: moderngl.Context, size: tuple[int, int]) -> None:
        self.colour = context.texture(size, 4, dtype="f2")
        self.colour.filter = moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR
        self.colour.repeat_x = self.colour.repeat_y = False
        self.depth = context.depth_texture(size)
        self.depth.compare_func = ""
        self.frame = context.framebuffer([self.colour], self.depth)

    def release(self) -> None:
        for thing in (self.frame, self.colour, self.depth):
            thing.release()


class AirDrawing:
    """The pass from linear pictures to targets; one instance per context."""

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context
        self._sizes: OrderedDict[tuple[int, int], LinearTarget] = OrderedDict()
        self._arrays: dict[Variant, moderngl.VertexArray] = {}

    def target(self, size: tuple[int, int]) -> LinearTarget:
        """Return the linear target of a size; those of the last few sizes are cached."""
        held = self._sizes.pop(size, None)
        if held is None:
            if len(self._sizes) == _SIZES_MAX:
                self._sizes.popitem(last=False)[1].release()
            held = LinearTarget(self._context, size)
        self._sizes[size] = held
        return held

    def draw(
        self, variant: Variant, seen: LinearTarget, sky: moderngl.Texture, target: Target
    ) -> None:
        """Draw a linear picture into a target. Its scene and weather blocks must be bound.

        The depth of the picture stays in the linear target, until its next use.
        """
        gl = self._context
        seen.colour.build_mipmaps()
        seen.colour.use(AIR_COLOUR_UNIT)
        seen.depth.use(AIR_DEPTH_UNIT)
        sky.use(SKY_UNIT)
        target.use()
        target.drawn_in = seen.frame
        gl.enable_only(moderngl.NOTHING)
        self._array(variant).render(moderngl.TRIANGLES, vertices=3)
        gl.enable_only(moderngl.DEPTH_TEST | moderngl.CULL_FACE)

    def _array(self, variant: Variant) -> moderngl.VertexArray:
        plain = variant & ~Variant.SHADOWS
        if plain not in self._arrays:
            program = programs(self._context, FULL_SCREEN, AIR_FRAGMENT, plain).colour
            self._arrays[plain] = self._context.vertex_array(program, [])
        return self._arrays[plain]

    def release(self) -> None:
        while self._sizes:
            self._sizes.popitem()[1].release()
        for array in self._arrays.values():
            array.release()
        self._arrays = {}
