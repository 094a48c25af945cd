"""Delay that the robot causes for people and vehicles, measured against the street without it.

Both streets start identically. A body is compared if it has the same id, entry tick and entry place
in both. At the end of the common time, its delay is how much earlier it would have reached its
current position without the robot, so a body that rests at the same place in both has none. The
delay is negative if it got ahead. Stepping aside and back counts as no progress. Positions within
_SLACK_M are the same, so delays are slightly underestimated. Bodies that never move without the
robot are skipped.

Small changes spread: far from the robot the streets differ by chance. The sum over bodies that came
near the robot is therefore reported separately.
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
"""Distance to the robot, metres, below which a body counts as near."""
MOVING_MPS: Final = 0.1
"""Speed above which a body counts as moving."""
_SAME_PLACE_M: Final = 0.5
_SLACK_M: Final = 0.5


class Delay(NamedTuple):
    """Delay that a robot caused.

    delay_s: sum over all compared bodies
    near_s: sum over those that came within DELAY_NEAR_M of the robot
    compared, near: number of these bodies
    unmatched: number of bodies in the street with the robot that have no counterpart
    """

    delay_s: float
    near_s: float
    compared: int
    near: int
    unmatched: int


class Tracks:
    """Positions of all bodies by tick, from first appearance to first absence."""

    def __init__(self) -> None:
        self._tick = 0
        self._xy: dict[str, array[float]] = {}
        self.began: dict[str, int] = {}

    def add(self, bodies: People | Vehicles) -> None:
        """Append the positions of one tick."""
        for name, (x_m, y_m) in zip(bodies.ids, bodies.xy.tolist(), strict=True):
            began = self.began.setdefault(name, self._tick)
            way = self._xy.setdefault(name, array("d"))
            if len(way) == 2 * (self._tick - began):
                way.extend((x_m, y_m))
        self._tick += 1

    def way(self, name: str) -> Floats:
        """Return the (N, 2) positions of a body, metres; empty for an unknown id."""
        return np.array(self._xy.get(name, ()), dtype=float).reshape(-1, 2)


def delay_of(
    robot: Sequence[tuple[float, float]], present: Tracks, absent: Tracks, tick_s: float
) -> Delay:
    """Compute the delay that a robot caused.

    robot: (x, y) in metres at each tick of `present`
    present, absent: tracks with and without the robot
    """
    robot_xy = np.array(robot, dtype=float).reshape(-1, 2)
    delay_s = near_s = 0.0
    compared = near = unmatched = 0
    for name in sorted(present.began):
        with_robot, without_robot = present.way(name), absent.way(name)
        first = present.began[name]
        same = (
            first == absent.began.get(name)
            and np.hypot(*(with_robot[0] - without_robot[0])) < _SAME_PLACE_M
        )
        if not same:
            unmatched += 1
            continue
        shared = min(len(with_robot), len(without_robot))
        with_robot, without_robot = with_robot[:shared], without_robot[:shared]
        if _step_lengths(without_robot).max(initial=0.0) <= MOVING_MPS * tick_s:
            continue
        delayed_s = _lag_ticks(with_robot, without_robot) * tick_s
        offset = with_robot - robot_xy[first : first + shared]
        is_near = bool((np.hypot(offset[:, 0], offset[:, 1]) < DELAY_NEAR_M).any())
        delay_s += delayed_s
        compared += 1
        near_s += delayed_s * is_near
        near += is_near
    return Delay(delay_s, near_s, compared, near, unmatched)


def _lag_ticks(track: Floats, reference: Floats) -> int:
    """Return by how many ticks the end of a track (N, 2) lags behind another track."""
    behind, track_off_m = _ticks_since(track[-1], reference)
    ahead, reference_off_m = _ticks_since(reference[-1], track)
    return behind if track_off_m <= reference_off_m else -ahead


def _ticks_since(point: Floats, way: Floats) -> tuple[int, float]:
    """Return the ticks since a track (N, 2) was last at a point (2,), and its least distance,
    metres."""
    away = np.hypot(*(way - point).T)
    nearest = float(away.min())
    # This circle cuts _SLACK_M off a straight track that passes the point at the least distance.
    last = np.flatnonzero(away <= math.hypot(nearest, _SLACK_M))[-1]
    return len(way) - 1 - int(last), nearest


def _step_lengths(way: Floats) -> Floats:
    """Return the (N - 1,) distances between the points of a track (N, 2), metres."""
    return np.asarray(np.hypot(*np.diff(way, axis=0).T))
