"""StreetMap: a place with walkable strips and corners, crossings, signals, roads and zones.

Every place, generated or imported, is read from a SUMO net into a StreetMap. Ground, buildings,
routes, crowd and the referee's walkable area derive from it.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final, Literal, NamedTuple, Self, get_args

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray
from shapely.geometry import MultiPolygon, Polygon

from cosim.core.errors import MapError
from cosim.core.geometry import Floats
from cosim.place import overlay
from cosim.place.terrain import Elevation, Terrain

SEAM_M = 0.05
"""Margin in metres by which walkable pieces are grown to close gaps; gaps up to twice this close.
"""


class Port(NamedTuple):
    """One end of a walkable strip: 0 at the start of its line, 1 at the end."""

    strip: str
    end: Literal[0, 1]

    @property
    def other(self) -> Port:
        """Other end of the same strip."""
        return Port(self.strip, 1 if self.end == 0 else 0)


def ports_of(strips: Iterable[str]) -> frozenset[Port]:
    """Return both ends of each strip."""
    return frozenset(port for strip in strips for port in (Port(strip, 0), Port(strip, 1)))


@dataclass(frozen=True, slots=True)
class SignalPlan:
    """Fixed-time program of a crossing's signal, repeated after the last phase.

    offset_ms: start of the first phase in SUMO's time.
    durations_ms: durations of the phases.
    walks: whether pedestrians may walk in each phase.
    """

    offset_ms: int
    durations_ms: tuple[int, ...]
    walks: tuple[bool, ...]


@dataclass(frozen=True, slots=True)
class Strip:
    """Sidewalk or crossing: a band of `width_m` around `line`, (N, 2) metres.

    id: SUMO edge id.
    corners: ids of the corners at both ends, None at a dead end.
    signalised: whether a crossing has a signal.
    crosses: ids of the road edges that a crossing crosses.
    frontage_m, curb_m, verge_m, street_class: properties of sidewalks; curb_m is the width of curb
        and gutter.
    road_side: +1 if the road is left of `line`, -1 right, 0 without a road.
    driveways: arc lengths of `line` at which driveways cross the sidewalk, in metres.
    going: surface. Bridges and tunnels share their place on the map with another level.
    plan: program of a crossing's signal; None without a signal, or if only SUMO knows its state.
    short_green: whether a signal without a plan has a green too short to walk.
    """

    id: str
    kind: Literal["sidewalk", "crossing"]
    line: Floats
    width_m: float
    polygon: Polygon
    corners: tuple[str | None, str | None]
    signalised: bool = False
    crosses: tuple[str, ...] = ()
    street_class: str = ""
    frontage_m: float = 2.0
    curb_m: float = 0.3
    verge_m: float = 0.0
    road_side: int = 1
    driveways: tuple[float, ...] = ()
    going: Literal["plain", "steps", "bridge"] = "plain"
    plan: SignalPlan | None = None
    short_green: bool = False

    @property
    def length_m(self) -> float:
        return float(np.hypot(*np.diff(self.line, axis=0).T).sum())


@dataclass(frozen=True, slots=True)
class Corner:
    """Walking area where strips meet, with their ports."""

    id: str
    polygon: Polygon | MultiPolygon
    ports: tuple[Port, ...]


@dataclass(frozen=True, slots=True)
class Lane:
    """Lane that is not for walking.

    kind: "road" for traffic; "verge" between road and sidewalk.
    internal: whether it is inside a junction.
    cars: whether cars may use it, and not only bicycles or trams.
    """

    id: str
    edge: str
    kind: Literal["road", "verge"]
    line: Floats
    width_m: float
    polygon: Polygon
    internal: bool = False
    cars: bool = True


@dataclass(frozen=True, slots=True)
class Junction:
    """Outline of a junction, with its corners."""

    id: str
    polygon: Polygon
    signalised: bool


LandKind = Literal["lawn", "planting", "soil", "yard", "water"]
"""Covers of open land. A yard is land to park, drive or work on, such as a parking lot."""
LAND_KINDS: Final[tuple[LandKind, ...]] = get_args(LandKind)
"""All covers of open land."""
FeatureKind = (
    Literal["building", "tree", "lamp", "bench", "bollard", "bin", "hydrant", "rack"] | LandKind
)
"""Kinds of mapped features."""


@dataclass(frozen=True, slots=True)
class Feature:
    """Building, street object or piece of land of the map.

    x_m, y_m: its middle.
    heading_rad: direction along it. The street is to the left of a lamp, and to the right of a
        bench or a building.
    height_m: 0 if unknown.
    polygon: footprint of a building or a piece of land; empty for the others.
    """

    kind: FeatureKind
    x_m: float
    y_m: float
    heading_rad: float = 0.0
    height_m: float = 0.0
    polygon: Polygon = field(default_factory=Polygon)


class Located(NamedTuple):
    """Result of `StreetMap.locate`: kind of ground at a point, and its SUMO edge, "" if off."""

    kind: Literal["walk", "road", "off"]
    edge: str


PieceKind = Literal["strip", "corner", "lane", "junction"]
"""Kinds of pieces with a spatial index."""
_Piece = Strip | Corner | Lane | Junction


@dataclass(frozen=True, eq=False)
class StreetMap:
    """A place. Ids are SUMO edge, lane or junction ids; mappings are in the net's order.

    bounds: x0, y0, x1, y1 in metres.
    net_hash: content hash of the net, of its features, and of its scan, if any.
    features: mapped objects off the walkable area.
    terrain: None if the place is flat.
    elevation: how the net's elevations were processed, None without any.
    planned: whether it is a generated city, whose net names the class of each street.
    scanned: whether its ground and surroundings are a scan, whose edge is a dead end of the walks.
    uncrowded: strips that are too narrow for the crowd; robots may use them.
    """

    name: str
    bounds: tuple[float, float, float, float]
    strips: Mapping[str, Strip]
    corners: Mapping[str, Corner]
    lanes: Mapping[str, Lane]
    junctions: Mapping[str, Junction]
    net_hash: str = ""
    left_hand: bool = False
    features: tuple[Feature, ...] = ()
    terrain: Terrain | None = None
    elevation: Elevation | None = None
    planned: bool = False
    scanned: bool = False
    uncrowded: tuple[str, ...] = ()
    _trees: dict[str, tuple[shapely.STRtree, tuple[_Piece, ...]]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )
    """Spatial indexes, built on first use. A modified copy builds its own."""
    _input_hash: str = field(default="", init=False, repr=False, compare=False)

    @property
    def input_hash(self) -> str:
        """Hash of the map's inputs and of the code that read it; "" if built otherwise."""
        return self._input_hash

    def with_input_hash(self, input_hash: str) -> Self:
        """Set `input_hash` and return the map, for its reader."""
        object.__setattr__(self, "_input_hash", input_hash)
        return self

    @cached_property
    def signals_fixed_time(self) -> bool:
        """Whether all signals of crossings have a fixed-time program."""
        return all(strip.plan is not None for strip in self.strips.values() if strip.signalised)

    @cached_property
    def too_steep(self) -> frozenset[Port]:
        """Ports that robots must not pass because of the slope; people do."""
        whole = {port for strip in self.steep for port in (Port(strip, 0), Port(strip, 1))}
        closed = self.elevation.closed if self.elevation is not None else ()
        return frozenset(whole | {Port(strip, 1 if end else 0) for strip, end in closed})

    @cached_property
    def steep(self) -> frozenset[str]:
        """Strips that robots must not use because of the slope."""
        return frozenset(self.elevation.steep if self.elevation is not None else ())

    def near(self, kind: PieceKind, area: shapely.Geometry) -> list[_Piece]:
        """Return the pieces of a kind whose polygon intersects `area`, in the net's order."""
        tree, pieces = self._tree(kind)
        return [pieces[i] for i in np.sort(tree.query(area, predicate="intersects"))]

    def land_near(self, area: shapely.Geometry) -> list[Feature]:
        """Return the mapped land that intersects `area`, the smallest piece first."""
        tree, lands = self._lands
        return sorted(
            (lands[i] for i in np.sort(tree.query(area, "intersects"))),
            key=lambda land: land.polygon.area,
        )

    def houses_near(self, area: shapely.Geometry) -> list[Feature]:
        """Return the mapped buildings that intersect `area`, in the map's order."""
        tree, houses = self._houses
        return [houses[i] for i in np.sort(tree.query(area, "intersects"))]

    @cached_property
    def _lands(self) -> tuple[shapely.STRtree, tuple[Feature, ...]]:
        return _indexed(feature for feature in self.features if feature.kind in LAND_KINDS)

    @cached_property
    def _houses(self) -> tuple[shapely.STRtree, tuple[Feature, ...]]:
        return _indexed(feature for feature in self.features if feature.kind == "building")

    def walkable_near(self, area: shapely.Geometry) -> Polygon | MultiPolygon:
        """Return the union of the walkable pieces that intersect `area`, with seams closed.

        Raises MapError if there are none.
        """
        polygons = [piece.polygon for piece in self.near("strip", area) + self.near("corner", area)]
        if not polygons:
            raise MapError(
                f"nothing walkable near {shapely.centroid(area).wkt} on map '{self.name}'"
            )
        return union_closed(polygons)

    @cached_property
    def walkable(self) -> Polygon | MultiPolygon:
        """Union of all walkable pieces. It takes seconds on a large map; prefer `walkable_near`."""
        strips, corners = self.strips.values(), self.corners.values()
        return union_closed([s.polygon for s in strips] + [c.polygon for c in corners])

    def locate(self, x_m: float, y_m: float, slack_m: float = 0.8) -> Located:
        """Return the walkable piece at a point, else the lane, else "off".

        slack_m: distance up to which a walkable piece counts, in metres.
        """
        point = shapely.Point(x_m, y_m)
        best = ""
        best_gap = slack_m
        for kind in ("corner", "strip"):
            tree, pieces = self._tree(kind)
            for i in np.sort(tree.query(point, predicate="dwithin", distance=slack_m)):
                gap = float(shapely.distance(pieces[i].polygon, point))
                if gap < best_gap or (gap == 0.0 and not best):
                    best = pieces[i].id
                    best_gap = gap
                if gap == 0.0:
                    return Located("walk", pieces[i].id)
        tree, pieces = self._tree("lane")
        for i in np.sort(tree.query(point, predicate="intersects")):
            lane = pieces[i]
            if isinstance(lane, Lane) and lane.kind == "road":
                return Located("walk", best) if best else Located("road", lane.edge)
        return Located("walk", best) if best else Located("off", "")

    def _tree(self, kind: str) -> tuple[shapely.STRtree, tuple[_Piece, ...]]:
        if kind not in self._trees:
            of_kind: dict[str, tuple[_Piece, ...]] = {
                "strip": tuple(self.strips.values()),
                "corner": tuple(self.corners.values()),
                "lane": tuple(self.lanes.values()),
                "junction": tuple(self.junctions.values()),
            }
            pieces = of_kind[kind]
            self._trees[kind] = (shapely.STRtree([p.polygon for p in pieces]), pieces)
        return self._trees[kind]


def _indexed(features: Iterable[Feature]) -> tuple[shapely.STRtree, tuple[Feature, ...]]:
    held = tuple(features)
    return shapely.STRtree([feature.polygon for feature in held]), held


def street_of(edge: str) -> str:
    """Return the street of an edge: `-s12b` and `s12a` give s12, `-7#2` gives 7."""
    return re.sub(r"(#-?\d+|(?<=\d)[a-d])$", "", edge.removeprefix("-"))


def union_closed(polygons: Sequence[shapely.Geometry]) -> Polygon | MultiPolygon:
    """Return the union of polygons; gaps up to 2 x SEAM_M are closed."""
    grown = shapely.buffer(np.asarray(polygons, dtype=object), SEAM_M, join_style="mitre")
    closed = shapely.buffer(overlay.union_all(grown), -SEAM_M, join_style="mitre")
    if closed.is_valid:  # slivers of imported nets can make the mitred outline cross itself
        return closed
    return shapely.make_valid(closed, method="structure", keep_collapsed=False)  # type: ignore[return-value]


class WalkableArea:
    """Spatial index for point tests against a walkable polygon."""

    def __init__(self, polygon: Polygon | MultiPolygon) -> None:
        self.polygon = polygon
        shapely.prepare(polygon)
        rings = [
            shapely.get_coordinates(r)
            for part in shapely.get_parts(polygon)
            for r in shapely.get_rings(part)
        ]
        ends = np.concatenate(
            [np.empty((0, 2, 2)), *(np.stack([r[:-1], r[1:]], axis=1) for r in rings)]
        )
        self._sides = shapely.STRtree(np.asarray(shapely.linestrings(ends), dtype=object))

    def contains(self, x_m: float, y_m: float) -> bool:
        return bool(shapely.contains_xy(self.polygon, x_m, y_m))

    def signed_distance(self, xy: ArrayLike) -> Floats:
        """Return the distance of (N, 2) points to the area's edge in metres, positive inside."""
        xy = np.asarray(xy, dtype=float).reshape(-1, 2)
        inside: NDArray[np.bool_] = shapely.contains_xy(self.polygon, xy[:, 0], xy[:, 1])
        if not len(self._sides):
            return np.full(len(xy), -np.inf)
        _, gap = self._sides.query_nearest(
            shapely.points(xy), return_distance=True, all_matches=False
        )
        return np.where(inside, gap, -gap)
