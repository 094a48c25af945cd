"""Drawing canvas for one facade bay, and the parts of windows drawn on it.

Coordinates are in metres: x from the left, z up from the storey's floor. The wall shows where
    nothing is drawn. Colours are linear and premultiplied, so that edges stay correct in every
    mip-map.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from physics.textures.layers import Colour, Picture, linear_to_srgb, srgb_to_linear
from physics.textures.noise import Field, Noise, pixel_centres, smooth_step

BAY_M: Final = 3.0
"""Width of a bay in metres."""

STOREY_M: Final = 3.2
"""Height of a storey in metres."""

_SRGB_CODES: Final = linear_to_srgb(np.arange(4097) / 4096.0)
"""Table of 4097 linear values encoded as sRGB."""

_Area = tuple[slice, slice]
"""Rows and columns of an area of pixels."""

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
"""sRGB colours of curtains."""

LIT_SHARE: Final = 0.4
"""Fraction of rooms with a light on at night."""


class FacadeCanvas:
    """Canvas of one bay with S x S pixels.

    rgb: (S, S, 3) linear, premultiplied
    wall: (S, S) visible fraction of the wall
    gloss, glow: (S, S) reflection and light at night
    number: index of the variant; it selects properties shared by all bays of a front
    """

    def __init__(self, noise: Noise, number: int = 0) -> None:
        size = noise.size
        self.number = number
        self.noise = noise
        self.rng = noise.rng
        self.size = size
        self.rgb = np.zeros((size, size, 3), np.float32)
        self.wall = np.ones((size, size), np.float32)
        self.gloss = np.zeros((size, size), np.float32)
        self.glow = np.zeros((size, size), np.float32)
        self._x = pixel_centres(size) * BAY_M
        self._z = STOREY_M - pixel_centres(size) * STOREY_M

    def box(
        self, x0: float, x1: float, z0: float, z1: float, colour: Colour, opacity: float = 1.0
    ) -> None:
        """Fill a rectangle, which also removes gloss and glow."""
        (rows, columns), across, up = self._coverage(x0, x1, z0, z1)
        light = srgb_to_linear(colour)
        if opacity < 1.0:
            self.fill((rows, columns), np.float32(opacity) * up[:, None] * across[None, :], light)
            return
        # Pixels inside the rim are fully covered, so they are assigned, which is faster.
        full_x, full_z = _full_range(across, columns.start), _full_range(up, rows.start)
        for plane, value in (
            (self.rgb, light),
            (self.wall, 0.0),
            (self.gloss, 0.0),
            (self.glow, 0.0),
        ):
            plane[full_z, full_x] = value
        for x in (slice(columns.start, full_x.start), slice(full_x.stop, columns.stop)):
            self.fill(
                (rows, x),
                up[:, None] * across[None, x.start - columns.start : x.stop - columns.start],
                light,
            )
        for z in (slice(rows.start, full_z.start), slice(full_z.stop, rows.stop)):
            share = up[z.start - rows.start : z.stop - rows.start, None]
            inner = across[None, full_x.start - columns.start : full_x.stop - columns.start]
            self.fill((z, full_x), share * inner, light)

    def fill(self, area: _Area, cover: Field, colour: np.ndarray) -> None:
        """Blend a linear colour, (3,) or (h, w, 3), into an area with (h, w) opacity."""
        keep = 1.0 - cover
        self.rgb[area] = self.rgb[area] * keep[..., None] + cover[..., None] * colour
        for plane in (self.wall, self.gloss, self.glow):
            plane[area] *= keep

    def shade(
        self, x0: float, x1: float, z0: float, z1: float, dark: float, soft_m: float = 0.0
    ) -> None:
        """Darken a rectangle; the shadow fades out downwards over `soft_m`."""
        area, cover = self._cover(x0, x1, z0, z1)
        if soft_m:
            cover = cover * np.clip((self._z[area[0]] - z0) / soft_m, 0.0, 1.0)[:, None]
        keep = 1.0 - np.float32(dark) * cover
        self.rgb[area] *= keep[..., None]
        self.wall[area] *= keep

    def frame(
        self,
        x0: float,
        x1: float,
        z0: float,
        z1: float,
        width: float,
        colour: Colour,
        head: float = 0.8,
    ) -> None:
        """Draw the outline of a rectangle, `width` inwards.

        head: brightness factor of the upper bar, which is in the shade of the wall
        """
        dark = (head * colour[0], head * colour[1], head * colour[2])
        self.box(x0, x1, z1 - width, z1, dark)
        self.box(x0, x1, z0, z0 + width, colour)
        self.box(x0, x0 + width, z0, z1, colour)
        self.box(x1 - width, x1, z0, z1, colour)

    def local(
        self, x0: float, x1: float, z0: float, z1: float
    ) -> tuple[_Area, Field, Field, Field]:
        """Return an area, the covered fraction of its pixels, and local coordinates.

        Local x and z run from 0 to 1, as a row and a column.
        """
        area, cover = self._cover(x0, x1, z0, z1)
        across = ((self._x[area[1]] - x0) / (x1 - x0))[None, :]
        up = ((self._z[area[0]] - z0) / (z1 - z0))[:, None]
        return area, cover, across.astype(np.float32), up.astype(np.float32)

    def picture(self) -> Picture:
        """Return the drawing as a layer."""
        at = (np.clip(self.rgb, 0.0, 1.0) * np.float32(4096.0) + np.float32(0.5)).astype(np.uint16)
        return Picture(
            np.take(_SRGB_CODES, at), self.wall, np.stack([self.gloss, self.glow], axis=-1)
        )

    def _cover(self, x0: float, x1: float, z0: float, z1: float) -> tuple[_Area, Field]:
        """Return the pixels of a rectangle and the covered fraction of each."""
        area, across, up = self._coverage(x0, x1, z0, z1)
        return area, up[:, None] * across[None, :]

    def _coverage(self, x0: float, x1: float, z0: float, z1: float) -> tuple[_Area, Field, Field]:
        """Return the pixels of a rectangle and the covered fractions of its columns and rows."""
        px, pz = BAY_M / self.size, STOREY_M / self.size
        columns = slice(max(0, int(np.floor(x0 / px))), min(self.size, int(np.ceil(x1 / px))))
        rows = slice(
            max(0, int(np.floor((STOREY_M - z1) / pz))),
            min(self.size, int(np.ceil((STOREY_M - z0) / pz))),
        )
        x, z = self._x[columns], self._z[rows]
        across = (
            np.clip(np.minimum(x1, x + 0.5 * px) - np.maximum(x0, x - 0.5 * px), 0.0, None) / px
        )
        up = np.clip(np.minimum(z1, z + 0.5 * pz) - np.maximum(z0, z - 0.5 * pz), 0.0, None) / pz
        return (rows, columns), across.astype(np.float32), up.astype(np.float32)


def _full_range(shares: Field, start: int) -> slice:
    """Return the range of fully covered pixels, offset by `start`."""
    full = np.flatnonzero(shares > 0.999)
    return (
        slice(start + int(full[0]), start + int(full[-1]) + 1) if len(full) else slice(start, start)
    )


def scaled(colour: Colour, factor: float) -> Colour:
    """Return a brighter or darker colour."""
    return tuple(min(1.0, factor * c) for c in colour)  # type: ignore[return-value]


def pane(
    canvas: FacadeCanvas, x0: float, x1: float, z0: float, z1: float, dress: bool = True
) -> None:
    """Draw glass with a dark room, a reflected skyline, and some curtains, blinds and lights.

    dress: allow curtains and blinds
    """
    rng = canvas.rng
    area, cover, across, up = canvas.local(x0, x1, z0, z1)
    room = srgb_to_linear((0.13, 0.14, 0.15)) * (0.6 + 0.8 * (1.0 - up)[..., None])
    colour = np.broadcast_to(room, (*cover.shape, 3)).copy()
    lit = rng.random() < LIT_SHARE
    glow = np.full(cover.shape, 0.75 if lit else 0.0, np.float32) * (0.7 + 0.3 * up)
    if dress:
        kind = rng.choice(["curtains", "net", "blind", "bare"], p=[0.38, 0.17, 0.2, 0.25])
        cloth = srgb_to_linear(_CURTAINS[int(rng.integers(len(_CURTAINS)))])
        folds: Field = 0.80 + 0.20 * np.sin(
            2.0 * np.pi * (across * (x1 - x0) / 0.085 + rng.random())
        )
        share: Field = np.zeros(cover.shape, np.float32)
        if kind == "curtains":
            open_ = rng.uniform(0.12, 0.3)
            share = (
                np.maximum(
                    smooth_step(-open_ - 0.02, -open_, -across),
                    smooth_step(1.0 - open_, 1.02 - open_, across),
                )
                + 0.0 * up
            )
        elif kind == "net":
            share = (0.55 + 0.0 * up) * np.ones_like(across)
        elif kind == "blind":
            low = rng.uniform(0.25, 0.8)
            share = 0.9 * smooth_step(low, low + 0.01, up) * np.ones_like(across)
            folds = 0.84 + 0.16 * np.sin(2.0 * np.pi * up * (z1 - z0) / 0.06)
        colour += (0.75 * cloth * np.asarray(folds)[..., None] - colour) * share[..., None]
        glow *= 1.0 - 0.45 * share
    roofs = np.repeat(rng.uniform(0.12, 0.45, 4), 3)[: int(rng.integers(4, 10))]
    skyline = np.interp(across[0], np.linspace(-0.1, 1.1, len(roofs)), roofs)[None, :]
    sky = smooth_step(-0.03, 0.05, up - skyline.astype(np.float32))
    house, above = srgb_to_linear((0.44, 0.42, 0.39)), srgb_to_linear((0.66, 0.73, 0.80))
    mirror = house + (above - house) * sky[..., None]
    colour += (mirror - colour) * np.float32(rng.uniform(0.34, 0.52))
    colour *= (1.0 - 0.35 * smooth_step(0.86, 1.0, up) - 0.15 * smooth_step(0.9, 1.0, across))[
        ..., None
    ]
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
    """Draw a window in its reveal with a frame.

    bars: number of panes across and up
    deep: depth of the reveal
    """
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
    """Draw a window sill and its shadow."""
    canvas.box(x0 - 0.08, x1 + 0.08, z - 0.07, z, colour)
    canvas.box(x0 - 0.08, x1 + 0.08, z - 0.012, z, scaled(colour, 1.1))
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
    """Draw a raised border around an opening with its shadow."""
    canvas.shade(x0 - width, x1 + width + 0.03, z0, z1 + width, 0.35)
    canvas.frame(x0 - width, x1 + width, z0, z1 + width, width, colour, head=1.03)


def railing(canvas: FacadeCanvas, x0: float, x1: float, z0: float, z1: float) -> None:
    """Draw an iron railing."""
    for x in np.arange(x0 + 0.05, x1, 0.11):
        canvas.box(float(x) - 0.008, float(x) + 0.008, z0, z1, IRON)
    canvas.box(x0, x1, z1 - 0.04, z1, IRON)
    canvas.box(x0, x1, z0, z0 + 0.025, IRON)
