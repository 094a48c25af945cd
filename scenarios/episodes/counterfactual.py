"""An episode beside the same street without its robot: who was delayed, and by how much.

When the episode is over its street is simulated again from the same seed: the same people and
vehicles come and go at the same moments, event pedestrians and injected people are where they were,
but nothing is where the robot was.
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

TELL_EVERY_TICKS: Final = 20


class Compared(NamedTuple):
    """What the robot cost people and vehicles."""

    people: Delay
    vehicles: Delay

    @property
    def measures(self) -> dict[str, float | None]:
        """As measures of a record: delays over those that came near the robot, absent where nobody
        did."""
        measures: dict[str, float | None] = {}
        for kind, delay in (("people", self.people), ("vehicles", self.vehicles)):
            measures[f"{kind}_delay_s"] = delay.near_s if delay.near else None
            measures[f"{kind}_compared"] = float(delay.near)
        return measures


class Beside:
    """Watches an episode; once it is over, compares it with the street without its robot."""

    def __init__(self) -> None:
        self._moments: list[tuple[RobotState, EventReply]] = []
        self._present = Tracks(), Tracks()

    def watch(self, step: Step, verdict: Verdict) -> None:
        """The next tick of the episode."""
        self._moments.append((step.robot, step.events))
        self._present[0].add(_crowd(step.street_after))
        self._present[1].add(step.street_after.vehicles)

    def compared(
        self, scenario: Scenario, entrances: Entrances, progress: Progress = ignore
    ) -> Compared:
        """entrances: of the episode. No SUMO may be running in this process."""
        absent = Tracks(), Tracks()
        with crowd_of(scenario, entrances) as crowd:
            for tick, (robot, reply) in enumerate(self._moments):
                if tick % TELL_EVERY_TICKS == 0:
                    progress("without the robot", tick / len(self._moments))
                street = crowd.step(robot, reply, absent=True)
                absent[0].add(_crowd(street))
                absent[1].add(street.vehicles)
        at = [(robot.pose.x_m, robot.pose.y_m) for robot, _ in self._moments]
        return Compared(
            *(
                delay_of(at, a, b, Clock().tick_s)
                for a, b in zip(self._present, absent, strict=True)
            )
        )


def _crowd(street: Street) -> People:
    """Those who come and go by themselves: event pedestrians and injected people are where they
    were."""
    return street.people.only(np.flatnonzero(street.people.are(PersonKind.CROWD)))
