"""The line that the oracle follows: the reference route, led round what stands on it.

Searched once on the lattice of `clearance`, from the goal back to everywhere, and then drawn taut like a band that
keeps off the edges.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import shapely
from shapely.geometry import LineString

from cosim.core.geometry import Floats, Polyline
from cosim.policies.clearance import LATTICE_M, Clearance

_WANTED_M: Final = 0.5
"""Room to either side that is worth a way round."""
_TIGHT_COST: Final = 6.0
"""How many times dearer a metre without any room is."""
_ASIDE_COST: Final = 0.15
"""What a metre costs more for each metre that it lies beside the route."""
_LEAST_M: Final = 0.03
_STEP_M: Final = 0.4
_ROUNDS: Final = 60
_PUSH: Final = 0.3
_NEIGHBOURS: Final = ((0, 1), (1, 0), (1, 1), (1, -1), (1, 2), (2, 1), (1, -2), (2, -1))


class Guide:
    """Ways to the end of a route from wherever the robot is."""

    def __init__(self, clearance: Clearance, route: Polyline) -> None:
        from scipy.sparse import csr_array  # 0.2 s, for those who are guided
        from scipy.sparse.csgraph import dijkstra

        self.clearance, self._route = clearance, route
        depth = clearance.depth[clearance.rows(clearance.cells)]
        self._cells = clearance.cells[depth > _LEAST_M]
        depth = depth[depth > _LEAST_M]
        cost = 1.0 + _TIGHT_COST * np.maximum(1.0 - depth / _WANTED_M, 0.0) ** 2
        cost += _ASIDE_COST * _aside(self._cells * LATTICE_M, route)
        numbers = np.full(len(clearance.depth) + 2 * clearance.columns + 3, -1)
        rows = clearance.rows(self._cells)
        numbers[rows] = np.arange(len(rows))
        first, second, lengths = [], [], []
        for i, j in _NEIGHBOURS:
            other = numbers[rows + i * clearance.columns + j]
            there = np.flatnonzero(other >= 0)
            first.append(there)
            second.append(other[there])
            lengths.append(0.5 * LATTICE_M * np.hypot(i, j) * (cost[there] + cost[other[there]]))
        graph = csr_array(
            (np.concatenate(lengths), (np.concatenate(first), np.concatenate(second))), shape=(len(rows), len(rows))
        )
        self._far = np.full(len(rows), np.inf)
        if len(rows):
            goal = self._nearest(route.points[-1], np.ones(len(rows), dtype=bool))
            self._far, self._next = dijkstra(  # type: ignore[call-overload]
                graph, directed=False, indices=goal, return_predecessors=True
            )

    def from_here(self, xy: Floats) -> Polyline:
        """The way from (2,) metres to the end of the route; the route itself where none is known."""
        known = np.isfinite(self._far)
        if not known.any():
            return self._route
        at, way = self._nearest(xy, known), []
        while at >= 0:
            way.append(at)
            at = int(self._next[at])
        line = np.vstack([xy, self._cells[way] * LATTICE_M, self._route.points[-1]])
        return self._taut(Polyline(line).resampled(_STEP_M).points)

    def _nearest(self, xy: Floats, among: np.ndarray) -> int:
        off = self._cells * LATTICE_M - xy
        return int(np.argmin(np.where(among, off[:, 0] ** 2 + off[:, 1] ** 2, np.inf)))

    def _taut(self, points: Floats) -> Polyline:
        """The line drawn taut, but pushed off what is nearer than _WANTED_M; its ends stay."""
        points = points.copy()
        for _ in range(_ROUNDS):
            inner = points[1:-1]
            lack = np.clip(_WANTED_M - self.clearance.at(inner), 0.0, _WANTED_M)
            middle = 0.5 * (points[:-2] + points[2:])
            inner += 0.5 * (middle - inner) + _PUSH * lack[:, None] * self.clearance.uphill(inner)
        return Polyline(points)


def _aside(points: Floats, route: Polyline) -> Floats:
    """(N,) metres from points (N, 2) to a route."""
    line = LineString(route.points)
    shapely.prepare(line)
    return np.asarray(shapely.distance(line, shapely.points(points)), dtype=float)
