"""`orca`: the reference solver. Sees everybody and the map; anticipates, yields, goes round groups, stops when told.

Each time it acts:

1. what stands (groups are one obstacle) decides on a lane beside the route;
2. what moves bends the velocity towards that lane by ORCA half-planes (`cosim.people.orca`), the robot doing all of the
   avoiding, because people need not;
3. many plans are driven ahead in the head (`foresight`), and the one is taken that comes nearest to that velocity
   while the body stays clear of everybody and inside the walkable area.

Red signals, cars near a crossing and a stopping hand limit the speed so that it comes to rest before them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import shapely
from shapely.geometry import MultiPolygon, Polygon

from cosim.core.geometry import Floats, Polyline, wrap_angles
from cosim.core.state import PERSON_RADIUS_M, Command, People
from cosim.episode.ports import Manifest, Observation, Privileged
from cosim.people.orca import best_velocity, half_plane
from cosim.policies.body import BodyDisks
from cosim.policies.foresight import STEP_S, STEPS, Ahead, Plans, Way, foresee
from cosim.policies.groups import distances, lines, who_stands
from cosim.policies.route import CAR_BRAKE_MPS2, SEEN_M, car_disks, crossing_limit
from cosim.spec.robot import Robot

LANES_M: Final = np.arange(-8, 9) * 0.25
_SPEED_THIRTIETHS: Final = (28, 18, 9)
"""Speeds of plans, in thirtieths of the robot's pace: who foresees so much drives a little slower than that."""
MANOEUVRES: Final = ((0.0, 0.35), (0.0, 0.9), (0.6, 0.9), (1.2, 0.9))
"""Delay in seconds and sideways metres per metre of a change of lanes."""
OUT_OF_A_NOOK: Final = (0.0, 3.0)
"""The same of turning nearly on the spot first, at the slowest speed: past somebody whom it stands right before."""

_HORIZON_S: Final = 3.0
"""ORCA's tau."""

_CLEARANCE_M: Final = 0.3
_TIGHT_M: Final = 0.12
LATER_M_PER_S: Final = 0.04
"""What is foreseen later may come out otherwise: so much nearer a plan may come for each second ahead."""
_NEARNESS_COST: Final = 15.0
TOUCH_COST: Final = 60.0
"""m/s given up per metre nearer than the clearance, and nearer than a hand's breadth."""
CAR_DEEP_M: Final = 0.5
LANE_COST: Final = 0.25
_CHANGE_COST: Final = 0.4
FOLLOWED: Final = 0.6
"""Those who walk the robot's way may stop: they are foreseen so much slower than they walk."""
EDGE_COST: Final = 6.0
"""m/s given up when all of a plan lies outside the walkable area."""
_EDGE_M: Final = 0.06
_PATIENCE_S: Final = 3.0
STUCK_M: Final = 0.5
"""A robot that has not come this far for PATIENCE_S, and was not held, takes tighter ways."""
NEAR_S: Final = 1.2
"""A plan is compared with ORCA's velocity over so long."""
LANE_AHEAD_M: Final = np.arange(0.5, 9.1, 0.5)
LANE_SLOPE: Final = 0.4

STOP_BEFORE_M: Final = 2.0
STOP_BRAKE_MPS2: Final = 0.5


class Weights(NamedTuple):
    """What counts how much: clearance m, m/s of progress, effort of leaving wish and lane, lying off the walkway."""

    clearance_m: float
    progress: float
    effort: float
    edge: float


PATIENT: Final = Weights(_CLEARANCE_M, 0.4, 1.0, EDGE_COST)
STUCK: Final = Weights(_TIGHT_M, 2.5, 0.1, 0.5 * EDGE_COST)


class Orca:
    """Anticipates, yields, goes round groups, stops for a hand: the reference solver; knows what no camera sees."""

    manifest = Manifest("orca", version="1", rate_hz=10.0, camera=None, privileged=True)

    def __init__(self) -> None:
        self.reset("", 0)

    def reset(self, scenario_id: str, seed: int) -> None:
        self._lane_m = 0.0
        self._stuck_s = 0.0
        self._stuck_at = (math.inf, math.inf)
        self._last_time_s = 0.0
        self._way: tuple[Polyline, Way] | None = None
        self._room: tuple[Polygon | MultiPolygon, shapely.Geometry] | None = None

    def act(self, observation: Observation) -> Command:
        known = observation.privileged
        if known is None:
            raise ValueError("the orca policy needs privileged observations")
        dt_s = max(observation.time_s - self._last_time_s, 1e-3)
        self._last_time_s = observation.time_s
        robot = observation.robot
        limit_mps = min(crossing_limit(known, robot), stop_limit(known), speeds_of(robot)[0])
        x_m, y_m, _ = known.robot.pose
        self._stuck_s += dt_s
        if limit_mps < 0.1 or math.dist((x_m, y_m), self._stuck_at) > STUCK_M:
            self._stuck_s, self._stuck_at = 0.0, (x_m, y_m)

        way, room = self._way_of(known), self._room_of(known)
        people = nearby(known)
        ends = lines(people)
        disks = BodyDisks.of(robot)
        aim_m = lane_past(known, disks, way, room, ends, self._lane_m)
        wished = bent(known, robot, way, people, aim_m, limit_mps)
        plans = all_plans(lanes_inside(known, way, room), [min(speed, limit_mps) for speed in speeds_of(robot)])
        ahead, gaps = foreseen(known, robot, way, plans, people, ends)
        weights = PATIENT if self._stuck_s < _PATIENCE_S else STUCK
        out = outside(way, room, ahead, robot.length_m * 2 / 7)
        out = weights.edge * out + _NEARNESS_COST * car_nearness(known, disks, ahead)
        score = self._scores(known, plans, ahead, gaps, wished, aim_m, weights) - out
        best = int(np.argmax(score))
        if plans.speed_mps[best] > 0.0:
            self._lane_m = float(plans.lane_m[best]) if plans.delay_s[best] == 0.0 else self._lane_m
        v_mps, w_radps = ahead.command[best]
        return Command(float(v_mps), float(w_radps))

    def _scores(
        self,
        known: Privileged,
        plans: Plans,
        ahead: Ahead,
        gaps: Floats,
        wished: Floats,
        aim_m: float,
        weights: Weights,
    ) -> Floats:
        """How good each plan is among people, (K,) in m/s of speed."""
        near = max(round(NEAR_S / STEP_S), 1)
        velocity = (ahead.pose[near - 1, :, :2] - known.robot.pose.xy) / (near * STEP_S)
        off_wish = np.hypot(*(velocity - wished).T)
        progress = (ahead.s_m[-1] - known.route_s_m) / (STEPS * STEP_S)
        lanes = LANE_COST * np.abs(plans.lane_m - aim_m) + _CHANGE_COST * np.abs(plans.lane_m - self._lane_m)
        nearness = _NEARNESS_COST * np.maximum(weights.clearance_m - gaps, 0.0)
        touch = TOUCH_COST * np.maximum(0.05 - gaps, 0.0)
        scores: Floats = weights.progress * progress - weights.effort * (off_wish + lanes) - nearness - touch
        return scores

    def _way_of(self, known: Privileged) -> Way:
        if self._way is None or self._way[0] is not known.route:
            self._way = (known.route, Way(known.route))
        return self._way[1]

    def _room_of(self, known: Privileged) -> shapely.Geometry:
        if self._room is None or self._room[0] is not known.free:
            room = shapely.buffer(known.free, -_EDGE_M)
            shapely.prepare(room)
            self._room = (known.free, room)
        return self._room[1]


def nearby(known: Privileged) -> People:
    """Those who matter: near, and not right behind, from where they step round the robot themselves."""
    pose, people = known.robot.pose, known.people
    offset = people.xy - pose.xy
    cos, sin = math.cos(pose.heading_rad), math.sin(pose.heading_rad)
    forward, left = offset @ [cos, sin], offset @ [-sin, cos]
    behind = (forward < -0.3) & ((np.abs(left) < 0.6) | (forward < -2.5))
    near = (np.hypot(offset[:, 0], offset[:, 1]) < 1.5 * SEEN_M) & ~behind
    return people.only(np.flatnonzero(near))


def walks(people: People) -> Floats:
    """(N, 2) m/s: how they walk; those who stand do not."""
    speed = np.where(who_stands(people), 0.0, people.speed)
    velocity: Floats = speed[:, None] * np.column_stack([np.cos(people.heading), np.sin(people.heading)])
    return velocity


def followed(known: Privileged, people: People) -> Floats:
    """`walks`, but slower for those ahead who walk the robot's way."""
    pose, velocity = known.robot.pose, walks(people)
    forward = np.array([math.cos(pose.heading_rad), math.sin(pose.heading_rad)])
    same = ((people.xy - pose.xy) @ forward > 0.3) & (velocity @ forward > 0.7 * people.speed)
    slower: Floats = np.where(same[:, None], FOLLOWED * velocity, velocity)
    return slower


def stop_limit(known: Privileged) -> float:
    """Speed in m/s at which the robot comes to rest before somebody ahead who holds out a stopping hand."""
    pose, people = known.robot.pose, known.people
    limit_mps = math.inf
    for i, doing in enumerate(people.doing):
        dx, dy = people.xy[i] - pose.xy
        far_m = math.hypot(dx, dy)
        off_rad = abs(float(wrap_angles(math.atan2(dy, dx) - pose.heading_rad)))
        if doing == "stop" and far_m < SEEN_M and off_rad < 1.0:
            room_m = far_m - STOP_BEFORE_M
            limit_mps = min(limit_mps, math.sqrt(2.0 * STOP_BRAKE_MPS2 * room_m) if room_m > 0.05 else 0.0)
    return limit_mps


def lane_past(
    known: Privileged, disks: BodyDisks, way: Way, room: shapely.Geometry, ends: Floats, current_m: float
) -> float:
    """The lane beside the route, m to the left, on which the robot best gets past what stands ahead."""
    here = way.lateral(known.robot.pose, known.route_s_m)
    shift = LANE_SLOPE * LANE_AHEAD_M
    lane = here + np.clip(LANES_M[:, None] - here, -shift, shift)
    points = way.place(np.broadcast_to(known.route_s_m + LANE_AHEAD_M, lane.shape), lane)
    gaps = np.full(len(LANES_M), np.inf)
    if len(ends):
        gaps = (distances(points, ends) - PERSON_RADIUS_M - disks.radius_m).min(axis=(1, 2))
    out = ~shapely.contains_xy(room, points[..., 0], points[..., 1])
    out &= known.route_s_m + LANE_AHEAD_M < way.length_m
    cost = LANE_COST * np.abs(LANES_M) + 0.5 * _CHANGE_COST * np.abs(LANES_M - current_m)
    cost += _NEARNESS_COST * np.maximum(_CLEARANCE_M - gaps, 0.0) + EDGE_COST * out.mean(axis=1)
    return float(LANES_M[int(np.argmin(cost))])


def bent(known: Privileged, robot: Robot, way: Way, people: People, aim_m: float, limit_mps: float) -> Floats:
    """The velocity (2,) towards the lane, bent so that nobody who walks is met within HORIZON_S."""
    state = known.robot
    here = way.lateral(state.pose, known.route_s_m)
    lane_m = here + max(-1.0, min(1.0, aim_m - here))
    ahead = way.place(np.array(known.route_s_m + 2.0), np.array(lane_m)) - state.pose.xy
    wish = limit_mps * ahead / max(float(np.hypot(*ahead)), 1e-9)
    mine = state.v_mps * np.array([math.cos(state.pose.heading_rad), math.sin(state.pose.heading_rad)])
    radius_m = BodyDisks.of(robot).around_m + PERSON_RADIUS_M + _TIGHT_M
    planes = [
        half_plane(xy - state.pose.xy, mine, velocity, radius_m, _HORIZON_S, 1.0, 0.5)
        for xy, velocity, still in zip(people.xy, walks(people), who_stands(people), strict=True)
        if not still
    ]
    return best_velocity(planes, wish, speeds_of(robot)[0])


def lanes_inside(known: Privileged, way: Way, room: shapely.Geometry) -> Floats:
    """The lanes that are walkable somewhere in the next metres, and the route itself."""
    along, lane = np.meshgrid(known.route_s_m + np.array([0.5, 1.5, 3.0, 5.0]), LANES_M)
    points = way.place(along, lane)
    inside = np.asarray(shapely.contains_xy(room, points[..., 0], points[..., 1])).any(axis=1)
    lanes: Floats = LANES_M[inside | (LANES_M == 0.0)]
    return lanes


def speeds_of(robot: Robot) -> list[float]:
    """The speeds of plans, m/s, the fastest first."""
    return [robot.cruise_mps * part / 30 for part in _SPEED_THIRTIETHS]


def all_plans(lanes: Floats, speeds: Sequence[float]) -> Plans:
    """Every lane at every speed in every manner, and waiting."""
    rows = [(lane, speed, slope, delay) for lane in lanes for speed in speeds for delay, slope in MANOEUVRES]
    rows += [(lane, speeds[-1], OUT_OF_A_NOOK[1], OUT_OF_A_NOOK[0]) for lane in lanes]
    rows.append((0.0, 0.0, MANOEUVRES[0][1], 0.0))
    return Plans(*np.array(rows).T)


def foreseen(
    known: Privileged, robot: Robot, way: Way, plans: Plans, people: People, ends: Floats
) -> tuple[Ahead, Floats]:
    """What becomes of the plans, and the smallest gap (K,) m of each between the body and anybody."""
    moving = ~who_stands(people)
    xy, velocity = people.xy[moving], followed(known, people)[moving]
    state, disks = known.robot, BodyDisks.of(robot)
    ahead = foresee(way, plans, robot, state.pose, known.route_s_m, (state.v_mps, state.w_radps), xy, velocity)
    gaps = np.full(ahead.s_m.shape, np.inf)
    for body in bodies(ahead, disks):
        if len(xy):
            away = ahead.people - body[:, :, None]
            apart = np.sqrt(np.einsum("...i,...i", away, away)) - PERSON_RADIUS_M
            gaps = np.minimum(gaps, apart.min(axis=-1) - disks.radius_m)
        if len(ends):
            gaps = np.minimum(gaps, (distances(body, ends) - PERSON_RADIUS_M - disks.radius_m).min(axis=-1))
    later = LATER_M_PER_S * STEP_S * np.arange(1, STEPS + 1)[:, None]
    return ahead, (gaps + later).min(axis=0)


def bodies(ahead: Ahead, disks: BodyDisks) -> tuple[Floats, Floats]:
    """(STEPS, K, 2) m each: the middles of the two disks of the body."""
    heading = ahead.pose[..., 2]
    nose = disks.nose_m * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    return ahead.pose[..., :2] + nose, ahead.pose[..., :2] - nose


def car_nearness(known: Privileged, disks: BodyDisks, ahead: Ahead) -> Floats:
    """(K,) m: how much nearer than the clearance each plan comes to vehicles that brake for it, at most CAR_DEEP_M.

    Who enters a crossing only when every car near can still stop (`crossing_limit`) may count on their stopping; what
    remains is to keep away from where they do. All plans near a car being bad must not hide how bad each is to people.
    """
    xy, velocity, radii = car_disks(known)
    if not len(xy):
        return np.zeros(ahead.s_m.shape[1])
    speed = np.maximum(np.hypot(velocity[:, 0], velocity[:, 1]), 1e-9)
    time_s = STEP_S * np.arange(1, STEPS + 1)[:, None]
    braked_s = np.minimum(time_s, speed / CAR_BRAKE_MPS2)
    driven_m = speed * braked_s - 0.5 * CAR_BRAKE_MPS2 * braked_s**2
    cars = xy + driven_m[..., None] * (velocity / speed[:, None])
    gaps = np.full(ahead.s_m.shape, np.inf)
    for body in bodies(ahead, disks):
        away = cars[:, None] - body[:, :, None]
        apart = np.sqrt(np.einsum("...i,...i", away, away)) - radii
        gaps = np.minimum(gaps, apart.min(axis=-1) - disks.radius_m)
    nearness: Floats = np.clip(_CLEARANCE_M - gaps.min(axis=0), 0.0, CAR_DEEP_M)
    return nearness


def outside(way: Way, room: shapely.Geometry, ahead: Ahead, nose_m: float) -> Floats:
    """(K,) the share of each plan whose base centre, or a point `nose_m` before it, lies outside the walkable area,
    what is near weighing most."""
    pose = ahead.pose[::2]
    nose = pose[..., :2] + nose_m * np.stack([np.cos(pose[..., 2]), np.sin(pose[..., 2])], axis=-1)
    out = ~shapely.contains_xy(room, pose[..., 0], pose[..., 1]) | ~shapely.contains_xy(
        room, nose[..., 0], nose[..., 1]
    )
    out &= ahead.s_m[::2] < way.length_m
    weight = np.linspace(1.5, 0.5, len(out))
    share: Floats = (out * weight[:, None]).mean(axis=0)
    return share
