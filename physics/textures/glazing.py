"""What openings are made of: panes with what is behind them, frames in reveals, sills, surrounds,
railings."""

from __future__ import annotations

from typing import Final

import numpy as np

from physics.textures.facade_canvas import FacadeCanvas
from physics.textures.layers import Colour, linear
from physics.textures.noise import Field, step

WHITE_FRAME: Final = (0.84, 0.83, 0.80)
BROWN: Final = (0.37, 0.28, 0.21)
DARK: Final = (0.23, 0.24, 0.26)
GREEN: Final = (0.29, 0.36, 0.32)
STONE: Final = (0.70, 0.68, 0.63)
IRON: Final = (0.13, 0.13, 0.14)
_CURTAINS: Final[tuple[Colour, ...]] = (
    (0.82, 0.80, 0.76),
    (0.76, 0.73, 0.68),
    (0.66, 0.57, 0.51),
    (0.62, 0.64, 0.65),
)
LIT_SHARE: Final = 0.4
"""Share of rooms with a light on at night."""


def pane(
    canvas: FacadeCanvas, x0: float, x1: float, z0: float, z1: float, dress: bool = True
) -> None:
    """Glass: a dark room, a reflection of sky over roofs, perhaps curtains or a blind; some are lit
    at night."""
    rng = canvas.rng
    area, cover, across, up = canvas.local(x0, x1, z0, z1)
    room = linear((0.13, 0.14, 0.15)) * (0.6 + 0.8 * (1.0 - up)[..., None])
    colour = np.broadcast_to(room, (*cover.shape, 3)).copy()
    lit = rng.random() < LIT_SHARE
    glow = np.full(cover.shape, 0.75 if lit else 0.0, np.float32) * (0.7 + 0.3 * up)
    if dress:
        kind = rng.choice(["curtains", "net", "blind", "bare"], p=[0.38, 0.17, 0.2, 0.25])
        cloth = linear(_CURTAINS[int(rng.integers(len(_CURTAINS)))])
        folds: Field = 0.80 + 0.20 * np.sin(
            2.0 * np.pi * (across * (x1 - x0) / 0.085 + rng.random())
        )
        share: Field = np.zeros(cover.shape, np.float32)
        if kind == "curtains":
            open_ = rng.uniform(0.12, 0.3)
            share = (
                np.maximum(
                    step(-open_ - 0.02, -open_, -across), step(1.0 - open_, 1.02 - open_, across)
                )
                + 0.0 * up
            )
        elif kind == "net":
            share = (0.55 + 0.0 * up) * np.ones_like(across)
        elif kind == "blind":
            low = rng.uniform(0.25, 0.8)
            share = 0.9 * step(low, low + 0.01, up) * np.ones_like(across)
            folds = 0.84 + 0.16 * np.sin(2.0 * np.pi * up * (z1 - z0) / 0.06)
        colour += (0.75 * cloth * np.asarray(folds)[..., None] - colour) * share[..., None]
        glow *= 1.0 - 0.45 * share
    roofs = np.repeat(rng.uniform(0.12, 0.45, 4), 3)[: int(rng.integers(4, 10))]
    skyline = np.interp(across[0], np.linspace(-0.1, 1.1, len(roofs)), roofs)[None, :]
    sky = step(-0.03, 0.05, up - skyline.astype(np.float32))
    house, above = linear((0.44, 0.42, 0.39)), linear((0.66, 0.73, 0.80))
    mirror = house + (above - house) * sky[..., None]
    colour += (mirror - colour) * np.float32(rng.uniform(0.34, 0.52))
    colour *= (1.0 - 0.35 * step(0.86, 1.0, up) - 0.15 * step(0.9, 1.0, across))[..., None]
    canvas.fill(area, cover, colour)
    canvas.gloss[area] = np.maximum(canvas.gloss[area], cover)
    canvas.glow[area] = np.maximum(canvas.glow[area], cover * glow)


def opening(
    canvas: FacadeCanvas,
    x0: float,
    x1: float,
    z0: float,
    z1: float,
    frame: Colour,
    bars: tuple[int, int] = (1, 1),
    deep: float = 0.07,
) -> None:
    """A window in its reveal: shadow of the wall above, frame, (across, up) panes."""
    canvas.box(x0, x1, z0, z1, (0.30, 0.29, 0.28))
    fx0 = x0 + 0.35 * deep
    fx1 = x1 - 0.35 * deep
    fz1 = z1 - 0.6 * deep
    canvas.frame(fx0, fx1, z0, fz1, 0.055, frame)
    nx, nz = bars
    ex, ez = (fx1 - fx0 - 0.11) / nx, (fz1 - z0 - 0.11) / nz
    pane(canvas, fx0 + 0.055, fx1 - 0.055, z0 + 0.055, fz1 - 0.055)
    for i in range(1, nx):
        at = fx0 + 0.055 + i * ex
        canvas.box(at - 0.028, at + 0.028, z0 + 0.05, fz1 - 0.05, frame)
    for j in range(1, nz):
        at = z0 + 0.055 + j * ez
        canvas.box(fx0 + 0.05, fx1 - 0.05, at - 0.022, at + 0.022, frame)
    canvas.shade(x0, x1, z1 - 0.16, z1, 0.45, 0.16)
    canvas.shade(x0, x0 + 0.05, z0, z1, 0.25)


def sill(canvas: FacadeCanvas, x0: float, x1: float, z: float, colour: Colour = STONE) -> None:
    canvas.box(x0 - 0.08, x1 + 0.08, z - 0.07, z, colour)
    canvas.box(x0 - 0.08, x1 + 0.08, z - 0.012, z, tuple(min(1.0, 1.1 * c) for c in colour))  # type: ignore[arg-type]
    canvas.shade(x0 - 0.06, x1 + 0.06, z - 0.22, z - 0.07, 0.45, 0.15)


def surround(
    canvas: FacadeCanvas,
    x0: float,
    x1: float,
    z0: float,
    z1: float,
    colour: Colour,
    width: float = 0.13,
) -> None:
    """A raised border around an opening, with the shadow it throws."""
    canvas.shade(x0 - width, x1 + width + 0.03, z0, z1 + width, 0.35)
    canvas.frame(x0 - width, x1 + width, z0, z1 + width, width, colour, head=1.03)


def railing(canvas: FacadeCanvas, x0: float, x1: float, z0: float, z1: float) -> None:
    for x in np.arange(x0 + 0.05, x1, 0.11):
        canvas.box(float(x) - 0.008, float(x) + 0.008, z0, z1, IRON)
    canvas.box(x0, x1, z1 - 0.04, z1, IRON)
    canvas.box(x0, x1, z0, z0 + 0.025, IRON)
