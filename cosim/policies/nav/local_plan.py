"""Local plan: the best lateral offsets from the route, past everything in the costmap.

Stations along the route and lateral offsets at each are a lattice. Dynamic programming finds the
cheapest way through it: near the route, with few changes, away from obstacles.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from cosim.core.geometry import Floats
from cosim.policies.nav.costmap import Costmap
from cosim.policies.nav.route_path import STEP_M

_OFFSET_M: Final = 0.1
"""Distance of neighbouring offsets in metres."""
WIDEST_M: Final = 1.6
"""Largest offset from the route in metres."""
_MOST_CHANGE: Final = 2
"""Largest change between two stations, in offsets: 0.8 m a metre."""
_OFFSET_COST: Final = 0.25
"""Cost of an offset of 1 m at a station."""
_CHANGE_COST: Final = 0.5
"""Cost of a change by one offset, squared."""
_NEAR_COST: Final = 4.0
"""Cost of an obstacle in contact with the robot; it falls to 0 at COST_M from its outline."""
COST_M: Final = 0.5
"""Distance from the robot's side beyond which obstacles cost nothing, in metres."""
_BLOCKED: Final = 1e6


class LocalPlan(NamedTuple):
    """Way to follow.

    points: (N, 2) metres in the robot's frame, from the robot on.
    free_m: length of the way until it is blocked; the length of the way if it is not.
    """

    points: Floats
    free_m: float
    blocked: bool


def local_plan(path: Floats, costmap: Costmap, half_width_m: float, margin_m: float) -> LocalPlan:
    """Return the cheapest way along a path.

    path: (N, 2) metres in the robot's frame, at distances of STEP_M.
    half_width_m: half of the robot's width.
    margin_m: least distance from the robot's side to an obstacle.
    """
    tangents = np.gradient(path, axis=0) if len(path) > 1 else np.array([(1.0, 0.0)])
    tangents /= np.maximum(np.hypot(*tangents.T), 1e-9)[:, None]
    normals = np.column_stack([-tangents[:, 1], tangents[:, 0]])
    count = round(WIDEST_M / _OFFSET_M)
    offsets = _OFFSET_M * np.arange(-count, count + 1)
    nodes = path[:, None] + offsets[None, :, None] * normals[:, None]
    gap_m = costmap.distances(nodes) - half_width_m
    near = np.clip(1.0 - gap_m / COST_M, 0.0, 1.0)
    cost = _OFFSET_COST * np.abs(offsets) + _NEAR_COST * near * near
    cost = np.where(gap_m < margin_m, _BLOCKED, cost)
    start = int(np.clip(np.rint(float(-path[0] @ normals[0]) / _OFFSET_M), -count, count)) + count
    chosen = _cheapest(cost, start)
    free = cost[np.arange(len(path)), chosen] < _BLOCKED
    free[:1] = True
    stations = len(path) if free.all() else int(np.argmin(free))
    points = nodes[np.arange(len(path)), chosen]
    points[0] = 0.0
    lengths = np.hypot(*np.diff(points, axis=0).T)
    free_m = float(lengths[: max(stations - 1, 0)].sum())
    return LocalPlan(points, free_m, bool(stations < len(path)))


def _cheapest(cost: Floats, start: int) -> np.ndarray:
    """Return the offsets of the cheapest way through a lattice (stations, offsets), as indices."""
    stations, count = cost.shape
    changes = np.arange(-_MOST_CHANGE, _MOST_CHANGE + 1)
    change_cost = _CHANGE_COST * changes**2
    best = np.full(count, np.inf)
    best[start] = 0.0
    came = np.zeros((stations, count), dtype=int)
    for k in range(1, stations):
        padded = np.pad(best, _MOST_CHANGE, constant_values=np.inf)
        from_each = np.lib.stride_tricks.sliding_window_view(padded, 2 * _MOST_CHANGE + 1)
        total = from_each + change_cost
        came[k] = np.argmin(total, axis=1)
        best = total[np.arange(count), came[k]] + cost[k]
    chosen = np.zeros(stations, dtype=int)
    chosen[-1] = int(np.argmin(best))
    for k in range(stations - 1, 0, -1):
        chosen[k - 1] = chosen[k] + came[k, chosen[k]] - _MOST_CHANGE
    return chosen
