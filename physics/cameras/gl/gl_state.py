"""Changes of the OpenGL state within a `with` block, which end also after an error."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal

import moderngl


@contextmanager
def polygon_offset(context: moderngl.Context, factor: float, units: float) -> Iterator[None]:
    """Shift the depths of later draws."""
    context.polygon_offset = factor, units
    try:
        yield
    finally:
        context.polygon_offset = 0.0, 0.0


@contextmanager
def blending(context: moderngl.Context) -> Iterator[None]:
    """Blend later draws by their fourth channel."""
    context.enable(moderngl.BLEND)
    try:
        yield
    finally:
        context.blend_func = moderngl.SRC_ALPHA, moderngl.ONE_MINUS_SRC_ALPHA
        context.disable(moderngl.BLEND)


@contextmanager
def masked(
    frame: moderngl.Framebuffer, only: Literal["colours", "labels", "depth"]
) -> Iterator[None]:
    """Limit later draws into a framebuffer to colours, to labels and depth, or to depth.

    Labels are the fourth channel. Masks of one framebuffer change without a flush, which a second
    framebuffer would need.
    """
    colours = only == "colours"
    before = frame.color_mask, frame.depth_mask
    frame.color_mask = colours, colours, colours, only == "labels"
    frame.depth_mask = not colours
    frame.use()
    try:
        yield
    finally:
        frame.color_mask, frame.depth_mask = before
        frame.use()
