"""`cosim run`: a suite with a policy."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from datetime import datetime
from functools import partial
from pathlib import Path
from secrets import token_hex
from typing import TYPE_CHECKING, Annotated, Any, get_args

import msgspec
import typer

from cosim.cli.console import LogJson, LogLevel, err, logged, out
from cosim.cli.options import (
    CAMERA_HELP,
    CHILDREN_HELP,
    CROWD_HELP,
    ELDERLY_HELP,
    GROUPS_HELP,
    LATENCY_HELP,
    LONGEST_WAIT_S,
    REAL_TIME_HELP,
    RERUN_HELP,
    RESIDENTS_HELP,
    ROBOT_HELP,
    VEHICLES_SHARE,
    Choice,
    Insecure,
    Tls,
    asked_latency_ms,
    camera_here,
    check_rerun,
    ends_of_run,
    taking,
    warned,
    with_latency,
    write_rerun,
)
from cosim.cli.progress import doing
from cosim.cli.run_progress import Board
from cosim.core.errors import INTERRUPTED, SOME_CRASHED, UsageError, unknown

if TYPE_CHECKING:
    from pandas import DataFrame

    from cosim.results.throughput import Figures
    from cosim.spec.connection import Connection
    from cosim.spec.scenario import Scenario, Split, Suite
    from scenarios.runs.transport import HeldRun

run_app = typer.Typer()

_SHARED_HELP = (
    "One process draws for all environments and, if the policy has act_batch, asks it for all of "
    "them at once."
)
_ISOLATED_HELP = (
    "The policy gets a process of its own and sees observations alone: it cannot reach into the "
    "simulator."
)
_POLICY_HELP = (
    "One of `cosim list`, your own as my.py:Class, a network as onnx:FOLDER, or a served one as "
    "zenoh:NAME."
)
_POLICY_AT_HELP = (
    "Where `cosim serve` listens, for --policy zenoh:NAME; may be repeated: servers share the "
    "episodes."
)
_SEED_HELP = (
    "Of the run: policies' seeds and the names they are told are drawn from it; and the routes "
    "with --map (else 0)."
)
_OWN_CAMERA_HELP = (
    "The policy may see by a camera that the robot does not have; every row is marked nonstandard."
)
_SHARD_HELP = (
    "Run only every N-th scenario, from the I-th on; needs --seed. `cosim merge` makes one run "
    "of all N."
)
_EVENT_HELP = "Run only scenarios of this event, or static: of none; may be repeated."
_JOBS_HELP = "Environment processes; with --on as many as the cluster has CPUs."
_PACE_HELP = (
    "Hold it to so many times real time, from 0.1 to 100: with 1 there is time to step in by "
    "hand. The same results."
)
_STEPS_IN = '{"id": "eve", "path": [{"ahead": 15, "left": 1}]}'
_ON_HELP = (
    "Run by a Ray cluster: ray (of this machine), auto, or ray://HOST:10001. A policy of yours "
    "is sent there."
)
_GOAL_HELP = (
    "What the policy is told of where to go, by its name (`cosim list`), in place of what its "
    "manifest says."
)


def carry_out(
    suite: Annotated[
        str, typer.Argument(help="A suite (see `cosim list`) or the path of a suite's .json file.")
    ],
    policy: Annotated[str, typer.Option(help=_POLICY_HELP)] = "route",
    robot: Annotated[str, typer.Option(help=ROBOT_HELP)] = "",
    episodes: Annotated[
        int | None, typer.Option(min=1, help="Run only the first so many scenarios.")
    ] = None,
    scenario: Annotated[
        list[str] | None, typer.Option(help="Run only this scenario; may be repeated.")
    ] = None,
    event: Annotated[list[str] | None, typer.Option(help=_EVENT_HELP)] = None,
    split: Annotated[
        str | None, typer.Option(help="Run only scenarios of val, or of test.")
    ] = None,
    jobs: Annotated[int, typer.Option(min=1, help="Environment processes.")] = 1,
    policy_at: Annotated[
        list[str] | None, typer.Option(metavar="ENDPOINT", help=_POLICY_AT_HELP)
    ] = None,
    isolated: Annotated[bool, typer.Option("--isolated", help=_ISOLATED_HELP)] = False,
    shared_renderer: Annotated[bool, typer.Option("--shared-renderer", help=_SHARED_HELP)] = False,
    shard: Annotated[str, typer.Option(metavar="I/N", help=_SHARD_HELP)] = "",
    folder: Annotated[
        Path | None, typer.Option("--out", help="Run folder; default runs/SUITE-POLICY-TIME.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Finish the run in --out.")] = False,
    map_name: Annotated[
        str | None,
        typer.Option(
            "--map", help="Draw on this place in place of the suite's: a map, a folder, a net."
        ),
    ] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, show_default="another one each time", help=_SEED_HELP)
    ] = None,
    roughness: Annotated[
        float | None,
        typer.Option(
            help="Of the ground of --map: from 0, flat, to 1 (raised slabs, roots, potholes)."
        ),
    ] = None,
    crowd: Annotated[int | None, typer.Option(min=0, help=CROWD_HELP)] = None,
    residents: Annotated[int | None, typer.Option(min=0, help=RESIDENTS_HELP)] = None,
    groups: Annotated[float | None, typer.Option(help=GROUPS_HELP)] = None,
    elderly: Annotated[float | None, typer.Option(help=ELDERLY_HELP)] = None,
    children: Annotated[float | None, typer.Option(help=CHILDREN_HELP)] = None,
    goal: Annotated[str, typer.Option(help=_GOAL_HELP)] = "",
    latency: Annotated[str, typer.Option(metavar="MS", help=LATENCY_HELP)] = "",
    real_time: Annotated[bool, typer.Option("--real-time", help=REAL_TIME_HELP)] = False,
    frames: Annotated[
        float, typer.Option(min=0.0, help="Keep a camera frame every so many seconds.")
    ] = 0.0,
    camera: Annotated[Choice, typer.Option(metavar="CAMERA", help=CAMERA_HELP)] = "auto",
    own_camera: Annotated[bool, typer.Option("--own-camera", help=_OWN_CAMERA_HELP)] = False,
    live: Annotated[
        str | None,
        typer.Option(
            help="Be on the air at this endpoint, like tcp/127.0.0.1:7447: see `cosim inject`."
        ),
    ] = None,
    pace: Annotated[
        float, typer.Option(metavar="X", show_default="as fast as possible", help=_PACE_HELP)
    ] = 0.0,
    director: Annotated[
        str | None,
        typer.Option(
            help="Ask the director at this endpoint, a process of its own: see `cosim direct`."
        ),
    ] = None,
    tls: Tls = "",
    insecure: Insecure = False,
    director_wait: Annotated[
        float,
        typer.Option(
            min=0.1,
            max=LONGEST_WAIT_S,
            help="Seconds to wait for it; then the episode has crashed.",
        ),
    ] = 60.0,
    answer_timeout: Annotated[
        float,
        typer.Option(
            min=0.1, help="Seconds a policy may take to answer; then its episode has crashed."
        ),
    ] = 60.0,
    start_timeout: Annotated[
        float,
        typer.Option(
            min=0.1,
            help="The same for loading it, for its reset, and for the first answer after it.",
        ),
    ] = 300.0,
    rerun: Annotated[Path | None, typer.Option(metavar="FILE.rrd", help=RERUN_HELP)] = None,
    counterfactual: Annotated[
        bool,
        typer.Option(
            "--counterfactual",
            help="Simulate every street again without the robot: whom it delayed.",
        ),
    ] = False,
    log_level: LogLevel = "",
    log_json: LogJson = None,
    carrier: AbstractContextManager[Any] | None = None,
) -> None:
    """Do what is asked by the options of `cosim run`. carrier: gives the `Reaches` of workers, in
    place of processes of this machine; opened before anything is written."""
    from bridge import keys
    from bridge.session import notices_of, open_session
    from cosim.results.throughput import Going
    from cosim.spec.goal import goal_called
    from cosim.spec.injection import Live
    from cosim.spec.options import EpisodeOptions, Outside
    from cosim.spec.policy_host import PolicyHost
    from cosim.spec.selection import scenarios_chosen
    from scenarios.ipc.deadlines import Patience
    from scenarios.runs.eta import announcement, remembered
    from scenarios.runs.run import by_processes, held_run, planned_run, run_what_is_left
    from scenarios.suites.catalog import load_suite, with_crowd, with_robot
    from scenarios.suites.fits import LOOKING, check_places

    asked_latency_ms(latency, real_time)
    if resume and folder is None:
        raise UsageError("--resume needs --out: the folder of the run to finish")
    if shard and latency == "measured":
        raise UsageError(
            "--shard with --latency measured: each would measure another: give milliseconds"
        )
    air, away, servers = ends_of_run(live, director, policy_at or (), tls, insecure)
    for line in (
        line for end in (air, away, *servers) if end is not None for line in notices_of(end)
    ):
        warned(line)
    if map_name is not None:
        whole = _drawn(suite, map_name, seed or 0, episodes, roughness or 0.0, event or (), robot)
    elif roughness is not None:
        raise UsageError(
            "--roughness goes with --map: a suite says itself how rough the ground of its places is"
        )
    else:
        whole = load_suite(suite)
    whole = with_robot(whole, robot)
    whole = with_crowd(
        whole,
        persons=crowd,
        vehicles=None if crowd is None else round(VEHICLES_SHARE * crowd),
        residents=residents,
        groups=groups,
        elderly=elderly,
        children=children,
    )
    of_run = scenarios_chosen(whole, scenario or (), episodes, event or (), _split_called(split))
    options = EpisodeOptions(
        seed=seed,
        robot=robot,
        own_camera=own_camera,
        goal=goal_called(goal) if goal else None,
        camera=camera,
        frames_every_s=frames,
        counterfactual=counterfactual,
        real_time=real_time,
        pace=pace,
    )
    went_on = folder if resume else None
    plan = planned_run(
        whole,
        of_run,
        policy,
        options,
        shard=shard,
        jobs=jobs,
        shared_renderer=shared_renderer,
        host=PolicyHost(isolated=isolated, servers=servers, run=token_hex(8)),
        patience=Patience(answer_timeout, start_timeout),
        resumed=went_on,
    )
    manifest = plan.driver.manifest
    picked = plan.picked
    if manifest.camera is not None:
        camera_here(camera)
    check_rerun(rerun, len(picked))
    with doing(LOOKING) as looking:
        check_places(
            whole, picked, looking, jobs if carrier is None else len(os.sched_getaffinity(0))
        )
    options = with_latency(
        plan.options,
        latency,
        real_time,
        went_on,
        whole,
        picked[0],
        policy,
        manifest.rate_hz,
        plan.host,
    )
    stamp = datetime.now().strftime("%Y%m%d-%H%M%S")
    suffix = "" if plan.shard is None else f"-{plan.shard.number}-of-{plan.shard.of}"
    path = folder or Path("runs") / f"{whole.name}-{manifest.name}-{stamp}{suffix}"
    named = keys.chunk(path.name)
    outside = None if away is None else Outside(connection=away, run=named, wait_s=director_wait)
    plan = plan._replace(options=msgspec.structs.replace(options, director=outside))
    renderer = plan.spec.renderer
    with ExitStack() as stack:
        counts = stack.enter_context(logged(log_level, log_json))
        reaches = by_processes(jobs) if carrier is None else stack.enter_context(carrier)
        if air is not None:
            hub = stack.enter_context(open_session(air))
            on_air = msgspec.structs.replace(
                plan.options, live=Live(connection=hub.inside, run=named)
            )
            plan = plan._replace(options=on_air)
        run = stack.enter_context(held_run(plan, path, resume=resume))
        done = {one.id for one in picked} - {one.id for one in run.todo}
        _tell_of_beginning(run, plan.options.seed)
        if run.todo and carrier is None:
            words = announcement(run.todo, plan.policy, renderer, jobs, counterfactual, pace)
            err.print(words, soft_wrap=not err.is_terminal, highlight=False, markup=False)
        if air is not None and run.todo:
            _tell_how_to_step_in(air, named, run, several=jobs > 1, paced=pace > 0.0)
        board = Board(picked, done, compared=counterfactual, pace=pace)
        go = Going(run.held.path, [s.id for s in run.todo], counts)
        try:
            with ExitStack() as running:
                running.callback(go.end)
                if carrier is None:
                    running.enter_context(remembered(run.held, run.todo, jobs, pace))
                running.enter_context(board.bars)
                run_what_is_left(plan, run, reaches, board.tell)
        except KeyboardInterrupt:
            finished = len(run.held.finished())
            again = shlex.join(a for a in sys.argv[1:] if a != "--resume")
            again += "" if folder else f" --out {shlex.quote(str(path))}"
            err.print(
                f"Stopped. {finished} of {len(picked)} episodes are finished and kept in {path}."
            )
            err.print(f"Go on with: cosim {again} --resume", soft_wrap=True)
            raise typer.Exit(INTERRUPTED) from None
        table = run.held.finish()
    _tell_of_end(path, table, of_run, go.figures)
    if plan.shard is not None:
        err.print(
            f"Shard {plan.shard.in_words} of the run: `cosim merge` makes one of all.",
            highlight=False,
        )
    if lacking := [s.id for s in picked if s.id not in set(table["scenario"])]:
        err.print(
            f"No record of {', '.join(lacking)}: run it again with --resume.",
            soft_wrap=True,
            markup=False,
        )
    if lacking or table["ended"].isna().any():
        raise typer.Exit(SOME_CRASHED)
    write_rerun(path, [one.id for one in picked], rerun)


def _drawn(
    suite: str,
    map_name: str,
    seed: int,
    episodes: int | None,
    roughness: float,
    events: Sequence[str],
    robot: str,
) -> Suite:
    """A suite on another place than its own, and what it is."""
    from cosim.spec.robot import COURIER, robot_called
    from scenarios.suites.sample import suite_on_map

    with doing(f"drawing routes on {map_name}"):
        driven_by = robot_called(robot or COURIER.name)
        whole = suite_on_map(suite, map_name, seed, episodes, roughness, events, robot=driven_by)
    err.print(whole.description, soft_wrap=True, highlight=False, markup=False)
    return whole


def _split_called(name: str | None) -> Split | None:
    from cosim.spec.scenario import Split

    if name not in (None, *get_args(Split)):
        raise unknown("split", str(name), get_args(Split))
    return name  # type: ignore[return-value]


def _tell_of_beginning(run: HeldRun, seed: int | None) -> None:
    err.print(
        f"Seed {seed}: what the policy is told that episodes are called is drawn from it.",
        highlight=False,
    )
    for note in run.held.notes:
        err.print(note, soft_wrap=True, markup=False, highlight=False)
    if done := len(run.picked) - len(run.todo):
        err.print(f"{done} of {len(run.picked)} episodes are finished already.")


def _tell_how_to_step_in(
    air: Connection, named: str, run: HeldRun, *, several: bool, paced: bool
) -> None:
    """Print the commands that listen and inject here. several: episodes at a time; then the first
    one is named."""
    from bridge import keys
    from cosim.cli.options import reached_by
    from cosim.spec.episode_id import pseudonym_of

    first = min(run.todo, key=partial(pseudonym_of, run.held.spec.seed))
    env = f" --env {named}/{keys.chunk(first.id)}" if several else ""
    say = partial(err.print, soft_wrap=True, markup=False, highlight=False)
    say(f"On the air at {air.listen}. From another terminal:")
    say(f"  cosim listen events{reached_by(air, 'viewer')}{env} --wait 60")
    say(f"  cosim inject '{_STEPS_IN}'{reached_by(air, 'injector')}{env} --wait 60")
    if not paced:
        say(
            "It runs as fast as it can. --pace 1 holds it to real time, so that there is "
            "time to step in."
        )


def _tell_of_end(
    path: Path, table: DataFrame, of_run: Sequence[Scenario], figures: Figures | None
) -> None:
    from cosim.cli.run_table import kinds_of, print_by_kind, print_next_commands, print_table

    print_table(out, table, len(of_run), path)
    print_by_kind(out, table, kinds_of(path))
    if figures is not None:
        err.print(figures.in_words, soft_wrap=True, highlight=False)
    out.print(f"Run folder: {path}", soft_wrap=True)
    print_next_commands(err, path, table)


@run_app.command(
    "run",
    epilog="Examples:  \n`cosim run long-horizon --policy route --episodes 2`  \n`cosim run "
    "reactive --event frontal --event lateral --policy orca`  \n`cosim run long-horizon --policy "
    "orca --episodes 2 --residents 8`  \n`cosim run long-horizon --robot scout --episodes 2`  "
    "\n`cosim run long-horizon --policy my.py:Mine --jobs 2 --out runs/mine`  \n`cosim run "
    "long-horizon --policy my.py:Mine --out runs/mine --resume`  \n`cosim run long-horizon "
    "--policy my.py:Mine --jobs 10 --shared-renderer`  \n`cosim run reactive --policy orca --seed "
    "7 --shard 1/4 --out runs/1`: see `cosim merge`  \n`cosim run long-horizon --policy "
    "my.py:Mine --isolated`  \n`cosim run reactive --policy my.py:Mine --on "
    "ray://head.lan:10001`, or `--on ray`  \n`cosim run long-horizon --policy zenoh:mine "
    "--policy-at tcp/127.0.0.1:7449`: see `cosim serve`  \n`cosim run reactive --policy "
    "onnx:my_network --goal route_point`  \n`cosim run long-horizon --policy my.py:Mine --goal "
    "route_point`  \n`cosim run reactive --policy my.py:Mine --latency 200`, or `--latency "
    "measured`, or `--real-time`  \n`cosim run long-horizon --map sumo-fkk-in --seed 3 --episodes "
    "5`  \n`cosim run reactive --director tcp/127.0.0.1:7448`, with `cosim direct` beside it  "
    "\n`cosim run long-horizon --policy route --episodes 2 --counterfactual`  \n`cosim run "
    "reactive --policy orca --scenario frontal-001 --rerun frontal.rrd`",
)
@taking(carry_out, without=("carrier", "jobs"))
def run_command(
    jobs: Annotated[int | None, typer.Option(min=1, show_default="1", help=_JOBS_HELP)] = None,
    on: Annotated[str, typer.Option(metavar="CLUSTER", help=_ON_HELP)] = "",
    **asked: Any,
) -> None:
    """Run a suite with a policy and print its table."""
    if on:
        from scenarios.runs.ray_workers import by_ray, check_on_ray

        of_here = ("shared_renderer", "real_time", "live", "pace", "rerun")
        check_on_ray(on, {f"--{name.replace('_', '-')}": asked[name] for name in of_here})
        say = partial(err.print, soft_wrap=True, highlight=False, markup=False)
        asked["carrier"] = by_ray(on, jobs, asked["policy"], say)
    with told_if_not_begun(asked["folder"]):
        carry_out(jobs=1 if on else jobs or 1, **asked)


@contextmanager
def told_if_not_begun(folder: Path | None) -> Iterator[None]:
    """Where Ctrl-C ends a run before its folder was written, print that there is nothing to
    resume."""
    try:
        yield
    except KeyboardInterrupt:
        if folder is not None and not (folder / "run.json").exists():
            words = (
                f"Stopped before the run began: {folder} holds nothing. Give the same command "
                f"again, without --resume."
            )
            err.print(words, soft_wrap=True, highlight=False, markup=False)
        raise
