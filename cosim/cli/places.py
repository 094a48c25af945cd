"""The commands `cosim city` and `cosim map`."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import msgspec
import typer
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from cosim.cli import tables
from cosim.cli.console import err, out, say
from cosim.cli.options import replacement_note
from cosim.cli.progress import doing
from cosim.core.bounding_box import check_overlap, parse_box
from cosim.core.errors import SOME_CRASHED, WRONG_USE, MapError, UsageError

if TYPE_CHECKING:
    from cosim.place.map_check import MapCheck
    from cosim.place.street_map import StreetMap
    from cosim.report.legend import Image
    from scenarios.suites.capacity import Capacity, FitCount
    from scenarios.tools.bench.places import Survey
    from sumo_nets.maps.map_store import About


city_app = typer.Typer(
    no_args_is_help=True, rich_markup_mode="markdown", help="Generated cities, from a seed."
)

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
"""Columns of the table of cities: head, value, format."""

TABLE_LEGEND = (
    "straight, curve, S: streets; T, X, Y, round: junctions; walk km, walk %: sidewalks, share of "
    "the city's area; cross, lit, mid, refuge: crossings, with signals, in mid-street, with an "
    "island; drive: driveways; props: street furniture; side m: least width next to it on any "
    "sidewalk; clear m: width that passes everywhere, furniture included (2 at most); far km: "
    "longest shortest walk; one %: of the walkable area in one piece"
)


@city_app.command(epilog="Example:  \n`cosim city make --seed 7 --size 500 cities/seven`")
def make(
    folder: Annotated[Path, typer.Argument(metavar="OUT", help="A folder, made for it.")],
    seed: Seed,
    size: _Size = 2000.0,
    style: _Style = "mixed",
) -> None:
    """Generate a city in a folder: street net, seed and versions, the same bytes each time."""
    from cosim.spec.scenario import City
    from sumo_nets.city.store import write_city

    city = City(seed=seed, size_m=size, style=style)
    with doing(f"building {city.name}"):
        made = write_city(city, folder)
    out.print(f"{folder}: {made.name}, net {made.net_hash}", soft_wrap=True, highlight=False)


@city_app.command(epilog="Example:  \n`cosim city table --count 10 --jobs 2`")
def table(
    count: Annotated[int, typer.Option(min=1, max=100, help="Number of shipped cities.")] = 100,
    size: _Size = 2000.0,
    style: _Style = "mixed",
    jobs: Annotated[int, typer.Option(min=1, help="Processes, about 0.3 GiB each.")] = 1,
) -> None:
    """Print and check the parts of the shipped cities. Exit code 1: a city has a fault."""
    from scenarios.tools.bench.places import surveys
    from sumo_nets.city.store import shipped_cities

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
    epilog="Examples:  \n`cosim city draw 7 -o city.png`  \n`cosim city draw 7 --zoom "
    "900,900,1100,1100 -o block.png`",
)
def draw_city(
    seed: Annotated[int, typer.Argument(min=0, help="The city's seed.")],
    picture: Annotated[
        Path, typer.Option("-o", "--output", help="Where to write the picture, a PNG.")
    ],
    size: _Size = 2000.0,
    style: _Style = "mixed",
    zoom: Annotated[str | None, typer.Option(help="Part of it: x0,y0,x1,y1 in metres.")] = None,
) -> None:
    """Draw a city from above."""
    from cosim.report.mapsheet import write_png
    from cosim.spec.scenario import City
    from sumo_nets.city.store import city_net
    from sumo_nets.net.snapshot import street_map_of

    part = (0.0, 0.0, size, size) if zoom is None else parse_box("--zoom", zoom, "x0,y0,x1,y1")
    city = City(seed=seed, size_m=size, style=style)
    instead = replacement_note(picture)
    with doing(f"building {city.name}") as progress:
        street_map = street_map_of(city_net(city))
        check_overlap("--zoom", part, street_map.bounds)
        progress("drawing")
        write_png(_picture(street_map, part), picture)
    out.print(f"Picture: {picture}{instead}", soft_wrap=True)


def print_cities(found: Sequence[Survey]) -> None:
    """Print a row per city, ranges over all cities, widths of zones, and faults."""
    rows: list[tables.Row] = [
        (str(one.seed), *(format(value(one), form) for _, value, form in _FIGURES)) for one in found
    ]
    rows.append(None)
    for name, pick in (("min", min), ("median", statistics.median), ("max", max)):
        cells = [
            format(round(x) if form == "d" else x, form)
            for _, value, form in _FIGURES
            for x in [pick([value(one) for one in found])]
        ]
        rows.append((name, *cells))
    tables.show(
        out, [*tables.names("seed"), *tables.figures(*(head for head, _, _ in _FIGURES))], rows
    )
    zones = []
    for zone in found[0].census.zones:
        spans = [one.census.zones[zone] for one in found]
        middle = statistics.median(span.middle for span in spans)
        low, high = min(span.low for span in spans), max(span.high for span in spans)
        zones.append((zone, f"{low:.2f}", f"{middle:.2f}", f"{high:.2f}"))
    tables.show(
        out, [*tables.names("zone"), *tables.figures("narrowest m", "median m", "widest m")], zones
    )
    out.print(TABLE_LEGEND)
    faulty = [(one.seed, fault) for one in found for fault in one.faults]
    for seed, fault in faulty:
        say(f"city {seed}: {fault}")
    signals = sum(one.census.signals for one in found)
    out.print(
        f"{len(found)} cities, {signals} traffic lights checked, {len(faulty)} faults",
        highlight=False,
    )
    narrowest = min(one.side_m for one in found)
    tightest = min(one.census.clear_m for one in found)
    out.print(
        f"least width next to furniture on any sidewalk {narrowest:.2f} m, passing everywhere "
        f"{tightest:.2f} m; "
        f"memory of a process {max(one.memory_mib for one in found):.0f} MiB at most",
        soft_wrap=True,
        highlight=False,
    )


def _bar() -> Progress:
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    return Progress(*columns, TimeRemainingColumn(), console=err)


def _picture(street_map: StreetMap, part: tuple[float, float, float, float]) -> Image:
    """Return a part of a map from above, (H, W, 3) uint8 RGB."""
    import shapely

    from cosim.report.above import Sheet, draw_streets

    sheet = Sheet(part)
    draw_streets(sheet, street_map, shapely.box(*part))
    return sheet.image


_OUTDATED = (
    "an older version of the importer made this map: import its file again for wider sidewalks "
    "and longer greens"
)

map_app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode="markdown",
    help="Cities of the real world: SUMO and OSM.",
)


@map_app.command(
    "import",
    epilog="Examples:  \n`cosim map import berlin.osm.pbf --bbox 13.43,52.46,13.45,52.48`  "
    "\n`cosim map import hamburg.net.xml.gz --sidewalk-width 3`",
)
def import_(
    file: Annotated[
        Path, typer.Argument(help=".net.xml, .net.xml.gz, .osm, .osm.gz, .osm.bz2 or .osm.pbf")
    ],
    name: Annotated[
        str | None, typer.Option(help="Its name from now on; by default the file's.")
    ] = None,
    bbox: Annotated[
        str | None,
        typer.Option(
            help="Only this part: west,south,east,north in degrees (metres without projection)."
        ),
    ] = None,
    lefthand: Annotated[
        bool | None,
        typer.Option("--lefthand/--righthand", help="Side people drive on; by default looked up."),
    ] = None,
    as_is: Annotated[
        bool,
        typer.Option(
            "--as-is",
            help="Leave a SUMO net unchanged: add no sidewalks and crossings, repair nothing.",
        ),
    ] = False,
    sidewalk_width: Annotated[
        float | None,
        typer.Option(
            help="Metres, of every guessed sidewalk, 1 to 10; by default 2.5 to 3.5 by the "
            "street's class."
        ),
    ] = None,
) -> None:
    """Import a map: convert, repair and check it, and store it under a name."""
    from sumo_nets.maps.importer import Options
    from sumo_nets.maps.map_store import checked_map, import_map

    box = None if bbox is None else parse_box("--bbox", bbox)
    options = Options(bbox=box, lefthand=lefthand, as_is=as_is, sidewalk_width_m=sidewalk_width)
    with doing(f"reading {file.name}") as progress:
        about = import_map(file, name, options, progress)
        progress(f"checking {about.name}")
        street_map, check, about = checked_map(about.name)
        capacity = _capacity(street_map, check)
    print_check(check, about, capacity)
    out.print(
        f"Kept as '{about.name}': see it with `cosim map check {about.name} -o map.png`.",
        soft_wrap=True,
    )
    if _refusals(check, capacity):
        raise typer.Exit(WRONG_USE)


@map_app.command(
    "check",
    epilog="Examples:  \n`cosim map check hamburg -o hamburg.png`  \n`cosim map check hamburg "
    "--zoom 900,700,1200,1000 -o junction.png`  \n`cosim map check sumo-fkk-in --json`",
)
def report_map_check(
    place: Annotated[
        str,
        typer.Argument(metavar="MAP", help="A map, a folder of a city or map, a .net.xml(.gz)."),
    ],
    picture: Annotated[
        Path | None, typer.Option("-o", "--output", help="Write a picture of it, a PNG.")
    ] = None,
    zoom: Annotated[
        str | None, typer.Option(help="Part of it for the picture: x0,y0,x1,y1 in metres.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the check as JSON.")] = False,
) -> None:
    """Print a map's description, defects and uses. Exit code 2: it is not usable."""
    part = None if zoom is None else parse_box("--zoom", zoom)
    if part is not None and picture is None:
        raise UsageError("--zoom is for the picture: say where to write it with -o")
    instead = replacement_note(picture)
    with doing(f"checking {place}") as progress:
        street_map, found, about = _look_up(place)
        capacity = _capacity(street_map, found)
        if picture is not None:
            from cosim.report.mapsheet import draw_map, write_png
            from cosim.spec.scenario import CityMap
            from sumo_nets.maps.map_store import credit_of

            if part is not None:
                check_overlap("--zoom", part, street_map.bounds)
            progress("drawing")
            credit = "" if about is None else credit_of(CityMap(map=about.name))
            write_png(draw_map(street_map, found, part, credit), picture)
    if as_json:
        report = {
            "usable": not _refusals(found, capacity),
            "check": found,
            "capacity": capacity,
            "about": about,
        }
        typer.echo(msgspec.json.format(msgspec.json.encode(report), indent=2).decode())
    else:
        print_check(found, about, capacity)
        if picture is not None:
            out.print(f"Picture: {picture}{instead}", soft_wrap=True)
    if _refusals(found, capacity):
        raise typer.Exit(WRONG_USE)


@map_app.command(
    "endure",
    epilog="Examples:  \n`cosim map endure sumo-drt`  \n`cosim map endure sumo-drt sumo-fkk-in "
    "--minutes 30 --seed 1`",
)
def endure_map(
    maps: Annotated[
        list[str], typer.Argument(metavar="MAP...", help="Maps, folders of cities or maps, nets.")
    ],
    minutes: Annotated[float, typer.Option(min=0.1, help="Simulated minutes on each.")] = 10.0,
    seed: Annotated[int, typer.Option(min=0, help="Of crowd, traffic and wanderings.")] = 0,
) -> None:
    """Simulate crowd and traffic around a robot that drives anywhere. Exit code 1: SUMO died."""
    from cosim.core.clock import Clock
    from scenarios.tools.bench.places import endure as endured_on
    from sumo_nets.maps.place_names import resolve_place

    places = [resolve_place(name) for name in maps]
    rows = []
    failed = False
    for name, where in zip(maps, places, strict=True):
        with doing(f"{minutes:g} min on {name}") as progress:
            done = endured_on(where, seed, minutes, progress)
        failed |= bool(done.reason)
        simulated_min = Clock().time_s(done.ticks) / 60.0
        cells = (
            f"{simulated_min:.1f}",
            f"{done.persons:.0f}",
            f"{done.vehicles:.0f}",
            f"{done.wall_s:.0f}",
        )
        rows.append((name, *cells, done.reason or "its time"))
    columns = [
        *tables.names("map"),
        *tables.figures("simulated min", "persons", "vehicles", "wall s"),
    ]
    columns += tables.words("ended by")
    tables.show(out, columns, rows)
    if failed:
        raise typer.Exit(SOME_CRASHED)


@map_app.command("delete", epilog="Example:  \n`cosim map delete my-street`")
def delete(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of an imported map or scan.")],
) -> None:
    """Delete an imported map or scan. Runs and scenarios on it need it to be imported again."""
    from sumo_nets.maps.map_store import delete_map

    folder = delete_map(name)
    out.print(f"Deleted: {folder}", soft_wrap=True, highlight=False)


@map_app.command("list", epilog="Example:  \n`cosim map list`")
def list_() -> None:
    """List the maps: imported ones, and those that come with SUMO (imported when first used)."""
    from sumo_nets.maps.map_store import known_maps

    rows = [(known.name, known.origin, known.source) for known in known_maps().values()]
    tables.show(out, [*tables.names("map"), *tables.words("origin", "file")], rows)


def print_check(check: MapCheck, about: About | None, capacity: Capacity | None) -> None:
    """Print the check of a map, and the number of places for each kind of scenario."""
    from sumo_nets.maps.map_store import outdated

    width_m, height_m = check.size_m
    side = "left" if check.left_hand else "right"
    rows = [*_rows(check), ("size", f"{width_m:.0f} x {height_m:.0f} m, traffic on the {side}")]
    tables.show(out, [*tables.names(check.name), *tables.words("")], rows)
    if capacity is not None:
        columns = [
            *tables.names("scenarios"),
            *tables.words("places where they fit, of those on the largest island"),
        ]
        tables.show(out, columns, [(name, str(count)) for name, count in _by_name(capacity)])
    remarks = [("warning", warning) for warning in check.warnings] + [
        ("note", note) for note in check.notes
    ]
    if about is not None:
        remarks += [("note", _OUTDATED)] if outdated(about) else []
        head = "scan" if about.format == "scan" else "changed"
        remarks += [(head, change) for change in about.changes]
        remarks += [
            ("licence", licence)
            for licence in about.licences or ("none found: ask where the file comes from",)
        ]
    remarks += [("NOT USABLE", reason) for reason in _refusals(check, capacity)]
    for head, words in remarks:
        say(f"{head}: {words}")


def _rows(check: MapCheck) -> list[tuple[str, str]]:
    islands = ", ".join(f"{island.share:.1%}" for island in check.islands[:5])
    guessed = (
        "unknown" if check.guessed_share is None else f"{check.guessed_share:.0%} of their length"
    )
    shown = ", ".join(f"{count} x {kind}" for kind, count in check.features.items())
    return [
        (
            "walkable",
            f"{check.walkable_km:.2f} km on {check.sidewalks} sidewalks, {check.corners} corners",
        ),
        (
            "crossings",
            f"{check.crossings}, {check.crossing_km:.2f} km; {check.signalised} with signals",
        ),
        ("roads", f"{check.roads_km:.1f} km of lanes"),
        ("islands", f"{len(check.islands)}: {islands}{' ...' if len(check.islands) > 5 else ''}"),
        (
            "narrower than 1 m",
            f"{check.narrow} sidewalks, {check.narrow_km:.2f} km; narrowest "
            f"{check.narrowest_m:.2f} m",
        ),
        ("shorter than 1 m", f"{check.stubs} pieces; {check.dead_ends} dead ends"),
        (
            "on the road",
            f"{check.overlap_share:.1%} of the sidewalks' area; {check.on_road} lie mostly "
            f"on it; routes avoid them",
        ),
        (
            "driven over",
            f"{check.driven_over} corners, where cars turn, crossings apart; routes avoid them",
        ),
        ("over or under a road", f"{check.stacked} sidewalks, with no crossing there"),
        ("guessed sidewalks", guessed),
        ("shown by the map", shown or "no buildings, no things: all are made up"),
    ]


def _look_up(called: str) -> tuple[StreetMap, MapCheck, About | None]:
    """Return map, check and source of a place by its name, folder or net file."""
    from cosim.place.map_check import check_map
    from cosim.spec.scenario import CityMap
    from sumo_nets.city.store import city_net
    from sumo_nets.maps.map_store import checked_map
    from sumo_nets.maps.place_names import resolve_place
    from sumo_nets.net.net_facts import read_facts
    from sumo_nets.net.snapshot import street_map_of

    path = Path(called)
    if not path.is_file():
        where = resolve_place(called)
        if isinstance(where, CityMap):
            return checked_map(where.map)
        path = city_net(where)
    elif not path.name.endswith((".net.xml", ".net.xml.gz", "net.xml")):
        raise MapError(
            f"{path}: only SUMO nets can be checked as they are: import it first with `cosim "
            f"map import`"
        )
    street_map = street_map_of(path)
    return street_map, check_map(street_map, None, read_facts(path)), None


def _capacity(street_map: StreetMap, check: MapCheck) -> Capacity | None:
    """Return the scenarios that fit on a map; None for an unusable map."""
    from cosim.place.walk_graph import walk_graph_of
    from scenarios.suites.capacity import capacity_of

    return capacity_of(street_map, walk_graph_of(street_map)) if check.usable else None


def _by_name(capacity: Capacity) -> list[tuple[str, FitCount]]:
    return [
        *((f"event {name}", count) for name, count in capacity.events.items()),
        *((f"unit {name}", count) for name, count in capacity.structures.items()),
        ("long route", capacity.routes),
    ]


def _refusals(check: MapCheck, capacity: Capacity | None) -> list[str]:
    """Return the reasons why a map cannot be used; none for a usable map."""
    if capacity is None or capacity.usable:
        return list(check.reasons)
    return [
        "no event, no unit scenario and no long route fits: import a larger area, or one "
        "with longer sidewalks"
    ]
