"""Route planner of the oracle: shortest paths to the goal around standing obstacles.

Dijkstra's algorithm on the grid of the distance field, from the goal to all points. The path is
then smoothed like a rubber band that keeps off the edges.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import shapely
from shapely.geometry import LineString, MultiPolygon, Polygon

from cosim.core.geometry import Floats, Polyline
from cosim.core.state import PERSON_RADIUS_M
from cosim.place import overlay
from cosim.place.street_map import WalkableArea
from cosim.policies.privileged.standing_groups import distances

GRID_M: Final = 0.2
"""Grid spacing in metres."""
_BESIDE_M: Final = 4.5
"""Metres from the route covered by the field; farther points count as not free."""
_FAR_OUT_M: Final = -1.0
"""Lower bound of the signed distance in metres."""


class DistanceField:
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
        depth = WalkableArea(near).signed_distance(self.cells * GRID_M)
        self.depth = np.full(int(shape.prod()), _FAR_OUT_M)
        self.depth[self.rows(self.cells)] = np.maximum(depth, _FAR_OUT_M)

    def rows(self, cells: np.ndarray) -> np.ndarray:
        """Return (N,) indices into `depth` of grid points (N, 2)."""
        at: np.ndarray = (cells[:, 0] - self.low[0]) * self.columns + cells[:, 1] - self.low[1]
        return at

    def at(self, xy: Floats) -> Floats:
        """Return (...) distances in metres at points (..., 2)."""
        scaled = xy / GRID_M - self.low
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
        half = 0.5 * GRID_M
        ways = [
            (self.at(xy + step) - self.at(xy - step)) / GRID_M
            for step in (np.array([half, 0.0]), np.array([0.0, half]))
        ]
        return np.stack(ways, axis=-1)


def _beside(route: Polyline) -> np.ndarray:
    """Return (N, 2) integer grid points near a route."""
    count = int(_BESIDE_M / GRID_M)
    steps = np.arange(-count, count + 1)
    disk = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    disk = disk[(disk**2).sum(axis=1) <= count * count]
    along = np.unique(np.round(route.resampled(1.0).points / GRID_M).astype(int), axis=0)
    low = along.min(axis=0) - count
    near = np.zeros(along.max(axis=0) + count - low + 1, dtype=bool)
    for offset in disk - low:
        near[tuple((along + offset).T)] = True
    cells: np.ndarray = np.argwhere(near) + low
    return cells


_WANTED_M: Final = 0.5
"""Wanted distance in metres to the edge of the free area."""
_TIGHT_COST: Final = 6.0
"""Extra cost factor of a metre at the edge."""
_ASIDE_COST: Final = 0.15
"""Extra cost factor per metre of distance from the route."""
_MIN_M: Final = 0.03
"""Smallest distance in metres to the edge for a grid point to be used."""
_PERSON_M: Final = PERSON_RADIUS_M + 0.45
"""Metres around a standing person that are avoided."""
_PERSON_COST: Final = 60.0
"""Extra cost factor of a metre near a standing person."""
_STEP_M: Final = 0.4
"""Metres between points of a path."""
_ROUNDS: Final = 60
"""Number of smoothing iterations."""
_PUSH: Final = 0.3
"""Step of the push off the edges in one iteration."""
_NEIGHBOURS: Final = ((0, 1), (1, 0), (1, 1), (1, -1), (1, 2), (2, 1), (1, -2), (2, -1))
"""Offsets of half of the 16 grid neighbours; the graph is undirected."""


class RoutePlanner:
    """Paths to the end of a route from any position."""

    def __init__(self, clearance: DistanceField, route: Polyline) -> None:
        self.clearance = clearance
        self._route = route
        depth = clearance.depth[clearance.rows(clearance.cells)]
        cells = clearance.cells[depth > _MIN_M]
        depth = depth[depth > _MIN_M]
        self._points = cells * GRID_M
        self._cost = 1.0 + _TIGHT_COST * np.maximum(1.0 - depth / _WANTED_M, 0.0) ** 2
        self._cost += _ASIDE_COST * _aside(self._points, route)
        rows = clearance.rows(cells)
        numbers = np.full(len(clearance.depth) + 2 * clearance.columns + 3, -1)
        numbers[rows] = np.arange(len(rows))
        steps = [numbers[rows + i * clearance.columns + j] for i, j in _NEIGHBOURS]
        self._first = np.concatenate([np.flatnonzero(other >= 0) for other in steps])
        self._second = np.concatenate([other[other >= 0] for other in steps])
        self._lengths = np.hypot(*(self._points[self._first] - self._points[self._second]).T)
        self.search(np.zeros((0, 2, 2)))

    def search(self, ends: Floats) -> None:
        """Recompute the paths.

        ends: (M, 2, 2) lines in metres along which people stand.
        """
        from scipy.sparse import csr_array  # takes 0.2 s to import
        from scipy.sparse.csgraph import dijkstra

        count = len(self._points)
        cost = self._cost
        self._far = np.full(count, np.inf)
        if not count:
            return
        if len(ends):
            cost = cost + _PERSON_COST * (distances(self._points, ends).min(axis=1) < _PERSON_M)
        lengths = 0.5 * self._lengths * (cost[self._first] + cost[self._second])
        graph = csr_array((lengths, (self._first, self._second)), shape=(count, count))
        goal = self._nearest(self._route.points[-1], np.ones(count, dtype=bool))
        self._far, self._next = dijkstra(  # type: ignore[call-overload]
            graph, directed=False, indices=goal, return_predecessors=True
        )

    def path_from(self, xy: Floats) -> Polyline:
        """Return the path from (2,) metres to the route's end; the route itself if unreachable."""
        known = np.isfinite(self._far)
        if not known.any():
            return self._route
        at = self._nearest(xy, known)
        way = []
        while at >= 0:
            way.append(at)
            at = int(self._next[at])
        line = np.vstack([xy, self._points[way], self._route.points[-1]])
        return self._taut(Polyline(line).resampled(_STEP_M).points)

    def _nearest(self, xy: Floats, among: np.ndarray) -> int:
        off = self._points - xy
        return int(np.argmin(np.where(among, off[:, 0] ** 2 + off[:, 1] ** 2, np.inf)))

    def _taut(self, points: Floats) -> Polyline:
        """Return the smoothed line, pushed off edges nearer than _WANTED_M; its ends are fixed."""
        points = points.copy()
        for _ in range(_ROUNDS):
            inner = points[1:-1]
            lack = np.clip(_WANTED_M - self.clearance.at(inner), 0.0, _WANTED_M)
            middle = 0.5 * (points[:-2] + points[2:])
            inner += 0.5 * (middle - inner) + _PUSH * lack[:, None] * self.clearance.uphill(inner)
        return Polyline(points)


def _aside(points: Floats, route: Polyline) -> Floats:
    """Return (N,) distances in metres from points (N, 2) to a route."""
    line = LineString(route.points)
    shapely.prepare(line)
    return np.asarray(shapely.distance(line, shapely.points(points)), dtype=float)
