"""Identify and unpack map files of users, and read facts of OpenStreetMap files.

netconvert reads neither bz2 nor PBF, and its errors are unclear. Here every file becomes plain XML
or raises a MapError.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Protocol
from xml.parsers import expat

import numpy as np

from cosim.core.errors import MapError
from sumo_nets.maps.levels import is_levelled
from sumo_nets.maps.osm_crop import Box, crop_osm
from sumo_nets.net.raw_file import (
    BLANK,
    LARGEST_BYTES,
    describe_root,
    parse,
    read_head,
    root_of,
    unpack_file,
)

READABLE = (
    "SUMO nets (.net.xml, .net.xml.gz) and OpenStreetMap (.osm, .osm.gz, .osm.bz2, .osm.pbf) can "
    "be read"
)
ON_FOOT = frozenset(
    ("footway", "path", "pedestrian", "steps", "living_street", "track", "cycleway", "bridleway")
)
FAST = frozenset(("motorway", "motorway_link", "trunk", "trunk_link"))
NO_STREET = frozenset(
    ("construction", "proposed", "raceway", "bus_guideway", "platform", "rest_area", "services")
)

MAX_LANES = 40
"""Largest plausible number of lanes."""
_WIDEST_M = 200
"""Largest plausible width of a street, metres."""
_NUMBER = re.compile(r"\d+(?:\.\d*)?(?:[eE]\+?\d+)?")

Format = Literal["net", "osm"]


@dataclass(frozen=True, slots=True)
class MapFile:
    """A map as plain XML in a scratch folder.

    source: the original file.
    packing: "", "gzip", "bzip2" or "PBF".
    """

    source: Path
    path: Path
    format: Format
    packing: str


@dataclass(frozen=True, slots=True)
class OsmFacts:
    """Facts of an OSM file.

    roads, footways: counts of highway ways.
    centre: median longitude and latitude of its nodes, degrees.
    tagged: ids of roads with tags on their sidewalks.
    widths: tags of roads with widths of their sidewalks, by road id.
    levelled: number of nodes of streets and paths that may be off the ground, by id.
    """

    nodes: int
    ways: int
    roads: int
    footways: int
    centre: tuple[float, float]
    tagged: frozenset[str]
    widths: Mapping[str, Mapping[str, str]]
    levelled: Mapping[str, int]
    licence: str


def unpack_map(source: Path, folder: Path, box: Box | None = None) -> MapFile:
    """Unpack `source` as plain XML into `folder`. Raises MapError if it is not a map.

    box: part of an OpenStreetMap file to crop, see `crop_osm`.
    """
    head = read_head(source)
    if not head:
        raise MapError(f"{source}: the file is empty; {READABLE}")
    packing = _packing(source, head)
    plain = folder / "unpacked.xml"
    if packing != "PBF":
        unpack_file(source, packing, plain)
    elif box is None:
        _pbf(source, plain)
    kind = "osm" if packing == "PBF" and box is not None else _kind(source, plain)
    path = folder / ("input.net.xml" if kind == "net" else "input.osm")
    if box is None or kind == "net":
        plain.rename(path)
    elif packing == "PBF":
        crop_osm(source, path, box, source)
    else:
        whole = plain.rename(folder / "whole.osm")
        crop_osm(whole, path, box, source)
        whole.unlink()
    return MapFile(source, path, kind, packing)


def _packing(source: Path, head: bytes) -> str:
    if head[:2] == b"\x1f\x8b":
        return "gzip"
    if head[:3] == b"BZh":
        return "bzip2"
    if b"OSMHeader" in head:
        return "PBF"
    if head.lstrip(BLANK)[:1] == b"<":
        return ""
    known = {
        b"PK": "a zip archive",
        b"\xfd7zXZ": "an xz file",
        b"7z\xbc\xaf": "a 7z archive",
        b"(\xb5/\xfd": "zstd",
    }
    # The message must not repeat content: a scenario's place.file may name any private file.
    plain = "text" if head.isascii() and b"\0" not in head else "data of no known kind"
    found = next((what for magic, what in known.items() if head.startswith(magic)), plain)
    raise MapError(
        f"{source}: neither XML nor a known compression: found {found}; unpack it first; {READABLE}"
    )


def _pbf(source: Path, target: Path) -> None:
    import osmium

    osm = target.with_suffix(".osm")
    try:
        with osmium.SimpleWriter(str(osm), overwrite=True) as writer:
            for thing in osmium.FileProcessor(str(source)):
                writer.add(thing)
    except (OSError, RuntimeError, ValueError) as error:
        raise MapError(f"{source}: cannot be unpacked (PBF): {error}: get it again") from error
    if osm.stat().st_size > LARGEST_BYTES:
        raise MapError(
            f"{source}: more than {LARGEST_BYTES >> 30} GiB unpacked: import a part of it "
            f"with --bbox"
        )
    osm.rename(target)


def _kind(source: Path, plain: Path) -> Format:
    try:
        tag = root_of(plain)
    except ValueError as error:
        raise MapError(f"{source}: broken XML: {error}") from error
    if tag in ("net", "osm"):
        return "net" if tag == "net" else "osm"
    raise MapError(f"{source}: not a map: {describe_root(tag)}, not <net> or <osm>; {READABLE}")


@dataclass(slots=True)
class _Scan:
    """Running counts of one pass over an OSM file."""

    lonlat: list[tuple[float, float]] = field(default_factory=list)
    ways: int = 0
    roads: int = 0
    fast: int = 0
    on_foot: int = 0
    tagged: set[str] = field(default_factory=set)
    widths: dict[str, dict[str, str]] = field(default_factory=dict)
    levelled: dict[str, int] = field(default_factory=dict)
    head: dict[str, str] = field(default_factory=dict)
    way: str | None = None
    refs: int = 0
    tags: dict[str, str] = field(default_factory=dict)

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        if tag == "node":
            self.lonlat.append(_lonlat(attributes))
        elif tag == "way":
            self.way = attributes["id"]
            self.refs = 0
            self.tags = {}
        elif tag == "nd":
            self.refs += 1
        elif tag == "tag" and self.way is not None:
            self.tags[attributes.get("k", "")] = attributes.get("v", "")
        elif tag == "osm":
            self.head = attributes

    def end(self, tag: str) -> None:
        if tag != "way" or self.way is None:
            return
        self.ways += 1
        highway = self.tags.get("highway", "")
        if highway:
            _check_numbers(self.way, self.tags)
            if is_levelled(self.tags):
                self.levelled[self.way] = self.refs
        if highway in ON_FOOT:
            self.on_foot += 1
        elif highway and highway not in NO_STREET:
            self.roads += 1
            tagged = any(key.split(":")[0] == "sidewalk" for key in self.tags)
            self.fast += highway in FAST and not tagged
            if tagged:
                self.tagged.add(self.way)
                if widths := {
                    k: v
                    for k, v in self.tags.items()
                    if k.startswith("sidewalk:") and k.endswith("width")
                }:
                    self.widths[self.way] = widths
        self.way = None


def _lonlat(node: dict[str, str]) -> tuple[float, float]:
    try:
        lon, lat = float(node["lon"]), float(node["lat"])
    except ValueError:
        lon = lat = math.nan
    if not (math.isfinite(lon) and math.isfinite(lat)):
        raise ValueError(
            f"node {node.get('id')} lies nowhere: lon={node['lon'][:40]} lat={node['lat'][:40]}"
        )
    return lon, lat


def _check_numbers(way: str, tags: dict[str, str]) -> None:
    """Raise ValueError for implausible lanes and widths, on which netconvert would not
    terminate."""
    for key, value in tags.items():
        parts = key.split(":")
        if parts[0] == "lanes":
            most = MAX_LANES
        elif "width" in (parts[0], parts[-1]):
            most = _WIDEST_M
        else:
            continue
        if any(float(number) > most for number in _NUMBER.findall(value)):
            raise ValueError(
                f"way {way}: {key}={value[:40]}, but no street has more than {most}: mend the tag"
            )


class Elements(Protocol):
    """Receiver of the elements of an OSM file."""

    def start(self, tag: str, attributes: dict[str, str]) -> None: ...
    def end(self, tag: str) -> None: ...


def scan_elements(file: MapFile, elements: Elements) -> None:
    """Pass the elements of an OSM file to `elements`. Raises MapError if the file is damaged."""
    parser = expat.ParserCreate()
    parser.StartElementHandler = elements.start
    parser.EndElementHandler = elements.end
    try:
        parse(parser, file.path)
    except ValueError as error:
        raise MapError(f"{file.source}: broken OpenStreetMap file: {error}") from error


def osm_facts(file: MapFile) -> OsmFacts:
    """Read the facts of an OSM file in one pass.

    Raises MapError if the file is damaged, has no walkable street, or is not in WGS 84 degrees.
    """
    scan = _Scan()
    scan_elements(file, scan)
    if not scan.lonlat or not scan.roads + scan.on_foot:
        raise MapError(
            f"{file.source}: an OpenStreetMap file of {len(scan.lonlat)} nodes and {scan.ways} "
            "ways, none of them a street or path (highway=*): export a larger area"
        )
    if not scan.on_foot and scan.fast == scan.roads:
        raise MapError(
            f"{file.source}: nothing walkable: {scan.roads} motorways and trunk roads, no other "
            "street or path: export a town"
        )
    lonlat = np.array(scan.lonlat)
    lon, lat = (float(v) for v in np.median(lonlat, axis=0))
    if not (abs(lon) <= 180.0 and abs(lat) <= 90.0):
        raise MapError(
            f"{file.source}: its nodes lie at longitude {lon:g}, latitude {lat:g}: not "
            f"degrees; reproject it to WGS 84"
        )
    licence = " ".join(
        scan.head[key] for key in ("copyright", "attribution", "license") if key in scan.head
    )
    return OsmFacts(
        nodes=len(scan.lonlat),
        ways=scan.ways,
        roads=scan.roads,
        footways=scan.on_foot,
        centre=(lon, lat),
        tagged=frozenset(scan.tagged),
        widths=scan.widths,
        levelled=scan.levelled,
        licence=licence,
    )
