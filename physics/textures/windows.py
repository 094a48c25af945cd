"""Windows of the upper storeys: what is behind a pane, frames, sills, shutters, railings."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

import numpy as np

from physics.textures.facade_canvas import BAY_M, STOREY_M, Canvas
from physics.textures.layers import Colour, linear
from physics.textures.noise import Field, step

FRAMES: Final[tuple[Colour, ...]] = (
    (0.86, 0.85, 0.82), (0.80, 0.79, 0.75), (0.22, 0.23, 0.25), (0.36, 0.27, 0.20), (0.84, 0.83, 0.80),
    (0.30, 0.36, 0.33),
)  # fmt: skip
_STONE: Final = (0.72, 0.70, 0.65)
_IRON: Final = (0.13, 0.13, 0.14)
_CURTAINS: Final[tuple[Colour, ...]] = ((0.80, 0.78, 0.73), (0.70, 0.66, 0.60), (0.62, 0.50, 0.44), (0.56, 0.60, 0.62))
_PAINTS: Final[tuple[Colour, ...]] = ((0.27, 0.35, 0.31), (0.40, 0.30, 0.24), (0.33, 0.40, 0.46), (0.52, 0.50, 0.45))
LIT_SHARE: Final = 0.4


def pane(canvas: Canvas, x0: float, x1: float, z0: float, z1: float, dress: bool = True) -> None:
    """Glass: a dark room, a reflection of sky over roofs, perhaps curtains or a blind; some are lit at night."""
    rng = canvas.rng
    area, cover, across, up = canvas.local(x0, x1, z0, z1)
    room = linear((0.13, 0.14, 0.15)) * (0.6 + 0.8 * (1.0 - up)[..., None])
    colour = np.broadcast_to(room, (*cover.shape, 3)).copy()
    lit = rng.random() < LIT_SHARE
    glow = np.full(cover.shape, 0.75 if lit else 0.0, np.float32) * (0.7 + 0.3 * up)
    if dress:
        kind = rng.choice(["curtains", "net", "blind", "bare"], p=[0.38, 0.17, 0.2, 0.25])
        cloth = linear(_CURTAINS[int(rng.integers(len(_CURTAINS)))])
        folds: Field = 0.80 + 0.20 * np.sin(2.0 * np.pi * (across * (x1 - x0) / 0.085 + rng.random()))
        share: Field = np.zeros(cover.shape, np.float32)
        if kind == "curtains":
            open_ = rng.uniform(0.12, 0.3)
            share = np.maximum(step(-open_ - 0.02, -open_, -across), step(1.0 - open_, 1.02 - open_, across)) + 0.0 * up
        elif kind == "net":
            share = (0.55 + 0.0 * up) * np.ones_like(across)
        elif kind == "blind":
            low = rng.uniform(0.25, 0.8)
            share = 0.9 * step(low, low + 0.01, up) * np.ones_like(across)
            folds = 0.84 + 0.16 * np.sin(2.0 * np.pi * up * (z1 - z0) / 0.06)
        colour += (0.55 * cloth * np.asarray(folds)[..., None] - colour) * share[..., None]
        glow *= 1.0 - 0.45 * share
    roofs = np.repeat(rng.uniform(0.25, 0.6, 4), 3)[: int(rng.integers(4, 10))]
    skyline = np.interp(across[0], np.linspace(-0.1, 1.1, len(roofs)), roofs)[None, :]
    sky = step(-0.03, 0.05, up - skyline.astype(np.float32))
    mirror = linear((0.36, 0.34, 0.32)) + (linear((0.66, 0.73, 0.80)) - linear((0.36, 0.34, 0.32))) * sky[..., None]
    colour += (mirror - colour) * np.float32(rng.uniform(0.28, 0.42))
    colour *= (1.0 - 0.35 * step(0.86, 1.0, up) - 0.15 * step(0.9, 1.0, across))[..., None]
    canvas.fill(area, cover, colour)
    canvas.gloss[area] = np.maximum(canvas.gloss[area], cover)
    canvas.glow[area] = np.maximum(canvas.glow[area], cover * glow)


def opening(
    canvas: Canvas,
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
    fx0, fx1, fz1 = x0 + 0.35 * deep, x1 - 0.35 * deep, z1 - 0.6 * deep
    canvas.frame(fx0, fx1, z0, fz1, 0.055, frame)
    nx, nz = bars
    ex, ez = (fx1 - fx0 - 0.11) / nx, (fz1 - z0 - 0.11) / nz
    for i in range(nx):
        for j in range(nz):
            ax, az = fx0 + 0.055 + i * ex, z0 + 0.055 + j * ez
            pane(canvas, ax, ax + ex, az, az + ez, dress=True) if (nx, nz) == (1, 1) else None
    if (nx, nz) != (1, 1):
        pane(canvas, fx0 + 0.055, fx1 - 0.055, z0 + 0.055, fz1 - 0.055)
        for i in range(1, nx):
            at = fx0 + 0.055 + i * ex
            canvas.box(at - 0.028, at + 0.028, z0 + 0.05, fz1 - 0.05, frame)
        for j in range(1, nz):
            at = z0 + 0.055 + j * ez
            canvas.box(fx0 + 0.05, fx1 - 0.05, at - 0.022, at + 0.022, frame)
    canvas.shade(x0, x1, z1 - 0.16, z1, 0.45, 0.16)
    canvas.shade(x0, x0 + 0.05, z0, z1, 0.25)


def sill(canvas: Canvas, x0: float, x1: float, z: float, colour: Colour = _STONE) -> None:
    canvas.box(x0 - 0.08, x1 + 0.08, z - 0.07, z, colour)
    canvas.box(x0 - 0.08, x1 + 0.08, z - 0.012, z, tuple(min(1.0, 1.1 * c) for c in colour))  # type: ignore[arg-type]
    canvas.shade(x0 - 0.06, x1 + 0.06, z - 0.22, z - 0.07, 0.45, 0.15)


def surround(canvas: Canvas, x0: float, x1: float, z0: float, z1: float, colour: Colour, width: float = 0.13) -> None:
    """A raised border around an opening, with the shadow it throws."""
    canvas.shade(x0 - width, x1 + width + 0.03, z0, z1 + width, 0.35)
    canvas.frame(x0 - width, x1 + width, z0, z1 + width, width, colour)


def railing(canvas: Canvas, x0: float, x1: float, z0: float, z1: float) -> None:
    for x in np.arange(x0 + 0.05, x1, 0.11):
        canvas.box(float(x) - 0.008, float(x) + 0.008, z0, z1, _IRON)
    canvas.box(x0, x1, z1 - 0.04, z1, _IRON)
    canvas.box(x0, x1, z0, z0 + 0.025, _IRON)


def _frame(canvas: Canvas) -> Colour:
    return FRAMES[int(canvas.rng.integers(len(FRAMES)))]


def _middle(width: float) -> tuple[float, float]:
    return 0.5 * (BAY_M - width), 0.5 * (BAY_M + width)


def _sash(canvas: Canvas) -> None:
    x0, x1 = _middle(canvas.rng.uniform(1.0, 1.2))
    canvas.box(x0 - 0.12, x1 + 0.12, 2.55, 2.77, _STONE)
    canvas.shade(x0 - 0.1, x1 + 0.1, 2.47, 2.55, 0.3, 0.08)
    opening(canvas, x0, x1, 0.85, 2.55, FRAMES[0], (1, 2))
    if canvas.rng.random() < 0.6:
        canvas.box(1.5 - 0.014, 1.5 + 0.014, 0.95, 2.45, FRAMES[0])
    sill(canvas, x0, x1, 0.85)


def _casement(canvas: Canvas) -> None:
    x0, x1 = _middle(canvas.rng.uniform(1.15, 1.35))
    surround(canvas, x0, x1, 0.85, 2.6, _STONE)
    opening(canvas, x0, x1, 0.85, 2.6, _frame(canvas), (2, 1))
    frame = _frame(canvas)
    canvas.box(x0 + 0.06, x1 - 0.06, 2.02, 2.07, frame)
    sill(canvas, x0 - 0.1, x1 + 0.1, 0.85)


def _shutters(canvas: Canvas) -> None:
    x0, x1 = _middle(1.1)
    colour = _PAINTS[int(canvas.rng.integers(len(_PAINTS)))]
    opening(canvas, x0, x1, 0.85, 2.5, FRAMES[0], (2, 3))
    sill(canvas, x0, x1, 0.85)
    for a, b in ((x0 - 0.58, x0 - 0.03), (x1 + 0.03, x1 + 0.58)):
        canvas.shade(a, b + 0.05, 0.80, 2.5, 0.35)
        canvas.box(a, b, 0.86, 2.5, colour)
        area, cover, _, up = canvas.local(a + 0.06, b - 0.06, 0.95, 2.41)
        slats = 0.62 + 0.3 * (up * 1.46 / 0.055 % 1.0)
        canvas.fill(area, cover, linear(colour) * np.broadcast_to(slats, cover.shape)[..., None])
        canvas.box(a + 0.05, b - 0.05, 1.60, 1.70, colour)


def _french(canvas: Canvas) -> None:
    x0, x1 = _middle(canvas.rng.uniform(1.2, 1.5))
    surround(canvas, x0, x1, 0.1, 2.55, _STONE, 0.09)
    opening(canvas, x0, x1, 0.1, 2.55, _frame(canvas), (2, 1))
    railing(canvas, x0 - 0.12, x1 + 0.12, 0.12, 1.08)
    canvas.box(x0 - 0.18, x1 + 0.18, 0.0, 0.1, _STONE)


def _pair(canvas: Canvas) -> None:
    frame = _frame(canvas)
    for x in (0.85, 2.15):
        opening(canvas, x - 0.42, x + 0.42, 0.9, 2.5, frame, (1, 1 + int(canvas.rng.integers(2))))
        sill(canvas, x - 0.42, x + 0.42, 0.9)


def _square(canvas: Canvas) -> None:
    x0, x1 = _middle(canvas.rng.uniform(1.4, 1.8))
    opening(canvas, x0, x1, 0.8, 2.5, FRAMES[2] if canvas.rng.random() < 0.6 else _frame(canvas), (2, 1), 0.10)
    sill(canvas, x0, x1, 0.8, (0.55, 0.56, 0.57))


def _wide(canvas: Canvas) -> None:
    x0, x1 = _middle(2.2)
    opening(canvas, x0, x1, 0.9, 2.45, _frame(canvas), (3, 1), 0.09)
    sill(canvas, x0, x1, 0.9, (0.60, 0.60, 0.59))


def _arched(canvas: Canvas) -> None:
    x0, x1 = _middle(1.1)
    area, _, across, up = canvas.local(x0 - 0.2, x1 + 0.2, 2.2, 2.75)
    x, z = (across - 0.5) * (x1 - x0 + 0.4), up * 0.55
    flat = np.float32(0.55)
    r = np.sqrt(x * x + (z + flat) ** 2)
    outer = step(-0.006, 0.006, np.float32(np.hypot(0.55, flat) + 0.16) - r) * step(-0.01, 0.0, 0.0 * x + z)
    opening(canvas, x0, x1, 0.85, 2.5, FRAMES[0], (2, 2))
    inside = step(-0.006, 0.006, np.float32(np.hypot(0.55, flat)) - r)
    voussoir = 1.0 - 0.12 * (np.cos(60.0 * np.arctan2(x, z + flat)) > 0.8)
    canvas.fill(area, np.asarray(outer * (1.0 - inside), np.float32), linear(_STONE) * voussoir[..., None])
    sill(canvas, x0, x1, 0.85)


def _balcony(canvas: Canvas) -> None:
    """A balcony with a solid or a railed front, its door and window in the shade behind it."""
    x0, x1 = 0.25, 2.75
    opening(canvas, x0 + 0.1, x1 - 0.1, 0.12, 2.5, _frame(canvas), (3, 1), 0.12)
    canvas.shade(0.15, 2.85, 1.9, 3.0, 0.45, 0.9)
    if canvas.rng.random() < 0.6:
        front = (0.66, 0.65, 0.62) if canvas.rng.random() < 0.5 else (0.55, 0.60, 0.63)
        canvas.box(0.1, 2.9, 0.15, 1.1, front)
        canvas.box(0.1, 2.9, 1.04, 1.1, tuple(0.75 * c for c in front))  # type: ignore[arg-type]
    else:
        railing(canvas, 0.1, 2.9, 0.15, 1.1)
    canvas.box(0.05, 2.95, 0.0, 0.16, (0.62, 0.61, 0.59))


def _ribbon(canvas: Canvas) -> None:
    """Glass from edge to edge; bays side by side make one band."""
    canvas.box(0.0, BAY_M, 0.95, 2.6, (0.24, 0.25, 0.26))
    for k in range(2):
        pane(canvas, k * 1.5 + 0.03, k * 1.5 + 1.47, 1.0, 2.55)
    canvas.shade(0.0, BAY_M, 2.40, 2.6, 0.45, 0.2)
    canvas.box(0.0, BAY_M, 0.90, 0.96, (0.50, 0.51, 0.52))


def _office(canvas: Canvas) -> None:
    """Curtain wall: panes above a dark breast, upright fins."""
    canvas.box(0.0, BAY_M, 0.0, STOREY_M, (0.24, 0.25, 0.27))
    spandrel = ((0.30, 0.34, 0.37), (0.40, 0.41, 0.41), (0.26, 0.30, 0.31))[int(canvas.rng.integers(3))]
    for k in range(2):
        pane(canvas, k * 1.5 + 0.04, k * 1.5 + 1.46, 0.85, 3.1)
        canvas.box(k * 1.5 + 0.04, k * 1.5 + 1.46, 0.06, 0.80, spandrel)
        canvas.box(k * 1.5 - 0.025, k * 1.5 + 0.025, 0.0, STOREY_M, (0.52, 0.53, 0.54))
    canvas.box(BAY_M - 0.025, BAY_M, 0.0, STOREY_M, (0.52, 0.53, 0.54))


def _blank(canvas: Canvas) -> None:
    if canvas.rng.random() < 0.5:
        canvas.box(1.3, 1.7, 2.3, 2.6, (0.40, 0.40, 0.41))
        for z in np.arange(2.32, 2.58, 0.05):
            canvas.shade(1.32, 1.68, float(z), float(z) + 0.025, 0.5)


WINDOWS: Final[Mapping[str, Callable[[Canvas], None]]] = {
    "sash": _sash,
    "casement": _casement,
    "shutters": _shutters,
    "french": _french,
    "pair": _pair,
    "square": _square,
    "wide": _wide,
    "arched": _arched,
    "balcony": _balcony,
    "ribbon": _ribbon,
    "office": _office,
    "blank-upper": _blank,
}
"""Styles of upper bays."""
