"""Run of a suite, for the command line and for `cosim.run`."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import msgspec
import pandas as pd

from bridge import keys
from bridge.session import connection_warnings, open_session
from cosim.core.errors import UsageError
from cosim.core.progress import Progress, ignore
from cosim.core.units import milliseconds
from cosim.episode.interfaces import Policy
from cosim.episode.policy_caller import PolicyCaller
from cosim.results.run_folder import check_begun, check_unused, read_spec
from cosim.spec.connection import Connection
from cosim.spec.injection import LiveAddress
from cosim.spec.options import DirectorAddress, EpisodeOptions, PolicyHost
from cosim.spec.robot import COURIER, robot_called
from cosim.spec.run_config import RunConfig, RunConnections
from cosim.spec.scenario import Scenario, Suite, split_called
from cosim.spec.selection import select_scenarios
from physics.robots.check import check_robot
from scenarios.ipc.messages import MessageHandler
from scenarios.runs.local import InProcess, LocalProcesses
from scenarios.runs.planning import PlannedRun, check_folder, locked_run, planned_run
from scenarios.runs.policy_host import host_of
from scenarios.runs.pool import run_all
from scenarios.runs.shared_renderer import SharedRenderer
from scenarios.runs.transport import LockedRun, TransportFactory
from scenarios.suites.catalog import load_suite, with_crowd
from scenarios.suites.fits import LOOKING, check_places
from scenarios.suites.sample import suite_on_map

WorkerConnection = AbstractContextManager[TransportFactory]
"""Connection to the workers of a run."""
_VEHICLES_SHARE = 2 / 3
"""Number of vehicles for each person of a crowd that is set by an option."""


class RunObjects(NamedTuple):
    """Objects of a Python caller, in place of names in a config. The default folder of such a run
    is temporary."""

    suite: Suite | None = None
    policy: Policy | None = None
    options: EpisodeOptions | None = None
    host: PolicyHost = PolicyHost()


class Reporter(Protocol):
    """Display of the progress of a run (`cosim.cli.run_display`)."""

    def say(self, words: str) -> None:
        """Show a line."""

    def stage(self, words: str) -> AbstractContextManager[Progress]:
        """Show a stage until the block ends, and return its progress callback."""

    def planned(self, plan: PlannedRun) -> None:
        """Show a plan; called when the policy is loaded, before places are built."""

    def opening(self, plan: PlannedRun, folder: Path) -> AbstractContextManager[None]:
        """Show a run: entered before workers are connected and files written, until the end."""

    def running(self, plan: PlannedRun, run: LockedRun) -> AbstractContextManager[MessageHandler]:
        """Show progress: entered while episodes run, returns the handler of workers' messages."""


class Silent(NamedTuple):
    """Reporter that shows nothing. tell: called with the messages of workers."""

    tell: MessageHandler = ignore

    def say(self, words: str) -> None: ...

    def stage(self, words: str) -> AbstractContextManager[Progress]:
        return nullcontext(ignore)

    def planned(self, plan: PlannedRun) -> None: ...

    def opening(self, plan: PlannedRun, folder: Path) -> AbstractContextManager[None]:
        return nullcontext()

    def running(self, plan: PlannedRun, run: LockedRun) -> AbstractContextManager[MessageHandler]:
        return nullcontext(self.tell)


def run(
    suite: Suite | str,
    policy: Policy | str = "route",
    *,
    episodes: int | None = None,
    scenarios: Sequence[str] = (),
    events: Sequence[str] = (),
    decoys: bool = True,
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
    """Run a suite with a policy. Returns a row per episode, sorted by scenario, as `results.csv`.

    suite: a loaded one, or a name or path as for `load_suite`.
    policy: an object, which drives in this process; or a name, as "my.py:Class", which drives in
        `jobs` processes that survive its errors.
    episodes, scenarios, events: run only the first episodes, these ids, these kinds of events.
    decoys: whether the decoys of these are run too; never with `scenarios`, which names each.
    shard: run only a part of them, as "1/4", of a run with a seed; `cosim merge` joins the parts.
    on: a Ray cluster ("ray", "auto", "ray://HOST:10001"), by default with a worker for each CPU.
    out: the run folder; without one only the table is returned.
    resume: continue the run in `out`.
    shared_renderer: draw in one process for all others, which also queries a policy with
        `act_batch` (`BatchPolicy`).
    host: where a named policy is queried: `PolicyHost(isolated="auto")` gives it a sandbox.
    options: options of the episodes; without a seed it is random, or that of the resumed run.
    tell: called with the messages of workers.

    A failed episode is a row with status "crashed". Raises UsageError, SpecError, RunError,
    MachineError.

    >>> table = run("reactive", "straight", scenarios=["obstructing-001"])
    >>> table[["scenario", "success"]].to_dict("records")
    [{'scenario': 'obstructing-001', 'success': 0.0}]
    """
    _refuse_for_object(policy, jobs, on, host, shared_renderer)
    config = RunConfig(
        suite=suite if isinstance(suite, str) else suite.name,
        policy=policy if isinstance(policy, str) else "",
        episodes=episodes,
        scenario=tuple(scenarios),
        event=tuple(events),
        no_decoys=not decoys,
        shard=shard,
        jobs=jobs,
        on=on,
        out=None if out is None else Path(out),
        resume=resume,
        shared_renderer=shared_renderer,
        robot=options.robot,
        weather=options.weather,
        real_time=options.real_time,
        pace=options.pace,
        latency=repr(options.latency_ms) if options.latency_ms else "",
    )
    objects = RunObjects(
        suite=None if isinstance(suite, str) else suite,
        policy=None if isinstance(policy, str) else policy,
        options=options,
        host=host,
    )
    return execute_run(config, objects=objects, reporter=Silent(tell))


def _refuse_for_object(
    policy: Policy | str, jobs: int | None, on: str, host: PolicyHost, shared: bool
) -> None:
    """Check that a policy object is not used with other processes. Raises UsageError."""
    needs = {
        f"jobs={jobs}": jobs not in (None, 1),
        f"on='{on}'": on != "",
        "host": host.isolated != "no",
    }
    option = next(
        (words for words, is_set in needs.items() if is_set), "shared_renderer=True" * shared
    )
    if option and not isinstance(policy, str):
        raise UsageError(
            f"{option} needs a policy by its name, such as 'my.py:Class': "
            "every process makes one of its own; an object drives in this process alone"
        )


def execute_run(
    config: RunConfig,
    *,
    objects: RunObjects | None = None,
    reporter: Reporter = Silent(),  # noqa: B008  a frozen value
    workers: WorkerConnection | None = None,
) -> pd.DataFrame:
    """Run a config, and return the table of its results.

    objects: objects in place of names in the config.
    reporter: shows progress.
    workers: connects to workers, in place of those that the config requests.
    Raises what `run` raises.
    """
    ends = config.ends
    _check_ros2(config, workers)
    for line in (line for end in ends.all for line in connection_warnings(end)):
        reporter.say(line)
    _check_cluster(config, objects)
    if config.robot:
        check_robot(robot_called(config.robot))
    if config.out is not None:
        (check_begun if config.resume else check_unused)(config.out)
    suite = _loaded(config, objects, reporter)
    selected = select_scenarios(
        suite,
        config.scenario,
        config.episodes,
        config.event,
        split_called(config.split),
        decoys=not config.no_decoys,
    )
    selected = tuple(
        scenario.driven_by(config.robot).in_weather(config.weather) for scenario in selected
    )
    plan = _planned(config, objects, suite, selected, ends)
    reporter.planned(plan)
    with ExitStack() as stack:
        folder = config.out or _default_folder(plan, stack, temporary=objects is not None)
        plan = _checked(plan, folder, reporter, 1 if objects else _checking_jobs(config, workers))
        stack.enter_context(reporter.opening(plan, folder))
        create_transport = stack.enter_context(workers or _workers(plan, objects, reporter))
        plan = stack.enter_context(_connected(plan, folder, ends, reporter))
        run = stack.enter_context(locked_run(plan, folder))
        with reporter.running(plan, run) as handle:
            _run_todo(plan, run, create_transport, handle)
        return run.folder.finish()


def _check_cluster(config: RunConfig, objects: RunObjects | None) -> None:
    """Check that a cluster supports the options of a run. Raises UsageError."""
    if not config.on:
        return
    from scenarios.runs.ray_workers import check_on_ray  # slow: the importer of maps comes with it

    local_options: dict[str, Any] = {
        "shared_renderer": config.shared_renderer,
        "real_time": config.real_time,
        "live": config.live if objects is None or objects.options is None else objects.options.live,
        "pace": config.pace,
        "rerun": config.rerun,
    }
    words = {name: name if objects else f"--{name.replace('_', '-')}" for name in local_options}
    check_on_ray(config.on, {words[name]: is_set for name, is_set in local_options.items()})


def _check_ros2(config: RunConfig, workers: WorkerConnection | None) -> None:
    """Check that a ROS 2 node and its environment processes are on one network. Raises
    UsageError."""
    if config.ros2 is not None and (config.on or workers is not None):
        raise UsageError(
            f"policy '{config.policy}' drives in the processes of this machine: use `cosim run` "
            "without --on"
        )


def _loaded(config: RunConfig, objects: RunObjects | None, reporter: Reporter) -> Suite:
    """Load the suite of a run, with its crowd. Raises UsageError, SpecError, MapError."""
    if objects is not None and objects.suite is not None:
        suite = objects.suite
    elif config.map is not None:
        with reporter.stage(f"drawing routes on {config.map}"):
            suite = suite_on_map(
                config.suite,
                config.map,
                config.seed or 0,
                config.episodes,
                config.roughness or 0.0,
                config.event,
                robot=robot_called(config.robot or COURIER.name),
            )
        reporter.say(suite.description)
    else:
        suite = load_suite(config.suite)
    return with_crowd(
        suite,
        persons=config.crowd,
        vehicles=None if config.crowd is None else round(_VEHICLES_SHARE * config.crowd),
        residents=config.residents,
        groups=config.groups,
        elderly=config.elderly,
        children=config.children,
    )


def _planned(
    config: RunConfig,
    objects: RunObjects | None,
    suite: Suite,
    selected: Sequence[Scenario],
    ends: RunConnections,
) -> PlannedRun:
    if objects is not None:
        return planned_run(
            config,
            suite,
            selected,
            policy=objects.policy,
            options=objects.options,
            host=objects.host,
        )
    return planned_run(config, suite, selected, host=host_of(config, ends.servers))


def _default_folder(plan: PlannedRun, stack: ExitStack, *, temporary: bool) -> Path:
    """Return the default run folder."""
    if temporary:
        return Path(stack.enter_context(tempfile.TemporaryDirectory())) / "run"
    stamp = datetime.now().strftime("%Y%m%d-%H%M%S")
    shard = "" if plan.shard is None else f"-{plan.shard.number}-of-{plan.shard.of}"
    return Path("runs") / f"{plan.suite.name}-{plan.caller.manifest.name}-{stamp}{shard}"


def _checking_jobs(config: RunConfig, workers: WorkerConnection | None) -> int:
    """Return the number of processes that check places."""
    return (config.jobs or 1) if workers is None and not config.on else len(os.sched_getaffinity(0))


def _checked(plan: PlannedRun, folder: Path, reporter: Reporter, jobs: int) -> PlannedRun:
    """Check folder and places of a run, and measure its latency if the config requests it."""
    latency_ms = plan.config.latency_ms
    if latency_ms is None and plan.config.resume:
        latency_ms = read_spec(folder).setup.latency_ms
    if latency_ms is not None:
        plan = _with_latency(plan, latency_ms)
    if plan.config.resume:
        check_folder(plan, folder)
    with reporter.stage(LOOKING) as looking:
        check_places(plan.suite, plan.scenarios, looking, jobs)
    return _with_latency(plan, _measured(plan, reporter)) if latency_ms is None else plan


def _with_latency(plan: PlannedRun, latency_ms: float) -> PlannedRun:
    return plan._replace(options=msgspec.structs.replace(plan.options, latency_ms=latency_ms))


def _measured(plan: PlannedRun, reporter: Reporter) -> float:
    """Measure the latency of the policy in the first episode, in ms, and report it."""
    first = plan.scenarios[0]
    with reporter.stage(f"measuring the latency of {plan.policy} in {first.id}"):
        answer_ms, latency_ms = measured_latency(
            plan.suite, first, plan.policy, plan.options, plan.host
        )
    reporter.say(
        f"Latency {latency_ms:g} ms for every command of this run: in {first.id} an answer took "
        f"{milliseconds(answer_ms)} (median), and commands take effect at whole ticks of 50 ms."
    )
    if latency_ms > (period_ms := 1000.0 / plan.caller.manifest.rate_hz):
        reporter.say(
            f"That is longer than its period of {period_ms:g} ms, at which it is still queried. "
            "With --real-time it is not queried again before it has answered."
        )
    return latency_ms


class MeasuredLatency(NamedTuple):
    """Medians over an episode, in ms.

    answer_ms: time of an answer of the policy.
    latency_ms: time until its command takes effect, in whole ticks.
    """

    answer_ms: float
    latency_ms: float


def measured_latency(
    suite: Suite,
    first: Scenario,
    policy: str,
    options: EpisodeOptions,
    host: PolicyHost = PolicyHost(),  # noqa: B008  a frozen value
) -> MeasuredLatency:
    """Measure the latency of a policy in an episode in real time, in a separate process. Raises
    UsageError if the episode does not end."""
    real_time = EpisodeOptions(
        seed=options.seed,
        robot=options.robot,
        weather=options.weather,
        goal=options.goal,
        own_camera=options.own_camera,
        camera=options.camera,
        appearance=options.appearance,
        real_time=True,
    )
    row = run(suite, policy, scenarios=[first.id], options=real_time, host=host).iloc[0]
    if not isinstance(row["ended"], str):
        raise UsageError(
            f"the latency of '{policy}' cannot be measured: {first.id} is {row['status']}: "
            f"{row['reason']}"
        )
    return MeasuredLatency(float(row["answer_ms"]), float(row["latency_ms"]))


def _workers(plan: PlannedRun, objects: RunObjects | None, reporter: Reporter) -> WorkerConnection:
    """Return the connection to the workers of a run: on Ray, this process, or child processes."""
    if plan.config.on:
        from scenarios.runs.ray_workers import ray_workers

        return ray_workers(plan.config.on, plan.config.jobs, plan.policy, reporter.say)
    if objects is not None and objects.policy is not None:
        return nullcontext(partial(_in_this_process, plan.caller))
    return nullcontext(partial(_local_processes, plan.config.jobs or 1))


def _local_processes(
    jobs: int, run: LockedRun, handle: MessageHandler
) -> AbstractContextManager[tuple[LocalProcesses, MessageHandler]]:
    return nullcontext((LocalProcesses(run.folder.path / "logs", jobs), handle))


def _in_this_process(
    caller: PolicyCaller, run: LockedRun, handle: MessageHandler
) -> AbstractContextManager[tuple[InProcess, MessageHandler]]:
    return nullcontext((InProcess(caller), handle))


@contextmanager
def _connected(
    plan: PlannedRun, folder: Path, ends: RunConnections, reporter: Reporter
) -> Iterator[PlannedRun]:
    """Connect a run to its director, live clients and ROS 2 nodes, if the config requests them."""
    options = plan.options
    named = keys.chunk(folder.name)
    if ends.director is not None:
        outside = DirectorAddress(
            connection=ends.director, run=named, wait_s=plan.config.director_wait
        )
        options = msgspec.structs.replace(options, director=outside)
    with _live(ends.live, named) as live, _ros2_hub(plan.host, plan.config, reporter) as host:
        if live is not None:
            options = msgspec.structs.replace(options, live=live)
        yield plan._replace(options=options, host=host)


@contextmanager
def _ros2_hub(host: PolicyHost, config: RunConfig, reporter: Reporter) -> Iterator[PolicyHost]:
    """Open the session to which ROS 2 nodes connect, if the policy is one and the run listens.

    Yields the host by which environment processes reach it.
    """
    ros2 = host.ros2
    if ros2 is None or not ros2.connection.listen:
        yield host
        return
    with open_session(ros2.connection) as hub:
        last = ros2.domain + (config.jobs or 1) - 1
        domains = f"domain {ros2.domain}" + f" to {last}" * (last > ros2.domain)
        reporter.say(f"ROS 2 nodes connect to {ros2.connection.listen}, {domains}")
        at = ros2.connection.listen
        inside = msgspec.structs.replace(ros2, connection=hub.inside, hub=at)
        yield msgspec.structs.replace(host, ros2=inside)


@contextmanager
def _live(connection: Connection | None, named: str) -> Iterator[LiveAddress | None]:
    """Open the session for live clients, and yield its address for episodes."""
    if connection is None:
        yield None
        return
    with open_session(connection) as hub:
        yield LiveAddress(connection=hub.inside, run=named)


def _run_todo(
    plan: PlannedRun, run: LockedRun, create_transport: TransportFactory, handle: MessageHandler
) -> None:
    """Run the episodes without a result. Raises MachineError, UsageError."""
    if not run.todo:
        return
    with ExitStack() as stack:
        renderer = None
        if plan.config.shared_renderer:
            logs = run.folder.path / "logs"
            renderer = SharedRenderer(
                logs,
                run.hello,
                asks=plan.caller.batches,
                appearance=plan.options.appearance,
            )
            stack.enter_context(renderer)
        transport, handle = stack.enter_context(create_transport(run, handle))
        run_all(
            run.folder,
            run.todo,
            run.hello,
            transport,
            handle=handle,
            options=plan.options,
            renderer=renderer,
        )
