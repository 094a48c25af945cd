"""Mipmaps of array textures."""

from __future__ import annotations

import moderngl
import numpy as np
import pytest

from physics.cameras.gl.context import context
from physics.cameras.gl.driver import function
from physics.cameras.gl.mipmaps import mipmapped

_ARRAY, _PACK_ALIGNMENT, _RGBA, _BYTE = 0x8C1A, 0x0D05, 0x1908, 0x1401


def _read(texture: moderngl.TextureArray, level: int, shape: tuple[int, ...]) -> np.ndarray:
    texels = np.zeros(shape, np.uint8)
    texture.use(0)
    function("glPixelStorei", "ui")(_PACK_ALIGNMENT, 1)
    function("glGetTexImage", "uiuup")(_ARRAY, level, _RGBA, _BYTE, texels.ctypes.data)
    return texels


@pytest.mark.engine
def test_levels_are_means_of_the_texels_below() -> None:
    """Each texel of each level is the mean of its four texels of the level before."""
    texels = np.random.default_rng(0).integers(0, 256, (3, 8, 16, 4), dtype=np.uint8)
    with context() as shared:
        texture = mipmapped(shared, texels)
        fine = texels
        for level, (rows, columns) in enumerate([(4, 8), (2, 4), (1, 2)], 1):
            coarse = _read(texture, level, (3, rows, columns, 4))
            means = fine.reshape(3, rows, 2, columns, 2, 4).mean(axis=(2, 4))
            assert np.abs(coarse - means).max() <= 0.5
            fine = coarse
        last = _read(texture, 4, (3, 1, 1, 4))
        assert np.abs(last[:, :, 0] - fine.mean(axis=2)).max() <= 0.5
        texture.release()
