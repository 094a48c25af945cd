"""Import foreign maps as walkable SUMO nets: convert OSM, add walkways to car-only nets, repair
signals.

netconvert's exit code is not reliable, so every net is checked and started in SUMO.
"""

from __future__ import annotations

import math
import re
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import shapely

from cosim.core.errors import MapError, UsageError
from cosim.core.progress import Progress, ignore
from cosim.place.map_check import NetFacts
from cosim.place.overlay import where_geos_failed
from cosim.place.street_map import Feature
from sumo_nets.maps.corner_repair import repair_corners
from sumo_nets.maps.driving_side import left_hand_country
from sumo_nets.maps.feature_fit import fit_features
from sumo_nets.maps.import_rules import REPAIRS
from sumo_nets.maps.levels import LEVEL_KEYS, edges_of
from sumo_nets.maps.net_steps import (
    ImportWork,
    add_walkways,
    crop_net,
    start_sumo,
    widen_sidewalks,
)
from sumo_nets.maps.osm_crop import Box
from sumo_nets.maps.osm_features import osm_features
from sumo_nets.maps.osm_file import MapFile, OsmFacts, osm_facts, unpack_map
from sumo_nets.maps.sidewalks import (
    STREET_WIDTHS_M,
    WIDTH_LIMITS_M,
    new_share,
    pavements,
    untagged_share,
)
from sumo_nets.net.net_facts import facts_of, net_root, read_facts
from sumo_nets.net.net_file import read_net
from sumo_nets.net.netconvert import sumo_home

TYPES = (
    "osmNetconvert.typ.xml",
    "osmNetconvertUrbanDe.typ.xml",
    "osmNetconvertPedestrians.typ.xml",
)
OSM_OPTIONS = (
    "--osm.sidewalks",
    "--sidewalks.guess",
    "--crossings.guess",
    "--walkingareas",
    "--geometry.remove",
    "--roundabouts.guess",
    "--ramps.guess",
    "--junctions.join",
    "--tls.guess-signals",
    "--tls.discard-simple",
    "--tls.join",
    "--remove-edges.isolated",
    "--remove-edges.by-vclass=rail,rail_urban,rail_electric,rail_fast,subway,ship,aircraft",
    "--output.street-names",
    "--output.original-names",
    "--osm.all-attributes",
    f"--osm.extra-attributes={','.join(LEVEL_KEYS)}",
)
"""Options of netconvert for OpenStreetMap files."""
SLOW_IMPORT_EDGES = 10_000
"""Number of streets and paths above which an import takes minutes."""
OSM_LICENCE = (
    "Map data (c) OpenStreetMap contributors, Open Database License (ODbL) 1.0: credit them "
    "on what is shown, "
    "and offer the net, a derived database, under the ODbL. https://www.openstreetmap.org/copyright"
)


@dataclass(frozen=True, slots=True)
class Options:
    """Options of an import.

    bbox: west, south, east, north in degrees, or x0, y0, x1, y1 of a net without a projection.
    lefthand: None to look it up.
    as_is: leave a SUMO net unchanged, even one without sidewalks.
    sidewalk_width_m: of all guessed sidewalks; None for widths by street class.
    """

    bbox: Box | None = None
    lefthand: bool | None = None
    as_is: bool = False
    sidewalk_width_m: float | None = None

    def __post_init__(self) -> None:
        if self.bbox is not None:
            west, south, east, north = self.bbox
            if not all(map(math.isfinite, self.bbox)) or west >= east or south >= north:
                raise UsageError(
                    f"bbox must be west,south,east,north with west < east, south < north: "
                    f"{self.bbox}"
                )
        if self.sidewalk_width_m is not None:
            low_m, high_m = WIDTH_LIMITS_M
            if not low_m <= self.sidewalk_width_m <= high_m:
                raise UsageError(
                    f"--sidewalk-width must be {low_m:g} to {high_m:g} metres, not "
                    f"{self.sidewalk_width_m:g}"
                )
            if self.as_is:
                raise UsageError(
                    "--sidewalk-width changes a net and --as-is leaves it unchanged: give "
                    "one of them"
                )

    @property
    def widths_m(self) -> Mapping[str, float]:
        """Widths of guessed sidewalks by street class."""
        one_m = self.sidewalk_width_m
        return STREET_WIDTHS_M if one_m is None else dict.fromkeys(STREET_WIDTHS_M, one_m)


@dataclass(frozen=True, slots=True)
class Converted:
    """A finished net and the features of its map.

    changes: changes by the importer, a sentence each.
    guessed_share: share of the pavements' length that the map does not contain; None if unknown.
    """

    net: Path
    facts: NetFacts
    features: tuple[Feature, ...]
    format: str
    packing: str
    changes: tuple[str, ...]
    guessed_share: float | None
    licences: tuple[str, ...]


def convert(source: Path, folder: Path, options: Options, progress: Progress = ignore) -> Converted:
    """Convert `source` to a net in the scratch `folder`. Raises MapError with a finding and a
    remedy."""
    progress(f"reading {source.name}")
    file = unpack_map(source, folder, options.bbox)
    work = ImportWork(
        file, folder, progress, [f"unpacked ({file.packing})"] if file.packing else []
    )
    with _naming_source(file):
        return _from_osm(work, options) if file.format == "osm" else _from_net(work, options)


def _from_osm(work: ImportWork, options: Options) -> Converted:
    file, changes = work.file, work.changes
    if options.as_is:
        raise UsageError(
            f"{file.source}: --as-is is for SUMO nets; an OpenStreetMap file is always "
            f"converted: leave --as-is out"
        )
    found = osm_facts(file)
    extra = ["--lefthand"] if _left_hand(found, options, changes) else []
    # If netconvert joined a bridge to a street, the whole street would be off the ground.
    apart = work.folder / "apart.txt"
    apart.write_text("\n".join(edges_of(found.levelled)))
    extra.append(f"--geometry.remove.keep-edges.input-file={apart}")
    types = ",".join(str(sumo_home() / "data" / "typemap" / name) for name in TYPES)
    arguments = ["--osm-files", str(file.path), "--type-files", types, *OSM_OPTIONS, *extra]
    stage = _converting(found.roads + found.footways, options)
    net = work.netconvert(stage, "full.net.xml", arguments)
    net = crop_net(work, net, options.bbox)
    changes.append(
        f"converted {found.roads} roads and {found.footways} paths; crossings are guessed "
        "wherever pavements meet a road; railways and isolated streets left out, junctions and "
        "signals close together joined"
    )
    net = widen_sidewalks(work, net, options.widths_m, found.widths)
    share = untagged_share(net_root(net), found.tagged)
    if share:
        changes.append(
            f"guessed {share:.0%} of the pavement's length: the file does not speak of it"
        )
    licences = [OSM_LICENCE, found.licence] if found.licence else [OSM_LICENCE]
    return _finish(work, net, share, licences)


def _converting(streets: int, options: Options) -> str:
    """Return the name of the conversion stage, with advice if it takes minutes."""
    advice = (
        " (--bbox west,south,east,north: a part is faster)"
        if streets > SLOW_IMPORT_EDGES and options.bbox is None
        else ""
    )
    return f"converting {streets} streets and paths{advice}"


def _from_net(work: ImportWork, options: Options) -> Converted:
    file, changes = work.file, work.changes
    facts = (
        read_facts(file.path)
        if options.lefthand is None
        else _check_driving_side(read_facts(file.path), options, file)
    )
    if not facts.edges:
        raise MapError(f"{file.source}: a net of 0 edges: export an area with streets in it")
    if facts.edges > SLOW_IMPORT_EDGES:
        work.progress(_converting(facts.edges, options))
    before = frozenset(pavements(net_root(file.path)))
    net = crop_net(work, file.path, options.bbox)
    if options.as_is:
        return _unchanged(work, net, facts)
    share: float | None = None
    if options.sidewalk_width_m is not None and not _lacks_walkways(facts):
        changes.append(
            "--sidewalk-width has no effect: the net has sidewalks of its own, none is guessed"
        )
    if _lacks_walkways(facts):
        net = add_walkways(work, net, facts)
        net = widen_sidewalks(work, net, options.widths_m, {}, before)
        share = new_share(net_root(net), before)
    elif facts.version == "?" or facts.version.startswith("0."):
        net = work.netconvert("renewing the net", "renewed.net.xml", ["-s", str(net)])
        changes.append(f"renewed by netconvert: format {facts.version} is too old to be simulated")
    return _finish(work, net, share, [])


def _lacks_walkways(facts: NetFacts) -> bool:
    return not facts.areas or facts.pavement_km + facts.shared_km == 0.0


def _unchanged(work: ImportWork, net: Path, facts: NetFacts) -> Converted:
    """Return the net as it is, with a note on its limits. Raises MapError if SUMO does not start
    on it."""
    file = work.file
    changes = work.changes
    final = net.with_name("final.net.xml")
    shutil.copyfile(net, final)
    start_sumo(file, final)
    if _lacks_walkways(facts):
        km = facts.pavement_km + facts.shared_km
        changes.append(
            f"left as it is (--as-is), with {km:.1f} km of sidewalks and {facts.areas} walking "
            "areas: no crowd, no route and no scenario is possible on it; import it without "
            "--as-is to add sidewalks and crossings"
        )
    else:
        changes.append("left as it is (--as-is): signals and corners are not mended")
    return Converted(final, facts, (), file.format, file.packing, tuple(changes), None, ())


def _finish(work: ImportWork, net: Path, share: float | None, licences: list[str]) -> Converted:
    """Repair the net, then check that it has walkways and that SUMO starts on it."""
    file = work.file
    changes = work.changes
    progress = work.progress
    progress("reading the net")
    root = net_root(net)
    for mend in REPAIRS:
        changes += mend(root)
    final = work.written(root, "final.net.xml")
    facts = facts_of(root)
    street_map = read_net(final)
    if mended := repair_corners(root, street_map, progress):
        changes += mended
        work.written(root, "final.net.xml")
        progress("reading the net")
        street_map = read_net(final)
    if not any(strip.kind == "sidewalk" for strip in street_map.strips.values()):
        raise MapError(
            f"{file.source}: nothing walkable in it: {facts.edges} edges, none with a sidewalk or "
            "path; import an area with streets in it"
        )
    if not street_map.corners:
        raise MapError(
            f"{file.source}: its sidewalks are not connected: it has no walking areas; "
            f"import a larger area"
        )
    if facts.twisted_areas:
        changes.append(
            f"{facts.twisted_areas} of {facts.areas} walking areas cross themselves: "
            f"repaired when read"
        )
    progress("starting SUMO on the net")
    start_sumo(file, final)
    features: tuple[Feature, ...] = ()
    if file.format == "osm":
        progress("placing buildings and things")
        location = root.find("location")
        features, fit_changes = fit_features(
            osm_features(file), {} if location is None else location.attrib, street_map
        )
        changes += fit_changes
    return Converted(
        final, facts, features, file.format, file.packing, tuple(changes), share, tuple(licences)
    )


def _left_hand(found: OsmFacts, options: Options, changes: list[str]) -> bool:
    lon, lat = found.centre
    country = left_hand_country(lon, lat)
    if options.lefthand is not None:
        changes.append(f"traffic on the {'left' if options.lefthand else 'right'}, as requested")
        return options.lefthand
    if country is None:
        changes.append(
            f"traffic on the right: {lat:.2f} N {lon:.2f} E is in no left-hand country of the table"
        )
        return False
    changes.append(
        f"traffic on the left: {lat:.2f} N {lon:.2f} E is in {country} (if wrong: --righthand)"
    )
    return True


def _check_driving_side(facts: NetFacts, options: Options, file: MapFile) -> NetFacts:
    if options.lefthand != facts.left_hand:
        side = "left" if facts.left_hand else "right"
        raise MapError(
            f"{file.source}: a SUMO net says itself on which side people drive: on the {side} in "
            "this one; leave --lefthand and --righthand out"
        )
    return facts


@contextmanager
def _naming_source(file: MapFile) -> Iterator[None]:
    """Raise errors with the user's file in place of scratch files."""
    try:
        yield
    except MapError as error:
        raise MapError(_with_source(file, str(error))) from error
    except KeyError as error:
        raise MapError(
            f"{file.source}: not a street net that can be read: attribute {error} is missing"
        ) from error
    except shapely.errors.GEOSException as error:
        raise MapError(
            f"{file.source}: its ground{where_geos_failed(error)} cannot be put together: {error}"
        ) from error
    except (ValueError, IndexError) as error:
        raise MapError(f"{file.source}: not a street net that can be read: {error}") from error


def _with_source(file: MapFile, message: str) -> str:
    message = re.sub(rf"^{re.escape(str(file.path.parent))}/\S+?: ", "", message)
    message = (
        message.rstrip(".")
        .replace(str(file.path), str(file.source))
        .replace(f"{file.path.parent}/", "")
    )
    remedy = "import a part of it with --bbox"
    message = message.replace("cut the area of interest out first", remedy)
    if "without any edge" in message or "No nodes loaded" in message:
        message += (
            "; no street of the file survived the conversion: import a larger area, with whole "
            "streets in it"
        )
    return message if message.startswith(f"{file.source}: ") else f"{file.source}: {message}"
