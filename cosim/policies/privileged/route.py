"""`route`: privileged baseline that follows the reference route, waits at red and yields.

Lanes parallel to the route are compared at a few speeds. A plan is good if it keeps a clearance to
all people, predicted at constant velocity. A PD controller follows the best lane by the bearing of
a point ahead. Signals and gaps in traffic limit the speed before crossings.
"""

from __future__ import annotations

import math

import numpy as np
import shapely

from cosim.core.geometry import Floats, Polyline, wrap_angle
from cosim.core.state import PERSON_RADIUS_M, Command
from cosim.episode.control import clipped
from cosim.episode.interfaces import Observation, Privileged
from cosim.place.car_paths import STOP_SHORT_M
from cosim.policies.body_disks import BodyDisks
from cosim.spec.manifest import Manifest
from cosim.spec.robot import Robot

_SPEED_THIRDS = np.array([3.0, 2.0, 1.0, 0.0])
"""Speeds to compare, in thirds of the cruising speed; the last is waiting."""

OFFSETS_M = np.array([0.0, 0.35, -0.35, 0.7, -0.7, 1.05, -1.05, 1.4, -1.4])
"""Lateral offsets of the lanes in metres, left positive."""
TIMES_S = np.linspace(0.25, 3.5, 14)
"""Prediction times in seconds."""
SHIFT_M_PER_M = 0.35
"""Lateral metres per metre driven in a lane change."""
SHIFT_AFTER_M = 0.3
"""Metres driven before a lane change has an effect."""

_LOOK_AHEAD_M = 1.2
"""Look-ahead distance in metres."""
GAIN_P_PER_S = 2.4
"""Proportional gain on the bearing in 1/s."""
GAIN_D = 0.12
"""Derivative gain on the bearing."""
BRAKE_MPS2 = 1.2
"""Deceleration in m/s^2 before a crossing."""
CAR_BRAKE_MPS2 = 3.0
"""Assumed deceleration of vehicles in m/s^2."""
HELD_MPS = 0.1
"""Speed in m/s below which the robot has stopped at red, so creeping closer does not start it."""
CAR_RADIUS_M = 1.1
"""Radius in metres of the three disks that represent a vehicle."""

_CLEARANCE_M = 0.3
"""Clearance in metres to people."""
_TIGHT_M = 0.1
"""Clearance in metres after waiting for long."""
OFFSET_COST = 0.25
"""Cost in m/s per metre of offset from the route."""
_CHANGE_COST = 0.5
"""Cost in m/s per metre of lane change."""
_NEARNESS_COST = 15.0
"""Cost in m/s per metre below the clearance."""

_PATIENCE_S = 3.0
"""Seconds of waiting after which smaller clearances are accepted."""
SEEN_M = 11.0
"""Metres within which obstacles are considered."""


class Route:
    """Follows the reference route like a careful pedestrian; privileged."""

    manifest = Manifest("route", version="2", rate_hz=10.0, privileged=True)

    def __init__(self) -> None:
        self.reset("", 0)

    def reset(self, episode_id: str, seed: int) -> None:
        self._offset_m = 0.0
        self._bearing_rad = 0.0
        self._stopped_s = 0.0
        self._last_time_s = 0.0

    def act(self, observation: Observation) -> Command:
        known = observation.privileged
        if known is None:
            raise ValueError("policy route needs privileged state")
        dt_s = max(observation.time_s - self._last_time_s, 1e-3)
        self._last_time_s = observation.time_s

        robot = observation.robot
        limit_mps = min(crossing_limit(known, robot), robot.cruise_mps)
        held = limit_mps < 0.1
        self._stopped_s = 0.0 if observation.v_mps > 0.1 or held else self._stopped_s + dt_s
        self._offset_m, free_mps = best_lane(
            known, robot, self._offset_m, patient=self._stopped_s < _PATIENCE_S
        )

        bearing_rad = bearing_to(known, self._offset_m)
        rate_radps = (bearing_rad - self._bearing_rad) / dt_s
        self._bearing_rad = bearing_rad
        w_radps = GAIN_P_PER_S * bearing_rad + GAIN_D * max(-2.0, min(2.0, rate_radps))
        turning_mps = (
            0.0
            if abs(bearing_rad) > 1.2
            else robot.cruise_mps * (1.0 - abs(bearing_rad) / 1.2) + 0.05
        )
        return clipped(Command(min(limit_mps, free_mps, turning_mps), w_radps), robot)


def bearing_to(known: Privileged, offset_m: float) -> float:
    """Return the bearing, in the robot's frame, of the look-ahead point on a lane.

    offset_m: Lateral offset of the lane, left positive.
    """
    x, y, heading = known.robot.pose
    look_m = _LOOK_AHEAD_M if known.route_s_m + _LOOK_AHEAD_M < known.route.length_m else 0.8
    ahead = known.route.at(min(known.route_s_m + look_m, known.route.length_m))
    lateral_m = lateral_of(known)
    shift_m = SHIFT_M_PER_M * look_m
    lane_m = lateral_m + max(-shift_m, min(shift_m, offset_m - lateral_m))
    target_x = ahead.x_m - lane_m * math.sin(ahead.heading_rad)
    target_y = ahead.y_m + lane_m * math.cos(ahead.heading_rad)
    return wrap_angle(math.atan2(target_y - y, target_x - x) - heading)


def crossing_limit(known: Privileged, robot: Robot) -> float:
    """Return the speed in m/s at which the robot can stop before a crossing it must not enter.

    It stops outside the paths of turning cars.
    """
    half_m = robot.length_m / 2
    crosses_mps = robot.cruise_mps * 13 / 15
    waits_m = known.waits_m or [enter - half_m - STOP_SHORT_M for _, enter, _ in known.crossings]
    for (crossing_id, enter_s_m, leave_s_m), wait_s_m in zip(known.crossings, waits_m, strict=True):
        before_m = enter_s_m - known.route_s_m
        if not 0.0 < before_m < 8.0:
            continue
        needs_s = (before_m + leave_s_m - enter_s_m + half_m) / crosses_mps + 0.5
        signal = known.signals.get(crossing_id)
        if signal is not None:
            may_enter = signal.walk and (
                signal.changes_in_s is None or signal.changes_in_s > needs_s
            )
        else:
            may_enter = not car_coming(known, enter_s_m, leave_s_m)
        waits = before_m > half_m or (signal is not None and known.robot.v_mps < HELD_MPS)
        if not may_enter and waits:
            room_m = wait_s_m - known.route_s_m
            return (
                math.sqrt(2.0 * min(BRAKE_MPS2, robot.acceleration_mps2) * room_m)
                if room_m > 0.05
                else 0.0
            )
    return math.inf


def car_coming(known: Privileged, enter_s_m: float, leave_s_m: float) -> bool:
    """Return whether a vehicle arrives at the crossing soon and cannot stop for a person on it."""
    vehicles = known.vehicles
    if not len(vehicles):
        return False
    middle = known.route.at((enter_s_m + leave_s_m) / 2)
    to_crossing = middle.xy - vehicles.xy
    heading = np.column_stack([np.cos(vehicles.heading), np.sin(vehicles.heading)])
    along_m = (to_crossing * heading).sum(axis=1) - vehicles.size[:, 0] / 2
    aside_m = np.abs(to_crossing[:, 0] * heading[:, 1] - to_crossing[:, 1] * heading[:, 0])
    near = (
        (along_m > -vehicles.size[:, 0])
        & (along_m < 40.0)
        & (aside_m < (leave_s_m - enter_s_m) / 2 + 2.0)
    )
    cannot_stop = along_m - 3.0 < vehicles.speed**2 / (2.0 * CAR_BRAKE_MPS2)
    return bool((near & cannot_stop & (vehicles.speed > 0.5)).any())


def best_lane(
    known: Privileged, robot: Robot, current_m: float, *, patient: bool
) -> tuple[float, float]:
    """Return (offset, speed) of the best lane; speed 0 to wait.

    The fastest plan wins after costs for leaving the route, changing the lane and coming close to
    people. Waiting is evaluated like other plans: it fails if a person walks straight at the robot.

    patient: False after a long wait; then any lane and a smaller clearance are accepted.
    """
    centres, velocities, radii = obstacles(known)
    if not len(centres):
        return 0.0, robot.cruise_mps
    speeds_mps = robot.cruise_mps * _SPEED_THIRDS / 3.0
    paths = plans(known.route, known.route_s_m, lateral_of(known), speeds_mps)
    gaps = smallest_gaps(
        paths, BodyDisks.of(robot), known.robot.pose.heading_rad, centres, velocities, radii
    )
    inside = np.asarray(shapely.contains_xy(known.free, paths[:, 0, :, 0], paths[:, 0, :, 1])).all(
        axis=1
    )
    gaps[~inside & (OFFSETS_M != 0.0), :-1] = -np.inf
    clearance_m, effort_cost = (_CLEARANCE_M, 1.0) if patient else (_TIGHT_M, 0.1)
    effort = OFFSET_COST * np.abs(OFFSETS_M) + _CHANGE_COST * np.abs(OFFSETS_M - current_m)
    score = (
        speeds_mps
        - effort_cost * effort[:, None]
        - _NEARNESS_COST * np.maximum(clearance_m - gaps, 0.0)
    )
    lane, speed = np.unravel_index(int(np.argmax(score)), score.shape)
    return float(OFFSETS_M[lane]), float(speeds_mps[speed])


def lateral_of(known: Privileged) -> float:
    """Return the robot's lateral offset from its route in metres, left positive."""
    near = (known.route_s_m - 3.0, known.route_s_m + 3.0)
    return known.route.project(known.robot.pose.x_m, known.robot.pose.y_m, near)[1]


def obstacles(known: Privileged) -> tuple[Floats, Floats, Floats]:
    """Return disks to avoid: centres (N, 2) m, velocities (N, 2) m/s, radii (N,) m.

    People nearby and not behind; on a crossing also vehicles, three disks each.
    """
    pose = known.robot.pose
    people = known.people
    cars_xy, cars_mps, cars_m = car_disks(known)
    centres = np.concatenate([people.xy, cars_xy])
    walks = (people.speed * np.array([np.cos(people.heading), np.sin(people.heading)])).T
    velocities = np.concatenate([walks, cars_mps])
    radii = np.concatenate([np.full(len(people), PERSON_RADIUS_M), cars_m])
    offset = centres - pose.xy
    forward = np.array([math.cos(pose.heading_rad), math.sin(pose.heading_rad)])
    near = (np.hypot(offset[:, 0], offset[:, 1]) < SEEN_M) & (offset @ forward > -0.2)
    return centres[near], velocities[near], radii[near]


def car_disks(known: Privileged) -> tuple[Floats, Floats, Floats]:
    """Return vehicles as three disks each, as in `obstacles`; empty away from crossings."""
    cars = known.vehicles
    if not any(enter - 3.0 < known.route_s_m < leave for _, enter, leave in known.crossings):
        return np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0)
    along = np.column_stack([np.cos(cars.heading), np.sin(cars.heading)])
    centres = np.concatenate(
        [cars.xy + part * cars.size[:, :1] * along for part in (-0.35, 0.0, 0.35)]
    )
    velocities = np.tile(
        (cars.speed * np.array([np.cos(cars.heading), np.sin(cars.heading)])).T, (3, 1)
    )
    return centres, velocities, np.full(len(centres), CAR_RADIUS_M)


def plans(route: Polyline, s_m: float, lateral_m: float, speeds_mps: Floats) -> Floats:
    """Return predicted positions (lanes, speeds, times, 2) in metres at TIMES_S."""
    driven = speeds_mps[:, None] * TIMES_S
    along = np.minimum(s_m + driven, route.length_m)
    x, y = (
        np.interp(along, route.s_m, route.points[:, 0]),
        np.interp(along, route.s_m, route.points[:, 1]),
    )
    ahead = np.minimum(along + 0.2, route.length_m)
    behind = ahead - 0.4
    dx = np.interp(ahead, route.s_m, route.points[:, 0]) - np.interp(
        behind, route.s_m, route.points[:, 0]
    )
    dy = np.interp(ahead, route.s_m, route.points[:, 1]) - np.interp(
        behind, route.s_m, route.points[:, 1]
    )
    norm = np.maximum(np.hypot(dx, dy), 1e-9)
    shift = SHIFT_M_PER_M * np.maximum(driven - SHIFT_AFTER_M, 0.0)
    lateral = lateral_m + np.clip(OFFSETS_M[:, None, None] - lateral_m, -shift, shift)
    return np.stack([x - lateral * dy / norm, y + lateral * dx / norm], axis=-1)


def smallest_gaps(
    paths: Floats,
    disks: BodyDisks,
    heading_rad: float,
    centres: Floats,
    velocities: Floats,
    radii: Floats,
) -> Floats:
    """Return (lanes, speeds): smallest gap in metres between the body and predicted disks."""
    people = centres + velocities * TIMES_S[:, None, None]
    nose = disks.nose_m * np.array([math.cos(heading_rad), math.sin(heading_rad)])
    gaps = np.full(paths.shape[:2], np.inf)
    for body in (paths + nose, paths - nose):
        away = body[:, :, :, None, :] - people
        gaps = np.minimum(
            gaps, (np.hypot(away[..., 0], away[..., 1]) - radii - disks.radius_m).min(axis=(2, 3))
        )
    return gaps
