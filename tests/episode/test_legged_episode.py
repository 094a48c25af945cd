"""An episode with a robot on legs: falls, resets, its log and its replay."""

from __future__ import annotations

import math
from pathlib import Path

import msgspec
import numpy as np
import pytest

import cosim
from cosim.core.state import Command
from cosim.episode.loop import Step
from cosim.policies.baselines import Straight
from cosim.results.referee import Verdict
from cosim.results.rejudge import contradictions
from cosim.spec.manifest import Manifest
from cosim.spec.options import EpisodeOptions
from cosim.spec.robot import ROBOTS, Legs, robot_called
from cosim.spec.scenario import Scenario, Suite
from physics.dynamics.bullet import p
from scenarios.episodes.episode import Episode
from scenarios.episodes.replay import RecordedEpisode, ReplayChecker, replay_state_hash
from scenarios.episodes.wiring import StagedScenario
from scenarios.tools.verify.doctor import small_scenario

pytestmark = pytest.mark.engine

LEGGED = [name for name, robot in ROBOTS.items() if isinstance(robot.drive, Legs)]
MANIFEST = Manifest("ahead", rate_hz=5.0, camera=None)
PUSH_TICK = 40
ABOVE_M = 0.25
"""Height of the push above the trunk's middle: it turns the robot over rather than moves it."""


@pytest.fixture(params=LEGGED)
def robot(request: pytest.FixtureRequest) -> str:
    """A robot with legs; one whose weights are missing is skipped."""
    if robot_called(request.param).drive.gait == "network":  # type: ignore[union-attr]
        request.getfixturevalue("walker_weights")
    return str(request.param)


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return msgspec.structs.replace(small_scenario(), time_limit_s=6.0)


def walk_with_push(scenario: Scenario, robot: str, push_ns: float) -> RecordedEpisode:
    """A walk straight ahead, pushed to the left once."""
    stages: list[StagedScenario] = []

    def push(step: Step, verdict: Verdict) -> None:
        if step.tick == PUSH_TICK and push_ns:
            bodies = stages[0].engines.world._engine  # type: ignore[attr-defined]
            heading = step.motion.robot.pose.heading_rad
            force = push_ns / 0.005 * np.array([-math.sin(heading), math.cos(heading), 0.0])
            (x, y, z), _ = p.getBasePositionAndOrientation(bodies._robot, bodies._client)
            p.applyExternalForce(
                bodies._robot,
                -1,
                force.tolist(),
                (x, y, z + ABOVE_M),
                p.WORLD_FRAME,
                bodies._client,
            )

    options = EpisodeOptions(seed=0, robot=robot)
    with Episode(scenario, MANIFEST, options, watches=[push], through=stages.append) as episode:
        episode.reset()
        while not episode.over:
            episode.advance(Command(0.6, 0.0))
        record, log = episode.result()
    return RecordedEpisode(episode.scenario, record, log)


def test_a_fall_on_a_long_route_is_counted_once_and_the_robot_continues(
    scenario: Scenario, robot: str
) -> None:
    """A push of 30 N s fells the robot, which is reset upright and walks within 2 s; trajectory and
    record agree."""
    pushed_scenario, record, log, *_ = walk_with_push(scenario, robot, 30.0)
    assert [failure.kind for failure in record.failures] == ["fall"]
    assert (record.measures["falls"], record.measures["failures"]) == (1.0, 1.0)
    (reset,) = np.flatnonzero(np.isfinite(log.reset_s_m)).tolist()
    assert PUSH_TICK < reset == record.failures[0].tick < PUSH_TICK + 40
    assert log.legs.shape == (record.ticks, 16) and log.legs[reset - 2 : reset + 1, 0].all()
    assert log.speed[reset + 40, 0] > 0.4 and not log.legs[reset + 1 :, 0].any()
    assert [*contradictions(record, pushed_scenario, log)] == []


def test_a_walk_replays_to_the_same_state_hash(scenario: Scenario, robot: str) -> None:
    """Without a push it does not fall, travels from its first to its last pose, and replays to the
    same hash."""
    episode = walk_with_push(scenario, robot, 0.0)
    straight_m = math.dist(episode.log.pose[0, :2], episode.log.pose[-1, :2])
    assert episode.record.measures["path_length_m"] == pytest.approx(straight_m, rel=0.02)
    assert episode.record.measures["falls"] == 0.0
    check = ReplayChecker(Path("run"), episode).watch
    assert replay_state_hash(episode, check) == episode.record.state_hash


def test_a_flying_body_makes_the_episode_invalid_with_its_values(
    scenario: Scenario, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where every height counts as flying, the row says so, and the policy has not failed."""
    monkeypatch.setattr("physics.dynamics.legs.leg_monitor._FLIES_M", -1.0)
    suite = Suite(name="one", version="1", scenarios=(scenario,))
    options = EpisodeOptions(seed=0, robot=LEGGED[0])
    (row,) = cosim.run(suite, Straight(), options=options).to_dict("records")
    assert row["status"] == "invalid"
    assert "it sinks or flies" in row["reason"] and "m/s" in row["reason"]


@pytest.mark.parametrize(("suite", "solved"), [("unit", "curve-001"), ("reactive", "lateral-001")])
def test_the_oracle_solves_scenarios_on_legs(robot: str, suite: str, solved: str) -> None:
    """It solves one scenario of each suite without a failure."""
    options = EpisodeOptions(seed=0, robot=robot)
    (row,) = cosim.run(suite, "orca", scenarios=[solved], options=options).to_dict("records")
    assert (row["status"], row["success"], row["falls"]) == ("done", 1.0, 0.0), row["reason"]
