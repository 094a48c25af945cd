"""Motion of event pedestrians: event coordinates, turning rate, avoidance.

Event coordinates are metres along the event's heading and metres to the left.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np

from cosim.core.geometry import Pose, wrap_angle
from cosim.core.state import PERSON_RADIUS_M
from cosim.people.steering import Vector
from cosim.people.yielding import (
    ROBOT_STANDS_MPS,
    RobotBody,
    obstacle_body,
    outline_mps,
    reaction_distance_m,
    stepped_around,
    touches,
)
from cosim.spec.events import Event, EventQuery, Walker
from scenarios.events.sight import Sight, avoiding_step, goal_occupied

EDGE_GAP_M = 0.1
"""Gap in metres between a person's shoulder and the edge of the sidewalk."""
TURN_RADPS = math.pi
"""Turning rate of a person in rad/s."""
MIDDLE_M = 0.3
"""Lateral offset in metres up to which a robot counts as driving on the middle."""
SLOW_MPS = 0.3
"""Speed in m/s below which motion does not change a person's heading."""
_SAME_M = 1e-9
"""Metres below which two positions are equal."""
MET_M = 2.5
"""Distance in metres between the centres of a person and a standing robot that have met. People who
come at a robot that stands farther away wait for it to come."""
_LEAD_S = 1.0
"""Time in seconds for which people who walk at the robot expect it to keep its course, at most."""
_WALKS_MPS = 1.3
"""Walking speed in m/s by which they estimate the time until they meet."""
_STANDOFF_M = 0.45
"""Gap in metres before a standing robot at which a person waits."""


def walker_at(event: Event, along_m: float, left_m: float, facing_rad: float) -> Walker:
    """Return a person at event coordinates.

    facing_rad: Heading relative to the event's heading.
    """
    x_m, y_m = world_point(event, along_m, left_m)
    return Walker(x_m=x_m, y_m=y_m, heading_rad=wrap_angle(event.heading_rad + facing_rad))


def world_point(event: Event, along_m: float, left_m: float) -> tuple[float, float]:
    """Convert event coordinates to world metres."""
    cos, sin = math.cos(event.heading_rad), math.sin(event.heading_rad)
    return event.x_m + cos * along_m - sin * left_m, event.y_m + sin * along_m + cos * left_m


def along_m(event: Event, x_m: float, y_m: float) -> float:
    """Return the coordinate of a world point along the event's heading."""
    return math.cos(event.heading_rad) * (x_m - event.x_m) + math.sin(event.heading_rad) * (
        y_m - event.y_m
    )


def left_m(event: Event, x_m: float, y_m: float) -> float:
    """Return the coordinate of a world point to the left of the event's heading."""
    return math.cos(event.heading_rad) * (y_m - event.y_m) - math.sin(event.heading_rad) * (
        x_m - event.x_m
    )


def has_passed(event: Event, walker: Walker, query: EventQuery) -> bool:
    """Return whether a person who comes towards the robot is 1 m behind it along the event."""
    here_m = along_m(event, walker.x_m, walker.y_m)
    return here_m < along_m(event, query.robot_x_m, query.robot_y_m) - 1.0


def edge_m(event: Event) -> float:
    """Return the largest lateral offset at which both shoulders are on the sidewalk."""
    return max(event.half_width_m - PERSON_RADIUS_M - EDGE_GAP_M, 0.0)


def meeting_offset_m(lane_m: float, room_m: float) -> float:
    """Return the lateral offset at which to meet a robot.

    lane_m: The robot's lateral offset at the trigger.
    room_m: Largest offset to either side.
    """
    return max(-room_m, min(room_m, lane_m)) if abs(lane_m) > MIDDLE_M else 0.0


def robot_body(query: EventQuery) -> RobotBody:
    """Return the robot's body from a query."""
    pose = Pose(query.robot_x_m, query.robot_y_m, query.robot_heading_rad)
    return RobotBody(pose, (query.robot_length_m / 2, query.robot_width_m / 2), query.robot_v_mps)


def turn_towards(heading_rad: float, wanted_rad: float, tick_s: float) -> float:
    """Return the heading after turning for one tick at a human rate."""
    error = wrap_angle(wanted_rad - heading_rad)
    return wrap_angle(heading_rad + max(-TURN_RADPS * tick_s, min(TURN_RADPS * tick_s, error)))


def walk_to(
    walker: Walker,
    x_m: float,
    y_m: float,
    speed_mps: float,
    sight: Sight,
    *,
    insisting: bool = False,
) -> Walker:
    """Move one tick towards a point, around people and the robot; exactly onto it when in reach.

    insisting: Approach the point even if it is occupied; otherwise the walker stops near it.
    """
    if not insisting and goal_occupied(walker, (x_m, y_m), sight):
        return walker
    tick_s = sight.query.tick_ms / 1000
    dx, dy = x_m - walker.x_m, y_m - walker.y_m
    far_m = math.hypot(dx, dy)
    share = min(speed_mps * tick_s / max(far_m, 1e-9), 1.0)
    wanted = (x_m, y_m) if share == 1.0 else (walker.x_m + share * dx, walker.y_m + share * dy)
    heading = (
        walker.heading_rad
        if share == 1.0
        else turn_towards(walker.heading_rad, math.atan2(dy, dx), tick_s)
    )
    return step_around(walker, wanted, heading, sight, goal=(x_m, y_m), insisting=insisting)


def walk_on(walker: Walker, heading_rad: float, speed_mps: float, sight: Sight) -> Walker:
    """Move one tick in a direction, around people and the robot."""
    tick_s = sight.query.tick_ms / 1000
    step_m = speed_mps * tick_s
    onward = (
        walker.x_m + math.cos(heading_rad) * step_m,
        walker.y_m + math.sin(heading_rad) * step_m,
    )
    return step_around(walker, onward, turn_towards(walker.heading_rad, heading_rad, tick_s), sight)


def step_around(
    walker: Walker,
    wanted: Vector,
    heading_rad: float,
    sight: Sight,
    goal: Vector | None = None,
    *,
    insisting: bool = False,
) -> Walker:
    """Move one step, changed in turn to avoid people, obstacles and the robot."""
    led = _round_things(
        walker, avoiding_step(walker, wanted, sight, goal, insisting=insisting), sight.query
    )
    if led != wanted:
        heading_rad = heading_after(walker, led, sight)
    x_m, y_m = _round_body(walker, led, robot_body(sight.query))
    return msgspec.structs.replace(walker, x_m=x_m, y_m=y_m, heading_rad=heading_rad)


def _round_things(walker: Walker, wanted: Vector, query: EventQuery) -> Vector:
    """Return where a step to `wanted` (m) ends after avoiding obstacles."""
    for thing in query.standing:
        moved = _round_body(walker, wanted, obstacle_body(thing))
        wanted = wanted if math.dist(wanted, moved) < _SAME_M else moved
    return wanted


def _round_body(walker: Walker, wanted: Vector, body: RobotBody) -> Vector:
    """Return where a step to `wanted` (m) ends after avoiding a body."""
    if math.dist(wanted, body.pose[:2]) >= reaction_distance_m(body):
        return wanted
    start = np.array([[walker.x_m, walker.y_m]])
    x_m, y_m = stepped_around(start, np.array([wanted]), body)[0].tolist()
    return x_m, y_m


def heading_after(walker: Walker, after: Vector, sight: Sight) -> float:
    """Return the heading after a changed step: the direction of motion, or unchanged if blocked."""
    dx, dy = after[0] - walker.x_m, after[1] - walker.y_m
    tick_s = sight.query.tick_ms / 1000
    if math.hypot(dx, dy) < SLOW_MPS * tick_s:
        return walker.heading_rad
    return turn_towards(walker.heading_rad, math.atan2(dy, dx), tick_s)


def aim_at_robot(walker: Walker, query: EventQuery, commit_m: float) -> tuple[Walker, float]:
    """Return the walker and its heading (rad) at the robot, ahead of it by the way to the meeting.

    commit_m: Distance to the robot below which the walker keeps its heading while the robot moves.
    """
    if robot_stands(query):
        walker = msgspec.structs.replace(walker, aim_rad=None)
    if walker.aim_rad is not None:
        return walker, walker.aim_rad
    far_m = distance_m(walker, query)
    lead_m = lead_to_meeting_m(far_m, query)
    dx = query.robot_x_m + lead_m * math.cos(query.robot_heading_rad) - walker.x_m
    dy = query.robot_y_m + lead_m * math.sin(query.robot_heading_rad) - walker.y_m
    heading_rad = math.atan2(dy, dx)
    commits = far_m <= commit_m and not robot_stands(query)
    return msgspec.structs.replace(walker, aim_rad=heading_rad) if commits else walker, heading_rad


def lead_to_meeting_m(far_m: float, query: EventQuery) -> float:
    """Return how far in metres the robot drives until it meets a person who comes towards it."""
    v_mps = max(query.robot_v_mps, 0.0)
    meets_s = max(far_m - query.robot_length_m, 0.0) / (v_mps + _WALKS_MPS)
    return v_mps * min(meets_s, _LEAD_S)


def robots_line_m(event: Event, query: EventQuery, ahead_m: float) -> float:
    """Return the lateral offset (m) of a point ahead of the robot, inside the way."""
    turn_rad = query.robot_heading_rad - event.heading_rad
    line_m = left_m(event, query.robot_x_m, query.robot_y_m) + ahead_m * math.sin(turn_rad)
    return max(-edge_m(event), min(edge_m(event), line_m))


def robot_stands(query: EventQuery) -> bool:
    """Return whether no point of the robot moves."""
    half_m = query.robot_length_m / 2, query.robot_width_m / 2
    return outline_mps(query.robot_v_mps, query.robot_w_radps, half_m) < ROBOT_STANDS_MPS


def waiting_for_robot(event: Event, walker: Walker, query: EventQuery) -> Walker:
    """Return the walker with the ticks counted for which the robot has stood within MET_M of it.

    A robot in contact counts, too. After the event's patience the count is not reset.
    """
    if lost_patience(event, walker, query):
        return walker
    met = robot_stands(query) and distance_m(walker, query) <= MET_M
    blocks = met or touches(np.array([walker.x_m, walker.y_m]), robot_body(query))
    return msgspec.structs.replace(walker, blocked_ticks=walker.blocked_ticks + 1 if blocks else 0)


def lost_patience(event: Event, walker: Walker, query: EventQuery) -> bool:
    """Return whether the robot has blocked a person for as long as the person waits."""
    blocked = walker.blocked_ticks
    return blocked > 0 and blocked * query.tick_ms >= 1000 * event.patience_s


def distance_m(walker: Walker, query: EventQuery) -> float:
    """Return the distance in metres between the centres of a person and the robot."""
    return math.hypot(query.robot_x_m - walker.x_m, query.robot_y_m - walker.y_m)


def come_at_robot(walker: Walker, heading_rad: float, speed_mps: float, sight: Sight) -> Walker:
    """Move one tick straight ahead without avoiding a moving robot, but around people.

    If the robot stands, the walker stops short of it, or stays where it is if they have not met.
    """
    query = sight.query
    if robot_stands(query):
        near = touches(np.array([walker.x_m, walker.y_m]), robot_body(query), _STANDOFF_M)
        if near or distance_m(walker, query) > MET_M:
            return walker
    return walk_straight(walker, heading_rad, speed_mps, sight)


def walk_straight(walker: Walker, heading_rad: float, speed_mps: float, sight: Sight) -> Walker:
    """Move one tick straight ahead without avoiding the robot, but around people.

    A walker in contact with the robot stops. One that avoids people has to aim again.
    """
    if touches(np.array([walker.x_m, walker.y_m]), robot_body(sight.query)):
        return walker
    step_m = speed_mps * sight.query.tick_ms / 1000
    wanted = (
        walker.x_m + math.cos(heading_rad) * step_m,
        walker.y_m + math.sin(heading_rad) * step_m,
    )
    people = sight._replace(robot=())
    x_m, y_m = led = _round_things(walker, avoiding_step(walker, wanted, people), sight.query)
    if led == wanted:
        return msgspec.structs.replace(
            walker, x_m=x_m, y_m=y_m, heading_rad=wrap_angle(heading_rad)
        )
    return msgspec.structs.replace(
        walker, x_m=x_m, y_m=y_m, heading_rad=heading_after(walker, led, sight), aim_rad=None
    )
