"""Commands on their way: a policy's answer to the observation of a tick takes effect some ticks
later.

Latency is counted from the observation's tick and rounded up to whole ticks (0.05 s), because a
command holds for a tick. Until the first one arrives the robot stands; afterwards the last one that
arrived holds. Waypoints become a command when they are answered, in the frame of the robot at their
observation, and are not corrected for the way it has driven since: so the robots that GNM, ViNT and
NoMaD are shipped for follow them. When the robot is put elsewhere, what is on its way is lost.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from cosim.core.state import STILL, Command, Planned

_NO_PLAN = np.empty((0, 2), dtype=np.float32)


class InFlight:
    """The commands of one episode, given in the order of their ticks; none overtakes another."""

    def __init__(self) -> None:
        self._way: deque[tuple[int, Command]] = deque()
        self._holds = STILL
        self._answers: list[tuple[float, float, float, float]] = []
        self._plans: list[NDArray[np.float32]] = []
        self._index = 0
        self.arrived_by = 0
        """The tick at which the last command takes effect."""

    def answered(self, tick: int, delay: int, command: Command) -> None:
        """A command for the observation of a tick, to take effect `delay` ticks later."""
        self.arrived_by = tick + delay
        self._way.append((self.arrived_by, command))
        self._answers.append((tick, delay, command.v_mps, command.w_radps))
        if isinstance(command, Planned):
            self._plans.append(command.waypoints)
            self._index = command.index
        else:
            self._plans.append(_NO_PLAN)

    def at(self, tick: int) -> Command:
        """The command that holds during a tick."""
        while self._way and self._way[0][0] <= tick:
            _, self._holds = self._way.popleft()
        return self._holds

    def put_back(self) -> None:
        """The robot is elsewhere now, at rest."""
        self._way.clear()
        self._holds = STILL

    @property
    def answers(self) -> Floats:
        """(A, 4), as in `cosim.results.log.Log`."""
        return np.array(self._answers, dtype=float).reshape(-1, 4)

    @property
    def plans(self) -> tuple[NDArray[np.int32], NDArray[np.float32], int]:
        """plan_sizes (A,), plan_points (W, 2) or (W, 4) and plan_index, as in
        `cosim.results.log.Log`; without waypoints plan_sizes is (0,)."""
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
    """The ticks that a latency takes, rounded up.

    >>> [whole_ticks(ms, 50) for ms in (0.0, 0.1, 50.0, 120.0)]
    [0, 1, 1, 3]
    """
    return math.ceil(latency_ms / tick_ms)


def median_ms(answers: Floats, tick_ms: int) -> float:
    """The median of the delays of answers, 0 without any."""
    return float(np.median(answers[:, 1])) * tick_ms if len(answers) else 0.0
