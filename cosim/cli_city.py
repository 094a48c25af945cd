"""The command line of generated cities: `cosim city make`, `table`, `draw`."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich import box
from rich.console import Console
from rich.table import Column, Table

from cosim.box import box_of

if TYPE_CHECKING:
    from cosim.report.above import Image
    from cosim.streetmap import StreetMap
    from sumo_nets.census import Census

city_app = typer.Typer(no_args_is_help=True, rich_markup_mode="markdown", help="Generated cities, from a seed.")
out = Console()
err = Console(stderr=True)

Seed = Annotated[int, typer.Option(min=0, help="Every seed is another city.")]
Size = Annotated[float, typer.Option(help="Side of its square in metres, 200 to 4000.")]
Style = Annotated[str, typer.Option(help="mixed, downtown or suburb.")]

FIGURES: tuple[tuple[str, Callable[[Census], float], str], ...] = (
    ("straight", lambda c: c.blocks["straight"], "d"),
    ("curve", lambda c: c.blocks["curve"], "d"),
    ("S", lambda c: c.blocks["s_bend"], "d"),
    ("T", lambda c: c.blocks["t_junction"], "d"),
    ("X", lambda c: c.blocks["x_junction"], "d"),
    ("Y", lambda c: c.blocks["y_junction"], "d"),
    ("round", lambda c: c.blocks["roundabout"], "d"),
    ("walk km", lambda c: c.sidewalk_km, ".1f"),
    ("walk %", lambda c: 100.0 * c.walkable_share, ".1f"),
    ("cross", lambda c: c.crossings, "d"),
    ("lit", lambda c: c.signalised, "d"),
    ("mid", lambda c: c.crosswalks, "d"),
    ("refuge", lambda c: c.refuges, "d"),
    ("drive", lambda c: c.driveways, "d"),
    ("clear m", lambda c: c.clear_m, ".2f"),
    ("far km", lambda c: c.longest_m / 1000.0, ".2f"),
    ("one %", lambda c: 100.0 * c.one_piece, ".1f"),
)
"""Columns of the table: head, value, format."""

MEANING = (
    "straight, curve, S: streets; T, X, Y, round: junctions; walk km, walk %: sidewalks, share of the city's area; "
    "cross, lit, mid, refuge: crossings, with signals, in mid-street, with an island; drive: driveways; "
    "clear m: free width everywhere; far km: longest shortest walk; one %: of the walkable area in one piece"
)


@city_app.command(epilog="Example:  \n`cosim city make --seed 7 --size 500 cities/seven`")
def make(
    folder: Annotated[Path, typer.Argument(metavar="OUT", help="A folder, made for it.")],
    seed: Seed,
    size: Size = 2000.0,
    style: Style = "mixed",
) -> None:
    """Make a city: a folder with its street net, and what it was made from. Equal to the byte when made again."""
    from cosim.scenario import City
    from sumo_nets.store import write_city

    made = write_city(City(seed=seed, size_m=size, style=style), folder)
    out.print(f"{folder}: {made.name}, net {made.net_hash}", soft_wrap=True, highlight=False)


@city_app.command(epilog="Example:  \n`cosim city table --count 10`")
def table(
    count: Annotated[int, typer.Option(min=1, max=100, help="How many of the shipped cities.")] = 100,
    size: Size = 2000.0,
    style: Style = "mixed",
) -> None:
    """Count what the shipped cities are made of, and check them. Exit code 1: one breaks a promise."""
    from sumo_nets.census import census
    from sumo_nets.seeds import shipped_cities
    from sumo_nets.store import city_net

    cities = shipped_cities(count, size, style)
    found: list[Census] = []
    with err.status("counting ...") as status:
        for city in cities:
            status.update(f"counting {city.name} ({len(found) + 1} of {count})")
            found.append(census(city_net(city)))
    print_cities([city.seed for city in cities], found)
    if any(one.faults for one in found):
        raise typer.Exit(1)


@city_app.command(
    epilog="Examples:  \n`cosim city draw 7 -o city.png`  \n`cosim city draw 7 --zoom 900,900,1100,1100 -o block.png`"
)
def draw(
    seed: Annotated[int, typer.Argument(min=0, help="The city's seed.")],
    picture: Annotated[Path, typer.Option("-o", "--output", help="Where to write the picture, a PNG.")],
    size: Size = 2000.0,
    style: Style = "mixed",
    zoom: Annotated[str | None, typer.Option(help="Part of it: x0,y0,x1,y1 in metres.")] = None,
) -> None:
    """Draw a city from above."""
    from cosim.report.mapsheet import write_png
    from cosim.scenario import City
    from sumo_nets.atlas import street_map_of
    from sumo_nets.store import city_net

    part = (0.0, 0.0, size, size) if zoom is None else box_of("--zoom", zoom, "x0,y0,x1,y1")
    write_png(_picture(street_map_of(city_net(City(seed=seed, size_m=size, style=style))), part), picture)
    out.print(f"Picture: {picture}", soft_wrap=True)


def print_cities(seeds: Sequence[int], found: Sequence[Census]) -> None:
    """A row per city, the spans of all, widths of the zones, and whatever is wrong."""
    heads = [Column(head, justify="right", no_wrap=True) for head, _, _ in FIGURES]
    shown = Table(Column("seed", no_wrap=True), *heads, box=box.SIMPLE_HEAD, padding=(0, 0, 0, 1))
    for seed, one in zip(seeds, found, strict=True):
        shown.add_row(str(seed), *(format(value(one), form) for _, value, form in FIGURES))
    shown.add_section()
    for name, pick in (("min", min), ("median", statistics.median), ("max", max)):
        cells = [
            format(round(x) if form == "d" else x, form)
            for _, value, form in FIGURES
            for x in [pick([value(one) for one in found])]
        ]
        shown.add_row(name, *cells)
    wide = Console(width=max(out.width, 130))
    wide.print(shown)
    zones = Table("zone", "narrowest m", "median m", "widest m", box=box.SIMPLE_HEAD)
    for zone in found[0].zones:
        spans = [one.zones[zone] for one in found]
        middle = statistics.median(span.middle for span in spans)
        zones.add_row(zone, f"{min(s.low for s in spans):.2f}", f"{middle:.2f}", f"{max(s.high for s in spans):.2f}")
    out.print(zones)
    out.print(MEANING)
    faulty = [(seed, fault) for seed, one in zip(seeds, found, strict=True) for fault in one.faults]
    for seed, fault in faulty:
        out.print(f"city {seed}: {fault}", soft_wrap=True, markup=False, highlight=False)
    signals = sum(one.signals for one in found)
    out.print(f"{len(found)} cities, {signals} traffic lights checked, {len(faulty)} faults", highlight=False)


def _picture(street_map: StreetMap, part: tuple[float, float, float, float]) -> Image:
    """A part of a map from above, (H, W, 3) uint8 RGB."""
    import shapely

    from cosim.report.above import LEGEND_PX, Sheet, draw_streets

    sheet = Sheet(part)
    draw_streets(sheet, street_map, shapely.box(*part))
    return sheet.image[:-LEGEND_PX]
