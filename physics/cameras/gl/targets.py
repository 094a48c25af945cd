"""Targets: what a picture is drawn into, and how it is read back.

Colour and label share one texture (the label is its fourth channel), so that a picture is one readback.
"""

from __future__ import annotations

from collections import deque
from typing import Final

import cv2
import moderngl
import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import EngineError
from physics.cameras.view import FAR_PLANE_M, NEAR_PLANE_M


class Target:
    """A framebuffer of one size. size: width, height in pixels."""

    def __init__(self, context: moderngl.Context, size: tuple[int, int]) -> None:
        self.size = size
        self._colour = context.renderbuffer(size, 4, dtype="f1")
        self._depth = context.depth_renderbuffer(size)
        self.frame, self._painted = (context.framebuffer([self._colour], self._depth) for _ in range(2))
        self._painted.color_mask, self._painted.depth_mask = (True, True, True, False), False

    def clear(self) -> None:
        """Nothing is seen, anywhere."""
        self.frame.use()
        self.frame.clear(depth=1.0)

    def use(self) -> None:
        """Draw into it from now on."""
        self.frame.use()

    def use_colours(self) -> None:
        """Draw into it from now on: labels and depth keep what they hold."""
        self._painted.use()

    def read(self) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Colours (H, W, 3) and labels (H, W), the top row first."""
        return parted(self.frame.read(components=4, dtype="f1"), self.size)

    def read_depth(self) -> NDArray[np.float32]:
        """Depth along the view, (H, W) metres."""
        width, height = self.size
        data = self.frame.read(components=1, attachment=-1, dtype="f4")
        depth = np.frombuffer(data, dtype=np.float32).reshape(height, width)
        return (FAR_PLANE_M * NEAR_PLANE_M / (FAR_PLANE_M - (FAR_PLANE_M - NEAR_PLANE_M) * depth)).astype(np.float32)

    def release(self) -> None:
        for thing in (self.frame, self._painted, self._colour, self._depth):
            thing.release()


class Readback:
    """Pictures on their way from the graphics card: copied behind one another into a buffer when the card comes to it,
    fetched later, so that nobody waits for one while the next can be drawn. size: width, height of a picture."""

    UNDER_WAY: Final = 2
    """Buffers that may have begun and not ended."""

    def __init__(self, context: moderngl.Context, size: tuple[int, int]) -> None:
        self._context, self._size = context, size
        self._each = size[0] * size[1] * 4
        self._free = [context.buffer(reserve=self._each) for _ in range(self.UNDER_WAY)]
        self._begun: deque[tuple[moderngl.Buffer, int]] = deque()

    def begin(self, pictures: int = 1) -> None:
        """Take a buffer for so many pictures, which are copied next."""
        if not self._free:
            raise EngineError("too many pictures are under way: `end` some first")
        buffer = self._free.pop()
        if buffer.size < pictures * self._each:
            buffer.release()
            buffer = self._context.buffer(reserve=pictures * self._each)
        self._begun.append((buffer, pictures))

    def copy(self, target: Target, place: int = 0) -> None:
        """Let the card copy a target to a place in the buffer that began last."""
        target.frame.read_into(self._begun[-1][0], components=4, dtype="f1", write_offset=place * self._each)

    def forget(self) -> None:
        """Give the buffer that began last back: its pictures could not be drawn."""
        self._free.append(self._begun.pop()[0])

    def end(self) -> list[tuple[NDArray[np.uint8], NDArray[np.uint8]]]:
        """The pictures of the buffer that began first, as `Target.read` gives them."""
        if not self._begun:
            raise EngineError("no picture is under way: `begin` one first")
        buffer, pictures = self._begun.popleft()
        self._free.append(buffer)
        data = memoryview(buffer.read(pictures * self._each)) if pictures else memoryview(b"")
        return [parted(data[i * self._each : (i + 1) * self._each], self._size) for i in range(pictures)]

    def release(self) -> None:
        for buffer in (*self._free, *(buffer for buffer, _ in self._begun)):
            buffer.release()


def parted(data: bytes | memoryview, size: tuple[int, int]) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Colours (H, W, 3) and labels (H, W) of a picture as it was read."""
    width, height = size
    whole = np.frombuffer(data, dtype=np.uint8).reshape(height, width, 4)
    colours, labels = cv2.cvtColor(whole, cv2.COLOR_RGBA2RGB), cv2.extractChannel(whole, 3)
    return np.asarray(colours, dtype=np.uint8), np.asarray(labels, dtype=np.uint8)
