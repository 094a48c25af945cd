"""Terrain: how high the land lies under a place, curbs, ramps and unevenness apart; and where those
heights come from.

A place without terrain (None in its StreetMap) is flat at height 0: nothing is added to anything
there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cosim.core.geometry import Floats

WALK_GRADE_MAX = 0.12
"""Steepest grade left in streets and walkways, steps apart. Local streets are built with up to 8 %
in towns and 15 % in hills (AASHTO, A Policy on Geometric Design of Highways and Streets); beyond
that maps hold mostly noise."""

ROBOT_GRADE_MAX = 0.20
"""No route leads over strips where the land, curb ramps apart, is anywhere steeper than this, along
or across."""


FALSE_GRADE = 0.25
"""Hardly a street on Earth is steeper: a map that says so is wrong there."""

CLAMPED_M = 0.25
"""A street that is moved by more than this counts as clamped."""


@dataclass(frozen=True, slots=True)
class Terrain:
    """Heights of the land on a square lattice, and flat triangles between.

    heights: (R, C) metres above `datum_m`, rows northwards from y0_m, columns eastwards from x0_m,
    R and C at least 2. Every cell is divided by the diagonal from its south-west to its north-east
    corner. Beyond the lattice the heights at its edge go on. datum_m: height of 0 above the map's
    own zero.
    """

    x0_m: float
    y0_m: float
    step_m: float
    heights: NDArray[np.float32]
    datum_m: float = 0.0

    def height(self, xy: ArrayLike) -> Floats:
        """Height of the land at (N, 2) points, (N,) metres: each value depends on its own point
        alone, to the bit."""
        i, j, a, b = self._cells(xy)
        h = self.heights
        south_west = h[j, i].astype(float)
        north_east = h[j + 1, i + 1].astype(float)
        corner = np.where(a >= b, h[j, i + 1], h[j + 1, i]).astype(float)
        more, less = np.maximum(a, b), np.minimum(a, b)
        return np.asarray(south_west + more * (corner - south_west) + less * (north_east - corner))

    def gradient(self, xy: ArrayLike) -> Floats:
        """(N, 2) rise to the east and to the north, metres for each metre; 0 across the edge beyond
        the lattice."""
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
        """(L, 2, 2) sides of the triangles within x0, y0, x1, y1 along which the land bends."""
        x0, y0, x1, y1 = bounds
        i0, j0 = (
            int(np.floor((c - o) / self.step_m)) for c, o in ((x0, self.x0_m), (y0, self.y0_m))
        )
        i1, j1 = (
            int(np.ceil((c - o) / self.step_m)) for c, o in ((x1, self.x0_m), (y1, self.y0_m))
        )
        # One ring of cells more than the bounds hold, so that the bend at their border can be seen.
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
        """Column and row of the cell of each point, and its place in there, 0 to 1 eastwards and
        northwards."""
        at = np.asarray(xy, dtype=float).reshape(-1, 2)
        rows, columns = self.heights.shape
        u = np.clip((at[:, 0] - self.x0_m) / self.step_m, 0.0, columns - 1.0)
        v = np.clip((at[:, 1] - self.y0_m) / self.step_m, 0.0, rows - 1.0)
        i, j = np.minimum(u.astype(np.intp), columns - 2), np.minimum(v.astype(np.intp), rows - 2)
        return i, j, u - i, v - j


@dataclass(frozen=True, slots=True)
class Elevation:
    """What became of the elevations in a map. dropped: why the place is flat all the same, "" when
    they are kept.

    low_m, high_m: of the points on streets, as the map has them, the missing ones apart. points: of
    all shapes; missing: those without an elevation or with a 0 or a spike that cannot be;
    false_share: part of the streets' length that is steeper than any street; clamped: points moved
    by more than CLAMPED_M to keep WALK_GRADE_MAX, by at most moved_m. steep: strips that no robot
    is sent over; closed: ends of others, strip and 0 or 1, that none passes.
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
