"""Local plan: the best lateral offsets from the route, past everything in the costmap.

Stations along the route and lateral offsets at each are a lattice. Dynamic programming finds the
cheapest way through it: near the route, with few changes, away from obstacles.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from cosim.core.geometry import Floats
from cosim.policies.nav.costmap import Costmap
from cosim.policies.nav.route_path import AHEAD_M, STEP_M
from cosim.policies.nav.tracking import NO_MOVERS, Movers

_OFFSET_M: Final = 0.1
"""Distance of neighbouring offsets in metres."""
WIDEST_M: Final = 1.6
"""Largest offset from the route in metres."""
_MAX_CHANGE: Final = 3
"""Largest change between two stations, in offsets: 1.2 m a metre."""
_OFFSET_COST: Final = 0.25
"""Cost of an offset of 1 m at a station."""
_FAR_COST: Final = 0.4
"""Additional cost of an offset of 1 m, with its square: the sidewalk ends somewhere."""
_OTHER_SIDE: Final = 1.6
"""Factor of this cost on the side that the last plan did not choose."""
_CHANGE_COST: Final = 0.12
"""Cost of a change by one offset, squared."""
_END_COST: Final = 8.0
"""Cost of an offset of 1 m at the end of the route."""
_SHORT_M: Final = 1.0
"""Length of a path in metres below which its end is approached directly."""
_NEAR_COST: Final = 2.5
"""Cost of an obstacle in contact with the robot; it falls to 0 at COST_M from its outline."""
COST_M: Final = 0.4
"""Distance from the robot's side beyond which obstacles cost nothing, in metres."""
_FORESEEN_S: Final = 3.0
"""Time in seconds for which moving bodies are predicted."""
_MOVER_MARGIN_M: Final = 0.15
"""Distance in metres to moving bodies in addition to that of others."""
_SLOWEST_MPS: Final = 0.7
"""Lowest speed in m/s of the robot for these predictions."""
NEARER_M: Final = 0.04
"""Distance in metres by which the costmap's cells may make an obstacle seem nearer."""
_ASIDE_M: Final = 0.3
"""Offset in metres from which a plan has a side."""
_BLOCKED: Final = 1e6


class LocalPlan(NamedTuple):
    """Way to follow.

    points: (N, 2) metres in the robot's frame, from the robot on.
    side: 1 if the way passes something on the left of the route, -1 on the right, else 0.
    free_m: length of the way until it is blocked; the length of the way if it is not.
    """

    points: Floats
    free_m: float
    blocked: bool
    side: int = 0


def local_plan(
    path: Floats,
    costmap: Costmap,
    half_width_m: float,
    margin_m: float,
    side: int = 0,
    movers: Movers = NO_MOVERS,
    v_mps: float = 1.0,
) -> LocalPlan:
    """Return the cheapest way along a path.

    path: (N, 2) metres in the robot's frame, at distances of STEP_M.
    half_width_m: half of the robot's width.
    margin_m: least distance from the robot's side to an obstacle; where the robot is nearer, it may
        stay as near as it is.
    side: side of the last plan, which is preferred if both are about equal.
    movers: moving bodies; each is where it will be when the robot arrives.
    v_mps: speed of the robot.
    """
    if len(path) <= _SHORT_M / STEP_M:
        return LocalPlan(np.array([(0.0, 0.0), path[-1]]), float(np.hypot(*path[-1])), False)
    tangents = np.gradient(path, axis=0)
    tangents /= np.maximum(np.hypot(*tangents.T), 1e-9)[:, None]
    normals = np.column_stack([-tangents[:, 1], tangents[:, 0]])
    count = round(WIDEST_M / _OFFSET_M)
    offsets = _OFFSET_M * np.arange(-count, count + 1)
    nodes = path[:, None] + offsets[None, :, None] * normals[:, None]
    gap_m = costmap.distances(nodes) - half_width_m
    own_m = float(costmap.distances(np.zeros(2))) - half_width_m
    margin_m = min(margin_m, max(own_m - NEARER_M, min(own_m, 0.0)))
    times_s = STEP_M * np.arange(len(path)) / max(v_mps, _SLOWEST_MPS)
    moving_m = movers.gaps_m(nodes, np.minimum(times_s, _FORESEEN_S)) - half_width_m
    moving_m[times_s > _FORESEEN_S] = np.inf
    gap_m = np.minimum(gap_m, np.maximum(moving_m - _MOVER_MARGIN_M, margin_m))
    near = np.clip(1.0 - gap_m / COST_M, 0.0, 1.0)
    aside = np.where(side * offsets < 0.0, _OTHER_SIDE, 1.0) * np.abs(offsets)
    cost = _OFFSET_COST * aside + _FAR_COST * offsets * offsets + _NEAR_COST * near * near
    if len(path) < AHEAD_M / STEP_M:
        cost[-1] += _END_COST * np.abs(offsets)
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
    widest = offsets[chosen[np.argmax(np.abs(offsets[chosen]))]]
    turned = int(np.sign(widest)) if abs(widest) >= _ASIDE_M else 0
    return LocalPlan(points, free_m, bool(stations < len(path)), turned)


def _cheapest(cost: Floats, start: int) -> np.ndarray:
    """Return the offsets of the cheapest way through a lattice (stations, offsets), as indices."""
    stations, count = cost.shape
    changes = np.arange(-_MAX_CHANGE, _MAX_CHANGE + 1)
    change_cost = _CHANGE_COST * changes**2
    padded = np.full(count + 2 * _MAX_CHANGE, np.inf)
    best = padded[_MAX_CHANGE : _MAX_CHANGE + count]
    best[start] = 0.0
    from_each = np.lib.stride_tricks.sliding_window_view(padded, len(changes))
    total = np.empty(from_each.shape)
    came = np.zeros((stations, count), dtype=int)
    rows = np.arange(count)
    for k in range(1, stations):
        np.add(from_each, change_cost, out=total)
        total.argmin(axis=1, out=came[k])
        best[:] = total[rows, came[k]] + cost[k]
    chosen = np.zeros(stations, dtype=int)
    chosen[-1] = int(np.argmin(best))
    for k in range(stations - 1, 0, -1):
        chosen[k - 1] = chosen[k] + came[k, chosen[k]] - _MAX_CHANGE
    return chosen
