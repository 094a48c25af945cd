"""Render targets.

Colour and label share one texture (the label is its fourth channel), so that a picture needs one
readback.
"""

from __future__ import annotations

import cv2
import moderngl
import numpy as np
from numpy.typing import NDArray

from physics.cameras.gl.context import draws_layers, is_card
from physics.cameras.gl.picture_bytes import write_picture
from physics.cameras.view import FAR_PLANE_M, NEAR_PLANE_M


class Frame:
    """Framebuffer whose fourth channel is the label."""

    frame: moderngl.Framebuffer

    def clear(self) -> None:
        """Clear the target to an empty picture."""
        self.frame.use()
        self.frame.clear(depth=1.0)

    def use(self) -> None:
        """Make it the target of later draws."""
        self.frame.use()


class Target(Frame):
    """Framebuffer of one size.

    size: width, height in pixels
    drawn_in: framebuffer with the depth of the picture
    parts_on_card: separate colours and labels before the readback; default on a graphics card
    """

    def __init__(
        self, context: moderngl.Context, size: tuple[int, int], parts_on_card: bool | None = None
    ) -> None:
        self._context = context
        self.size = size
        self._colour = context.texture(size, 4)
        self._depth = context.depth_renderbuffer(size)
        self.frame = context.framebuffer([self._colour], self._depth)
        self.drawn_in = self.frame
        on_card = is_card(context) or draws_layers(context)
        self._parts = on_card if parts_on_card is None else parts_on_card
        self._bytes: moderngl.Buffer | None = None

    def clear(self) -> None:
        """Clear the target to an empty picture."""
        self.drawn_in = self.frame
        super().clear()

    def read(self) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Read colours (H, W, 3) and labels (H, W), the top row first."""
        data = np.empty(4 * self.size[0] * self.size[1], dtype=np.uint8)
        if self._parts:
            if self._bytes is None:
                self._bytes = self._context.buffer(reserve=data.nbytes)
            self.copy(self._bytes, 0)
            self._bytes.read_into(data)
        else:
            self.frame.read_into(data, components=4, dtype="f1")
        return self.parted(data)

    def copy(self, buffer: moderngl.Buffer, offset: int) -> None:
        """Queue a copy of the picture into a buffer at `offset`, for `parted`."""
        if self._parts:
            write_picture(self._context, self._colour, buffer, offset)
        else:
            self.frame.read_into(buffer, components=4, dtype="f1", write_offset=offset)

    def parted(self, data: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Split the read data of a picture into colours (H, W, 3) and labels (H, W)."""
        width, height = self.size
        if self._parts:
            colours = data[: 3 * width * height]
            labels = data[3 * width * height :]
            return colours.reshape(height, width, 3), labels.reshape(height, width)
        whole = data.reshape(height, width, 4)
        rgb = cv2.cvtColor(whole, cv2.COLOR_RGBA2RGB)
        label = cv2.extractChannel(whole, 3)
        return np.asarray(rgb, dtype=np.uint8), np.asarray(label, dtype=np.uint8)

    def read_depth(self) -> NDArray[np.float32]:
        """Read depth along the view, (H, W) metres."""
        width, height = self.size
        data = self.drawn_in.read(components=1, attachment=-1, dtype="f4")
        depth = np.frombuffer(data, dtype=np.float32).reshape(height, width)
        return (
            FAR_PLANE_M * NEAR_PLANE_M / (FAR_PLANE_M - (FAR_PLANE_M - NEAR_PLANE_M) * depth)
        ).astype(np.float32)

    def release(self) -> None:
        for thing in (self.frame, self._colour, self._depth, self._bytes):
            if thing is not None:
                thing.release()
