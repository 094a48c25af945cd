"""Extract the features of OpenStreetMap files besides streets: buildings, trees, lamps, land and
others, in degrees.

Errors of mappers raise nothing: unusable features are omitted and counted.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import shapely
from shapely.geometry import Polygon

from cosim.core.geometry import Floats
from cosim.place.street_map import LandKind
from sumo_nets.maps.osm_file import MapFile, scan_elements

_STOREY_M = 3.2
"""Height of a storey, metres."""
LOWEST_M = 2.5
"""Smallest height of a building, metres."""
HIGHEST_BUILDING_M = 150.0
"""Largest height of a building, metres."""
ABSURD_M = 1000.0
"""Tagged heights above this are ignored, metres."""
SMALLEST_DEG2 = 1e-10
"""Smallest area of a building or a piece of land, about 1 m2, in square degrees."""
LARGEST_DEG2 = 1e-4
"""Largest area of a building, about 1 km2, in square degrees."""

POINT_OBJECTS: Mapping[tuple[str, str], str] = {
    ("natural", "tree"): "tree",
    ("highway", "street_lamp"): "lamp",
    ("amenity", "bench"): "bench",
    ("barrier", "bollard"): "bollard",
    ("amenity", "waste_basket"): "bin",
    ("emergency", "fire_hydrant"): "hydrant",
    ("amenity", "bicycle_parking"): "rack",
}
"""Kind of a point object by its tag."""
ROWS: Mapping[tuple[str, str], tuple[str, float]] = {
    ("natural", "tree_row"): ("tree", 8.0),
    ("barrier", "bollard"): ("bollard", 1.5),
}
"""Kind and spacing in metres of objects along a way, by the way's tag."""
FLAT = ("no", "roof", "ruins", "construction", "proposed", "foundation", "collapsed")
"""Values of building=* without walls."""
LOW = (
    "garage",
    "garages",
    "shed",
    "hut",
    "carport",
    "kiosk",
    "container",
    "cabin",
    "bungalow",
    "greenhouse",
)
"""Values of building=* with one storey."""
LEVELS_OF = {"house": 2.0, "detached": 2.0, "semidetached_house": 2.0, "terrace": 2.0}
"""Number of storeys by the value of building=*."""
_LEVELS = 3.0
"""Default number of storeys."""
SMALL_M2 = 40.0
"""Buildings with a smaller area have one storey: kiosks, sheds, advertising columns, m2."""
LARGEST_LAND_DEG2 = 1e-2
"""Largest area of a piece of land, about 100 km2, in square degrees."""
_GREEN = (
    "grass",
    "meadow",
    "recreation_ground",
    "village_green",
    "cemetery",
    "allotments",
    "orchard",
    "vineyard",
)
_SPORT = ("park", "garden", "pitch", "golf_course", "dog_park", "common", "nature_reserve")
_LAND_VALUES: Mapping[LandKind, Mapping[str, tuple[str, ...]]] = {
    "lawn": {
        "landuse": (*_GREEN, "farmland", "greenfield", "plant_nursery", "greenery"),
        "leisure": _SPORT,
        "natural": ("grassland", "heath"),
        "amenity": ("grave_yard",),
    },
    "planting": {"landuse": ("forest", "flowerbed"), "natural": ("wood", "scrub", "shrubbery")},
    "soil": {
        "landuse": ("construction", "brownfield", "quarry", "landfill"),
        "natural": ("sand", "beach", "bare_rock", "shingle", "scree", "mud"),
        "leisure": ("playground",),
    },
    "yard": {
        "amenity": ("parking", "fuel", "bus_station", "car_wash", "marketplace"),
        "landuse": ("industrial", "commercial", "retail", "depot", "garages", "port", "railway"),
        "place": ("square",),
        "highway": ("pedestrian", "services"),
    },
    "water": {
        "natural": ("water", "bay"),
        "landuse": ("basin", "reservoir"),
        "waterway": ("riverbank", "dock"),
        "leisure": ("swimming_pool", "marina"),
    },
}
LAND_OF: Mapping[tuple[str, str], LandKind] = {
    (key, value): kind
    for kind, keys in _LAND_VALUES.items()
    for key, values in keys.items()
    for value in values
}
"""Kind of land by its tag. Pedestrian squares that are not walkable in the net are yards too."""
_ROOFED = ("underground", "multi-storey", "rooftop", "carports", "garage_boxes", "sheds")
"""Values of parking=* that are not open land."""
METRE_DEG = 1.0 / 111_195.0
"""Degrees of latitude per metre."""
_NUMBER = re.compile(r"\d{1,6}(?:\.\d{1,6})?")
WINDS = (
    "N",
    "NNE",
    "NE",
    "ENE",
    "E",
    "ESE",
    "SE",
    "SSE",
    "S",
    "SSW",
    "SW",
    "WSW",
    "W",
    "WNW",
    "NW",
    "NNW",
)


class MappedFeature(NamedTuple):
    """A feature as mapped.

    rings: (N, 2) longitudes and latitudes; outline and holes of buildings and land, one point of
        others.
    height_m: 0 if unknown.
    facing_rad: viewing direction of a person seated on it, None if unknown.
    """

    kind: str
    rings: tuple[Floats, ...]
    height_m: float
    facing_rad: float | None


@dataclass(frozen=True, slots=True)
class OsmFeatures:
    """All features of a file in order, and the number of omitted ones by reason."""

    things: tuple[MappedFeature, ...]
    skipped: Mapping[str, int]


@dataclass(slots=True)
class _Scan:
    """One pass over a file.

    spots: tagged nodes.
    ways: node ids and tags.
    areas, lands: multipolygons with tags of buildings, and of land.
    """

    lonlat: dict[str, tuple[float, float]] = field(default_factory=dict)
    spots: list[tuple[str, dict[str, str]]] = field(default_factory=list)
    ways: dict[str, tuple[list[str], dict[str, str]]] = field(default_factory=dict)
    areas: list[tuple[list[tuple[str, str]], dict[str, str]]] = field(default_factory=list)
    lands: list[tuple[list[tuple[str, str]], dict[str, str]]] = field(default_factory=list)
    tags: dict[str, str] = field(default_factory=dict)
    refs: list[str] = field(default_factory=list)
    members: list[tuple[str, str]] = field(default_factory=list)
    name: str = ""

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        if tag == "node":
            self.name = attributes.get("id", "")
            self.lonlat[self.name] = float(attributes["lon"]), float(attributes["lat"])
            self.tags = {}
        elif tag in ("way", "relation"):
            self.name = attributes.get("id", "")
            self.tags = {}
            self.refs = []
            self.members = []
        elif tag == "tag":
            self.tags[attributes.get("k", "")] = attributes.get("v", "")
        elif tag == "nd":
            self.refs.append(attributes.get("ref", ""))
        elif tag == "member" and attributes.get("type") == "way":
            self.members.append((attributes.get("ref", ""), attributes.get("role", "")))

    def end(self, tag: str) -> None:
        if tag == "node" and self.tags:
            self.spots.append((self.name, self.tags))
        elif tag == "way":
            self.ways[self.name] = self.refs, self.tags
        elif tag == "relation" and self.tags.get("type") == "multipolygon":
            if "building" in self.tags:
                self.areas.append((self.members, self.tags))
            elif _land(self.tags) is not None:
                self.lands.append((self.members, self.tags))


def osm_features(file: MapFile) -> OsmFeatures:
    """Return the features of an OSM file. Raises MapError if the file is damaged."""
    scan = _Scan()
    scan_elements(file, scan)
    skipped: Counter[str] = Counter()
    things = [
        *_spots(scan, skipped),
        *_rows(scan, skipped),
        *_buildings(scan, skipped),
        *_lands(scan, skipped),
    ]
    return OsmFeatures(tuple(things), dict(sorted(skipped.items())))


def _spots(scan: _Scan, skipped: Counter[str]) -> list[MappedFeature]:
    found = []
    for name, tags in scan.spots:
        kind = next((POINT_OBJECTS[pair] for pair in tags.items() if pair in POINT_OBJECTS), None)
        if kind is None:
            continue
        at = np.array([scan.lonlat[name]])
        if not _on_earth(at):
            skipped["things with impossible coordinates"] += 1
        elif kind == "hydrant" and tags.get("fire_hydrant:type", "pillar") not in (
            "pillar",
            "dry_barrel",
        ):
            skipped["hydrants in the ground or on a wall"] += 1
        else:
            found.append(
                MappedFeature(kind, (at,), _height(tags, "height", skipped), _facing(tags))
            )
    return found


def _rows(scan: _Scan, skipped: Counter[str]) -> list[MappedFeature]:
    """Return evenly spaced objects along ways."""
    found = []
    for refs, tags in scan.ways.values():
        row = next((ROWS[pair] for pair in tags.items() if pair in ROWS), None)
        if row is None:
            continue
        points = _points(scan, refs)
        if points is None or len(points) < 2:
            skipped["rows of things with missing nodes"] += 1
            continue
        kind, apart_m = row
        scale = np.array([math.cos(math.radians(float(points[:, 1].mean()))), 1.0]) / METRE_DEG
        line = shapely.LineString(points * scale)
        if not line.length < 5000.0:
            skipped["rows of things beyond 5 km"] += 1
            continue
        count = max(round(line.length / apart_m), 1) + 1
        spots = shapely.get_coordinates(
            shapely.line_interpolate_point(line, np.linspace(0.0, 1.0, count), normalized=True)
        )
        found += [MappedFeature(kind, (at[None],), 0.0, None) for at in spots / scale]
    return found


def _buildings(scan: _Scan, skipped: Counter[str]) -> list[MappedFeature]:
    found = []
    within = {ref for members, _ in scan.areas for ref, role in members if role != "inner"}
    for name, (refs, tags) in scan.ways.items():
        if "building" in tags and name not in within and _has_walls(tags, skipped):
            ring = _points(scan, refs)
            if ring is None:
                skipped["buildings with missing nodes"] += 1
            elif len(ring) < 4 or refs[0] != refs[-1]:
                skipped["buildings with an open outline"] += 1
            else:
                found += _building_features([Polygon(ring)], tags, skipped)
    for members, tags in scan.areas:
        if not _has_walls(tags, skipped):
            continue
        walled = _outlines(scan, members, "buildings", skipped)
        found += _building_features(walled, tags, skipped)
    return found


def _lands(scan: _Scan, skipped: Counter[str]) -> list[MappedFeature]:
    """Return pieces of open land. Pieces with missing nodes, common at a map's edge, are only
    counted."""
    found = []
    for refs, tags in scan.ways.values():
        kind = _land(tags)
        if kind is None or "building" in tags or len(refs) < 4 or refs[0] != refs[-1]:
            continue
        if tags.get("highway") and tags.get("area") != "yes":
            continue
        ring = _points(scan, refs)
        if ring is None:
            skipped["pieces of land with missing nodes"] += 1
        else:
            found += _land_features(kind, [Polygon(ring)], skipped)
    for members, tags in scan.lands:
        kind = _land(tags)
        if kind is not None:
            found += _land_features(
                kind, _outlines(scan, members, "pieces of land", skipped), skipped
            )
    return found


def _land(tags: Mapping[str, str]) -> LandKind | None:
    """Return the kind of land of an area; None if unknown or not at ground level."""
    if tags.get("parking") in _ROOFED or tags.get("layer", "0").lstrip("-") not in ("", "0"):
        return None
    if tags.get("tunnel", "no") != "no" or tags.get("location") == "underground":
        return None
    return next((LAND_OF[pair] for pair in tags.items() if pair in LAND_OF), None)


def _land_features(
    kind: LandKind, outlines: Sequence[shapely.Geometry], skipped: Counter[str]
) -> list[MappedFeature]:
    found = []
    for outline in outlines:
        if not isinstance(outline, Polygon) or not outline.is_valid:
            skipped["pieces of land whose outline crosses itself"] += 1
        elif SMALLEST_DEG2 < outline.area < LARGEST_LAND_DEG2:
            found.append(MappedFeature(kind, _rings_of(outline), 0.0, None))
    return found


def _outlines(
    scan: _Scan, members: Sequence[tuple[str, str]], subject: str, skipped: Counter[str]
) -> list[shapely.Geometry]:
    """Return the areas of a multipolygon; empty, and counted, if they cannot be assembled."""
    outer, inner = (
        _rings(scan, [ref for ref, r in members if (r == "inner") == is_in])
        for is_in in (False, True)
    )
    if not outer or inner is None:
        skipped[f"{subject} with an open outline"] += 1
        return []
    try:
        holes = shapely.union_all(inner)
        return [part for o in outer for part in shapely.get_parts(shapely.difference(o, holes))]
    except shapely.errors.GEOSException:
        skipped[f"{subject} whose outline crosses itself"] += 1
        return []


def _rings(scan: _Scan, refs: Sequence[str]) -> list[Polygon] | None:
    """Return the closed rings of a multipolygon's ways; None if a way is missing or left over."""
    lines = []
    for ref in refs:
        points = _points(scan, scan.ways[ref][0]) if ref in scan.ways else None
        if points is None or len(points) < 2 or not np.ptp(points, axis=0).any():
            return None
        lines.append(shapely.LineString(points))
    if not lines:
        return []
    rings, cuts, dangles, broken = shapely.polygonize_full(lines)
    if not all(shapely.is_empty(rest) for rest in (cuts, dangles, broken)):
        return None
    return [Polygon(shapely.get_exterior_ring(ring)) for ring in shapely.get_parts(rings)]


def _building_features(
    outlines: Sequence[shapely.Geometry], tags: Mapping[str, str], skipped: Counter[str]
) -> list[MappedFeature]:
    found = []
    for outline in outlines:
        if not isinstance(outline, Polygon) or not outline.is_valid:
            skipped["buildings whose outline crosses itself"] += 1
        elif not SMALLEST_DEG2 < outline.area < LARGEST_DEG2:
            skipped["buildings too small or too large to be one"] += 1
        else:
            metres2 = outline.area * math.cos(math.radians(outline.centroid.y)) / METRE_DEG**2
            found.append(
                MappedFeature(
                    "building", _rings_of(outline), building_height_m(tags, metres2, skipped), None
                )
            )
    return found


def _rings_of(outline: Polygon) -> tuple[Floats, ...]:
    return tuple(shapely.get_coordinates(ring) for ring in (outline.exterior, *outline.interiors))


def _has_walls(tags: Mapping[str, str], skipped: Counter[str]) -> bool:
    if tags.get("building", "no") in FLAT:
        skipped["roofs, ruins and plans of buildings"] += 1
        return False
    hangs = any(
        (parse_metres(tags.get(key, "0")) or 0.0) > 0.0
        for key in ("min_height", "building:min_level")
    )
    if hangs or tags.get("layer", "0").startswith("-") or tags.get("location") == "underground":
        skipped["buildings above or under the ground"] += 1
        return False
    return True


def building_height_m(tags: Mapping[str, str], area_m2: float, skipped: Counter[str]) -> float:
    """Return a building's height: as tagged, else by storeys, else by kind and size, limited to
    a plausible range."""
    height_m = (
        _height(tags, "height", skipped) or _height(tags, "building:levels", skipped) * _STOREY_M
    )
    if not height_m:
        kind = tags.get("building", "yes")
        height_m = _STOREY_M * (
            1.0 if kind in LOW or area_m2 < SMALL_M2 else LEVELS_OF.get(kind, _LEVELS)
        )
    return min(max(height_m, LOWEST_M), HIGHEST_BUILDING_M)


def _height(tags: Mapping[str, str], key: str, skipped: Counter[str]) -> float:
    """Return a tag's value in metres or storeys; 0 if missing or unusable, which is counted."""
    if key not in tags:
        return 0.0
    value = parse_metres(tags[key])
    if value is None or not value < ABSURD_M:
        skipped["heights that cannot be read or cannot be"] += 1
        return 0.0
    return value


def parse_metres(value: str) -> float | None:
    """Parse a length in metres or feet ("12", "12.5 m", "12,5", "40'", "40 ft"); None for other
    text."""
    text = value.strip().lower().replace(",", ".")
    feet = re.fullmatch(
        rf"({_NUMBER.pattern})\s*(?:'|ft|feet)(?:\s*({_NUMBER.pattern})\s*(?:\"|in))?", text
    )
    if feet:
        return 0.3048 * (float(feet[1]) + float(feet[2] or 0.0) / 12.0)
    plain = re.fullmatch(rf"({_NUMBER.pattern})\s*(?:m|metres?|meters?)?", text)
    return float(plain[1]) if plain else None


def _facing(tags: Mapping[str, str]) -> float | None:
    """Return the direction tag, clockwise from north in degrees or a compass point, as a heading
    in radians."""
    text = tags.get("direction", "").strip().upper()
    if text in WINDS:
        degrees = 360.0 * WINDS.index(text) / len(WINDS)
    elif _NUMBER.fullmatch(text):
        degrees = float(text)
    else:
        return None
    return math.remainder(math.radians(90.0 - degrees), 2.0 * math.pi)


def _points(scan: _Scan, refs: Sequence[str]) -> Floats | None:
    """Return the coordinates (N, 2) of a way; None if nodes are missing or have invalid
    coordinates."""
    if not all(ref in scan.lonlat for ref in refs):
        return None
    points = np.array([scan.lonlat[ref] for ref in refs], dtype=float).reshape(-1, 2)
    return points if _on_earth(points) else None


def _on_earth(lonlat: Floats) -> bool:
    return bool((np.abs(lonlat) <= (180.0, 85.0)).all())
