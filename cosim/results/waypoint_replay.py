"""Waypoints that the robot follows at each tick of a replayed episode."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from cosim.core.geometry import Floats
from cosim.episode.loop import Step
from cosim.results.log import Log

_FARTHEST_M = 200.0
"""Limit, metres, of waypoint coordinates; farther ones are not visible."""


class WaypointReplay:
    """Waypoints that the robot follows, from the Steps of an episode in order.

    The waypoints are those whose command took effect last, at the robot's pose when they were
    requested. `follows` is the row of `update`'s result that is followed.
    """

    def __init__(self, log: Log) -> None:
        points = np.clip(log.plan_points[:, :2].astype(float), -_FARTHEST_M, _FARTHEST_M)
        self._plans = np.split(points, np.cumsum(log.plan_sizes)[:-1])
        self._requests = log.answers[: len(log.plan_sizes), :2].astype(int).tolist()
        self._next = 0
        self.follows = log.plan_index + 1
        self._pending: deque[tuple[int, Floats | None]] = deque()
        self._current: Floats | None = None

    def update(self, step: Step, reset: bool) -> Floats | None:
        """Process a step and return (1 + N, 2) metres in the world; None without waypoints.

        The first row is the robot's position at the request, then the waypoints.

        reset: whether the robot is reset after this tick
        """
        while self._next < len(self._requests) and self._requests[self._next][0] <= step.tick:
            points = self._plans[self._next]
            delay = self._requests[self._next][1]
            pose = step.robot.pose
            self._next += 1
            cos, sin = math.cos(pose.heading_rad), math.sin(pose.heading_rad)
            there = np.vstack([(0.0, 0.0), points]) @ np.array([[cos, sin], [-sin, cos]]) + pose.xy
            self._pending.append((step.tick + delay, there if len(points) else None))
        while self._pending and self._pending[0][0] <= step.tick:
            _, self._current = self._pending.popleft()
        current = self._current
        if reset:
            self._pending.clear()
            self._current = None
        return current
