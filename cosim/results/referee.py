"""Referee: judges contacts and poses of each Step and returns failures, resets and the end.

Rules (the paper leaves them open; each is a decision of this benchmark):

- collision: the body touches anything but the ground, or its footprint overlaps a person's 0.3 m
  disk or a vehicle's box, at any physics substep. Each thing counts once until it has been away for
  1 s. People and vehicles are away beyond 0.1 m, walls and objects without contact. Two things
  touched in one tick count as two.
- A person who walks into a robot of which no point has moved faster than 0.05 m/s for 1 s is at
  fault. So is one who walks into a robot that has turned on the spot for 1 s, if the person moves
  faster towards the touched point than that point towards the person. Both are recorded
  (`walked_into`) and are no failures. A robot that drives on, or turns a corner into that person,
  has collided.
- out_of_lane: the base centre is outside the walkable area (sidewalks, corners, crossings).
- fall: for 0.1 s a robot with legs was down (`Motion.down`): its trunk leaned by more than 60
  degrees, touched the ground, or was below 0.45 of its height at rest. A fall within 1 s after the
  last contact with a person who walked into the robot is no failure. It is recorded with
  `walked_into`; the robot is reset.
  A collision or fall resets the robot, so that the one that follows from the other is not counted.
- freezing, if the episode does not end on a failure: for 10 s the robot was never 0.5 m away from
  its position at their beginning. Waiting before a red crossing of the route does not count. In a
  short episode waiting only costs time.
- Signals are judged on the crossings of the reference route, by arc length.
- One kind of failure per tick: collisions before out_of_lane before falls before freezing, with one
  reset for all of them.
- The goal is reached within its radius at the end of the route. It is also reached at any arc
  length if walkable ground leads straight to it: the robot skipped a part of the route. If the
  route passes its goal before its end (a loop), only its end counts.
- A robot that is down reaches no goal and makes no stop.
- If an episode ends at a stop (`gesturing`), stopping within 3 m in front of the pedestrian for 2 s
  succeeds. Passing the pedestrian fails.
- After a failure the robot is reset to the nearest free waypoint of the route, heading along it.
  Waypoints are every 5 m, never on a crossing, at an obstacle or at the goal. After 3 failures
  within 10 m of the route, it is reset to the first free waypoint at least 1 m beyond them, or
  between waypoints if none is free.
- After a fall at a person's fault it is reset to the nearest free place of the route that is not
  beyond the fall. Such a fall does not count towards the 3 failures.
- The jump counts neither as travel nor as progress.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from cosim.core.clock import Clock
from cosim.core.geometry import Circle, Floats, Pose, box_disk_gap, boxes_overlap
from cosim.core.state import PERSON_RADIUS_M, STILL, Contact, Signal
from cosim.episode.loop import Reset, Step
from cosim.people.yielding import ROBOT_STANDS_MPS, STOOD_S, outline_mps
from cosim.place.barriers import outline
from cosim.place.street_map import WalkableArea
from cosim.spec.events import Event, EventState
from cosim.spec.obstacle import footprint
from cosim.spec.scenario import Scenario

FALL_S = 0.1
"""Time, seconds, that a robot is down before it has fallen."""
PUSHED_S = 1.0
"""Time, seconds, after contact with a person who walked into the robot in which a fall is the
person's fault."""
_NOT_PUSHED: tuple[float, str] = (-math.inf, "")
"""Tick and id of the last push, of a robot that no person has pushed."""
FREEZE_WINDOW_S = 10.0
"""Time, seconds, in which a robot that moves less than FREEZE_MOVE_M is frozen."""
FREEZE_MOVE_M = 0.5
"""Distance, metres, from the oldest position of the window that a frozen robot never reaches."""
_ROUNDING_M = 1e-6
"""Margin, metres, for rounding of distances."""
_APART_M = 0.1
"""Gap, metres, above which a touched person or vehicle is away."""
APART_S = 1.0
"""Time, seconds, that a touched thing must be away before another contact counts."""
WAYPOINT_STEP_M = 5.0
"""Spacing, metres, of the waypoints for resets."""
FREE_OF_PEOPLE_M = 1.0
"""Least distance, metres, from a reset position to the centre of a person."""
FREE_OF_VEHICLES_M = 4.0
"""Least distance, metres, from a reset position to the centre of a vehicle."""
FREE_OF_OBSTACLES_M = 0.1
"""Least gap, metres, between the circle in which a robot turns on the spot and an obstacle."""
_SAME_PLACE_M = 10.0
"""Length of route, metres, within which repeated failures are at the same place."""
SAME_PLACE_FAILURES = 3
"""Number of failures at the same place after which the robot is reset beyond them."""
_BEYOND_M = 1.0
"""Least distance, metres, of that reset beyond the failures."""
_BETWEEN_M = 0.1
"""Spacing, metres, of reset positions between waypoints: after a fall at a person's fault, and if
no waypoint beyond the failures is free."""
_GOAL_MARGIN_M = 0.2
"""Least distance, metres, between a reset position and the goal's circle."""
RED_WAIT_M = 4.0
"""Distance, metres, before a red crossing of the route within which waiting is lawful."""
STOP_S = 2.0
"""Time, seconds, that the robot must be stopped before a stopping hand."""
STOP_WITHIN_M = 3.0
"""Distance, metres, in front of a stopping hand within which the robot must stop."""
LOOP_MARGIN_M = 0.5
"""Margin, metres, added to the goal's radius when testing whether a route is a loop."""
CROSSING_LEFT_M = 0.3
"""Distance, metres, before a crossing at which the robot has left it and may enter it again."""

FailureKind = Literal["collision", "out_of_lane", "fall", "freezing"]
Ended = Literal["goal", "stop", "timeout", "failure"]
Fault = Literal["robot_at_fault", "pedestrian_at_fault", "shared"]


@dataclass(frozen=True, slots=True)
class Failure:
    """One counted failure.

    other: id of the thing touched
    fault: for pedestrians, which side moved into the other
    """

    kind: FailureKind
    tick: int
    x_m: float
    y_m: float
    route_s_m: float
    robot_speed_mps: float
    other: str = ""
    other_kind: str = ""
    fault: Fault | None = None

    @property
    def suffered(self) -> str:
        """What a person at fault did to the robot, in words before "by"."""
        return "pushed over" if self.kind == "fall" else "walked into"


@dataclass(frozen=True, slots=True)
class Verdict:
    """Judgement of one Step.

    walked_into: contacts and falls at a person's fault, which are no failures
    red_light_entry: crossing that was entered at red, if any
    """

    failures: tuple[Failure, ...] = ()
    walked_into: tuple[Failure, ...] = ()
    reset: Reset | None = None
    ended: Ended | None = None
    red_light_entry: str | None = None
    waits_at_red: bool = False


class Referee:
    """Referee of one episode; judges its Steps in order."""

    def __init__(
        self, scenario: Scenario, area: WalkableArea, footprint_m: tuple[float, float], clock: Clock
    ) -> None:
        self._scenario = scenario
        self._area = area
        self._half_m = (footprint_m[0] / 2, footprint_m[1] / 2)
        self._clock = clock
        self._route = scenario.route_line
        self._obstacles = shapely.union_all(
            [footprint(obstacle) for obstacle in scenario.obstacles]
        )
        self._fences = shapely.union_all([outline(barrier) for barrier in scenario.barriers])
        self._is_round = is_loop(scenario)
        self._limit_ticks = clock.ticks(scenario.time_limit_s)
        self._touching: dict[str, int] = {}
        self._walked_into: set[str] = set()
        self._still_ticks = self._spot_ticks = 0
        self._down_ticks = 0
        self._pushed = _NOT_PUSHED
        self._window = FreezeWindow(clock)
        self._failed_at_s: list[float] = []
        self._entered: set[str] = set()
        self._stopped_ticks = 0
        self._inside = Circle()

    def judge(self, step: Step) -> Verdict:
        """Judge one Step; a failure comes with a reset unless it ends the episode."""
        waits = self._waits_at_red(step)
        red = self._red_light_entry(step)
        contacts = self._contacts(step)
        into = tuple(contact for contact in contacts if contact.fault == "pedestrian_at_fault")
        failures = tuple(contact for contact in contacts if contact.fault != "pedestrian_at_fault")
        fallen = self._fall(step)
        failures = failures or self._out_of_lane(step)
        if fallen is not None and not failures:
            if fallen.fault is None:
                failures = (fallen,)
            else:
                into = (*into, fallen)
                if step.tick + 1 >= self._limit_ticks:
                    return Verdict((), into, None, "timeout", red, waits)
                return Verdict((), into, self._reset(fallen, step), None, red, waits)
        failures = failures or self._freezing(step, waits)
        if not failures:
            return Verdict((), into, None, self._end(step), red, waits)
        if self._scenario.ends_on_failure:
            return Verdict(failures, into, None, "failure", red, waits)
        if step.tick + 1 >= self._limit_ticks:
            return Verdict(failures, into, None, "timeout", red, waits)
        reset = self._reset(failures[0], step)
        return Verdict(failures, into, reset, None, red, waits)

    def _reset(self, failure: Failure, step: Step) -> Reset:
        """Return the reset after a failure or fall, and clear the state from before it."""
        pushed = failure.fault == "pedestrian_at_fault"
        reset = (
            self._reset_after_push(failure, step)
            if pushed
            else self._reset_after_failure(failure, step)
        )
        self._window.clear()
        self._entered.clear()
        self._down_ticks = self._stopped_ticks = 0
        self._pushed = _NOT_PUSHED
        return reset

    def _fall(self, step: Step) -> Failure | None:
        """Return the fall of a robot with legs in a tick."""
        for contact in step.motion.contacts:
            if contact.other in self._walked_into:
                self._pushed = step.tick, contact.other
        self._down_ticks = self._down_ticks + 1 if step.motion.down else 0
        if self._down_ticks <= self._clock.ticks(FALL_S):
            return None
        since, person = self._pushed
        if step.tick - since > self._clock.ticks(PUSHED_S):
            return self._failure("fall", step)
        return self._failure("fall", step, person, "pedestrian", "pedestrian_at_fault")

    def _end(self, step: Step) -> Ended | None:
        """Return how the episode ends with a step without a failure; None if it continues."""
        if step.motion.down:
            self._stopped_ticks = 0
            return "timeout" if step.tick + 1 >= self._limit_ticks else None
        if self._scenario.ends_at == "stop":
            return self._end_by_stop(step)
        pose = step.motion.robot.pose
        if at_goal(
            self._scenario, np.array([pose]), np.array([step.route_s_after_m])
        ).any() or self._goal_straight_ahead(pose):
            return "goal"
        return "timeout" if step.tick + 1 >= self._limit_ticks else None

    def _goal_straight_ahead(self, pose: Pose) -> bool:
        """Return whether the goal is near and straight ahead on walkable ground."""
        if self._is_round or not near_goal(self._scenario, np.array([pose])).any():
            return False
        straight = shapely.LineString([(pose.x_m, pose.y_m), self._scenario.goal])
        return bool(shapely.covers(self._area.polygon, straight)) and not shapely.intersects(
            self._fences, straight
        )

    def _end_by_stop(self, step: Step) -> Ended | None:
        """Return the end of a `gesturing` episode: the robot stopped before the pedestrian or
        passed it."""
        robot = step.motion.robot
        here = any(
            state.phase == "acting" and is_in_front_of_event(robot.pose, event, state)
            for event, state in zip(self._scenario.events, step.events.states, strict=True)
        )
        self._stopped_ticks = (
            self._stopped_ticks + 1 if here and abs(robot.v_mps) < ROBOT_STANDS_MPS else 0
        )
        if self._stopped_ticks >= self._clock.ticks(STOP_S):
            return "stop"
        if all(step.route_s_after_m > event.route_s_m for event in self._scenario.events):
            return "failure"
        return "timeout" if step.tick + 1 >= self._limit_ticks else None

    def _contacts(self, step: Step) -> list[Failure]:
        """Return the contacts that begin in a tick, one per thing."""
        self._forget_distant(step)
        stood, on_spot = self._has_rested(step)
        moves = self._still_ticks == 0
        drives_on = self._walked_into if moves and step.command != STILL else set()
        began: dict[str, Contact] = {}
        for contact in step.motion.contacts:
            if contact.other not in self._touching or (
                contact.other in drives_on
                and (not on_spot or closing_speeds(contact.other, step, self._half_m)[0] > 0.0)
            ):
                began.setdefault(contact.other, contact)
            self._touching[contact.other] = step.tick
        found = []
        for name, contact in began.items():
            fault = (
                fault_of(name, step, self._half_m, stood=stood, on_spot=on_spot)
                if contact.kind == "pedestrian"
                else None
            )
            if fault == "pedestrian_at_fault":
                self._walked_into.add(name)
            else:
                self._walked_into.discard(name)
            found.append(self._failure("collision", step, name, contact.kind, fault))
        return found

    def _has_rested(self, step: Step) -> tuple[bool, bool]:
        """Return whether the robot has stood for STOOD_S, and whether it has stood or turned on the
        spot for as long."""
        v_mps, w_radps = step.robot.v_mps, step.robot.w_radps
        moves = outline_mps(v_mps, w_radps, self._half_m) >= ROBOT_STANDS_MPS
        self._still_ticks = 0 if moves else self._still_ticks + 1
        self._spot_ticks = 0 if abs(v_mps) >= ROBOT_STANDS_MPS else self._spot_ticks + 1
        least = self._clock.ticks(STOOD_S)
        return self._still_ticks >= least, self._spot_ticks >= least

    def _forget_distant(self, step: Step) -> None:
        """Forget contacts with things that have been away for a second."""
        if not self._touching:
            return
        gaps = person_gaps(step, self._half_m)
        near_vehicles = vehicles_within(step, self._half_m, _APART_M)
        for other, last_tick in list(self._touching.items()):
            if gaps.get(other, np.inf) <= _APART_M or other in near_vehicles:
                self._touching[other] = step.tick
            elif (step.tick - last_tick) * self._clock.tick_s > APART_S:
                del self._touching[other]
                self._walked_into.discard(other)

    def _out_of_lane(self, step: Step) -> tuple[Failure, ...]:
        """Return the failure of a base centre outside the walkable area; nothing inside."""
        pose = step.motion.robot.pose
        if self._inside.holds(pose.x_m, pose.y_m):
            return ()
        if not self._area.contains(pose.x_m, pose.y_m):
            return (self._failure("out_of_lane", step),)
        room_m = float(self._area.signed_distance(pose.xy)[0]) - _ROUNDING_M
        self._inside = Circle(pose.x_m, pose.y_m, max(room_m, 0.0))
        return ()

    def _freezing(self, step: Step, waits_at_red: bool) -> tuple[Failure, ...]:
        """Return the failure of a robot that has been frozen; nothing in short episodes."""
        if waits_at_red or self._scenario.ends_on_failure:
            return ()
        x_m, y_m, _ = step.motion.robot.pose
        return (self._failure("freezing", step),) if self._window.update((x_m, y_m)) else ()

    def _waits_at_red(self, step: Step) -> bool:
        """Return whether the robot is within RED_WAIT_M before a red crossing of the route."""
        return any(
            signal_is_red(crossing.id, step.street.signals)
            and -RED_WAIT_M <= step.route_s_after_m - crossing.enter_s_m <= 0.0
            for crossing in self._scenario.crossings
        )

    def _red_light_entry(self, step: Step) -> str | None:
        """Return the id of a crossing that the robot enters at red; None without one."""
        for crossing in self._scenario.crossings:
            inside = crossing.enter_s_m < step.route_s_after_m < crossing.leave_s_m
            if inside and crossing.id not in self._entered:
                self._entered.add(crossing.id)
                if signal_is_red(crossing.id, step.street.signals):
                    return crossing.id
            elif step.route_s_after_m < crossing.enter_s_m - CROSSING_LEFT_M:
                self._entered.discard(crossing.id)
        return None

    def _failure(
        self,
        kind: FailureKind,
        step: Step,
        other: str = "",
        other_kind: str = "",
        fault: Fault | None = None,
    ) -> Failure:
        """Return a failure at the pose and arc length of the end of a step."""
        pose = step.motion.robot.pose
        speed = abs(step.robot.v_mps)
        return Failure(
            kind,
            step.tick,
            pose.x_m,
            pose.y_m,
            step.route_s_after_m,
            speed,
            other,
            other_kind,
            fault,
        )

    @property
    def _last_m(self) -> float:
        """Largest arc length, metres, of a reset before the goal."""
        return max(self._route.length_m - 2 * self._scenario.goal_radius_m, 0.0)

    def _reset_after_push(self, fall: Failure, step: Step) -> Reset:
        """Return the reset after a fall at a person's fault: the nearest free place of the route,
        not beyond the fall."""
        begin_m = min(fall.route_s_m, self._last_m)
        places = np.append(np.arange(begin_m, 0.0, -_BETWEEN_M), 0.0)
        clear = self._clear_of_obstacles(places)
        if (found := self._first_free(clear, step)) is not None:
            return found
        s_m = float(clear[0] if len(clear) else places[0])
        return Reset(self._route.at(s_m), s_m)

    def _reset_after_failure(self, failure: Failure, step: Step) -> Reset:
        """Return the reset after a failure: the nearest free waypoint, or one beyond the last
        failures if all were at the same place."""
        self._failed_at_s.append(failure.route_s_m)
        recent = self._failed_at_s[-SAME_PLACE_FAILURES:]
        stuck = len(recent) == SAME_PLACE_FAILURES and max(recent) - min(recent) <= _SAME_PLACE_M
        count = int(self._route.length_m // WAYPOINT_STEP_M) + 1
        waypoints = np.arange(count, dtype=np.float64) * WAYPOINT_STEP_M
        waypoints = waypoints[waypoints <= self._last_m]
        clear = self._clear_of_obstacles(waypoints)
        waypoints = clear if len(clear) else waypoints
        if stuck:
            self._failed_at_s.clear()
            begin_m = max(recent) + _BEYOND_M
            order = waypoints[waypoints > begin_m]
        else:
            order = waypoints[np.argsort(np.abs(waypoints - failure.route_s_m), kind="stable")]
        if (found := self._first_free(order, step)) is not None:
            return found
        if stuck:
            end_m = self._route.length_m - self._scenario.goal_radius_m - _GOAL_MARGIN_M
            between = self._clear_of_obstacles(np.arange(begin_m, end_m, _BETWEEN_M))
            if (found := self._first_free(between, step)) is not None:
                return found
        s_m = float(waypoints[np.argmin(np.abs(waypoints - failure.route_s_m))])
        return Reset(self._route.at(s_m), s_m)

    def _first_free(self, places: Floats, step: Step) -> Reset | None:
        """Return a reset to the first of these arc lengths, metres, that is free."""
        for s_m in places.tolist():
            pose = self._route.at(s_m)
            if self._is_free(pose, s_m, step):
                return Reset(pose, s_m)
        return None

    def _clear_of_obstacles(self, waypoints: Floats) -> Floats:
        """Return the waypoints at which the robot can turn on the spot between the obstacles."""
        if not self._scenario.obstacles or not len(waypoints):
            return waypoints
        at = shapely.points([self._route.at(s_m).xy for s_m in waypoints.tolist()])
        return waypoints[
            shapely.distance(at, self._obstacles) > math.hypot(*self._half_m) + FREE_OF_OBSTACLES_M
        ]

    def _is_free(self, pose: Pose, s_m: float, step: Step) -> bool:
        """Return whether a reset pose is off the crossings, and clear of people and vehicles."""
        if any(
            c.enter_s_m - self._half_m[0] < s_m < c.leave_s_m + self._half_m[0]
            for c in self._scenario.crossings
        ):
            return False
        people, vehicles = step.street_after.people, step.street_after.vehicles
        if len(people) and np.hypot(*(people.xy - pose.xy).T).min() < FREE_OF_PEOPLE_M:
            return False
        return not (
            len(vehicles) and np.hypot(*(vehicles.xy - pose.xy).T).min() < FREE_OF_VEHICLES_M
        )


class FreezeWindow:
    """Positions of a robot within the last 10 s, without ticks in which it waited lawfully."""

    def __init__(self, clock: Clock) -> None:
        self._at: deque[tuple[float, float]] = deque(maxlen=clock.ticks(FREEZE_WINDOW_S) + 1)

    def update(self, xy: tuple[float, float]) -> bool:
        """Append the position of a tick, metres, and return whether the robot is frozen."""
        self._at.append(xy)
        if len(self._at) < (self._at.maxlen or 0):
            return False
        # Fast path: usually the robot is far from its oldest position.
        if math.dist(self._at[0], xy) > FREEZE_MOVE_M + _ROUNDING_M:
            return False
        track = np.array(self._at)
        return bool(np.hypot(*(track - track[0]).T).max() < FREEZE_MOVE_M)

    def clear(self) -> None:
        """Clear the window after a reset."""
        self._at.clear()


def at_goal(scenario: Scenario, pose: Floats, route_s_m: Floats) -> NDArray[np.bool_]:
    """Return (T,) whether poses (T, 3) with arc lengths (T,) reach the goal at the end of the
    route."""
    last_m = scenario.route_line.length_m - 2 * scenario.goal_radius_m
    reached: NDArray[np.bool_] = near_goal(scenario, pose) & (route_s_m >= last_m)
    return reached


def near_goal(scenario: Scenario, pose: Floats) -> NDArray[np.bool_]:
    """Return (T,) which of (T, 3) poses are within the goal's radius."""
    away_m = np.hypot(pose[:, 0] - scenario.goal[0], pose[:, 1] - scenario.goal[1])
    near: NDArray[np.bool_] = away_m <= scenario.goal_radius_m
    return near


def is_loop(scenario: Scenario) -> bool:
    """Return whether a route is a loop: it passes its own goal before its end."""
    route = scenario.route_line
    last_m = route.length_m - 2 * scenario.goal_radius_m
    before = shapely.LineString([*route.points[route.s_m < last_m], route.at(last_m).xy])
    return before.distance(shapely.Point(scenario.goal)) <= scenario.goal_radius_m + LOOP_MARGIN_M


def is_in_front_of_event(robot: Pose, event: Event, state: EventState) -> bool:
    """Return whether the robot is within STOP_WITHIN_M of a person, on the side it came from."""
    for walker in state.walkers:
        dx, dy = robot.x_m - walker.x_m, robot.y_m - walker.y_m
        behind = dx * math.cos(event.heading_rad) + dy * math.sin(event.heading_rad) > 0.0
        if not behind and math.hypot(dx, dy) <= STOP_WITHIN_M:
            return True
    return False


def signal_is_red(crossing_id: str, signals: Mapping[str, Signal]) -> bool:
    """Return whether a crossing has a signal and it shows red."""
    signal = signals.get(crossing_id)
    return signal is not None and not signal.walk


def person_gaps(step: Step, half_m: tuple[float, float]) -> dict[str, float]:
    """Return the gap in metres from the robot's footprint to each person's disk after a Step."""
    people = step.street_after.people
    pose = step.motion.robot.pose
    if not len(people):
        return {}
    gaps: Floats = box_disk_gap(np.array([pose]), *half_m, people.xy[None])[0] - PERSON_RADIUS_M
    return dict(zip(people.ids, gaps.tolist(), strict=True))


def vehicles_within(step: Step, half_m: tuple[float, float], gap_m: float) -> set[str]:
    """Return ids of the vehicles whose box is within a gap of the robot's outline after a Step."""
    vehicles = step.street_after.vehicles
    pose = step.motion.robot.pose
    if not len(vehicles):
        return set()
    boxes = np.column_stack([vehicles.xy, vehicles.heading])
    near = boxes_overlap(np.array(pose), np.array(half_m) + gap_m, boxes, vehicles.size / 2)
    return {vehicles.ids[i] for i in np.flatnonzero(near)}


def fault_of(
    person: str, step: Step, half_m: tuple[float, float], *, stood: bool, on_spot: bool
) -> Fault:
    """Return which side moved into the other.

    half_m: half length and half width of the robot in metres
    stood: whether the robot was at rest long enough for the person to be at fault
    on_spot: whether it has at most turned on the spot for as long
    """
    if stood:
        return "pedestrian_at_fault"
    robot_mps, person_mps = closing_speeds(person, step, half_m)
    if person_mps <= ROBOT_STANDS_MPS:
        return "robot_at_fault"
    return "pedestrian_at_fault" if on_spot and person_mps > robot_mps else "shared"


def closing_speeds(person: str, step: Step, half_m: tuple[float, float]) -> tuple[float, float]:
    """Return the speeds in m/s at which the robot's nearest point and a person approach each other.

    The first is the point's speed towards the person, the second the person's towards the point.
    Both are 0 if the person is not there. half_m: half length and half width in metres.
    """
    people = step.street.people
    if person not in people.ids:
        return 0.0, 0.0
    i = people.ids.index(person)
    pose, v_mps, w_radps = step.robot.pose, step.robot.v_mps, step.robot.w_radps
    cos, sin = math.cos(pose.heading_rad), math.sin(pose.heading_rad)
    local = np.array([[cos, sin], [-sin, cos]]) @ (people.xy[i] - pose.xy)
    point = np.clip(local, -np.array(half_m), half_m)
    away = local - point if (local != point).any() else local
    away = away / max(float(np.hypot(*away)), _ROUNDING_M)
    point_mps = np.array([v_mps - w_radps * point[1], w_radps * point[0]])
    heading = float(people.heading[i]) - pose.heading_rad
    walk_mps = float(people.speed[i]) * np.array([math.cos(heading), math.sin(heading)])
    return float(point_mps @ away), float(-walk_mps @ away)
