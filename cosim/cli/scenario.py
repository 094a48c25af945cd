"""The command line of own scenarios: `cosim scenario new`, `check`, `draw`."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich import box
from rich.table import Column, Table

from cosim.cli.consoles import err, out
from cosim.cli.progress import doing
from cosim.core.errors import WRONG_USE, SpecError, UsageError, unknown, unwritable
from cosim.core.whole_file import write_whole

if TYPE_CHECKING:
    from cosim.spec.scenario import Suite
    from scenarios.own.reading import OwnFile

scenario_app = typer.Typer(
    no_args_is_help=True, rich_markup_mode="markdown", help="Scenarios of your own, in TOML files; sweeps over them."
)
_MOVED_M = 0.5
"""What was moved farther than this is told."""
_FILE_HELP = "A TOML file: `cosim scenario new` writes one."


@scenario_app.command("new", epilog="Example:  \n`cosim scenario new mine.toml`")
def write_template(
    file: Annotated[Path, typer.Argument(help="Where to write it, a .toml; it is named after it.")],
) -> None:
    """Write a scenario that runs as it is, with a comment on everything that may stand in it."""
    if file.suffix != ".toml":
        raise UsageError(f"{file}: a scenario's file ends in .toml")
    if file.exists():
        raise UsageError(f"{file} is there already: choose another name, or remove it")
    name = re.sub(r"[^A-Za-z0-9_.-]+", "-", file.stem).strip("-.") or "mine"
    template = Path(__file__).parents[2] / "scenarios" / "own" / "template.toml"
    try:
        write_whole(file, template.read_bytes().replace(b"NAME", name.encode(), 1))
    except OSError as error:
        raise unwritable(file, error) from error
    out.print(f"{file}: try `cosim scenario draw {file} -o map.png` and `cosim scenario run {file}`", soft_wrap=True)


@scenario_app.command(
    "check", epilog="Examples:  \n`cosim scenario check mine.toml`  \n`cosim scenario check scenarios/examples/*.toml`"
)
def check_own(files: Annotated[list[Path], typer.Argument(metavar="FILE...", help=_FILE_HELP)]) -> None:
    """Say what scenarios are, or everything that is wrong with them: fields, place, way, events, obstacles, room."""
    from scenarios.own.checking import own_faults
    from scenarios.own.making import suite_of_own
    from scenarios.own.reading import read_own

    faulty = 0
    for path in files:
        try:
            with doing(f"checking {path}") as tell:
                own = read_own(path)
                faults = own_faults(own, tell)
        except SpecError as error:
            faults = [str(error).removeprefix(f"{path}: ")]
        if faults:
            faulty += 1
            for fault in faults:
                err.print(f"{path}: {fault}", soft_wrap=True, markup=False, highlight=False)
        else:
            _say(own)
            _print_scenarios(suite_of_own(own), own)
    if faulty:
        raise typer.Exit(WRONG_USE)


@scenario_app.command(
    "draw",
    epilog="Examples:  \n`cosim scenario draw mine.toml -o map.png`  \n"
    "`cosim scenario draw mine.toml --whole -o town.png`",
)
def draw_own(
    file: Annotated[Path, typer.Argument(help=_FILE_HELP)],
    picture: Annotated[Path, typer.Option("-o", "--output", help="The picture, a PNG.")],
    scenario: Annotated[str | None, typer.Option(help="Of a sweep, which one; by default the first.")] = None,
    whole: Annotated[bool, typer.Option("--whole", help="The whole place, also where there is no way yet.")] = False,
) -> None:
    """Draw the map from above: coordinates, way, metres along it, fences, obstacles, events."""
    from cosim.report.mapsheet import write_png
    from cosim.report.plan import draw_plan
    from scenarios.execution.places import place
    from scenarios.own.making import made_one, place_of_own
    from scenarios.own.reading import read_own

    own = read_own(file)
    variants = {variant.id: variant for variant in own.variants}
    if scenario is not None and scenario not in variants:
        raise unknown("scenario", scenario, variants)
    variant = variants[scenario] if scenario else own.variants[0]
    with doing(f"drawing {variant.id}"):
        made = made_one(variant, own.name)
        if made.scenario is None and not whole:
            faults = "\n  ".join(made.faults)
            raise SpecError(f"{file}: {faults}\n  --whole draws the place alone, to find a way on it")
        _, street_map = place(place_of_own(variant.own.place) if made.scenario is None else made.scenario.place)
        write_png(draw_plan(street_map, made.scenario, whole=whole), picture)
    for fault in made.faults:
        err.print(f"{file}: {fault}", soft_wrap=True, markup=False, highlight=False)
    out.print(f"Picture: {picture}", soft_wrap=True)


def _say(own: OwnFile) -> None:
    """What a file makes, in words."""
    swept = ", ".join(f"{axis.field} ({len(axis.values)} values)" for axis in own.axes)
    count = len(own.variants)
    words = f"a sweep over {swept}: {count} scenarios" if swept else f"{count} scenario{'s' * (count > 1)}"
    out.print(f"{own.path}: {words}", soft_wrap=True, markup=False, highlight=False)


def _print_scenarios(suite: Suite, own: OwnFile) -> None:
    """A row per scenario, with its hash: for 80 columns."""
    from cosim.spec.scenario import content_hash
    from scenarios.own.ways import moved_m

    heads = ("scenario", "hash", "way\nm", "cross-\nings", "events", "obst-\nacles", "people", "limit\ns")
    first, *others = (Column(head, no_wrap=head != heads[0], overflow="fold") for head in heads)
    shown = Table(first, *others, box=box.SIMPLE_HEAD, padding=0)
    for one in suite.scenarios:
        people = f"{one.crowd.density:g}/1000m2" if one.crowd.density is not None else str(one.crowd.persons)
        counts = (str(len(there)) for there in (one.crossings, one.events, one.obstacles))
        length = f"{one.route_line.length_m:.1f}"
        shown.add_row(one.id, content_hash(one), length, *counts, people, f"{one.time_limit_s:g}")
    out.print(shown)
    pairs = zip(own.variants, suite.scenarios, strict=True)
    for name, far_m in dict.fromkeys(end for variant, one in pairs for end in moved_m(variant.own.way, one)):
        if far_m > _MOVED_M:
            out.print(f"way: {name} was moved by {far_m:.1f} m to the middle of its sidewalk")
    out.print(f"on {', '.join(sorted({one.place.name for one in suite.scenarios}))}; suite hash {suite.content_hash}")
