"""Readback of drawn pictures.

All pictures of a batch are read at once, while the next batch is drawn.
"""

from __future__ import annotations

import sys
from collections import deque
from functools import lru_cache
from typing import Final

import moderngl
import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import EngineError
from physics.cameras.gl.layers import LayerTarget
from physics.cameras.gl.targets import Target

_UNIT: Final = 8
"""Texture unit of the layers to be read."""
_BYTES_BINDING: Final = 2
_GROUP: Final = 64
_ARRAYS_MAX: Final = 4

Pictures = list[tuple[NDArray[np.uint8], NDArray[np.uint8]]]
"""Colours (H, W, 3) and labels (H, W) of each picture, the top row first."""


class Readback:
    """Asynchronous readback of pictures.

    Pictures are queued one after another into a buffer and fetched later, while the next are drawn.
    target: source of the pictures that are not layers
    """

    UNDER_WAY: Final = 2
    """Maximum number of pending buffers."""

    def __init__(self, context: moderngl.Context, target: Target) -> None:
        self._context = context
        self._target = target
        self._each = target.size[0] * target.size[1] * 4
        self._free = [context.buffer(reserve=self._each) for _ in range(self.UNDER_WAY)]
        self._begun: deque[tuple[moderngl.Buffer, int]] = deque()
        self._arrays: list[NDArray[np.uint8]] = []

    def begin(self, pictures: int = 1) -> None:
        """Take a buffer for `pictures` pictures, which are copied next."""
        if not self._free:
            raise EngineError("too many pictures are under way: `end` some first")
        buffer = self._free.pop()
        if buffer.size < pictures * self._each:
            buffer.release()
            buffer = self._context.buffer(reserve=pictures * self._each)
        self._begun.append((buffer, pictures))

    def take(self, place: int = 0) -> None:
        """Queue a copy of the target to a place in the most recent buffer."""
        self._target.copy(self._begun[-1][0], place * self._each)

    def take_layers(self, drawn: LayerTarget, first: int, count: int, place: int) -> None:
        """Queue a copy of `count` layers from `first` on to places in the most recent buffer."""
        assert drawn.colour is not None
        program = _parting(self._context)
        drawn.colour.use(_UNIT)
        self._begun[-1][0].bind_to_storage_buffer(_BYTES_BINDING)
        words = self._each // 4
        program["places"] = first, place * words, words
        program.run((words + _GROUP - 1) // _GROUP, count)
        self._context.memory_barrier()

    def forget(self) -> None:
        """Return the most recent buffer after a failed drawing."""
        self._free.append(self._begun.pop()[0])

    def end(self) -> Pictures:
        """Return the pictures of the oldest buffer, as `Target.read` does."""
        if not self._begun:
            raise EngineError("no picture is under way: `begin` one first")
        buffer, pictures = self._begun.popleft()
        self._free.append(buffer)
        if not pictures:
            return []
        data = self._array(pictures * self._each)
        buffer.read_into(data, data.nbytes)
        return [self._target.parted(one) for one in data.reshape(pictures, self._each)]

    def release(self) -> None:
        for buffer in (*self._free, *(buffer for buffer, _ in self._begun)):
            buffer.release()

    def _array(self, size: int) -> NDArray[np.uint8]:
        """Return memory for pictures. That of earlier ones is used again once these are gone, as
        the system clears new memory page by page.
        """
        for i in range(len(self._arrays)):
            # references: the list's, and the argument's
            if self._arrays[i].size >= size and sys.getrefcount(self._arrays[i]) == 2:
                return self._arrays[i][:size]
        if len(self._arrays) == _ARRAYS_MAX:
            self._arrays.pop(0)
        self._arrays.append(np.empty(size, dtype=np.uint8))
        return self._arrays[-1][:]


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
