"""Canvas: a bay of a facade being drawn, in metres: x from the left, z up from the storey's floor.

Everything is laid over the wall: where nothing is drawn the wall shows. Colours are composed
linearly and premultiplied, so that edges stay clean in every mip-map.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from physics.textures.layers import Colour, Picture, encoded, linear
from physics.textures.noise import Field, Noise

BAY_M: Final = 3.0
STOREY_M: Final = 3.2

_CODES: Final = encoded(np.arange(4097) / 4096.0)
_Area = tuple[slice, slice]


class FacadeCanvas:
    """rgb: (S, S, 3) linear, premultiplied; wall: (S, S) how much of the wall shows; gloss, glow:
    (S, S).

    number: of the variant; what the bays of one front have in common, such as its colour, goes by
    it.
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
        self._x = (np.arange(size, dtype=np.float32) + 0.5) / size * BAY_M
        self._z = STOREY_M - (np.arange(size, dtype=np.float32) + 0.5) / size * STOREY_M

    def box(
        self, x0: float, x1: float, z0: float, z1: float, colour: Colour, opacity: float = 1.0
    ) -> None:
        """A filled rectangle; it hides what is below, gloss and glow too."""
        (rows, columns), across, up = self._shares(x0, x1, z0, z1)
        light = linear(colour)
        if opacity < 1.0:
            self.fill((rows, columns), np.float32(opacity) * up[:, None] * across[None, :], light)
            return
        # All but the rim is covered whole: that is most of it, and cheaper.
        full_x, full_z = _whole(across, columns.start), _whole(up, rows.start)
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
        """Cover an area by (h, w) shares with a linear colour, (3,) or (h, w, 3)."""
        keep = 1.0 - cover
        self.rgb[area] = self.rgb[area] * keep[..., None] + cover[..., None] * colour
        for plane in (self.wall, self.gloss, self.glow):
            plane[area] *= keep

    def shade(
        self, x0: float, x1: float, z0: float, z1: float, dark: float, soft_m: float = 0.0
    ) -> None:
        """A shadow on whatever is there, fading out downwards over `soft_m`."""
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
        """The outline of a rectangle, `width` inwards; the upper bar is in the shade of the wall:
        darker by `head`."""
        dark = (head * colour[0], head * colour[1], head * colour[2])
        self.box(x0, x1, z1 - width, z1, dark)
        self.box(x0, x1, z0, z0 + width, colour)
        self.box(x0, x0 + width, z0, z1, colour)
        self.box(x1 - width, x1, z0, z1, colour)

    def local(
        self, x0: float, x1: float, z0: float, z1: float
    ) -> tuple[_Area, Field, Field, Field]:
        """An area, how much of each pixel it covers, and x and z in it as shares from 0 to 1, as
        rows and columns."""
        area, cover = self._cover(x0, x1, z0, z1)
        across = ((self._x[area[1]] - x0) / (x1 - x0))[None, :]
        up = ((self._z[area[0]] - z0) / (z1 - z0))[:, None]
        return area, cover, across.astype(np.float32), up.astype(np.float32)

    def picture(self) -> Picture:
        """What was drawn, as a layer."""
        at = (np.clip(self.rgb, 0.0, 1.0) * np.float32(4096.0) + np.float32(0.5)).astype(np.uint16)
        return Picture(np.take(_CODES, at), self.wall, np.stack([self.gloss, self.glow], axis=-1))

    def _cover(self, x0: float, x1: float, z0: float, z1: float) -> tuple[_Area, Field]:
        """The pixels of a rectangle, and the share of each that it covers."""
        area, across, up = self._shares(x0, x1, z0, z1)
        return area, up[:, None] * across[None, :]

    def _shares(self, x0: float, x1: float, z0: float, z1: float) -> tuple[_Area, Field, Field]:
        """The pixels of a rectangle, and the shares of its columns and rows that it covers."""
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


def _whole(shares: Field, start: int) -> slice:
    """The run of pixels, from `start` on, that is covered whole."""
    full = np.flatnonzero(shares > 0.999)
    return (
        slice(start + int(full[0]), start + int(full[-1]) + 1) if len(full) else slice(start, start)
    )
