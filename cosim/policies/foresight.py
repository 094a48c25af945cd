"""Foresight: what becomes of many plans at once, each driven ahead in the head with the robot's own steering.

A plan is a lane beside the route, a speed, how boldly it changes lanes and after how long. The robot is a unicycle with
the limits of its drive; people walk on as they walk, and those who walk at the robot aim at it until they commit to a
line.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from cosim.core.geometry import Floats, Polyline, Pose, wrap_angles
from cosim.spec.robot import Robot

STEP_S: Final = 0.2
STEPS: Final = 20
_GAIN_PER_S: Final = 2.4
_LOOK_M: Final = 1.0
TURN_FIRST_RAD: Final = 1.1
"""A robot whose target is this far off its heading turns nearly on the spot."""
COMMITS_M: Final = 5.0
AIMS_RAD: Final = 0.12
"""Somebody farther than this whose walk points at the robot so exactly is taken to aim at it."""
GRID_M: Final = 0.2
_BEYOND_M: Final = 10.0
GOAL_LANE_M: Final = 0.6
"""The lane at the goal: it counts as reached from within 1 m."""


class Plans(NamedTuple):
    """K plans, (K,) each: m left of the route, m/s, sideways m per m of the change of lanes, s until that begins."""

    lane_m: Floats
    speed_mps: Floats
    slope: Floats
    delay_s: Floats


class Way:
    """A route as arrays over arc length, continued straight on beyond its end."""

    def __init__(self, route: Polyline) -> None:
        self.length_m = route.length_m
        end = route.at(route.length_m)
        beyond = end.xy + _BEYOND_M * np.array([math.cos(end.heading_rad), math.sin(end.heading_rad)])
        line = Polyline(np.vstack([route.points, beyond]))
        self._s = np.arange(0.0, line.length_m, GRID_M)
        self._x = np.interp(self._s, line.s_m, line.points[:, 0])
        self._y = np.interp(self._s, line.s_m, line.points[:, 1])
        dx, dy = np.gradient(self._x), np.gradient(self._y)
        self._heading = np.unwrap(np.arctan2(dy, dx))

    def at(self, s_m: Floats) -> tuple[Floats, Floats, Floats]:
        """x, y and heading (unwrapped) at arc lengths."""
        x, y = np.interp(s_m, self._s, self._x), np.interp(s_m, self._s, self._y)
        return x, y, np.interp(s_m, self._s, self._heading)

    def lateral(self, pose: Pose, s_m: float) -> float:
        """How far left of the route a pose is, given its arc length."""
        x, y, heading = (float(value) for value in self.at(np.array(s_m)))
        return -(pose.x_m - x) * math.sin(heading) + (pose.y_m - y) * math.cos(heading)

    def place(self, s_m: Floats, lane_m: Floats) -> Floats:
        """(..., 2) m: points beside the route."""
        x, y, heading = self.at(s_m)
        return np.stack([x - lane_m * np.sin(heading), y + lane_m * np.cos(heading)], axis=-1)


class Ahead(NamedTuple):
    """What becomes of K plans at STEPS times. pose: (STEPS, K, 3) x, y, heading; s_m (STEPS, K); people
    (STEPS, K, N, 2) m; command (K, 2): v and w to be given now."""

    pose: Floats
    s_m: Floats
    people: Floats
    command: Floats


def steering(
    way: Way, plans: Plans, w_max_radps: float, pose: Floats, s_m: Floats, after_s: float
) -> tuple[Floats, Floats]:
    """(v, w), (K,) each: how robots at poses (K, 3) with arc lengths (K,) follow their plans, `after_s` from now."""
    x, y, heading = way.at(s_m)
    here = -(pose[:, 0] - x) * np.sin(heading) + (pose[:, 1] - y) * np.cos(heading)
    at_end = GOAL_LANE_M + 0.5 * np.maximum(way.length_m - s_m - 1.0, 0.0)
    lane = np.clip(plans.lane_m, -at_end, at_end)
    reach = np.where(after_s >= plans.delay_s - 1e-9, plans.slope * _LOOK_M, 0.0)
    target = way.place(s_m + _LOOK_M, here + np.clip(lane - here, -reach, reach))
    bearing = wrap_angles(np.arctan2(target[:, 1] - pose[:, 1], target[:, 0] - pose[:, 0]) - pose[:, 2])
    slowed = np.maximum(1.0 - np.abs(bearing) / TURN_FIRST_RAD, 0.05)
    return plans.speed_mps * np.minimum(slowed * 1.35, 1.0), np.clip(_GAIN_PER_S * bearing, -w_max_radps, w_max_radps)


def foresee(
    way: Way,
    plans: Plans,
    robot: Robot,
    pose: Pose,
    s_m: float,
    speeds: tuple[float, float],
    people: Floats,
    walks: Floats,
) -> Ahead:
    """Drive every plan STEPS ahead with a robot. speeds: v m/s and w rad/s now; people (N, 2) m, walks (N, 2) m/s."""
    count = len(plans.lane_m)
    v_step, w_step = STEP_S * (robot.acceleration_mps2 * 4 / 5), STEP_S * (robot.acceleration_radps2 * 5 / 6)
    at = np.tile(np.array(pose), (count, 1))
    along = np.full(count, s_m)
    v, w = np.full(count, speeds[0]), np.full(count, speeds[1])
    others = np.tile(people, (count, 1, 1))
    velocity = np.tile(walks, (count, 1, 1))
    pace = np.hypot(walks[:, 0], walks[:, 1])
    aims = _aims_at(pose, people, walks)
    poses, arcs, places = [], [], []
    command = np.zeros((count, 2))
    for k in range(STEPS):
        v_goal, w_goal = steering(way, plans, robot.w_max_radps, at, along, k * STEP_S)
        if k == 0:
            command = np.column_stack([v_goal, w_goal])
        v = v + np.clip(v_goal - v, -v_step, v_step)
        w = w + np.clip(w_goal - w, -w_step, w_step)
        middle = at[:, 2] + 0.5 * STEP_S * w
        at = at + STEP_S * np.column_stack([v * np.cos(middle), v * np.sin(middle), w])
        along = along + STEP_S * v * np.cos(middle - way.at(along)[2])
        if aims.any():
            to_robot = at[:, None, :2] - others
            far = np.hypot(to_robot[..., 0], to_robot[..., 1])
            turns = (aims & (far > COMMITS_M))[..., None]
            velocity = np.where(turns, pace[:, None] * to_robot / np.maximum(far, 1e-9)[..., None], velocity)
        others = others + STEP_S * velocity
        poses.append(at)
        arcs.append(along)
        places.append(others)
    return Ahead(np.stack(poses), np.stack(arcs), np.stack(places), command)


def _aims_at(pose: Pose, people: Floats, walks: Floats) -> np.ndarray:
    """(N,) whether each walks straight at the robot from beyond COMMITS_M."""
    to_robot = pose.xy - people
    far = np.hypot(to_robot[:, 0], to_robot[:, 1])
    off = np.arctan2(walks[:, 1], walks[:, 0]) - np.arctan2(to_robot[:, 1], to_robot[:, 0])
    aims: np.ndarray = (np.abs(wrap_angles(off)) < AIMS_RAD) & (far > COMMITS_M) & (np.hypot(*walks.T) > 0.3)
    return aims
