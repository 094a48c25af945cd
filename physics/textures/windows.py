"""Upper-storey bays. A style has one shape in every bay; only rooms behind panes differ."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

import numpy as np

from physics.textures.facade_canvas import (
    BAY_M,
    BROWN,
    DARK,
    GREEN,
    STONE,
    STOREY_M,
    WHITE_FRAME,
    FacadeCanvas,
    opening,
    pane,
    railing,
    sill,
    surround,
)
from physics.textures.layers import Colour, srgb_to_linear
from physics.textures.noise import smooth_step

_Style = Callable[[FacadeCanvas], None]

_COURSE: Final = (0.66, 0.64, 0.60)
"""sRGB colour of string courses."""


def _middle(width: float) -> tuple[float, float]:
    """Return the left and right edge of a centred opening."""
    return 0.5 * (BAY_M - width), 0.5 * (BAY_M + width)


def _string_course(canvas: FacadeCanvas) -> None:
    """Draw a moulded band along the floor of the storey."""
    canvas.box(0.0, BAY_M, 0.0, 0.13, _COURSE)
    canvas.shade(0.0, BAY_M, 0.0, 0.05, 0.35)
    canvas.box(0.0, BAY_M, 0.11, 0.13, (0.76, 0.74, 0.70))


def _sash(frame: Colour, bars: int) -> _Style:
    def draw(canvas: FacadeCanvas) -> None:
        x0, x1 = _middle(1.05)
        canvas.box(x0 - 0.12, x1 + 0.12, 2.55, 2.77, STONE)
        canvas.shade(x0 - 0.1, x1 + 0.1, 2.47, 2.55, 0.3, 0.08)
        opening(canvas, x0, x1, 0.85, 2.55, frame, (1, 2))
        for k in range(1, bars):
            at = x0 + (x1 - x0) * k / bars
            canvas.box(at - 0.014, at + 0.014, 0.92, 2.45, frame)
        sill(canvas, x0, x1, 0.85)

    return draw


def _casement(frame: Colour) -> _Style:
    def draw(canvas: FacadeCanvas) -> None:
        _string_course(canvas)
        x0, x1 = _middle(1.2)
        surround(canvas, x0, x1, 0.85, 2.6, STONE)
        opening(canvas, x0, x1, 0.85, 2.6, frame, (2, 1))
        canvas.box(x0 + 0.06, x1 - 0.06, 2.02, 2.07, frame)
        sill(canvas, x0 - 0.1, x1 + 0.1, 0.85)

    return draw


def _shutters(colour: Colour) -> _Style:
    def draw(canvas: FacadeCanvas) -> None:
        x0, x1 = _middle(1.1)
        opening(canvas, x0, x1, 0.85, 2.5, WHITE_FRAME, (2, 3))
        sill(canvas, x0, x1, 0.85)
        for a, b in ((x0 - 0.58, x0 - 0.03), (x1 + 0.03, x1 + 0.58)):
            canvas.shade(a, b + 0.05, 0.80, 2.5, 0.35)
            canvas.box(a, b, 0.86, 2.5, colour)
            area, cover, _, up = canvas.local(a + 0.06, b - 0.06, 0.95, 2.41)
            slats = 0.62 + 0.3 * (up * 1.46 / 0.055 % 1.0)
            canvas.fill(
                area, cover, srgb_to_linear(colour) * np.broadcast_to(slats, cover.shape)[..., None]
            )
            canvas.box(a + 0.05, b - 0.05, 1.60, 1.70, colour)

    return draw


def _french(frame: Colour) -> _Style:
    def draw(canvas: FacadeCanvas) -> None:
        x0, x1 = _middle(1.35)
        surround(canvas, x0, x1, 0.1, 2.55, STONE, 0.09)
        opening(canvas, x0, x1, 0.1, 2.55, frame, (2, 1))
        railing(canvas, x0 - 0.12, x1 + 0.12, 0.12, 1.08)
        canvas.box(x0 - 0.18, x1 + 0.18, 0.0, 0.1, STONE)

    return draw


def _pair(frame: Colour) -> _Style:
    def draw(canvas: FacadeCanvas) -> None:
        for x in (0.85, 2.15):
            opening(canvas, x - 0.42, x + 0.42, 0.9, 2.5, frame, (1, 2))
            sill(canvas, x - 0.42, x + 0.42, 0.9)

    return draw


def _square(frame: Colour, width: float, panes: int) -> _Style:
    def draw(canvas: FacadeCanvas) -> None:
        x0, x1 = _middle(width)
        opening(canvas, x0, x1, 0.85, 2.48, frame, (panes, 1), 0.10)
        sill(canvas, x0, x1, 0.85, (0.56, 0.57, 0.57))

    return draw


def _arched(canvas: FacadeCanvas) -> None:
    """Draw a segmental arch of voussoirs over a recessed window with a straight head."""
    x0, x1 = _middle(1.1)
    _string_course(canvas)
    opening(canvas, x0, x1, 0.85, 2.5, WHITE_FRAME, (2, 2))
    area, _, across, up = canvas.local(x0 - 0.25, x1 + 0.25, 2.25, 2.8)
    x = (across - 0.5) * (x1 - x0 + 0.5)
    z = up * 0.55
    # The circle passes through the springers at z = 0.1 and the crown at z = 0.3.
    radius = (0.55**2 + 0.2**2) / (2.0 * 0.2)
    rise = z - (0.3 - radius)
    r = np.sqrt(x * x + rise * rise)
    wedge = np.abs(np.arctan2(x, rise)) < np.arcsin(0.55 / radius) + 0.02
    ring = (
        smooth_step(-0.008, 0.008, r - radius)
        * (1.0 - smooth_step(-0.008, 0.008, r - radius - 0.17))
        * wedge
    )
    joints = 1.0 - 0.18 * (np.cos(44.0 * np.arctan2(x, rise)) > 0.93)
    canvas.fill(area, np.asarray(ring, np.float32), srgb_to_linear(STONE) * joints[..., None])
    sill(canvas, x0, x1, 0.85)


def _balcony(front: Colour | None, frame: Colour) -> _Style:
    """Return a style with a balcony; `front` is its solid front, None for a railing."""

    def draw(canvas: FacadeCanvas) -> None:
        opening(canvas, 0.35, 2.65, 0.12, 2.5, frame, (3, 1), 0.12)
        canvas.shade(0.15, 2.85, 1.9, 3.0, 0.45, 0.9)
        if front is not None:
            canvas.box(0.1, 2.9, 0.15, 1.1, front)
            canvas.box(0.1, 2.9, 1.05, 1.1, (0.45, 0.45, 0.45))
            canvas.shade(0.1, 2.9, 0.98, 1.05, 0.25, 0.07)
            for x in (0.8, 1.5, 2.2):
                canvas.shade(x - 0.008, x + 0.008, 0.15, 1.05, 0.4)
        else:
            railing(canvas, 0.1, 2.9, 0.15, 1.1)
        canvas.box(0.05, 2.95, 0.0, 0.16, (0.62, 0.61, 0.59))
        canvas.shade(0.05, 2.95, 0.0, 0.05, 0.3)

    return draw


def _ribbon(canvas: FacadeCanvas) -> None:
    """Draw a continuous band of glass."""
    canvas.box(0.0, BAY_M, 0.95, 2.6, DARK)
    for k in range(2):
        pane(canvas, k * 1.5 + 0.03, k * 1.5 + 1.47, 1.0, 2.55)
    canvas.shade(0.0, BAY_M, 2.40, 2.6, 0.45, 0.2)
    canvas.box(0.0, BAY_M, 0.90, 0.96, (0.50, 0.51, 0.52))


def _office(spandrel: Colour) -> _Style:
    """Return a style of a curtain wall with opaque spandrels and vertical fins."""

    def draw(canvas: FacadeCanvas) -> None:
        canvas.box(0.0, BAY_M, 0.0, STOREY_M, (0.24, 0.25, 0.27))
        for k in range(2):
            pane(canvas, k * 1.5 + 0.04, k * 1.5 + 1.46, 0.85, 3.1)
            canvas.box(k * 1.5 + 0.04, k * 1.5 + 1.46, 0.06, 0.80, spandrel)
            canvas.box(k * 1.5 - 0.025, k * 1.5 + 0.025, 0.0, STOREY_M, (0.52, 0.53, 0.54))
        canvas.box(BAY_M - 0.025, BAY_M, 0.0, STOREY_M, (0.52, 0.53, 0.54))

    return draw


def _blank(canvas: FacadeCanvas) -> None:
    """Draw no window, sometimes a grille."""
    if canvas.rng.random() < 0.5:
        canvas.box(1.3, 1.7, 2.3, 2.6, (0.40, 0.40, 0.41))
        for z in np.arange(2.32, 2.58, 0.05):
            canvas.shade(1.32, 1.68, float(z), float(z) + 0.025, 0.5)


WINDOW_STYLES: Final[Mapping[str, _Style]] = {
    "sash": _sash(WHITE_FRAME, 2),
    "sash-fine": _sash(WHITE_FRAME, 3),
    "casement": _casement(WHITE_FRAME),
    "casement-brown": _casement(BROWN),
    "shutters": _shutters((0.29, 0.36, 0.32)),
    "shutters-brown": _shutters((0.42, 0.32, 0.26)),
    "french": _french(WHITE_FRAME),
    "french-dark": _french(DARK),
    "pair": _pair(WHITE_FRAME),
    "pair-green": _pair(GREEN),
    "square": _square(DARK, 1.6, 2),
    "square-white": _square(WHITE_FRAME, 1.4, 2),
    "wide": _square(DARK, 2.2, 3),
    "arched": _arched,
    "balcony": _balcony((0.64, 0.63, 0.60), WHITE_FRAME),
    "balcony-railed": _balcony(None, DARK),
    "ribbon": _ribbon,
    "office": _office((0.36, 0.39, 0.41)),
    "office-light": _office((0.60, 0.60, 0.58)),
    "blank-upper": _blank,
}
"""Upper-storey bay styles by name."""
