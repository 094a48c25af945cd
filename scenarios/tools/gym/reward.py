"""Rewards of a learner for the period between two answers. They need no engine and no Gymnasium."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from cosim.core.state import Command, RobotState
from cosim.episode.loop import Step
from cosim.results.referee import Ended, Failure, Verdict
from cosim.spec.scenario import Scenario

_NEAR_M: Final = 1.2
"""Radius of personal space, between the centres of robot and person
(`personal_space_violation`).
"""


@dataclass(frozen=True, slots=True)
class Transition:
    """Input of a reward: the period from one answer to the next.

    period_s: duration, shorter at the end of an episode.
    robot, route_s_m: at the end of the period, before the robot is put back after a failure.
    command: the last one that was applied.
    progress_m: along the reference route, negative backwards, without being put back.
    acceleration_mps2, turn_acceleration_radps2: root mean squares over the ticks.
    nearest_person_m: least distance between the centres of robot and a person, infinite without
    people.
    failures: failures that the referee counts.
    walked_into: contacts and falls that are the fault of people (`Failure.kind`).
    red_light_entries: crossings entered at red.
    ended: reason for the end of the episode, if it ended.
    """

    scenario: Scenario
    period_s: float
    robot: RobotState
    command: Command
    route_s_m: float
    progress_m: float
    acceleration_mps2: float
    turn_acceleration_radps2: float
    nearest_person_m: float
    failures: tuple[Failure, ...]
    walked_into: tuple[Failure, ...]
    red_light_entries: int
    ended: Ended | None


Reward = Callable[[Transition], float]


def usual_reward(happened: Transition) -> float:
    """Return the default reward, the sum of:

    1 a metre along the route
    -0.1 a second
    -0.05 of each m/s2 and each rad/s2 a second (comfort)
    -0.5 a second, growing with nearness, within 1.2 m of a person
    -2 for a red light
    -10 for each failure, and for passing a stopping hand
    10 at the goal, or for stopping before that hand
    """
    time_s = happened.period_s
    jerking = happened.acceleration_mps2 + happened.turn_acceleration_radps2
    near = max(1.0 - happened.nearest_person_m / _NEAR_M, 0.0)
    failures = len(happened.failures) or happened.ended == "failure"
    reached = happened.ended in ("goal", "stop")
    return (
        happened.progress_m
        - (0.1 + 0.05 * jerking + 0.5 * near) * time_s
        - 2.0 * happened.red_light_entries
        - 10.0 * failures
        + 10.0 * reached
    )


class Period:
    """The ticks of one period, as they are judged. tick_s: how long each is."""

    def __init__(self, scenario: Scenario, tick_s: float) -> None:
        self._scenario = scenario
        self._tick_s = tick_s
        self._ticks: list[tuple[Step, Verdict]] = []

    def watch(self, step: Step, verdict: Verdict) -> None:
        """Add the next tick of an episode."""
        self._ticks.append((step, verdict))

    def transition(self) -> Transition:
        """Return the transition since the last call."""
        ticks = self._ticks
        self._ticks = []
        steps, verdicts = [step for step, _ in ticks], [verdict for _, verdict in ticks]
        last = steps[-1]
        gained = [
            (
                step.motion.robot.v_mps - step.robot.v_mps,
                step.motion.robot.w_radps - step.robot.w_radps,
            )
            for step in steps
        ]
        v_mps2, w_radps2 = (np.sqrt(np.mean(np.square(gained), axis=0)) / self._tick_s).tolist()
        return Transition(
            scenario=self._scenario,
            period_s=len(steps) * self._tick_s,
            robot=last.motion.robot,
            command=last.command,
            route_s_m=last.route_s_after_m,
            progress_m=sum(step.route_s_after_m - step.route_s_m for step in steps),
            acceleration_mps2=v_mps2,
            turn_acceleration_radps2=w_radps2,
            nearest_person_m=min(map(_nearest_m, steps)),
            failures=tuple(failure for verdict in verdicts for failure in verdict.failures),
            walked_into=tuple(contact for verdict in verdicts for contact in verdict.walked_into),
            red_light_entries=sum(verdict.red_light_entry is not None for verdict in verdicts),
            ended=verdicts[-1].ended,
        )


def _nearest_m(step: Step) -> float:
    """Return the distance between the centres of robot and nearest person at the end of a tick."""
    people = step.street_after.people
    if not len(people):
        return math.inf
    return float(np.hypot(*(people.xy - step.motion.robot.pose.xy).T).min())
