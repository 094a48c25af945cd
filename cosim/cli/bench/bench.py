"""The command line of measurements: `cosim bench`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich import box
from rich.markup import escape
from rich.table import Column, Table

from cosim.cli.bench.crowd import bench_crossings, bench_crowd
from cosim.cli.bench.people import bench_people
from cosim.cli.options.panels import MEASURE
from cosim.cli.options.street import CHILDREN_HELP, ELDERLY_HELP, GROUPS_HELP
from cosim.cli.terminal.consoles import out
from cosim.cli.terminal.fitted import print_fitted
from cosim.cli.terminal.progress import doing
from cosim.core.errors import UsageError, unknown

if TYPE_CHECKING:
    from scenarios.bench.figures import Figure

bench_app = typer.Typer()
NONE = ("none: see below", "")


@bench_app.command(
    rich_help_panel=MEASURE,
    epilog="Examples:  \n`cosim bench --rounds 5`  \n`cosim bench --only driving --compare ../cosim-before`  \n"
    "`cosim bench camera`  \n`cosim bench crowd --cities 10`  \n"
    "`cosim bench crossings --crossings 40 --jobs 2 --policy orca`",
)
def bench(
    what: Annotated[
        str,
        typer.Argument(
            metavar="WHAT",
            help="environment (one process, part by part), camera (all of them side by side), crowd (how people and "
            "vehicles behave), people (how the crowd walks, beside what was measured of people) or crossings (how a "
            "policy, they and the lights get on).",
        ),
    ] = "environment",
    only: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="For `environment` and `camera`: this measurement alone; repeatable."),
    ] = None,
    compare: Annotated[
        Path | None,
        typer.Option(
            metavar="CHECKOUT",
            help="For `environment` and `camera`: take each figure there too, in turns, and show the ratios.",
        ),
    ] = None,
    rounds: Annotated[int, typer.Option(min=1, help="How often each figure is taken; medians are shown.")] = 3,
    cities: Annotated[
        int | None, typer.Option(min=1, help="How many cities: 3 for `crowd`, 20 for `crossings` unless you say.")
    ] = None,
    minutes: Annotated[float, typer.Option(min=0.1, help="For `crowd`: simulated minutes in each.")] = 10.0,
    residents: Annotated[int, typer.Option(min=0, help="For `crowd`: residents beside the crowd.")] = 0,
    crossings: Annotated[int, typer.Option(min=1, help="For `crossings`: how many in all.")] = 200,
    policy: Annotated[str, typer.Option(help="For `crossings`: who drives over them.")] = "orca",
    jobs: Annotated[int, typer.Option(min=1, help="For `crossings` and `people`: processes.")] = 1,
    groups: Annotated[float, typer.Option(help=f"For `crowd`: {GROUPS_HELP}")] = 0.0,
    elderly: Annotated[float, typer.Option(help=f"For `crowd`: {ELDERLY_HELP}")] = 0.0,
    children: Annotated[float, typer.Option(help=f"For `crowd`: {CHILDREN_HELP}")] = 0.0,
) -> None:
    """Measure one environment process, part by part, the cameras, or what robot, people and vehicles do in traffic."""
    choices = ("environment", "camera", "crowd", "people", "crossings")
    if what not in choices:
        raise unknown("bench", what, choices)
    if what == "crowd":
        bench_crowd(3 if cities is None else cities, minutes, residents, groups, elderly, children)
        return
    if what == "crossings":
        bench_crossings(crossings, min(20, crossings) if cities is None else cities, policy, jobs)
        return
    if what == "people":
        bench_people(jobs)
        return
    only = only or []
    if compare is not None:
        _compare(compare, what, only, rounds)
    elif what == "camera" and not only:
        bench_cameras(rounds)
    else:
        print_figures(_taken(what, only, [None], rounds)[0])


def _taken(
    what: str, only: Sequence[str], checkouts: Sequence[Path | None], rounds: int
) -> list[dict[str, list[Figure]]]:
    """The figures of checkouts, None for this one, each value of each round."""
    from scenarios.bench.measurements import CAMERA, ENVIRONMENT, ON_REQUEST, ROOT, chosen, take_rounds

    environment = (*ENVIRONMENT, *ON_REQUEST) if only else ENVIRONMENT
    names = chosen(only, tuple(CAMERA) if what == "camera" else environment)
    with doing("measuring") as tell:
        return take_rounds(names, [one or ROOT for one in checkouts], rounds, lambda words: tell(f"measuring: {words}"))


def _compare(other: Path, what: str, only: Sequence[str], rounds: int) -> None:
    """A row per figure that both checkouts take: medians here and there, and the ratio round by round."""
    from scenarios.bench.figures import spread

    if not (other / "scenarios" / "bench" / "take.py").is_file():
        raise UsageError(f"--compare {other}: no checkout of cosim that can be measured (scenarios/bench/take.py)")
    here, there = _taken(what, only, [None, other.resolve()], rounds)
    table = Table(*_columns("figure", "here", "there", "here / there", "spread"), box=box.SIMPLE_HEAD, padding=0)
    for name in [name for name in here if name in there]:
        mine, theirs = ([one.value for one in found[name]] for found in (here, there))
        ratios = [a / b for a, b in zip(mine, theirs, strict=True)]
        table.add_row(name, spread(mine)[0], spread(theirs)[0], *spread(ratios))
    print_fitted(out, table)
    out.print(f"medians; a ratio a round, {rounds} in all, the checkouts in turns", highlight=False)


def print_figures(found: Mapping[str, Sequence[Figure]]) -> None:
    """A row per figure: the median of its rounds, the engine's own time, their ratio, and what should be reached."""
    from scenarios.bench.figures import spread

    heads = ("figure", "median", "spread", "limit", "ratio", "reach")
    table = Table(*_columns(*heads), box=box.SIMPLE_HEAD, padding=0)
    limits: dict[str, None] = {}
    for name, rounds in found.items():
        first, ratios = rounds[0], [one.ratio for one in rounds if one.ratio is not None]
        limit = ratio = reach = mark = ""
        if ratios:
            limit, ratio = (spread(values)[0] for values in ([one.limit or 0.0 for one in rounds], ratios))
            limits[first.limit_is] = None
            mark = f" [{list(limits).index(first.limit_is) + 1}]"
        if first.reach is not None:
            reach = f"{'ratio' if first.reach_ratio else ''} {first.better} {first.reach:,.4g}".strip()
        table.add_row(escape(name + mark), *spread([one.value for one in rounds]), limit, ratio, reach)
    print_fitted(out, table)
    for i, words in enumerate(limits):
        out.print(f"limit [{i + 1}]: {words}", markup=False, highlight=False)


def _columns(first: str, *others: str) -> list[Column]:
    return [Column(first, overflow="fold"), *(Column(head, no_wrap=True, justify="right") for head in others)]


def bench_cameras(rounds: int) -> None:
    """Measure the cameras in one busy street and print frames a second, targets and ratios."""
    from physics.cameras.choice import camera_of_choice, renderer_of
    from scenarios.bench.cameras import FIGURES, PERSONS, RATIOS, SIZE, time_cameras
    from scenarios.bench.figures import spread

    drawn_by = renderer_of(camera_of_choice("auto"))
    on_gpu = "llvmpipe" not in drawn_by and "bullet" not in drawn_by
    with doing("measuring") as tell:
        found = time_cameras(rounds, lambda words: tell(f"measuring: {words}"))
    head = f"busy street, {PERSONS} people in view, {SIZE[0]}x{SIZE[1]}"
    table = Table(head, "frames/s", "spread", "target")
    for figure in FIGURES:
        least, fps = figure.least_fps[on_gpu], found[figure.name].fps
        table.add_row(figure.name, *(spread(fps) if fps else NONE), "" if least is None else f">= {least:,.4g}")
    print_fitted(out, table)
    ratios = Table("ratio", "median", "spread", "target")
    for name, above, below, target in RATIOS:
        values = [a / b for a, b in zip(found[above].fps, found[below].fps, strict=False)]
        ratios.add_row(name, *(spread(values) if values else NONE), target)
    print_fitted(out, ratios)
    out.print(f"{drawn_by}; {rounds} {'round' if rounds == 1 else 'rounds'}, medians", highlight=False)
    wrong: dict[str, list[str]] = {}
    for name, one in found.items():
        if one.why:
            wrong.setdefault(one.why, []).append(name)
    for why, names in wrong.items():
        out.print(f"{'; '.join(names)} cannot be drawn here: {why}", soft_wrap=True, markup=False, highlight=False)
    if wrong:
        out.print("What the machine lacks, and how to get it: `cosim doctor`.", highlight=False)
