"""The tick of an episode, without policy, scoring, recording or drawing.

A tick (0.05 s) uses robot and street at its start:

    1 direct    the director replies with the event pedestrians of this tick
    2 crowd     one step, with the robot and the event pedestrians at their current positions
    3 physics   ten substeps with the command; people and vehicles move linearly

The crowd always sees the robot one tick late. The robot's camera shows the street of its own tick.
"""

from __future__ import annotations

from dataclasses import dataclass

from cosim.core.clock import Clock
from cosim.core.geometry import Polyline, Pose
from cosim.core.state import Command, Frame, Motion, RobotState, Street
from cosim.episode.interfaces import Camera, Crowd, Director, World
from cosim.people.steering import nearby_people
from cosim.spec.events import EventQuery, EventReply, EventState
from cosim.spec.scenario import Scenario


@dataclass(frozen=True, slots=True)
class Step:
    """Result of one tick, yielded by the loop.

    robot, street, route_s_m: state at its start; route_s_m is the arc length on the route.
    frame: camera frame, on ticks with a policy query.
    motion, street_after, route_s_after_m: state at its end.
    """

    tick: int
    robot: RobotState
    street: Street
    route_s_m: float
    frame: Frame | None
    command: Command
    events: EventReply
    motion: Motion
    street_after: Street
    route_s_after_m: float


@dataclass(frozen=True, slots=True)
class Reset:
    """Reset of the robot to a pose, at rest, at this arc length of the route."""

    pose: Pose
    route_s_m: float


ROUTE_WINDOW_M = 10.0
"""Range of arc length around the last position in which the robot is searched, in metres."""


@dataclass(frozen=True, slots=True)
class EpisodeEngines:
    """Engines of an episode."""

    world: World
    crowd: Crowd
    director: Director
    camera: Camera | None


@dataclass(frozen=True, slots=True)
class Moment:
    """State of an episode between two ticks.

    route_s_m: robot's arc length on the route.
    states: states of the events.
    """

    tick: int
    robot: RobotState
    street: Street
    route_s_m: float
    states: tuple[EventState, ...] = ()


def begin(scenario: Scenario, engines: EpisodeEngines) -> Moment:
    """Return the first moment, with the robot at rest at its start."""
    return Moment(0, engines.world.place(scenario.start_pose), engines.crowd.street, 0.0)


def tick(
    scenario: Scenario,
    clock: Clock,
    engines: EpisodeEngines,
    now: Moment,
    command: Command,
    frame: Frame | None = None,
) -> Step:
    """Run one tick and return its step.

    frame: camera frame of the observation, if the policy was queried at this tick.
    """
    reply = engines.director.react(query(scenario, clock, now, engines.world.footprint_m))
    street_after = engines.crowd.step(now.robot, reply)
    motion = engines.world.step(command, now.street, street_after, clock.substeps)
    route_s_after_m = place_on_route(scenario.route_line, motion.robot.pose, now.route_s_m)
    return Step(
        now.tick,
        now.robot,
        now.street,
        now.route_s_m,
        frame,
        command,
        reply,
        motion,
        street_after,
        route_s_after_m,
    )


def after(step: Step, reset: Reset | None, engines: EpisodeEngines) -> Moment:
    """Return the moment after a step; a reset puts the robot elsewhere, at rest."""
    robot = step.motion.robot
    route_s_m = step.route_s_after_m
    if reset is not None:
        robot = engines.world.place(reset.pose)
        route_s_m = reset.route_s_m
    return Moment(step.tick + 1, robot, step.street_after, route_s_m, step.events.states)


def query(
    scenario: Scenario, clock: Clock, now: Moment, footprint_m: tuple[float, float]
) -> EventQuery:
    """Return the message to the director at a tick."""
    return EventQuery(
        episode=scenario.id,
        tick=now.tick,
        tick_ms=clock.tick_ms,
        robot_x_m=now.robot.pose.x_m,
        robot_y_m=now.robot.pose.y_m,
        robot_heading_rad=now.robot.pose.heading_rad,
        robot_v_mps=now.robot.v_mps,
        robot_w_radps=now.robot.w_radps,
        route_s_m=now.route_s_m,
        robot_length_m=footprint_m[0],
        robot_width_m=footprint_m[1],
        events=scenario.events,
        states=now.states,
        nearby=nearby_people(now.street.people),
    )


def place_on_route(route: Polyline, pose: Pose, last_s_m: float) -> float:
    """Return the robot's arc length on the route, searched near the last one."""
    s_m, _ = route.project(
        pose.x_m, pose.y_m, (last_s_m - ROUTE_WINDOW_M, last_s_m + ROUTE_WINDOW_M)
    )
    return s_m
