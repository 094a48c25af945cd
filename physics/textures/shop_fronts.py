"""Ground-floor bays: shops, cafes, entrances, lobbies, garages and blank walls."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Final

import numpy as np

from physics.textures.facade_canvas import (
    BAY_M,
    STOREY_M,
    WHITE_FRAME,
    FacadeCanvas,
    opening,
    pane,
    scaled,
    sill,
    surround,
)
from physics.textures.facade_signs import SHOP_WORDS, climber, lettering, poster, scrawl
from physics.textures.layers import Colour, srgb_to_linear
from physics.textures.noise import smooth_step

_FASCIAS: Final[tuple[Colour, ...]] = (
    (0.20, 0.28, 0.27),
    (0.34, 0.20, 0.19),
    (0.22, 0.26, 0.35),
    (0.30, 0.29, 0.27),
    (0.72, 0.68, 0.60),
    (0.42, 0.34, 0.24),
)
"""sRGB colours of shop fronts."""

_CLOTHS: Final[tuple[Colour, ...]] = (
    (0.47, 0.24, 0.21),
    (0.26, 0.37, 0.32),
    (0.28, 0.35, 0.45),
    (0.58, 0.47, 0.30),
)
"""sRGB colours of awnings."""

_DOORS: Final[tuple[Colour, ...]] = (
    (0.25, 0.32, 0.28),
    (0.37, 0.24, 0.17),
    (0.20, 0.23, 0.30),
    (0.42, 0.19, 0.17),
    (0.24, 0.24, 0.25),
    (0.50, 0.40, 0.28),
)
"""sRGB colours of doors."""

_GOODS: Final[tuple[Colour, ...]] = (
    (0.72, 0.68, 0.60),
    (0.55, 0.42, 0.32),
    (0.42, 0.47, 0.50),
    (0.60, 0.36, 0.30),
    (0.40, 0.46, 0.38),
    (0.66, 0.58, 0.42),
    (0.30, 0.33, 0.40),
    (0.78, 0.76, 0.72),
)
"""sRGB colours of goods in shop windows."""

_PLINTH_M: Final = 0.42
"""Height of the plinth in metres."""


def _pick(canvas: FacadeCanvas, colours: tuple[Colour, ...]) -> Colour:
    """Return a random colour."""
    return colours[int(canvas.rng.integers(len(colours)))]


def _plinth(canvas: FacadeCanvas) -> None:
    """Draw a dark plinth with a ledge and splashed dirt."""
    canvas.shade(0.0, BAY_M, 0.0, _PLINTH_M, 0.42)
    canvas.box(0.0, BAY_M, _PLINTH_M - 0.03, _PLINTH_M, (0.60, 0.59, 0.56), 0.5)
    canvas.shade(0.0, BAY_M, 0.0, 0.12, 0.35)


def _display(canvas: FacadeCanvas, x0: float, x1: float, z0: float, z1: float) -> None:
    """Draw a shop window with a lit room, shelves, goods and a reflection of the street."""
    rng = canvas.rng
    area, cover, across, up = canvas.local(x0, x1, z0, z1)
    warm = srgb_to_linear((0.68, 0.62, 0.54))
    depth = 0.35 + 0.65 * np.exp(-(((up - 0.85) / 0.3) ** 2)) * (0.9 + 0.1 * np.cos(9.0 * across))
    colour = np.broadcast_to(0.55 * warm * depth[..., None], (*cover.shape, 3)).copy()
    for shelf in (0.08, 0.38):
        x = rng.uniform(0.02, 0.08)
        while x < 0.95:
            wide, high = rng.uniform(0.04, 0.13), rng.uniform(0.07, 0.24)
            hue = np.asarray(_GOODS[int(rng.integers(len(_GOODS)))]) * rng.uniform(0.7, 1.1)
            inside = smooth_step(x - 0.01, x, across) * (
                1.0 - smooth_step(x + wide, x + wide + 0.01, across)
            )
            inside = (
                inside
                * smooth_step(shelf - 0.01, shelf, up)
                * (1.0 - smooth_step(shelf + high, shelf + high + 0.01, up))
            )
            colour += (0.8 * srgb_to_linear(hue) - colour) * inside[..., None]
            x += wide + rng.uniform(0.01, 0.12)
        board = (
            smooth_step(shelf - 0.03, shelf - 0.025, up)
            * (1.0 - smooth_step(shelf - 0.008, shelf, up))
            * np.ones_like(across)
        )
        colour += (srgb_to_linear((0.34, 0.30, 0.26)) - colour) * board[..., None]
    mirror = (
        srgb_to_linear((0.62, 0.68, 0.74))
        * smooth_step(0.35, 0.75, up + 0.12 * np.sin(5.0 * across + rng.uniform(0.0, 6.0)))[
            ..., None
        ]
    )
    colour += (mirror - colour) * np.float32(0.16)
    canvas.fill(area, cover, colour)
    canvas.gloss[area] = np.maximum(canvas.gloss[area], 0.8 * cover)
    canvas.glow[area] = np.maximum(canvas.glow[area], cover * (0.6 + 0.4 * up))


def _fascia(canvas: FacadeCanvas, colour: Colour, z0: float = 2.55, z1: float = 3.0) -> None:
    """Draw a sign board across the bay, mostly with a word."""
    canvas.box(0.0, BAY_M, z0, z1, colour)
    canvas.box(0.0, BAY_M, z1 - 0.05, z1, scaled(colour, 1.3))
    canvas.shade(0.0, BAY_M, z0 - 0.12, z0, 0.4, 0.12)
    if canvas.rng.random() < 0.8:
        mark = (0.88, 0.85, 0.76) if sum(colour) < 1.5 else (0.22, 0.21, 0.20)
        word = SHOP_WORDS[int(canvas.rng.integers(len(SHOP_WORDS)))]
        x = canvas.rng.uniform(1.1, 1.9)
        lettering(canvas, x, z0 + 0.2 * (z1 - z0), 0.62 * (z1 - z0), word, mark, 1.9)


def _shop(canvas: FacadeCanvas, door: bool = True) -> None:
    """Draw a shop with or without a door."""
    colour = _FASCIAS[2 * canvas.number % len(_FASCIAS)]
    canvas.box(0.0, BAY_M, 0.0, 3.0, scaled(colour, 0.9))
    right = 1.85 if door else BAY_M - 0.1
    canvas.box(0.1, right, 0.08, 0.45, scaled(colour, 1.12))
    canvas.shade(0.1, right, 0.42, 0.45, 0.4)
    _display(canvas, 0.1, right, 0.5, 2.45)
    if canvas.rng.random() < 0.6:
        poster(canvas, canvas.rng.uniform(0.2, right - 0.6), 0.6, 0.36, 0.5)
    for x in np.linspace(0.1, right, 2 if not door else 1, endpoint=False)[1:]:
        canvas.box(float(x) - 0.03, float(x) + 0.03, 0.5, 2.45, colour)
    canvas.frame(0.1, right, 0.46, 2.49, 0.04, scaled(colour, 1.25))
    if door:
        canvas.box(1.95, 2.9, 0.0, 2.45, scaled(colour, 0.5))
        canvas.frame(2.0, 2.85, 0.04, 2.4, 0.09, scaled(colour, 1.2))
        pane(canvas, 2.09, 2.76, 0.35, 2.31, dress=False)
        canvas.box(2.12, 2.15, 1.0, 1.25, (0.70, 0.66, 0.52))
    _fascia(canvas, colour)
    canvas.shade(0.0, BAY_M, 0.0, 0.08, 0.4)


def _awning(canvas: FacadeCanvas, z0: float, z1: float) -> None:
    """Draw striped cloth with a straight valance and its shadow."""
    cloth = _pick(canvas, _CLOTHS)
    pale = (0.78, 0.76, 0.70)
    canvas.shade(0.0, BAY_M, z0 - 0.85, z0, 0.55, 0.8)
    area, cover, across, up = canvas.local(0.0, BAY_M, z0, z1)
    stripe = (
        smooth_step(-0.08, 0.08, np.sin(2.0 * np.pi * across * BAY_M / 0.5))
        if canvas.rng.random() < 0.65
        else 0.0 * across
    )
    tone = (0.72 + 0.30 * up) * np.where(up < 0.22, 0.82, 1.0)
    colour = (
        srgb_to_linear(cloth) + (srgb_to_linear(pale) - srgb_to_linear(cloth)) * stripe[..., None]
    )
    canvas.fill(area, cover, np.asarray(colour * tone[..., None], np.float32))
    canvas.shade(0.0, BAY_M, z0 + 0.21 * (z1 - z0), z0 + 0.24 * (z1 - z0), 0.4)


def _shop_awning(canvas: FacadeCanvas) -> None:
    _shop(canvas, door=False)
    _awning(canvas, 1.98, 2.56)


def _cafe(canvas: FacadeCanvas, door: bool = False) -> None:
    """Draw a cafe with or without a door."""
    frame = _FASCIAS[(2 * canvas.number + 1) % len(_FASCIAS)]
    canvas.box(0.0, BAY_M, 0.0, 2.9, frame)
    for k in range(3):
        x0 = 0.08 + 0.96 * k
        if door and k == 1:
            canvas.box(x0, x0 + 0.88, 0.0, 2.15, scaled(frame, 0.6))
            canvas.frame(x0 + 0.04, x0 + 0.84, 0.02, 2.13, 0.09, scaled(frame, 1.2))
            pane(canvas, x0 + 0.13, x0 + 0.75, 0.35, 2.04, dress=False)
            continue
        canvas.box(x0, x0 + 0.88, 0.06, 0.55, scaled(frame, 1.25))
        canvas.shade(x0 + 0.08, x0 + 0.80, 0.14, 0.47, 0.25)
        _display(canvas, x0, x0 + 0.88, 0.62, 2.15)
        pane(canvas, x0, x0 + 0.88, 2.22, 2.6, dress=False)
    canvas.shade(0.0, BAY_M, 2.45, 2.6, 0.4, 0.15)
    _fascia(canvas, scaled(frame, 0.85), 2.62, 3.0)


def _entrance(canvas: FacadeCanvas) -> None:
    """Draw the door of an apartment building with a transom window, a step and bells."""
    _plinth(canvas)
    leaf = _pick(canvas, _DOORS)
    x0 = 0.9
    x1 = 2.1
    surround(canvas, x0, x1, 0.0, 2.65, (0.70, 0.68, 0.63))
    canvas.box(x0, x1, 0.0, 2.65, (0.16, 0.15, 0.15))
    canvas.box(x0 + 0.05, x1 - 0.05, 0.1, 2.15, leaf)
    for a, b in ((x0 + 0.15, 1.46), (1.54, x1 - 0.15)):
        for low, high in ((0.25, 0.95), (1.1, 2.02)):
            canvas.shade(a, b, low, high, 0.30)
            canvas.box(a + 0.025, b - 0.025, low, high - 0.025, scaled(leaf, 1.12))
        if canvas.rng.random() < 0.5:
            pane(canvas, a + 0.04, b - 0.04, 1.14, 1.98, dress=False)
    canvas.box(1.49, 1.51, 0.1, 2.15, scaled(leaf, 0.5))
    canvas.box(1.55, 1.59, 1.0, 1.12, (0.72, 0.66, 0.46))
    pane(canvas, x0 + 0.08, x1 - 0.08, 2.22, 2.6, dress=False)
    canvas.shade(x0, x1, 2.4, 2.65, 0.5, 0.25)
    canvas.box(x0 - 0.2, x1 + 0.2, 0.0, 0.1, (0.62, 0.61, 0.58))
    canvas.box(2.36, 2.46, 1.25, 1.55, (0.60, 0.59, 0.56))
    if canvas.rng.random() < 0.6:
        opening(canvas, 0.12, 0.6, 1.3, 2.3, WHITE_FRAME)


def _home(canvas: FacadeCanvas) -> None:
    _plinth(canvas)
    x0 = 0.85
    x1 = 2.15
    opening(canvas, x0, x1, 1.0, 2.5, WHITE_FRAME, (2, 1))
    sill(canvas, x0, x1, 1.0)
    if canvas.rng.random() < 0.25:
        for x in np.arange(x0 + 0.1, x1, 0.13):
            canvas.box(float(x) - 0.01, float(x) + 0.01, 1.02, 2.42, (0.14, 0.14, 0.15))
        canvas.box(x0, x1, 1.7, 1.72, (0.14, 0.14, 0.15))
    if canvas.number == 1:
        climber(canvas, 0.45, 0.85, 2.5)
    elif canvas.number == 2:
        climber(canvas, 2.55, 0.9, 1.3)
        climber(canvas, 0.4, 0.8, 0.9)


def _garage(canvas: FacadeCanvas) -> None:
    _plinth(canvas)
    colour = _pick(
        canvas, ((0.62, 0.62, 0.61), (0.40, 0.42, 0.44), (0.46, 0.38, 0.30), (0.70, 0.69, 0.65))
    )
    canvas.box(0.22, 2.78, 0.0, 2.5, (0.22, 0.22, 0.22))
    area, cover, _, up = canvas.local(0.3, 2.7, 0.02, 2.4)
    ribs = 0.82 + 0.18 * np.clip(8.0 * np.abs((up * 2.38 / 0.2 % 1.0) - 0.5) - 0.4, -1.0, 1.0)
    canvas.fill(
        area,
        cover,
        srgb_to_linear(colour) * np.broadcast_to(ribs, cover.shape)[..., None].astype(np.float32),
    )
    canvas.box(1.42, 1.58, 0.9, 0.95, (0.20, 0.20, 0.21))
    if canvas.number == 1:
        scrawl(canvas, 0.5, 2.3, 0.7, 1.7)
    canvas.shade(0.22, 2.78, 2.1, 2.5, 0.55, 0.4)


def _lobby(canvas: FacadeCanvas) -> None:
    """Draw a full-height glass front in steel."""
    canvas.box(0.0, BAY_M, 0.0, STOREY_M, (0.30, 0.31, 0.32))
    for k in range(2):
        pane(canvas, 1.5 * k + 0.04, 1.5 * k + 1.46, 0.12, 2.35, dress=False)
        pane(canvas, 1.5 * k + 0.04, 1.5 * k + 1.46, 2.42, 3.05, dress=False)
    if canvas.rng.random() < 0.5:
        canvas.box(1.47, 1.53, 0.12, 2.35, (0.62, 0.63, 0.64))
        for x in (1.38, 1.58):
            canvas.box(x, x + 0.035, 0.8, 1.4, (0.70, 0.71, 0.72))
    canvas.box(0.0, BAY_M, 3.05, STOREY_M, (0.42, 0.43, 0.44))


def _blank(canvas: FacadeCanvas) -> None:
    _plinth(canvas)
    if canvas.number == 0:
        for x in (0.65, 1.32):
            poster(canvas, x, 0.95, 0.6, 0.85)
    elif canvas.number == 1:
        scrawl(canvas, 0.6, 2.4, 0.5, 1.5)
    else:
        climber(canvas, 1.6, 1.5, 2.9)
    if canvas.rng.random() < 0.5:
        canvas.box(2.2, 2.7, 0.5, 1.1, (0.55, 0.55, 0.54))
        canvas.frame(2.2, 2.7, 0.5, 1.1, 0.025, (0.44, 0.44, 0.44))
    if canvas.rng.random() < 0.5:
        canvas.shade(0.34, 0.47, 0.0, STOREY_M, 0.3)
        canvas.box(0.30, 0.40, 0.0, STOREY_M, (0.50, 0.51, 0.51))
        canvas.box(0.32, 0.34, 0.0, STOREY_M, (0.66, 0.67, 0.67))


FRONTS: Final[Mapping[str, Callable[[FacadeCanvas], None]]] = {
    "shop": _shop,
    "shop-window": partial(_shop, door=False),
    "shop-awning": _shop_awning,
    "cafe": _cafe,
    "cafe-door": partial(_cafe, door=True),
    "entrance": _entrance,
    "home": _home,
    "garage": _garage,
    "lobby": _lobby,
    "blank": _blank,
}
"""Ground-floor bay styles by name."""
