"""The commands `cosim scenario new`, `check`, `draw` and `run`."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cosim.cli import tables
from cosim.cli.console import err, notice, out, say
from cosim.cli.generated_options import ConfiguredCommand, Fields, configured
from cosim.cli.options import camera_here, check_rerun, replacement_note, write_rerun
from cosim.cli.progress import doing
from cosim.core.bounding_box import check_overlap, parse_box
from cosim.core.errors import (
    INTERRUPTED,
    SOME_CRASHED,
    WRONG_USE,
    MachineError,
    SpecError,
    UsageError,
    unknown,
    unwritable,
)
from cosim.core.files import write_atomic
from cosim.spec.run_config import MEASURED, ROS2_OPTIONS, RunConfig

if TYPE_CHECKING:
    import pandas as pd

    from cosim.spec.goal import GoalProtocol
    from cosim.spec.scenario import Suite
    from scenarios.suites.user_scenarios.read import OwnFile

scenario_app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode="markdown",
    help="Scenarios of your own, in TOML files; sweeps over them.",
)
_MOVED_M = 0.5
"""Metres beyond which a moved end of a route is reported."""
_FILE_HELP = "A TOML file: `cosim scenario new` writes one."
_OF_OWN_RUN = Fields(
    only=(
        "policy",
        "isolated",
        "policy_data",
        "policy_memory",
        "jobs",
        "out",
        "resume",
        "seed",
        "frames",
        "camera",
        "appearance",
        "latency",
        "real_time",
        "rerun",
        *ROS2_OPTIONS,
    ),
    help={
        "policy": "A baseline, or your own as my.py:Class.",
        "jobs": "Environment processes.",
        "out": "Run folder; default runs/NAME-POLICY-TIME.",
        "seed": "Of the run: policies' own seeds are drawn from it.",
    },
)
"""Options of `cosim scenario run`."""


@scenario_app.command("new", epilog="Example:  \n`cosim scenario new mine.toml`")
def write_template(
    file: Annotated[Path, typer.Argument(help="Where to write it, a .toml; it is named after it.")],
) -> None:
    """Write a scenario file that runs as it is, with a comment on every possible field."""
    if file.suffix != ".toml":
        raise UsageError(f"{file}: a scenario's file ends in .toml")
    if file.exists():
        raise UsageError(f"{file} is there already: choose another name, or remove it")
    name = re.sub(r"[^A-Za-z0-9_.-]+", "-", file.stem).strip("-.") or "mine"
    template = (
        Path(__file__).parents[2] / "scenarios" / "suites" / "user_scenarios" / "template.toml"
    )
    try:
        write_atomic(file, template.read_bytes().replace(b"NAME", name.encode(), 1))
    except OSError as error:
        raise unwritable(file, error) from error
    out.print(
        f"{file}: try `cosim scenario draw {file} -o map.png` and `cosim scenario run {file}`",
        soft_wrap=True,
    )


@scenario_app.command(
    "check",
    epilog="Examples:  \n`cosim scenario check mine.toml --drive`  \n`cosim scenario check "
    "scenarios/examples/*.toml`",
)
def check_own(
    files: Annotated[list[Path], typer.Argument(metavar="FILE...", help=_FILE_HELP)],
    drive: Annotated[
        bool, typer.Option("--drive", help="Have the oracle drive each: can it be solved?")
    ] = False,
) -> None:
    """Print the scenarios of files, or all their errors at once.

    Checks fields, place, route, events, obstacles and free width. Exit code 1: the oracle failed.
    """
    from scenarios.suites.user_scenarios.build import suite_of_own
    from scenarios.suites.user_scenarios.check import own_faults
    from scenarios.suites.user_scenarios.read import read_own

    faulty = failed = 0
    for path in files:
        try:
            with doing(f"checking {path}") as progress:
                own = read_own(path)
                faults = own_faults(own, progress)
        except SpecError as error:
            faults = [str(error).removeprefix(f"{path}: ")]
        if faults:
            faulty += 1
            for fault in faults:
                notice(f"{path}: {fault}")
        else:
            _print_count(own)
            suite = suite_of_own(own)
            _print_scenarios(suite, own)
            failed += _driven(suite) if drive else 0
    if faulty:
        raise typer.Exit(WRONG_USE)
    if failed:
        raise typer.Exit(SOME_CRASHED)


def _driven(suite: Suite) -> int:
    """Print whether the oracle solves each scenario, and return the number of failures."""
    from scenarios.suites.proofs import Dropped
    from scenarios.tools.build.proving import EXPERT, proved

    failed = 0
    for one in suite.scenarios:
        with doing(f"{EXPERT} drives {one.id}"):
            proof = proved(one)
        if isinstance(proof, Dropped):
            failed += 1
            words = f"{EXPERT} fails: {proof.reason} {proof.details}"
        else:
            words = f"solved by {EXPERT} in {proof.time_s:.1f} s"
        say(f"{one.id}: {words}")
    return failed


@scenario_app.command(
    "draw",
    epilog="Examples:  \n`cosim scenario draw mine.toml -o map.png`  \n"
    "`cosim scenario draw mine.toml --whole -o town.png`  \n"
    "`cosim scenario draw mine.toml --zoom 300,1700,500,1900 -o part.png`",
)
def draw_own(
    file: Annotated[Path, typer.Argument(help=_FILE_HELP)],
    picture: Annotated[Path, typer.Option("-o", "--output", help="The picture, a PNG.")],
    scenario: Annotated[
        str | None, typer.Option(help="Of a sweep, which one; by default the first.")
    ] = None,
    whole: Annotated[
        bool, typer.Option("--whole", help="The whole place, also where there is no way yet.")
    ] = False,
    zoom: Annotated[
        str | None, typer.Option(help="Part of the place: x0,y0,x1,y1 in metres.")
    ] = None,
) -> None:
    """Draw the map from above, with coordinates, route, fences, obstacles and events."""
    from cosim.report.mapsheet import draw_plan, write_png
    from scenarios.places.nets import place
    from scenarios.suites.user_scenarios.build import build_scenario, place_of_own
    from scenarios.suites.user_scenarios.read import read_own
    from sumo_nets.maps.map_store import credit_of

    part = None if zoom is None else parse_box("--zoom", zoom)
    own = read_own(file)
    variants = {variant.id: variant for variant in own.variants}
    if scenario is not None and scenario not in variants:
        raise unknown("scenario", scenario, variants)
    variant = variants[scenario] if scenario else own.variants[0]
    instead = replacement_note(picture)
    with doing(f"drawing {variant.id}"):
        made = build_scenario(variant, own.name)
        if made.scenario is None and not whole and part is None:
            faults = "\n  ".join(made.faults)
            raise SpecError(
                f"{file}: {faults}\n  --whole draws the place alone, to find a way on it"
            )
        where = place_of_own(variant.own.place) if made.scenario is None else made.scenario.place
        _, street_map = place(where)
        if part is not None:
            check_overlap("--zoom", part, street_map.bounds)
        plan = draw_plan(street_map, made.scenario, whole=whole, part=part, credit=credit_of(where))
        write_png(plan, picture)
    for fault in made.faults:
        notice(f"{file}: {fault}")
    out.print(f"Picture: {picture}{instead}", soft_wrap=True)
    if made.faults:
        raise typer.Exit(WRONG_USE)


@scenario_app.command(
    "run",
    cls=ConfiguredCommand,
    epilog="Examples:  \n`cosim scenario run mine.toml --policy orca`  \n"
    "`cosim scenario run sweep.toml --policy social_force --jobs 2 --out runs/sweep`  \n"
    "`cosim scenario run sweep.toml --policy social_force --out runs/sweep --resume`  \n"
    "`cosim scenario run mine.toml --policy my.py:Mine --real-time --rerun mine.rrd`",
)
@configured
def run_own(
    file: Annotated[Path, typer.Argument(help=_FILE_HELP)],
    config: Annotated[RunConfig, _OF_OWN_RUN],
) -> None:
    """Run the scenarios of a file. A sweep gets a table by its values, and a plot.

    `cosim run FILE.toml` has all other options of runs.
    """
    from cosim.results.run_folder import check_unused
    from scenarios.runs.policy_host import host_of, inspected_caller
    from scenarios.suites.user_scenarios.check import checked_own
    from scenarios.suites.user_scenarios.read import read_own

    own = read_own(file)
    check_rerun(config.rerun, len(own.variants))
    if config.out is not None and not config.resume:
        for part in _parts(own, config.out).values():
            check_unused(part)
    with doing(f"checking {file}") as progress:
        suite = checked_own(own, progress)
    manifest = inspected_caller(config.policy, host_of(config), config.jobs or 1).manifest
    stamp = datetime.now().strftime("%Y%m%d-%H%M%S")
    path = config.out or Path("runs") / f"{own.name}-{manifest.name}-{stamp}"
    if manifest.camera is not None:
        config = replace(config, camera=camera_here(config.camera))
    _print_count(own)
    tables = _run_parts(own, suite, config, path)
    _print_run(own, tables, path)
    write_rerun(path, [own.variants[0].id], config.rerun)


def _parts(own: OwnFile, path: Path) -> dict[GoalProtocol | None, Path]:
    """Return the run folder of each goal protocol in a file, because a run has only one."""
    goals = dict.fromkeys(variant.own.goal_protocol for variant in own.variants)
    return {goal: path if len(goals) == 1 else path / str(goal) for goal in goals}


def _run_parts(own: OwnFile, suite: Suite, config: RunConfig, path: Path) -> list[pd.DataFrame]:
    """Run the scenarios of a file, with one seed and one latency, and return a table per run."""
    from cosim.cli.run_progress import EpisodeBars
    from cosim.results.run_folder import read_spec
    from scenarios.runs.planning import seed_of_run
    from scenarios.runs.policy_host import host_of
    from scenarios.runs.run import RunObjects, execute_run

    parts = _parts(own, path)
    begun = [part for part in parts.values() if config.resume and (part / "run.json").exists()]
    if config.resume and not begun:
        read_spec(path)
    config = replace(config, seed=seed_of_run(config.seed, begun[0] if begun else None))
    tables: list[pd.DataFrame] = []
    for goal, part in parts.items():
        if config.latency == MEASURED and (known := [*begun, *list(parts.values())[: len(tables)]]):
            config = replace(config, latency=repr(read_spec(known[0]).setup.latency_ms))
        ids = tuple(variant.id for variant in own.variants if variant.own.goal_protocol == goal)
        of_part = replace(
            config, suite=own.name, scenario=ids, goal=goal or "", out=part, resume=part in begun
        )
        try:
            objects = RunObjects(suite=suite, host=host_of(of_part))
            tables.append(execute_run(of_part, objects=objects, reporter=EpisodeBars()))
        except KeyboardInterrupt:
            notice(
                f"Stopped. Finished episodes are stored in {part}: continue with --out {path} "
                f"--resume"
            )
            raise typer.Exit(INTERRUPTED) from None
    return tables


def _print_run(own: OwnFile, tables: Sequence[pd.DataFrame], path: Path) -> None:
    """Print the results of a run; a sweep by its values, which are also written to files."""
    import pandas as pd

    from cosim.cli.run_table import print_next_commands, print_statuses, print_table
    from scenarios.suites.user_scenarios.sweep import summary_of_sweep, write_sweep

    table = pd.concat(tables, ignore_index=True)
    if own.axes:
        summary = summary_of_sweep(own, table)
        _print_sweep(summary, [axis.field for axis in own.axes])
        print_statuses(out, table, len(own.variants))
        try:
            files = write_sweep(summary, own, path)
            out.print(f"Table and picture: {' '.join(map(str, files))}", soft_wrap=True)
        except MachineError as error:
            notice(str(error))
    else:
        print_table(out, table, len(own.variants), path)
    out.print(f"Run folder: {path}", soft_wrap=True)
    if len(tables) == 1:
        print_next_commands(err, path, table)
    if table["ended"].isna().any():
        raise typer.Exit(SOME_CRASHED)


def _print_sweep(summary: pd.DataFrame, fields: list[str]) -> None:
    """Print the means of a sweep, a row per value, with intervals below."""
    from cosim.results.intervals import MIN_N, Estimate
    from cosim.results.metrics import SUCCESS_IN_WORDS
    from scenarios.suites.user_scenarios.sweep import SWEPT

    columns = [
        *tables.names(*(field.replace(".", ".\n") for field in fields)),
        *tables.figures("n", "crashed"),
    ]
    columns += tables.labels("SR", "SPL", "RC", "FC /100m")
    shown = []
    for values, rows in summary.groupby(fields, sort=False):
        means = rows.set_index("metric").loc[list(SWEPT)]
        estimates = [
            Estimate(*row) for row in means[list(Estimate._fields)].itertuples(index=False)
        ]
        cells = [
            f"{one.in_words}\n{one.interval_in_words('..')}" if one.has_interval else one.in_words
            for one in estimates
        ]
        counts = f"{max(one.n for one in estimates)}", f"{means['crashed'].iloc[0]}"
        shown.append((*(f"{value}" for value in values), *counts, *cells))
    tables.show(out, columns, shown)
    out.print(
        f"n episodes that are scored; SR {SUCCESS_IN_WORDS}; SPL the same by path length; RC share "
        "of the route done; FC all failures on all metres, per 100 m; below: 95 % intervals, or "
        f"only counts of less than {MIN_N} episodes"
    )


def _print_count(own: OwnFile) -> None:
    """Print the number of scenarios in a file."""
    swept = ", ".join(f"{axis.field} ({len(axis.values)} values)" for axis in own.axes)
    count = len(own.variants)
    words = (
        f"a sweep over {swept}: {count} scenarios"
        if swept
        else f"{count} scenario{'s' * (count > 1)}"
    )
    say(f"{own.path}: {words}")


def _print_scenarios(suite: Suite, own: OwnFile) -> None:
    """Print a row per scenario with its hash, and notes."""
    from cosim.spec.scenario import content_hash
    from scenarios.suites.user_scenarios.along_route import narrow_events
    from scenarios.suites.user_scenarios.routes import moved_m

    short = f"{own.name}-" if len(own.variants) > 1 else ""
    columns = [*tables.names(short or "scenario"), *tables.labels("hash")]
    columns += tables.figures("way\nm", "cross-\nings", "events", "obst-\nacles", "people")
    shown = []
    for one in suite.scenarios:
        people = (
            f"{one.crowd.density:g}/1000m2"
            if one.crowd.density is not None
            else str(one.crowd.persons)
        )
        counts = (str(len(there)) for there in (one.crossings, one.events, one.obstacles))
        length = f"{one.route_line.length_m:.1f}"
        shown.append((one.id.removeprefix(short), content_hash(one), length, *counts, people))
    tables.show(out, columns, shown)
    pairs = zip(own.variants, suite.scenarios, strict=True)
    for name, far_m in dict.fromkeys(
        end for variant, one in pairs for end in moved_m(variant.own.way, one)
    ):
        if far_m > _MOVED_M:
            out.print(f"way: {name} was moved by {far_m:.1f} m to the middle of its sidewalk")
    for note in dict.fromkeys(note for one in suite.scenarios for note in narrow_events(one)):
        say(f"note: {note}")
    for variant, one in zip(own.variants, suite.scenarios, strict=True):
        wanted = variant.own.obstacles
        if wanted.per_100m and len(one.obstacles) == len(wanted.placed):
            out.print(
                f"note: {one.id}: no room for obstacles that leave the robot's width and 0.5 m",
                soft_wrap=True,
            )
    where = ", ".join(sorted({one.place.name for one in suite.scenarios}))
    least_s, most_s = (end(one.time_limit_s for one in suite.scenarios) for end in (min, max))
    limits = f"{least_s:g}" if least_s == most_s else f"{least_s:g} to {most_s:g}"
    out.print(f"on {where}; time limit {limits} s; suite hash {suite.content_hash}", soft_wrap=True)
