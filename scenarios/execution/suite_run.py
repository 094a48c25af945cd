"""run(suite, policy) -> table: a suite run from Python, in this process or in several, into a run folder or none."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

import msgspec
import pandas as pd

from cosim.core.errors import UsageError
from cosim.core.versions import versions
from cosim.episode.camera_rules import check_camera
from cosim.episode.driver import Driver
from cosim.episode.given import with_goal
from cosim.episode.ports import Policy
from cosim.records.record import METRIC_SCHEMA, NO_RENDERER
from cosim.records.run_folder import RunFolder, read_spec
from cosim.records.run_spec import RunSpec, Shard
from cosim.spec.options import EpisodeOptions
from cosim.spec.policy_host import PolicyHost
from cosim.spec.pseudonym import drawn_seed
from cosim.spec.robot import robot_called
from cosim.spec.scenario import Scenario, Suite
from physics.cameras.choice import camera_of_choice as chosen_camera
from physics.cameras.choice import renderer_of
from physics.robots import hash_of_robot
from scenarios.builders.fits import check_places
from scenarios.catalog import load_suite, scenarios_chosen, with_robot
from scenarios.execution.messages import Hear, Hello
from scenarios.execution.pool import run_all
from scenarios.execution.process import LocalProcesses
from scenarios.execution.transport import InProcess, Transport
from scenarios.rendering.shared import SharedRenderer, check_shared
from scenarios.serving.drivers import known_driver


def _untold(message: object) -> None:
    """Nobody wants to know."""


def run(
    suite: Suite | str,
    policy: Policy | str = "route",
    *,
    episodes: int | None = None,
    scenarios: Sequence[str] = (),
    events: Sequence[str] = (),
    jobs: int = 1,
    out: str | Path | None = None,
    resume: bool = False,
    shared_renderer: bool = False,
    host: PolicyHost = PolicyHost(),  # noqa: B008  a frozen value
    options: EpisodeOptions = EpisodeOptions(),  # noqa: B008  a frozen value
    tell: Hear = _untold,
) -> pd.DataFrame:
    """Run a suite with a policy; one row per episode, sorted by scenario, as in `results.csv`.

    suite: one that was loaded, or a name or path as for `load_suite`. policy: an object, which drives in this process,
    one episode after another; or a name, as "orca" or "package.module:Class", which drives in `jobs` processes that
    survive whatever it does. episodes, scenarios, events: run only the first so many, these ids, these kinds of events.
    out: the run folder, to be kept and resumed; without one only the table is. shared_renderer: one process draws for
    all the others and, if the policy has `act_batch`, asks it (`BatchPolicy`). host: where a named policy is asked:
    `PolicyHost(isolated=True)` gives it a process of its own. options: without a seed one is drawn anew, or taken from
    the run that is resumed; it stands in every row (`run_seed`). tell: takes in what workers say of their episodes.

    Raises UsageError for names and options that do not exist, SpecError for scenarios that do not fit their places,
    RunError for a folder that is of another run, MachineError when engines cannot start. An episode that fails is a row
    with status "crashed".

    >>> run("reactive", "straight", scenarios=["obstructing-001"])[["scenario", "success"]].to_dict("records")
    [{'scenario': 'obstructing-001', 'success': 0.0}]
    """
    if not isinstance(policy, str) and (jobs != 1 or shared_renderer or host.isolated):
        asked = f"jobs={jobs}" if jobs != 1 else "host" if host.isolated else "shared_renderer=True"
        raise UsageError(
            f"{asked} needs a policy by its name, such as 'package.module:Class': "
            "every process makes one of its own; an object drives in this process alone"
        )
    whole = with_robot(load_suite(suite) if isinstance(suite, str) else suite, options.robot)
    picked = scenarios_chosen(whole, scenarios, episodes, events)
    check_places(whole, picked)
    driver = known_driver(policy, host, jobs) if isinstance(policy, str) else Driver.of(policy)
    name = policy if isinstance(policy, str) else f"{type(policy).__module__}:{type(policy).__qualname__}"
    options = _settled(options, whole, driver, seed_of_run(options.seed, Path(out) if resume and out else None))
    check_alone(options, jobs, shared_renderer)
    asks = shared_renderer and check_shared(driver, chosen_camera(options.camera))
    spec = run_spec(whole, picked, name, driver, options, shared_renderer)
    with ExitStack() as stack:
        folder = Path(out) if out is not None else Path(stack.enter_context(tempfile.TemporaryDirectory())) / "run"
        held = RunFolder.resume(folder, spec) if resume else RunFolder.create(folder, spec, whole)
        stack.enter_context(held)
        done = held.finished()
        todo = [scenario for scenario in picked if scenario.id not in done]
        if isinstance(policy, str):
            transport: Transport = LocalProcesses(held.path / "logs", jobs)
        else:
            transport = InProcess(driver)
        hello = Hello(name, driver.manifest, driver.source_hash, host=host)
        renderer = None
        if shared_renderer and todo:
            renderer = stack.enter_context(SharedRenderer(held.path / "logs", hello, asks=asks))
        run_all(held, todo, hello, transport, tell=tell, options=options, renderer=renderer)
        return held.finish()


def run_spec(
    whole: Suite, picked: Sequence[Scenario], policy: str, driver: Driver, options: EpisodeOptions,
    shared: bool = False, shard: Shard | None = None,
) -> RunSpec:  # fmt: skip
    """What a run is, for its folder. policy: its name; shared: one renderer draws for all of it; shard: what of
    it the folder holds, if not all. Raises UsageError when
    a robot has no such camera, unless one of its own was asked for, or the policy cannot be given what it asks for."""
    manifest = with_goal(driver.manifest, options.goal)
    robots = [robot_called(name) for name in sorted({one.robot for one in picked})]
    if manifest.camera is not None:
        for robot in robots:
            check_camera(manifest, robot, options.own_camera)
    return RunSpec(
        suite=whole.name,
        robots={robot.name: hash_of_robot(robot) for robot in robots},
        suite_version=whole.version,
        metric_schema=METRIC_SCHEMA,
        suite_hash=whole.content_hash,
        policy=policy,
        policy_name=manifest.name,
        policy_version=manifest.version,
        policy_source=driver.source_hash,
        policy_runs=driver.runs,
        waypoints=manifest.waypoints,
        camera=manifest.camera,
        cameras=dict(manifest.cameras),
        rate_hz=manifest.rate_hz,
        goal_protocol=manifest.goal,
        odometry=manifest.odometry,
        latency_ms=options.latency_ms,
        real_time=options.real_time,
        seed=0 if options.seed is None else options.seed,
        scenarios=tuple(s.id for s in picked),
        versions=versions(),
        renderer=renderer_of(chosen_camera(options.camera)) if manifest.camera is not None else NO_RENDERER,
        counterfactual=options.counterfactual,
        shared_renderer=shared,
        shard=shard,
    )


def check_alone(options: EpisodeOptions, jobs: int, shared: bool) -> None:
    """Raises UsageError where the answers of a run in real time would wait for those of other episodes."""
    if options.real_time and (jobs != 1 or shared):
        much = "a shared renderer" if shared else f"{jobs} jobs"
        raise UsageError(f"in real time every answer is timed, and {much} would be timed too: take one job, without it")


class MeasuredLatency(NamedTuple):
    """Medians over an episode. answer_ms: what the policy took for an answer. latency_ms: after what they answer the
    commands took effect, at whole ticks."""

    answer_ms: float
    latency_ms: float


def measured_latency(
    whole: Suite,
    first: Scenario,
    policy: str,
    options: EpisodeOptions,
    host: PolicyHost = PolicyHost(),  # noqa: B008  a frozen value
) -> MeasuredLatency:
    """The latency that a policy shows on this machine in an episode in real time, in a process of its own. Raises
    UsageError when that does not come to its end."""
    alone = EpisodeOptions(
        seed=options.seed, robot=options.robot, goal=options.goal, own_camera=options.own_camera, camera=options.camera,
        real_time=True,
    )  # fmt: skip
    row = run(whole, policy, scenarios=[first.id], options=alone, host=host).iloc[0]
    if not isinstance(row["ended"], str):
        raise UsageError(
            f"the latency of '{policy}' cannot be measured: {first.id} is {row['status']}: {row['reason']}"
        )
    return MeasuredLatency(float(row["answer_ms"]), float(row["latency_ms"]))


def seed_of_run(asked: int | None, resumed: Path | None) -> int:
    """The seed that was asked for; else that of the run that is resumed; else one that is drawn anew."""
    if asked is not None:
        return asked
    return drawn_seed() if resumed is None else read_spec(resumed).seed


def _settled(options: EpisodeOptions, whole: Suite, driver: Driver, seed: int) -> EpisodeOptions:
    """Options with the run's seed, the suite's hash and the one camera of the run."""
    camera = chosen_camera(options.camera) if driver.manifest.camera is not None else "bullet"
    return msgspec.structs.replace(options, seed=seed, suite_hash=whole.content_hash, camera=camera)
