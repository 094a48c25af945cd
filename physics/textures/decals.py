"""Pictures that lie on the ground: covers, drains, cracks, repairs, stains, litter and grass edges.

Alpha is the visible fraction of the picture; what lies below shows elsewhere.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Final

import cv2
import numpy as np

from physics.textures.layers import Colour, Layers, Picture, Recipe, Rgb, stack_layers
from physics.textures.noise import Field, Noise, cells, pixel_centres, smooth_step
from physics.textures.surface import blend_colours, plain_colour, relief_shading, scale_brightness

_IRON: Final = (0.30, 0.29, 0.28)
_DIRT: Final = (0.16, 0.15, 0.14)
_LITTER: Final[tuple[Colour, ...]] = (
    (0.88, 0.87, 0.84),
    (0.80, 0.78, 0.72),
    (0.72, 0.20, 0.16),
    (0.20, 0.36, 0.58),
    (0.85, 0.72, 0.22),
)
"""sRGB colours of paper and packaging."""
_FALLEN: Final[tuple[Colour, ...]] = (
    (0.45, 0.33, 0.16),
    (0.52, 0.42, 0.18),
    (0.34, 0.27, 0.15),
    (0.36, 0.38, 0.18),
)
"""sRGB colours of fallen leaves."""


@lru_cache(maxsize=4)
def decal_layers(size_px: int = 512, seed: int = 0) -> Layers:
    """Return every layer of pictures on the ground."""
    return stack_layers("decals", DECALS, size_px, seed)


def _plane(noise: Noise) -> tuple[Field, Field]:
    """Return (S, S) coordinates from -1 to 1, to the right and down."""
    at = 2.0 * pixel_centres(noise.size) - 1.0
    x, y = np.meshgrid(at, at)
    return x, y


def _round_cover(noise: Noise) -> Picture:
    """Draw a cast-iron cover with a pattern of studs, in a concrete frame."""
    x, y = _plane(noise)
    away = np.hypot(x, y)
    stud = np.sin(np.pi * 7.0 * x) * np.sin(np.pi * 7.0 * y)
    bump = smooth_step(0.1, 0.5, np.abs(stud))
    iron = scale_brightness(plain_colour(noise, _IRON, 0.02, 0.03), relief_shading(bump, 0.22))
    rim = smooth_step(0.74, 0.77, away) * (1.0 - smooth_step(0.84, 0.87, away))
    iron = scale_brightness(iron, 1.0 + 0.35 * rim)
    gap = np.exp(-(((away - 0.72) / 0.018) ** 2)) + np.exp(-(((away - 0.89) / 0.018) ** 2))
    collar = plain_colour(noise, (0.50, 0.49, 0.47), 0.03, 0.05)
    rgb = blend_colours(iron, collar, smooth_step(0.87, 0.90, away))
    rgb = scale_brightness(rgb, 1.0 - 0.75 * np.clip(gap, 0.0, 1.0))
    return Picture(rgb, 1.0 - smooth_step(0.95, 0.99, away))


def _square_cover(noise: Noise) -> Picture:
    """Draw a steel lid with a chequered pattern."""
    x, y = _plane(noise)
    edge = np.maximum(np.abs(x), np.abs(y))
    bars = np.where(np.sin(4.0 * np.pi * x) * np.sin(4.0 * np.pi * y) > 0.0, x + y, x - y)
    bump = smooth_step(0.0, 0.6, np.sin(np.pi * 14.0 * bars))
    rgb = plain_colour(noise, (0.38, 0.37, 0.36), 0.02, 0.03)
    rgb = scale_brightness(rgb, relief_shading(bump, 0.16))
    frame = smooth_step(0.80, 0.83, edge)
    gap = np.exp(-(((edge - 0.81) / 0.02) ** 2)) + np.exp(-(((edge - 0.95) / 0.02) ** 2))
    rgb = scale_brightness(rgb, (1.0 + 0.18 * frame) * (1.0 - 0.7 * np.clip(gap, 0.0, 1.0)))
    return Picture(rgb, 1.0 - smooth_step(0.96, 0.99, edge))


def _drain(noise: Noise) -> Picture:
    """Draw the grate of a drain with dark slots."""
    x, y = _plane(noise)
    edge = np.maximum(np.abs(x), np.abs(y))
    slot = smooth_step(0.15, 0.35, np.cos(np.pi * 8.0 * x)) * (1.0 - smooth_step(0.76, 0.80, edge))
    slot *= smooth_step(0.04, 0.07, np.abs(y))
    rgb = plain_colour(noise, (0.34, 0.32, 0.30), 0.03, 0.03)
    rgb = blend_colours(rgb, (0.04, 0.04, 0.04), slot)
    rgb = scale_brightness(rgb, 1.0 - 0.6 * np.exp(-(((edge - 0.90) / 0.02) ** 2)))
    return Picture(rgb, 1.0 - smooth_step(0.95, 0.99, edge))


def _faded(noise: Noise, soft: float = 0.35) -> Field:
    """Return the opacity of a round patch with an uneven rim."""
    x, y = _plane(noise)
    away = np.hypot(x, y) + 0.12 * noise.clouds(4)
    return 1.0 - smooth_step(0.85 - soft, 0.85, away)


def _crack(noise: Noise) -> Picture:
    """Draw branching cracks with tar in places."""
    edge = noise.distort(cells(noise, 3).edge, 0.02, 8)
    fine = noise.distort(cells(noise, 9).edge, 0.012, 16)
    wide = 1.0 - smooth_step(0.0025, 0.009, edge)
    thin = (1.0 - smooth_step(0.001, 0.005, fine)) * smooth_step(0.4, 1.2, noise.clouds(4))
    line = np.maximum(wide, 0.8 * thin)
    rgb = np.broadcast_to(np.asarray(_DIRT, np.float32), (*line.shape, 3))
    return Picture(rgb, 0.9 * line * _faded(noise, 0.2))


def _repair(noise: Noise) -> Picture:
    """Draw a rectangle of newer asphalt with sealed edges."""
    x, y = _plane(noise)
    edge = np.maximum(np.abs(x), np.abs(y)) + 0.01 * noise.clouds(16)
    chips = noise.grain(0.6)
    rgb = plain_colour(noise, (0.27, 0.27, 0.28), 0.015, 0.0, 8)
    rgb = rgb + 0.05 * (smooth_step(0.9, 2.2, chips) + 0.35 * noise.grain())[..., None]
    rgb = scale_brightness(rgb, 1.0 - 0.45 * np.exp(-(((edge - 0.92) / 0.025) ** 2)))
    return Picture(rgb, 0.92 * (1.0 - smooth_step(0.955, 0.985, edge)))


def _stain(noise: Noise) -> Picture:
    """Draw a dark patch of oil, water or dirt with drops around it."""
    spots = smooth_step(1.7, 2.1, noise.clouds(16)) * _faded(noise, 0.1)
    whole = _faded(noise, 0.6) * smooth_step(-0.8, 1.2, noise.clouds(8))
    return Picture(
        plain_colour(noise, _DIRT, 0.02, 0.02), np.clip(0.45 * whole + 0.6 * spots, 0.0, 0.8)
    )


def _dust(noise: Noise) -> Picture:
    """Draw a pale patch of sand and dust."""
    grains = 0.35 + 0.65 * smooth_step(-0.2, 1.6, noise.clouds(8) + 0.8 * noise.grain())
    return Picture(
        plain_colour(noise, (0.66, 0.61, 0.53), 0.03, 0.05), 0.5 * grains * _faded(noise, 0.6)
    )


def _gum(noise: Noise) -> Picture:
    """Draw trodden chewing gum and small spots."""
    alpha = np.zeros((noise.size, noise.size), np.float32)
    rgb = np.tile(np.asarray((0.28, 0.27, 0.26), np.float32), (noise.size, noise.size, 1))
    for _ in range(16):
        radius = noise.size * noise.rng.uniform(0.008, 0.022)
        middle = noise.rng.uniform(0.06, 0.94, 2) * noise.size
        tone = np.float32(0.20 if noise.rng.random() < 0.7 else 0.72)
        axes = radius * noise.rng.uniform(0.7, 1.0, 2)
        mask = _ellipse(noise.size, middle, axes, noise.rng.uniform(0.0, 180.0))
        rgb = blend_colours(rgb, (float(tone),) * 3, mask)
        alpha = np.maximum(alpha, 0.75 * mask)
    return Picture(rgb, alpha)


def _ellipse(size: int, middle: Field, axes: Field, turn_deg: float) -> Field:
    mask = np.zeros((size, size), np.uint8)
    centre, half = np.rint(16.0 * middle).astype(int), np.rint(16.0 * axes).astype(int)
    cv2.ellipse(mask, centre.tolist(), half.tolist(), turn_deg, 0.0, 360.0, 255, -1, cv2.LINE_AA, 4)
    return mask.astype(np.float32) / 255.0


def _litter(noise: Noise) -> Picture:
    """Draw a few pieces of paper and packaging with small shadows."""
    return _scattered(noise, _LITTER, 5, (0.05, 0.12), (0.35, 0.9), 4)


def _fallen_leaves(noise: Noise) -> Picture:
    """Draw loose leaves with small shadows."""
    return _scattered(noise, _FALLEN, 60, (0.018, 0.034), (0.4, 0.7), 7)


def _scattered(
    noise: Noise,
    colours: tuple[Colour, ...],
    count: int,
    long: tuple[float, float],
    wide: tuple[float, float],
    sides: int,
) -> Picture:
    """Draw polygons at random places.

    long: smallest and largest half length as fractions of the side
    wide: smallest and largest ratio of width to length
    sides: corners of a polygon
    """
    rng, size = noise.rng, noise.size
    rgb: Rgb = np.tile(np.asarray(colours[0], np.float32) * 0.5, (size, size, 1))
    alpha = np.zeros((size, size), np.float32)
    angle = 2.0 * np.pi * (np.arange(sides) + 0.5) / sides
    for _ in range(count):
        middle, half = rng.uniform(0.14, 0.86, 2) * size, rng.uniform(*long) * size
        turn = rng.uniform(0.0, 2.0 * np.pi)
        shape = np.stack([np.cos(angle), rng.uniform(*wide) * np.sin(angle)], 1) * half
        shape *= rng.uniform(0.85, 1.1, (sides, 1))
        way = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        colour = np.asarray(colours[int(rng.integers(len(colours)))]) * rng.uniform(0.75, 1.1)
        for shift, tone, share in ((0.012 * size, 0.0, 0.45), (0.0, 1.0, 1.0)):
            mask = np.zeros((size, size), np.uint8)
            corner = np.rint(16.0 * (middle + shift + shape @ way)).astype(np.int32)
            cv2.fillPoly(mask, [corner], 255, cv2.LINE_AA, 4)
            cover = share * mask.astype(np.float32) / 255.0
            over = cover / np.maximum(cover + alpha * (1.0 - cover), 1e-6)
            rgb = blend_colours(rgb, (tone * colour).astype(np.float32)[None, None], over)
            alpha = cover + alpha * (1.0 - cover)
    return Picture(rgb, alpha)


def _tufts(noise: Noise) -> Picture:
    """Draw grass that grows over an edge; dense at the top of the picture, loose at its foot."""
    size = noise.size
    rgb: Rgb = np.tile(np.asarray((0.33, 0.39, 0.21), np.float32), (size, size, 1))
    alpha = np.zeros((size, size), np.uint8)
    down = np.arange(size)[:, None] / size
    ragged = np.broadcast_to(down, (size, size)) + 0.10 * noise.clouds(16)
    alpha[ragged < 0.42] = 255
    for _ in range(700):
        x, reach = noise.rng.uniform(0.0, 1.0), noise.rng.uniform(0.1, 0.32)
        foot = np.array([x, noise.rng.uniform(0.15, 0.42 + 0.12 * np.sin(9.0 * x))]) * size
        tip = foot + np.array([noise.rng.normal(0.0, 0.05), reach]) * size
        green = np.array([0.30, 0.36, 0.19]) * noise.rng.uniform(0.7, 1.5)
        ends = [np.rint(16.0 * p).astype(int).tolist() for p in (foot, tip)]
        wide = max(1, round(size / 110))
        for shift in (-16 * size, 0, 16 * size):
            one, two = ([p[0] + shift, p[1]] for p in ends)
            cv2.line(rgb, one, two, green.tolist(), wide, cv2.LINE_AA, 4)
            cv2.line(alpha, one, two, 255, wide, cv2.LINE_AA, 4)
    rgb = scale_brightness(rgb, 1.0 + 0.12 * noise.grain(0.7))
    return Picture(rgb, alpha.astype(np.float32) / 255.0 * smooth_step(0.02, 0.40, down))


DECALS: Final[Mapping[str, Recipe]] = {
    "decal-cover": Recipe(0.75, _round_cover),
    "decal-lid": Recipe(0.6, _square_cover),
    "decal-drain": Recipe(0.5, _drain),
    "decal-crack": Recipe(3.0, _crack),
    "decal-repair": Recipe(2.0, _repair),
    "decal-stain": Recipe(1.6, _stain),
    "decal-dust": Recipe(2.4, _dust),
    "decal-gum": Recipe(1.2, _gum),
    "decal-litter": Recipe(0.8, _litter),
    "decal-leaves": Recipe(1.4, _fallen_leaves),
    "decal-tufts": Recipe((1.4, 0.5), _tufts),
}
"""Recipe of every picture on the ground by name, with its usual width and height in metres."""
