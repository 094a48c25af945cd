"""The one control loop: a generator of Steps. No scoring, no recording, no drawing in it.

One tick (0.05 s), robot and street as they are at its start:

    1 observe   the camera draws and the policy is asked, on the ticks of its own rate; else its command is held
    2 direct    the director answers with the event pedestrians of this tick
    3 crowd     one step on, with the robot and the event pedestrians where they are now
    4 physics   ten substeps with the command; people and vehicles move evenly to their new places
    5 yield     a Step; whoever drives the generator may send a Reset, obeyed before the next tick

The crowd of a step has seen the robot one tick late, always; the robot's camera shows the street of its own tick.
"""

from __future__ import annotations

import itertools
from collections.abc import Generator
from dataclasses import dataclass

from shapely.geometry import MultiPolygon, Polygon

from cosim.core.clock import Clock
from cosim.core.geometry import Polyline, Pose
from cosim.core.state import STILL, Frame, People, RobotState
from cosim.episode.driver import Driver
from cosim.episode.ports import Camera, Crowd, Director, Observation, Privileged, World
from cosim.episode.step import Reset, Step
from cosim.people.neighbours import bystanders
from cosim.spec.events import EventQuery, EventState
from cosim.spec.scenario import Scenario

ROUTE_WINDOW_M = 10.0
"""The robot's place on the route is looked for this far before and behind the last one."""


@dataclass(frozen=True, slots=True)
class Parts:
    """The engines of an episode, behind their ports. free: see `cosim.episode.ports.Privileged`."""

    world: World
    crowd: Crowd
    director: Director
    driver: Driver
    camera: Camera | None
    free: Polygon | MultiPolygon


def steps(scenario: Scenario, clock: Clock, parts: Parts) -> Generator[Step, Reset | None, None]:
    """Run a scenario, one Step a tick, for ever. Send a Reset to put the robot elsewhere, None to go on."""
    route = scenario.route_line
    crossings = tuple((c.id, c.enter_s_m, c.leave_s_m) for c in scenario.crossings)
    robot, street = parts.world.place(scenario.start_pose), parts.crowd.street
    command, route_s_m = STILL, 0.0
    states: tuple[EventState, ...] = ()
    parts.driver.reset(scenario.id, scenario.seed)

    for tick in itertools.count():
        frame = None
        if clock.acts(tick):
            frame = parts.camera.render(robot, street) if parts.camera is not None else None
            known = Privileged(
                robot, route, route_s_m, street.people, street.vehicles, street.signals, crossings, parts.free
            )
            command = parts.driver.act(observe(tick, clock, robot, frame, known))
        asked = query(scenario, clock, tick, robot, street.people, route_s_m, parts.world.footprint_m, states)
        reply = parts.director.react(asked)
        street_after = parts.crowd.step(robot, reply)
        motion = parts.world.step(command, street, street_after, clock.substeps)
        route_s_after_m = place_on_route(route, motion.robot.pose, route_s_m)

        reset = yield Step(tick, robot, street, route_s_m, frame, command, reply, motion, street_after, route_s_after_m)

        robot, street, states, route_s_m = motion.robot, street_after, reply.states, route_s_after_m
        if reset is not None:
            robot, route_s_m, command = parts.world.place(reset.pose), reset.route_s_m, STILL


def observe(tick: int, clock: Clock, robot: RobotState, frame: Frame | None, known: Privileged) -> Observation:
    """What is to be known; the driver gives the policy copies, and `known` only to one that declares it."""
    rgb = frame.rgb if frame is not None else None
    return Observation(tick, clock.time_s(tick), rgb, robot.v_mps, robot.w_radps, known)


def query(
    scenario: Scenario,
    clock: Clock,
    tick: int,
    robot: RobotState,
    people: People,
    route_s_m: float,
    footprint_m: tuple[float, float],
    states: tuple[EventState, ...],
) -> EventQuery:
    """The question to the director at a tick."""
    return EventQuery(
        episode=scenario.id,
        tick=tick,
        tick_ms=clock.tick_ms,
        robot_x_m=robot.pose.x_m,
        robot_y_m=robot.pose.y_m,
        robot_heading_rad=robot.pose.heading_rad,
        robot_v_mps=robot.v_mps,
        robot_w_radps=robot.w_radps,
        route_s_m=route_s_m,
        robot_length_m=footprint_m[0],
        robot_width_m=footprint_m[1],
        events=scenario.events,
        states=states,
        bystanders=bystanders(people, scenario.events),
    )


def place_on_route(route: Polyline, pose: Pose, last_s_m: float) -> float:
    """Arc length of the robot on the route, searched near the last one."""
    s_m, _ = route.project(pose.x_m, pose.y_m, (last_s_m - ROUTE_WINDOW_M, last_s_m + ROUTE_WINDOW_M))
    return s_m
