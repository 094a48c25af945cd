"""run(suite, policy) -> table: a suite run from Python, in this process or in several, into a run
folder or none.

What the command line does with options goes the same way: a run is planned, its folder held, what
is left of it run.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path
from typing import NamedTuple

import msgspec
import pandas as pd

from cosim.core.errors import UsageError
from cosim.core.progress import ignore
from cosim.core.versions import versions
from cosim.episode.camera_rules import check_camera
from cosim.episode.interfaces import Policy
from cosim.episode.manifest_checks import with_goal
from cosim.episode.policy_caller import Driver
from cosim.policies.user_module import importable
from cosim.results.record import METRIC_SCHEMA, NO_RENDERER
from cosim.results.run_folder import RunFolder, read_spec, refuse_unbegun
from cosim.results.run_spec import RunSpec, Shard
from cosim.spec.episode_id import drawn_seed
from cosim.spec.options import EpisodeOptions
from cosim.spec.policy_host import PolicyHost
from cosim.spec.robot import robot_called
from cosim.spec.scenario import Scenario, Suite
from cosim.spec.selection import scenarios_chosen
from physics.cameras.choice import camera_of_choice as chosen_camera
from physics.cameras.choice import renderer_of
from physics.robots import hash_of_robot
from scenarios.ipc.deadlines import Patience
from scenarios.ipc.messages import Hello, MessageHandler
from scenarios.runs.local import LocalProcesses
from scenarios.runs.policy_host import known_driver
from scenarios.runs.pool import run_all
from scenarios.runs.shared_renderer import SharedRenderer, check_shared
from scenarios.runs.transport import HeldRun, InProcess, TransportFactory
from scenarios.suites.catalog import load_suite, with_robot
from scenarios.suites.fits import check_places


def run(
    suite: Suite | str,
    policy: Policy | str = "route",
    *,
    episodes: int | None = None,
    scenarios: Sequence[str] = (),
    events: Sequence[str] = (),
    shard: str = "",
    jobs: int | None = None,
    on: str = "",
    out: str | Path | None = None,
    resume: bool = False,
    shared_renderer: bool = False,
    host: PolicyHost = PolicyHost(),  # noqa: B008  a frozen value
    options: EpisodeOptions = EpisodeOptions(),  # noqa: B008  a frozen value
    tell: MessageHandler = ignore,
) -> pd.DataFrame:
    """Run a suite with a policy; one row per episode, sorted by scenario, as in `results.csv`.

    suite: one that was loaded, or a name or path as for `load_suite`. policy: an object, which
    drives in this process, one episode after another; or a name, as "orca" or "my.py:Class", which
    drives in `jobs` processes (one) that survive whatever it does; or, with `on` ("ray", "auto",
    "ray://HOST:10001"), in those of a Ray cluster, as many as it has CPUs. episodes, scenarios,
    events: run only the first so many, these ids, these kinds of events. shard: only a part of
    that, as "1/4", of a run with a seed: `cosim merge` makes one of all. out: the run folder, to be
    kept and resumed; without one only the table is. shared_renderer: one process draws for all the
    others and, if the policy has `act_batch`, asks it (`BatchPolicy`). host: where a named policy
    is asked: `PolicyHost(isolated=True)` gives it a process of its own. options: without a seed one
    is drawn anew, or taken from the run that is resumed; it stands in every row (`run_seed`). tell:
    takes in what workers say of their episodes.

    Raises UsageError for names and options that do not exist, SpecError for scenarios that do not
    fit their places, RunError for a folder that is of another run, MachineError when engines cannot
    start. An episode that fails is a row with status "crashed".

    >>> table = run("reactive", "straight", scenarios=["obstructing-001"])
    >>> table[["scenario", "success"]].to_dict("records")
    [{'scenario': 'obstructing-001', 'success': 0.0}]
    """
    needs = {f"jobs={jobs}": jobs not in (None, 1), f"on='{on}'": on != "", "host": host.isolated}
    asked = next(
        (words for words, is_asked in needs.items() if is_asked),
        "shared_renderer=True" * shared_renderer,
    )
    if asked and not isinstance(policy, str):
        raise UsageError(
            f"{asked} needs a policy by its name, such as 'my.py:Class': "
            "every process makes one of its own; an object drives in this process alone"
        )
    if on:
        from scenarios.runs.ray_workers import by_ray, check_on_ray

        of_here = {
            "shared_renderer": shared_renderer,
            "real_time": options.real_time,
            "live": options.live,
            "pace": options.pace,
        }
        check_on_ray(on, of_here)
    whole = with_robot(load_suite(suite) if isinstance(suite, str) else suite, options.robot)
    of_run = scenarios_chosen(whole, scenarios, episodes, events)
    folder = None if out is None else Path(out)
    plan = planned_run(
        whole,
        of_run,
        policy,
        options,
        shard=shard,
        jobs=1 if on else jobs or 1,
        shared_renderer=shared_renderer,
        host=host,
        resumed=folder if resume else None,
    )
    check_places(whole, plan.picked)
    with ExitStack() as stack:
        if on:
            reaches = stack.enter_context(by_ray(on, jobs, plan.policy, ignore))
        else:
            reaches = (
                by_processes(jobs or 1) if isinstance(policy, str) else in_this_process(plan.driver)
            )
        folder = folder or Path(stack.enter_context(tempfile.TemporaryDirectory())) / "run"
        held = stack.enter_context(held_run(plan, folder, resume=resume))
        run_what_is_left(plan, held, reaches, tell)
        return held.held.finish()


class PlannedRun(NamedTuple):
    """What is to be run. of_run: of the suite `whole`; shard: which part of that, where not all;
    policy: its name; driver: it, as it was loaded here; options: with the run's seed and camera;
    shared_renderer: whether one process draws for all the others."""

    whole: Suite
    of_run: Sequence[Scenario]
    shard: Shard | None
    policy: str
    driver: Driver
    options: EpisodeOptions
    host: PolicyHost
    patience: Patience
    shared_renderer: bool

    @property
    def picked(self) -> Sequence[Scenario]:
        """What is run of it here."""
        return self.of_run if self.shard is None else self.shard.share(self.of_run)

    @property
    def spec(self) -> RunSpec:
        """What it is, for its folder. Raises UsageError."""
        return run_spec(
            self.whole,
            self.of_run,
            self.policy,
            self.driver,
            self.options,
            self.shared_renderer,
            self.shard,
        )


def planned_run(
    whole: Suite,
    of_run: Sequence[Scenario],
    policy: Policy | str,
    options: EpisodeOptions,
    *,
    shard: str = "",
    jobs: int = 1,
    shared_renderer: bool = False,
    host: PolicyHost = PolicyHost(),  # noqa: B008  a frozen value
    patience: Patience = Patience(),
    resumed: Path | None = None,
) -> PlannedRun:
    """A run, once its policy is loaded and its seed drawn; its places have not been looked at.
    shard: "1/4"; resumed: the folder of the run that it goes on with. Raises UsageError,
    MachineError."""
    policy = importable(policy) if isinstance(policy, str) else policy
    part = Shard.called(shard, len(of_run)) if shard else None
    if part is not None and options.seed is None and resumed is None:
        raise UsageError(
            "--shard needs --seed: shards are of one run, which has one seed: give the same to each"
        )
    driver = (
        known_driver(policy, host, jobs, patience.start_s)
        if isinstance(policy, str)
        else Driver.of(policy)
    )
    name = (
        policy
        if isinstance(policy, str)
        else f"{type(policy).__module__}:{type(policy).__qualname__}"
    )
    camera = chosen_camera(options.camera) if driver.manifest.camera is not None else "bullet"
    seed = seed_of_run(options.seed, resumed)
    options = msgspec.structs.replace(
        options, seed=seed, suite_hash=whole.content_hash, camera=camera
    )
    check_alone(options, jobs, shared_renderer)
    if shared_renderer:
        check_shared(driver, camera)
    return PlannedRun(whole, of_run, part, name, driver, options, host, patience, shared_renderer)


@contextmanager
def held_run(plan: PlannedRun, folder: Path, *, resume: bool) -> Iterator[HeldRun]:
    """The run in its folder, begun there, or to be gone on with. Raises RunError for a folder of
    another run."""
    held = (
        RunFolder.resume(folder, plan.spec, plan.whole)
        if resume
        else RunFolder.create(folder, plan.spec, plan.whole)
    )
    hello = Hello(
        plan.policy,
        plan.driver.manifest,
        plan.driver.source_hash,
        host=plan.host,
        patience=plan.patience,
    )
    with held:
        done = held.finished()
        yield HeldRun(held, hello, plan.picked, [one for one in plan.picked if one.id not in done])


def run_what_is_left(
    plan: PlannedRun, run: HeldRun, reaches: TransportFactory, tell: MessageHandler
) -> None:
    """Run what is to be run of it, by workers that are reached so. Raises MachineError,
    UsageError."""
    if not run.todo:
        return
    with ExitStack() as stack:
        renderer = None
        if plan.shared_renderer:
            asks = check_shared(plan.driver, chosen_camera(plan.options.camera))
            drawing = SharedRenderer(
                run.held.path / "logs", run.hello, asks=asks, patience=plan.patience
            )
            renderer = stack.enter_context(drawing)
        transport, tell = stack.enter_context(reaches(run, tell))
        run_all(
            run.held,
            run.todo,
            run.hello,
            transport,
            tell=tell,
            options=plan.options,
            renderer=renderer,
        )


def by_processes(jobs: int) -> TransportFactory:
    """Workers that are so many processes of this machine."""
    return lambda run, tell: nullcontext((LocalProcesses(run.held.path / "logs", jobs), tell))


def in_this_process(driver: Driver) -> TransportFactory:
    """This process is the worker."""
    return lambda run, tell: nullcontext((InProcess(driver), tell))


def run_spec(
    whole: Suite,
    picked: Sequence[Scenario],
    policy: str,
    driver: Driver,
    options: EpisodeOptions,
    shared: bool = False,
    shard: Shard | None = None,
) -> RunSpec:
    """What a run is, for its folder. policy: its name; shared: one renderer draws for all of it;
    shard: what of it the folder holds, if not all. Raises UsageError when a robot has no such
    camera, unless one of its own was asked for, or the policy cannot be given what it asks for."""
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
        renderer=renderer_of(chosen_camera(options.camera))
        if manifest.camera is not None
        else NO_RENDERER,
        counterfactual=options.counterfactual,
        shared_renderer=shared,
        shard=shard,
    )


def check_alone(options: EpisodeOptions, jobs: int, shared: bool) -> None:
    """Raises UsageError where the answers of a run in real time would wait for those of other
    episodes."""
    if options.real_time and (jobs != 1 or shared):
        much = "a shared renderer" if shared else f"{jobs} jobs"
        raise UsageError(
            f"in real time every answer is timed, and {much} would be timed too: take one "
            f"job, without it"
        )


class MeasuredLatency(NamedTuple):
    """Medians over an episode. answer_ms: what the policy took for an answer. latency_ms: after
    what they answer the commands took effect, at whole ticks."""

    answer_ms: float
    latency_ms: float


def measured_latency(
    whole: Suite,
    first: Scenario,
    policy: str,
    options: EpisodeOptions,
    host: PolicyHost = PolicyHost(),  # noqa: B008  a frozen value
) -> MeasuredLatency:
    """The latency that a policy shows on this machine in an episode in real time, in a process of
    its own. Raises UsageError when that does not come to its end."""
    alone = EpisodeOptions(
        seed=options.seed,
        robot=options.robot,
        goal=options.goal,
        own_camera=options.own_camera,
        camera=options.camera,
        real_time=True,
    )
    row = run(whole, policy, scenarios=[first.id], options=alone, host=host).iloc[0]
    if not isinstance(row["ended"], str):
        raise UsageError(
            f"the latency of '{policy}' cannot be measured: {first.id} is {row['status']}: "
            f"{row['reason']}"
        )
    return MeasuredLatency(float(row["answer_ms"]), float(row["latency_ms"]))


def seed_of_run(asked: int | None, resumed: Path | None) -> int:
    """The seed that was asked for; else that of the run that is resumed; else one that is drawn
    anew."""
    if asked is not None:
        return asked
    if resumed is None:
        return drawn_seed()
    refuse_unbegun(resumed)
    return read_spec(resumed).seed
