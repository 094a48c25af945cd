"""Read a .net.xml or .net.xml.gz into a StreetMap.

The reader streams the file once through expat and builds all polygons in a few vectorised calls.
"""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, NamedTuple
from xml.parsers import expat

import numpy as np
import shapely
from shapely.geometry import MultiPolygon, Point, Polygon

from cosim.core.errors import MapError
from cosim.core.geometry import Floats
from cosim.place.overlay import where_geos_failed
from cosim.place.street_map import Corner, Junction, Lane, Port, StreetMap, Strip
from sumo_nets.net.elevation import off_ground, steep_ports, steep_strips, terrain_of_net
from sumo_nets.net.outlines import (
    bands,
    carriageways,
    close_seams,
    coordinates,
    polygon_parts,
    polylines,
)
from sumo_nets.net.raw_file import DEEPEST, net_bytes, net_xml_hash
from sumo_nets.net.signal_plans import SignalPrograms

LANE_M = 3.2
"""SUMO's default width of lanes and sidewalks, metres."""
SPECK_M2 = 0.5
"""Smallest area of a corner, m2; smaller ones are dropped unless they connect strips."""
HEAVY = frozenset(("rail", "rail_electric", "rail_fast", "subway", "ship", "cable_car", "aircraft"))
"""Vehicle classes of railways and waterways, whose lanes are not roads."""
TRAMS = frozenset(("tram", "rail_urban"))
"""Vehicle classes of trams, which may share tracks with HEAVY."""
NEEDED = {
    "edge": ("id",),
    "lane": ("id", "shape"),
    "junction": ("id",),
    "connection": ("from", "to"),
}
"""Required attributes of each element."""
_WIDEST_M = 500.0
"""Largest width of a lane, metres."""

Attributes = dict[str, str]


def read_net(path: Path) -> StreetMap:
    """Read the StreetMap of a .net.xml or .net.xml.gz. Raises MapError naming the file and the
    reason.

    Nets without sidewalks or walking areas are read too: their strips or corners are empty.
    """
    data = net_bytes(path)
    raw = _parse(path, data)
    try:
        return _street_map(path, raw, net_xml_hash(data))
    except KeyError as error:
        raise MapError(
            f"{path}: not a street net that can be read: attribute {error} is missing"
        ) from error
    except MapError as error:
        raise MapError(f"{path}: {error}") from error
    except shapely.errors.GEOSException as error:
        raise MapError(
            f"{path}: its ground{where_geos_failed(error)} cannot be put together: {error}"
        ) from error
    except (ValueError, IndexError) as error:
        raise MapError(f"{path}: not a street net that can be read: {error}") from error


@dataclass(slots=True)
class _Edge:
    attributes: Attributes
    lanes: list[Attributes] = field(default_factory=list)
    params: Attributes = field(default_factory=dict)


@dataclass(slots=True)
class _Raw:
    """The elements of a net that a StreetMap is built from."""

    net: Attributes = field(default_factory=dict)
    location: Attributes = field(default_factory=dict)
    edges: list[_Edge] = field(default_factory=list)
    junctions: list[Attributes] = field(default_factory=list)
    links: list[Attributes] = field(default_factory=list)
    programs: SignalPrograms = field(default_factory=SignalPrograms)


def _parse(path: Path, data: bytes) -> _Raw:
    raw = _Raw()
    stack = list[str]()
    edges, junctions, links = raw.edges, raw.junctions, raw.links

    def start(tag: str, attributes: Attributes) -> None:
        parent = stack[-1] if stack else ""
        stack.append(tag)
        if tag == "request":
            return
        if len(stack) > DEEPEST:
            raise ValueError(f"elements nested more than {DEEPEST} deep")
        if lacking := [name for name in NEEDED.get(tag, ()) if name not in attributes]:
            raise ValueError(f"<{tag}> '{attributes.get('id', '')}' lacks '{lacking[0]}'")
        if tag == "connection":
            # Walking areas and crossings are internal edges; other connections are not needed.
            if ":" in (attributes.get("from", "")[:1], attributes.get("to", "")[:1]):
                links.append(attributes)
        elif tag == "lane" and parent == "edge":
            edges[-1].lanes.append(attributes)
        elif tag == "edge" and parent == "net":
            edges.append(_Edge(attributes))
        elif tag == "param" and parent == "edge":
            edges[-1].params[attributes.get("key", "")] = attributes.get("value", "")
        elif tag == "junction" and parent == "net":
            junctions.append(attributes)
        elif tag == "location":
            raw.location = attributes
        elif tag == "net":
            raw.net = attributes
        else:
            raw.programs.add(tag, parent, attributes)

    def end(_tag: str) -> None:
        stack.pop()

    parser = expat.ParserCreate()
    parser.StartElementHandler = start
    parser.EndElementHandler = end
    try:
        parser.Parse(data, True)
    except (expat.ExpatError, LookupError) as error:
        raise MapError(f"{path}: broken XML: {error}") from error
    except ValueError as error:
        raise MapError(
            f"{path}: not a street net that can be read: {error}: line {parser.CurrentLineNumber}"
        ) from error
    if not raw.net:
        raise MapError(f"{path}: not a SUMO street net: it has no <net>")
    if not edges:
        raise MapError(f"{path}: the street net has no edges: nothing walkable here")
    return raw


@dataclass(frozen=True)
class _Ground:
    """Lanes and areas of a net.

    walk: walked lane of each strip, by its edge, with its index
    areas: walking areas
    driven: all other lanes, with their kind
    """

    walk: dict[str, tuple[_Edge, Attributes, int]]
    areas: dict[str, Attributes]
    driven: list[tuple[_Edge, Attributes, Literal["road", "verge"]]]


def _ground(raw: _Raw) -> _Ground:
    """Sort the lanes of a net by their use."""
    found = _Ground({}, {}, [])
    for edge in raw.edges:
        function = edge.attributes.get("function", "")
        if function == "walkingarea" and edge.lanes:
            found.areas[edge.attributes["id"]] = edge.lanes[0]
            continue
        if function == "crossing" and edge.lanes:
            found.walk[edge.attributes["id"]] = (edge, edge.lanes[0], 0)
            continue
        footway = -1 if function == "internal" else _footway(edge)
        for i, lane in enumerate(edge.lanes):
            if i == footway:
                found.walk[edge.attributes["id"]] = (edge, lane, i)
            elif (function != "internal" or not _only_walked(lane)) and not _is_track(lane):
                found.driven.append((edge, lane, "verge" if _is_verge(lane) else "road"))
    return found


def _street_map(path: Path, raw: _Raw, net_hash: str) -> StreetMap:
    ground = _ground(raw)
    walk, driven = ground.walk, ground.driven
    lanes = [lane for _, lane, _ in (*walk.values(), *driven)]
    lines = polylines([lane["shape"] for lane in lanes], [lane["id"] for lane in lanes])
    widths = np.array([_width_m(lane) for lane in lanes])
    # Foreign nets write -1 for the default width.
    widths[widths <= 0.0] = LANE_M
    polygons = bands(lines, widths)
    corners = _corners(ground.areas, raw.links)
    ports, signalised = _ports(raw.links, walk, corners, lines)
    end_corners = [
        (corners.get(ports.get((name, 0), "")), corners.get(ports.get((name, 1), "")))
        for name in walk
    ]
    with np.errstate(divide="ignore", invalid="ignore"):
        # Slivers in foreign nets have infinite mitres, which GEOS cuts off.
        polygons[: len(walk)] = close_seams(
            polygons[: len(walk)], lines[: len(walk)], widths[: len(walk)], end_corners
        )
    strips = _strips(raw, walk, _Bands(lines, widths, polygons), ports, signalised)
    first = len(walk)
    roads = _roads(driven, _Bands(lines[first:], widths[first:], polygons[first:]))
    apart = {edge.attributes["id"] for edge in raw.edges if all(map(_only_walked, edge.lanes))}
    terrain, elevation = terrain_of_net(
        raw.edges, apart, {name: index for name, (_, _, index) in walk.items()}, ports
    )
    corner_ports: dict[str, list[Port]] = defaultdict(list)
    for (strip, end), corner in ports.items():
        corner_ports[corner].append(Port(strip, 1 if end else 0))
    corners_by_id = {
        c: Corner(id=c, polygon=polygon, ports=tuple(corner_ports[c]))
        for c, polygon in corners.items()
    }
    if terrain is not None and elevation is not None:
        steep = steep_strips(terrain, tuple(strips.values()))
        closed = steep_ports(terrain, strips, corners_by_id.values(), frozenset(steep))
        elevation = replace(elevation, steep=steep, closed=closed)
    return StreetMap(
        name=re.sub(r"(\.net)?\.xml(\.gz)?$", "", path.name),
        bounds=_bounds(raw, lines),
        strips=strips,
        corners=corners_by_id,
        lanes=roads,
        junctions=_junctions(
            raw.junctions,
            [*(s.polygon for s in strips.values() if s.kind == "sidewalk"), *corners.values()],
            [lane.polygon for lane in roads.values() if lane.kind == "road"],
        ),
        net_hash=net_hash,
        left_hand=_is_left_hand(raw),
        terrain=terrain,
        elevation=elevation,
        planned=any("street_class" in edge.params for edge in raw.edges),
    )


class _Bands(NamedTuple):
    """Lanes as bands: lines (K, 2) and widths (N,) in metres, and polygons."""

    lines: Sequence[Floats]
    widths_m: Floats
    polygons: Sequence[Polygon]


def _strips(
    raw: _Raw,
    walk: Mapping[str, tuple[_Edge, Attributes, int]],
    shapes: _Bands,
    ports: Mapping[tuple[str, int], str],
    signalised: Collection[str],
) -> dict[str, Strip]:
    """Build the strips, with the signals of crossings. shapes: those of `walk` come first."""
    left_hand = _is_left_hand(raw)
    plans = raw.programs.plans(raw.links, signalised)
    lengths_m = {
        name: float(np.hypot(*np.diff(shapes.lines[k], axis=0).T).sum())
        for k, name in enumerate(walk)
        if name in signalised
    }
    short = raw.programs.short_greens(raw.links, lengths_m) - plans.keys()
    strips: dict[str, Strip] = {}
    for k, (name, (edge, _, index)) in enumerate(walk.items()):
        ends = ports.get((name, 0)), ports.get((name, 1))
        built = _strip(
            edge,
            index,
            left_hand,
            shapes.lines[k],
            float(shapes.widths_m[k]),
            shapes.polygons[k],
            ends,
        )
        strips[name] = (
            replace(built, signalised=True, plan=plans.get(name), short_green=name in short)
            if name in signalised
            else built
        )
    return strips


def _roads(
    driven: Sequence[tuple[_Edge, Attributes, Literal["road", "verge"]]], shapes: _Bands
) -> dict[str, Lane]:
    """Build the lanes that are not walked."""
    return {
        lane["id"]: Lane(
            id=lane["id"],
            edge=edge.attributes["id"],
            kind=kind,
            line=shapes.lines[k],
            width_m=float(shapes.widths_m[k]),
            polygon=shapes.polygons[k],
            internal=edge.attributes.get("function", "") == "internal",
            cars=allows(lane, "passenger"),
        )
        for k, (edge, lane, kind) in enumerate(driven)
    }


def _is_left_hand(raw: _Raw) -> bool:
    return raw.net.get("lefthand") in ("true", "1")


def _width_m(lane: Attributes) -> float:
    value = lane.get("width", LANE_M)
    try:
        width_m = float(value)
    except ValueError:
        width_m = math.nan
    if math.isnan(width_m) or width_m > _WIDEST_M:
        reason = (
            f"a width of {width_m:g} m, but none is more than {_WIDEST_M:g}"
            if width_m > _WIDEST_M
            else "no number"
        )
        raise ValueError(f"lane '{lane['id']}': width '{value}' is {reason}")
    return width_m


def _lane_of(link: Attributes, end: str) -> int:
    """Return the lane index at an end, "fromLane" or "toLane", of a connection."""
    try:
        return int(link.get(end, 0))
    except ValueError as error:
        raise ValueError(
            f"connection from '{link['from']}' to '{link['to']}': {end} '{link[end]}' is no number"
        ) from error


def allows(lane: Attributes, vehicle: str) -> bool:
    """Return whether a lane permits a SUMO vehicle class, for example "pedestrian"."""
    if "allow" in lane:
        return lane["allow"] == "all" or vehicle in lane["allow"].split()
    return lane.get("disallow", "") != "all" and vehicle not in lane.get("disallow", "").split()


def _only_walked(lane: Attributes) -> bool:
    return allows(lane, "pedestrian") and not allows(lane, "passenger")


def _footway(edge: _Edge) -> int:
    """Return the index of the lane for walking, paths shared with bicycles included; -1 without
    one."""
    return next((i for i, lane in enumerate(edge.lanes) if _only_walked(lane)), -1)


def _is_verge(lane: Attributes) -> bool:
    return (
        lane.get("type", "") == "green_verge"
        or lane.get("disallow") == "all"
        or lane.get("allow") == ""
    )


def _is_track(lane: Attributes) -> bool:
    """Return whether only trains or ships use a lane. Trams run in the street."""
    allowed = set(lane.get("allow", "").split())
    return bool(allowed & HEAVY) and allowed <= HEAVY | TRAMS


def _corners(
    areas: dict[str, Attributes], links: Sequence[Attributes]
) -> dict[str, Polygon | MultiPolygon]:
    """Return the repaired polygons of the walking areas, without specks that connect no strips."""
    if not areas:
        return {}
    joined: dict[str, set[str]] = defaultdict(set)
    for link in links:
        joined[link["from"]].add(link["to"])
        joined[link["to"]].add(link["from"])
    flat, counts = coordinates([lane["shape"] for lane in areas.values()], list(areas))
    corners: dict[str, Polygon | MultiPolygon] = {}
    rings = np.split(flat, np.cumsum(counts)[:-1])
    shapes = [shapely.polygons(ring) if len(ring) > 2 else None for ring in rings]
    for name, ring, shape in zip(
        areas, rings, shapely.make_valid(np.array(shapes, dtype=object)), strict=True
    ):
        polygon = (
            None
            if shape is None
            else shape
            if isinstance(shape, Polygon)
            else polygon_parts(shape, largest=False)
        )
        if polygon is not None and polygon.area >= SPECK_M2:
            corners[name] = polygon
        elif len(joined[name]) > 1:
            corners[name] = shapely.MultiPoint(ring).convex_hull.buffer(0.3)
    return corners


def _ports(
    links: Sequence[Attributes],
    walk: dict[str, tuple[_Edge, Attributes, int]],
    corners: dict[str, Polygon | MultiPolygon],
    lines: Sequence[Floats],
) -> tuple[dict[tuple[str, int], str], set[str]]:
    """Return the corner at each end of each strip, and the ids of the signalised crossings."""
    ports: dict[tuple[str, int], str] = {}
    signalised: set[str] = set()
    for link in links:
        tail, head = link["from"], link["to"]
        if head in corners and tail in walk and _lane_of(link, "fromLane") == walk[tail][2]:
            ports.setdefault((tail, 1), head)
        elif tail in corners and head in walk and _lane_of(link, "toLane") == walk[head][2]:
            ports.setdefault((head, 0), tail)
        if "tl" in link and head in walk and head.startswith(":"):
            signalised.add(head)
    # A crossing's line may run against its connections: assign each end the nearer corner.
    for k, (name, (edge, _, _)) in enumerate(walk.items()):
        if edge.attributes.get("function") == "crossing" and {(name, 0), (name, 1)} <= ports.keys():
            first, last = corners[ports[name, 0]], corners[ports[name, 1]]
            start = Point(lines[k][0])
            stop = Point(lines[k][-1])
            straight = first.distance(start) + last.distance(stop)
            if straight > 1e-6 and first.distance(stop) + last.distance(start) < straight - 1e-6:
                ports[name, 0], ports[name, 1] = ports[name, 1], ports[name, 0]
    return ports, signalised


def _strip(
    edge: _Edge,
    index: int,
    left_hand: bool,
    line: Floats,
    width_m: float,
    polygon: Polygon,
    corners: tuple[str | None, str | None],
) -> Strip:
    name = edge.attributes["id"]
    if edge.attributes.get("function") == "crossing":
        crosses = tuple(edge.attributes.get("crossingEdges", "").split())
        return Strip(
            name,
            "crossing",
            line,
            width_m,
            polygon,
            corners,
            crosses=crosses,
            frontage_m=0.0,
            curb_m=0.0,
            road_side=0,
        )
    roads = [i for i, lane in enumerate(edge.lanes) if i != index and not _is_verge(lane)]
    side = 0 if not roads else 1 if (roads[0] > index) != left_hand else -1
    verges = (
        [float(lane.get("width", LANE_M)) for lane in edge.lanes if _is_verge(lane)]
        if roads
        else []
    )

    def number(key: str, missing: float) -> float:
        return float(edge.params.get(key, missing))

    return Strip(
        name,
        "sidewalk",
        line,
        width_m,
        polygon,
        corners,
        street_class=edge.params.get("street_class", edge.attributes.get("type", "")),
        frontage_m=number("frontage_m", 2.0),
        curb_m=number("curb_m", 0.3 if side else 0.0) + number("gutter_m", 0.0),
        verge_m=number("verge_m", sum(verges)),
        road_side=side,
        driveways=_driveways(edge.params.get("driveways", ""), line),
        going=_going(edge.params, edge.attributes.get("type", "")),
    )


def _going(params: Mapping[str, str], kind: str) -> Literal["plain", "steps", "bridge"]:
    """Return the value of `Strip.going` for an edge, from its params and type."""
    if off_ground(params, kind):
        return "bridge"
    return "steps" if "highway.steps" in kind.split("|") else "plain"


def _driveways(points: str, line: Floats) -> tuple[float, ...]:
    """Return the arc lengths on a sidewalk's line nearest to points of its street's middle line,
    metres."""
    if not points:
        return ()
    at, _ = coordinates([points], ["driveways"])
    return tuple(
        np.round(
            shapely.line_locate_point(shapely.linestrings(line), shapely.points(at)), 3
        ).tolist()
    )


def _junctions(
    rows: Sequence[Attributes],
    walks: Sequence[Polygon | MultiPolygon],
    lanes: Sequence[Polygon],
) -> dict[str, Junction]:
    outlined = [
        row for row in rows if row.get("type") != "internal" and row.get("shape", "").count(" ") > 1
    ]
    if not outlined:
        return {}
    flat, counts = coordinates([row["shape"] for row in outlined], [row["id"] for row in outlined])
    shapes = [shapely.polygons(ring) for ring in np.split(flat, np.cumsum(counts)[:-1])]
    valid = [
        (row, shape if isinstance(shape, Polygon) else polygon_parts(shape, largest=True))
        for row, shape in zip(
            outlined, shapely.make_valid(np.array(shapes, dtype=object)), strict=True
        )
    ]
    whole = [(row, polygon) for row, polygon in valid if polygon is not None]
    polygons = carriageways(
        [polygon for _, polygon in whole],
        np.array(walks, dtype=object),
        np.array(lanes, dtype=object),
    )
    return {
        row["id"]: Junction(row["id"], polygon, row.get("type", "").startswith("traffic_light"))
        for (row, _), polygon in zip(whole, polygons, strict=True)
    }


def _bounds(raw: _Raw, lines: Sequence[Floats]) -> tuple[float, float, float, float]:
    if lines:
        every = np.concatenate(lines)
        low, high = every.min(axis=0), every.max(axis=0)
    else:
        low, high = np.array(raw.location["convBoundary"].split(","), dtype=float).reshape(2, 2)
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])
