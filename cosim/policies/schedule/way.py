"""Ways of blind policies: position along the way and bearing of a lane, from odometry and goal."""

from __future__ import annotations

import math
from typing import Final, NamedTuple, Protocol

import numpy as np

from cosim.core.geometry import wrap_angle
from cosim.episode.interfaces import Observation
from cosim.spec.goal import PATCH_M, PATCH_PX, PointGoal, RoutePatch
from cosim.spec.odometry import Odometry

_SAME_GOAL_M: Final = 0.3
"""Least distance between two goals in metres, in the frame of the start."""
_RING_M: Final = 0.8
"""Half the width in metres of the ring of pixels around the look-ahead distance."""
_ORIGIN: Final = Odometry(0.0, 0.0, 0.0)


class Way(Protocol):
    """Way of an episode.

    along_m: position of the robot along it.
    length_m: its length, infinite if unknown.
    """

    along_m: float
    length_m: float

    def update(self, observation: Observation) -> None:
        """Read odometry and goal."""

    def bearing_rad(self, look_m: float, lane_m: float) -> float:
        """Return the bearing of the point `look_m` ahead and `lane_m` to the left of the way."""


class _Segment(NamedTuple):
    """Straight part of a way.

    begins_m: position along the way of its start.
    """

    x_m: float
    y_m: float
    heading_rad: float
    length_m: float
    begins_m: float

    def local(self, x_m: float, y_m: float) -> tuple[float, float]:
        """Return a point as metres along the segment and to its left."""
        dx, dy = x_m - self.x_m, y_m - self.y_m
        cos, sin = math.cos(self.heading_rad), math.sin(self.heading_rad)
        return cos * dx + sin * dy, cos * dy - sin * dx


def _segment(x_m: float, y_m: float, to: tuple[float, float], begins_m: float) -> _Segment:
    dx, dy = to[0] - x_m, to[1] - y_m
    return _Segment(x_m, y_m, math.atan2(dy, dx), math.hypot(dx, dy), begins_m)


class LineWay:
    """Straight lines from the start to each goal point, or straight ahead.

    follows: whether goals are used.
    """

    def __init__(self, follows: bool) -> None:
        self._follows = follows
        self._segments = [_Segment(0.0, 0.0, 0.0, math.inf, 0.0)]
        self._goal: tuple[float, float] | None = None
        self._pose = _ORIGIN
        self.along_m = 0.0
        self.length_m = math.inf

    def update(self, observation: Observation) -> None:
        """Read odometry and goal. A reset of the robot begins a new line at its position."""
        self._pose = pose = _pose_of(observation)
        if observation.reset:
            heading = pose.heading_rad or 0.0
            self._segments = [_Segment(pose.x_m, pose.y_m, heading, math.inf, self.along_m)]
            self._goal = None
        if self._follows and isinstance(observation.goal, PointGoal):
            self._follow(_in_start_frame(pose, observation.goal))
        first = self._segments[0]
        along_m, _ = first.local(pose.x_m, pose.y_m)
        while len(self._segments) > 1 and along_m >= first.length_m:
            del self._segments[0]
            first = self._segments[0]
            along_m, _ = first.local(pose.x_m, pose.y_m)
        self.along_m = first.begins_m + along_m

    def _follow(self, goal: tuple[float, float]) -> None:
        """Add a line to a goal unless it is the last one."""
        if self._goal is None:
            self._segments = [_segment(self._pose.x_m, self._pose.y_m, goal, self.along_m)]
        elif math.dist(goal, self._goal) > _SAME_GOAL_M:
            last = self._segments[-1]
            begins_m = last.begins_m + last.length_m
            self._segments.append(_segment(*self._goal, goal, begins_m))
        else:
            return
        self._goal = goal
        self.length_m = self._segments[-1].begins_m + self._segments[-1].length_m

    def bearing_rad(self, look_m: float, lane_m: float) -> float:
        segment, pose = self._segments[0], self._pose
        _, left_m = segment.local(pose.x_m, pose.y_m)
        heading = segment.heading_rad + math.atan2(lane_m - left_m, look_m)
        return wrap_angle(heading - (pose.heading_rad or 0.0))


class RasterWay:
    """Reference route in a raster around the robot; its position is the distance driven."""

    def __init__(self) -> None:
        self._pixels: np.ndarray | None = None
        self._pose = _ORIGIN
        self.along_m = 0.0
        self.length_m = math.inf

    def update(self, observation: Observation) -> None:
        """Read odometry and goal; the jump of a reset is no driven distance."""
        pose = _pose_of(observation)
        if not observation.reset:
            self.along_m += math.hypot(pose.x_m - self._pose.x_m, pose.y_m - self._pose.y_m)
        self._pose = pose
        if isinstance(observation.goal, RoutePatch):
            rows, columns = np.nonzero(observation.goal.pixels)
            middle = 0.5 * (PATCH_PX - 1)
            self._pixels = PATCH_M * np.stack([middle - rows, middle - columns], axis=1)

    def bearing_rad(self, look_m: float, lane_m: float) -> float:
        if self._pixels is None:
            return 0.0
        look_m = max(look_m, 2.0 * _RING_M)
        distance_m = np.hypot(*self._pixels.T)
        ahead = self._pixels[(np.abs(distance_m - look_m) < _RING_M) & (self._pixels[:, 0] > 0.0)]
        if not len(ahead):
            return 0.0
        x_m, y_m = ahead.mean(axis=0).tolist()
        return math.atan2(y_m, x_m) + math.atan2(lane_m, look_m)


def _pose_of(observation: Observation) -> Odometry:
    return _ORIGIN if observation.odometry is None else observation.odometry


def _in_start_frame(pose: Odometry, goal: PointGoal) -> tuple[float, float]:
    heading = pose.heading_rad or 0.0
    cos, sin = math.cos(heading), math.sin(heading)
    return (
        pose.x_m + cos * goal.x_m - sin * goal.y_m,
        pose.y_m + sin * goal.x_m + cos * goal.y_m,
    )
