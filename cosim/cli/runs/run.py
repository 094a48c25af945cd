"""`cosim run`: a suite with a policy."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from datetime import datetime
from pathlib import Path
from secrets import token_hex
from typing import Annotated, Any, get_args

import msgspec
import typer

from cosim.cli.options.camera import CAMERA_HELP, Choice, camera_here
from cosim.cli.options.endpoint import LONGEST_WAIT_S, Insecure, Tls, ends_of_run, warned
from cosim.cli.options.latency import LATENCY_HELP, REAL_TIME_HELP, asked_latency_ms, with_latency
from cosim.cli.options.recording import RERUN_HELP, check_rerun, write_rerun
from cosim.cli.options.street import (
    CHILDREN_HELP,
    CROWD_HELP,
    ELDERLY_HELP,
    GROUPS_HELP,
    RESIDENTS_HELP,
    ROBOT_HELP,
    VEHICLES_SHARE,
)
from cosim.cli.options.taking import taking
from cosim.cli.terminal.board import Board
from cosim.cli.terminal.consoles import err, out
from cosim.cli.terminal.logs import LogJson, LogLevel, logged
from cosim.cli.terminal.progress import doing
from cosim.core.errors import INTERRUPTED, SOME_CRASHED, UsageError, unknown

run_app = typer.Typer()
ReachesWorkers = Callable[..., AbstractContextManager[Any]]

_SHARED_HELP = (
    "One process draws for all environments and, if the policy has act_batch, asks it for all of them at once."
)
_ISOLATED_HELP = "The policy gets a process of its own and sees observations alone: it cannot reach into the simulator."
_POLICY_HELP = "A baseline, your own as package.module:Class, or one that is served, as zenoh:NAME."
_POLICY_AT_HELP = "Where `cosim serve` listens, for --policy zenoh:NAME; may be repeated: servers share the episodes."
_SEED_HELP = (
    "Of the run: policies' seeds and the names they are told are drawn from it; and the routes with --map (else 0)."
)
_OWN_CAMERA_HELP = "The policy may see by a camera that the robot does not have; every row is marked nonstandard."
_SHARD_HELP = "Run only every N-th scenario, from the I-th on; needs --seed. `cosim merge` makes one run of all N."
_JOBS_HELP = "Environment processes; with --on as many as the cluster has CPUs."
_ON_HELP = "Run by a Ray cluster: ray (of this machine), auto, or ray://HOST:10001. A policy of yours is sent there."
_GOAL_HELP = "What the policy is told of where to go, by its name (`cosim list`), in place of what its manifest says."


def carry_out(
    suite: Annotated[str, typer.Argument(help="A suite (see `cosim list`) or the path of a suite's .json file.")],
    policy: Annotated[str, typer.Option(help=_POLICY_HELP)] = "route",
    robot: Annotated[str, typer.Option(help=ROBOT_HELP)] = "",
    episodes: Annotated[int | None, typer.Option(min=1, help="Run only the first so many scenarios.")] = None,
    scenario: Annotated[list[str] | None, typer.Option(help="Run only this scenario; may be repeated.")] = None,
    event: Annotated[list[str] | None, typer.Option(help="Run only scenarios of this event; may be repeated.")] = None,
    split: Annotated[str | None, typer.Option(help="Run only scenarios of val, or of test.")] = None,
    jobs: Annotated[int, typer.Option(min=1, help="Environment processes.")] = 1,
    policy_at: Annotated[list[str] | None, typer.Option(metavar="ENDPOINT", help=_POLICY_AT_HELP)] = None,
    isolated: Annotated[bool, typer.Option("--isolated", help=_ISOLATED_HELP)] = False,
    shared_renderer: Annotated[bool, typer.Option("--shared-renderer", help=_SHARED_HELP)] = False,
    shard: Annotated[str, typer.Option(metavar="I/N", help=_SHARD_HELP)] = "",
    folder: Annotated[Path | None, typer.Option("--out", help="Run folder; default runs/SUITE-POLICY-TIME.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Finish the run in --out.")] = False,
    map_name: Annotated[
        str | None, typer.Option("--map", help="Draw on this place in place of the suite's: a map, a folder, a net.")
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, show_default="another one each time", help=_SEED_HELP)] = None,
    roughness: Annotated[
        float | None, typer.Option(help="Of the ground of --map: from 0, flat, to 1 (raised slabs, roots, potholes).")
    ] = None,
    crowd: Annotated[int | None, typer.Option(min=0, help=CROWD_HELP)] = None,
    residents: Annotated[int | None, typer.Option(min=0, help=RESIDENTS_HELP)] = None,
    groups: Annotated[float | None, typer.Option(help=GROUPS_HELP)] = None,
    elderly: Annotated[float | None, typer.Option(help=ELDERLY_HELP)] = None,
    children: Annotated[float | None, typer.Option(help=CHILDREN_HELP)] = None,
    goal: Annotated[str, typer.Option(help=_GOAL_HELP)] = "",
    latency: Annotated[str, typer.Option(metavar="MS", help=LATENCY_HELP)] = "",
    real_time: Annotated[bool, typer.Option("--real-time", help=REAL_TIME_HELP)] = False,
    frames: Annotated[float, typer.Option(min=0.0, help="Keep a camera frame every so many seconds.")] = 0.0,
    camera: Annotated[Choice, typer.Option(metavar="CAMERA", help=CAMERA_HELP)] = "auto",
    own_camera: Annotated[bool, typer.Option("--own-camera", help=_OWN_CAMERA_HELP)] = False,
    live: Annotated[
        str | None, typer.Option(help="Be on the air at this endpoint, like tcp/127.0.0.1:7447: see `cosim inject`.")
    ] = None,
    director: Annotated[
        str | None, typer.Option(help="Ask the director at this endpoint, a process of its own: see `cosim direct`.")
    ] = None,
    tls: Tls = "",
    insecure: Insecure = False,
    director_wait: Annotated[
        float, typer.Option(min=0.1, max=LONGEST_WAIT_S, help="Seconds to wait for it; then the episode has crashed.")
    ] = 60.0,
    answer_timeout: Annotated[
        float, typer.Option(min=0.1, help="Seconds a policy may take to answer; then its episode has crashed.")
    ] = 60.0,
    start_timeout: Annotated[
        float, typer.Option(min=0.1, help="The same for loading it, for its reset, and for the first answer after it.")
    ] = 300.0,
    rerun: Annotated[Path | None, typer.Option(metavar="FILE.rrd", help=RERUN_HELP)] = None,
    counterfactual: Annotated[
        bool, typer.Option("--counterfactual", help="Simulate every street again without the robot: whom it delayed.")
    ] = False,
    log_level: LogLevel = "",
    log_json: LogJson = None,
    carrier: AbstractContextManager[ReachesWorkers] | None = None,
) -> None:
    """Do what is asked by the options of `cosim run`. carrier: what reaches the workers, in place of processes of this
    machine, opened before anything is written: (held folder, scenarios to run, those of the run, hello, patience, tell)
    -> (transport, tell)."""
    from bridge import keys
    from bridge.session import notices_of, open_session
    from cosim.cli.terminal.run_table import kinds_of, print_by_kind, print_table
    from cosim.records.figures import Going
    from cosim.records.run_folder import RunFolder
    from cosim.records.run_spec import Shard
    from cosim.spec.goal import goal_called
    from cosim.spec.injection import Live
    from cosim.spec.options import EpisodeOptions, Outside
    from cosim.spec.policy_host import PolicyHost
    from cosim.spec.robot import COURIER, robot_called
    from cosim.spec.scenario import Split
    from scenarios.builders.fits import LOOKING, check_places
    from scenarios.catalog import load_suite, scenarios_chosen, with_crowd, with_robot
    from scenarios.execution.asked import Patience
    from scenarios.execution.messages import Hear, Hello
    from scenarios.execution.pace import announcement, remembered
    from scenarios.execution.pool import run_all
    from scenarios.execution.process import LocalProcesses
    from scenarios.execution.suite_run import check_alone, run_spec, seed_of_run
    from scenarios.execution.transport import Transport
    from scenarios.rendering.shared import SharedRenderer, check_shared
    from scenarios.serving.drivers import known_driver

    asked_latency_ms(latency, real_time)
    air, away, servers = ends_of_run(live, director, policy_at or (), tls, insecure)
    for line in (line for end in (air, away, *servers) if end is not None for line in notices_of(end)):
        warned(line)
    if map_name is not None:
        from scenarios.builders.sample import suite_on_map

        with doing(f"drawing routes on {map_name}"):
            driven_by = robot_called(robot or COURIER.name)
            whole = suite_on_map(suite, map_name, seed or 0, episodes, roughness or 0.0, event or (), robot=driven_by)
        err.print(whole.description, soft_wrap=True, highlight=False, markup=False)
    elif roughness is not None:
        raise UsageError("--roughness goes with --map: a suite says itself how rough the ground of its places is")
    else:
        whole = load_suite(suite)
    whole = with_robot(whole, robot)
    whole = with_crowd(
        whole, persons=crowd, vehicles=None if crowd is None else round(VEHICLES_SHARE * crowd),
        residents=residents, groups=groups, elderly=elderly, children=children,
    )  # fmt: skip
    if split not in (None, *get_args(Split)):
        raise unknown("split", str(split), get_args(Split))
    of_run = scenarios_chosen(whole, scenario or (), episodes, event or (), split)
    part = Shard.called(shard, len(of_run)) if shard else None
    if part is not None and seed is None and not resume:
        raise UsageError("--shard needs --seed: shards are of one run, which has one seed: give the same to each")
    if part is not None and latency == "measured":
        raise UsageError("--shard with --latency measured: each would measure another: give milliseconds")
    picked = of_run if part is None else part.share(of_run)
    host = PolicyHost(isolated=isolated, servers=servers, run=token_hex(8))
    loaded = known_driver(policy, host, jobs)
    manifest = loaded.manifest
    drawn_by = camera_here(camera) if manifest.camera is not None else "bullet"
    asks = shared_renderer and check_shared(loaded, drawn_by)
    check_rerun(rerun, len(picked))
    if resume and folder is None:
        raise UsageError("--resume needs --out: the folder of the run to finish")
    run_seed = seed_of_run(seed, folder if resume else None)
    stamp = datetime.now().strftime("%Y%m%d-%H%M%S")
    suffix = "" if part is None else f"-{part.number}-of-{part.of}"
    path = folder or Path("runs") / f"{whole.name}-{manifest.name}-{stamp}{suffix}"
    with doing(LOOKING) as looking:
        check_places(whole, picked, looking, jobs if carrier is None else len(os.sched_getaffinity(0)))
    named = keys.chunk(path.name)
    on_air = None if air is None else Live(connection=air, run=named)
    outside = None if away is None else Outside(connection=away, run=named, wait_s=director_wait)
    options = EpisodeOptions(
        seed=run_seed,
        robot=robot,
        own_camera=own_camera,
        goal=goal_called(goal) if goal else None,
        suite_hash=whole.content_hash,
        camera=drawn_by,
        frames_every_s=frames,
        live=on_air,
        director=outside,
        counterfactual=counterfactual,
    )
    went_on = folder if resume else None
    options = with_latency(options, latency, real_time, went_on, whole, picked[0], policy, manifest.rate_hz, host)
    check_alone(options, jobs, shared_renderer)
    spec = run_spec(whole, of_run, policy, loaded, options, shared_renderer, part)
    with ExitStack() as stack:
        counts = stack.enter_context(logged(log_level, log_json))
        carried = None if carrier is None else stack.enter_context(carrier)
        if on_air is not None:
            hub = stack.enter_context(open_session(on_air.connection))
            options = msgspec.structs.replace(options, live=Live(connection=hub.inside, run=named))
            err.print(f"On the air at {live}: see `cosim listen --help`.", soft_wrap=True, highlight=False)
        held = RunFolder.resume(path, spec) if resume else RunFolder.create(path, spec, whole)
        stack.enter_context(held)
        err.print(
            f"Seed {run_seed}: what the policy is told that episodes are called is drawn from it.", highlight=False
        )
        for note in held.notes:
            err.print(note, soft_wrap=True, markup=False, highlight=False)
        done = held.finished()
        todo = [s for s in picked if s.id not in done]
        if done:
            err.print(f"{len(done)} of {len(picked)} episodes are finished already.")
        if todo and carrier is None:
            words = announcement(todo, policy, spec.renderer, jobs, counterfactual)
            err.print(words, soft_wrap=not err.is_terminal, highlight=False, markup=False)
        board = Board(picked, done, compared=counterfactual)
        hello = Hello(policy, manifest, loaded.source_hash, host=host)
        patience = Patience(answer_timeout, start_timeout)
        renderer = None
        if shared_renderer and todo:
            drawing = SharedRenderer(held.path / "logs", hello, asks=asks, patience=patience)
            renderer = stack.enter_context(drawing)
        transport: Transport = LocalProcesses(held.path / "logs", jobs)
        go = Going(held.path, [s.id for s in todo], counts)
        try:
            with ExitStack() as running:
                running.callback(go.end)
                tell: Hear = board.tell
                if carried is None:
                    running.enter_context(remembered(held, todo, jobs))
                elif todo:
                    transport, tell = running.enter_context(carried(held, todo, picked, hello, patience, tell))
                running.enter_context(board.bars)
                run_all(held, todo, hello, transport, tell=tell, options=options, patience=patience, renderer=renderer)
        except KeyboardInterrupt:
            finished = len(held.finished())
            again = shlex.join(a for a in sys.argv[1:] if a != "--resume")
            again += "" if folder else f" --out {shlex.quote(str(path))}"
            err.print(f"Stopped. {finished} of {len(picked)} episodes are finished and kept in {path}.")
            err.print(f"Go on with: cosim {again} --resume", soft_wrap=True)
            raise typer.Exit(INTERRUPTED) from None
        table = held.finish()
    print_table(out, table, len(of_run))
    print_by_kind(out, table, kinds_of(path))
    if go.figures is not None:
        err.print(go.figures.in_words, soft_wrap=True, highlight=False)
    out.print(f"Run folder: {path}", soft_wrap=True)
    if part is not None:
        err.print(f"Shard {part.in_words} of the run: `cosim merge` makes one of all.", highlight=False)
    if lacking := [s.id for s in picked if s.id not in set(table["scenario"])]:
        err.print(f"No record of {', '.join(lacking)}: run it again with --resume.", soft_wrap=True, markup=False)
    if lacking or table["ended"].isna().any():
        raise typer.Exit(SOME_CRASHED)
    write_rerun(path, [scenario.id for scenario in picked], rerun)


@run_app.command(
    "run",
    epilog="Examples:  \n"
    "`cosim run long-horizon --policy route --episodes 2`  \n"
    "`cosim run reactive --event frontal --event lateral --policy orca`  \n"
    "`cosim run long-horizon --policy orca --episodes 2 --residents 8`  \n"
    "`cosim run long-horizon --robot scout --episodes 2`  \n"
    "`cosim run long-horizon --policy my_robot.policy:Mine --jobs 2 --out runs/mine`  \n"
    "`cosim run long-horizon --policy my_robot.policy:Mine --out runs/mine --resume`  \n"
    "`cosim run long-horizon --policy my_robot.policy:Mine --jobs 10 --shared-renderer`  \n"
    "`cosim run reactive --policy orca --seed 7 --shard 1/4 --out runs/1`: see `cosim merge`  \n"
    "`cosim run long-horizon --policy my_robot.policy:Mine --isolated`  \n"
    "`cosim run reactive --policy my_robot.policy:Mine --on ray://head.lan:10001`, or `--on ray`  \n"
    "`cosim run long-horizon --policy zenoh:mine --policy-at tcp/127.0.0.1:7449`: see `cosim serve`  \n"
    "`cosim run long-horizon --policy my_robot.policy:Mine --goal route_point`  \n"
    "`cosim run reactive --policy my_robot.policy:Mine --latency 200`, or `--latency measured`, or `--real-time`  \n"
    "`cosim run long-horizon --map sumo-fkk-in --seed 3 --episodes 5`  \n"
    "`cosim run reactive --director tcp/127.0.0.1:7448`, with `cosim direct` beside it  \n"
    "`cosim run long-horizon --policy route --episodes 2 --counterfactual`  \n"
    "`cosim run reactive --policy orca --scenario frontal-001 --rerun frontal.rrd`",
)
@taking(carry_out, without=("carrier", "jobs"))
def run_command(
    jobs: Annotated[int | None, typer.Option(min=1, show_default="1", help=_JOBS_HELP)] = None,
    on: Annotated[str, typer.Option(metavar="CLUSTER", help=_ON_HELP)] = "",
    **asked: Any,
) -> None:
    """Run a suite with a policy and print its table."""
    if on:
        from cosim.cli.runs.on_cluster import carried_by_ray, check_on

        check_on(on, asked)
        asked["carrier"] = carried_by_ray(on, jobs, asked["policy"])
    carry_out(jobs=1 if on else jobs or 1, **asked)
