"""The line that the oracle follows: the reference route, led round what stands on it.

Searched once on the lattice of `clearance`, from the goal back to everywhere, and then drawn taut
like a band that keeps off the edges.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import shapely
from shapely.geometry import LineString

from cosim.core.geometry import Floats, Polyline
from cosim.core.state import PERSON_RADIUS_M
from cosim.policies.privileged.distance_field import LATTICE_M, Clearance
from cosim.policies.privileged.standing_groups import distances

_WANTED_M: Final = 0.5
"""Room to either side that is worth a way round."""
_TIGHT_COST: Final = 6.0
"""How many times dearer a metre without any room is."""
_ASIDE_COST: Final = 0.15
"""What a metre costs more for each metre that it lies beside the route."""
_LEAST_M: Final = 0.03
_PERSON_M: Final = PERSON_RADIUS_M + 0.45
_PERSON_COST: Final = 60.0
"""How near to who stands, and how many times dearer, a metre is then."""
_STEP_M: Final = 0.4
_ROUNDS: Final = 60
_PUSH: Final = 0.3
_NEIGHBOURS: Final = ((0, 1), (1, 0), (1, 1), (1, -1), (1, 2), (2, 1), (1, -2), (2, -1))


class Guide:
    """Ways to the end of a route from wherever the robot is."""

    def __init__(self, clearance: Clearance, route: Polyline) -> None:
        self.clearance = clearance
        self._route = route
        depth = clearance.depth[clearance.rows(clearance.cells)]
        cells = clearance.cells[depth > _LEAST_M]
        depth = depth[depth > _LEAST_M]
        self._points = cells * LATTICE_M
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
        """Find the ways anew, round people who stand along lines (M, 2, 2) m."""
        from scipy.sparse import csr_array  # 0.2 s, for those who are guided
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

    def from_here(self, xy: Floats) -> Polyline:
        """The way from (2,) metres to the end of the route; the route itself where none is
        known."""
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
