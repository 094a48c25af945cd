"""Census of a generated city: counts of blocks, zones, walkways and signals, and faults.

Everything is read from the saved net and its StreetMap; the plan is not used.
"""

from __future__ import annotations

import math
import statistics
import xml.etree.ElementTree as ET
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import shapely

from cosim.core.geometry import Floats
from cosim.place import overlay
from cosim.place.street_map import Lane, StreetMap, Strip
from cosim.place.walk_graph import WalkGraph
from sumo_nets.city.signals import signal_faults
from sumo_nets.net.net_file import read_net

BLOCKS = ("straight", "curve", "s_bend", "t_junction", "x_junction", "y_junction", "roundabout")
"""The seven primitive blocks."""
ZONES = ("road", "curb", "verge", "sidewalk", "frontage")
"""The five zones of a street, from its middle outwards; "curb" includes the gutter."""

STRAIGHT_RAD = math.radians(8.0)
"""Streets that turn less are straight; S-bends turn more in both directions, radians."""
FORK_RAD = math.radians(152.0)
"""A junction of three arms is a Y if no two neighbouring arms are farther apart, else a T,
radians."""

_WIDEST_M = 2.0
"""Largest tested width of the free ground, metres."""
_WIDTH_STEP_M = 0.05
"""Step of tested widths, metres."""
MIN_CLEAR_M = 1.2
"""Smallest free width in a city without faults, metres."""
_LONGEST_M = 1500.0
"""Smallest length of the longest walk in a city without faults, metres."""
ONE_PIECE = 0.99
"""Smallest share of the walkable area in its largest part, in a city without faults."""


class Span(NamedTuple):
    """Minimum, median and maximum of values."""

    low: float
    middle: float
    high: float

    @classmethod
    def of(cls, values: Sequence[float]) -> Span:
        """Return the span of at least one value."""
        return cls(min(values), statistics.median(values), max(values))


class Census(NamedTuple):
    """Counts and measures of a city.

    blocks: number of each of BLOCKS.
    zones: widths in metres, one value per sidewalk.
    missing: number of streets without all zones.
    crosswalks: crossings in the middle of a street.
    refuges: crossings with a median island.
    one_piece: share of the walkable area in its largest part.
    clear_m: free width everywhere on the walkable ground, around the given furniture.
    longest_m: length of the longest shortest walk found.
    faults: violated requirements of a city, a sentence each.
    """

    name: str
    km2: float
    blocks: Mapping[str, int]
    zones: Mapping[str, Span]
    missing: int
    sidewalk_km: float
    walkable_share: float
    crossings: int
    crosswalks: int
    refuges: int
    signalised: int
    signals: int
    driveways: int
    one_piece: float
    clear_m: float
    longest_m: float
    faults: tuple[str, ...]


class _Way(NamedTuple):
    """One direction of a street: end nodes, parameters, and the line of its first road lane."""

    tail: str
    head: str
    params: Mapping[str, str]
    line: Floats


def census(
    path: Path, street_map: StreetMap | None = None, standing: Sequence[shapely.Geometry] = ()
) -> Census:
    """Take the census of a city's net.

    street_map: map of the same file, if already read.
    standing: ground covered by furniture.
    """
    place = read_net(path) if street_map is None else street_map
    net = path.read_bytes()
    root = ET.fromstring(net)
    ways = _ways(root, place)
    medians = {
        e.get("id")
        for e in root.iter("edge")
        if any(lane.get("type") == "median" for lane in e.iter("lane"))
    }
    sidewalks = [strip for strip in place.strips.values() if strip.kind == "sidewalk"]
    crossings = [strip for strip in place.strips.values() if strip.kind == "crossing"]
    blocks, middles = _blocks(root, ways)
    zones, missing = _zones(place, ways, sidewalks)
    areas = [part.area for part in shapely.get_parts(place.walkable)]
    x0, y0, x1, y1 = place.bounds
    km2 = (x1 - x0) * (y1 - y0) / 1e6
    found = Census(
        name=place.name,
        km2=km2,
        blocks={name: blocks[name] for name in BLOCKS},
        zones=zones,
        missing=missing,
        sidewalk_km=sum(strip.length_m for strip in sidewalks) / 1000.0,
        walkable_share=sum(areas) / (km2 * 1e6),
        crossings=len(crossings),
        crosswalks=sum(strip.id.rsplit("_", 1)[0][1:] in middles for strip in crossings),
        refuges=sum(bool(medians & set(strip.crosses)) for strip in crossings),
        signalised=sum(strip.signalised for strip in crossings),
        signals=sum(junction.signalised for junction in place.junctions.values()),
        driveways=sum(len(strip.driveways) for strip in sidewalks),
        one_piece=max(areas) / sum(areas),
        clear_m=clear_width_m(place, standing),
        longest_m=longest_walk_m(WalkGraph(place)),
        faults=(),
    )
    return found._replace(faults=tuple(_faults(found, place, signal_faults(net))))


def clear_width_m(
    place: StreetMap,
    standing: Sequence[shapely.Geometry] = (),
) -> float:
    """Return the largest width up to 2 m, in steps of 5 cm, that fits everywhere.

    The walkable ground around furniture, shrunk by half of that width, must have one piece that
    holds the middles of all strips.
    """
    ground: shapely.Geometry = shapely.simplify(place.walkable, 0.01)
    shapely.prepare(ground)
    if in_the_way := [thing for thing in standing if shapely.intersects(ground, thing)]:
        ground = overlay.difference(ground, overlay.union_all(in_the_way))
    lines = shapely.linestrings(
        np.concatenate([strip.line[:, :2] for strip in place.strips.values()]),
        indices=np.repeat(
            np.arange(len(place.strips)), [len(strip.line) for strip in place.strips.values()]
        ),
    )
    middles = shapely.get_coordinates(shapely.line_interpolate_point(lines, 0.5, normalized=True))
    low = 0
    high = round(_WIDEST_M / _WIDTH_STEP_M) + 1
    while high - low > 1:
        steps = (low + high) // 2
        low, high = (
            (steps, high) if _passes(ground, middles, 0.5 * steps * _WIDTH_STEP_M) else (low, steps)
        )
    return low * _WIDTH_STEP_M


def _passes(ground: shapely.Geometry, middles: Floats, half_m: float) -> bool:
    parts = shapely.get_parts(shapely.buffer(ground, -half_m, quad_segs=4))
    if not len(parts):
        return False
    # A niche at a corner may be cut off; every strip must be reachable.
    free = parts[np.argmax(shapely.area(parts))]
    shapely.prepare(free)
    return bool(shapely.contains_xy(free, middles[:, 0], middles[:, 1]).all())


def longest_walk_m(graph: WalkGraph) -> float:
    """Return the length of the longest shortest walk found by two sweeps between far ports."""
    port = graph.ports[int(np.argmin(graph.xy.sum(axis=1)))]
    longest = 0.0
    for _ in range(2):
        reach = graph.reach(port)
        distance = np.where(np.isfinite(reach.distance_m), reach.distance_m, -1.0)
        longest = float(distance.max())
        port = graph.ports[int(distance.argmax())]
    return longest


def _ways(root: ET.Element, place: StreetMap) -> dict[str, _Way]:
    lines: dict[str, Floats] = {}
    for lane in place.lanes.values():
        if lane.kind == "road" and not lane.internal:
            lines.setdefault(lane.edge, lane.line[:, :2])
    return {
        edge.get("id", ""): _Way(
            edge.get("from", ""),
            edge.get("to", ""),
            {param.get("key", ""): param.get("value", "") for param in edge.iter("param")},
            lines[edge.get("id", "")],
        )
        for edge in root.iter("edge")
        if edge.get("id", "") in lines
    }


def _blocks(root: ET.Element, ways: Mapping[str, _Way]) -> tuple[Counter[str], set[str]]:
    """Count the blocks of each kind, and find the nodes in the middle of a street."""
    ring = {edge for row in root.iter("roundabout") for edge in row.get("edges", "").split()}
    found = Counter({"roundabout": sum(1 for _ in root.iter("roundabout"))})
    arms: dict[str, list[float]] = defaultdict(list)
    for name, way in ways.items():
        if name not in ring:
            arms[way.tail].append(math.atan2(*(way.line[1] - way.line[0])[::-1]))
            if way.tail < way.head:
                found[_shape(way.line)] += 1
    round_about = {ways[edge].tail for edge in ring if edge in ways}
    middles = set()
    for node, headings in arms.items():
        if node in round_about:
            continue
        order = sorted(headings)
        widest = max(
            (b - a) % (2.0 * math.pi) for a, b in zip(order, [*order[1:], order[0]], strict=True)
        )
        if len(order) == 2:
            middles.add(node)
        elif len(order) == 3:
            found["y_junction" if widest < FORK_RAD else "t_junction"] += 1
        elif len(order) > 3:
            found["x_junction"] += 1
    return found, middles


def _shape(line: Floats) -> str:
    """Classify a street's middle line by its total turns to the left and right."""
    headings = [
        math.atan2(q[1] - p[1], q[0] - p[0])
        for p, q in pairwise(line.tolist())
        if math.dist(p, q) > 0.05
    ]
    turns = [math.remainder(b - a, 2.0 * math.pi) for a, b in pairwise(headings)]
    left = sum(t for t in turns if t > 0.0)
    right = -sum(t for t in turns if t < 0.0)
    if left + right < STRAIGHT_RAD:
        return "straight"
    return "s_bend" if min(left, right) > STRAIGHT_RAD else "curve"


def _zones(
    place: StreetMap, ways: Mapping[str, _Way], sidewalks: Sequence[Strip]
) -> tuple[dict[str, Span], int]:
    """Return the widths of the zones of all streets, and the number of streets that lack one."""
    lanes: dict[str, list[Lane]] = defaultdict(list)
    for lane in place.lanes.values():
        if not lane.internal:
            lanes[lane.edge].append(lane)
    widths: dict[str, list[float]] = {zone: [] for zone in ZONES}
    missing = 0
    for strip in sidewalks:
        params = ways[strip.id].params if strip.id in ways else {}
        # The verge is the lane next to the sidewalk; a later one is a median.
        next_lane = lanes[strip.id][:1]
        zone_widths = {
            "road": sum(lane.width_m for lane in lanes[strip.id] if lane.kind == "road"),
            "curb": float(params.get("curb_m", 0.0)) + float(params.get("gutter_m", 0.0)),
            "verge": sum(lane.width_m for lane in next_lane if lane.kind == "verge"),
            "sidewalk": strip.width_m,
            "frontage": float(params.get("frontage_m", 0.0)),
        }
        missing += not all(zone_widths.values())
        for zone, width_m in zone_widths.items():
            widths[zone].append(width_m)
    return {zone: Span.of(values) for zone, values in widths.items() if values}, missing


def _faults(found: Census, place: StreetMap, signals: Sequence[str]) -> list[str]:
    """Return the violated requirements, a sentence each. Small cities need not have every block."""
    faults = [
        f"no {name} block" for name, count in found.blocks.items() if not count and found.km2 > 3.0
    ]
    loose = sum(None in strip.corners for strip in place.strips.values())
    if found.missing:
        faults.append(f"{found.missing} streets without all of the zones {', '.join(ZONES)}")
    if found.one_piece < ONE_PIECE:
        faults.append(f"only {found.one_piece:.1%} of the walkable area is one piece")
    if loose:
        faults.append(f"{loose} strips end at no corner")
    if found.clear_m < MIN_CLEAR_M:
        faults.append(f"a passage is only {found.clear_m:.2f} m wide")
    if found.km2 > 3.0 and found.longest_m < _LONGEST_M:
        faults.append(f"the longest walk has only {found.longest_m:.0f} m")
    return [*faults, *signals]
