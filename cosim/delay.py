"""Delay: what the robot costs the people and vehicles around it, against the same street without it.

Both streets begin alike. As far as somebody is in both (the same id, entered at the same tick and place), the ways
covered in the shared time are compared: delay = (way without - way with the robot) / pace without it, in seconds; it
is negative for who got on faster. Somebody who never moves without the robot has no pace and is left out. A small cause
spreads: far from the robot the two streets differ by chance, so the sum over those that came near it is told apart.
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from cosim.geometry import Floats
from cosim.state import People, Vehicles

NEAR_M: Final = 10.0
MOVING_MPS: Final = 0.1
SAME_PLACE_M: Final = 0.5


class Delay(NamedTuple):
    """delay_s: summed over everybody compared; near_s: over those that came within NEAR_M of the robot.

    compared, near: how many. unmatched: how many of the street with the robot are not the same in both.
    """

    delay_s: float
    near_s: float
    compared: int
    near: int
    unmatched: int


class Tracks:
    """Where everybody of one kind was, tick by tick, from when it was first seen until it was first missed.

    ids that start with another letter than `kind` are left out.
    """

    def __init__(self, kind: str) -> None:
        self._kind = kind
        self._tick = 0
        self._xy: dict[str, array[float]] = {}
        self.began: dict[str, int] = {}

    def add(self, bodies: People | Vehicles) -> None:
        """The next tick."""
        for name, (x_m, y_m) in zip(bodies.ids, bodies.xy.tolist(), strict=True):
            if not name.startswith(self._kind):
                continue
            began = self.began.setdefault(name, self._tick)
            way = self._xy.setdefault(name, array("d"))
            if len(way) == 2 * (self._tick - began):
                way.extend((x_m, y_m))
        self._tick += 1

    def way(self, name: str) -> Floats:
        """(N, 2) m: where somebody was; nowhere for one who never came."""
        return np.array(self._xy.get(name, ()), dtype=float).reshape(-1, 2)


def delay_of(robot: Sequence[tuple[float, float]], present: Tracks, absent: Tracks, tick_s: float) -> Delay:
    """The delay that a robot caused that was at (x, y) at each tick of `present`."""
    at = np.array(robot, dtype=float).reshape(-1, 2)
    delay_s = near_s = 0.0
    compared = near = unmatched = 0
    for name in sorted(present.began):
        mine, other = present.way(name), absent.way(name)
        first = present.began[name]
        same = first == absent.began.get(name) and np.hypot(*(mine[0] - other[0])) < SAME_PLACE_M
        if not same:
            unmatched += 1
            continue
        shared = min(len(mine), len(other))
        steps_mine, steps_other = _steps(mine[:shared]), _steps(other[:shared])
        moving = steps_other > MOVING_MPS * tick_s
        if not moving.any():
            continue
        late_s = float((steps_other.sum() - steps_mine.sum()) / steps_other[moving].mean()) * tick_s
        gap = mine[:shared] - at[first : first + shared]
        is_near = bool((np.hypot(gap[:, 0], gap[:, 1]) < NEAR_M).any())
        delay_s, compared = delay_s + late_s, compared + 1
        near_s, near = near_s + late_s * is_near, near + is_near
    return Delay(delay_s, near_s, compared, near, unmatched)


def _steps(way: Floats) -> Floats:
    """(N - 1,) metres between the points of a way (N, 2)."""
    return np.asarray(np.hypot(*np.diff(way, axis=0).T))
