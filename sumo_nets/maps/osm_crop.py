"""Crop OpenStreetMap files before conversion: a city takes minutes, a part of it seconds."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from cosim.core.errors import MapError

MARGIN_M: Final = 500.0
"""Width of the margin around the box, metres: blocks are complete, and the net is cropped
afterwards."""
MAX_MEMBERS: Final = 50
"""Areas of more ways (rivers, borders) are omitted."""
_DEGREE_M: Final = 111_195.0
"""Length of a degree of latitude, metres."""

Box = tuple[float, float, float, float]


def crop_osm(file: Path, target: Path, box: Box, source: Path) -> None:
    """Write the part of an OSM file (XML or PBF) in a box to `target`, as XML.

    Open streets end one node outside of the margin; everything else is complete or omitted. Raises
    MapError, with the bounds of the file, when it has no street there.

    box: west, south, east, north in degrees.
    source: the file to name in errors.
    """
    import osmium

    try:
        part = _selected_part(file, box, source)
        _write(file, target, part)
    except (OSError, RuntimeError, ValueError, osmium.InvalidLocationError) as error:
        raise MapError(f"{source}: cannot be cropped: {error}: get it again") from error


def refuse_box_outside(source: Path, box: Box, bounds: Box, unit: str = "degrees") -> None:
    """Raise MapError, with the bounds of the map, when a box does not overlap it."""
    if _overlap(box, bounds):
        return
    west, south, east, north = box
    swapped = (south, west, north, east)
    hint = (
        f" (latitude and longitude swapped? --bbox {_box_text(swapped)})"
        if _overlap(swapped, bounds)
        else ""
    )
    covers = _box_text(bounds)
    raise MapError(
        f"{source}: --bbox {_box_text(box)} is outside of the map, which covers {covers} "
        f"(west,south,east,north in {unit}): give a part of that{hint}"
    )


@dataclass(slots=True)
class _Part:
    """Ids of the cropped part.

    cuts: indices of the first and last node of shortened streets.
    """

    nodes: set[int] = field(default_factory=set)
    ways: set[int] = field(default_factory=set)
    cuts: dict[int, tuple[int, int]] = field(default_factory=dict)
    relations: set[int] = field(default_factory=set)


def _selected_part(file: Path, box: Box, source: Path) -> _Part:
    inside, bounds = _inside(file, box)
    if not math.isfinite(bounds[0]):
        raise MapError(f"{source}: an OpenStreetMap file without nodes: export a larger area")
    refuse_box_outside(source, box, bounds)
    part = _Part(set(inside))
    streets = 0
    for way in _elements(file, "WAY"):
        refs = [node.ref for node in way.nodes]
        hits = [place for place, ref in enumerate(refs) if ref in inside]
        if not hits:
            continue
        part.ways.add(way.id)
        if "highway" in way.tags:
            streets += 1
            if refs[0] != refs[-1]:
                first = max(hits[0] - 1, 0)
                last = min(hits[-1] + 1, len(refs) - 1)
                part.cuts[way.id] = first, last
                refs = refs[first : last + 1]
        part.nodes.update(refs)
    if not streets:
        raise MapError(
            f"{source}: no street or path (highway=*) of the file lies in --bbox {_box_text(box)}; "
            f"the file covers {_box_text(bounds)}: choose a part with streets in it"
        )
    further = set[int]()
    for relation in _elements(file, "RELATION"):
        members = [member.ref for member in relation.members if member.type == "w"]
        kind = relation.tags.get("type", "")
        if (
            kind == "multipolygon"
            and len(members) <= MAX_MEMBERS
            and part.ways.intersection(members)
        ):
            part.relations.add(relation.id)
            further.update(members)
        elif kind == "restriction" and part.ways.issuperset(members):
            part.relations.add(relation.id)
    further -= part.ways
    for way in _elements(file, "WAY") if further else ():
        if way.id in further:
            part.ways.add(way.id)
            part.nodes.update(node.ref for node in way.nodes)
    return part


def _inside(file: Path, box: Box) -> tuple[set[int], Box]:
    """Return the ids of the nodes in a box and its margin, and the bounds of all nodes."""
    west, south, east, north = box
    high = MARGIN_M / _DEGREE_M
    wide = high / max(math.cos(math.radians(0.5 * (south + north))), 0.01)
    west = west - wide
    south = south - high
    east = east + wide
    north = north + high
    low_lon = low_lat = math.inf
    high_lon = high_lat = -math.inf
    inside = set[int]()
    for node in _elements(file, "NODE"):
        if not node.location.valid():
            continue
        lon, lat = node.lon, node.lat
        low_lon, high_lon = min(low_lon, lon), max(high_lon, lon)
        low_lat, high_lat = min(low_lat, lat), max(high_lat, lat)
        if west <= lon <= east and south <= lat <= north:
            inside.add(node.id)
    return inside, (low_lon, low_lat, high_lon, high_lat)


def _write(file: Path, target: Path, part: _Part) -> None:
    import osmium

    with osmium.SimpleWriter(str(target), overwrite=True) as writer:
        for node in _elements(file, "NODE"):
            if node.id in part.nodes:
                writer.add_node(node)
        for way in _elements(file, "WAY"):
            if way.id in part.cuts:
                first, last = part.cuts[way.id]
                writer.add_way(
                    way.replace(nodes=[node.ref for node in way.nodes][first : last + 1])
                )
            elif way.id in part.ways:
                writer.add_way(way)
        for relation in _elements(file, "RELATION"):
            if relation.id in part.relations:
                writer.add_relation(relation)


def _elements(file: Path, kind: str) -> Iterator[Any]:
    """Yield the nodes, ways or relations of a file."""
    import osmium

    things: Iterable[Any] = osmium.FileProcessor(str(file), getattr(osmium.osm, kind))
    yield from things


def _overlap(a: Box, b: Box) -> bool:
    return a[0] < b[2] and a[2] > b[0] and a[1] < b[3] and a[3] > b[1]


def _box_text(box: Box) -> str:
    return ",".join(f"{side:.6g}" if abs(side) < 1000.0 else f"{side:.0f}" for side in box)
