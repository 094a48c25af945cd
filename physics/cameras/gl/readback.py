"""Readback of drawn pictures.

All pictures of a batch are read at once, while the next batch is drawn.
"""

from __future__ import annotations

import ctypes
import weakref
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Final

import moderngl
import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import EngineError
from physics.cameras.gl.context import is_card
from physics.cameras.gl.driver import flush, function
from physics.cameras.gl.layers import LayerTarget
from physics.cameras.gl.picture_bytes import write_layers
from physics.cameras.gl.targets import Target

_LENT_MAX: Final = 3
"""Maximum number of batches whose memory the caller holds; later ones are copied."""
_PIXEL_PACK_BUFFER: Final = 0x88EB
_MAP_READ_WRITE: Final = 0x0003
_MAP_PERSISTENT: Final = 0x0040
_MAP_COHERENT: Final = 0x0080
_CLIENT_STORAGE: Final = 0x0200
_GPU_COMMANDS_COMPLETE: Final = 0x9117
_FLUSH_COMMANDS: Final = 1
_WAIT_NS: Final = 600_000_000_000
_SIGNALED: Final = (0x911A, 0x911C)
"""Results of a successful wait: already signaled, condition satisfied."""

Pictures = list[tuple[NDArray[np.uint8], NDArray[np.uint8]]]
"""Colours (H, W, 3) and labels (H, W) of each picture, the top row first."""


class HostBuffer:
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
            function("glDeleteBuffers", "ip")(1, ctypes.addressof(name))
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
    Returned arrays are views of this memory. Where the caller holds those of many batches, later
    pictures are copies.

    target: source of the pictures that are not layers
    staged: pictures are first written to memory of the graphics card, and transferred from there
        together; default on a card
    """

    PENDING_MAX: Final = 2
    """Maximum number of pending batches."""

    def __init__(
        self, context: moderngl.Context, target: Target, staged: bool | None = None
    ) -> None:
        self._context = context
        self._target = target
        self._each = target.size[0] * target.size[1] * 4
        self._staged = is_card(context) if staged is None else staged
        self._stage: moderngl.Buffer | None = None
        self._host_buffers: list[HostBuffer] = []
        self._pending: deque[PendingBatch] = deque()

    @contextmanager
    def begin(self, pictures: int = 1) -> Iterator[None]:
        """Reserve memory for `pictures` pictures, which are taken within a `with` block.

        Their transfer is queued at its end. An error within it discards the batch.
        Raises EngineError for too many pending batches, and where the driver fails.
        """
        if len(self._pending) == self.PENDING_MAX:
            raise EngineError("too many pictures are under way: `end` some first")
        batch = PendingBatch(self._unused(max(pictures, 1) * self._each), pictures)
        self._pending.append(batch)
        try:
            yield
            self._send(batch)
        except BaseException:
            self._pending.pop()
            raise

    def take(self, place: int = 0) -> None:
        """Queue a copy of the target to a place of the most recent batch."""
        self._target.copy(self._buffer, place * self._each)

    def take_layers(self, drawn: LayerTarget, places: Sequence[int]) -> None:
        """Queue a copy of the first layers to places of the most recent batch."""
        assert drawn.colour is not None
        write_layers(self._context, drawn.colour, self._buffer, places)

    def end(self) -> Pictures:
        """Return the pictures of the oldest batch, as `Target.read` does.

        Raises EngineError without one, and where the graphics card does not finish it.
        """
        if not self._pending:
            raise EngineError("no picture is under way: `begin` one first")
        batch = self._pending.popleft()
        pictures = batch.pictures
        wait = function("glClientWaitSync", "puq", "u")
        result = wait(batch.fence, _FLUSH_COMMANDS, _WAIT_NS)
        batch.delete_fence()
        if result not in _SIGNALED:
            raise EngineError(
                f"the graphics driver did not finish {pictures} pictures (glClientWaitSync returned "
                f"0x{result:04X}): see the driver's log; start the process again"
            )
        data = batch.memory.lend()[: pictures * self._each].reshape(pictures, self._each)
        copied = sum(one.lent for one in self._host_buffers) > _LENT_MAX
        return [self._target.parted(one.copy() if copied else one) for one in data]

    def release(self) -> None:
        if self._stage is not None:
            self._stage.release()
            self._stage = None
        while self._pending:
            self._pending.popleft().delete_fence()
        _UNRELEASED.extend(self._host_buffers)
        self._host_buffers.clear()
        _free_unreleased()

    def _send(self, batch: PendingBatch) -> None:
        """Queue the transfer of a batch, after its last picture."""
        if self._staged and batch.pictures:
            size = batch.pictures * self._each
            self._context.copy_buffer(batch.memory.buffer, self._buffer, size=size)
        batch.fence = function("glFenceSync", "uu", "p")(_GPU_COMMANDS_COMPLETE, 0)
        if batch.fence is None:
            raise EngineError("the graphics driver made no fence (glFenceSync): see its log")
        flush()

    @property
    def _buffer(self) -> moderngl.Buffer:
        """Buffer that pictures of the most recent batch are written to."""
        memory = self._pending[-1].memory
        if not self._staged:
            return memory.buffer
        if self._stage is None or self._stage.size < memory.size:
            if self._stage is not None:
                self._stage.release()
            self._stage = self._context.buffer(reserve=memory.size)
        return self._stage

    def _unused(self, size: int) -> HostBuffer:
        """Return unused memory of at least a size."""
        pending = [one.memory for one in self._pending]
        unused = [one for one in self._host_buffers if one not in pending and not one.lent]
        for one in unused:
            if one.size >= size:
                return one
            self._host_buffers.remove(one)
            one.release()
        _free_unreleased()
        self._host_buffers.append(HostBuffer(self._context, size))
        return self._host_buffers[-1]


@dataclass(slots=True)
class PendingBatch:
    """Batch of pictures that are queued."""

    memory: HostBuffer
    pictures: int
    fence: int | None = None

    def delete_fence(self) -> None:
        """Free the fence, if any."""
        if self.fence is not None:
            function("glDeleteSync", "p")(self.fence)
            self.fence = None


_UNRELEASED: Final[list[HostBuffer]] = []
"""Memory of released readbacks whose pictures were in use."""


def _free_unreleased() -> None:
    """Free memory of released readbacks that is not in use any more."""
    for one in [one for one in _UNRELEASED if not one.lent]:
        _UNRELEASED.remove(one)
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

    def take_layers(self, drawn: LayerTarget, places: Sequence[int]) -> None:
        """Read the first layer."""
        with self._readback.begin():
            self._readback.take_layers(drawn, places)
        self._found = self._readback.end()

    def end(self) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Return the picture."""
        return self._found.pop()

    def release(self) -> None:
        self.target.release()
        self._readback.release()
