"""Scenarios as Gymnasium environments: spaces, rewards, ends, seeds, and equality with runs."""

from __future__ import annotations

import math
import subprocess
import sys
import time
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import msgspec
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import cosim
from cosim.core.errors import PolicyError, SpecError, UsageError
from cosim.core.geometry import Pose
from cosim.core.state import Command, RobotState
from cosim.episode.interfaces import Observation
from cosim.gym import ENV_IDS
from cosim.results.referee import Failure
from cosim.results.run_setup import RunSetup
from cosim.spec.camera import CameraPicture, CameraSpec
from cosim.spec.goal import GOALS, PointGoal
from cosim.spec.manifest import Manifest, WaypointRule
from cosim.spec.odometry import Odometry
from cosim.spec.options import EpisodeOptions
from cosim.spec.robot import COURIER, SCOUT
from cosim.spec.scenario import CrowdSpec
from cosim.spec.sensors import AT_REST, ScanSpec, Tracks, clear_scan
from scenarios.episodes.run_episode import run_episode
from scenarios.suites.catalog import SUITES, load_suite
from scenarios.tools.gym.learned import LearnedPolicy
from scenarios.tools.gym.reward import Transition, usual_reward
from scenarios.tools.gym.spaces import action_as_answer, action_space_of, seen_by, seen_space
from tests.conftest import PATIENCE_S, still_runs
from tests.support.gym_suite import BLIND, COUNT, short_ways

MODULE = (sys.executable, "-m", "tests.support.gym_suite")
SEES = Manifest("sees", camera=CameraSpec(32, 24, depth=True), goal="image", rate_hz=5.0)
FAILED = Failure("collision", 3, 0.0, 0.0, 1.0, 1.0)
QUIET = Transition(
    scenario=None,  # type: ignore[arg-type]  the usual reward does not look at it
    period_s=0.25,
    robot=RobotState(Pose(0.0, 0.0, 0.0)),
    command=Command(0.0, 0.0),
    route_s_m=3.0,
    progress_m=0.0,
    acceleration_mps2=0.0,
    turn_acceleration_radps2=0.0,
    nearest_person_m=math.inf,
    failures=(),
    walked_into=(),
    red_light_entries=0,
    ended=None,
)


@pytest.mark.parametrize(
    ("happened", "worth"),
    [
        ({}, -0.025),
        ({"progress_m": 0.5}, 0.475),
        ({"progress_m": -0.5}, -0.525),
        ({"acceleration_mps2": 2.0}, -0.05),
        ({"turn_acceleration_radps2": 2.0}, -0.05),
        ({"nearest_person_m": 1.2}, -0.025),
        ({"nearest_person_m": 0.6}, -0.0875),
        ({"red_light_entries": 1}, -2.025),
        ({"failures": (FAILED,)}, -10.025),
        ({"failures": (FAILED,), "ended": "failure"}, -10.025),
        ({"failures": (FAILED, FAILED)}, -20.025),
        ({"ended": "failure"}, -10.025),
        ({"walked_into": (FAILED,)}, -0.025),
        ({"ended": "goal"}, 9.975),
        ({"ended": "stop"}, 9.975),
        ({"ended": "timeout"}, -0.025),
    ],
    ids=lambda value: " ".join(value) or "nothing" if isinstance(value, dict) else None,
)
def test_the_default_reward_is_the_documented_sum(happened: dict[str, Any], worth: float) -> None:
    """Each part of the sum has its hand-computed value."""
    assert usual_reward(replace(QUIET, **happened)) == pytest.approx(worth)


@pytest.mark.parametrize("goal", sorted(GOALS))
def test_observations_lie_in_the_observation_space(goal: str) -> None:
    """For every goal protocol and all optional sensors, the dictionary has the keys of the space,
    its values are contained, and values beyond the bounds are clipped."""
    wide = CameraSpec(32, 24, labels=True, depth=True)
    manifest = Manifest(
        "all",
        camera=wide,
        cameras={"left": CameraSpec(8, 6)},
        goal=goal,  # type: ignore[arg-type]
        odometry="gps",
        scan=ScanSpec(rays=8),
        imu="exact",
        people="seen",
    )
    space = seen_space(manifest, [COURIER, SCOUT])
    pixels = np.full((24, 32), 3, np.uint8)
    far = np.full((24, 32), np.inf, np.float32)
    goals = GOALS[goal].type  # type: ignore[index]
    given = (
        None
        if goals is None
        else PointGoal(30_000.0, 1.0)
        if goals is PointGoal
        else goals.example((32, 24))
    )
    picture = CameraPicture(np.zeros((6, 8, 3), np.uint8), None, None, None)  # type: ignore[arg-type]
    seen = seen_by(
        Observation(
            5,
            0.25,
            np.zeros((24, 32, 3), np.uint8),
            90.0,
            -0.1,
            COURIER,
            goal=given,
            depth=far,
            labels=pixels,
            pictures={"left": picture},
            odometry=Odometry(1.0, 2.0, None),
            scan=clear_scan(ScanSpec(rays=8)),
            imu=AT_REST,
            people=Tracks(np.arange(40, dtype=np.int32), *np.ones((2, 40, 2), np.float32)),
        ),
        space,
    )
    assert (
        space.contains(seen) and seen["speeds"][0] == 5.0 and ("goal" in seen) == (goal != "none")
    )
    assert {"picture", "depth", "labels", "picture_left", "odometry"} <= {*seen}
    assert (seen["scan"] == 20.0).all() and seen["imu"][5] == np.float32(9.81)
    assert (seen["people"] == 1.0).all() and seen["people"].shape == (32, 5)


def test_actions_are_commands_or_waypoints_of_the_manifest() -> None:
    """A command is speed and yaw rate within the limits of the fastest robot; waypoints end with
    the followed one, in its unit."""
    space = action_space_of("command", BLIND, [COURIER, SCOUT])
    assert (space.low.tolist(), space.high.tolist()) == (
        [0.0, np.float32(-1.2)],
        [2.5, np.float32(1.2)],
    )
    assert action_as_answer(np.float32([1.5, 0.25]), space) == Command(1.5, 0.25)
    rule = WaypointRule(index=3, unit_m=0.25, dt_s=0.2)
    several = action_space_of("waypoints", replace(BLIND, waypoints=rule), [COURIER])
    assert several.shape == (4, 2) and several.high.max() == pytest.approx(2.5 * 0.2 / 0.25)
    with pytest.raises(UsageError, match=r"shape \(2,\): this environment's are \(4, 2\)"):
        action_as_answer(np.float32([1.5, 0.25]), several)
    with pytest.raises(PolicyError, match="100002 numbers; an answer holds at most 100000"):
        action_as_answer(np.zeros((50_001, 2), np.float32), several)


def test_every_shipped_suite_has_an_id_of_its_major_version() -> None:
    """`gymnasium.make` accepts an id for each suite, and the id ends with the suite's major
    version."""
    assert {*ENV_IDS.values()} == {*SUITES}
    for env_id, name in ENV_IDS.items():
        assert env_id.endswith(f"-v{load_suite(name).version.split('.')[0]}")
    with gymnasium.make("cosim/Unit-v2", manifest=BLIND, split="test", actions="waypoints") as env:
        assert env.action_space.shape == (3, 2) and {
            one.split for one in env.unwrapped.scenarios
        } == {"test"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"suite": "unlt"}, "unknown suite 'unlt'.*Did you mean unit"),
        ({"scenarios": ["straight-999999"]}, "unknown scenario 'straight-999999'"),
        ({"events": ["frontal"]}, "suite 'unit' has no events"),
        ({"actions": "wheels"}, "unknown kind of actions 'wheels'.*command, waypoints"),
        ({"render_mode": "human"}, "unknown render_mode 'human'.*rgb_array"),
        ({"manifest": replace(BLIND, privileged=True)}, "leave privileged=True out"),
        ({"manifest": replace(BLIND, goal="image")}, "no camera, and goal protocol 'image'"),
        (
            {"manifest": replace(SEES, camera=CameraSpec(9000, 9000))},
            "which robot 'courier' does not have",
        ),
        ({"options": EpisodeOptions(counterfactual=True)}, "leave counterfactual out"),
        ({"options": EpisodeOptions(robot="rover")}, "unknown robot 'rover'"),
    ],
    ids=[
        "suite",
        "scenario",
        "event",
        "actions",
        "render mode",
        "privileged",
        "goal",
        "camera",
        "options",
        "robot",
    ],
)
def test_invalid_arguments_are_refused_when_an_environment_is_made(
    arguments: dict[str, Any], message: str
) -> None:
    """One line names the invalid value and the valid ones."""
    with pytest.raises((UsageError, SpecError), match=message):
        cosim.make_env(**{"suite": "unit", "manifest": BLIND} | arguments)


def test_a_missing_gymnasium_is_named_with_its_installation(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The message names the extra to install."""
    monkeypatch.delitem(sys.modules, "scenarios.tools.gym.environment", raising=False)
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    with pytest.raises(
        UsageError, match=r"need Gymnasium.*pip install -e '\.\[gym\]' in the checkout"
    ):
        cosim.make_env("unit")


def test_render_without_a_render_mode_is_refused() -> None:
    """`render()` raises an error with the mode and the call that sets it."""
    with (
        gymnasium.make("cosim/Unit-v2", manifest=BLIND) as env,
        pytest.raises(
            UsageError, match=r"no render_mode.*gymnasium\.make\(.*render_mode=\"rgb_array\"\)"
        ),
    ):
        env.unwrapped.render()


@pytest.mark.engine
def test_check_env_of_gymnasium_passes() -> None:
    """`check_env` passes for a camera with depth, a picture goal and rendering, and warns only of
    spaces that are not normalized."""
    arguments = {
        "suite": short_ways(),
        "manifest": SEES,
        "scenarios": ["way-1"],
        "render_mode": "rgb_array",
    }
    env = gymnasium.make("cosim/Unit-v2", **arguments).unwrapped
    with env, warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        check_env(env)
        assert env.render().shape == (360, 640, 3) and env.render().std() > 10.0
        with pytest.raises(
            UsageError, match=r"unknown option of reset 'scene'\. Valid choices: scenario"
        ):
            env.reset(options={"scene": "way-1"})
        with pytest.raises(UsageError, match=r"unknown scenario 'way-2'\. Valid choices: way-1"):
            env.reset(options={"scenario": "way-2"})
    warnings_seen = [str(one.message) for one in warned]
    assert [
        text
        for text in warnings_seen
        if "we recommend using a symmetric and normalized space" not in text
    ] == []
    with pytest.raises(UsageError, match=r"call reset\(\) first"):
        env.step(env.action_space.sample())


class Replay:
    """A policy that gives the same commands as `commands`."""

    manifest = replace(SEES, odometry="wheel")

    def reset(self, episode_id: str, seed: int) -> None:
        self._next = iter(commands())

    def act(self, observation: Observation) -> Command:
        return Command(*map(float, next(self._next)))


def commands() -> list[np.ndarray]:
    """Return commands along curves, at speeds that single precision represents exactly."""
    return [np.float32([0.25 + 0.125 * (k % 7), 0.25 * (k % 3 - 1)]) for k in range(20)]


@pytest.mark.engine
def test_the_same_commands_give_the_record_of_a_run_to_the_bit() -> None:
    """The last step of an environment has the state hash and measures of a run with the same
    commands."""
    suite = short_ways(crowd=CrowdSpec(persons=12, vehicles=4, radius_m=60.0))
    options = EpisodeOptions(seed=11)
    setup = RunSetup.of(options, suite_hash=suite.content_hash)
    with cosim.make_env(suite, Replay.manifest, options=options) as env:
        seen, info = env.reset(options={"scenario": "way-3"})
        observations = [seen]
        rewards = []
        gained_m = 0.0
        for command in commands():
            seen, reward, terminated, truncated, info = env.step(command)
            observations.append(seen)
            rewards.append(reward)
            gained_m += env.transition.progress_m
            if terminated or truncated:
                break
    queried: list[dict[str, Any]] = []
    answers = iter(commands())
    learned = LearnedPolicy(lambda seen: queried.append(seen) or next(answers), Replay.manifest)
    for policy in (Replay(), learned):
        record = run_episode(suite.scenarios[3], policy, options, setup=setup).record
        assert info["record"] == msgspec.structs.replace(record, clock={})
    assert len(record.state_hash) > 10 and (terminated, truncated) == (
        record.ended == "failure",
        record.ended == "timeout",
    )
    assert info["metrics"] == {
        name: value for name, value in record.measures.items() if value is not None
    }
    for stepped, answered in zip(observations, queried, strict=False):
        assert all((stepped[name] == answered[name]).all() for name in stepped)
    assert len(queried) == len(observations) - 1 and gained_m > 0.2


@pytest.mark.engine
def test_a_seed_determines_scenarios_and_observations() -> None:
    """The same seed gives the same scenarios and observations in the same order, with noisy
    odometry, and another seed others. A named scenario does not change the following ones, and a
    user's reward is returned by step."""

    def episodes(
        env: Any, seed: int, first: dict[str, str] | None = None
    ) -> list[tuple[str, list[float]]]:
        found = []
        for seed_now, options in ((seed, first), (None, None), (None, None)):
            _, info = env.reset(seed=seed_now, options=options)
            seen, reward, *_ = env.step(np.float32([2.0, 0.5]))
            assert reward == env.transition.route_s_m
            found.append((info["scenario"], seen["odometry"].tolist()))
        return found

    with cosim.make_env(short_ways(), BLIND, reward=lambda happened: happened.route_s_m) as env:
        once = episodes(env, 3)
        assert episodes(env, 3) == once != episodes(env, 4)
        assert episodes(env, 3, {"scenario": "way-5"})[1:] == once[1:]
    assert len({name for name, _ in once}) > 1


@pytest.mark.engine
def test_a_failure_ends_a_short_way_and_is_counted_on_a_long_one() -> None:
    """A failure terminates a short way; on a long way the robot is reset with a penalty until the
    time truncates the episode."""

    def driven_off_the_sidewalk(ends: bool) -> tuple[list[dict[str, Any]], list[float], bool, bool]:
        way = short_ways(ends_on_failure=ends, time_limit_s=4.0)
        infos = []
        rewards = []
        with cosim.make_env(way, BLIND, scenarios=["way-0"]) as env:
            env.reset(seed=1)
            terminated = truncated = False
            while not (terminated or truncated):
                _, reward, terminated, truncated, info = env.step(np.float32([1.5, 0.65]))
                infos.append(info)
                rewards.append(reward)
        return infos, rewards, terminated, truncated

    infos, rewards, *ends = driven_off_the_sidewalk(True)
    assert ends == [True, False] and infos[-1]["failures"] == 1 and rewards[-1] < -8.0
    assert not infos[-1]["is_success"] and infos[-1]["record"].ended == "failure"
    infos, rewards, *ends = driven_off_the_sidewalk(False)
    resets = [k for k, info in enumerate(infos) if info["put_back"]]
    assert (
        ends == [False, True]
        and resets
        and all(infos[k]["failures"] == 1 and rewards[k] < -8.0 for k in resets)
    )
    assert sum(info["failures"] for info in infos) == len(infos[-1]["record"].failures)
    assert infos[-1]["time_s"] == 4.0 and infos[-1]["record"].ended == "timeout"


@pytest.mark.engine
def test_vectorized_environments_equal_single_ones(tmp_path: Path) -> None:
    """Four environments of an `AsyncVectorEnv`, in processes of their own, give the observations,
    rewards and ends of single environments to the bit."""
    done = subprocess.run(
        [*MODULE, "differences"], capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    assert done.stdout == "[]\n" and COUNT == 4, done.stderr


@pytest.mark.engine
def test_vectorized_environments_report_errors_and_end_with_their_parent() -> None:
    """An action that is not finite raises its own error, and environments end when the process that
    made them is killed."""
    output = subprocess.run(
        [*MODULE, "error"], capture_output=True, text=True, timeout=PATIENCE_S, check=False
    ).stdout
    assert (
        "PolicyError policy 'blind' answered Command(v_mps=nan, w_radps=0.0): both must be finite"
        in output
    )
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    with subprocess.Popen([*MODULE, "killed"], text=True, **pipes) as parent:
        pids = [int(word) for word in parent.stdout.readline().split()]
        assert len(pids) == 2 and all(map(still_runs, pids))
        parent.kill()
    deadline = time.monotonic() + PATIENCE_S
    while any(map(still_runs, pids)) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not any(map(still_runs, pids))


@pytest.mark.engine
def test_the_learner_of_the_readme_runs(tmp_path: Path) -> None:
    """The PPO example learns for one short rollout, writes its curve, and returns a policy that
    drives in a run. Skipped without Stable-Baselines3."""
    pytest.importorskip("stable_baselines3", reason="Stable-Baselines3 is not installed")
    code = (
        "import runpy, pathlib, cosim;"
        "made = runpy.run_path('scenarios/examples/learn_straight_on.py', run_name='learn');"
        f"policy = made['learn'](30.0, 1, pathlib.Path({str(tmp_path)!r}), 1, 64, 64); "
        "print(cosim.run('reactive', policy, scenarios=['static-7001']).scenario[0])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.stdout == "static-7001\n", done.stderr
    assert (tmp_path / "curve.csv").read_text().startswith("steps,cpu_s,episodes,return,success")
