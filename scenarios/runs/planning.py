"""Planning of a run: its policy, its seed and its identity (`RunSpec`)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import msgspec

from cosim.core.errors import UsageError
from cosim.episode.interfaces import Policy
from cosim.episode.manifest_checks import check_camera, with_goal
from cosim.episode.policy_caller import PolicyCaller
from cosim.policies.user_module import importable_name
from cosim.results.run_folder import RunFolder, check_begun, read_spec
from cosim.results.run_setup import RunSetup
from cosim.results.run_spec import RunSpec, Shard
from cosim.spec.episode_id import random_run_seed
from cosim.spec.options import EpisodeOptions, PolicyHost
from cosim.spec.robot import robot_called
from cosim.spec.run_config import RunConfig
from cosim.spec.scenario import Scenario, Suite
from cosim.spec.selection import scenario_pairs
from physics.cameras.choice import camera_of_choice as chosen_camera
from physics.cameras.choice import renderer_of
from physics.dynamics.drives import gait_hash
from physics.robots import robot_hash
from physics.robots.check import check_robot
from scenarios.ipc.deadlines import Patience
from scenarios.ipc.messages import Hello
from scenarios.runs.policy_host import inspected_caller, settled_host
from scenarios.runs.shared_renderer import check_shared
from scenarios.runs.transport import LockedRun


class PlannedRun(NamedTuple):
    """A run whose policy is loaded and whose seed is drawn.

    suite: its suite, before a robot is applied, so that runs of several robots have the same suite.
    selected: the scenarios selected from the suite, with the robot of the run.
    shard: the part of them that is run here, None for all.
    policy: name of the policy.
    caller: the policy as loaded in this process.
    options: of each episode, with the seed of the run and the camera of this machine.
    host: where episodes query the policy.
    patience: timeouts of the policy.
    """

    config: RunConfig
    suite: Suite
    selected: Sequence[Scenario]
    shard: Shard | None
    policy: str
    caller: PolicyCaller
    options: EpisodeOptions
    host: PolicyHost
    patience: Patience

    @property
    def scenarios(self) -> Sequence[Scenario]:
        """Return the scenarios that are run here."""
        if self.shard is None:
            return self.selected
        return [one for pair in self.shard.select(scenario_pairs(self.selected)) for one in pair]

    @property
    def spec(self) -> RunSpec:
        """Return the identity of the run. Raises UsageError."""
        shared = self.config.shared_renderer
        return run_spec(
            self.suite, self.selected, self.policy, self.caller, self.options, shared, self.shard
        )


def planned_run(
    config: RunConfig,
    suite: Suite,
    selected: Sequence[Scenario],
    *,
    policy: Policy | None = None,
    options: EpisodeOptions | None = None,
    host: PolicyHost = PolicyHost(),  # noqa: B008  a frozen value
) -> PlannedRun:
    """Load the policy of a run and draw its seed, without building its places.

    policy: an object that drives in this process, in place of the config's name.
    options: in place of the config's.
    Raises UsageError, MachineError.
    """
    options = EpisodeOptions.from_config(config) if options is None else options
    resumed = config.out if config.resume else None
    name = (
        importable_name(config.policy)
        if policy is None
        else f"{type(policy).__module__}:{type(policy).__qualname__}"
    )
    part = Shard.parse(config.shard, len(scenario_pairs(selected))) if config.shard else None
    if part is not None and options.seed is None and resumed is None:
        raise UsageError(
            "--shard needs --seed: shards are of one run, which has one seed: give the same to each"
        )
    patience = Patience(config.answer_timeout, config.start_timeout)
    jobs = 1 if config.on else config.jobs or 1
    caller = (
        inspected_caller(name, host, jobs, patience.start_s)
        if policy is None
        else PolicyCaller.of(policy)
    )
    host = settled_host(host, caller)
    camera = chosen_camera(options.camera) if caller.manifest.camera is not None else "bullet"
    seed = seed_of_run(options.seed, resumed)
    options = msgspec.structs.replace(options, seed=seed, camera=camera)
    check_real_time(options, jobs, config.shared_renderer)
    if config.shared_renderer:
        check_shared(caller, camera)
    return PlannedRun(config, suite, selected, part, name, caller, options, host, patience)


def check_folder(plan: PlannedRun, folder: Path) -> None:
    """Check that the run can continue in a folder. Raises RunError, UsageError."""
    _run_folder(plan, folder)


@contextmanager
def locked_run(plan: PlannedRun, folder: Path) -> Iterator[LockedRun]:
    """Create or resume the run folder, and lock it until the end of the block.

    Raises RunError for a folder of another run.
    """
    run_folder = _run_folder(plan, folder)
    hello = Hello(
        plan.policy,
        plan.caller.manifest,
        plan.caller.source_hash,
        host=msgspec.structs.replace(plan.host, hidden=(str(folder.absolute()),)),
        patience=plan.patience,
    )
    with run_folder:
        done = run_folder.finished_ids()
        todo = [one for one in plan.scenarios if one.id not in done]
        yield LockedRun(run_folder, hello, plan.scenarios, todo)


def _run_folder(plan: PlannedRun, folder: Path) -> RunFolder:
    if plan.config.resume:
        return RunFolder.resume(folder, plan.spec, plan.suite)
    suite = msgspec.structs.replace(plan.suite, scenarios=tuple(plan.selected))
    return RunFolder.create(folder, plan.spec, suite)


def run_spec(
    suite: Suite,
    scenarios: Sequence[Scenario],
    policy: str,
    caller: PolicyCaller,
    options: EpisodeOptions,
    shared: bool = False,
    shard: Shard | None = None,
) -> RunSpec:
    """Build the identity of a run.

    suite: the suite before robot and weather are applied.
    scenarios: the scenarios of the run, with its robot and weather.
    policy: name of the policy.
    shared: whether one renderer draws for all episodes.
    shard: the part of the run in the folder, None for all.
    Raises UsageError if a robot lacks the policy's camera, unless the options allow an own camera,
    if the policy does not support the goal, or if the gait does not fit the robot. Raises SpecError
    if a robot's row or URDF is invalid.
    """
    manifest = with_goal(caller.manifest, options.goal)
    robots = [robot_called(name) for name in sorted({one.robot for one in scenarios})]
    if manifest.camera is not None:
        for robot in robots:
            check_camera(manifest, robot, options.own_camera)
    for robot in robots:
        check_robot(robot)
    gaits = [gait_hash(options.gait, robot) for robot in robots]
    setup = RunSetup.of(
        options,
        suite_hash=suite.content_hash,
        policy_source=caller.source_hash,
        policy_runs=caller.runs,
        gait_hash=gaits[0] if gaits else "",
    )
    if manifest.camera is not None:
        drawn_by = renderer_of(chosen_camera(options.camera), options.appearance)
        setup = msgspec.structs.replace(setup, renderer=drawn_by)
    return RunSpec(
        suite=suite.name,
        robots={robot.name: robot_hash(robot) for robot in robots},
        suite_version=suite.version,
        policy=policy,
        manifest=manifest,
        setup=setup,
        scenarios=tuple(s.id for s in scenarios),
        weather=options.weather,
        counterfactual=options.counterfactual,
        shared_renderer=shared,
        shard=shard,
    )


def check_real_time(options: EpisodeOptions, jobs: int, shared: bool) -> None:
    """Check that the answers of a run in real time do not wait for those of other episodes. Raises
    UsageError."""
    if options.real_time and (jobs != 1 or shared):
        cause = "a shared renderer" if shared else f"{jobs} jobs"
        raise UsageError(
            f"in real time every answer is timed, and {cause} would be timed too: take one "
            f"job, without it"
        )


def seed_of_run(requested: int | None, resumed: Path | None) -> int:
    """Return the requested seed; else that of the resumed run; else a random one."""
    if requested is not None:
        return requested
    if resumed is None:
        return random_run_seed()
    check_begun(resumed)
    return read_spec(resumed).setup.seed
