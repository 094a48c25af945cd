"""Array textures as targets: one draw fills many pictures, each a layer.

moderngl has no array textures of depths, so the driver is called for these. A vertex shader selects
the layer (GL_ARB_shader_viewport_layer_array).
"""

from __future__ import annotations

import ctypes
from collections import OrderedDict
from typing import Final

import moderngl

from cosim.core.errors import EngineError
from physics.cameras.gl.driver import function
from physics.cameras.gl.shading import PICTURES_MAX
from physics.cameras.gl.targets import Frame

_SIZES_MAX: Final = 4
_TEXTURE_2D_ARRAY: Final = 0x8C1A
_DEPTH_COMPONENT: Final = 0x1902
_DEPTH_COMPONENT24: Final = 0x81A6
_FLOAT: Final = 0x1406
_FRAMEBUFFER: Final = 0x8D40
_DEPTH_ATTACHMENT: Final = 0x8D00
_TEXTURE0: Final = 0x84C0
_NEAREST: Final = 0x2600
_LINEAR: Final = 0x2601
_CLAMP_TO_EDGE: Final = 0x812F
_COMPARE_REF_TO_TEXTURE: Final = 0x884E
_LEQUAL: Final = 0x0203
_MIN_FILTER: Final = 0x2801
_MAG_FILTER: Final = 0x2800
_WRAP_S: Final = 0x2802
_WRAP_T: Final = 0x2803
_COMPARE_MODE: Final = 0x884C
_COMPARE_FUNC: Final = 0x884D


class DepthLayers:
    """Depths of layers, in a framebuffer of their own or of a `LayerTarget`.

    shadow: compared when they are read
    """

    def __init__(
        self, context: moderngl.Context, size: tuple[int, int], shadow: bool = False
    ) -> None:
        self._context = context
        self._size = size
        self._shadow = shadow
        self._name = 0
        self.layers = 0
        self._frame: moderngl.Framebuffer | None = None

    def room(self, layers: int) -> bool:
        """Ensure `layers` layers, and return whether this discarded all of them."""
        if layers <= self.layers:
            return False
        layers = max(layers, min(self.layers * 3 // 2, PICTURES_MAX))
        self.release()
        self._name = self._texture(layers)
        try:
            if self._shadow:
                self._frame = self._framebuffer()
        except BaseException:
            self.release()
            raise
        self.layers = layers
        return True

    def _framebuffer(self) -> moderngl.Framebuffer:
        """Create the framebuffer of shadow maps."""
        # It needs another depth at first, as moderngl does not create empty framebuffers.
        depth = self._context.depth_texture(self._size)
        frame = self._context.framebuffer(depth_attachment=depth)
        self.attach(frame)
        depth.release()
        return frame

    def attach(self, frame: moderngl.Framebuffer) -> None:
        """Make them the depths of a framebuffer."""
        frame.use()
        function("glFramebufferTexture", "uuui")(_FRAMEBUFFER, _DEPTH_ATTACHMENT, self._name, 0)

    def use(self) -> None:
        """Make them the target of later draws."""
        assert self._frame is not None
        self._frame.use()

    def clear_all(self) -> None:
        assert self._frame is not None
        self._frame.clear(depth=1.0)

    def clear(self, layer: int) -> None:
        """Clear one layer."""
        far = ctypes.c_float(1.0)
        function("glClearTexSubImage", "uiiiiiiiuup")(
            *(self._name, 0, 0, 0, layer, *self._size, 1),
            *(_DEPTH_COMPONENT, _FLOAT, ctypes.addressof(far)),
        )

    def bind(self, unit: int) -> None:
        function("glActiveTexture", "u")(_TEXTURE0 + unit)
        function("glBindTexture", "uu")(_TEXTURE_2D_ARRAY, self._name)

    def release(self) -> None:
        if self._frame is not None:
            self._frame.release()
            self._frame = None
        if self._name:
            name = ctypes.c_uint(self._name)
            function("glDeleteTextures", "ip")(1, ctypes.addressof(name))
            self._name = 0
        self.layers = 0

    def _texture(self, layers: int) -> int:
        """Create the texture; return its name."""
        name = ctypes.c_uint(0)
        error = function("glGetError", "", "u")
        error()  # clears the error of an earlier call
        function("glGenTextures", "ip")(1, ctypes.addressof(name))
        function("glActiveTexture", "u")(_TEXTURE0 + self._context.default_texture_unit)
        function("glBindTexture", "uu")(_TEXTURE_2D_ARRAY, name.value)
        function("glTexStorage3D", "uiuiii")(
            _TEXTURE_2D_ARRAY, 1, _DEPTH_COMPONENT24, *self._size, layers
        )
        set_to = function("glTexParameteri", "uui")
        filter_ = _LINEAR if self._shadow else _NEAREST
        values = {_MIN_FILTER: filter_, _MAG_FILTER: filter_}
        values |= {_WRAP_S: _CLAMP_TO_EDGE, _WRAP_T: _CLAMP_TO_EDGE}
        if self._shadow:
            values |= {_COMPARE_MODE: _COMPARE_REF_TO_TEXTURE, _COMPARE_FUNC: _LEQUAL}
        for key, value in values.items():
            set_to(_TEXTURE_2D_ARRAY, key, value)
        if error():
            function("glDeleteTextures", "ip")(1, ctypes.addressof(name))
            raise EngineError(
                f"the graphics driver has no memory for {layers} layers of "
                f"{self._size[0]} x {self._size[1]} pixels: draw fewer or smaller pictures at a time"
            )
        return name.value


class LayerTarget(Frame):
    """Pictures of one size as layers, with labels as fourth channel."""

    def __init__(self, context: moderngl.Context, size: tuple[int, int]) -> None:
        self._context = context
        self.size = size
        self._depth = DepthLayers(context, size)
        self.colour: moderngl.TextureArray | None = None
        self._made: list[moderngl.TextureArray | moderngl.Framebuffer] = []

    def room(self, layers: int) -> None:
        """Ensure `layers` layers. Growing discards earlier pictures."""
        if not self._depth.room(layers):
            return
        self._release_colour()
        try:
            self.colour = self._context.texture_array((*self.size, self._depth.layers), 4)
            self._made.append(self.colour)
            self.colour.filter = moderngl.NEAREST, moderngl.NEAREST
            self.frame = self._context.framebuffer([self.colour])
            self._made.append(self.frame)
            self._depth.attach(self.frame)
            # moderngl masks the depths of a framebuffer that it created without any.
            self.frame.depth_mask = True
        except BaseException:
            self.release()
            raise

    def release(self) -> None:
        self._depth.release()
        self._release_colour()

    def _release_colour(self) -> None:
        self.colour = None
        while self._made:
            self._made.pop().release()


class LayerTargets:
    """Layer targets of the last few sizes; one instance per context."""

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context
        self._sizes: OrderedDict[tuple[int, int], LayerTarget] = OrderedDict()

    def of(self, size: tuple[int, int], layers: int) -> LayerTarget:
        """Return the target of a size with at least `layers` layers."""
        held = self._sizes.pop(size, None)
        if held is None:
            if len(self._sizes) == _SIZES_MAX:
                self._sizes.popitem(last=False)[1].release()
            held = LayerTarget(self._context, size)
        self._sizes[size] = held
        held.room(layers)
        return held
