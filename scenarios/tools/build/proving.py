"""Prove candidates: the expert drives each one until its end or its first failure."""

from __future__ import annotations

import math
from typing import Final

import msgspec
import numpy as np
import shapely

from cosim.core.errors import CosimError
from cosim.core.geometry import box_disk_gap
from cosim.core.state import PERSON_RADIUS_M
from cosim.episode.loop import Step
from cosim.policies.load import load_policy
from cosim.results.record import Record
from cosim.results.referee import Verdict
from cosim.spec.obstacle import footprint
from cosim.spec.robot import robot_called
from cosim.spec.scenario import Scenario, content_hash
from scenarios.episodes.run_episode import run_episode
from scenarios.suites.decoys import limited, people_in_obstacles
from scenarios.suites.proofs import Dropped, Proof

EXPERT: Final = "orca"
_ROUNDED: Final = 3
_PASSING_DIGITS: Final = 4
_ANY_MPS: Final = 1e-3
"""Speed of the go-on rule for the expert, whose own speed the rule follows."""


class _FailedError(CosimError):
    """Failure of the expert, which ends the episode."""


class _Witness:
    """Monitor that stops an episode at its first failure.

    It measures the least distance of the robot from people and obstacles.
    """

    def __init__(self, scenario: Scenario) -> None:
        robot = robot_called(scenario.robot)
        self._half = robot.length_m / 2, robot.width_m / 2
        outlines = [footprint(obstacle) for obstacle in scenario.obstacles]
        self._obstacles = shapely.union_all(outlines) if outlines else None
        self.people_m = self.obstacles_m = math.inf
        self.failure: Dropped | None = None
        self._seed = scenario.seed

    def see(self, step: Step, verdict: Verdict) -> None:
        """Process the events of a tick. Raises _FailedError."""
        for failure in verdict.failures:
            words = " with ".join(filter(None, (failure.kind, failure.other_kind)))
            self.failure = Dropped(self._seed, words, f"at {failure.route_s_m:.1f} m")
            raise _FailedError(words)
        pose = np.array([step.motion.robot.pose])
        if len(people := step.street_after.people.xy):
            gap_m = float(box_disk_gap(pose, *self._half, people[None]).min()) - PERSON_RADIUS_M
            self.people_m = min(self.people_m, gap_m)
        if self._obstacles is not None:
            self.obstacles_m = min(
                self.obstacles_m, float(self._obstacles.distance(self._body(*pose[0])))
            )

    def _body(self, x_m: float, y_m: float, heading_rad: float) -> shapely.Polygon:
        ahead, aside = self._half
        corners = np.array([[ahead, aside], [-ahead, aside], [-ahead, -aside], [ahead, -aside]])
        cos, sin = math.cos(heading_rad), math.sin(heading_rad)
        return shapely.Polygon(corners @ np.array([[cos, sin], [-sin, cos]]) + (x_m, y_m))


def accepted(scenario: Scenario) -> tuple[Scenario, Proof] | Dropped:
    """Return a scenario that the expert solves, with its limits and proof, or why it fails.

    The expert must also meet the go-on rule of a decoy, at any speed but without a stop. A person
    who may stay inside an obstacle is a failure before it drives.
    """
    if (inside := next(people_in_obstacles(scenario), None)) is not None:
        return Dropped(scenario.seed, "person inside an obstacle", inside)
    rule = {"go_on_mps": _ANY_MPS} if any(event.decoy for event in scenario.events) else {}
    found = proved(msgspec.structs.replace(scenario, **rule))
    if isinstance(found, Dropped):
        return found
    scenario = limited(scenario, found.time_s, found.passing_mps)
    return scenario, msgspec.structs.replace(found, scenario_hash=content_hash(scenario))


def proved(scenario: Scenario, expert: str = EXPERT) -> Proof | Dropped:
    """Return the proof that the expert solves a scenario, or the reason for its failure."""
    witness = _Witness(scenario)
    record = run_episode(scenario, load_policy(expert), watches=[witness.see]).record
    if witness.failure is not None:
        return witness.failure
    if record.status != "done":
        return Dropped(scenario.seed, record.status, record.reason[:300])
    if record.measures["success"] != 1.0:
        if record.reason:
            return Dropped(scenario.seed, "event bypassed", record.reason[:300])
        done = record.measures["route_completion"] or 0.0
        if any(event.rule_met is False for event in record.events):
            return Dropped(scenario.seed, "rule of its event not met", f"at {done:.2f} of the way")
        return Dropped(scenario.seed, f"ended by {record.ended}", f"{done:.2f} of the way done")
    return proof_of(scenario, record, expert, witness.people_m, witness.obstacles_m)


def proof_of(
    scenario: Scenario,
    record: Record,
    expert: str,
    people_m: float = math.inf,
    obstacles_m: float = math.inf,
) -> Proof:
    """Return the proof of a solved episode. people_m, obstacles_m: inf without any."""
    passing_mps = next((event.passing_mps for event in record.events), None)
    return Proof(
        scenario=scenario.id,
        scenario_hash=content_hash(scenario),
        expert=expert,
        expert_version=record.manifest.version,
        state_hash=record.state_hash,
        time_s=record.measures["time_s"] or 0.0,
        people_m=round(people_m, _ROUNDED) if math.isfinite(people_m) else None,
        obstacles_m=round(obstacles_m, _ROUNDED) if math.isfinite(obstacles_m) else None,
        passing_mps=None if passing_mps is None else round(passing_mps, _PASSING_DIGITS),
    )
