"""How event pedestrians move: places beside an event, turning at a human rate, steps round people
and the robot."""

from __future__ import annotations

import math

import msgspec
import numpy as np

from cosim.core.geometry import Pose, wrap_angle
from cosim.core.state import PERSON_RADIUS_M
from cosim.people.steering import Vector
from cosim.people.yielding import RobotBody, as_met, stepped_round, touches, within_reach_m
from cosim.spec.events import Event, EventQuery, Walker
from scenarios.events.sight import Sight, led_round, place_taken

EDGE_GAP_M = 0.1
TURN_RADPS = math.pi
ON_THE_MIDDLE_M = 0.3
"""A robot no farther from the middle of the way is met there."""
SLOW_MPS = 0.3
"""Below this the motion says nothing about where somebody faces."""
_SAME_M = 1e-9
_GIVES_UP_S = 2.0
"""How long somebody stands against a robot that it has run into before it goes round."""


def walker_at(event: Event, along_m: float, left_m: float, facing_rad: float) -> Walker:
    """Somebody at a place of the event's frame: metres along its heading and to the left, facing in
    that frame."""
    x_m, y_m = spot(event, along_m, left_m)
    return Walker(x_m=x_m, y_m=y_m, heading_rad=wrap_angle(event.heading_rad + facing_rad))


def spot(event: Event, along_m: float, left_m: float) -> tuple[float, float]:
    """World metres of a place in the event's frame."""
    cos, sin = math.cos(event.heading_rad), math.sin(event.heading_rad)
    return event.x_m + cos * along_m - sin * left_m, event.y_m + sin * along_m + cos * left_m


def along_m(event: Event, x_m: float, y_m: float) -> float:
    """Metres of a point of the world along the event's heading, from its place."""
    return math.cos(event.heading_rad) * (x_m - event.x_m) + math.sin(event.heading_rad) * (
        y_m - event.y_m
    )


def left_m(event: Event, x_m: float, y_m: float) -> float:
    """Metres of a point of the world to the left of the event's heading, from its place."""
    return math.cos(event.heading_rad) * (y_m - event.y_m) - math.sin(event.heading_rad) * (
        x_m - event.x_m
    )


def edge_m(event: Event) -> float:
    """How far from the middle one can stand with both shoulders on the sidewalk."""
    return max(event.half_width_m - PERSON_RADIUS_M - EDGE_GAP_M, 0.0)


def met_m(lane_m: float, room_m: float) -> float:
    """How far left of the middle of the way a robot is met that was `lane_m` left of it at the
    trigger, with so much room to either side."""
    return max(-room_m, min(room_m, lane_m)) if abs(lane_m) > ON_THE_MIDDLE_M else 0.0


def robot_of(query: EventQuery) -> RobotBody:
    """The robot as people see it."""
    pose = Pose(query.robot_x_m, query.robot_y_m, query.robot_heading_rad)
    return RobotBody(pose, (query.robot_length_m / 2, query.robot_width_m / 2), query.robot_v_mps)


def turned(heading_rad: float, wanted_rad: float, tick_s: float) -> float:
    """Heading after one tick of turning at a human rate."""
    error = wrap_angle(wanted_rad - heading_rad)
    return wrap_angle(heading_rad + max(-TURN_RADPS * tick_s, min(TURN_RADPS * tick_s, error)))


def walked_to(
    walker: Walker,
    x_m: float,
    y_m: float,
    speed_mps: float,
    sight: Sight,
    *,
    insisting: bool = False,
) -> Walker:
    """One tick towards a point, facing it, round people and the robot where they are in the way;
    exactly there when in reach. Where somebody is there already one stands beside them, unless one
    insists: then they make room."""
    if not insisting and place_taken(walker, (x_m, y_m), sight):
        return walker
    tick_s = sight.query.tick_ms / 1000
    dx, dy = x_m - walker.x_m, y_m - walker.y_m
    far_m = math.hypot(dx, dy)
    share = min(speed_mps * tick_s / max(far_m, 1e-9), 1.0)
    wanted = (x_m, y_m) if share == 1.0 else (walker.x_m + share * dx, walker.y_m + share * dy)
    heading = (
        walker.heading_rad
        if share == 1.0
        else turned(walker.heading_rad, math.atan2(dy, dx), tick_s)
    )
    return stepped(walker, wanted, heading, sight, goal=(x_m, y_m), insisting=insisting)


def walked_on(walker: Walker, heading_rad: float, speed_mps: float, sight: Sight) -> Walker:
    """One tick in a direction, round people and the robot where they are in the way."""
    tick_s = sight.query.tick_ms / 1000
    step_m = speed_mps * tick_s
    onward = (
        walker.x_m + math.cos(heading_rad) * step_m,
        walker.y_m + math.sin(heading_rad) * step_m,
    )
    return stepped(walker, onward, turned(walker.heading_rad, heading_rad, tick_s), sight)


def stepped(
    walker: Walker,
    wanted: Vector,
    heading_rad: float,
    sight: Sight,
    goal: Vector | None = None,
    *,
    insisting: bool = False,
) -> Walker:
    """The walker one step on, with the step led round people, then round what stands there, then
    round the robot."""
    led = _round_things(
        walker, led_round(walker, wanted, sight, goal, insisting=insisting), sight.query
    )
    if led != wanted:
        heading_rad = facing(walker, led, sight)
    x_m, y_m = led
    robot = robot_of(sight.query)
    if math.dist(led, robot.pose[:2]) < within_reach_m(robot):
        x_m, y_m = stepped_round(np.array([[walker.x_m, walker.y_m]]), np.array([led]), robot)[
            0
        ].tolist()
    return msgspec.structs.replace(walker, x_m=x_m, y_m=y_m, heading_rad=heading_rad)


def _round_things(walker: Walker, wanted: Vector, query: EventQuery) -> Vector:
    """Where a step ends that should end at `wanted` (m), once it is led round what stands there;
    `wanted` itself where it is not."""
    for thing in query.standing:
        body = as_met(thing)
        if math.dist(wanted, body.pose[:2]) < within_reach_m(body):
            x_m, y_m = stepped_round(
                np.array([[walker.x_m, walker.y_m]]), np.array([wanted]), body
            )[0].tolist()
            wanted = wanted if math.dist(wanted, (x_m, y_m)) < _SAME_M else (x_m, y_m)
    return wanted


def facing(walker: Walker, after: Vector, sight: Sight) -> float:
    """Heading after a step that was led aside: the body turns to where it goes; that of who is held
    up stays."""
    dx, dy = after[0] - walker.x_m, after[1] - walker.y_m
    tick_s = sight.query.tick_ms / 1000
    if math.hypot(dx, dy) < SLOW_MPS * tick_s:
        return walker.heading_rad
    return turned(walker.heading_rad, math.atan2(dy, dx), tick_s)


def aimed(walker: Walker, query: EventQuery, commit_m: float) -> tuple[Walker, float]:
    """The walker and where it heads (rad) who walks at the robot's current position, and keeps its
    line once it is so near."""
    dx, dy = query.robot_x_m - walker.x_m, query.robot_y_m - walker.y_m
    if walker.aim_rad is not None:
        return walker, walker.aim_rad
    heading_rad = math.atan2(dy, dx)
    commits = math.hypot(dx, dy) <= commit_m
    return msgspec.structs.replace(walker, aim_rad=heading_rad) if commits else walker, heading_rad


def pressed_on(walker: Walker, heading_rad: float, speed_mps: float, sight: Sight) -> Walker:
    """One tick straight on whether or not the robot is there, but round people and round a robot
    that stands; one that meets the robot stands and does not push it. Who is led round anybody
    takes aim anew."""
    if sight.robot_stands:
        return msgspec.structs.replace(
            walked_on(walker, heading_rad, speed_mps, sight), aim_rad=None
        )
    if touches(np.array([walker.x_m, walker.y_m]), robot_of(sight.query)):
        return msgspec.structs.replace(walker, blocked_ticks=walker.blocked_ticks + 1)
    step_m = speed_mps * sight.query.tick_ms / 1000
    wanted = (
        walker.x_m + math.cos(heading_rad) * step_m,
        walker.y_m + math.sin(heading_rad) * step_m,
    )
    x_m, y_m = led = _round_things(walker, led_round(walker, wanted, sight), sight.query)
    if led == wanted:
        return msgspec.structs.replace(
            walker, x_m=x_m, y_m=y_m, heading_rad=wrap_angle(heading_rad)
        )
    return msgspec.structs.replace(
        walker, x_m=x_m, y_m=y_m, heading_rad=facing(walker, led, sight), aim_rad=None
    )


def gave_up(walker: Walker, query: EventQuery) -> bool:
    """Whether somebody has stood against the robot long enough."""
    return walker.blocked_ticks * query.tick_ms / 1000 >= _GIVES_UP_S
