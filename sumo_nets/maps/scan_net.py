"""Build the walking net of a scan from its areas.

The medial axis of the walkable ground becomes edges for pedestrians, each as wide as its narrowest
place. SUMO walks there, inside of the drawn ground. Drawn roads carry cars; drawn crossings lead
over them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from pathlib import Path
from typing import Final, NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np
import shapely
from shapely.geometry import LineString, MultiPolygon, Polygon

from cosim.core.errors import MapError
from cosim.core.geometry import Floats, Polyline
from cosim.core.progress import Progress, ignore
from cosim.place import overlay
from cosim.place.medial_axis import Axis, between, medial_axis
from cosim.place.scan import Georeference, HeightGrid, ScanArea
from cosim.place.scan_areas import WALKED, walkable_ground
from cosim.place.street_map import Port, StreetMap, Strip
from cosim.place.walk_graph import WalkGraph
from sumo_nets.maps.driving_side import left_hand_country
from sumo_nets.maps.ground_file import GROUND_FILE, drawn_ground, write_ground
from sumo_nets.maps.net_steps import start_net
from sumo_nets.net.net_file import read_net
from sumo_nets.net.netconvert import netconvert

CROWD_M: Final = 1.2
"""Clear width below which the crowd does not walk, in metres."""
INNER_M: Final = 0.2
"""Width by which lanes are narrower than the clear width, in metres."""
_MIN_LANE_M: Final = 0.4
_TWO_WAY_M: Final = 5.0
"""Clear width from which a road has a lane in each direction, in metres."""
_LANE_MPS: Final = 8.33
_WALK_MPS: Final = 1.4
_JOIN_M: Final = 20.0
"""Largest distance from a crossing to the axis of a sidewalk, in metres."""
_TO_WALK_M: Final = 5.0
"""Largest distance from the end of a crossing to a sidewalk, in metres."""
_NEAR_END_M: Final = 3.0
"""Distance from the end of a piece up to which a crossing joins its node, in metres."""
_ROAD_END_M: Final = 6.0
"""Least distance of a crossing from the end of a road, in metres."""
_ON_ROAD_M2: Final = 0.5
_BESIDE_M: Final = 0.3
"""Gap between a crossing and its road that is closed, in metres."""
_KERB_M: Final = 0.8
"""Depth of the corner between a curb and the link to its sidewalk, in metres."""
_OPTIONS: Final = (
    "--walkingareas",
    "--no-turnarounds.except-deadend",
    "--offset.disable-normalization",
)
_ROUNDS: Final = 12
"""Largest number of rounds in which lanes are narrowed."""
_NARROWING: Final = 0.85
_OUTSIDE_M: Final = 0.05
"""Distance from the ground up to which lanes are inside, in metres."""
_STRIPE_M: Final = 0.7
"""Least width of a narrowed lane, in metres: one stripe of SUMO's pedestrians."""
_RADII_M: Final = (0.5, 1.5, 3.0)
"""Radii of junctions, in metres, of which the first is taken that keeps all crossings."""


@dataclass(slots=True)
class _Edge:
    """Edge of the net.

    drive: whether it is a road.
    cars: whether cars use the road.
    """

    start: int
    end: int
    line: Floats
    clear_m: float
    lane_m: float
    drive: bool = False
    cars: bool = True


@dataclass(slots=True)
class _Zebra:
    """Crossing at a node.

    number: of its area.
    line: from curb to curb, (2, 2) metres.
    turned: whether netconvert takes the line the other way than most.
    """

    number: int
    node: int
    line: Floats
    lane_m: float
    turned: bool = False

    @property
    def outline(self) -> Floats:
        """Outline of its node, with corners before the curbs, (4, 2) metres."""
        along = (self.line[1] - self.line[0]) / np.hypot(*(self.line[1] - self.line[0]))
        aside = np.array([-along[1], along[0]]) * (0.5 * self.lane_m + INNER_M)
        start, end = self.line[0] - _KERB_M * along, self.line[1] + _KERB_M * along
        return np.array([start - aside, end - aside, end + aside, start + aside])

    @property
    def id(self) -> str:
        return f":n{self.node}_c0"


class _NoCrossing(Exception):
    """A crossing that does not fit on its road.

    number: of its area.
    """

    def __init__(self, number: int, reason: str) -> None:
        super().__init__(reason)
        self.number = number


@dataclass(slots=True)
class _Plan:
    nodes: list[Floats] = field(default_factory=list)
    edges: list[_Edge] = field(default_factory=list)
    zebras: list[_Zebra] = field(default_factory=list)
    findings: list[str] = field(default_factory=list)

    def node(self, xy: Floats) -> int:
        self.nodes.append(np.asarray(xy, dtype=float))
        return len(self.nodes) - 1


class ScanNet(NamedTuple):
    """Built net.

    findings: a sentence each
    inner_iou: of SUMO's lanes and the drawn ground.
    """

    path: Path
    findings: tuple[str, ...]
    inner_iou: float


def build_scan_net(
    areas: Sequence[ScanArea],
    heights: HeightGrid,
    georeference: Georeference | None,
    folder: Path,
    progress: Progress = ignore,
) -> ScanNet:
    """Build `net.xml` and the shares of the drawn ground in `folder`, and start SUMO on the net.

    georeference: decides on which side people drive; on the right without it.

    Raises MapError if nothing is walkable or netconvert or SUMO refuses the net.
    """
    progress("finding the walkable ground")
    ground = walkable_ground(areas, heights)
    progress("building the net")
    plan, path, street_map = _fitted(areas, ground, georeference, folder)
    findings = [*plan.findings, *_checked(plan, street_map)]
    progress("starting SUMO on the net")
    start_net(path, str(path))
    walks = {f"w{i}": edge for i, edge in enumerate(plan.edges) if not edge.drive}
    narrow = tuple(name for name, edge in walks.items() if edge.clear_m < CROWD_M)
    widths_m = {name: round(edge.clear_m, 3) for name, edge in walks.items()}
    write_ground(drawn_ground(street_map, ground, widths_m, narrow), folder / GROUND_FILE)
    if narrow:
        line = walks[narrow[0]].line
        x, y = line[len(line) // 2].tolist()
        findings.append(
            f"net: {len(narrow)} of {len(walks)} pieces of the walking net are narrower than "
            f"{CROWD_M:g} m, one of them at ({x:.1f}, {y:.1f}): robots may use them, the crowd "
            "does not"
        )
    iou, outside = _agreement(street_map, ground)
    findings.append(
        f"net: {ground.area:.0f} m2 are walkable; SUMO's lanes and corners agree with them by "
        f"{iou:.0%} (intersection over union), {outside:.1%} of the lanes are outside"
    )
    return ScanNet(path, tuple(findings), iou)


def _fitted(
    areas: Sequence[ScanArea],
    ground: Polygon | MultiPolygon,
    georeference: Georeference | None,
    folder: Path,
) -> tuple[_Plan, Path, StreetMap]:
    """Build the net, without crossings that do not fit, and with lanes inside of the ground."""
    plain: dict[int, str] = {}
    while True:
        plan = _planned(areas, ground, plain)
        path, street_map = _built(plan, georeference, folder)
        lacking = [zebra for zebra in plan.zebras if zebra.id not in street_map.strips]
        if not lacking:
            break
        plain |= {zebra.number: "netconvert refuses it" for zebra in lacking}
    for _ in range(_ROUNDS):
        if not _narrowed(plan, street_map, ground):
            break
        path, street_map = _built(plan, georeference, folder)
    return plan, path, street_map


def _agreement(street_map: StreetMap, ground: Polygon | MultiPolygon) -> tuple[float, float]:
    """Return the intersection over union of SUMO's lanes and the ground, and the share of the lanes
    outside."""
    strips, corners = street_map.strips.values(), street_map.corners.values()
    lanes = overlay.union_all([s.polygon for s in strips] + [c.polygon for c in corners])
    both = float(shapely.intersection(lanes, ground).area)
    return both / (lanes.area + ground.area - both), max(0.0, 1.0 - both / lanes.area)


def _planned(
    areas: Sequence[ScanArea], ground: Polygon | MultiPolygon, plain: dict[int, str]
) -> _Plan:
    """Return the plan of a net. Crossings that do not fit are added to `plain`.

    plain: reason for each crossing that is only walkable ground, by the number of its area.
    """
    while True:
        try:
            return _plan(areas, ground, plain)
        except _NoCrossing as error:
            plain[error.number] = str(error)


def _plan(
    areas: Sequence[ScanArea], ground: Polygon | MultiPolygon, plain: Mapping[int, str]
) -> _Plan:
    roads = overlay.union_all([area.polygon for area in areas if area.kind == "road"])
    walks = overlay.union_all([a.polygon for a in areas if a.kind in WALKED - {"crossing"}])
    over = {
        number: overlay.difference(area.polygon, walks)
        for number, area in enumerate(areas)
        if area.kind == "crossing"
        and number not in plain
        and shapely.intersection(area.polygon.buffer(_BESIDE_M), roads).area > _ON_ROAD_M2
    }
    axis = medial_axis(overlay.difference(ground, overlay.union_all([*over.values()])))
    if not axis.pieces:
        raise MapError("the walkable ground is nowhere wide enough to walk: draw wider areas")
    plan = _Plan(list(axis.nodes))
    for piece in axis.pieces:
        ends = (piece.start, piece.end)
        plan.edges.append(_Edge(*ends, piece.line, piece.clear_m, _inner(piece.clear_m)))
    if not roads.is_empty:
        # Roads may be drawn up to a crossing, or below it.
        joined = overlay.union_all([roads, *over.values()])
        joined = shapely.buffer(overlay.grown(joined, _BESIDE_M), -_BESIDE_M, quad_segs=4)
        _add_roads(plan, medial_axis(joined, whole=True))
        for number, crossing in over.items():
            _add_crossing(plan, number, crossing, joined, walks)
    for number, reason in plain.items():
        at = areas[number].polygon.centroid
        plan.findings.append(
            f"net: crossing near ({at.x:.1f}, {at.y:.1f}): cars do not stop there: {reason}"
        )
    return plan


def _add_roads(plan: _Plan, axis: Axis) -> None:
    first = len(plan.nodes)
    plan.nodes += list(axis.nodes)
    for piece in axis.pieces:
        ends = (first + piece.start, first + piece.end)
        lane_m = piece.clear_m - INNER_M
        plan.edges.append(_Edge(*ends, piece.line, piece.clear_m, lane_m, drive=True))


def _inner(clear_m: float) -> float:
    return max(clear_m - INNER_M, _MIN_LANE_M)


def _add_crossing(
    plan: _Plan,
    number: int,
    crossing: Polygon | MultiPolygon,
    roads: shapely.Geometry,
    walks: shapely.Geometry,
) -> None:
    """Add a crossing, with links to the sidewalks on both sides.

    Where no drawn road leads straight over it, such as next to a junction, it gets a piece of road
    of its own, and no cars drive there.

    Raises _NoCrossing if it does not lead from sidewalk to sidewalk.
    """
    span = _span(crossing, roads, walks)
    if span is None:
        raise _NoCrossing(number, "it does not lead from one side of its road to the other")
    road = _road_over(plan, span)
    if road is None:
        for edge in plan.edges:
            if edge.drive and shapely.intersects(LineString(edge.line), crossing):
                edge.cars = False  # they would not stop for people
        across = np.array([-span.along[1], span.along[0]]) * _ROAD_END_M
        road = _stub(plan, np.array([span.middle - across, span.middle + across]), span)
    node = _split(plan, road, span.middle, _ROAD_END_M)
    if node is None:
        raise _NoCrossing(number, f"its road is shorter than {2.0 * _ROAD_END_M:g} m")
    lane_m = _inner(span.width_m - INNER_M)
    plan.zebras.append(_Zebra(number, node, span.ends, lane_m))
    for end, outward in ((span.ends[0], -span.along), (span.ends[1], span.along)):
        meets = _joint(plan, end, outward)
        joint = None if meets is None else _split(plan, *meets, _NEAR_END_M)
        if joint is None:
            raise _NoCrossing(number, "it joins no sidewalk at one end: draw one there")
        line = np.vstack([plan.nodes[joint], end + _KERB_M * outward, span.middle])
        plan.edges.append(_Edge(joint, node, line, span.width_m, lane_m))


class _Span(NamedTuple):
    """Crossing of a road.

    middle: (2,) metres.
    along: (2,) unit vector across the road.
    ends: (2, 2) from curb to curb, metres.
    """

    middle: Floats
    along: Floats
    ends: Floats
    width_m: float


def _span(
    crossing: Polygon | MultiPolygon, roads: shapely.Geometry, walks: shapely.Geometry
) -> _Span | None:
    """Return the span of a crossing, along that of its axes whose ends are nearest to sidewalks."""
    corners = shapely.get_coordinates(
        shapely.minimum_rotated_rectangle(shapely.intersection(crossing, roads))
    )[:4]
    middle = corners.mean(axis=0)
    sides = [corners[1] - corners[0], corners[2] - corners[1]]
    lengths_m = [float(np.hypot(*side)) for side in sides]
    found = []
    for k, side in enumerate(sides):
        along = side / lengths_m[k]
        ray = LineString([middle - _JOIN_M * along, middle + _JOIN_M * along])
        kerbs = shapely.get_coordinates(shapely.intersection(ray, shapely.boundary(roads)))
        reach = (kerbs - middle) @ along
        low = float(reach[reach < 0.0].max(initial=-math.inf))
        high = float(reach[reach > 0.0].min(initial=math.inf))
        if not (math.isfinite(low) and math.isfinite(high)):
            continue
        ends = np.array([middle + low * along, middle + high * along])
        gap_m = max(float(shapely.distance(walks, shapely.Point(end))) for end in ends)
        if gap_m < _TO_WALK_M:
            found.append((gap_m, k, _Span(middle, along, ends, lengths_m[1 - k])))
    return min(found, key=lambda one: one[:2])[2] if found else None


def _road_over(plan: _Plan, span: _Span) -> _Edge | None:
    """Return the road that leads straight over a crossing, if one is long enough."""
    road, gap_m = _nearest(plan, shapely.Point(span.middle), drive=True)
    if road is None or gap_m > 0.5 * float(np.hypot(*(span.ends[1] - span.ends[0]))):
        return None
    line = Polyline(road.line)
    s_m = line.project(*span.middle.tolist())[0]
    heading_rad = line.at(s_m).heading_rad
    aligned = abs(math.cos(heading_rad) * span.along[0] + math.sin(heading_rad) * span.along[1])
    fits = _ROAD_END_M <= s_m <= line.length_m - _ROAD_END_M
    return road if fits and aligned < math.sqrt(0.5) else None


def _stub(plan: _Plan, line: Floats, span: _Span) -> _Edge:
    """Add a piece of road without cars."""
    start, end = (plan.node(xy) for xy in line)
    clear_m = float(np.hypot(*(span.ends[1] - span.ends[0])))
    edge = _Edge(start, end, line, clear_m, clear_m - INNER_M, drive=True, cars=False)
    plan.edges.append(edge)
    return edge


def _nearest(plan: _Plan, point: shapely.Point, *, drive: bool) -> tuple[_Edge | None, float]:
    """Return the nearest road or walk, and its distance in metres."""
    found = [
        (float(LineString(edge.line).distance(point)), i)
        for i, edge in enumerate(plan.edges)
        if edge.drive == drive
    ]
    if not found:
        return None, math.inf
    gap_m, i = min(found)
    return plan.edges[i], gap_m


def _joint(plan: _Plan, end: Floats, outward: Floats) -> tuple[_Edge, Floats] | None:
    """Return the walk that a crossing joins straight on, else the nearest one, and the place."""
    ray = LineString([end, end + _JOIN_M * outward])
    hits = [
        (float(np.hypot(*(xy - end))), i, xy)
        for i, edge in enumerate(plan.edges)
        if not edge.drive
        for xy in shapely.get_coordinates(shapely.intersection(ray, LineString(edge.line)))
    ]
    if hits:
        _, i, xy = min(hits, key=lambda hit: hit[:2])
        return plan.edges[i], xy
    edge, gap_m = _nearest(plan, shapely.Point(end + outward), drive=False)
    if edge is None or gap_m > _JOIN_M:
        return None
    line = Polyline(edge.line)
    return edge, line.at(line.project(*(end + outward).tolist())[0]).xy


def _split(plan: _Plan, edge: _Edge, at: Floats, near_m: float) -> int | None:
    """Return the node of an edge at a place: one of its ends if near, else a new one.

    Roads are split at a distance from their ends; None if they are too short.
    """
    line = Polyline(edge.line)
    s_m = line.project(*np.asarray(at).tolist())[0]
    if edge.drive:
        if line.length_m < 2.0 * near_m:
            return None
        s_m = min(max(s_m, near_m), line.length_m - near_m)
    elif s_m < near_m or s_m > line.length_m - near_m:
        return edge.start if s_m < 0.5 * line.length_m else edge.end
    node = plan.node(line.at(s_m).xy)
    rest = replace(edge, start=node, line=between(edge.line, s_m, line.length_m))
    edge.end, edge.line = node, between(edge.line, 0.0, s_m)
    plan.edges.append(rest)
    return node


def _converted(
    plan: _Plan, georeference: Georeference | None, folder: Path, radius_m: float
) -> Path:
    """Write the plan as plain XML and build the net."""
    left = georeference is not None and bool(
        left_hand_country(georeference.longitude_deg, georeference.latitude_deg)
    )
    # netconvert mirrors left-hand nets, but not the outlines of their nodes.
    outlines = {} if left else {zebra.node: zebra.outline for zebra in plan.zebras}
    nodes = [
        f'<node id="n{i}" x="{xy[0]:.3f}" y="{xy[1]:.3f}" type="priority"'
        + (f' shape="{_shape(outlines[i])}"' if i in outlines else "")
        + "/>"
        for i, xy in enumerate(plan.nodes)
    ]
    edges = [row for i, edge in enumerate(plan.edges) for row in _rows(i, edge)]
    zebras = []
    for zebra in plan.zebras:
        arm = next(
            i for i, e in enumerate(plan.edges) if e.drive and zebra.node in (e.start, e.end)
        )
        both = [f"r{arm}"] + ([f"-r{arm}"] if _two_way(plan.edges[arm]) else [])
        zebras.append(
            f'<crossing node="n{zebra.node}" edges="{" ".join(both)}" '
            f'width="{zebra.lane_m:.2f}" priority="true" '
            f'shape="{_shape(_clockwise(zebra, plan.edges[arm], left))}"/>'
        )
    files = {"nodes": nodes, "edges": edges, "connections": zebras}
    paths = {}
    for tag, rows in files.items():
        paths[tag] = folder / f"plain.{tag}.xml"
        paths[tag].write_text(f"<{tag}>\n" + "\n".join(rows) + f"\n</{tag}>\n")
    arguments = ["-n", str(paths["nodes"]), "-e", str(paths["edges"]), "-x"]
    arguments += [str(paths["connections"]), *_OPTIONS, *(["--lefthand"] if left else [])]
    arguments.append(f"--default.junctions.radius={radius_m}")
    try:
        return netconvert(arguments, folder / "net.xml")
    finally:
        for plain in paths.values():
            plain.unlink()


def _clockwise(zebra: _Zebra, road: _Edge, left: bool) -> Floats:
    """Return a crossing's line as netconvert expects it: from the right of a road that leaves its
    node, or from the left where people drive there."""
    line = Polyline(road.line)
    away_m = min(3.0, line.length_m)
    at = line.at(away_m) if road.start == zebra.node else line.at(line.length_m - away_m)
    out = at.xy - zebra.line.mean(axis=0)
    right = np.array([out[1], -out[0]])
    from_right = float((zebra.line[0] - zebra.line[1]) @ right) > 0.0
    return zebra.line if from_right != (left != zebra.turned) else zebra.line[::-1]


def _built(plan: _Plan, georeference: Georeference | None, folder: Path) -> tuple[Path, StreetMap]:
    """Build the net with the first radius of junctions that keeps all crossings."""
    for radius_m in _RADII_M:
        path = _converted(plan, georeference, folder, radius_m)
        street_map = read_net(path)
        if backwards := [zebra for zebra in plan.zebras if _is_backwards(zebra, street_map)]:
            for zebra in backwards:
                zebra.turned = not zebra.turned
            path = _converted(plan, georeference, folder, radius_m)
            street_map = read_net(path)
        if all(zebra.id in street_map.strips for zebra in plan.zebras):
            break
    return path, street_map


def _is_backwards(zebra: _Zebra, street_map: StreetMap) -> bool:
    """Return whether the first corner of a built crossing is at its far end."""
    strip = street_map.strips.get(zebra.id)
    if strip is None or strip.corners[0] is None:
        return False
    corner = street_map.corners[strip.corners[0]]
    ends = [
        street_map.strips[port.strip].line[0 if port.end == 0 else -1, :2]
        for port in corner.ports
        if port.strip != zebra.id
    ]
    if not ends:
        return False
    to_first, to_last = (np.hypot(*(np.array(ends) - strip.line[i, :2]).T).min() for i in (0, -1))
    return bool(to_first > to_last)


def _narrowed(plan: _Plan, street_map: StreetMap, ground: Polygon | MultiPolygon) -> bool:
    """Narrow the lanes on which people would leave the ground. Returns whether any was."""
    inside = shapely.buffer(ground, _OUTSIDE_M)
    shapely.prepare(inside)
    wide = {name for name, s in street_map.strips.items() if not inside.covers(_lane_band(s))}
    for corner in street_map.corners.values():
        for one, other in combinations(dict.fromkeys(corner.ports), 2):
            mouths = [_mouth(street_map.strips[port.strip], port) for port in (one, other)]
            if not inside.covers(shapely.MultiPoint(np.vstack(mouths)).convex_hull):
                wide |= {one.strip, other.strip}
    changed = False
    lanes: dict[str, _Edge | _Zebra] = {f"w{i}": edge for i, edge in enumerate(plan.edges)}
    for zebra in plan.zebras:
        lanes[zebra.id] = zebra
    for name in sorted(wide):
        lane_m = max(_NARROWING * lanes[name].lane_m, min(_STRIPE_M, lanes[name].lane_m))
        changed |= lane_m < lanes[name].lane_m
        lanes[name].lane_m = lane_m
    return changed


def _lane_band(strip: Strip) -> shapely.Geometry:
    return shapely.buffer(
        LineString(strip.line[:, :2]), 0.5 * strip.width_m, cap_style="flat", join_style="mitre"
    )


def _mouth(strip: Strip, port: Port) -> Floats:
    """Return both sides of the end of a lane, (2, 2) metres."""
    end, inner = strip.line[[0, 1], :2] if port.end == 0 else strip.line[[-1, -2], :2]
    along = (end - inner) / max(float(np.hypot(*(end - inner))), 1e-9)
    aside = 0.5 * strip.width_m * np.array([-along[1], along[0]])
    return np.array([end + aside, end - aside])


def _two_way(edge: _Edge) -> bool:
    return edge.lane_m + INNER_M >= _TWO_WAY_M


def _rows(number: int, edge: _Edge) -> list[str]:
    """Return the XML of an edge: a walk, or a road with a lane in one or both directions."""
    if not edge.drive:
        return [_row(f"w{number}", edge.start, edge.end, edge.line, edge.lane_m, "pedestrian")]
    allowed = "passenger" if edge.cars else "custom1"
    if not _two_way(edge):
        return [_row(f"r{number}", edge.start, edge.end, edge.line, edge.lane_m, allowed)]
    half_m = 0.5 * edge.lane_m
    return [
        _row(f"r{number}", edge.start, edge.end, edge.line, half_m, allowed, "right"),
        _row(f"-r{number}", edge.end, edge.start, edge.line[::-1], half_m, allowed, "right"),
    ]


def _row(
    name: str,
    start: int,
    end: int,
    line: Floats,
    lane_m: float,
    allowed: str,
    spread: str = "center",
) -> str:
    speed_mps = _WALK_MPS if allowed == "pedestrian" else _LANE_MPS
    return (
        f'<edge id={quoteattr(name)} from="n{start}" to="n{end}" numLanes="1" type="scan" '
        f'speed="{speed_mps}" width="{lane_m:.2f}" allow="{allowed}" spreadType="{spread}" '
        f'shape="{_shape(line)}"/>'
    )


def _shape(line: Floats) -> str:
    return " ".join(f"{x:.3f},{y:.3f}" for x, y in line.tolist())


def _checked(plan: _Plan, street_map: StreetMap) -> list[str]:
    """Return findings on a built net. Raises MapError if it lacks pieces or connections."""
    wanted = [f"w{i}" for i, edge in enumerate(plan.edges) if not edge.drive]
    if missing := [name for name in wanted if name not in street_map.strips]:
        raise MapError(f"netconvert left out {len(missing)} walks of {len(wanted)}: {missing[0]}")
    parts = len(set(WalkGraph(street_map).component.tolist()))
    if parts == 1:
        return []
    return [f"net: the walkable ground is in {parts} separate parts: scenarios use the largest"]
