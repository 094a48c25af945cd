"""Distance field near a route: signed distance to the edge of the free area on a grid."""

from __future__ import annotations

from typing import Final

import numpy as np
from shapely.geometry import LineString, MultiPolygon, Polygon

from cosim.core.geometry import Floats, Polyline
from cosim.place import overlay
from cosim.place.street_map import WalkableArea

LATTICE_M: Final = 0.2
"""Grid spacing in metres."""
_BESIDE_M: Final = 4.5
"""Metres from the route covered by the field; farther points count as not free."""
_FAR_OUT_M: Final = -1.0
"""Lower bound of the signed distance in metres."""


class Clearance:
    """Signed distance in metres to the edge of the free area, positive inside, near a route.

    Exact on the grid, bilinear between.

    free: Area for the robot's base centre, `Privileged.free`.
    """

    def __init__(self, free: Polygon | MultiPolygon, route: Polyline) -> None:
        self.cells = _beside(route)
        self.low = self.cells.min(axis=0) - 1
        shape = self.cells.max(axis=0) - self.low + 2
        self.columns = int(shape[1])
        self._most = shape - 2
        near = overlay.intersection(free, LineString(route.points).buffer(_BESIDE_M + 2.0))
        depth = WalkableArea(near).signed_distance(self.cells * LATTICE_M)
        self.depth = np.full(int(shape.prod()), _FAR_OUT_M)
        self.depth[self.rows(self.cells)] = np.maximum(depth, _FAR_OUT_M)

    def rows(self, cells: np.ndarray) -> np.ndarray:
        """Return (N,) indices into `depth` of grid points (N, 2)."""
        at: np.ndarray = (cells[:, 0] - self.low[0]) * self.columns + cells[:, 1] - self.low[1]
        return at

    def at(self, xy: Floats) -> Floats:
        """Return (...) distances in metres at points (..., 2)."""
        scaled = xy / LATTICE_M - self.low
        u, v = (
            np.clip(scaled[..., 0], 0.0, self._most[0]),
            np.clip(scaled[..., 1], 0.0, self._most[1]),
        )
        i, j = u.astype(np.intp), v.astype(np.intp)
        u, v = u - i, v - j
        first = i * self.columns + j
        here, there = (
            self.depth.take(row) * (1.0 - v) + self.depth.take(row + 1) * v
            for row in (first, first + self.columns)
        )
        depth: Floats = here + u * (there - here)
        return depth

    def uphill(self, xy: Floats) -> Floats:
        """Return (N, 2) gradients of the distance at points (N, 2), of length 1 at most."""
        half = 0.5 * LATTICE_M
        ways = [
            (self.at(xy + step) - self.at(xy - step)) / LATTICE_M
            for step in (np.array([half, 0.0]), np.array([0.0, half]))
        ]
        return np.stack(ways, axis=-1)


def _beside(route: Polyline) -> np.ndarray:
    """Return (N, 2) integer grid points near a route."""
    count = int(_BESIDE_M / LATTICE_M)
    steps = np.arange(-count, count + 1)
    disk = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    disk = disk[(disk**2).sum(axis=1) <= count * count]
    along = np.unique(np.round(route.resampled(1.0).points / LATTICE_M).astype(int), axis=0)
    low = along.min(axis=0) - count
    near = np.zeros(along.max(axis=0) + count - low + 1, dtype=bool)
    for offset in disk - low:
        near[tuple((along + offset).T)] = True
    cells: np.ndarray = np.argwhere(near) + low
    return cells
