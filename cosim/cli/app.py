"""The command line: `cosim run`, `list`, `show`, `doctor`."""

from __future__ import annotations

import shlex
import signal
import sys
from contextlib import ExitStack
from datetime import datetime
from pathlib import Path
from typing import Annotated, get_args

import typer
from rich.markup import escape

from cosim.cli import eyes
from cosim.cli.bench import bench
from cosim.cli.board import Board
from cosim.cli.city import city_app
from cosim.cli.compare import compare
from cosim.cli.consoles import err, out
from cosim.cli.crowd import CHILDREN_HELP, CROWD_HELP, ELDERLY_HELP, GROUPS_HELP, VEHICLES_SHARE, compare_one
from cosim.cli.latency import LATENCY_HELP, REAL_TIME_HELP, with_latency
from cosim.cli.live import LONGEST_WAIT_S, checked_endpoint, direct, inject, listen, replay
from cosim.cli.map import map_app
from cosim.cli.output import told_streams
from cosim.cli.progress import doing
from cosim.cli.report import report
from cosim.cli.scenario import scenario_app
from cosim.cli.score import score
from cosim.cli.suite import suite_app
from cosim.cli.verify import doctor, verify
from cosim.core.errors import INTERRUPTED, SOME_CRASHED, CosimError, UsageError, unknown

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    help="Sidewalk-navigation benchmark: SUMO crowds, a PyBullet robot, Zenoh between them.",
    epilog="Examples:  \n`cosim run long-horizon --policy route --episodes 2`  \n`cosim COMMAND --help`",
)
SHARED_HELP = (
    "One process draws for all environments and, if the policy has act_batch, asks it for all of them at once."
)
SEED_HELP = (
    "Of the run: policies' seeds and the names they are told are drawn from it; and the routes with --map (else 0)."
)
OWN_CAMERA_HELP = "The policy may see by a camera that the robot does not have; every row is marked nonstandard."
GOAL_HELP = "What the policy is told of where to go, by its name (`cosim list`), in place of what its manifest says."
LOOK, STEP_IN, MEASURE, PLACES = "Look at episodes", "Step into running episodes", "Measure", "Places"
TRUST = "Trust what came out"


def say_versions(asked: bool) -> None:
    """Print the versions and end, if asked for."""
    if asked:
        from cosim.core.versions import versions_in_words

        typer.echo(versions_in_words())
        raise typer.Exit


@app.callback()
def common(
    version: Annotated[
        bool, typer.Option("--version", callback=say_versions, is_eager=True, help="Say the versions and end.")
    ] = False,
) -> None:
    """Options of `cosim` itself."""


@app.command(
    "run",
    epilog="Examples:  \n"
    "`cosim run long-horizon --policy route --episodes 2`  \n"
    "`cosim run reactive --event frontal --event lateral --policy orca`  \n"
    "`cosim run long-horizon --policy orca --episodes 2 --residents 8`  \n"
    "`cosim run long-horizon --robot scout --episodes 2`  \n"
    "`cosim run long-horizon --policy my_robot.policy:Mine --jobs 2 --out runs/mine`  \n"
    "`cosim run long-horizon --policy my_robot.policy:Mine --out runs/mine --resume`  \n"
    "`cosim run long-horizon --policy my_robot.policy:Mine --jobs 10 --shared-renderer`  \n"
    "`cosim run long-horizon --policy my_robot.policy:Mine --goal route_point`  \n"
    "`cosim run reactive --policy my_robot.policy:Mine --latency 200`, or `--latency measured`, or `--real-time`  \n"
    "`cosim run long-horizon --map sumo-fkk-in --seed 3 --episodes 5`  \n"
    "`cosim run reactive --director tcp/127.0.0.1:7448`, with `cosim direct` beside it  \n"
    "`cosim run long-horizon --policy route --episodes 2 --counterfactual`  \n"
    "`cosim run reactive --policy orca --scenario frontal-001 --rerun frontal.rrd`",
)
def run_command(
    suite: Annotated[str, typer.Argument(help="A suite (see `cosim list`) or the path of a suite's .json file.")],
    policy: Annotated[str, typer.Option(help="A baseline, or your own as package.module:Class.")] = "route",
    robot: Annotated[str, typer.Option(help=eyes.ROBOT_HELP)] = "",
    episodes: Annotated[int | None, typer.Option(min=1, help="Run only the first so many scenarios.")] = None,
    scenario: Annotated[list[str] | None, typer.Option(help="Run only this scenario; may be repeated.")] = None,
    event: Annotated[list[str] | None, typer.Option(help="Run only scenarios of this event; may be repeated.")] = None,
    split: Annotated[str | None, typer.Option(help="Run only scenarios of val, or of test.")] = None,
    jobs: Annotated[int, typer.Option(min=1, help="Environment processes.")] = 1,
    shared_renderer: Annotated[bool, typer.Option("--shared-renderer", help=SHARED_HELP)] = False,
    folder: Annotated[Path | None, typer.Option("--out", help="Run folder; default runs/SUITE-POLICY-TIME.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Finish the run in --out.")] = False,
    map_name: Annotated[
        str | None, typer.Option("--map", help="Draw on this place in place of the suite's: a map, a folder, a net.")
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, show_default="another one each time", help=SEED_HELP)] = None,
    roughness: Annotated[
        float | None, typer.Option(help="Of the ground of --map: from 0, flat, to 1 (raised slabs, roots, potholes).")
    ] = None,
    crowd: Annotated[int | None, typer.Option(min=0, help=CROWD_HELP)] = None,
    residents: Annotated[int | None, typer.Option(min=0, help=eyes.RESIDENTS_HELP)] = None,
    groups: Annotated[float | None, typer.Option(help=GROUPS_HELP)] = None,
    elderly: Annotated[float | None, typer.Option(help=ELDERLY_HELP)] = None,
    children: Annotated[float | None, typer.Option(help=CHILDREN_HELP)] = None,
    goal: Annotated[str, typer.Option(help=GOAL_HELP)] = "",
    latency: Annotated[str, typer.Option(metavar="MS", help=LATENCY_HELP)] = "",
    real_time: Annotated[bool, typer.Option("--real-time", help=REAL_TIME_HELP)] = False,
    frames: Annotated[float, typer.Option(min=0.0, help="Keep a camera frame every so many seconds.")] = 0.0,
    camera: Annotated[eyes.Choice, typer.Option(metavar="CAMERA", help=eyes.CAMERA_HELP)] = "auto",
    own_camera: Annotated[bool, typer.Option("--own-camera", help=OWN_CAMERA_HELP)] = False,
    live: Annotated[
        str | None, typer.Option(help="Be on the air at this endpoint, like tcp/127.0.0.1:7447: see `cosim inject`.")
    ] = None,
    director: Annotated[
        str | None, typer.Option(help="Ask the director at this endpoint, a process of its own: see `cosim direct`.")
    ] = None,
    director_wait: Annotated[
        float, typer.Option(min=0.1, max=LONGEST_WAIT_S, help="Seconds to wait for it; then the episode has crashed.")
    ] = 60.0,
    answer_timeout: Annotated[
        float, typer.Option(min=0.1, help="Seconds a policy may take to answer; then its episode has crashed.")
    ] = 60.0,
    start_timeout: Annotated[
        float, typer.Option(min=0.1, help="The same for loading it, for its reset, and for the first answer after it.")
    ] = 300.0,
    rerun: Annotated[Path | None, typer.Option(metavar="FILE.rrd", help=eyes.RERUN_HELP)] = None,
    counterfactual: Annotated[
        bool, typer.Option("--counterfactual", help="Simulate every street again without the robot: whom it delayed.")
    ] = False,
) -> None:
    """Run a suite with a policy and print its table."""
    from bridge import keys
    from bridge.session import Session
    from cosim.cli.tables import kinds_of, print_by_kind, print_table
    from cosim.policies.load import load_policy
    from cosim.records.run_folder import RunFolder
    from cosim.spec.goal import goal_called
    from cosim.spec.injection import Live
    from cosim.spec.options import EpisodeOptions, Outside
    from cosim.spec.robot import COURIER, robot_called
    from cosim.spec.scenario import Split
    from scenarios.builders.fits import LOOKING, check_places
    from scenarios.catalog import load_suite, scenarios_chosen, with_crowd, with_robot
    from scenarios.execution.asked import Patience
    from scenarios.execution.messages import Hello
    from scenarios.execution.pace import announcement, remembered
    from scenarios.execution.pool import run_all
    from scenarios.execution.process import LocalProcesses
    from scenarios.execution.suite_run import check_alone, run_spec, seed_of_run
    from scenarios.rendering.shared import SharedRenderer, check_shared

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
    picked = scenarios_chosen(whole, scenario or (), episodes, event or (), split)
    loaded = load_policy(policy)
    manifest = loaded.manifest
    drawn_by = eyes.camera_here(camera) if manifest.camera is not None else "bullet"
    asks = shared_renderer and check_shared(loaded, drawn_by)
    eyes.check_rerun(rerun, len(picked))
    if resume and folder is None:
        raise UsageError("--resume needs --out: the folder of the run to finish")
    run_seed = seed_of_run(seed, folder if resume else None)
    stamp = datetime.now().strftime("%Y%m%d-%H%M%S")
    path = folder or Path("runs") / f"{whole.name}-{manifest.name}-{stamp}"
    with doing(LOOKING) as tell:
        check_places(whole, picked, tell)
    on_air = None if live is None else Live(endpoint=checked_endpoint(live, "--live"), run=keys.chunk(path.name))
    outside = None
    if director is not None:
        endpoint = checked_endpoint(director, "--director")
        outside = Outside(endpoint=endpoint, run=keys.chunk(path.name), wait_s=director_wait)
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
    options = with_latency(options, latency, real_time, went_on, whole, picked[0], policy, manifest.rate_hz)
    check_alone(options, jobs, shared_renderer)
    spec = run_spec(whole, picked, policy, loaded, options, shared_renderer)
    with ExitStack() as stack:
        if on_air is not None:
            stack.enter_context(Session.hub(on_air.endpoint))
            err.print(f"On the air at {on_air.endpoint}: see `cosim listen --help`.", soft_wrap=True, highlight=False)
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
        if todo:
            words = announcement(todo, policy, spec.renderer, jobs, counterfactual)
            err.print(words, soft_wrap=not err.is_terminal, highlight=False, markup=False)
        board = Board(picked, done, compared=counterfactual)
        hello, patience = Hello(policy, manifest, loaded.source_hash), Patience(answer_timeout, start_timeout)
        renderer = None
        if shared_renderer and todo:
            drawing = SharedRenderer(held.path / "logs", hello, asks=asks, patience=patience)
            renderer = stack.enter_context(drawing)
        try:
            with board.bars, remembered(held, todo, jobs):
                run_all(
                    held,
                    todo,
                    hello,
                    LocalProcesses(held.path / "logs"),
                    jobs=jobs,
                    tell=board.tell,
                    options=options,
                    patience=patience,
                    renderer=renderer,
                )
        except KeyboardInterrupt:
            finished = len(held.finished())
            again = shlex.join(a for a in sys.argv[1:] if a != "--resume")
            again += "" if folder else f" --out {shlex.quote(str(path))}"
            err.print(f"Stopped. {finished} of {len(picked)} episodes are finished and kept in {path}.")
            err.print(f"Go on with: cosim {again} --resume", soft_wrap=True)
            raise typer.Exit(INTERRUPTED) from None
        table = held.finish()
    print_table(out, table, len(picked))
    print_by_kind(out, table, kinds_of(path))
    out.print(f"Run folder: {path}", soft_wrap=True)
    if lacking := [s.id for s in picked if s.id not in set(table["scenario"])]:
        err.print(f"No record of {', '.join(lacking)}: run it again with --resume.", soft_wrap=True, markup=False)
    if lacking or table["ended"].isna().any():
        raise typer.Exit(SOME_CRASHED)
    eyes.write_rerun(path, [scenario.id for scenario in picked], rerun)


@app.command("list", epilog="Examples:  \n`cosim list`  \n`cosim list reactive`")
def list_all(
    suite: Annotated[str | None, typer.Argument(help="Show the scenarios of this suite.")] = None,
) -> None:
    """List the suites, robots, policies and goals, or the scenarios of a suite."""
    from cosim.cli.tables import print_names, print_scenarios
    from scenarios.catalog import load_suite

    if suite is None:
        print_names(out)
        return
    print_scenarios(out, load_suite(suite))


@app.command(
    epilog="Examples:  \n`cosim show runs/mine`  \n`cosim show runs/mine --events`  \n"
    "`cosim show runs/mine --episode lh-011-00 -o episode.png`  \n"
    "`cosim show runs/mine --episode lh-011-00 --rerun episode.rrd`"
)
def show(
    folder: Annotated[Path, typer.Argument(metavar="RUN", help="A run folder.")],
    episode: Annotated[str | None, typer.Option(help="One episode: its failures and events, and a picture.")] = None,
    picture: Annotated[
        Path | None, typer.Option("-o", "--output", help="Where to write the episode's picture.")
    ] = None,
    events: Annotated[
        bool, typer.Option("--events", help="What was measured of every event, from its tracks.")
    ] = False,
    rerun: Annotated[Path | None, typer.Option(metavar="FILE.rrd", help=eyes.RERUN_HELP)] = None,
) -> None:
    """Show the table of a run, finished or not, or one episode as a picture from above."""
    from cosim.cli.tables import kinds_of, print_by_kind, print_episode, print_sheet, print_table
    from cosim.records.results import table_of
    from cosim.records.run_folder import read_records, read_spec

    spec = read_spec(folder)
    records = {record.scenario: record for record in read_records(folder)}
    if rerun is not None:
        eyes.write_rerun(folder, [] if episode is None else [episode], rerun)
        return
    if events:
        if episode is not None:
            raise UsageError("--events is about a whole run: leave --episode out")
        from scenarios.viewing.eventsheet import sheet_of_run

        print_sheet(out, sheet_of_run(folder))
        return
    if episode is None:
        table = table_of(records.values())
        print_table(out, table, len(spec.scenarios))
        print_by_kind(out, table, kinds_of(folder))
        return
    if episode not in records:
        raise unknown(f"finished episode in {folder}", episode, records)
    from scenarios.viewing.picture import draw_episode

    record = records[episode]
    print_episode(out, record)
    if record.ended is None and picture is not None:
        raise UsageError(f"episode '{episode}' is {record.status}: it has no track to draw. Leave -o out")
    if record.ended is not None:
        path = picture or folder / "episodes" / episode / "above.png"
        with doing(f"drawing {episode}"):
            draw_episode(folder, episode, path)
        out.print(f"Picture: {path}", soft_wrap=True)


app.command(epilog="Example:  \n`cosim doctor`")(doctor)
app.command(epilog="Examples:  \n`cosim verify`  \n`cosim verify --case lh-001-00 --case frontal-001`")(verify)
app.command(
    rich_help_panel=LOOK,
    epilog="Examples:  \n`cosim look lh-011-00 --at 20 -o frame.png`  \n`cosim look lh-011-00 --residents 8`",
)(eyes.look)
app.command(rich_help_panel=LOOK, epilog="Example:  \n`cosim film runs/mine lh-011-00 --from 30 --to 60 -o film.mp4`")(
    eyes.film
)
app.command(
    rich_help_panel=LOOK,
    epilog="Examples:  \n`cosim report runs/mine -o report.html`  \n"
    "`cosim report runs/unit-mine runs/reactive-mine runs/reactive-theirs --failures 24`",
)(report)
app.command(rich_help_panel=LOOK, epilog="Example:  \n`cosim replay runs/mine lh-011-00`")(replay)
app.command(rich_help_panel=LOOK, epilog="Example:  \n`cosim export lh-011-00 street.glb`")(eyes.export)
app.command("counterfactual", rich_help_panel=LOOK, epilog="Example:  \n`cosim counterfactual runs/mine lh-011-00`")(
    compare_one
)
app.command(
    rich_help_panel=STEP_IN,
    epilog="Examples:  \n"
    '`cosim inject \'{"id": "anna", "path": [[170, 252], [190, 252]], "speed_mps": 1.2}\'`  \n'
    "`cosim inject @anna.json --env mine/lh-011-00 --wait 60`",
)(inject)
app.command(
    rich_help_panel=STEP_IN, epilog="Examples:  \n`cosim listen robot --seconds 5`  \n`cosim listen events --wait 60`"
)(listen)
app.command(
    rich_help_panel=STEP_IN,
    epilog="Example, in two terminals:  \n`cosim direct --listen tcp/127.0.0.1:7448`  \n"
    "`cosim run reactive --event frontal --policy orca --director tcp/127.0.0.1:7448`",
)(direct)
app.command(
    rich_help_panel=MEASURE,
    epilog="Examples:  \n`cosim bench --rounds 5`  \n`cosim bench --only driving --compare ../cosim-before`  \n"
    "`cosim bench camera`  \n`cosim bench crowd --cities 10`  \n"
    "`cosim bench crossings --crossings 40 --jobs 2 --policy orca`",
)(bench)
app.command(rich_help_panel=TRUST, epilog="Example:  \n`cosim score runs/mine`")(score)
app.command(
    rich_help_panel=TRUST,
    epilog="Examples:  \n`cosim compare runs/before runs/after`  \n"
    "`cosim compare runs/straight runs/mine runs/other -o all.csv -o table.md -o table.tex`",
)(compare)
app.add_typer(suite_app, name="suite", rich_help_panel=MEASURE)
app.add_typer(scenario_app, name="scenario", rich_help_panel=MEASURE)
app.add_typer(city_app, name="city", rich_help_panel=PLACES)
app.add_typer(map_app, name="map", rich_help_panel=PLACES)


def main() -> None:
    """Run the command line. SIGTERM ends it as Ctrl-C does: exit code 130, nothing half-written is left."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with told_streams():
        try:
            app()
        except CosimError as error:
            err.print(f"[red]error:[/] {escape(str(error))}", soft_wrap=True, highlight=False)
            raise SystemExit(error.exit_code) from None


if __name__ == "__main__":
    main()
