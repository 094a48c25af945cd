"""Replay of a recorded episode: same commands, same injections, same state hash."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cosim.core.clock import Clock
from cosim.core.errors import RunError, unknown
from cosim.core.progress import Progress, ignore
from cosim.core.state import Command, WaypointCommand
from cosim.core.versions import versions
from cosim.episode.loop import Step
from cosim.policies.baselines import Replay
from cosim.results.log import Log, Tick
from cosim.results.record import Record
from cosim.results.referee import Verdict
from cosim.results.run_folder import read_records, read_spec
from cosim.results.run_setup import RunSetup, appearance_of
from cosim.results.traffic import RoadState
from cosim.spec.manifest import Manifest
from cosim.spec.options import EpisodeOptions
from cosim.spec.robot import robot_called
from cosim.spec.run_config import Appearance, CameraChoice
from cosim.spec.scenario import Scenario, read_suite
from physics.robots import robot_hash
from scenarios.episodes.counterfactual import CounterfactualTracker, DelayComparison
from scenarios.episodes.episode import Episode, Watch
from scenarios.episodes.run_episode import drive
from scenarios.episodes.wiring import StagedScenario
from sumo_nets.crowd.demand_log import Entrances


class RecordedEpisode(NamedTuple):
    """A finished episode as loaded from a run folder.

    robot_hash: hash of its robot in the run (`physics.robots.robot_hash`); "" if unknown.
    """

    scenario: Scenario
    record: Record
    log: Log
    robot_hash: str = ""


def load_recorded(folder: Path, scenario_id: str) -> RecordedEpisode:
    """Load a finished episode. Raises UsageError with the valid names, RunError if it crashed."""
    records = {record.scenario.id for record in read_records(folder)}
    if scenario_id not in records:
        raise unknown(f"finished episode in {folder}", scenario_id, records)
    scenarios = {s.id: s for s in read_suite(folder / "scenarios.json").scenarios}
    episode = folder / "episodes" / scenario_id
    record = Record.load(episode / "record.json")
    if record.ended is None:
        raise RunError(
            f"{folder}: '{scenario_id}' did not come to its end: there is nothing to run again"
        )
    scenario = scenarios[scenario_id]
    digest = read_spec(folder).robots.get(scenario.robot, "")
    return RecordedEpisode(scenario, record, Log.load(episode / "trajectory.npz"), digest)


def replay_episode(
    recorded: RecordedEpisode,
    camera: CameraChoice = "auto",
    *watches: Watch,
    without_measures: bool = False,
    appearance: Appearance | None = None,
) -> tuple[Episode, Replay]:
    """Return a new Episode for a replay, and the policy that repeats the recorded commands.

    without_measures: compute no measures, for a replay whose result is not needed.
    appearance: of scanned places in pictures, by default that of the recorded episode.
    """
    options = EpisodeOptions(
        seed=recorded.record.setup.seed,
        camera=camera,
        appearance=appearance or appearance_of(recorded.record.setup.renderer),
        gait=recorded.record.setup.gait,
        injections=recorded.record.injections,
    )
    setup = RunSetup.of(options, gait_hash=recorded.record.setup.gait_hash)
    policy = Replay(recorded.log.command)

    def skip_measures(stage: StagedScenario) -> None:
        stage.scorer.skip_measures()

    through = skip_measures if without_measures else None
    episode = Episode(
        recorded.scenario,
        policy.manifest,
        options,
        watches=watches,
        through=through,
        setup=setup,
    )
    return episode, policy


class RecordedAnswers:
    """Recorded answers of a policy, for a replay at its own rate."""

    def __init__(self, log: Log) -> None:
        self._answers = {
            int(tick): (int(delay), v, w) for tick, delay, v, w in log.answers.tolist()
        }
        sizes = log.plan_sizes if len(log.plan_sizes) else np.zeros(len(self._answers), int)
        plans = np.split(log.plan_points, np.cumsum(sizes)[:-1]) if len(sizes) else []
        self._plans = dict(zip(self._answers, plans, strict=True))

    def at(self, tick: int) -> tuple[Command, int]:
        """Return the answer to the observation of a tick, and its delay in ticks.

        Raises RunError for an observation that the policy did not answer.
        """
        if tick not in self._answers:
            raise RunError(f"the record has no answer at tick {tick}: not the same")
        delay, v_mps, w_radps = self._answers[tick]
        plan = self._plans[tick]
        if len(plan):
            return WaypointCommand(v_mps, w_radps, plan, 0), delay
        return Command(v_mps, w_radps), delay


def observed_replay(
    recorded: RecordedEpisode, manifest: Manifest, camera: CameraChoice = "auto"
) -> tuple[Episode, RecordedAnswers]:
    """Return a new Episode that observes with a manifest at the recorded rate, and the answers.

    It records only the state hash.

    manifest: sensors of the observations; its rate is that of the record.
    """
    setup = recorded.record.setup
    options = EpisodeOptions(
        seed=setup.seed,
        camera=camera,
        appearance=appearance_of(setup.renderer),
        gait=setup.gait,
        injections=recorded.record.injections,
        own_camera=True,
        real_time=setup.real_time,
    )
    of_replay = RunSetup.of(options, gait_hash=setup.gait_hash)
    episode = Episode(recorded.scenario, manifest, options, through=_only_hash, setup=of_replay)
    return episode, RecordedAnswers(recorded.log)


def _only_hash(stage: StagedScenario) -> None:
    stage.scorer.only_hash()


def replay_state_hash(
    recorded: RecordedEpisode, *watches: Watch, progress: Progress = ignore
) -> str:
    """Replay an episode, and return its state hash."""
    return _again(recorded, progress, *watches)[0]


def replay_and_compare(
    recorded: RecordedEpisode, progress: Progress = ignore
) -> tuple[str, DelayComparison]:
    """Replay an episode, then its street without the robot; return the state hash and the
    delays."""
    tracker = CounterfactualTracker()
    state_hash, entrances = _again(recorded, progress, tracker.watch)
    return state_hash, tracker.compared(
        recorded.scenario, entrances, partial(progress, "the street without the robot")
    )


def _again(recorded: RecordedEpisode, progress: Progress, *watches: Watch) -> tuple[str, Entrances]:
    def watch(step: Step, _: Verdict) -> None:
        progress(f"replaying {recorded.scenario.id}", step.tick / len(recorded.log))

    progress("starting SUMO and PyBullet")
    episode, policy = replay_episode(recorded, "auto", watch, *watches)
    with episode:
        drive(episode, policy)
        return episode.result()[0].state_hash, episode.entrances


class ReplayChecker:
    """Checker that every tick of a replay equals the recorded trajectory to the bit.

    Compared are the robot's pose, speeds and command, its route position, its resets and the
    distance to the nearest person.
    """

    def __init__(self, folder: Path, recorded: RecordedEpisode) -> None:
        self._folder = folder
        self._recorded = recorded
        self._footprint_m = robot_called(recorded.scenario.robot).footprint_m

    def watch(self, step: Step, verdict: Verdict) -> None:
        """Check the next tick. Raises RunError if it differs from the recorded one."""
        if not self._recorded.log.same(Tick(step, verdict, self._footprint_m, RoadState())):
            raise replay_mismatch(
                self._folder, self._recorded, f"from {Clock().time_s(step.tick):g} s on"
            )


def check_state_hash(folder: Path, recorded: RecordedEpisode, state_hash: str) -> None:
    """Check the state hash of a replay. Raises RunError if it differs from the recorded one."""
    if state_hash != recorded.record.state_hash:
        raise replay_mismatch(
            folder, recorded, f"{state_hash[:16]}, recorded {recorded.record.state_hash[:16]}"
        )


def replay_mismatch(folder: Path, recorded: RecordedEpisode, what: str) -> RunError:
    """Return the error for a replay that differs from the record. what: the difference."""
    name = recorded.record.scenario.id
    return RunError(
        f"{folder}: '{name}' was not the same when it was replayed ({what}). The record is "
        f"{_origin_in_words(recorded)}, or it was changed. Replay it with the code and the files "
        "that made it, or run it again."
    )


def _origin_in_words(recorded: RecordedEpisode) -> str:
    """Return what differs between the origin of a record and this machine, in words."""
    robot = robot_called(recorded.scenario.robot)
    if recorded.robot_hash not in ("", digest := robot_hash(robot)):
        return (
            f"of robot '{robot.name}' with hash {recorded.robot_hash}, and its row and files here "
            f"have hash {digest}"
        )
    here, there = versions(), recorded.record.setup.versions
    changed = [
        f"{name} {there.get(name)}, here {here[name]}"
        for name in here
        if here[name] != there.get(name)
    ]
    if changed:
        return f"made with other versions: {'; '.join(changed)}"
    return "of the same versions: of other code"
