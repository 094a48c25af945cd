"""Readback of drawn pictures.

All pictures of a batch are read at once, while the next batch is drawn.
"""

from __future__ import annotations

import ctypes
import weakref
from collections import deque
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

import moderngl
import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import EngineError
from physics.cameras.gl.context import is_card
from physics.cameras.gl.driver import flush, function
from physics.cameras.gl.layers import LayerTarget
from physics.cameras.gl.targets import Target

_UNIT: Final = 8
"""Texture unit of the layers to be read."""
_BYTES_BINDING: Final = 2
_GROUP: Final = 64
_LENT_MAX: Final = 3
"""Maximum number of batches whose memory the caller holds; later ones are copied."""
_PIXEL_PACK_BUFFER: Final = 0x88EB
_MAP_READ_WRITE: Final = 0x0003
_MAP_PERSISTENT: Final = 0x0040
_MAP_COHERENT: Final = 0x0080
_CLIENT_STORAGE: Final = 0x0200
_GPU_COMMANDS_COMPLETE: Final = 0x9117
_FLUSH_COMMANDS: Final = 1
_FOREVER_NS: Final = (1 << 64) - 1

Pictures = list[tuple[NDArray[np.uint8], NDArray[np.uint8]]]
"""Colours (H, W, 3) and labels (H, W) of each picture, the top row first."""


class _Landing:
    """Memory of the processor that the graphics card writes to. size: bytes"""

    def __init__(self, context: moderngl.Context, size: int) -> None:
        self.size = size
        name = ctypes.c_uint(0)
        function("glGenBuffers", "ip")(1, ctypes.addressof(name))
        bind = function("glBindBuffer", "uu")
        bind(_PIXEL_PACK_BUFFER, name.value)
        flags = _MAP_READ_WRITE | _MAP_PERSISTENT | _MAP_COHERENT
        function("glBufferStorage", "ulpu")(_PIXEL_PACK_BUFFER, size, None, flags | _CLIENT_STORAGE)
        at = function("glMapBufferRange", "ullu", "p")(_PIXEL_PACK_BUFFER, 0, size, flags)
        bind(_PIXEL_PACK_BUFFER, 0)
        if not at:
            raise EngineError(
                f"the graphics driver has no memory for {size} bytes of pictures: draw fewer or "
                "smaller pictures at a time"
            )
        self._at = at
        self._name = name
        self.buffer = context.external_buffer(name.value, size)
        self._lent: weakref.ref[Any] | None = None

    @property
    def lent(self) -> bool:
        """Whether arrays from `lend` are in use."""
        return self._lent is not None and self._lent() is not None

    def lend(self) -> NDArray[np.uint8]:
        """Return the memory as an array. It is written again once this and its views are gone."""
        memory = (ctypes.c_ubyte * self.size).from_address(self._at)
        self._lent = weakref.ref(memory)
        return np.asarray(np.frombuffer(memoryview(memory), dtype=np.uint8))

    def release(self) -> None:
        """Free the memory; no array may be in use."""
        function("glDeleteBuffers", "ip")(1, ctypes.addressof(self._name))


class Readback:
    """Asynchronous readback of pictures.

    Pictures are queued one after another into memory, and returned later, while the next are drawn.
    Returned arrays are views of this memory; pictures that are kept for long are copies.

    target: source of the pictures that are not layers
    """

    UNDER_WAY: Final = 2
    """Maximum number of pending batches."""

    def __init__(self, context: moderngl.Context, target: Target) -> None:
        self._context = context
        self._target = target
        self._each = target.size[0] * target.size[1] * 4
        self._on_card = is_card(context)
        self._written: moderngl.Buffer | None = None
        self._landings: list[_Landing] = []
        self._begun: deque[_Begun] = deque()

    def begin(self, pictures: int = 1) -> None:
        """Reserve memory for `pictures` pictures, which are taken next."""
        if len(self._begun) == self.UNDER_WAY:
            raise EngineError("too many pictures are under way: `end` some first")
        landing = self._landing(max(pictures, 1) * self._each)
        self._begun.append(_Begun(landing, pictures))

    def take(self, place: int = 0) -> None:
        """Queue a copy of the target to a place of the most recent batch."""
        self._target.copy(self._buffer, place * self._each)

    def take_layers(self, drawn: LayerTarget, first: int, count: int, place: int) -> None:
        """Queue a copy of `count` layers from `first` on to places of the most recent batch."""
        assert drawn.colour is not None
        program = _parting(self._context)
        drawn.colour.use(_UNIT)
        self._buffer.bind_to_storage_buffer(_BYTES_BINDING)
        words = self._each // 4
        program["places"] = first, place * words, words
        self._context.memory_barrier()  # llvmpipe else does not see a clear without draws
        program.run((words + _GROUP - 1) // _GROUP, count)
        self._context.memory_barrier()

    def send(self) -> None:
        """Queue the transfer of the most recent batch, after its last picture."""
        begun = self._begun[-1]
        if self._written is not None and begun.pictures:
            size = begun.pictures * self._each
            self._context.copy_buffer(begun.landing.buffer, self._written, size=size)
        begun.fence = function("glFenceSync", "uu", "p")(_GPU_COMMANDS_COMPLETE, 0)
        flush()

    def forget(self) -> None:
        """Drop the most recent batch after a failed drawing."""
        self._begun.pop()

    def end(self) -> Pictures:
        """Return the pictures of the oldest batch, as `Target.read` does."""
        if not self._begun:
            raise EngineError("no picture is under way: `begin` one first")
        begun = self._begun.popleft()
        pictures = begun.pictures
        function("glClientWaitSync", "puq", "u")(begun.fence, _FLUSH_COMMANDS, _FOREVER_NS)
        function("glDeleteSync", "p")(begun.fence)
        data = begun.landing.lend()[: pictures * self._each].reshape(pictures, self._each)
        held = sum(one.lent for one in self._landings) > _LENT_MAX
        return [self._target.parted(one.copy() if held else one) for one in data]

    def release(self) -> None:
        if self._written is not None:
            self._written.release()
            self._written = None
        self._begun.clear()
        _LEFT.extend(self._landings)
        self._landings.clear()
        _free_left()

    @property
    def _buffer(self) -> moderngl.Buffer:
        """Return the buffer that pictures are written to: on a card it has its own memory."""
        landing = self._begun[-1].landing
        if not self._on_card:
            return landing.buffer
        if self._written is None or self._written.size < landing.size:
            if self._written is not None:
                self._written.release()
            self._written = self._context.buffer(reserve=landing.size)
        return self._written

    def _landing(self, size: int) -> _Landing:
        """Return unused memory of at least a size."""
        under_way = [one.landing for one in self._begun]
        unused = [one for one in self._landings if one not in under_way and not one.lent]
        for one in unused:
            if one.size >= size:
                return one
            self._landings.remove(one)
            one.release()
        _free_left()
        self._landings.append(_Landing(self._context, size))
        return self._landings[-1]


@dataclass(slots=True)
class _Begun:
    """Batch that is under way."""

    landing: _Landing
    pictures: int
    fence: int | None = None


_LEFT: Final[list[_Landing]] = []
"""Memory of released readbacks whose pictures were in use."""


def _free_left() -> None:
    """Free memory of released readbacks that is not in use any more."""
    for one in [one for one in _LEFT if not one.lent]:
        _LEFT.remove(one)
        one.release()


class SinglePicture:
    """Target of one picture, which is read at once. size: width, height in pixels"""

    def __init__(self, context: moderngl.Context, size: tuple[int, int]) -> None:
        self.target = Target(context, size)
        self._readback = Readback(context, self.target)
        self._found: Pictures = []

    def take(self, place: int) -> None:
        """Read the target."""
        self._found = [self.target.read()]

    def take_layers(self, drawn: LayerTarget, first: int, count: int, place: int) -> None:
        """Read a layer."""
        self._readback.begin()
        self._readback.take_layers(drawn, first, count, place)
        self._readback.send()
        self._found = self._readback.end()

    def end(self) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Return the picture."""
        return self._found.pop()

    def release(self) -> None:
        self.target.release()
        self._readback.release()


@lru_cache(maxsize=1)
def _parting(context: moderngl.Context) -> moderngl.ComputeShader:
    """Create the program that writes layers to a buffer: all colours of each, then all labels."""
    return context.compute_shader(
        f"""#version 430
        layout(local_size_x = {_GROUP}) in;
        layout(binding = {_UNIT}) uniform sampler2DArray pictures;
        layout(std430, binding = {_BYTES_BINDING}) writeonly buffer Bytes {{ uint words[]; }};
        uniform ivec3 places;  // first layer, first word, words of a picture
        void main() {{
            int word = int(gl_GlobalInvocationID.x), nth = int(gl_WorkGroupID.y);
            if (word >= places.z) return;
            int wide = textureSize(pictures, 0).x, colours = 3 * places.z;
            vec4 four;
            for (int i = 0; i < 4; i++) {{
                int k = 4 * word + i, at = k < colours ? k / 3 : k - colours;
                vec4 seen = texelFetch(pictures, ivec3(at % wide, at / wide, places.x + nth), 0);
                four[i] = seen[k < colours ? k - 3 * at : 3];
            }}
            words[places.y + nth * places.z + word] = packUnorm4x8(four);
        }}
        """
    )
