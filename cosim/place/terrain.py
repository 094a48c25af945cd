"""Terrain: heights of the land under a place, and the processing of its elevations.

Curbs, ramps and roughness are not part of it. A place without terrain is flat at height 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cosim.core.geometry import Floats

WALK_GRADE_MAX = 0.12
"""Maximum grade of streets and walkways, except steps.

Local streets have up to 8 % in towns and 15 % in hills (AASHTO, A Policy on Geometric Design of
Highways and Streets). Steeper values in maps are mostly noise.
"""

ROBOT_GRADE_MAX = 0.20
"""Maximum grade of the land on a route, along or across a strip; curb ramps are excluded."""


IMPLAUSIBLE_GRADE = 0.25
"""Grade above which a map's elevation counts as wrong; hardly any street is steeper."""

CLAMP_THRESHOLD_M = 0.25
"""Correction of a street's height in metres above which the point counts as clamped."""


@dataclass(frozen=True, slots=True)
class Terrain:
    """Heights on a square lattice, interpolated linearly on triangles.

    heights: (R, C) metres above `datum_m`, rows northwards from y0_m, columns eastwards from x0_m.
        R and C are at least 2.
    datum_m: height of 0 above the map's own zero.

    The diagonal of each cell runs from south-west to north-east. Beyond the lattice, the heights of
    its edge continue.
    """

    x0_m: float
    y0_m: float
    step_m: float
    heights: NDArray[np.float32]
    datum_m: float = 0.0

    def height(self, xy: ArrayLike) -> Floats:
        """Return the height at (N, 2) points, (N,) metres. Each value depends only on its own
        point."""
        i, j, a, b = self._cells(xy)
        h = self.heights
        south_west = h[j, i].astype(float)
        north_east = h[j + 1, i + 1].astype(float)
        corner = np.where(a >= b, h[j, i + 1], h[j + 1, i]).astype(float)
        more, less = np.maximum(a, b), np.minimum(a, b)
        return np.asarray(south_west + more * (corner - south_west) + less * (north_east - corner))

    def gradient(self, xy: ArrayLike) -> Floats:
        """Return the slope to the east and to the north at (N, 2) points, (N, 2).

        Beyond the lattice the slope across its edge is 0.
        """
        i, j, a, b = self._cells(xy)
        h = self.heights
        below = a >= b
        south_west = h[j, i].astype(float)
        north_east = h[j + 1, i + 1].astype(float)
        corner = np.where(below, h[j, i + 1], h[j + 1, i]).astype(float)
        east = np.where(below, corner - south_west, north_east - corner)
        north = np.where(below, north_east - corner, corner - south_west)
        rise = np.column_stack([east, north]) / self.step_m
        at = np.asarray(xy, dtype=float).reshape(-1, 2)
        last = np.array([self.x0_m, self.y0_m]) + self.step_m * (np.array(h.shape[::-1]) - 1)
        return np.where((at < (self.x0_m, self.y0_m)) | (at > last), 0.0, rise)

    def creases(self, bounds: tuple[float, float, float, float]) -> Floats:
        """Return the triangle sides within x0, y0, x1, y1 at which the land bends, (L, 2, 2)
        metres."""
        x0, y0, x1, y1 = bounds
        i0, j0 = (
            int(np.floor((c - o) / self.step_m)) for c, o in ((x0, self.x0_m), (y0, self.y0_m))
        )
        i1, j1 = (
            int(np.ceil((c - o) / self.step_m)) for c, o in ((x1, self.x0_m), (y1, self.y0_m))
        )
        # One more ring of cells, to find the bends at the border.
        columns = np.clip(np.arange(i0 - 1, i1 + 2), 0, self.heights.shape[1] - 1)
        rows = np.clip(np.arange(j0 - 1, j1 + 2), 0, self.heights.shape[0] - 1)
        h = self.heights[np.ix_(rows, columns)].astype(float)
        second = {
            (1, 0): h[1:-1, :-1] + h[1:-1, 1:] - h[:-2, :-1] - h[2:, 1:],
            (0, 1): h[:-1, 1:-1] + h[1:, 1:-1] - h[:-1, :-2] - h[1:, 2:],
            (1, 1): h[:-1, :-1] + h[1:, 1:] - h[:-1, 1:] - h[1:, :-1],
        }
        found = []
        for (east, north), bend in second.items():
            j, i = np.nonzero(np.abs(bend) > 1e-6)
            start = np.column_stack([i + i0 - 1 + (east == 0), j + j0 - 1 + (north == 0)]).astype(
                float
            )
            found.append(np.stack([start, start + np.array([east, north])], axis=1))
        ends: Floats = np.concatenate(found) * self.step_m + (self.x0_m, self.y0_m)
        return ends

    def _cells(self, xy: ArrayLike) -> tuple[NDArray[np.intp], NDArray[np.intp], Floats, Floats]:
        """Return column and row of each point's cell, and its position there, 0 to 1 east and
        north."""
        at = np.asarray(xy, dtype=float).reshape(-1, 2)
        rows, columns = self.heights.shape
        u = np.clip((at[:, 0] - self.x0_m) / self.step_m, 0.0, columns - 1.0)
        v = np.clip((at[:, 1] - self.y0_m) / self.step_m, 0.0, rows - 1.0)
        i, j = np.minimum(u.astype(np.intp), columns - 2), np.minimum(v.astype(np.intp), rows - 2)
        return i, j, u - i, v - j


@dataclass(frozen=True, slots=True)
class Elevation:
    """Statistics of the processing of a map's elevations.

    low_m, high_m: range of the valid points on streets.
    points: number of points of all shapes.
    missing: number of points without an elevation, or with an impossible 0 or spike.
    false_share: share of the streets' length that is steeper than any real street.
    clamped: number of points moved by more than CLAMP_THRESHOLD_M to satisfy WALK_GRADE_MAX.
    moved_m: largest correction.
    steep: strips that robots must not use.
    closed: ends of other strips that robots must not pass, as strip and 0 or 1.
    dropped: why the place is flat in spite of elevations; "" if they are used.
    """

    low_m: float
    high_m: float
    points: int
    missing: int
    false_share: float
    clamped: int = 0
    moved_m: float = 0.0
    steep: tuple[str, ...] = ()
    closed: tuple[tuple[str, int], ...] = ()
    dropped: str = ""
