"""Foresight: what becomes of many plans at once, each driven ahead in the head with the robot's own
steering.

A plan is a lane beside the way, a speed, how boldly it changes lanes and after how long. The robot
is a unicycle with the limits of its drive.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from cosim.core.geometry import Floats, Polyline, Pose, wrap_angles
from cosim.spec.robot import Robot

STEP_S: Final = 0.2
STEPS: Final = 20
STEP_TIMES_S: Final = STEP_S * np.arange(1, STEPS + 1)
_GAIN_PER_S: Final = 2.4
_LOOK_M: Final = 1.0
TURN_FIRST_RAD: Final = 1.1
"""A robot whose target is this far off its heading turns nearly on the spot."""
_GRID_M: Final = 0.2
_LOOK_CELLS: Final = round(_LOOK_M / _GRID_M)
_BEYOND_M: Final = 10.0
GOAL_LANE_M: Final = 0.6
"""The lane at the goal: it counts as reached from within 1 m."""


class Plans(NamedTuple):
    """K plans, (K,) each: m left of the way, m/s, sideways m per m of the change of lanes, s until
    that begins."""

    lane_m: Floats
    speed_mps: Floats
    slope: Floats
    delay_s: Floats


class Way:
    """A line as arrays over arc length, continued straight on beyond its end."""

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
        """(4, ...) at arc lengths: x, y, and the x and y of the direction to the left. cells_on: so
        many _GRID_M on."""
        scaled = np.minimum(np.maximum(s_m * (1.0 / _GRID_M), 0.0), self._last - cells_on)
        cell = scaled.astype(np.intp)
        part = scaled - cell
        cell += cells_on
        found: Floats = self._rows[:, cell] + part * self._more[:, cell]
        return found

    def lateral(self, pose: Pose, s_m: float) -> float:
        """How far left of the way a pose is, given its arc length."""
        x, y, left_x, left_y = self.at(np.array(s_m)).tolist()
        return float((pose.x_m - x) * left_x + (pose.y_m - y) * left_y)

    def place(self, s_m: Floats, lane_m: Floats) -> Floats:
        """(..., 2) m: points beside the way."""
        x, y, left_x, left_y = self.at(s_m)
        return np.stack([x + lane_m * left_x, y + lane_m * left_y], axis=-1)


class Ahead(NamedTuple):
    """What becomes of K plans at STEPS times. pose: (STEPS, 3, K) x, y, heading; s_m: (STEPS, K);
    command: (2, K) v and w to be given now. Who waits does not turn either."""

    pose: Floats
    s_m: Floats
    command: Floats


def foresee(
    way: Way, plans: Plans, robot: Robot, pose: Pose, s_m: float, speeds: tuple[float, float]
) -> Ahead:
    """Drive every plan STEPS ahead with a robot. s_m: its arc length; speeds: v m/s and w rad/s
    now."""
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
    return Ahead(poses, arcs, command)
