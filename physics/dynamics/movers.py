"""Interpolation of people and vehicles near the robot between two street snapshots."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Pose
from cosim.core.state import PERSON_RADIUS_M, People, Vehicles

_JUMP_M: Final = 5.0
"""Distance in metres above which a move within one tick counts as a teleport."""
_ROUNDING_M: Final = 0.01
"""Margin in metres for rounding in the vectorized distance test."""

TickPoses = list[tuple[float, float, float]]
"""x, y and heading after each substep of a tick."""

_PERSON_SIZE_M: Final = (2.0 * PERSON_RADIUS_M, 2.0 * PERSON_RADIUS_M)
"""Length and width of a person in metres."""


class Mover(NamedTuple):
    """A person or vehicle that moves uniformly during a tick.

    size_m: length and width
    start: pose at the start of the tick
    change: change of x, y and heading by the end of the tick
    """

    id: str
    size_m: tuple[float, float]
    start: Pose
    change: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def may_come_within(self, x_m: float, y_m: float, reach_m: float) -> bool:
        """Return whether any part may come within `reach_m` of a point during the tick."""
        way_m = math.hypot(*self.change[:2]) + 0.5 * math.hypot(*self.size_m)
        return math.hypot(self.start.x_m - x_m, self.start.y_m - y_m) <= way_m + reach_m

    def poses(self, substeps: int) -> TickPoses:
        """Return the pose after each substep."""
        (x, y, heading) = self.start
        (dx, dy, turn) = self.change
        shares = [(k + 1) / substeps for k in range(substeps)]
        return [(x + share * dx, y + share * dy, heading + share * turn) for share in shares]


def movers_near(
    before: People | Vehicles, after: People | Vehicles, x_m: float, y_m: float, reach_m: float
) -> list[Mover]:
    """Return the people or vehicles that are within `reach_m` of a point at either end of a tick.

    Those missing from `before` are placed at their new pose at once.
    """
    same = before.ids == after.ids
    search_m = reach_m + _ROUNDING_M + (0.0 if same else _JUMP_M)
    near = _within(after, x_m, y_m, search_m)
    if same:
        near |= _within(before, x_m, y_m, search_m)
    found = []
    for i in near.nonzero()[0].tolist():
        name = after.ids[i]
        start = None
        if same:
            start = _pose(before, i)
        elif name in before.ids:
            start = _pose(before, before.ids.index(name))
        size_m = _PERSON_SIZE_M
        if isinstance(after, Vehicles):
            size_m = float(after.size[i, 0]), float(after.size[i, 1])
        mover = _mover(name, size_m, start, _pose(after, i))
        from_x, from_y = mover.start.x_m - x_m, mover.start.y_m - y_m
        if (
            math.hypot(from_x, from_y) <= reach_m
            or math.hypot(from_x + mover.change[0], from_y + mover.change[1]) <= reach_m
        ):
            found.append(mover)
    return found


def _within(things: People | Vehicles, x_m: float, y_m: float, reach_m: float) -> NDArray[np.bool_]:
    """Return which people or vehicles are within `reach_m` of a point, (N,); rounding is not
    exact."""
    dx, dy = things.xy[:, 0] - x_m, things.xy[:, 1] - y_m
    near: NDArray[np.bool_] = dx * dx + dy * dy <= reach_m * reach_m
    return near


def _mover(name: str, size_m: tuple[float, float], start: Pose | None, end: Pose) -> Mover:
    if start is None or math.dist(start[:2], end[:2]) > _JUMP_M:
        return Mover(name, size_m, end)
    turn = math.pi - (math.pi - (end.heading_rad - start.heading_rad)) % (2.0 * math.pi)
    return Mover(name, size_m, start, (end.x_m - start.x_m, end.y_m - start.y_m, turn))


def _pose(things: People | Vehicles, row: int) -> Pose:
    x, y = things.xy[row].tolist()
    return Pose(x, y, float(things.heading[row]))
