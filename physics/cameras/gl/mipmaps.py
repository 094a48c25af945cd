"""Array textures with mipmaps.

The coarser levels are made here: a software renderer takes twenty times as long for them, and each
driver rounds them in its own way.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import cv2
import moderngl
import numpy as np
from numpy.typing import NDArray

from physics.cameras.gl.driver import function

_TEXTURE_2D_ARRAY: Final = 0x8C1A
_UNPACK_ALIGNMENT: Final = 0x0CF5
_UNSIGNED_BYTE: Final = 0x1401
_FORMATS: Final = {2: (0x822B, 0x8227), 4: (0x8058, 0x1908)}
"""OpenGL's numbers of the internal format and the format, by channels: RG8 and RG; RGBA8 and
RGBA."""


def mipmapped(context: moderngl.Context, texels: NDArray[np.uint8]) -> moderngl.TextureArray:
    """Upload an array texture with all its mipmap levels.

    texels: (layers, height, width, channels), 2 or 4 channels
    """
    layers, height, width, channels = texels.shape
    texture = context.texture_array((width, height, layers), channels, texels.tobytes())
    bind, upload = function("glBindTexture", "uu"), function("glTexImage3D", "uiiiiiiuup")
    bind(_TEXTURE_2D_ARRAY, texture.glo)  # to the unit at which moderngl has just created it
    function("glPixelStorei", "ui")(_UNPACK_ALIGNMENT, 1)
    internal, pixels = _FORMATS[channels]
    for level, coarse in enumerate(_coarser(texels), 1):
        count, rows, columns, _ = coarse.shape
        upload(
            *(_TEXTURE_2D_ARRAY, level, internal, columns, rows, count, 0),
            *(pixels, _UNSIGNED_BYTE, coarse.ctypes.data),
        )
    return texture


def _coarser(texels: NDArray[np.uint8]) -> Iterator[NDArray[np.uint8]]:
    """Yield the mipmap levels after the first one. A texel is the mean of those that it covers."""
    layers, height, width, channels = texels.shape
    while max(height, width) > 1:
        height, width = max(height // 2, 1), max(width // 2, 1)
        coarse = np.empty((layers, height, width, channels), np.uint8)
        for fine, to in zip(texels, coarse, strict=True):
            cv2.resize(fine, (width, height), to, interpolation=cv2.INTER_AREA)
        texels = coarse
        yield coarse
