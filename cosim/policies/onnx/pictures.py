"""Convert camera images to tensors: crop, resize, colour, normalisation and axis order."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from cosim.policies.onnx.inputs import PixelsInput, axes_of

_RESAMPLED: Final = {
    "area": cv2.INTER_AREA,
    "linear": cv2.INTER_LINEAR,
    "cubic": cv2.INTER_CUBIC,
    "nearest": cv2.INTER_NEAREST,
}


def picture_tensor(rgb: NDArray[np.uint8], spec: PixelsInput) -> NDArray[Any]:
    """Return a picture (H, W, 3) as (rows, columns, channels): float32, or unchanged uint8."""
    pixels = _coloured(_fitted(_cut(rgb, spec), spec), spec.colour)
    if spec.keeps_bytes:
        return pixels
    numbers = _numbers_of_bytes(spec)
    if pixels.shape[2] in (1, 3):
        looked_up: NDArray[Any] = cv2.LUT(np.ascontiguousarray(pixels), numbers[None])
        return looked_up.reshape(pixels.shape)
    return np.stack([numbers[pixels[..., i], i] for i in range(pixels.shape[2])], axis=-1)


@cache
def _numbers_of_bytes(spec: PixelsInput) -> NDArray[np.float32]:
    """Return (256, channels): the normalised value of each byte."""
    numbers = np.arange(256, dtype=np.float32)[:, None] * np.full(
        spec.channels, 1.0 / spec.scale, np.float32
    )
    if spec.mean:
        numbers -= np.asarray(spec.mean, np.float32)
    if spec.std:
        numbers /= np.asarray(spec.std, np.float32)
    return numbers


def transpose_frame(frame: NDArray[Any], layout: str) -> NDArray[Any]:
    """Transpose a frame (H, W, C) to the order of a layout, in which C may be absent.

    >>> transpose_frame(np.zeros((64, 85, 3)), "N(TC)HW").shape
    (3, 64, 85)
    """
    order = [letter for letter in "".join(axes_of(layout)) if letter in "HWC"]
    return np.ascontiguousarray(
        frame.transpose(["HWC".index(letter) for letter in order + ["C"] * ("C" not in order)])
    )


def combine_frames(frames: Sequence[NDArray[Any]], layout: str) -> NDArray[Any]:
    """Combine frames from `transpose_frame` to a tensor with the axes of a layout; N is 1.

    >>> combine_frames([np.zeros((3, 64, 85))] * 6, "N(TC)HW").shape
    (1, 18, 64, 85)
    """
    letters = "".join(axes_of(layout)).replace("N", "")
    stacked = np.stack(frames, axis=letters.index("T")) if "T" in letters else frames[0]
    sides = dict(zip(letters, stacked.shape, strict=False))
    return stacked.reshape(
        tensor_shape((sides["H"], sides["W"], sides.get("C", 1)), len(frames), layout)
    )


def tensor_shape(sides: tuple[int, int, int], frames: int, layout: str) -> tuple[int, ...]:
    """Return the shape of a tensor.

    sides: rows, columns and channels of a frame.

    >>> tensor_shape((64, 85, 3), 6, "N(TC)HW")
    (1, 18, 64, 85)
    """
    counts = {"N": 1, "T": frames} | dict(zip("HWC", sides, strict=True))
    return tuple(math.prod(counts[letter] for letter in group) for group in axes_of(layout))


def _cut(rgb: NDArray[np.uint8], spec: PixelsInput) -> NDArray[np.uint8]:
    """Crop a picture to `crop`, and to the aspect ratio of `size` for fit "crop"."""
    rows, columns = rgb.shape[:2]
    if spec.crop is not None:
        x0, y0, x1, y1 = spec.crop
        left, right = _within(x0 * columns, x1 * columns, columns)
        top, bottom = _within(y0 * rows, y1 * rows, rows)
        rgb = rgb[top:bottom, left:right]
        rows, columns = rgb.shape[:2]
    if spec.fit == "crop":
        width, height = spec.size
        wide = min(columns, max(round(rows * width / height), 1))
        high = min(rows, max(round(columns * height / width), 1))
        left, top = (columns - wide) // 2, (rows - high) // 2
        rgb = rgb[top : top + high, left : left + wide]
    return rgb


def _within(low: float, high: float, most: int) -> tuple[int, int]:
    """Return a range in whole pixels, at least one pixel wide."""
    first = min(round(low), most - 1)
    return first, max(round(high), first + 1)


def _fitted(rgb: NDArray[np.uint8], spec: PixelsInput) -> NDArray[np.uint8]:
    """Resize a picture to the size (width, height)."""
    width, height = spec.size
    if spec.fit in ("stretch", "crop"):
        return _resized(rgb, width, height, spec)
    scale = min(width / rgb.shape[1], height / rgb.shape[0])
    wide, high = max(round(rgb.shape[1] * scale), 1), max(round(rgb.shape[0] * scale), 1)
    left, top = ((width - wide) // 2, (height - high) // 2) if spec.fit == "letterbox" else (0, 0)
    whole = np.full((height, width, 3), spec.border, np.uint8)
    whole[top : top + high, left : left + wide] = _resized(rgb, wide, high, spec)
    return whole


def _resized(
    rgb: NDArray[np.uint8], width: int, height: int, spec: PixelsInput
) -> NDArray[np.uint8]:
    if rgb.shape[:2] == (height, width):
        return rgb
    resized: NDArray[np.uint8] = cv2.resize(
        np.ascontiguousarray(rgb), (width, height), interpolation=_RESAMPLED[spec.resample]
    )
    return resized


def _coloured(rgb: NDArray[np.uint8], colour: str) -> NDArray[np.uint8]:
    """Convert the colours of (H, W, 3).

    yuv420 gives (H / 2, W / 2, 6): Y of even and odd rows at even columns, then at odd ones, U, V.
    """
    if colour == "bgr":
        return rgb[..., ::-1]
    if colour == "grey":
        grey: NDArray[np.uint8] = cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2GRAY)
        return grey[..., None]
    if colour == "yuv420":
        height, width = rgb.shape[:2]
        planes = cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2YUV_I420)
        y = planes[:height]
        uv = planes[height:].reshape(2, height // 2, width // 2)
        return np.stack(
            [y[::2, ::2], y[1::2, ::2], y[::2, 1::2], y[1::2, 1::2], uv[0], uv[1]], axis=-1
        )
    return rgb
