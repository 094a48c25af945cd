"""Rollout of many plans at once with the robot's steering.

A plan is a lane parallel to the path, a speed, the slope of the lane change and its delay. The
robot is a unicycle with the limits of its drive.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from cosim.core.geometry import Floats, Polyline, Pose, wrap_angles
from cosim.spec.robot import Robot

STEP_S: Final = 0.2
"""Time step of a rollout in seconds."""
STEPS: Final = 20
"""Number of steps of a rollout."""
STEP_TIMES_S: Final = STEP_S * np.arange(1, STEPS + 1)
"""(STEPS,) times of the steps in seconds."""
_GAIN_PER_S: Final = 2.4
"""Gain of the turning rate on the bearing in 1/s."""
_LOOK_M: Final = 1.0
"""Look-ahead distance in metres."""
TURN_FIRST_RAD: Final = 1.1
"""Bearing in radians above which the robot turns almost on the spot."""
_GRID_M: Final = 0.2
"""Sampling distance of a path in metres."""
_LOOK_CELLS: Final = round(_LOOK_M / _GRID_M)
_BEYOND_M: Final = 10.0
"""Length in metres of the straight extension at the end of a path."""
GOAL_LANE_M: Final = 0.6
"""Largest lane offset in metres at the goal, which counts as reached within 1 m."""


class Plans(NamedTuple):
    """K plans, each array (K,).

    lane_m: Metres to the left of the path.
    speed_mps: Speed in m/s; 0 is waiting.
    slope: Lateral metres per metre of a lane change.
    delay_s: Seconds until the lane change begins.
    """

    lane_m: Floats
    speed_mps: Floats
    slope: Floats
    delay_s: Floats


class SampledPath:
    """Path sampled over arc length, extended straight beyond its end."""

    def __init__(self, line: Polyline) -> None:
        self.length_m = line.length_m
        end = line.at(line.length_m)
        beyond = end.xy + _BEYOND_M * np.array(
            [math.cos(end.heading_rad), math.sin(end.heading_rad)]
        )
        whole = Polyline(np.vstack([line.points, beyond]))
        s = np.arange(0.0, whole.length_m, _GRID_M)
        x, y = (
            np.interp(s, whole.s_m, whole.points[:, 0]),
            np.interp(s, whole.s_m, whole.points[:, 1]),
        )
        heading = np.unwrap(np.arctan2(np.gradient(y), np.gradient(x)))
        self._rows = np.stack([x, y, -np.sin(heading), np.cos(heading)])
        self._more = np.diff(self._rows, axis=1, append=self._rows[:, -1:])
        self._last = len(s) - 1

    def at(self, s_m: Floats, cells_on: int = 0) -> Floats:
        """Return (4, ...) at arc lengths: x, y, and the unit vector to the left.

        cells_on: Number of samples (_GRID_M) to look ahead.
        """
        scaled = np.minimum(np.maximum(s_m * (1.0 / _GRID_M), 0.0), self._last - cells_on)
        cell = scaled.astype(np.intp)
        part = scaled - cell
        cell += cells_on
        found: Floats = self._rows[:, cell] + part * self._more[:, cell]
        return found

    def lateral(self, pose: Pose, s_m: float) -> float:
        """Return the lateral offset in metres of a pose with this arc length, left positive."""
        x, y, left_x, left_y = self.at(np.array(s_m)).tolist()
        return float((pose.x_m - x) * left_x + (pose.y_m - y) * left_y)

    def place(self, s_m: Floats, lane_m: Floats) -> Floats:
        """Return (..., 2) points in metres at arc lengths and lateral offsets."""
        x, y, left_x, left_y = self.at(s_m)
        return np.stack([x + lane_m * left_x, y + lane_m * left_y], axis=-1)


class Rollout(NamedTuple):
    """Rollout of K plans at STEPS times.

    pose: (STEPS, 3, K) x, y and heading.
    s_m: (STEPS, K) arc lengths.
    command: (2, K) v and w of the first step.
    """

    pose: Floats
    s_m: Floats
    command: Floats


def roll_out(
    way: SampledPath,
    plans: Plans,
    robot: Robot,
    pose: Pose,
    s_m: float,
    speeds: tuple[float, float],
) -> Rollout:
    """Roll out every plan. A waiting plan does not turn either.

    s_m: Arc length of the robot in metres.
    speeds: Current v in m/s and w in rad/s.
    """
    count = len(plans.lane_m)
    v_step, w_step = (
        STEP_S * (robot.acceleration_mps2 * 4 / 5),
        STEP_S * (robot.acceleration_radps2 * 5 / 6),
    )
    x, y, heading = (np.full(count, value) for value in pose)
    along, v, w = (np.full(count, value) for value in (s_m, *speeds))
    poses = np.empty((STEPS, 3, count))
    arcs = np.empty((STEPS, count))
    command = np.empty((2, count))
    turns = plans.speed_mps > 0.0
    for k in range(STEPS):
        x_0, y_0, left_x, left_y = way.at(along)
        x_1, y_1, there_x, there_y = way.at(along, _LOOK_CELLS)
        beside = (x - x_0) * left_x + (y - y_0) * left_y
        at_end = GOAL_LANE_M + 0.5 * np.maximum(way.length_m - along - 1.0, 0.0)
        lane = np.minimum(np.maximum(plans.lane_m, -at_end), at_end)
        reach = np.where(k * STEP_S >= plans.delay_s - 1e-9, plans.slope * _LOOK_M, 0.0)
        lane = beside + np.minimum(np.maximum(lane - beside, -reach), reach)
        bearing = wrap_angles(
            np.arctan2(y_1 + lane * there_y - y, x_1 + lane * there_x - x) - heading
        )
        slowed = np.maximum(1.0 - np.abs(bearing) / TURN_FIRST_RAD, 0.05)
        v_goal = plans.speed_mps * np.minimum(slowed * 1.35, 1.0)
        w_goal = turns * np.minimum(
            np.maximum(_GAIN_PER_S * bearing, -robot.w_max_radps), robot.w_max_radps
        )
        if k == 0:
            command[:] = v_goal, w_goal
        v = v + np.minimum(np.maximum(v_goal - v, -v_step), v_step)
        w = w + np.minimum(np.maximum(w_goal - w, -w_step), w_step)
        middle = heading + 0.5 * STEP_S * w
        v_x, v_y = v * np.cos(middle), v * np.sin(middle)
        x, y, heading = x + STEP_S * v_x, y + STEP_S * v_y, heading + STEP_S * w
        along = along + STEP_S * (v_x * left_y - v_y * left_x)
        poses[k] = x, y, heading
        arcs[k] = along
    return Rollout(poses, arcs, command)
