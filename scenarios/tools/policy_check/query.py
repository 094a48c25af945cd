"""Query a policy about a drive in a separate episode, before the limits of the robot apply."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np

from cosim.core.geometry import Floats
from cosim.core.progress import Progress, ignore
from cosim.core.state import Command, WaypointCommand
from cosim.episode.interfaces import Observation, Policy
from cosim.episode.policy_caller import PolicyCaller
from cosim.spec.manifest import Manifest, WaypointRule
from scenarios.tools.policy_check.drives import SceneName, ShownDrive
from scenarios.tools.policy_check.edits import Edit, with_goal

_SEED: Final = 1
_LEAST: Final = 0.1
"""Least size with which an answer is compared: metres of a waypoint, or metres and radians in a
second.
"""
ROUNDING: Final = 1e-4
"""Largest relative difference of equal answers: one device may sum in another order."""


@dataclass(frozen=True, slots=True)
class Answered:
    """Answer of a policy: its speed and its turn.

    turn_rad: bearing of the waypoint that is followed, or the yaw rate of a command.
    waypoints: (N, 2) or (N, 4) in metres; None for a command, also if it comes with a plan.
    """

    v_mps: float
    turn_rad: float
    waypoints: Floats | None

    @property
    def degrees(self) -> str:
        """The turn as text."""
        turn = round(math.degrees(self.turn_rad))
        return f"{abs(turn)} deg {'left' if turn > 0 else 'right'}" if turn else "straight on"


def answered(raw_answer: object, command: Command, rule: WaypointRule) -> Answered:
    """Convert a raw answer, which became this command."""
    if isinstance(raw_answer, Command) or not isinstance(command, WaypointCommand):
        raw = raw_answer if isinstance(raw_answer, Command) else command
        return Answered(float(raw.v_mps), float(raw.w_radps), None)
    waypoints = command.waypoints.astype(float)
    x_m, y_m = waypoints[command.index, :2].tolist()
    if math.hypot(x_m, y_m) > 1e-6:
        turn = math.atan2(y_m, x_m)
    else:
        turn = math.atan2(*waypoints[command.index, [3, 2]]) if waypoints.shape[1] == 4 else 0.0
    return Answered(x_m / rule.dt_s, turn, waypoints)


def apart(one: Answered, other: Answered) -> float:
    """Return the difference of two answers as a share of the larger: 0 if equal, 2 if opposite."""
    first, second = _numbers(one), _numbers(other)
    if first.shape != second.shape:
        return 2.0
    largest = max(float(np.linalg.norm(rows, axis=1).max()) for rows in (first, second))
    return float(np.linalg.norm(first - second, axis=1).max()) / max(largest, _LEAST)


def _numbers(one: Answered) -> Floats:
    return np.array([[one.v_mps, one.turn_rad]]) if one.waypoints is None else one.waypoints[:, :2]


class PolicyQuery:
    """Policy with the drives of its queries. Answers are cached."""

    def __init__(
        self,
        caller: PolicyCaller,
        manifest: Manifest,
        drives: Mapping[SceneName, ShownDrive],
        progress: Progress = ignore,
    ) -> None:
        """manifest: with the goals of the run."""
        self.manifest = manifest
        self.drives = drives
        self.took_ms: list[float] = []
        self._caller = caller
        self._progress = progress
        self._raw_answer: object = None
        self._known: dict[tuple[SceneName, tuple[str, ...]], Answered] = {}
        self._episodes = 0
        caller.on_answer(self._store_answer)

    def answer(self, scene: SceneName, *edits: Edit) -> Answered:
        """Return the answer to the last observation of a drive with these edits. Raises
        PolicyError.
        """
        key = scene, tuple(edit.name for edit in edits)
        if key not in self._known:
            seen: Sequence[Observation] = self.drives[scene].seen
            for edit in edits:
                seen = edit.change(seen)
            self._known[key] = self.episode(seen)[-1]
        return self._known[key]

    def episode(self, seen: Sequence[Observation], seed: int = _SEED) -> list[Answered]:
        """Return the answers to observations in a new episode. Raises PolicyError."""
        self._episodes += 1
        name = f"check-{self._episodes:04d}"
        self._progress("querying the policy")
        caller = self._caller
        rule = self._caller.manifest.waypoints
        answers: list[Answered] = []
        caller.reset(name, seed)
        try:
            for one in seen:
                began_s = time.perf_counter()
                command = caller.act(replace(one, episode=name))
                if answers:
                    self.took_ms.append(1000.0 * (time.perf_counter() - began_s))
                answers.append(answered(self._raw_answer, command, rule))
        finally:
            caller.ended()
        return answers

    @property
    def policy(self) -> Policy:
        """The policy that is queried."""
        return self._caller.policy

    @property
    def plain(self) -> Edit:
        """Edit that sets a goal without a turn: straight on."""
        return self.goals["ahead"]

    @cached_property
    def goals(self) -> dict[str, Edit]:
        """Edits of the goal by name, from `AnyGoal.probes`."""
        own = self.drives["straight"].seen[-1].goal
        probes = {"ahead": None} if own is None else own.probes()
        return {name: with_goal(name, goal) for name, goal in probes.items()}

    def _store_answer(self, raw_answer: object) -> None:
        self._raw_answer = raw_answer
