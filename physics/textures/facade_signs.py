"""Details on walls and shop fronts: lettering, posters, painted scrawls and climbing plants."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from physics.textures.facade_canvas import BAY_M, STOREY_M, FacadeCanvas
from physics.textures.layers import Colour, srgb_to_linear
from physics.textures.noise import Field

SHOP_WORDS: Final = (
    "BAKERY",
    "CAFE",
    "BOOKS",
    "OPTIK",
    "FLOWERS",
    "TABAK",
    "FRISEUR",
    "PIZZA",
    "APOTHEKE",
    "KIOSK",
    "BIKES",
    "MARKET",
)
"""Words on shop fronts."""
_POSTER_WORDS: Final = ("LIVE", "EXPO", "SALE", "JAZZ", "VOTE", "CIRCUS", "FILM", "RUN")
_PRINTS: Final[tuple[Colour, ...]] = (
    (0.86, 0.84, 0.78),
    (0.80, 0.24, 0.18),
    (0.16, 0.34, 0.58),
    (0.90, 0.74, 0.20),
    (0.18, 0.19, 0.20),
    (0.30, 0.52, 0.36),
    (0.78, 0.42, 0.56),
)
"""sRGB colours of printed paper."""
_SPRAYED: Final[tuple[Colour, ...]] = ((0.12, 0.12, 0.14), (0.16, 0.30, 0.62), (0.62, 0.16, 0.20))
"""sRGB colours of scrawls."""
_LEAVES: Final[tuple[Colour, ...]] = (
    (0.20, 0.32, 0.14),
    (0.30, 0.44, 0.20),
    (0.40, 0.52, 0.26),
    (0.15, 0.24, 0.11),
)
"""sRGB colours of climbing plants."""


def lettering(
    canvas: FacadeCanvas,
    x_m: float,
    z_m: float,
    high_m: float,
    word: str,
    colour: Colour,
    wide_m: float = BAY_M,
) -> None:
    """Draw a word centred at `x_m` on a base line, at most `wide_m` wide."""
    font, thick = cv2.FONT_HERSHEY_DUPLEX, 2
    (width, tall), _ = cv2.getTextSize(word, font, 2.0, thick)
    inked = np.zeros((tall + 12, width + 12), np.uint8)
    cv2.putText(inked, word, (6, tall + 6), font, 2.0, 255, thick + 1, cv2.LINE_AA)
    across = min(wide_m, high_m * inked.shape[1] / inked.shape[0])
    x0 = max(x_m - 0.5 * across, 0.0)
    z1 = min(z_m + high_m, STOREY_M)
    area, cover, _, _ = canvas.local(x0, min(x0 + across, BAY_M), z_m, z1)
    if min(cover.shape) > 1:
        shown = cv2.resize(inked, cover.shape[::-1], interpolation=cv2.INTER_AREA)
        canvas.fill(area, cover * (shown.astype(np.float32) / 255.0), srgb_to_linear(colour))


def poster(canvas: FacadeCanvas, x0: float, z0: float, wide_m: float, high_m: float) -> None:
    """Draw a printed poster: a picture of simple shapes, a word and lines of text."""
    rng = canvas.rng
    paper, ink, block = (_PRINTS[k] for k in rng.choice(len(_PRINTS), 3, replace=False).tolist())
    x1, z1 = x0 + wide_m, z0 + high_m
    canvas.shade(x0 - 0.01, x1 + 0.015, z0 - 0.015, z1, 0.35)
    canvas.box(x0, x1, z0, z1, paper)
    for _ in range(int(rng.integers(2, 5))):
        a, b = np.sort(rng.uniform(x0 + 0.02, x1 - 0.02, 2)).tolist()
        low, high = np.sort(rng.uniform(z0 + 0.35 * high_m, z1 - 0.02, 2)).tolist()
        canvas.box(a, b, low, high, block if rng.random() < 0.6 else ink, rng.uniform(0.5, 1.0))
    word = _POSTER_WORDS[int(rng.integers(len(_POSTER_WORDS)))]
    lettering(canvas, 0.5 * (x0 + x1), z0 + 0.18 * high_m, 0.14 * high_m, word, ink, 0.9 * wide_m)
    for k in range(2):
        z = z0 + (0.05 + 0.06 * k) * high_m
        canvas.box(x0 + 0.04, x1 - 0.04 - 0.1 * wide_m * k, z, z + 0.025 * high_m, ink, 0.6)


def scrawl(canvas: FacadeCanvas, x0: float, x1: float, z0: float, z1: float) -> None:
    """Draw a sprayed scribble."""
    rng = canvas.rng
    mask = np.zeros((canvas.size, canvas.size), np.uint8)
    steps = np.linspace(0.0, 1.0, 60)
    turns = rng.uniform(3.0, 6.0)
    x = x0 + (x1 - x0) * (0.12 + 0.7 * steps + 0.09 * np.sin(2.0 * np.pi * turns * steps))
    up = 0.5 + 0.4 * np.sin(2.0 * np.pi * (turns * steps + rng.random())) * rng.uniform(0.6, 1.0)
    z = z0 + (z1 - z0) * up
    at = np.column_stack([x / BAY_M, 1.0 - z / STOREY_M]) * canvas.size
    wide = max(2, round(canvas.size * 0.006))
    cv2.polylines(mask, [np.rint(16.0 * at).astype(np.int32)], False, 255, wide, cv2.LINE_AA, 4)
    colour = srgb_to_linear(_SPRAYED[int(rng.integers(len(_SPRAYED)))])
    whole = slice(0, canvas.size), slice(0, canvas.size)
    canvas.fill(whole, 0.85 * mask.astype(np.float32) / 255.0, colour)


def climber(canvas: FacadeCanvas, x_m: float, wide_m: float, high_m: float) -> None:
    """Draw a plant that climbs a wall from the ground, wider at its foot.

    x_m: middle of the foot
    """
    rng, size = canvas.rng, canvas.size
    whole = slice(0, size), slice(0, size)
    count = int(420 * wide_m * high_m)
    up = rng.beta(1.0, 1.5, count)
    reach = 0.5 * wide_m * (1.0 - 0.75 * up) * (1.0 + 0.25 * np.sin(7.0 * up + rng.uniform(0, 6)))
    x = (x_m + reach * np.clip(rng.normal(0.0, 0.5, count), -1.1, 1.1)) / BAY_M * size
    z = (1.0 - (up * high_m) / STOREY_M) * size
    for colour, tone in ((_LEAVES[3], 0.5), *((leaf, 1.0) for leaf in _LEAVES)):
        mask = np.zeros((size, size), np.uint8)
        chosen = rng.random(count) < (0.8 if tone < 1.0 else 0.3)
        for a, b in np.column_stack([x, z])[chosen].tolist():
            long = size * rng.uniform(0.007, 0.014)
            shape = _leaf(a, b, long, rng.uniform(0.0, 2.0 * np.pi))
            cv2.fillConvexPoly(mask, shape, 255, cv2.LINE_AA, 4)
        cover: Field = mask.astype(np.float32) / 255.0
        canvas.fill(whole, cover, np.float32(tone) * srgb_to_linear(colour))


def _leaf(x_px: float, y_px: float, long_px: float, turn_rad: float) -> NDArray[np.int32]:
    """Return the outline of a leaf in sixteenths of a pixel."""
    along = np.array([np.cos(turn_rad), np.sin(turn_rad)]) * long_px
    aside = 0.6 * np.array([-along[1], along[0]])
    middle = np.array([x_px, y_px])
    corners = middle + np.array([along, aside, -along, -aside])
    return np.asarray(np.rint(16.0 * corners), dtype=np.int32)
