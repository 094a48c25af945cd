"""`orca`: the oracle. Predicts people, yields, avoids groups and obstacles, obeys gestures.

It knows what no camera shows: positions and velocities of all people, what they are doing, the free
area and signal timing. Future motion is predicted at constant velocity (`people_prediction`).

`route_planner` leads the path around permanent obstacles. Each action has three steps:

1. Choose a lane parallel to that path around standing people; a group is one obstacle.
2. Adjust the velocity towards that lane by ORCA half-planes (`cosim.people.orca`) of moving people.
The robot does all of the avoiding.
3. Roll out many plans (`rollout`), and take the one closest to that velocity that keeps clear of
people and stays on the free area (`DistanceField`).

The robot limits its speed to stop before red signals, vehicles near a crossing, gestures and the
crowd directly ahead. Before a crossing it waits where no car turns. It stops for people who walk at
it or across its path, because people walk around a standing robot. If a green phase is too short,
it approaches slowly.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar, Final, NamedTuple

import numpy as np

from cosim.core.geometry import Floats, Polyline, wrap_angles
from cosim.core.state import DIRECTED, PERSON_RADIUS_M, Command, People
from cosim.episode.interfaces import Observation, Privileged
from cosim.people.orca import best_velocity, half_plane
from cosim.place.car_paths import STOP_SHORT_M
from cosim.policies.body_disks import BodyDisks
from cosim.policies.privileged.people_prediction import (
    Yielding,
    bodies,
    gaps_to_people,
    predicted_velocities,
)
from cosim.policies.privileged.rollout import (
    STEP_S,
    STEP_TIMES_S,
    STEPS,
    Plans,
    Rollout,
    SampledPath,
    roll_out,
)
from cosim.policies.privileged.route import (
    CAR_BRAKE_MPS2,
    SEEN_M,
    car_disks,
    crossing_limit,
)
from cosim.policies.privileged.route_planner import DistanceField, RoutePlanner
from cosim.policies.privileged.standing_groups import distances, is_standing, lines
from cosim.spec.manifest import Manifest
from cosim.spec.robot import Robot

LANES_M: Final = np.arange(-8, 9) * 0.25
"""Lateral offsets of the lanes in metres, left positive."""
_SPEED_THIRTIETHS: Final = (28, 18, 9)
"""Speeds of plans in thirtieths of the cruising speed; the fastest is slightly below it."""
MANOEUVRES: Final = ((0.0, 0.35), (0.0, 0.9), (0.6, 0.9), (1.2, 0.9))
"""Lane changes: delay in seconds, and lateral metres per metre."""
TURN_IN_PLACE_PLAN: Final = (0.0, 3.0)
"""Lane change that turns almost on the spot first, to get past a person directly ahead."""

_HORIZON_S: Final = 3.0
"""ORCA's time horizon tau in seconds."""

_CLEARANCE_M: Final = 0.3
"""Clearance in metres to people and vehicles."""
_TIGHT_M: Final = 0.12
"""Clearance in metres if the robot is stuck."""
_NEARNESS_COST: Final = 15.0
"""Cost in m/s per metre below the clearance."""
TOUCH_COST: Final = 60.0
"""Cost in m/s per metre below 5 cm."""
CAR_DEEP_M: Final = 0.5
"""Largest violation of the clearance to vehicles in metres that is counted."""
LANE_COST: Final = 0.25
"""Cost in m/s per metre of difference to the chosen lane."""
_CHANGE_COST: Final = 0.4
"""Cost in m/s per metre of lane change."""
EDGE_COST: Final = 6.0
"""Cost in m/s of a plan that is entirely outside the walkable area."""
_EDGE_M: Final = 0.06
"""Distance in metres to the edge below which a point is outside."""
_SOLID_M: Final = 0.05
"""Distance in metres to the edge below which a corner of the body may touch an obstacle."""
_SOLID_COST: Final = 60.0
"""Cost in m/s per metre that the body gets deeper into obstacles."""
_DEEP_M: Final = 0.4
"""Largest such depth in metres that is counted."""
_SOON: Final = 5
"""Number of steps (of two STEP_S) checked against obstacles; later ones are planned again."""
_JUMP_M: Final = 1.0
"""Metres between two actions above which the robot was moved."""
_STRAYED_M: Final = 2.6
"""Lateral offset in metres above which the path is planned again."""
_PAST_END_M: Final = 0.05
"""Metres before the end of the path at which the robot has missed the goal and replans."""
_PATIENCE_S: Final = 3.0
"""Seconds without progress after which the robot is stuck."""
_AT_REST_MPS: Final = 0.3
"""Speed in m/s below which the robot is at rest."""
_LED_ANEW_S: Final = 1.6
"""Seconds without progress after which the path is planned again around standing people."""
STUCK_M: Final = 0.5
"""Metres that count as progress."""
NEAR_S: Final = 1.2
"""Seconds over which a plan is compared with ORCA's velocity."""
LANE_AHEAD_M: Final = np.arange(0.5, 9.1, 0.5)
"""Distances ahead in metres at which lanes are checked for standing people."""
LANE_SLOPE: Final = 0.4
"""Lateral metres per metre of the lanes in that check."""

_STANDS_AT_WALK_S: Final = 6.0
"""Seconds before red at which a robot too late for green arrives at the crossing."""

_REACTS_S: Final = 0.25
"""Reaction time in seconds in the speed limit for a crowd."""
_AHEAD: Final = 0.3
"""Cosine above which a person of the crowd is ahead."""
_CREEPS_MPS: Final = 0.15
"""Lower bound in m/s of the speed limit for a crowd."""

STOP_BEFORE_M: Final = 2.0
"""Metres before a stopping gesture at which the robot stops."""
STOP_BRAKE_MPS2: Final = 0.5
"""Deceleration in m/s^2 before a stopping gesture."""


class Weights(NamedTuple):
    """Weights of the scoring.

    clearance_m: Required gap in metres.
    progress: Weight of the progress in m/s.
    effort: Weight of the difference to the wanted velocity and lane.
    edge: Cost in m/s of being outside the walkable area.
    """

    clearance_m: float
    progress: float
    effort: float
    edge: float


PATIENT: Final = Weights(_CLEARANCE_M, 0.4, 1.0, EDGE_COST)
"""Weights while the robot makes progress."""
STUCK: Final = Weights(_TIGHT_M, 2.5, 0.1, 0.5 * EDGE_COST)
"""Weights after `_PATIENCE_S` without progress: tighter paths are accepted."""


class PathState(NamedTuple):
    """Path to the goal, the robot's arc length on it, and the distance field."""

    way: SampledPath
    s_m: float
    clearance: DistanceField


class Orca:
    """Oracle that predicts, yields, avoids groups and obeys gestures; privileged."""

    manifest = Manifest("orca", version="5", rate_hz=5.0, camera=None, privileged=True)
    patient: ClassVar[bool] = True
    """Whether it waits out of caution, up to `_PATIENCE_S`, where a tighter plan would move."""

    def __init__(self) -> None:
        self.reset("", 0)

    def reset(self, episode_id: str, seed: int) -> None:
        self._lane_m = 0.0
        self._stuck_s = 0.0
        self._yielding = Yielding()
        self._led_anew_s = _LED_ANEW_S
        self._stuck_at = (math.inf, math.inf)
        self._last_time_s = 0.0
        self._here: PathState | None = None
        self._guide: tuple[Polyline, RoutePlanner] | None = None
        self._line = Polyline([(0.0, 0.0), (1.0, 0.0)])
        self._was = (math.inf, math.inf)

    def act(self, observation: Observation) -> Command:
        known = observation.privileged
        if known is None:
            raise ValueError(f"policy {self.manifest.name} needs privileged state")
        dt_s = max(observation.time_s - self._last_time_s, 1e-3)
        self._last_time_s = observation.time_s
        robot = observation.robot
        crossing_mps = crossing_limit(known, robot)
        rolls_up_mps = short_green_limit(known, robot, crossing_mps)
        limit_mps = min(crossing_mps, rolls_up_mps, gesture_limit(known), speeds_of(robot)[0])
        if self._yielding.waits(known, observation.time_s):
            limit_mps = 0.0
        x_m, y_m, _ = known.robot.pose
        self._stuck_s += dt_s
        if limit_mps < 0.1 or math.dist((x_m, y_m), self._stuck_at) > STUCK_M:
            self._stuck_s = 0.0
            self._stuck_at = (x_m, y_m)
            self._led_anew_s = _LED_ANEW_S

        limit_mps = min(limit_mps, crowd_limit(known, robot))
        people = nearby(known)
        ends = lines(people)
        here = self._find(known, ends)
        disks = BodyDisks.of(robot)
        aim_m = best_lane_past(known, disks, here, ends, self._lane_m)
        wished = orca_velocity(known, robot, here, people, aim_m, limit_mps)
        plans = all_plans(lanes_inside(here), [min(speed, limit_mps) for speed in speeds_of(robot)])
        state = known.robot
        ahead = roll_out(here.way, plans, robot, state.pose, here.s_m, (state.v_mps, state.w_radps))
        gaps = gaps_to_people(known, robot, ahead, people, ends)
        weights = PATIENT if self._stuck_s < _PATIENCE_S else STUCK
        out, deeper = outside_area(known, here, ahead, axis_points(robot))
        near_cars = vehicle_violation(known, disks, ahead)

        def best_plan(weights: Weights) -> int:
            cost = weights.edge * out + _SOLID_COST * deeper + _NEARNESS_COST * near_cars
            score = self._scores(known, here, plans, ahead, gaps, wished, aim_m, weights) - cost
            return int(np.argmax(score))

        best = best_plan(weights)
        may_drive = limit_mps >= 0.1 and abs(state.v_mps) < _AT_REST_MPS
        if not self.patient and may_drive and plans.speed_mps[best] == 0.0:
            best = best_plan(STUCK)
        if plans.speed_mps[best] > 0.0:
            self._lane_m = float(plans.lane_m[best]) if plans.delay_s[best] == 0.0 else self._lane_m
        v_mps, w_radps = ahead.command[:, best]
        return Command(float(v_mps), float(w_radps))

    def _scores(
        self,
        known: Privileged,
        here: PathState,
        plans: Plans,
        ahead: Rollout,
        gaps: Floats,
        wished: Floats,
        aim_m: float,
        weights: Weights,
    ) -> Floats:
        """Return (K,) scores of the plans in m/s."""
        near = max(round(NEAR_S / STEP_S), 1)
        velocity = (ahead.pose[near - 1, :2].T - known.robot.pose.xy) / (near * STEP_S)
        off_wish = np.hypot(*(velocity - wished).T)
        progress = (ahead.s_m[-1] - here.s_m) / (STEPS * STEP_S)
        lanes = LANE_COST * np.abs(plans.lane_m - aim_m) + _CHANGE_COST * np.abs(
            plans.lane_m - self._lane_m
        )
        nearness = _NEARNESS_COST * np.maximum(weights.clearance_m - gaps, 0.0)
        touch = TOUCH_COST * np.maximum(0.05 - gaps, 0.0)
        scores: Floats = (
            weights.progress * progress - weights.effort * (off_wish + lanes) - nearness - touch
        )
        return scores

    def _find(self, known: Privileged, ends: Floats) -> PathState:
        """Return the robot's position on its path.

        The path is planned again if the robot was moved or strayed, or if standing people block it.
        """
        x_m, y_m, _ = known.robot.pose
        if self._guide is None or self._guide[0] is not known.route:
            clearance = DistanceField(known.free, known.route)
            self._guide = (known.route, RoutePlanner(clearance, known.route))
            self._here = None
        here = self._here
        jumped = math.dist(self._was, (x_m, y_m)) > _JUMP_M
        self._was = x_m, y_m
        blocked = self._stuck_s > self._led_anew_s and len(ends) > 0
        if blocked:
            self._guide[1].search(ends)
            self._led_anew_s = self._stuck_s + _PATIENCE_S
        if not blocked and here is not None and not jumped:
            s_m, lateral_m = self._line.project(x_m, y_m, (here.s_m - 2.0, here.s_m + 3.0))
            if abs(lateral_m) < _STRAYED_M and s_m < here.way.length_m - _PAST_END_M:
                self._here = here._replace(s_m=s_m)
                return self._here
        guide = self._guide[1]
        self._line = guide.path_from(known.robot.pose.xy)
        self._lane_m = 0.0
        self._here = PathState(
            SampledPath(self._line), self._line.project(x_m, y_m)[0], guide.clearance
        )
        return self._here


def nearby(known: Privileged) -> People:
    """Return people nearby, except those directly behind, who avoid the robot themselves."""
    pose = known.robot.pose
    people = known.people
    offset = people.xy - pose.xy
    cos, sin = math.cos(pose.heading_rad), math.sin(pose.heading_rad)
    forward = offset @ [cos, sin]
    left = offset @ [-sin, cos]
    behind = (forward < -0.3) & ((np.abs(left) < 0.6) | (forward < -2.5))
    near = (np.hypot(offset[:, 0], offset[:, 1]) < 1.5 * SEEN_M) & ~behind
    return people.only(np.flatnonzero(near))


def short_green_limit(known: Privileged, robot: Robot, crossing_mps: float) -> float:
    """Return the speed in m/s at which to approach a crossing whose green phase is too short.

    crossing_mps: The robot's `crossing_limit`.
    """
    for crossing_id, enter_s_m, _ in known.crossings:
        room_m = enter_s_m - known.route_s_m - (robot.length_m / 2 + STOP_SHORT_M)
        signal = known.signals.get(crossing_id)
        if (
            not 0.0 < room_m < 8.0
            or signal is None
            or not signal.walk
            or signal.changes_in_s is None
        ):
            continue
        if math.isfinite(crossing_mps) and signal.changes_in_s > _STANDS_AT_WALK_S:
            return room_m / (signal.changes_in_s - _STANDS_AT_WALK_S)
    return math.inf


def crowd_limit(known: Privileged, robot: Robot) -> float:
    """Return the speed in m/s at which the robot can stop before any person of the crowd ahead."""
    pose = known.robot.pose
    people = known.people
    offset = (people.xy - pose.xy)[~people.are(*DIRECTED)]
    cos, sin = math.cos(pose.heading_rad), math.sin(pose.heading_rad)
    local = offset @ np.array([[cos, -sin], [sin, cos]])
    half = np.array(robot.footprint_m) / 2
    away = local - np.clip(local, -half, half)
    far = np.hypot(away[:, 0], away[:, 1])
    ahead = away[:, 0] / np.maximum(far, 1e-9)
    rows = ahead > _AHEAD
    if not rows.any():
        return math.inf
    room_m = np.maximum(far[rows] - PERSON_RADIUS_M, 0.0)
    brake_mps2 = 0.8 * robot.acceleration_mps2
    reacted_mps = _REACTS_S * brake_mps2
    speed = (np.sqrt(reacted_mps**2 + 2.0 * brake_mps2 * room_m) - reacted_mps) / ahead[rows]
    return max(float(speed.min()), _CREEPS_MPS)


def gesture_limit(known: Privileged) -> float:
    """Return the speed in m/s at which the robot can stop before a stopping gesture."""
    pose = known.robot.pose
    people = known.people
    limit_mps = math.inf
    for i, doing in enumerate(people.doing):
        dx, dy = people.xy[i] - pose.xy
        far_m = math.hypot(dx, dy)
        off_rad = abs(float(wrap_angles(math.atan2(dy, dx) - pose.heading_rad)))
        if doing == "stop" and far_m < SEEN_M and off_rad < 1.0:
            room_m = far_m - STOP_BEFORE_M
            limit_mps = min(
                limit_mps, math.sqrt(2.0 * STOP_BRAKE_MPS2 * room_m) if room_m > 0.05 else 0.0
            )
    return limit_mps


def best_lane_past(
    known: Privileged, disks: BodyDisks, here: PathState, ends: Floats, current_m: float
) -> float:
    """Return the lateral offset in metres of the best lane past standing people."""
    way, s_m, clearance = here
    beside = way.lateral(known.robot.pose, s_m)
    shift = LANE_SLOPE * LANE_AHEAD_M
    lane = beside + np.clip(LANES_M[:, None] - beside, -shift, shift)
    points = way.place(np.broadcast_to(s_m + LANE_AHEAD_M, lane.shape), lane)
    gaps = np.full(len(LANES_M), np.inf)
    if len(ends):
        gaps = (distances(points, ends) - PERSON_RADIUS_M - disks.radius_m).min(axis=(1, 2))
    out = (clearance.at(points) < _EDGE_M) & (s_m + LANE_AHEAD_M < way.length_m)
    cost = LANE_COST * np.abs(LANES_M) + 0.5 * _CHANGE_COST * np.abs(LANES_M - current_m)
    cost += _NEARNESS_COST * np.maximum(_CLEARANCE_M - gaps, 0.0) + EDGE_COST * out.mean(axis=1)
    return float(LANES_M[int(np.argmin(cost))])


def orca_velocity(
    known: Privileged, robot: Robot, here: PathState, people: People, aim_m: float, limit_mps: float
) -> Floats:
    """Return the velocity (2,) towards the lane without collisions within _HORIZON_S."""
    state = known.robot
    beside = here.way.lateral(state.pose, here.s_m)
    lane_m = beside + max(-1.0, min(1.0, aim_m - beside))
    ahead = here.way.place(np.array(here.s_m + 2.0), np.array(lane_m)) - state.pose.xy
    wish = limit_mps * ahead / max(float(np.hypot(*ahead)), 1e-9)
    mine = state.v_mps * np.array(
        [math.cos(state.pose.heading_rad), math.sin(state.pose.heading_rad)]
    )
    radius_m = BodyDisks.of(robot).around_m + PERSON_RADIUS_M + _TIGHT_M
    planes = [
        half_plane(xy - state.pose.xy, mine, velocity, radius_m, _HORIZON_S, 1.0, 0.5)
        for xy, velocity, still in zip(
            people.xy, predicted_velocities(people), is_standing(people), strict=True
        )
        if not still
    ]
    return best_velocity(planes, wish, speeds_of(robot)[0])


def lanes_inside(here: PathState) -> Floats:
    """Return the lanes that are partly inside the free area ahead, and the path itself."""
    along, lane = np.meshgrid(here.s_m + np.array([0.5, 1.5, 3.0, 5.0]), LANES_M)
    inside = (here.clearance.at(here.way.place(along, lane)) > _EDGE_M).any(axis=1)
    lanes: Floats = LANES_M[inside | (LANES_M == 0.0)]
    return lanes


def speeds_of(robot: Robot) -> list[float]:
    """Return the speeds of plans in m/s, the fastest first."""
    return [robot.cruise_mps * part / 30 for part in _SPEED_THIRTIETHS]


def all_plans(lanes: Floats, speeds: Sequence[float]) -> Plans:
    """Return the plans: every lane at every speed with every manoeuvre, and waiting."""
    rows = [
        (lane, speed, slope, delay)
        for lane in lanes
        for speed in speeds
        for delay, slope in MANOEUVRES
    ]
    rows += [(lane, speeds[-1], TURN_IN_PLACE_PLAN[1], TURN_IN_PLACE_PLAN[0]) for lane in lanes]
    rows.append((0.0, 0.0, MANOEUVRES[0][1], 0.0))
    return Plans(*np.array(rows).T)


def vehicle_violation(known: Privileged, disks: BodyDisks, ahead: Rollout) -> Floats:
    """Return (K,) in metres: by how much each plan violates the clearance to braking vehicles.

    At most CAR_DEEP_M, so that people are still compared when all plans are near a vehicle.
    `crossing_limit` lets the robot enter only if all vehicles can stop, so only the places where
    they stop are avoided.
    """
    xy, velocity, radii = car_disks(known)
    if not len(xy):
        return np.zeros(ahead.s_m.shape[1])
    speed = np.maximum(np.hypot(velocity[:, 0], velocity[:, 1]), 1e-9)
    braked_s = np.minimum(STEP_TIMES_S[:, None], speed / CAR_BRAKE_MPS2)
    driven_m = speed * braked_s - 0.5 * CAR_BRAKE_MPS2 * braked_s**2
    cars = xy + driven_m[..., None] * (velocity / speed[:, None])
    gaps = np.full(ahead.s_m.shape, np.inf)
    for x, y in bodies(ahead, disks):
        apart = (
            np.hypot(cars[:, None, :, 0] - x[..., None], cars[:, None, :, 1] - y[..., None]) - radii
        )
        gaps = np.minimum(gaps, apart.min(axis=-1) - disks.radius_m)
    nearness: Floats = np.clip(_CLEARANCE_M - gaps.min(axis=0), 0.0, CAR_DEEP_M)
    return nearness


def axis_points(robot: Robot) -> list[float]:
    """Return the points on the robot's axis that are checked against obstacles.

    Metres ahead of the base centre. Disks around them, _SOLID_M larger than half the width of the
    robot, cover its outline, and the legs in motion.
    """
    radius_m = robot.width_m / 2 + _SOLID_M
    nose_m, between_m = robot.length_m * 2 / 7, math.inf
    for length_m, width_m in (robot.footprint_m, robot.drive.stride_m):
        covered_m = math.sqrt(max(radius_m**2 - (width_m / 2) ** 2, _SOLID_M**2))
        nose_m = max(nose_m, length_m / 2 - covered_m)
        between_m = min(between_m, 2.0 * covered_m)
    count = math.ceil(nose_m / between_m)
    return [nose_m * (k / count) for k in range(-count, count + 1)]


def outside_area(
    known: Privileged, here: PathState, ahead: Rollout, axis_m: Sequence[float]
) -> tuple[Floats, Floats]:
    """Return how far each plan leaves the free area.

    axis_m: Points checked, as of `axis_points`.
    Returns: (K,) weighted fraction of the plan outside the free area, where early steps weigh most;
        and (K,) metres that the body soon gets deeper into obstacles.
    """
    present = np.array(known.robot.pose)[:, None]
    pose = np.concatenate([np.broadcast_to(present, (1, *ahead.pose.shape[1:])), ahead.pose[::2]])
    along = np.stack([np.cos(pose[:, 2]), np.sin(pose[:, 2])], axis=-1)
    middle = np.stack([pose[:, 0], pose[:, 1]], axis=-1)
    room = here.clearance.at(np.stack([middle + one_m * along for one_m in axis_m]))
    room[:, 1:][:, ahead.s_m[::2] >= here.way.length_m] = np.inf
    off = room[1:, 1:].min(axis=0) < _EDGE_M
    body = room.min(axis=0)
    share: Floats = (off * np.linspace(1.5, 0.5, len(body) - 1)[:, None]).mean(axis=0)
    deeper = np.minimum(body[0], _SOLID_M) - body[1 : 1 + _SOON].min(axis=0)
    return share, np.clip(deeper, 0.0, _DEEP_M)
