"""Foreign maps as SUMO nets that can be walked: OSM converted, car-only nets given walkways, signals mended.

netconvert's exit code proves nothing, so every net is counted and started in SUMO before it counts as imported.
"""

from __future__ import annotations

import math
import re
import shutil
import subprocess
import xml.etree.ElementTree as ET
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import shapely

from cosim.core.errors import MachineError, MapError, UsageError
from cosim.place.map_check import NetFacts
from cosim.place.overlay import where_geos_failed
from cosim.place.street_map import Feature
from sumo_nets.maps.cornermend import mend_corners
from sumo_nets.maps.drivingside import left_hand_country
from sumo_nets.maps.featurefit import fitted
from sumo_nets.maps.importrules import NEWEST_RULES, Rules
from sumo_nets.maps.levels import LEVEL_KEYS, edges_of
from sumo_nets.maps.osmfeatures import osm_features
from sumo_nets.maps.osmfile import MapFile, OsmFacts, osm_facts, unpacked
from sumo_nets.maps.sidewalks import (
    STREET_WIDTHS_M,
    WIDTH_LIMITS_M,
    new_share,
    pavements,
    set_widths,
    untagged_share,
)
from sumo_nets.net.netconvert import complaints, netconvert
from sumo_nets.net.netfacts import allows, facts_of, net_root, read_facts
from sumo_nets.net.netfile import read_net

TIMEOUT_S = 300.0
START_TIMEOUT_S = 60.0
_Box = tuple[float, float, float, float]

TYPES = ("osmNetconvert.typ.xml", "osmNetconvertUrbanDe.typ.xml", "osmNetconvertPedestrians.typ.xml")
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
UPGRADE_OPTIONS = ("--sidewalks.guess", "--crossings.guess", "--walkingareas")
FOOT_TYPES = ("highway.footway", "highway.pedestrian", "highway.steps", "highway.path")
FOOT_MPS = 1.4
"""An edge of one lane that is as slow as this is a footway, whatever the net lets drive on it."""
OSM_LICENCE = (
    "Map data (c) OpenStreetMap contributors, Open Database License (ODbL) 1.0: credit them on what is shown, "
    "and offer the net, a derived database, under the ODbL. https://www.openstreetmap.org/copyright"
)


@dataclass(frozen=True, slots=True)
class Options:
    """Options of an import.

    bbox: west, south, east, north in degrees, or x0, y0, x1, y1 of a net without a projection.
    lefthand: None to look it up.
    as_is: leave a SUMO net unchanged, even one without sidewalks.
    sidewalk_width_m: of all guessed sidewalks; None for the widths of the rules, by street class.
    rules: the version of the importer.
    """

    bbox: _Box | None = None
    lefthand: bool | None = None
    as_is: bool = False
    sidewalk_width_m: float | None = None
    rules: Rules = NEWEST_RULES

    def __post_init__(self) -> None:
        if self.bbox is not None:
            west, south, east, north = self.bbox
            if not all(map(math.isfinite, self.bbox)) or west >= east or south >= north:
                raise UsageError(f"bbox must be west,south,east,north with west < east, south < north: {self.bbox}")
        if self.sidewalk_width_m is not None:
            low_m, high_m = WIDTH_LIMITS_M
            if not low_m <= self.sidewalk_width_m <= high_m:
                raise UsageError(
                    f"--sidewalk-width must be {low_m:g} to {high_m:g} metres, not {self.sidewalk_width_m:g}"
                )
            if self.as_is:
                raise UsageError("--sidewalk-width changes a net and --as-is leaves it unchanged: give one of them")

    @property
    def widths_m(self) -> Mapping[str, float]:
        """Widths of guessed sidewalks by street class; empty to leave them as netconvert chose them."""
        one_m = self.sidewalk_width_m
        return self.rules.widths_m if one_m is None else dict.fromkeys(STREET_WIDTHS_M, one_m)


@dataclass(frozen=True, slots=True)
class Converted:
    """A net ready to be kept, and what the map shows beside its streets.

    changes: what the importer did to it, a sentence each. guessed_share: of the length of the pavements, the part no
    mapper has seen; None when it cannot be known.
    """

    net: Path
    facts: NetFacts
    features: tuple[Feature, ...]
    format: str
    packing: str
    changes: tuple[str, ...]
    guessed_share: float | None
    licences: tuple[str, ...]


def convert(source: Path, folder: Path, options: Options) -> Converted:
    """`source` as a net in the scratch `folder`. Raises MapError naming what was found and what to do."""
    file = unpacked(source, folder)
    changes = [f"unpacked ({file.packing})"] if file.packing else []
    with _told_of(file):
        if file.format == "osm":
            return _from_osm(file, folder, options, changes)
        return _from_net(file, folder, options, changes)


def _from_osm(file: MapFile, folder: Path, options: Options, changes: list[str]) -> Converted:
    found = osm_facts(file)
    if options.as_is:
        raise UsageError(
            f"{file.source}: --as-is is for SUMO nets; an OpenStreetMap file is always converted: leave --as-is out"
        )
    extra = ["--lefthand"] if _left_hand(found, options, changes) else []
    # Joined to a street on the ground, a bridge would take all of the street off the ground.
    apart = folder / "apart.txt"
    apart.write_text("\n".join(edges_of(found.levelled)))
    extra.append(f"--geometry.remove.keep-edges.input-file={apart}")
    types = ",".join(str(_sumo_home() / "data" / "typemap" / name) for name in TYPES)
    net = _netconvert(
        folder, "full.net.xml", ["--osm-files", str(file.path), "--type-files", types, *OSM_OPTIONS, *extra]
    )
    net = _crop(file, folder, net, options.bbox, changes)
    changes.append(
        f"converted {found.roads} roads and {found.ways_on_foot} paths; crossings are guessed wherever pavements "
        "meet a road; railways and isolated streets left out, junctions and signals close together joined"
    )
    net = _widened(folder, net, options, found.widths, frozenset(), changes)
    share = untagged_share(net_root(net), found.tagged)
    if share:
        changes.append(f"guessed {share:.0%} of the pavement's length: the file does not speak of it")
    licences = [OSM_LICENCE, found.licence] if found.licence else [OSM_LICENCE]
    return _finish(file, net, options.rules, changes, share, licences)


def _from_net(file: MapFile, folder: Path, options: Options, changes: list[str]) -> Converted:
    facts = read_facts(file.path) if options.lefthand is None else _sided(read_facts(file.path), options, file)
    if not facts.edges:
        raise MapError(f"{file.source}: a net of 0 edges: export an area with streets in it")
    net = file.path
    before = frozenset(pavements(net_root(net)))
    net = _crop(file, folder, net, options.bbox, changes)
    if options.as_is:
        return _unchanged(file, net, facts, changes)
    share: float | None = None
    if _lacks_walkways(facts):
        net = _upgraded(folder, net, facts, changes)
        net = _widened(folder, net, options, {}, before, changes)
        share = new_share(net_root(net), before)
    elif _old(facts.version):
        net = _netconvert(folder, "renewed.net.xml", ["-s", str(net)])
        changes.append(f"renewed by netconvert: format {facts.version} is too old to be simulated")
    return _finish(file, net, options.rules, changes, share, [])


def _lacks_walkways(facts: NetFacts) -> bool:
    return not facts.areas or facts.pavement_km + facts.shared_km == 0.0


def _unchanged(file: MapFile, net: Path, facts: NetFacts, changes: list[str]) -> Converted:
    """The net as it is, with what is not possible on it. Raises MapError when SUMO does not start on it."""
    final = net.with_name("final.net.xml")
    shutil.copyfile(net, final)
    _start_sumo(file, final)
    if _lacks_walkways(facts):
        km = facts.pavement_km + facts.shared_km
        changes.append(
            f"left as it is (--as-is), with {km:.1f} km of sidewalks and {facts.areas} walking areas: no crowd, no "
            "route and no scenario is possible on it; import it without --as-is to add sidewalks and crossings"
        )
    else:
        changes.append("left as it is (--as-is): signals and corners are not mended")
    return Converted(final, facts, (), file.format, file.packing, tuple(changes), None, ())


def _finish(
    file: MapFile, net: Path, rules: Rules, changes: list[str], share: float | None, licences: list[str]
) -> Converted:
    """Mend what can be mended, then prove that the net holds walkways and that SUMO starts on it."""
    final, root = net.with_name("final.net.xml"), net_root(net)
    for mend in rules.mends:
        changes += mend(root)
    ET.ElementTree(root).write(final, encoding="UTF-8", xml_declaration=True)
    facts = facts_of(root)
    street_map = read_net(final)
    if mended := mend_corners(root, street_map):
        changes += mended
        ET.ElementTree(root).write(final, encoding="UTF-8", xml_declaration=True)
        street_map = read_net(final)
    if not any(strip.kind == "sidewalk" for strip in street_map.strips.values()):
        raise MapError(
            f"{file.source}: nothing walkable in it: {facts.edges} edges, none with a sidewalk or path; import an area "
            "with streets in it"
        )
    if not street_map.corners:
        raise MapError(f"{file.source}: its sidewalks are not connected: it has no walking areas; import a larger area")
    if facts.twisted_areas:
        changes.append(f"{facts.twisted_areas} of {facts.areas} walking areas cross themselves: repaired when read")
    _start_sumo(file, final)
    features: tuple[Feature, ...] = ()
    if file.format == "osm":
        location = root.find("location")
        features, told = fitted(osm_features(file), {} if location is None else location.attrib, street_map)
        changes += told
    return Converted(final, facts, features, file.format, file.packing, tuple(changes), share, tuple(licences))


def _left_hand(found: OsmFacts, options: Options, changes: list[str]) -> bool:
    lon, lat = found.centre
    country = left_hand_country(lon, lat)
    if options.lefthand is not None:
        changes.append(f"traffic on the {'left' if options.lefthand else 'right'}, as asked")
        return options.lefthand
    if country is None:
        changes.append(f"traffic on the right: {lat:.2f} N {lon:.2f} E is in no left-hand country of the table")
        return False
    changes.append(f"traffic on the left: {lat:.2f} N {lon:.2f} E is in {country} (if wrong: --righthand)")
    return True


def _sided(facts: NetFacts, options: Options, file: MapFile) -> NetFacts:
    if options.lefthand != facts.left_hand:
        side = "left" if facts.left_hand else "right"
        raise MapError(
            f"{file.source}: a SUMO net says itself on which side people drive: on the {side} in this one; leave "
            "--lefthand and --righthand out"
        )
    return facts


def _crop(file: MapFile, folder: Path, net: Path, bbox: _Box | None, changes: list[str]) -> Path:
    """The net inside a box, in two calls: both wishes in one keep netconvert busy for ever on some nets."""
    if bbox is None:
        return net
    projected = read_facts(net).projected
    option = "--keep-edges.in-geo-boundary" if projected else "--keep-edges.in-boundary"
    box = ",".join(f"{v:.7f}" for v in bbox)
    try:
        inside = _netconvert(folder, "inside.net.xml", ["-s", str(net), f"{option}={box}"])
        net = _netconvert(folder, "cropped.net.xml", ["-s", str(inside), "--keep-edges.components=1"])
    except MapError as error:
        x0, y0, x1, y1 = read_net(net).bounds
        units = "longitude and latitude" if projected else "metres: this net has no projection"
        raise MapError(
            f"{file.source}: cropping to {box} failed (bbox is in {units}; the whole map is {x1 - x0:.0f} x "
            f"{y1 - y0:.0f} m): {error}"
        ) from error
    changes.append(f"cropped to {box}; whole streets are kept, and only the largest connected part")
    return net


def _widened(
    folder: Path,
    net: Path,
    options: Options,
    tagged: Mapping[str, Mapping[str, str]],
    before: Collection[str],
    changes: list[str],
) -> Path:
    """The net with the widths of guessed sidewalks set, see `set_widths`."""
    root = net_root(net)
    said = set_widths(root, options.widths_m, tagged, before)
    if not said:
        return net
    changes += said
    ready = folder / "widths.net.xml"
    ET.ElementTree(root).write(ready, encoding="UTF-8", xml_declaration=True)
    return _netconvert(folder, "widened.net.xml", ["-s", str(ready)])


def _upgraded(folder: Path, net: Path, facts: NetFacts, changes: list[str]) -> Path:
    """The net with sidewalks beside slow roads, crossings and walking areas."""
    root = net_root(net)
    freed = 0
    for edge in root.iter("edge"):
        lanes = edge.findall("lane")
        if len(lanes) == 1 and not edge.get("function") and allows(lanes[0], "pedestrian") and _is_footway(edge):
            freed += allows(lanes[0], "passenger")
            lanes[0].attrib.pop("disallow", None)
            lanes[0].set("allow", "pedestrian")
    ready = folder / "ready.net.xml"
    ET.ElementTree(root).write(ready, encoding="UTF-8", xml_declaration=True)
    # --tls.guess would invent signals, some of which SUMO then refuses.
    upgraded = _netconvert(folder, "upgraded.net.xml", ["-s", str(ready), *UPGRADE_OPTIONS])
    if freed:
        changes.append(f"{freed} footways on which cars were allowed are for people only")
    changes.append(
        f"sidewalks beside every road up to 50 km/h, crossings and walking areas added (format was {facts.version}): "
        "lanes are renumbered, junctions grew; bus stops and detectors made for the old net do not fit any more"
    )
    return upgraded


def _is_footway(edge: ET.Element) -> bool:
    slow = float(edge[0].get("speed", "13.9")) <= FOOT_MPS
    return slow or edge.get("type", "") in FOOT_TYPES


def _old(version: str) -> bool:
    return version.startswith("0.") or version == "?"


def _netconvert(folder: Path, name: str, arguments: Sequence[str]) -> Path:
    return netconvert(arguments, folder / name, TIMEOUT_S)


def _start_sumo(file: MapFile, net: Path) -> None:
    """Start SUMO on the net for a second: some nets that netconvert is content with are refused by it."""
    command = [str(_sumo_home() / "bin" / "sumo"), "-n", str(net), "-e", "1", "--no-step-log", "--no-warnings"]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, errors="replace", timeout=START_TIMEOUT_S, check=False
        )
    except subprocess.TimeoutExpired as error:
        raise MapError(f"{file.source}: SUMO did not start on the net within {START_TIMEOUT_S:g} s") from error
    except OSError as error:
        raise MachineError(f"sumo cannot be run: {error.strerror}: is eclipse-sumo installed?") from error
    if done.returncode != 0:
        ended = f"(sumo -n NET -e 1 ends with {done.returncode})"
        raise MapError(f"{file.source}: SUMO refuses the net {ended}{complaints(done.stderr)}")


def _sumo_home() -> Path:
    import sumo

    return Path(sumo.__file__).parent


@contextmanager
def _told_of(file: MapFile) -> Iterator[None]:
    """Errors told with the user's file in place of our scratch files, so that their commands can be repeated."""
    try:
        yield
    except MapError as error:
        raise MapError(_retold(file, str(error))) from error
    except KeyError as error:
        raise MapError(f"{file.source}: not a street net that can be read: attribute {error} is missing") from error
    except shapely.errors.GEOSException as error:
        raise MapError(
            f"{file.source}: its ground{where_geos_failed(error)} cannot be put together: {error}"
        ) from error
    except (ValueError, IndexError) as error:
        raise MapError(f"{file.source}: not a street net that can be read: {error}") from error


def _retold(file: MapFile, words: str) -> str:
    words = re.sub(rf"^{re.escape(str(file.path.parent))}/\S+?: ", "", words)
    words = words.rstrip(".").replace(str(file.path), str(file.source)).replace(f"{file.path.parent}/", "")
    if "without any edge" in words or "No nodes loaded" in words:
        words += "; no street of the file survived the conversion: import a larger area, with whole streets in it"
    return words if words.startswith(f"{file.source}: ") else f"{file.source}: {words}"
