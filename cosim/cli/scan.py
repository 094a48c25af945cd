"""The command `cosim scan`: import of scanned places."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec
import typer

from cosim.cli import tables
from cosim.cli.console import out, say
from cosim.cli.generated_options import Fields, configured
from cosim.cli.options import check_output, replacement_note
from cosim.cli.progress import doing
from cosim.core.errors import WRONG_USE, UsageError
from cosim.spec.run_config import Option

if TYPE_CHECKING:
    from physics.scans.findings import Finding
    from scenarios.places.scan_options import ScanOptions

scan_app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode="markdown",
    help="Scanned places: a mesh, and Gaussian splats for pictures.",
)

_FRAME = "Frame of the files"
_SPLATS = "Splats, if they differ from the mesh"
_AREA = "Walkable area (by default a draft from the ground)"
_FACTS = "Facts"


@dataclass(frozen=True, kw_only=True)
class ScanChoices:
    """Options of an import, as `scan.json` has them. None and "" are left to it."""

    name: Annotated[str, Option("Name of the map.", default="the folder's", panel=_FACTS)] = ""
    preset: Annotated[
        str,
        Option(
            "Place of the suite `scans` whose options and areas replace scan.json.",
            metavar="PLACE",
            panel=_FACTS,
        ),
    ] = ""
    scale: Annotated[
        float | None, Option("Metres per unit.", default="1 in .glb files", panel=_FRAME)
    ] = None
    up: Annotated[
        Literal["+x", "-x", "+y", "-y", "+z", "-z"] | None,
        Option("Axis that points up.", default="+y in .glb and .spz files", panel=_FRAME),
    ] = None
    transform: Annotated[
        str,
        Option(
            "File with a 4 x 4 matrix to metres with z up, in place of scale and up.",
            metavar="FILE",
            panel=_FRAME,
        ),
    ] = ""
    mirror: Annotated[
        Literal["x", "y", "z"] | None,
        Option("Axis to negate, for left-handed files.", panel=_FRAME),
    ] = None
    flip: Annotated[
        bool, Option("Reverse the winding of triangles.", flag="--flip", panel=_FRAME)
    ] = False
    colours: Annotated[
        Literal["srgb", "linear"] | None,
        Option("Encoding of vertex colours.", default="by format and program", panel=_FRAME),
    ] = None
    georeference: Annotated[
        str,
        Option(
            "Origin of the files: LATITUDE,LONGITUDE[,HEADING of +y, 0 is north], or "
            "CRS[,EAST,NORTH] such as EPSG:25833.",
            metavar="PLACE",
            panel=_FRAME,
        ),
    ] = ""
    splat_scale: Annotated[float | None, Option("As --scale, of the splats.", panel=_SPLATS)] = None
    splat_up: Annotated[
        Literal["+x", "-x", "+y", "-y", "+z", "-z"] | None,
        Option("As --up, of the splats.", panel=_SPLATS),
    ] = None
    splat_transform: Annotated[
        str, Option("As --transform, of the splats.", metavar="FILE", panel=_SPLATS)
    ] = ""
    splat_mirror: Annotated[
        Literal["x", "y", "z"] | None, Option("As --mirror, of the splats.", panel=_SPLATS)
    ] = None
    quaternions: Annotated[
        Literal["wxyz", "xyzw"] | None,
        Option("Order of rotations in a .ply file.", default="wxyz", panel=_SPLATS),
    ] = None
    most_splats: Annotated[
        int | None,
        Option("Reduce to this number, least visible first.", least=1, panel=_SPLATS),
    ] = None
    areas: Annotated[
        str,
        Option("GeoJSON with drawn areas, by their kind.", metavar="FILE", panel=_AREA),
    ] = ""
    osm: Annotated[
        str, Option("OpenStreetMap file; needs --georeference.", metavar="FILE", panel=_AREA)
    ] = ""
    way: Annotated[
        str, Option("Walked path: GeoJSON line, or JSON.", metavar="FILE", panel=_AREA)
    ] = ""
    width: Annotated[
        float | None, Option("Metres, of the corridor along --way.", default="3", panel=_AREA)
    ] = None
    sun: Annotated[
        str,
        Option(
            "Sun of the scan: AZIMUTH,ELEVATION in degrees.",
            metavar="ANGLES",
            panel=_FACTS,
        ),
    ] = ""
    exposure: Annotated[
        float | None,
        Option("Stops by which people and objects are brighter.", default="0", panel=_FACTS),
    ] = None
    licence: Annotated[
        str, Option("Licence of the scan.", default="the folder's files", panel=_FACTS)
    ] = ""

    def options(self, folder: Path) -> ScanOptions:
        """Return the options of a folder's `scan.json`, replaced by these.

        Raises UsageError and SpecError for invalid values.
        """
        from scenarios.places.scan_options import parse_georeference, parse_sun, read_options
        from scenarios.places.scan_places import preset_folder

        given: dict[str, Any] = dataclasses.asdict(self)
        preset = given.pop("preset")
        given["width_m"] = given.pop("width")
        given["exposure_ev"] = given.pop("exposure")
        given["flip"] = self.flip or None
        given["georeference"] = parse_georeference(self.georeference) if self.georeference else None
        given["sun"] = parse_sun(self.sun) if self.sun else None
        return read_options(folder, given, preset_folder(preset) if preset else None)


_Folder = Annotated[
    Path, typer.Argument(metavar="FOLDER", help="Folder with the mesh, the splats and scan.json.")
]
_Map = Annotated[str, typer.Argument(metavar="NAME", help="Name of an imported scan.")]


@scan_app.command(
    "import",
    epilog="Examples:  \n`cosim scan import my-street`  \n`cosim scan import my-street --up +z "
    "--scale 1 --areas areas.geojson`  \n`cosim scan import my-street --way walk.geojson --width 3 "
    "--georeference 55.698,13.195`  \n`cosim scan import lund-street --preset lund-street`",
)
@configured
def import_(folder: _Folder, choices: Annotated[ScanChoices, Fields(panels=True)]) -> None:
    """Import a scan: read, check and clean it, build its net, and store it as a map."""
    from scenarios.places.scan_import import import_scan

    options = choices.options(folder)
    with doing(f"reading {folder}") as progress:
        about, checked = import_scan(folder, options, progress)
    print_findings(about.name, checked.findings)
    out.print(
        f"Stored as '{about.name}': see it with `cosim scan show {about.name} -o scan.png`, run on "
        f"it with --map {about.name}.",
        soft_wrap=True,
    )


@scan_app.command(
    "check",
    epilog="Examples:  \n`cosim scan check my-street`  \n`cosim scan check my-street --up +z "
    "--json`",
)
@configured
def check(
    folder: _Folder,
    choices: Annotated[ScanChoices, Fields(panels=True)],
    as_json: Annotated[bool, typer.Option("--json", help="Print the findings as JSON.")] = False,
) -> None:
    """Check a scan as an import does, and store nothing. Exit code 2: it would be refused."""
    from scenarios.places.scan_import import check_scan

    options = choices.options(folder)
    with doing(f"reading {folder}") as progress:
        findings = check_scan(folder, options, progress).findings
    if as_json:
        rows = [{"level": one.level, "words": one.words} for one in findings]
        typer.echo(msgspec.json.format(msgspec.json.encode(rows), indent=2).decode())
    else:
        print_findings(folder.resolve().name, findings)
    if any(one.level == "refused" for one in findings):
        raise typer.Exit(WRONG_USE)


@scan_app.command(
    "show",
    epilog="Example:  \n`cosim scan show my-street -o scan.png`",
)
def show(
    name: _Map,
    picture: Annotated[
        Path, typer.Option("-o", "--output", help="Where to write the picture, a PNG.")
    ] = Path("scan.png"),
) -> None:
    """Draw a scan from above: areas, blocked ground, holes, removed floaters, coverage."""
    from cosim.report.mapsheet import write_png
    from cosim.report.scan_sheet import draw_scan
    from scenarios.places.scan_views import coverage_of

    check_output(picture, "a picture", (".png",))
    folder = _map_folder(name)
    instead = replacement_note(picture)
    with doing(f"reading {name}") as progress:
        from cosim.place.scan import read_scan

        scan = read_scan(folder)
        progress("measuring the coverage of views")
        eyes, shares = coverage_of(scan)
        progress("drawing")
        write_png(draw_scan(scan, eyes, shares), picture)
    for words in scan.facts.findings:
        say(words)
    out.print(f"Picture: {picture}{instead}", soft_wrap=True)


@scan_app.command(
    "areas",
    epilog="Examples:  \n`cosim scan areas my-street -o areas.geojson`  \n`cosim scan areas "
    "my-street --set areas.geojson`  \n`cosim scan areas my-street --way walk.geojson --width 2.5`",
)
def areas(
    name: _Map,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Write the areas, a .geojson.")
    ] = None,
    draft: Annotated[
        Path | None, typer.Option(help="Write a draft from the ground, a .geojson to edit.")
    ] = None,
    set_: Annotated[
        Path | None, typer.Option("--set", help="GeoJSON with the areas that replace its own.")
    ] = None,
    osm: Annotated[
        Path | None, typer.Option(help="OpenStreetMap file whose streets replace its areas.")
    ] = None,
    way: Annotated[
        Path | None, typer.Option(help="Walked path along which a corridor replaces its areas.")
    ] = None,
    width: Annotated[
        float, typer.Option(min=1.0, max=20.0, help="Width of the corridor in metres.")
    ] = 3.0,
) -> None:
    """Write the areas of a scan as GeoJSON in metres, or replace them and build its net again."""
    from cosim.place.scan import encode_areas, read_scan

    folder = _map_folder(name)
    sources = {"areas": set_, "osm": osm, "way": way}
    chosen = {key: str(path) for key, path in sources.items() if path is not None}
    written = [path for path in (output, draft) if path is not None]
    if len(chosen) + len(written) != 1:
        raise UsageError("give one of -o, --draft, --set, --osm and --way")
    if chosen:
        _replace_areas(name, chosen, width)
        return
    (target,) = written
    check_output(target, "areas", (".geojson", ".json"))
    scan = read_scan(folder, splats=False)
    found = scan.areas
    if draft is not None:
        from scenarios.places.chosen_areas import drafted_areas

        found = drafted_areas(scan.mesh, scan.heights)
    instead = replacement_note(target)
    target.write_bytes(msgspec.json.format(encode_areas(found, step_m=0.01), indent=1))
    out.print(f"Areas: {target} ({len(found)} areas){instead}", soft_wrap=True, highlight=False)


def _replace_areas(name: str, chosen: dict[str, str], width_m: float) -> None:
    from scenarios.places.chosen_areas import replace_areas
    from scenarios.places.scan_options import ScanOptions

    with doing(f"reading {name}") as progress:
        options = ScanOptions(**chosen, width_m=width_m)  # type: ignore[arg-type]
        _, findings = replace_areas(name, options, progress)
    print_findings(name, findings)
    out.print(
        f"Replaced the areas of '{name}': scenarios made on the old ones are refused.",
        soft_wrap=True,
    )


@scan_app.command(
    "make",
    epilog="Examples:  \n`cosim scan make --city 7 -o demo && cosim scan import demo`  \n`cosim "
    "scan make --city 7 --size 500 --box 100,100,180,160 --spacing 0.06 -o demo`",
)
def make(
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder to write to.")],
    city: Annotated[int, typer.Option(min=0, help="Seed of the generated city.")] = 7,
    size: Annotated[float, typer.Option(help="Side of the city in metres.")] = 500.0,
    style: Annotated[str, typer.Option(help="Style of the city.")] = "mixed",
    box: Annotated[
        str,
        typer.Option(
            metavar="X0,Y0,X1,Y1",
            help="Part of the city, in metres. Default: 80 x 60 m around a crossing.",
            show_default=False,
        ),
    ] = "",
    hour: Annotated[float, typer.Option(min=0, max=24, help="Solar time of the light.")] = 13.0,
    spacing: Annotated[float, typer.Option(help="Metres between splats on the ground.")] = 0.1,
) -> None:
    """Make a scan of a generated street: a mesh and splats, for demonstrations and tests.

    The folder must be new or empty. It has scan.json, so that it can be imported without options.
    """
    from cosim.spec.scenario import City, Light
    from scenarios.places.scan_make import make_scan

    if output.exists() and (not output.is_dir() or any(output.iterdir())):
        raise UsageError(f"{output} exists already: give a new folder with --output")
    corners = _box(box) if box else None
    with doing("building the city") as progress:
        count = make_scan(
            City(seed=city, size_m=size, style=style),
            corners,
            output,
            light=Light(hour=hour),
            spacing_m=spacing,
            progress=progress,
        )
    out.print(
        f"Scan: {output} ({count} splats): import it with `cosim scan import {output}`.",
        soft_wrap=True,
        highlight=False,
    )


def _box(words: str) -> tuple[float, float, float, float]:
    """Parse the corners of a box. Raises UsageError."""
    try:
        x0, y0, x1, y1 = map(float, words.split(","))
    except ValueError:
        raise UsageError(f"--box {words}: give X0,Y0,X1,Y1 in metres") from None
    return x0, y0, x1, y1


def print_findings(name: str, findings: Sequence[Finding]) -> None:
    """Print findings as a table: notes, then warnings, then refusals."""
    order = ("note", "warning", "refused")
    rows = [
        (one.level, one.words)
        for one in sorted(findings, key=lambda finding: order.index(finding.level))
    ]
    tables.show(out, [*tables.labels(name), *tables.words("finding")], rows)


def _map_folder(name: str) -> Path:
    """Return the folder of an imported scan. Raises UsageError for a name that is none."""
    from cosim.place.scan import has_scan
    from sumo_nets.maps.map_store import map_net, maps_folder

    folder = maps_folder() / name
    if not has_scan(folder):
        map_net(name)  # raises for an unknown map
        raise UsageError(
            f"'{name}' is a map without a scan: scans are imported with `cosim scan import`"
        )
    return folder
