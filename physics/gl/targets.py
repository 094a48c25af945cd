"""Targets: what a picture is drawn into, and how it is read back.

Colour and label share one texture (the label is its fourth channel), so that a picture is one readback.
"""

from __future__ import annotations

import cv2
import moderngl
import numpy as np
from numpy.typing import NDArray

from physics.view import FAR_M, NEAR_M


class Target:
    """A framebuffer of one size. size: width, height in pixels."""

    def __init__(self, context: moderngl.Context, size: tuple[int, int]) -> None:
        self.size = size
        self._colour = context.renderbuffer(size, 4, dtype="f1")
        self._depth = context.depth_renderbuffer(size)
        self.frame = context.framebuffer([self._colour], self._depth)

    def clear(self) -> None:
        """Nothing is seen, anywhere."""
        self.use()
        self.frame.clear(depth=1.0)

    def use(self, labels: bool = True, depth: bool = True) -> None:
        """Draw into it from now on; what is False keeps what it holds."""
        self.frame.color_mask, self.frame.depth_mask = (True, True, True, labels), depth
        self.frame.use()

    def read(self) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Colours (H, W, 3) and labels (H, W), the top row first."""
        return parted(self.frame.read(components=4, dtype="f1"), self.size)

    def read_depth(self) -> NDArray[np.float32]:
        """Depth along the view, (H, W) metres."""
        width, height = self.size
        data = self.frame.read(components=1, attachment=-1, dtype="f4")
        depth = np.frombuffer(data, dtype=np.float32).reshape(height, width)
        return (FAR_M * NEAR_M / (FAR_M - (FAR_M - NEAR_M) * depth)).astype(np.float32)

    def read_into(self, buffer: moderngl.Buffer, offset: int) -> None:
        """Let the graphics card copy colours and labels into a buffer, when it comes to it; nobody waits."""
        self.frame.read_into(buffer, components=4, dtype="f1", write_offset=offset)

    def release(self) -> None:
        for thing in (self.frame, self._colour, self._depth):
            thing.release()


def parted(data: bytes | memoryview, size: tuple[int, int]) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Colours (H, W, 3) and labels (H, W) of a picture as it was read."""
    width, height = size
    whole = np.frombuffer(data, dtype=np.uint8).reshape(height, width, 4)
    colours, labels = cv2.cvtColor(whole, cv2.COLOR_RGBA2RGB), cv2.extractChannel(whole, 3)
    return np.asarray(colours, dtype=np.uint8), np.asarray(labels, dtype=np.uint8)
