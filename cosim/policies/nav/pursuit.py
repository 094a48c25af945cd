"""Regulated pure pursuit: from a way to speed and yaw rate.

The rules are those of the controller of Nav2 with this name, and their values are scaled to a
robot of 1.5 m/s: look-ahead by the speed, slower in curves and near obstacles, a turn on the spot
towards a way that starts sideways, and a stop before a predicted collision.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from cosim.core.geometry import Floats
from cosim.core.state import STILL, Command
from cosim.policies.body_disks import BodyDisks
from cosim.policies.nav.costmap import Costmap
from cosim.policies.nav.local_plan import NEARER_M, LocalPlan
from cosim.policies.nav.route_path import STEP_M
from cosim.policies.nav.tracking import Movers
from cosim.spec.robot import Robot

LOOK_AHEAD_S: Final = 0.8
"""Look-ahead time in seconds."""
LOOK_AHEAD_M: Final = (0.7, 1.2)
"""Smallest and largest look-ahead distance in metres."""
TURN_FIRST_RAD: Final = 0.785
"""Bearing of the look-ahead point in radians beyond which the robot turns on the spot."""
MIN_RADIUS_M: Final = 1.5
"""Radius in metres below which the speed falls with the radius."""
SLOWEST_MPS: Final = 0.25
"""Lowest speed in m/s that curves and near obstacles lead to."""
SLOW_WITHIN_M: Final = 0.45
"""Distance from the robot's outline to an obstacle below which the speed falls, in metres."""
BRAKE_MPS2: Final = 1.2
"""Deceleration in m/s^2 before an obstacle."""
STOP_SHORT_M: Final = 0.45
"""Distance in metres from the robot's front to an obstacle at which it stops."""
FORESEEN_S: Final = 2.5
"""Time in seconds for which moving bodies are predicted."""
MOVER_GAP_M: Final = 0.2
"""Least predicted distance in metres from the robot's disks to a moving body."""
_TOUCH_M: Final = 0.06
"""Distance in metres of a corner at which it may touch: half a cell of the costmap."""
_STOPPING_M: Final = 0.15
"""Distance in metres from a touch at which the robot stops on its arc."""
_NEAR_M: Final = 0.45
"""Distance in metres of the point to which the robot turns on the spot where its arc is closed."""
_TURN_RAD: Final = 0.15
"""Step in radians at which turns on the spot are checked."""
_CORNER_M: Final = 0.12
"""Least distance in metres of a corner to an obstacle in such a turn."""
_IMPATIENT: Final = 0.5
"""Share of this time and distance that counts after waiting for long."""
_SPEEDS: Final = np.array([1.0, 2.0 / 3.0, 1.0 / 3.0, 0.0])
"""Speeds to compare, as shares of the travelling speed."""
COLLISION_S: Final = 1.2
"""Time in seconds over which the arc is checked for a collision."""


def pursue(
    plan: LocalPlan, costmap: Costmap, robot: Robot, v_mps: float, most_mps: float
) -> Command:
    """Return the command that follows a plan.

    v_mps: current speed.
    most_mps: limit of the speed.
    """
    room_m = plan.free_m - STOP_SHORT_M - robot.length_m / 2 if plan.blocked else math.inf
    if room_m <= 0.0:
        return STILL
    look_m = float(np.clip(LOOK_AHEAD_S * v_mps, *LOOK_AHEAD_M))
    x, y = point_at(plan.points, look_m).tolist()
    if abs(math.atan2(y, x)) > TURN_FIRST_RAD:
        return _turn_to(y, robot.w_max_radps, costmap, robot)
    curvature = 2.0 * y / max(x * x + y * y, 1e-6)
    most_mps = min(most_mps, robot.cruise_mps, _stopping_mps(room_m))
    v = min(
        _regulated_mps(curvature, plan.points[: max(2, round(look_m / STEP_M))], costmap, robot),
        most_mps,
        robot.w_max_radps / max(abs(curvature), 1e-6),
    )
    free_m = _free_on_arc_m(curvature, max(v, 0.3) * COLLISION_S + 0.2, costmap, robot)
    v = min(v, _stopping_mps(free_m - _STOPPING_M))
    if v < SLOWEST_MPS <= most_mps:
        x, y = point_at(plan.points, _NEAR_M).tolist()
        if abs(math.atan2(y, x)) > _TURN_RAD and can_turn(costmap, robot, y):
            return _turn_to(y, robot.w_max_radps / 2, costmap, robot)
    return Command(v, v * curvature)


def _regulated_mps(curvature: float, ahead: Floats, costmap: Costmap, robot: Robot) -> float:
    """Return the speed in a curve and near obstacles.

    ahead: (N, 2) next points of the way.
    """
    slow = min(1.0, 1.0 / max(abs(curvature) * MIN_RADIUS_M, 1e-6))
    gap_m = float(costmap.distances(ahead).min()) - robot.width_m / 2
    slow *= float(np.clip(gap_m / SLOW_WITHIN_M, 0.0, 1.0))
    return max(SLOWEST_MPS, robot.cruise_mps * slow)


def _stopping_mps(room_m: float) -> float:
    """Return the speed from which the robot can stop within a distance."""
    return math.sqrt(2.0 * BRAKE_MPS2 * max(room_m, 0.0))


def _turn_to(side: float, w_radps: float, costmap: Costmap, robot: Robot) -> Command:
    """Return a turn on the spot to a side, left positive; STILL without room."""
    return Command(0.0, math.copysign(w_radps, side)) if can_turn(costmap, robot, side) else STILL


def can_turn(costmap: Costmap, robot: Robot, side: float) -> bool:
    """Return whether the robot's corners stay clear in a turn on the spot.

    side: left positive
    """
    ahead, aside = robot.length_m / 2, robot.width_m / 2
    corners = np.array([(ahead, aside), (ahead, -aside), (-ahead, -aside), (-ahead, aside)])
    turn_rad = math.copysign(_TURN_RAD, side) * np.array([0.0, 1.0, 2.0])
    cos, sin = np.cos(turn_rad)[:, None], np.sin(turn_rad)[:, None]
    x, y = corners.T
    turned = np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)
    gaps_m = costmap.distances(turned)
    least_m = np.maximum(np.minimum(gaps_m[0], _CORNER_M), _TOUCH_M)
    return bool((gaps_m[1:] >= least_m).all())


def safe_speed(plan: LocalPlan, movers: Movers, robot: Robot, v_mps: float, patient: bool) -> float:
    """Return the highest of a few speeds at which no moving body is met; 0 if none is safe.

    v_mps: current speed, from which the robot brakes or accelerates.
    patient: False after waiting for long: then less time and smaller gaps count.
    """
    if not len(movers.at):
        return robot.cruise_mps
    speeds = robot.cruise_mps * _SPEEDS
    share = 1.0 if patient else _IMPATIENT
    times_s = np.arange(0.1, share * FORESEEN_S + 0.05, 0.1)
    change_mps = np.clip(
        speeds[:, None] - v_mps, -BRAKE_MPS2 * times_s, robot.acceleration_mps2 * times_s
    )
    driven_m = np.cumsum(v_mps + change_mps, axis=1) * 0.1
    points = points_at(plan.points, driven_m.T)
    gaps_m = movers.gaps_m(points, times_s) - BodyDisks.of(robot).radius_m
    safe = gaps_m.min(axis=0) > share * MOVER_GAP_M
    return float(speeds[np.argmax(safe)]) if safe.any() else 0.0


def points_at(points: Floats, s_m: Floats) -> Floats:
    """Return the (..., 2) points of a way at arc lengths; beyond its end straight on."""
    lengths = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    return np.stack([np.interp(s_m, lengths, points[:, axis]) for axis in (0, 1)], axis=-1)


def point_at(points: Floats, s_m: float) -> Floats:
    """Return the (2,) point of a way at an arc length, or its last one."""
    return points_at(points, np.array(s_m))


def _free_on_arc_m(curvature: float, length_m: float, costmap: Costmap, robot: Robot) -> float:
    """Return the length of an arc until the robot touches something; inf if it does not."""
    disks = BodyDisks.of(robot)
    s_m = np.arange(0.1, length_m + 0.1, 0.1)
    turn = curvature * s_m
    straight = abs(curvature) < 1e-4
    x = s_m if straight else np.sin(turn) / curvature
    y = np.zeros_like(s_m) if straight else (1.0 - np.cos(turn)) / curvature
    ends = disks.nose_m * np.array([1.0, -1.0])
    centres = np.stack([x + ends[:, None] * np.cos(turn), y + ends[:, None] * np.sin(turn)], -1)
    now_m = costmap.distances(np.column_stack([ends, np.zeros(2)]))
    least_m = np.maximum(now_m - NEARER_M, np.minimum(now_m, robot.width_m / 2))
    least_m = np.minimum(least_m, disks.radius_m)
    hits = (costmap.distances(centres) < least_m[:, None]).any(axis=0)
    return float(s_m[np.argmax(hits)]) if hits.any() else math.inf
