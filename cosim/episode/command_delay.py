"""Latency of commands: a policy's answer takes effect some ticks after its observation.

Latency is counted from the observation's tick and rounded up to whole ticks of 0.05 s. The robot
is at rest until the first command arrives; then the last arrived command holds. Waypoints become a
command when they are answered, in the robot's frame at the observation. They are not corrected for
later motion, as on the robots of GNM, ViNT and NoMaD. A reset of the robot discards pending
commands.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from cosim.core.state import STILL, Command, WaypointCommand

_NO_PLAN = np.empty((0, 2), dtype=np.float32)
"""Waypoints of a command without any."""


class CommandDelay:
    """Pending commands of an episode, in the order of their ticks."""

    def __init__(self) -> None:
        self._pending: deque[tuple[int, Command]] = deque()
        self._current = STILL
        self._answers: list[tuple[float, float, float, float]] = []
        self._plans: list[NDArray[np.float32]] = []
        self._index = 0
        self.last_arrival_tick = 0
        """Tick at which the last command takes effect."""

    def add(self, tick: int, delay: int, command: Command) -> None:
        """Add a command for the observation of `tick`, which takes effect `delay` ticks later."""
        self.last_arrival_tick = tick + delay
        self._pending.append((self.last_arrival_tick, command))
        self._answers.append((tick, delay, command.v_mps, command.w_radps))
        if isinstance(command, WaypointCommand):
            self._plans.append(command.waypoints)
            self._index = command.index
        else:
            self._plans.append(_NO_PLAN)

    def at(self, tick: int) -> Command:
        """Return the command that holds during a tick."""
        while self._pending and self._pending[0][0] <= tick:
            _, self._current = self._pending.popleft()
        return self._current

    def on_reset(self) -> None:
        """Discard pending commands: the robot was reset and is at rest."""
        self._pending.clear()
        self._current = STILL

    @property
    def answers(self) -> Floats:
        """Answers, (A, 4), as in `cosim.results.log.Log`."""
        return np.array(self._answers, dtype=float).reshape(-1, 4)

    @property
    def plans(self) -> tuple[NDArray[np.int32], NDArray[np.float32], int]:
        """Sizes (A,), points (W, 2) or (W, 4), and index of waypoints, as in
        `cosim.results.log.Log`.

        Without waypoints the sizes have shape (0,).
        """
        sizes = np.array([len(plan) for plan in self._plans], dtype=np.int32)
        points = np.full(
            (sizes.sum(), max((plan.shape[1] for plan in self._plans), default=2)),
            np.nan,
            np.float32,
        )
        for plan, end in zip(self._plans, np.cumsum(sizes).tolist(), strict=True):
            points[end - len(plan) : end, : plan.shape[1]] = plan
        return sizes if len(points) else sizes[:0], points, self._index


def whole_ticks(latency_ms: float, tick_ms: int) -> int:
    """Return the number of ticks of a latency, rounded up.

    >>> [whole_ticks(ms, 50) for ms in (0.0, 0.1, 50.0, 120.0)]
    [0, 1, 1, 3]
    """
    return math.ceil(latency_ms / tick_ms)


def median_ms(answers: Floats, tick_ms: int) -> float:
    """Return the median delay of answers in milliseconds, 0 without any."""
    return float(np.median(answers[:, 1])) * tick_ms if len(answers) else 0.0
