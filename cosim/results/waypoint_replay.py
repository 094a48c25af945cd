"""The waypoints that are followed, tick by tick of an episode that is run again."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from cosim.core.geometry import Floats
from cosim.episode.loop import Step
from cosim.results.log import Log

_FARTHEST_M = 200.0
"""Ahead and aside; nobody looks farther."""


class Following:
    """Takes in the Steps of an episode, in order, and says where the waypoints lie that its robot
    follows: those whose command took effect last, seen from where the robot was when they were
    asked for.

    follows: which row of what `take` gives is followed.
    """

    def __init__(self, log: Log) -> None:
        points = np.clip(log.plan_points[:, :2].astype(float), -_FARTHEST_M, _FARTHEST_M)
        self._plans = np.split(points, np.cumsum(log.plan_sizes)[:-1])
        self._asked = log.answers[: len(log.plan_sizes), :2].astype(int).tolist()
        self._next = 0
        self.follows = log.plan_index + 1
        self._way: deque[tuple[int, Floats | None]] = deque()
        self._holds: Floats | None = None

    def take(self, step: Step, reset: bool) -> Floats | None:
        """(1 + N, 2) metres in the world: where the robot was asked, and the waypoints; None where
        there are none to follow. reset: after this tick the robot is put elsewhere."""
        while self._next < len(self._asked) and self._asked[self._next][0] <= step.tick:
            points = self._plans[self._next]
            delay = self._asked[self._next][1]
            pose = step.robot.pose
            self._next = self._next + 1
            cos, sin = math.cos(pose.heading_rad), math.sin(pose.heading_rad)
            there = np.vstack([(0.0, 0.0), points]) @ np.array([[cos, sin], [-sin, cos]]) + pose.xy
            self._way.append((step.tick + delay, there if len(points) else None))
        while self._way and self._way[0][0] <= step.tick:
            _, self._holds = self._way.popleft()
        holds = self._holds
        if reset:
            self._way.clear()
            self._holds = None
        return holds
