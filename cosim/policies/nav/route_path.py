"""The route ahead as a path in the robot's frame, from a goal."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from cosim.core.geometry import Floats
from cosim.spec.goal import PATCH_M, PATCH_PX, Goal, PointGoal, RoutePatch

STEP_M: Final = 0.25
"""Distance of a path's points in metres."""
AHEAD_M: Final = 7.0
"""Length of a path in metres."""
_MARCH_M: Final = 0.5
"""Step in metres along the pixels of a route patch."""
_AROUND_M: Final = 1.1
"""Distance in metres of the pixels that determine a point of the path."""
_TURN_M: Final = 1.8
"""Distance in metres within which a route that ends ahead may go on aside."""
_PASSED_M: Final = 0.75
"""Distance in metres from the path within which pixels are those of the path so far."""
_BESIDE_M: Final = 2.0
"""Distance in metres of the pixels that determine the direction of the route at the robot."""
_FEWEST_PX: Final = 3
"""Number of pixels around a point below which the route has ended."""
_SMOOTH: Final = 0.6
"""Weight of the last direction in the direction of the next step."""


def path_to(goal: Goal | None, direction_rad: float) -> Floats:
    """Return the route ahead, (N, 2) metres in the robot's frame, at distances of STEP_M.

    direction_rad: direction of the route at the robot, in its frame.
    Raises ValueError for a goal that is neither a route patch nor a point.
    """
    if isinstance(goal, RoutePatch):
        return _spaced(_along_patch(goal, direction_rad))
    if isinstance(goal, PointGoal):
        return _spaced(np.array([(0.0, 0.0), (goal.x_m, goal.y_m)]))
    raise ValueError("nav needs a goal of a route patch or a point: --goal route_patch")


def _along_patch(patch: RoutePatch, direction_rad: float) -> Floats:
    """Return (N, 2) points on the route of a patch, from the one next to the robot on."""
    rows, columns = np.nonzero(patch.pixels)
    middle = 0.5 * (PATCH_PX - 1)
    on_route = PATCH_M * np.column_stack([middle - rows, middle - columns])
    if not len(on_route):
        return np.zeros((1, 2))
    nearest = on_route[np.argmin((on_route * on_route).sum(axis=1))]
    beside = on_route[np.hypot(*(on_route - nearest).T) <= _BESIDE_M]
    if len(beside) < 2:
        return np.zeros((1, 2))
    at = beside.mean(axis=0)
    way = np.linalg.eigh(np.cov((beside - at).T))[1][:, -1]
    if way @ (math.cos(direction_rad), math.sin(direction_rad)) < 0.0:
        way = -way
    at = at - (at @ way) * way
    points = [at]
    for _ in range(round(AHEAD_M / _MARCH_M)):
        ahead = at + _MARCH_M * way
        offset = on_route - ahead
        near = offset[(offset * offset).sum(axis=1) <= _AROUND_M**2]
        if len(near) < _FEWEST_PX or (near @ way).max() < 0.0:
            turned = _turned(on_route, np.array(points))
            if turned is None:
                break
            way = turned
            continue
        left = np.array([-way[1], way[0]])
        after = ahead + float(near.mean(axis=0) @ left) * left
        way = _SMOOTH * way + (1.0 - _SMOOTH) * (after - at) / np.hypot(*(after - at))
        way /= np.hypot(*way)
        at = after
        points.append(at)
    return np.array(points)


def _turned(on_route: Floats, points: Floats) -> Floats | None:
    """Return the direction (2,) of a sharp turn at the last point; None at the end of the route.

    on_route: (M, 2) pixels on the route.
    points: (N, 2) points of the path so far.
    """
    to = on_route - points[-1]
    there = on_route[np.hypot(*to.T) <= _TURN_M]
    off = np.hypot(*np.moveaxis(there[:, None] - points, -1, 0)).min(axis=1, initial=np.inf)
    new = there[off > _PASSED_M]
    if len(new) < _FEWEST_PX:
        return None
    way: Floats = new.mean(axis=0) - points[-1]
    return way / max(float(np.hypot(*way)), 1e-9)


def _spaced(points: Floats) -> Floats:
    """Return a polyline (M, 2) at distances of STEP_M."""
    s_m = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    at_m = np.arange(0.0, min(s_m[-1], AHEAD_M) + 1e-9, STEP_M)
    return np.column_stack([np.interp(at_m, s_m, points[:, axis]) for axis in (0, 1)])
