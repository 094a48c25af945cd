"""Rolling local costmap from the scans of a lidar.

Its cells are fixed in the frame of the odometry and move with the robot by whole cells. A scan
marks the cells that it hits, and clears those that its rays pass.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from cosim.core.geometry import Floats, Pose
from cosim.policies.nav.tracking import NO_MOVERS, Movers
from cosim.spec.sensors import Scan

CELL_M: Final = 0.1
"""Size of a cell in metres."""
_HALF_CELLS: Final = 48
"""Number of cells from the middle to an edge."""
_CELLS: Final = 2 * _HALF_CELLS + 1
_CLEARED_M: Final = 0.2
"""Distance in metres before a hit up to which a ray clears cells."""
_OWN_M: Final = 0.1
"""Distance in metres of returns that are ignored."""
_MOVER_M: Final = 0.45
"""Distance in metres from a moving body within which returns are its own."""
FREE_M: Final = 2.0
"""Largest distance to an obstacle that a query returns, in metres."""


class Costmap:
    """Occupied cells around the robot, and distances to them."""

    def __init__(self) -> None:
        offsets = CELL_M * (np.arange(_CELLS) - _HALF_CELLS)
        self._x, self._y = np.meshgrid(offsets, offsets, indexing="ij")
        self._radius = np.hypot(self._x, self._y)
        self._bearing = np.arctan2(self._y, self._x)
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        self._occupied = np.zeros((_CELLS, _CELLS), dtype=bool)
        self._middle = (0, 0)
        self._pose = Pose(0.0, 0.0, 0.0)
        self._distance = np.full((_CELLS, _CELLS), FREE_M)

    def update(self, scan: Scan, pose: Pose, movers: Movers = NO_MOVERS) -> None:
        """Move to a pose in the frame of the odometry, and take a scan from there.

        movers: bodies whose returns are not marked.
        """
        self._move(pose)
        ranges = scan.ranges_m[0].astype(float)
        spec = scan.spec
        turn = self._bearing - pose.heading_rad + math.pi
        ray = np.rint(turn / (2.0 * math.pi) * spec.rays).astype(int) % spec.rays
        seen_m = np.minimum(ranges, spec.range_m)
        passed = self._radius < (seen_m - _CLEARED_M)[ray]
        self._occupied &= ~passed
        hit = np.isfinite(ranges) & (ranges > _OWN_M)
        for x_m, y_m in movers.at.tolist():
            ahead = seen_m * np.cos(spec.angles_rad) - x_m
            left = seen_m * np.sin(spec.angles_rad) - y_m
            hit &= ahead * ahead + left * left > _MOVER_M**2
        heading = spec.angles_rad[hit] + pose.heading_rad
        x = ranges[hit] * np.cos(heading) + pose.x_m
        y = ranges[hit] * np.sin(heading) + pose.y_m
        rows = np.floor(x / CELL_M).astype(int) - self._middle[0] + _HALF_CELLS
        columns = np.floor(y / CELL_M).astype(int) - self._middle[1] + _HALF_CELLS
        inside = (rows >= 0) & (rows < _CELLS) & (columns >= 0) & (columns < _CELLS)
        self._occupied[rows[inside], columns[inside]] = True
        if self._occupied.any():
            from scipy.ndimage import distance_transform_edt  # loads SciPy, only where needed

            self._distance = np.minimum(CELL_M * distance_transform_edt(~self._occupied), FREE_M)
        else:
            self._distance = np.full((_CELLS, _CELLS), FREE_M)

    def distances(self, points: Floats) -> Floats:
        """Return the distance of (..., 2) points to obstacles, metres, at most FREE_M.

        It is interpolated between the middles of cells.
        points: metres in the robot's frame. Those outside the map are free.
        """
        cos, sin = math.cos(self._pose.heading_rad), math.sin(self._pose.heading_rad)
        x = cos * points[..., 0] - sin * points[..., 1] + self._pose.x_m
        y = sin * points[..., 0] + cos * points[..., 1] + self._pose.y_m
        row = x / CELL_M - 0.5 - self._middle[0] + _HALF_CELLS
        column = y / CELL_M - 0.5 - self._middle[1] + _HALF_CELLS
        i, j = (np.clip(np.floor(at).astype(int), 0, _CELLS - 2) for at in (row, column))
        down, right = row - i, column - j
        field = self._distance
        above = (1.0 - right) * field[i, j] + right * field[i, j + 1]
        below = (1.0 - right) * field[i + 1, j] + right * field[i + 1, j + 1]
        inside = (down >= 0.0) & (down <= 1.0) & (right >= 0.0) & (right <= 1.0)
        found: Floats = np.where(inside, (1.0 - down) * above + down * below, FREE_M)
        return found

    def _move(self, pose: Pose) -> None:
        """Shift the cells by whole cells, so that the robot is in the middle one."""
        middle = (math.floor(pose.x_m / CELL_M), math.floor(pose.y_m / CELL_M))
        shift = middle[0] - self._middle[0], middle[1] - self._middle[1]
        if shift != (0, 0):
            moved = np.zeros_like(self._occupied)
            rows, columns = (_overlap(cells) for cells in shift)
            moved[rows[0], columns[0]] = self._occupied[rows[1], columns[1]]
            self._occupied = moved
        self._middle, self._pose = middle, pose


def _overlap(shift: int) -> tuple[slice, slice]:
    """Return where cells are after a shift, and where they were."""
    kept = max(_CELLS - abs(shift), 0)
    if shift >= 0:
        return slice(0, kept), slice(_CELLS - kept, _CELLS)
    return slice(_CELLS - kept, _CELLS), slice(0, kept)
