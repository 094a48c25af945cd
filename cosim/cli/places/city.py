"""The command line of generated cities: `cosim city make`, `table`, `draw`."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich import box
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Column, Table

from cosim.cli.options.output_file import replaced
from cosim.cli.terminal.consoles import err, out
from cosim.cli.terminal.fitted import print_fitted
from cosim.cli.terminal.progress import doing
from cosim.core.box import box_of, refuse_outside
from cosim.core.errors import SOME_CRASHED

if TYPE_CHECKING:
    from cosim.place.street_map import StreetMap
    from cosim.report.legend import Image
    from scenarios.bench.survey import Survey

city_app = typer.Typer(no_args_is_help=True, rich_markup_mode="markdown", help="Generated cities, from a seed.")

Seed = Annotated[int, typer.Option(min=0, help="Every seed is another city.")]
_Size = Annotated[float, typer.Option(help="Side of its square in metres, 200 to 4000.")]
_Style = Annotated[str, typer.Option(help="mixed, downtown or suburb.")]

_FIGURES: tuple[tuple[str, Callable[[Survey], float], str], ...] = (
    ("straight", lambda s: s.census.blocks["straight"], "d"),
    ("curve", lambda s: s.census.blocks["curve"], "d"),
    ("S", lambda s: s.census.blocks["s_bend"], "d"),
    ("T", lambda s: s.census.blocks["t_junction"], "d"),
    ("X", lambda s: s.census.blocks["x_junction"], "d"),
    ("Y", lambda s: s.census.blocks["y_junction"], "d"),
    ("round", lambda s: s.census.blocks["roundabout"], "d"),
    ("walk km", lambda s: s.census.sidewalk_km, ".1f"),
    ("walk %", lambda s: 100.0 * s.census.walkable_share, ".1f"),
    ("cross", lambda s: s.census.crossings, "d"),
    ("lit", lambda s: s.census.signalised, "d"),
    ("mid", lambda s: s.census.crosswalks, "d"),
    ("refuge", lambda s: s.census.refuges, "d"),
    ("drive", lambda s: s.census.driveways, "d"),
    ("props", lambda s: s.props, "d"),
    ("side m", lambda s: s.side_m, ".2f"),
    ("clear m", lambda s: s.census.clear_m, ".2f"),
    ("far km", lambda s: s.census.longest_m / 1000.0, ".2f"),
    ("one %", lambda s: 100.0 * s.census.one_piece, ".1f"),
)
"""Columns of the table: head, value, format."""

MEANING = (
    "straight, curve, S: streets; T, X, Y, round: junctions; walk km, walk %: sidewalks, share of the city's area; "
    "cross, lit, mid, refuge: crossings, with signals, in mid-street, with an island; drive: driveways; "
    "props: street furniture; side m: least width beside it on any sidewalk; clear m: width that passes everywhere, "
    "furniture included (2 at most); far km: longest shortest walk; one %: of the walkable area in one piece"
)


@city_app.command(epilog="Example:  \n`cosim city make --seed 7 --size 500 cities/seven`")
def make(
    folder: Annotated[Path, typer.Argument(metavar="OUT", help="A folder, made for it.")],
    seed: Seed,
    size: _Size = 2000.0,
    style: _Style = "mixed",
) -> None:
    """Make a city: a folder with its street net, and what it was made from. Equal to the byte when made again."""
    from cosim.spec.scenario import City
    from sumo_nets.city.store import write_city

    city = City(seed=seed, size_m=size, style=style)
    with doing(f"building {city.name}"):
        made = write_city(city, folder)
    out.print(f"{folder}: {made.name}, net {made.net_hash}", soft_wrap=True, highlight=False)


@city_app.command(epilog="Example:  \n`cosim city table --count 10 --jobs 2`")
def table(
    count: Annotated[int, typer.Option(min=1, max=100, help="How many of the shipped cities.")] = 100,
    size: _Size = 2000.0,
    style: _Style = "mixed",
    jobs: Annotated[int, typer.Option(min=1, help="Processes, about 0.3 GiB each.")] = 1,
) -> None:
    """Count what the shipped cities are made of, furniture included, and check them. Exit code 1: one breaks a
    promise."""
    from scenarios.bench.survey import surveys
    from sumo_nets.city.seeds import shipped_cities

    cities = shipped_cities(count, size, style)
    found: list[Survey] = []
    with _bar() as bar:
        task = bar.add_task("cities", total=count)
        for one in surveys(cities, jobs):
            found.append(one)
            bar.advance(task)
    print_cities(found)
    if any(one.faults for one in found):
        raise typer.Exit(SOME_CRASHED)


@city_app.command(
    "draw",
    epilog="Examples:  \n`cosim city draw 7 -o city.png`  \n`cosim city draw 7 --zoom 900,900,1100,1100 -o block.png`",
)
def draw_city(
    seed: Annotated[int, typer.Argument(min=0, help="The city's seed.")],
    picture: Annotated[Path, typer.Option("-o", "--output", help="Where to write the picture, a PNG.")],
    size: _Size = 2000.0,
    style: _Style = "mixed",
    zoom: Annotated[str | None, typer.Option(help="Part of it: x0,y0,x1,y1 in metres.")] = None,
) -> None:
    """Draw a city from above."""
    from cosim.report.mapsheet import write_png
    from cosim.spec.scenario import City
    from sumo_nets.city.store import city_net
    from sumo_nets.net.snapshot import street_map_of

    part = (0.0, 0.0, size, size) if zoom is None else box_of("--zoom", zoom, "x0,y0,x1,y1")
    city = City(seed=seed, size_m=size, style=style)
    instead = replaced(picture)
    with doing(f"building {city.name}") as tell:
        street_map = street_map_of(city_net(city))
        refuse_outside("--zoom", part, street_map.bounds)
        tell("drawing")
        write_png(_picture(street_map, part), picture)
    out.print(f"Picture: {picture}{instead}", soft_wrap=True)


def print_cities(found: Sequence[Survey]) -> None:
    """A row per city, the spans of all, widths of the zones, and whatever is wrong."""
    heads = [Column(head, justify="right", no_wrap=True) for head, _, _ in _FIGURES]
    shown = Table(Column("seed", no_wrap=True), *heads, box=box.SIMPLE_HEAD, padding=(0, 0, 0, 1))
    for one in found:
        shown.add_row(str(one.seed), *(format(value(one), form) for _, value, form in _FIGURES))
    shown.add_section()
    for name, pick in (("min", min), ("median", statistics.median), ("max", max)):
        cells = [
            format(round(x) if form == "d" else x, form)
            for _, value, form in _FIGURES
            for x in [pick([value(one) for one in found])]
        ]
        shown.add_row(name, *cells)
    print_fitted(out, shown)
    zones = Table("zone", "narrowest m", "median m", "widest m", box=box.SIMPLE_HEAD)
    for zone in found[0].census.zones:
        spans = [one.census.zones[zone] for one in found]
        middle = statistics.median(span.middle for span in spans)
        zones.add_row(zone, f"{min(s.low for s in spans):.2f}", f"{middle:.2f}", f"{max(s.high for s in spans):.2f}")
    print_fitted(out, zones)
    out.print(MEANING)
    faulty = [(one.seed, fault) for one in found for fault in one.faults]
    for seed, fault in faulty:
        out.print(f"city {seed}: {fault}", soft_wrap=True, markup=False, highlight=False)
    signals = sum(one.census.signals for one in found)
    out.print(f"{len(found)} cities, {signals} traffic lights checked, {len(faulty)} faults", highlight=False)
    narrowest, tightest = min(one.side_m for one in found), min(one.census.clear_m for one in found)
    out.print(
        f"least width beside furniture on any sidewalk {narrowest:.2f} m, passing everywhere {tightest:.2f} m; "
        f"memory of a process {max(one.memory_mib for one in found):.0f} MiB at most",
        soft_wrap=True,
        highlight=False,
    )


def _bar() -> Progress:
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    return Progress(*columns, TimeRemainingColumn(), console=err)


def _picture(street_map: StreetMap, part: tuple[float, float, float, float]) -> Image:
    """A part of a map from above, (H, W, 3) uint8 RGB."""
    import shapely

    from cosim.report.above import Sheet, draw_streets

    sheet = Sheet(part)
    draw_streets(sheet, street_map, shapely.box(*part))
    return sheet.image
