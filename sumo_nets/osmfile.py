"""Map files as a user has them, packed or not: what they are, unpacked, and what an OSM file says about itself.

netconvert reads neither bz2 nor PBF, and says so in riddles; here every file ends as plain XML or as a MapError.
"""

from __future__ import annotations

import bz2
import gzip
import lzma
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Literal, Protocol
from xml.parsers import expat

import numpy as np

from cosim.errors import MapError

LARGEST_BYTES = 2 * 1024**3
"""A file that unpacks to more than this is refused: cut the area out first."""

PIECE_BYTES = 1 << 20
READABLE = "SUMO nets (.net.xml, .net.xml.gz) and OpenStreetMap (.osm, .osm.gz, .osm.bz2, .osm.pbf) can be read"
ON_FOOT = frozenset(("footway", "path", "pedestrian", "steps", "living_street", "track", "cycleway", "bridleway"))
FAST = frozenset(("motorway", "motorway_link", "trunk", "trunk_link"))
NO_STREET = frozenset(("construction", "proposed", "raceway", "bus_guideway", "platform", "rest_area", "services"))

Format = Literal["net", "osm"]


@dataclass(frozen=True, slots=True)
class MapFile:
    """A map as plain XML in a scratch folder. source: the file it came from. packing: "", "gzip", "bzip2", "PBF"."""

    source: Path
    path: Path
    format: Format
    packing: str


@dataclass(frozen=True, slots=True)
class OsmFacts:
    """What an OSM file holds. centre: median longitude and latitude of its nodes, degrees.

    roads, ways_on_foot: counts of highway ways. tagged: ids of roads whose tags speak of their sidewalks.
    """

    nodes: int
    ways: int
    roads: int
    ways_on_foot: int
    centre: tuple[float, float]
    tagged: frozenset[str]
    licence: str


def unpacked(source: Path, folder: Path) -> MapFile:
    """`source` as plain XML inside `folder`. Raises MapError naming what was found when it is no map."""
    try:
        with source.open("rb") as file:
            head = file.read(64)
    except OSError as error:
        raise MapError(f"{source}: cannot be read: {error.strerror}") from error
    if not head:
        raise MapError(f"{source}: the file is empty; {READABLE}")
    packing, plain = _packing(source, head), folder / "unpacked.xml"
    try:
        UNPACKERS[packing](source, plain)
    except (EOFError, zlib.error, lzma.LZMAError) as error:
        raise MapError(f"{source}: broken {packing} file, probably cut short: {error}: get it again") from error
    except (OSError, RuntimeError, ValueError) as error:
        raise MapError(f"{source}: cannot be unpacked ({packing or 'plain'}): {error}") from error
    kind = _root(source, plain)
    path = folder / ("input.net.xml" if kind == "net" else "input.osm")
    plain.rename(path)
    return MapFile(source, path, kind, packing)


def _packing(source: Path, head: bytes) -> str:
    if head[:2] == b"\x1f\x8b":
        return "gzip"
    if head[:3] == b"BZh":
        return "bzip2"
    if b"OSMHeader" in head:
        return "PBF"
    if head.lstrip(b"\xef\xbb\xbf\xff\xfe\x00 \t\r\n")[:1] == b"<":
        return ""
    known = {b"PK": "a zip archive", b"\xfd7zXZ": "an xz file", b"7z\xbc\xaf": "a 7z archive", b"(\xb5/\xfd": "zstd"}
    found = next((what for magic, what in known.items() if head.startswith(magic)), f"bytes {head[:8]!r}")
    raise MapError(f"{source}: neither XML nor a known compression: found {found}; unpack it first; {READABLE}")


def _plain(source: Path, target: Path) -> None:
    with source.open("rb") as stream:
        _pour(source, stream, target)


def _gzip(source: Path, target: Path) -> None:
    with gzip.open(source, "rb") as stream:
        _pour(source, stream, target)


def _bzip2(source: Path, target: Path) -> None:
    with bz2.open(source, "rb") as stream:
        _pour(source, stream, target)


def _pbf(source: Path, target: Path) -> None:
    import osmium

    osm = target.with_suffix(".osm")
    with osmium.SimpleWriter(str(osm), overwrite=True) as writer:
        for thing in osmium.FileProcessor(str(source)):
            writer.add(thing)
    osm.rename(target)


UNPACKERS: dict[str, Callable[[Path, Path], None]] = {"": _plain, "gzip": _gzip, "bzip2": _bzip2, "PBF": _pbf}


def _pour(source: Path, stream: IO[bytes] | gzip.GzipFile | bz2.BZ2File, target: Path) -> None:
    size = 0
    with target.open("wb") as out:
        while piece := stream.read(PIECE_BYTES):
            size += len(piece)
            if size > LARGEST_BYTES:
                gib = LARGEST_BYTES >> 30
                raise MapError(f"{source}: more than {gib} GiB unpacked: cut the area of interest out first")
            out.write(piece)


class _Found(Exception):
    """The root element is known; the rest is not read."""


def _root(source: Path, plain: Path) -> Format:
    found: list[str] = []

    def start(tag: str, _attributes: dict[str, str]) -> None:
        found.append(tag)
        raise _Found

    parser = expat.ParserCreate()
    parser.StartElementHandler = start
    try:
        with plain.open("rb") as file:
            parser.ParseFile(file)
    except _Found:
        pass
    except (expat.ExpatError, LookupError, ValueError) as error:
        raise MapError(f"{source}: broken XML: {error}; {READABLE}") from error
    tag = found[0] if found else ""
    if tag in ("net", "osm"):
        return "net" if tag == "net" else "osm"
    raise MapError(f"{source}: not a map: its root element is <{tag}>, not <net> or <osm>; {READABLE}")


@dataclass(slots=True)
class _Scan:
    """Running counts of one pass over an OSM file."""

    lonlat: list[tuple[float, float]] = field(default_factory=list)
    ways: int = 0
    roads: int = 0
    fast: int = 0
    on_foot: int = 0
    tagged: set[str] = field(default_factory=set)
    head: dict[str, str] = field(default_factory=dict)
    way: str | None = None
    tags: dict[str, str] = field(default_factory=dict)

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        if tag == "node":
            self.lonlat.append((float(attributes["lon"]), float(attributes["lat"])))
        elif tag == "way":
            self.way, self.tags = attributes["id"], {}
        elif tag == "tag" and self.way is not None:
            self.tags[attributes.get("k", "")] = attributes.get("v", "")
        elif tag == "osm":
            self.head = attributes

    def end(self, tag: str) -> None:
        if tag != "way" or self.way is None:
            return
        self.ways += 1
        highway = self.tags.get("highway", "")
        if highway in ON_FOOT:
            self.on_foot += 1
        elif highway and highway not in NO_STREET:
            self.roads += 1
            tagged = any(key.split(":")[0] == "sidewalk" for key in self.tags)
            self.fast += highway in FAST and not tagged
            if tagged:
                self.tagged.add(self.way)
        self.way = None


class Elements(Protocol):
    """Takes in the elements of an OSM file, one after another."""

    def start(self, tag: str, attributes: dict[str, str]) -> None: ...
    def end(self, tag: str) -> None: ...


def scanned(file: MapFile, elements: Elements) -> None:
    """Show the elements of an OSM file. Raises MapError when it is broken."""
    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = elements.start, elements.end
    try:
        with file.path.open("rb") as stream:
            parser.ParseFile(stream)
    except (expat.ExpatError, LookupError) as error:
        said = f"attribute {error} is missing" if isinstance(error, KeyError) else str(error)
        raise MapError(f"{file.source}: broken OpenStreetMap file: {said}: get it again") from error
    except ValueError as error:
        raise MapError(f"{file.source}: broken OpenStreetMap file: {error}: get it again") from error


def osm_facts(file: MapFile) -> OsmFacts:
    """Facts of an OSM file, from one pass over it. Raises MapError when it is broken or holds no street."""
    scan = _Scan()
    scanned(file, scan)
    if not scan.lonlat or not scan.roads + scan.on_foot:
        raise MapError(
            f"{file.source}: an OpenStreetMap file of {len(scan.lonlat)} nodes and {scan.ways} ways, none of them a "
            "street or path (highway=*): export a larger area"
        )
    if not scan.on_foot and scan.fast == scan.roads:
        raise MapError(
            f"{file.source}: nothing walkable: {scan.roads} motorways and trunk roads, no other street or path: export "
            "a town"
        )
    lonlat = np.array(scan.lonlat)
    lon, lat = (float(v) for v in np.median(lonlat, axis=0))
    if not (abs(lon) <= 180.0 and abs(lat) <= 90.0):
        raise MapError(
            f"{file.source}: its nodes lie at longitude {lon:g}, latitude {lat:g}: not degrees; reproject it to WGS 84"
        )
    licence = " ".join(scan.head[key] for key in ("copyright", "attribution", "license") if key in scan.head)
    return OsmFacts(len(scan.lonlat), scan.ways, scan.roads, scan.on_foot, (lon, lat), frozenset(scan.tagged), licence)
