"""A recorded episode beside the same street without its robot: who was delayed, and by how much.

The episode is replayed; then its street is simulated again from the same seed, with the same event pedestrians and
guests where they were, around the same moving point, but with nothing there.
"""

from __future__ import annotations

from typing import NamedTuple

from cosim.clock import Clock
from cosim.delay import Delay, Tracks, delay_of
from cosim.events import EventReply
from cosim.referee import Verdict
from cosim.state import RobotState
from cosim.step import Step
from cosim.streetmap import Port
from scenarios.assemble import place
from scenarios.replay import Recorded, replayed
from sumo_nets.crowd import SumoCrowd


class Compared(NamedTuple):
    """What the robot cost people and vehicles; state_hash: of the replayed episode."""

    people: Delay
    vehicles: Delay
    state_hash: str


def counterfactual(told: Recorded) -> Compared:
    """Compare an episode with the same street without the robot."""
    moments: list[tuple[RobotState, EventReply]] = []
    present = Tracks("c"), Tracks("v")

    def watch(step: Step, verdict: Verdict) -> None:
        moments.append((step.robot, step.events))
        present[0].add(step.street_after.people)
        present[1].add(step.street_after.vehicles)

    state_hash = replayed(told, watch)
    scenario, absent = told.scenario, (Tracks("c"), Tracks("v"))
    net_path, street_map = place(scenario.place)
    closed = frozenset(Port(barrier.strip, barrier.end) for barrier in scenario.barriers)
    with SumoCrowd(net_path, street_map, scenario.crowd, scenario.seed, closed, scenario.start[:2]) as crowd:
        for robot, reply in moments:
            street = crowd.step(robot, reply, absent=True)
            absent[0].add(street.people)
            absent[1].add(street.vehicles)
    robot_xy = [(robot.pose.x_m, robot.pose.y_m) for robot, _ in moments]
    people, vehicles = (delay_of(robot_xy, a, b, Clock().tick_s) for a, b in zip(present, absent, strict=True))
    return Compared(people, vehicles, state_hash)
