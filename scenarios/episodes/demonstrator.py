"""Demonstrator: an expert that drives, with disturbances, while its observations and commands are
recorded."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.core.clock import Clock
from cosim.core.errors import UsageError
from cosim.core.packed_demos import REWARD
from cosim.core.state import Command
from cosim.episode.control import clipped
from cosim.episode.interfaces import Observation
from cosim.episode.manifest_checks import with_goal
from cosim.episode.policy_caller import PolicyCaller
from cosim.policies.load import load_policy
from cosim.results.log import Log
from cosim.results.record import Record
from cosim.spec.demo_options import RECORDING_CAMERA, DemoOptions, check_learner, recording_manifest
from cosim.spec.goal import GoalProtocol, Instruction, PointGoal
from cosim.spec.robot import Robot
from cosim.spec.scenario import Scenario
from cosim.spec.sensors import people_rows, scan_row
from scenarios.episodes.clip import Clip
from scenarios.episodes.demonstration import Demonstration, drives_ahead, glimpse
from scenarios.episodes.labels import event_numbers, event_person, label_rows
from scenarios.episodes.reward import row_rewards

_BURST_S: Final = (0.4, 1.0)
"""Shortest and longest disturbance in seconds."""
_LEARNER_S: Final = (1.0, 5.0)
"""Shortest and longest time in seconds that a learner drives, enough to reach its own errors."""
_EXPLORED_S: Final = (0.6, 2.0)
"""Shortest and longest change of an exploring learner in seconds."""
_SLOWER: Final = (0.5, 1.2)
"""Range of the factor on the expert's speed during a disturbance."""
_TURN: Final = 0.8
"""Largest change of the expert's yaw rate in a disturbance, as a share of the robot's maximum."""

_EXPLORED_TURN: Final = 0.3
"""The same share for an exploring learner, which is to stay on its way."""
_EXPLORED_MPS: Final = (0.0, 1.0)
"""Speeds that half of the changes of an exploring learner set. A factor never starts a robot."""


class Demonstrator(PolicyCaller):
    """Policy that drives with an expert and records a demonstration.

    goal: goal protocol of the run; see `EpisodeOptions`.
    learner: drives at times (`load_learner`; Ross et al., DAgger, 2011). It is queried at every
        picture, because it may have a memory. A learner that explores drives all the time, and
        the expert is not queried.
    Raises UsageError.
    """

    def __init__(
        self,
        expert: PolicyCaller,
        collecting: DemoOptions,
        goal: GoalProtocol | None = None,
        learner: PolicyCaller | None = None,
    ) -> None:
        manifest = with_goal(recording_manifest(expert.manifest, collecting, goal), None)
        super().__init__(expert, manifest, expert.source_hash)
        self.runs = expert.runs
        self.at_once = expert.at_once
        self._expert = expert
        self._collecting = collecting
        self._sees = expert.manifest.camera is not None
        self._rows = _Rows(manifest.rate_hz, collecting)
        self._bursts = _Bursts(0, collecting)
        self.learner = learner
        if learner is not None:
            check_learner(learner.manifest, collecting, expert.manifest, manifest.goal)

    @property
    def clock(self) -> dict[str, float]:
        return self._expert.clock

    def close(self) -> None:
        self._expert.close()

    def reset(self, episode_id: str, seed: int) -> None:
        self._rows = _Rows(self.manifest.rate_hz, self._collecting)
        self._bursts = _Bursts(seed, self._collecting)
        self._expert.reset(episode_id, seed)
        if self.learner is not None:
            self.learner.reset(episode_id, seed)

    def act(self, observation: Observation) -> Command:
        """Return the command to execute: the expert's, in a disturbance another one or the
        learner's. That of an exploring learner is also the recorded one."""
        rgb = observation.pictures[RECORDING_CAMERA].rgb if self._sees else observation.rgb
        assert rgb is not None
        learned = None if self.learner is None else self.learner.act(observation)
        if self._collecting.explore:
            assert learned is not None, "`DemoOptions` demands a learner"
            explored = self._bursts.driven(learned, observation.robot)
            self._rows.add(observation, rgb, clipped(explored, observation.robot), False)
            return explored
        answer = self._expert.act(observation)
        driven = self._bursts.driven(answer, observation.robot, learned)
        self._rows.add(observation, rgb, answer, driven is not answer)
        return driven

    def ended(self) -> None:
        self._expert.ended()
        if self.learner is not None:
            self.learner.ended()

    def encoded_demonstration(self, scenario: Scenario, record: Record, log: Log | None) -> bytes:
        """Return the encoded demonstration; b"" if the episode crashed or was not solved.

        Of an exploring learner, episodes that failed are returned, but not invalid ones.
        """
        if self._collecting.explore and record.status != "done":
            return b""
        if log is None or not (self._collecting.unsolved or solved(record, log)):
            return b""
        return self._rows.demonstration(scenario, record, log).encoded()


def solved(record: Record, log: Log) -> bool:
    """Return whether the episode is a success without a reset."""
    return (
        record.status == "done"
        and record.measures["success"] == 1.0
        and bool(np.isnan(log.reset_s_m).all())
    )


def load_learner(collecting: DemoOptions) -> PolicyCaller | None:
    """Load the learner of a collection, None without one. Raises UsageError."""
    try:
        return load_policy(collecting.learner) if collecting.learner else None
    except UsageError as error:
        raise UsageError(f"learner: {error}") from error


class _Bursts:
    """Times and commands of disturbances, drawn from the episode's seed."""

    def __init__(self, seed: int, collecting: DemoOptions) -> None:
        self._draws = np.random.default_rng([seed, 0xDA66E5])
        self._period_s = 1.0 / collecting.rate_hz
        self._explores = collecting.explore > 0.0
        self._share = collecting.explore or collecting.noise
        driver_s = _LEARNER_S if collecting.learner else _BURST_S
        self._lasts_s = _EXPLORED_S if self._explores else driver_s
        self._most_turn = _EXPLORED_TURN if self._explores else _TURN
        self._set_mps: float | None = None
        self._left = self._calm = 0
        if float(self._draws.random()) >= self._share:  # else it begins with a burst
            self._calm = self._steps_of_calm()
        self._slower = self._turn = 0.0

    def driven(self, answer: Command, robot: Robot, learned: Command | None = None) -> Command:
        """Return the command to execute: outside of disturbances the expert's `answer` itself.

        learned: the learner's command, if there is a learner.
        """
        if not self._share:
            return answer
        if not self._left and self._calm:
            self._calm -= 1
            return answer
        if not self._left:
            self._left = max(1, round(float(self._draws.uniform(*self._lasts_s)) / self._period_s))
            self._calm = self._steps_of_calm()
            self._slower = float(self._draws.uniform(*_SLOWER))
            self._turn = float(self._draws.uniform(-self._most_turn, self._most_turn))
            if self._explores:
                sets = self._draws.random() < 0.5
                self._set_mps = float(self._draws.choice(_EXPLORED_MPS)) if sets else None
        self._left -= 1
        if learned is not None:
            return learned
        turned_radps = answer.w_radps + self._turn * robot.w_max_radps
        v_mps = self._slower * answer.v_mps if self._set_mps is None else self._set_mps
        return clipped(Command(v_mps, turned_radps), robot)

    def _steps_of_calm(self) -> int:
        """Return the number of undisturbed commands before the next disturbance."""
        if not self._share:
            return 0
        mean_s = float(np.mean(self._lasts_s)) * (1.0 - self._share) / self._share
        return round(float(self._draws.exponential(mean_s)) / self._period_s)


class _Rows:
    """Observations and commands of an episode: raw ones to its end, others until its first
    reset."""

    def __init__(self, rate_hz: float, collecting: DemoOptions) -> None:
        self._collecting = collecting
        self._begins: list[bool] = []
        self._fps = round(rate_hz)
        self._clip: Clip | None = None
        self._over = False
        self._ticks: list[int] = []
        self._numbers: list[tuple[float, ...]] = []
        self._instructions: list[str] = []
        self._glimpses: list[NDArray[np.uint8]] = []
        self._colours = np.zeros((3, 256), np.int64)
        self._extras: dict[str, list[NDArray[np.float32]]] = {}
        self._persons: list[str] = []

    def add(
        self, seen: Observation, rgb: NDArray[np.uint8], answer: Command, disturbed: bool
    ) -> None:
        self._over |= seen.reset and self._collecting.format != "raw"
        if self._over:
            return
        if self._clip is None:
            self._clip = Clip((rgb.shape[1], rgb.shape[0]), self._fps)
        self._clip.add(rgb)
        goal = seen.goal
        x_m, y_m = (goal.x_m, goal.y_m) if isinstance(goal, PointGoal) else (math.nan, math.nan)
        self._begins.append(seen.reset or not self._ticks)
        self._ticks.append(seen.tick)
        self._numbers.append(
            (seen.v_mps, seen.w_radps, x_m, y_m, answer.v_mps, answer.w_radps, float(disturbed))
        )
        self._instructions.append(goal.text if isinstance(goal, Instruction) else "")
        self._glimpses.append(glimpse(rgb))
        for name, row in (
            _sensor_rows(seen) | (label_rows(seen) if self._collecting.labels else {})
        ).items():
            self._extras.setdefault(name, []).append(row)
        self._persons.append(event_person(seen.privileged))
        self._colours += [
            np.bincount(channel.ravel(), minlength=256) for channel in np.moveaxis(rgb, 2, 0)
        ]

    def demonstration(self, scenario: Scenario, record: Record, log: Log) -> Demonstration:
        """Return the demonstration, with waypoints of the trajectory up to the next reset."""
        collecting = self._collecting
        assert self._clip is not None, "an episode has a picture before its first command"
        ticks, numbers = np.array(self._ticks), np.array(self._numbers)
        resets = np.flatnonzero(~np.isnan(log.reset_s_m))
        pose = np.vstack([scenario.start, log.pose])
        begins = np.array(self._begins)
        every = Clock().ticks(collecting.waypoint_s)
        disturbed = numbers[:, 6] > 0.0
        command = numbers[:, 4:6]
        waypoints, driven = drives_ahead(
            pose, resets, ticks, begins, command, disturbed, collecting.waypoints, every, log.tick_s
        )
        extras = {name: np.stack(rows) for name, rows in self._extras.items()}
        if "scene" in extras:
            triggered = {
                one.id: log.tick_at(one.triggered_at_s)
                for one in record.events
                if one.triggered_at_s is not None
            }
            extras["scene"][:, 1] = event_numbers(scenario, self._persons, self._ticks, triggered)
        if collecting.explore:
            extras[REWARD] = row_rewards(record, log, ticks)
        return Demonstration(
            state=numbers[:, 0:2].astype(np.float32),
            goal=numbers[:, 2:4].astype(np.float32),
            command=command.astype(np.float32),
            waypoints=waypoints,
            driven=driven,
            disturbed=disturbed,
            instruction=np.array(self._instructions),
            glimpses=np.stack(self._glimpses),
            colours=self._colours,
            clip=np.frombuffer(self._clip.finished(), np.uint8),
            **extras,
            begins=begins,
        )


def _sensor_rows(seen: Observation) -> dict[str, NDArray[np.float32]]:
    """Return the readings of an observation as arrays of fixed size."""
    rows = {}
    if seen.scan is not None:
        rows["scan"] = scan_row(seen.scan).ravel()
    if seen.imu is not None:
        rows["imu"] = np.asarray(seen.imu, np.float32)
    if seen.people is not None:
        rows["people"] = people_rows(seen.people)
    return rows
