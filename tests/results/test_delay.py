"""Delays worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from cosim.core.state import People
from cosim.results.delay import Tracks, delay_of


def tracks(*ways: list[float]) -> Tracks:
    """People c0, c1, ... on lines 20 m apart who are at these x, tick by tick; all of equal
    length."""
    told = Tracks()
    for xs in zip(*ways, strict=True):
        n = len(xs)
        names = tuple(f"c{i}" for i in range(n))
        xy = [(x, 20.0 * i) for i, x in enumerate(xs)]
        told.add(People.of(names, xy, np.zeros(n), np.zeros(n), ("walk",) * n))
    return told


WALK = [0.05 * k for k in range(201)]
"""10 s at 1 m/s."""
HELD_UP = [0.05 * min(k, 100) for k in range(201)]
"""5 s at 1 m/s, then 5 s of standing."""


def test_who_stands_for_five_seconds_is_late_by_them() -> None:
    """One of two people, near the robot, is held up for 5 s, less the time for half a metre; the
    other, far from it, is not."""
    robot = [(5.0, 1.0)] * 201
    found = delay_of(robot, tracks(HELD_UP, WALK), tracks(WALK, WALK), 0.05)
    assert found.delay_s == pytest.approx(4.5) and found.near_s == pytest.approx(4.5)
    assert (found.compared, found.near, found.unmatched) == (2, 1, 0)
    faster = delay_of(robot, tracks(WALK, WALK), tracks(HELD_UP, WALK), 0.05)
    assert faster.delay_s == pytest.approx(-4.5)


def test_who_steps_aside_and_back_has_not_got_on() -> None:
    """Somebody who waits for the last five seconds is not faster for shuffling about meanwhile."""
    shuffling = [x + (0.3 * (k % 2) if k > 100 else 0.0) for k, x in enumerate(HELD_UP)]
    assert delay_of(
        [(5.0, 1.0)] * 201, tracks(shuffling), tracks(HELD_UP), 0.05
    ).delay_s == pytest.approx(0.0)


def test_somebody_else_of_the_same_name_is_not_compared() -> None:
    """Who entered elsewhere is another person."""
    found = delay_of([(5.0, 1.0)] * 201, tracks(HELD_UP), tracks([3.0 + x for x in WALK]), 0.05)
    assert (found.compared, found.unmatched, found.delay_s) == (0, 1, 0.0)


def test_who_stands_anyway_is_not_delayed() -> None:
    """Without a pace there is no delay."""
    found = delay_of([(5.0, 1.0)] * 201, tracks([1.0] * 201), tracks([1.0] * 201), 0.05)
    assert (found.compared, found.delay_s) == (0, 0.0)
