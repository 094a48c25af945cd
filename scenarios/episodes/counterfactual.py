"""Comparison of an episode with a counterfactual: the same street without the robot.

After the episode its street is simulated again from the same seed. The same people and vehicles
arrive at the same times, event pedestrians and injected people move as before. The difference is
the delay that the robot causes.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from cosim.core.clock import Clock
from cosim.core.progress import Progress, ignore
from cosim.core.state import People, PersonKind, RobotState, Street
from cosim.episode.loop import Step
from cosim.results.delay import Delay, Tracks, delay_of
from cosim.results.referee import Verdict
from cosim.spec.events import EventReply
from cosim.spec.scenario import Scenario
from scenarios.episodes.wiring import crowd_of
from sumo_nets.crowd.demand_log import Entrances

PROGRESS_EVERY_TICKS: Final = 20
"""Ticks between two calls of the progress callback."""


class DelayComparison(NamedTuple):
    """The delays that the robot caused to people and vehicles."""

    people: Delay
    vehicles: Delay

    @property
    def measures(self) -> dict[str, float | None]:
        """Return the measures of a record: summed delays of those that came near the robot, None if
        none did."""
        measures: dict[str, float | None] = {}
        for kind, delay in (("people", self.people), ("vehicles", self.vehicles)):
            measures[f"{kind}_delay_s"] = delay.near_s if delay.near else None
            measures[f"{kind}_compared"] = float(delay.near)
        return measures


class CounterfactualTracker:
    """Recorder of an episode, to be compared with the street without the robot afterwards."""

    def __init__(self) -> None:
        self._moments: list[tuple[RobotState, EventReply]] = []
        self._with_robot = Tracks(), Tracks()

    def watch(self, step: Step, verdict: Verdict) -> None:
        """Record the next tick of the episode."""
        self._moments.append((step.robot, step.events))
        self._with_robot[0].add(_crowd(step.street_after))
        self._with_robot[1].add(step.street_after.vehicles)

    def compared(
        self, scenario: Scenario, entrances: Entrances, progress: Progress = ignore
    ) -> DelayComparison:
        """Simulate the street without the robot, and return the delays.

        entrances: arrivals and departures of the episode's crowd.
        No SUMO may be running in this process.
        """
        without_robot = Tracks(), Tracks()
        with crowd_of(scenario, entrances) as crowd:
            for tick, (robot, reply) in enumerate(self._moments):
                if tick % PROGRESS_EVERY_TICKS == 0:
                    progress("without the robot", tick / len(self._moments))
                street = crowd.step(robot, reply, absent=True)
                without_robot[0].add(_crowd(street))
                without_robot[1].add(street.vehicles)
        at = [(robot.pose.x_m, robot.pose.y_m) for robot, _ in self._moments]
        return DelayComparison(
            *(
                delay_of(at, a, b, Clock().tick_s)
                for a, b in zip(self._with_robot, without_robot, strict=True)
            )
        )


def _crowd(street: Street) -> People:
    """Return the people that SUMO moves: event pedestrians and injected people move the same in
    both simulations."""
    return street.people.only(np.flatnonzero(street.people.are(PersonKind.CROWD)))
