"""Clouds over a clear sky: from fair-weather clouds to an overcast."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Final

import cv2
import numpy as np

from cosim.core.geometry import Floats
from cosim.core.state import write_protected_float32
from physics.textures.noise import Field, Noise, smooth_step

_SIZE: Final = 512
_PER_SIDE: Final = 5.0
"""Side of the layer's repeating square, in units of the layer's height."""


def clouded(
    clear: Floats, ways: Floats, sun: Floats, beam: Floats, cover: float, seed: int
) -> tuple[Floats, float]:
    """Return the radiance (H, W, 3) of the sky with clouds, and the transmitted share of the sun.

    clear, ways: radiance and directions of a cloudless sky
    beam: (3,) sunlight
    cover: cloud cover, 0 to 1

    A full cover is the overcast of the CIE (P. Moon and D. E. Spencer, 1942).
    It is three times brighter at the zenith than at the horizon.
    """
    if cover <= 0.0:
        return np.array(clear), 1.0
    up = np.maximum(ways[..., 2], 0.0)
    above = ways[..., 2] > 0.0
    solid = np.where(above, np.cos(np.arcsin(np.clip(ways[..., 2], -1.0, 1.0))), 0.0)
    sky_light = (clear * (solid * up)[..., None]).sum(axis=(0, 1)) / max(
        float((solid * up).sum()), 1e-9
    )
    layer = _layer(seed)
    dense = _dense(layer, ways, cover, np.zeros(2))
    towards = np.asarray(sun[:2], dtype=float) / max(math.hypot(sun[0], sun[1]), 1e-9)
    beyond = _dense(layer, ways, cover, 0.10 * towards)
    apart = np.arccos(np.clip(ways @ sun, -1.0, 1.0))
    lit = np.clip(0.75 - 0.55 * (beyond - 0.6 * dense) - 0.25 * dense, 0.15, 1.0)
    glow = 1.0 + 1.6 * np.exp(-apart / 0.25) * (1.0 - 0.7 * dense)
    low = float(np.clip((sun[2] + 0.05) / 0.25, 0.0, 1.0))
    white = beam * (0.30 + 0.30 * low) * max(float(sun[2]), 0.12 if sun[2] > -0.05 else 0.0) ** 0.35
    cloud = white * (lit * glow)[..., None] + sky_light * (0.95 - 0.35 * dense)[..., None]
    thick = dense * smooth_step(0.0, 0.10, up)
    broken = clear + (cloud - clear) * thick[..., None]
    closed = float(smooth_step(0.65, 1.0, np.asarray(cover)))
    seen = 1.0 - float(smooth_step(0.45, 0.95, np.asarray(cover)))
    total = sky_light + beam * max(float(sun[2]), 0.0)
    grey = 0.30 * (0.75 * float(total.mean()) + 0.25 * total)
    vault = (
        (1.0 + 2.0 * up)
        / 3.0
        * (9.0 / 7.0)
        * (1.0 + 0.10 * (dense - 0.5) * smooth_step(0.0, 0.3, up))
    )
    overcast = grey * vault[..., None]
    return broken + (overcast - broken) * closed, seen


@lru_cache(maxsize=1)
def _layer(seed: int) -> Field:
    """Return (S, S) noise with a uniform distribution in 0 to 1, so that a cover is a threshold;
    write-protected. Episodes in one place share it."""
    noise = Noise(_SIZE, (seed, 9001))
    field = noise.distort(
        np.asarray(noise.clouds(4) + 0.6 * noise.clouds(16) + 0.15 * noise.clouds(64), np.float32),
        0.012,
        8,
    )
    order = np.argsort(np.argsort(field, axis=None)).reshape(field.shape)
    return write_protected_float32(order / order.size)


def _dense(layer: Field, ways: Floats, cover: float, moved: Floats) -> Field:
    """Return the cloud density in each direction, 0 to 1."""
    flat = ways[..., :2] / np.maximum(ways[..., 2:] + 0.12, 0.06) + moved
    at = (flat / _PER_SIDE % 1.0 * _SIZE).astype(np.float32)
    found = cv2.remap(layer, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return smooth_step(1.0 - cover, 1.0 - cover + 0.24, np.asarray(found, np.float32))
