"""Unevenness of the ground as a pure function of position, roughness and seed.

Pavement has slabs of unequal height, a slow undulation with cross-slopes of at most 2 %, and bumps
over tree roots. Roads have potholes. Roughness 0 adds no relief.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import shapely
from numpy.typing import NDArray

from cosim.core.geometry import Floats

SLAB_M: Final = 1.0
"""Side of a pavement slab in metres."""

SLAB_HEIGHT_M: Final = 0.006
"""Largest height offset of a settled slab in metres."""

RAISED_M: Final = 0.02
"""Additional height of a raised slab in metres."""

RAISED_SHARE: Final = 0.08
"""Fraction of slab corners that are raised."""

WAVE_M: Final = 6.0
"""Distance between the nodes of the undulation in metres."""

WAVE_HEIGHT_M: Final = 0.025
"""Largest height of the undulation in metres.

With smooth steps between nodes, the slope along an axis stays below 3 x height / length.
"""

ROOT_HEIGHT_M: Final = 0.035
"""Height of the bump over tree roots in metres."""

ROOT_M: Final = 0.5
"""Standard deviation of the Gaussian root bump in metres."""

POTHOLE_CELL_M: Final = 9.0
"""Side of a grid cell in metres; each cell has at most one pothole."""

POTHOLE_SHARE: Final = 0.5
"""Fraction of cells with a pothole at roughness 1."""

POTHOLE_RADIUS_M: Final = (0.25, 0.5)
"""Smallest and largest radius of a pothole in metres."""

POTHOLE_DEPTH_M: Final = 0.05
"""Depth of a pothole at roughness 1 in metres."""

_SIDES: Final = 8
"""Corners of the polygon that represents the rim of a pothole."""


@dataclass(frozen=True, slots=True)
class Relief:
    """Unevenness of one tile.

    roughness: 0 to 1
    roots: (N, 2) tree positions, m
    holes: (M, 3) potholes: x, y and radius, m
    """

    roughness: float
    seed: int
    roots: Floats
    holes: Floats

    def pavement_offset(self, xy: Floats) -> Floats:
        """Return the (N,) height offsets in metres at (N, 2) pavement points."""
        waves = WAVE_HEIGHT_M * _noise(xy, WAVE_M, self.seed, smooth=True)
        slabs = _noise(xy, SLAB_M, self.seed + 1, smooth=False, spikes=True)
        gaps = np.hypot(*(xy[:, None] - self.roots[None]).transpose(2, 0, 1))
        roots = ROOT_HEIGHT_M * np.exp(-0.5 * (gaps / ROOT_M) ** 2).max(axis=1, initial=0.0)
        return np.asarray(self.roughness * (waves + slabs + roots))

    def on_road(self, xy: Floats) -> Floats:
        """Return the (N,) height offsets in metres at (N, 2) road points; negative in potholes."""
        gaps = np.hypot(*(xy[:, None] - self.holes[None, :, :2]).transpose(2, 0, 1))
        share = np.clip(1.0 - gaps / self.holes[None, :, 2], 0.0, 1.0).max(axis=1, initial=0.0)
        return np.asarray(-self.roughness * POTHOLE_DEPTH_M * share)

    def lines(
        self, pavement: shapely.Geometry, bounds: tuple[float, float, float, float]
    ) -> NDArray[np.object_]:
        """Return lines that divide the ground at slab joints and pothole rims.

        pavement: area of the slabs
        bounds: x0, y0, x1, y1 of the tile, m
        """
        x0, y0, x1, y1 = bounds
        joints_x, joints_y = (
            np.arange(np.floor(a / SLAB_M), np.ceil(b / SLAB_M) + 1) * SLAB_M
            for a, b in ((x0, x1), (y0, y1))
        )
        joints = [((x, y0), (x, y1)) for x in joints_x.tolist()] + [
            ((x0, y), (x1, y)) for y in joints_y.tolist()
        ]
        angle = 2.0 * np.pi * np.arange(_SIDES + 1) / _SIDES
        circle = np.column_stack([np.cos(angle), np.sin(angle)])
        rims = [(x, y) + r * circle for x, y, r in self.holes]
        spokes = [(rim[k], rim[k + _SIDES // 2]) for rim in rims for k in (0, _SIDES // 4)]
        clipped = np.asarray(
            shapely.intersection(shapely.linestrings(np.array(joints)), pavement), dtype=object
        )
        outlines = np.array(
            [shapely.LineString(points) for points in [*rims, *spokes]], dtype=object
        )
        return np.concatenate([clipped, outlines])


def potholes(
    road: shapely.Geometry, bounds: tuple[float, float, float, float], roughness: float, seed: int
) -> Floats:
    """Return (M, 3) centres and radii of the potholes within bounds.

    A pothole is the same for every tile that contains part of it.
    """
    x0, y0, x1, y1 = bounds
    i, j = (
        np.arange(np.floor(a / POTHOLE_CELL_M), np.floor(b / POTHOLE_CELL_M) + 1)
        for a, b in ((x0, x1), (y0, y1))
    )
    cell = np.stack(np.meshgrid(i, j), axis=-1).reshape(-1, 2)
    chance, u, v, w = (_hash_noise(cell, seed + 2 + k) for k in range(4))
    x, y = ((cell + np.column_stack([u, v])) * POTHOLE_CELL_M).T
    low, high = POTHOLE_RADIUS_M
    holes = np.column_stack([x, y, low + (high - low) * w])[chance < POTHOLE_SHARE * roughness]
    if not len(holes) or shapely.is_empty(road):
        return np.zeros((0, 3))
    inside = shapely.contains_xy(road, holes[:, 0], holes[:, 1])
    edge = shapely.distance(shapely.points(holes[:, :2]), shapely.boundary(road))
    return np.asarray(holes[inside & (edge > holes[:, 2] + 0.1)])


def _noise(xy: Floats, cell_m: float, seed: int, smooth: bool, spikes: bool = False) -> Floats:
    """Interpolate lattice values at (N, 2) points.

    smooth: use smooth instead of linear interpolation
    spikes: return slab heights in metres instead of values in [-1, 1]
    """
    at = xy / cell_m
    base = np.floor(at)
    share = at - base
    if smooth:
        share = share * share * (3.0 - 2.0 * share)
    value = np.zeros(len(xy))
    for dx in (0, 1):
        for dy in (0, 1):
            weight = np.abs(1 - dx - share[:, 0]) * np.abs(1 - dy - share[:, 1])
            node = _hash_noise(base + np.array([dx, dy]), seed)
            height = 2.0 * node - 1.0
            if spikes:
                height = SLAB_HEIGHT_M * height + RAISED_M * (node > 1.0 - RAISED_SHARE)
            value += weight * height
    return value


def _hash_noise(cell: Floats, seed: int) -> Floats:
    """Return a pseudo-random number in [0, 1) for each of (N, 2) integer cells."""
    i, j = cell.astype(np.int64).astype(np.uint64).T
    mixed = i * np.uint64(0x9E3779B97F4A7C15) ^ j * np.uint64(0xC2B2AE3D27D4EB4F)
    mixed ^= np.uint64((seed * 0x165667B19E3779F9) % 2**64)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        mixed = (mixed ^ (mixed >> np.uint64(shift))) * np.uint64(factor)
    mixed ^= mixed >> np.uint64(31)
    return np.asarray((mixed >> np.uint64(11)).astype(float) / 2.0**53)
