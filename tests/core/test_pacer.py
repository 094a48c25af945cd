"""Holding a simulation to the wall clock, with a simulated clock."""

from __future__ import annotations

import pytest

from cosim.core.clock import Pacer


class Wall:
    """A wall clock that advances with sleep and work."""

    def __init__(self) -> None:
        self.now_s = 100.0
        self.slept_s: list[float] = []

    def sleep(self, seconds: float) -> None:
        self.slept_s.append(seconds)
        self.now_s += seconds


@pytest.mark.parametrize("pace", [0.5, 1.0, 4.0])
def test_ticks_take_real_time_however_long_each_is_computed(pace: float) -> None:
    """100 ticks of 0.05 s, every fifth of which takes longer to compute, take 5 s together at real
    time."""
    wall = Wall()
    pacer = Pacer(pace, lambda: wall.now_s, wall.sleep)
    for tick in range(100):
        wall.now_s += 0.08 / pace if tick % 5 == 1 else 0.001 / pace
        pacer.wait(0.05)
    assert wall.now_s - 100.0 == pytest.approx(5.0 / pace, rel=0.01)


def test_slow_ticks_are_not_delayed_and_long_pauses_are_not_caught_up() -> None:
    """Slow ticks are not followed by a wait; after a pause of a minute at most a second's worth of
    ticks runs faster."""
    wall = Wall()
    pacer = Pacer(1.0, lambda: wall.now_s, wall.sleep)
    pacer.wait(0.05)
    wall.slept_s.clear()
    for _ in range(100):
        wall.now_s += 0.06
        pacer.wait(0.05)
    assert wall.slept_s == []
    wall.now_s += 60.0
    for _ in range(100):
        pacer.wait(0.05)
    assert sum(wall.slept_s) == pytest.approx(4.0, abs=0.06)
