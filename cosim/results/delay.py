"""Delay: what the robot costs the people and vehicles around it, against the same street without
it.

Both streets begin alike. As far as somebody is in both (the same id, entered at the same tick and
place), it is asked at the end of the shared time how long ago it would have been, without the
robot, where it is now; negative for who got on faster. Who steps aside and back has not got on.
Within SLACK_M is the same place, so that delays are told rather too small. Somebody who never moves
without the robot is left out. A small cause spreads: far from the robot the two streets differ by
chance, so the sum over those that came near it is told apart.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from cosim.core.geometry import Floats
from cosim.core.state import People, Vehicles

DELAY_NEAR_M: Final = 10.0
MOVING_MPS: Final = 0.1
_SAME_PLACE_M: Final = 0.5
_SLACK_M: Final = 0.5


class Delay(NamedTuple):
    """delay_s: summed over everybody compared; near_s: over those that came within NEAR_M of the
    robot.

    compared, near: how many. unmatched: how many of the street with the robot are not the same in
    both.
    """

    delay_s: float
    near_s: float
    compared: int
    near: int
    unmatched: int


class Tracks:
    """Where everybody was, tick by tick, from when it was first seen until it was first missed."""

    def __init__(self) -> None:
        self._tick = 0
        self._xy: dict[str, array[float]] = {}
        self.began: dict[str, int] = {}

    def add(self, bodies: People | Vehicles) -> None:
        """The next tick."""
        for name, (x_m, y_m) in zip(bodies.ids, bodies.xy.tolist(), strict=True):
            began = self.began.setdefault(name, self._tick)
            way = self._xy.setdefault(name, array("d"))
            if len(way) == 2 * (self._tick - began):
                way.extend((x_m, y_m))
        self._tick += 1

    def way(self, name: str) -> Floats:
        """(N, 2) m: where somebody was; nowhere for one who never came."""
        return np.array(self._xy.get(name, ()), dtype=float).reshape(-1, 2)


def delay_of(
    robot: Sequence[tuple[float, float]], present: Tracks, absent: Tracks, tick_s: float
) -> Delay:
    """The delay that a robot caused that was at (x, y) at each tick of `present`."""
    at = np.array(robot, dtype=float).reshape(-1, 2)
    delay_s = near_s = 0.0
    compared = near = unmatched = 0
    for name in sorted(present.began):
        mine, other = present.way(name), absent.way(name)
        first = present.began[name]
        same = first == absent.began.get(name) and np.hypot(*(mine[0] - other[0])) < _SAME_PLACE_M
        if not same:
            unmatched += 1
            continue
        shared = min(len(mine), len(other))
        mine, other = mine[:shared], other[:shared]
        if _steps(other).max(initial=0.0) <= MOVING_MPS * tick_s:
            continue
        late_s = _late(mine, other) * tick_s
        gap = mine - at[first : first + shared]
        is_near = bool((np.hypot(gap[:, 0], gap[:, 1]) < DELAY_NEAR_M).any())
        delay_s = delay_s + late_s
        compared = compared + 1
        near_s = near_s + late_s * is_near
        near = near + is_near
    return Delay(delay_s, near_s, compared, near, unmatched)


def _late(mine: Floats, other: Floats) -> int:
    """By how many ticks the end of one way (N, 2) comes later than on the other, which goes the
    same way."""
    behind, off_m = _since(mine[-1], other)
    ahead, off_other_m = _since(other[-1], mine)
    return behind if off_m <= off_other_m else -ahead


def _since(point: Floats, way: Floats) -> tuple[int, float]:
    """How many ticks before the end of a way (N, 2) it was last at a point (2,), and how near it
    came to it."""
    away = np.hypot(*(way - point).T)
    nearest = float(away.min())
    # A circle that cuts SLACK_M off a straight way which passes the point at a distance.
    last = np.flatnonzero(away <= math.hypot(nearest, _SLACK_M))[-1]
    return len(way) - 1 - int(last), nearest


def _steps(way: Floats) -> Floats:
    """(N - 1,) metres between the points of a way (N, 2)."""
    return np.asarray(np.hypot(*np.diff(way, axis=0).T))
