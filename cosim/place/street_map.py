"""StreetMap: what a place is. Walkable strips and corners, crossings and their signals, roads,
zones.

Every place, generated or imported, is read from a SUMO net into this one value; ground, buildings,
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
"""Gaps up to twice this between neighbouring walkable pieces count as closed."""


class Port(NamedTuple):
    """One end of a walkable strip: 0 where its line starts, 1 where it ends."""

    strip: str
    end: Literal[0, 1]

    @property
    def other(self) -> Port:
        """The other end of the same strip."""
        return Port(self.strip, 1 if self.end == 0 else 0)


@dataclass(frozen=True, slots=True)
class SignalPlan:
    """A crossing's signal that goes by the clock alone: phase after phase, and again from the
    first.

    The first one begins at offset_ms, in milliseconds of SUMO's time. durations_ms: of the phases;
    walks: whether one may walk in each.
    """

    offset_ms: int
    durations_ms: tuple[int, ...]
    walks: tuple[bool, ...]


@dataclass(frozen=True, slots=True)
class Strip:
    """A sidewalk or a crossing: a band of `width_m` around `line`, (N, 2) metres.

    id: SUMO edge id. corners: ids of the corners at either end, None at a dead end. signalised and
    crosses (ids of the road edges crossed) are for crossings; frontage_m, curb_m (width of curb and
    gutter), verge_m and street_class for sidewalks. road_side: +1 when the road lies left of
    `line`, -1 right, 0 when there is none. driveways: arc lengths of `line`, in metres, where a
    driveway's middle crosses the sidewalk. going: plain ground, steps, or a bridge or tunnel, which
    share their place on the map with what lies below or above. plan: of a crossing's signal; None
    where there is no signal, or where SUMO alone can tell what it shows.
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

    @property
    def length_m(self) -> float:
        return float(np.hypot(*np.diff(self.line, axis=0).T).sum())


@dataclass(frozen=True, slots=True)
class Corner:
    """A walking area: the polygon where strips meet, and their ports."""

    id: str
    polygon: Polygon | MultiPolygon
    ports: tuple[Port, ...]


@dataclass(frozen=True, slots=True)
class Lane:
    """A lane that is not for walking. kind "road": driven on; "verge": between road and sidewalk.

    internal: part of a junction's interior. cars: whether cars may drive on it, and not only
    bicycles or trams.
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
    """The outline of a junction, its corners included."""

    id: str
    polygon: Polygon
    signalised: bool


LandKind = Literal["lawn", "planting", "soil", "yard", "water"]
"""What open land is covered with. yard: land to park, drive or work on, such as a parking lot."""
LANDS: Final[tuple[LandKind, ...]] = get_args(LandKind)
FeatureKind = (
    Literal["building", "tree", "lamp", "bench", "bollard", "bin", "hydrant", "rack"] | LandKind
)


@dataclass(frozen=True, slots=True)
class Feature:
    """A building, a thing on the street or a piece of land that the map itself shows.

    x_m, y_m: its middle. heading_rad: along it, what it serves or faces to its left (the arm of a
    lamp) or right (who sits on a bench, the front of a building). height_m: 0 where the map does
    not say. polygon: the ground of a building or a piece of land; empty for the others.
    """

    kind: FeatureKind
    x_m: float
    y_m: float
    heading_rad: float = 0.0
    height_m: float = 0.0
    polygon: Polygon = field(default_factory=Polygon)


class Located(NamedTuple):
    """Where a point is: on a walkable piece, on a lane, or off both; edge: the SUMO edge there."""

    kind: Literal["walk", "road", "off"]
    edge: str


PieceKind = Literal["strip", "corner", "lane", "junction"]
_Piece = Strip | Corner | Lane | Junction


@dataclass(frozen=True, eq=False)
class StreetMap:
    """A place. All ids are SUMO edge, lane or junction ids; the mappings are in the net's order.

    bounds: x0, y0, x1, y1 in metres. net_hash: content hash of the net it was read from, and of the
    features where there are any. features: what the map shows beside its streets; none of it stands
    in the way. terrain: None where the place is flat; elevation: what became of the net's
    elevations, None when it has none. planned: a generated city: its net names the class of each of
    its streets.
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
    _trees: dict[str, tuple[shapely.STRtree, tuple[_Piece, ...]]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )
    """Made when they are first asked for; a map that is changed makes its own."""
    _made_of: str = field(default="", init=False, repr=False, compare=False)

    @property
    def made_of(self) -> str:
        """A hash of all that it was read from, and of what read it; "" where it is made by hand or
        of another one."""
        return self._made_of

    def read_of(self, made_of: str) -> Self:
        """This map, told its `made_of` by who read it."""
        object.__setattr__(self, "_made_of", made_of)
        return self

    @cached_property
    def signals_by_the_clock(self) -> bool:
        """Whether all signals of crossings have a plan."""
        return all(strip.plan is not None for strip in self.strips.values() if strip.signalised)

    @cached_property
    def too_steep(self) -> frozenset[Port]:
        """Ports that no robot is sent past because the land is too steep there; people pass."""
        whole = {port for strip in self.steep for port in (Port(strip, 0), Port(strip, 1))}
        closed = self.elevation.closed if self.elevation is not None else ()
        return frozenset(whole | {Port(strip, 1 if end else 0) for strip, end in closed})

    @cached_property
    def steep(self) -> frozenset[str]:
        """Strips that no robot is sent over because the land is too steep there."""
        return frozenset(self.elevation.steep if self.elevation is not None else ())

    def near(self, kind: PieceKind, area: shapely.Geometry) -> list[_Piece]:
        """Pieces of `kind` whose polygon touches `area`, in the net's order."""
        tree, pieces = self._tree(kind)
        return [pieces[i] for i in np.sort(tree.query(area, predicate="intersects"))]

    def lands_near(self, area: shapely.Geometry) -> list[Feature]:
        """Pieces of land that the map shows and that touch `area`, the smallest first."""
        tree, lands = self._lands
        return sorted(
            (lands[i] for i in np.sort(tree.query(area, "intersects"))),
            key=lambda land: land.polygon.area,
        )

    def houses_near(self, area: shapely.Geometry) -> list[Feature]:
        """Buildings that the map shows and that touch `area`, in its order."""
        tree, houses = self._houses
        return [houses[i] for i in np.sort(tree.query(area, "intersects"))]

    @cached_property
    def _lands(self) -> tuple[shapely.STRtree, tuple[Feature, ...]]:
        return _by_place(feature for feature in self.features if feature.kind in LANDS)

    @cached_property
    def _houses(self) -> tuple[shapely.STRtree, tuple[Feature, ...]]:
        return _by_place(feature for feature in self.features if feature.kind == "building")

    def walkable_near(self, area: shapely.Geometry) -> Polygon | MultiPolygon:
        """Union of the walkable pieces that touch `area`; seams closed. Raises MapError when there
        are none."""
        polygons = [piece.polygon for piece in self.near("strip", area) + self.near("corner", area)]
        if not polygons:
            raise MapError(
                f"nothing walkable near {shapely.centroid(area).wkt} on map '{self.name}'"
            )
        return union_closed(polygons)

    @cached_property
    def walkable(self) -> Polygon | MultiPolygon:
        """Union of every walkable piece. Seconds on a large map: prefer `walkable_near`."""
        strips, corners = self.strips.values(), self.corners.values()
        return union_closed([s.polygon for s in strips] + [c.polygon for c in corners])

    def locate(self, x_m: float, y_m: float, slack_m: float = 0.8) -> Located:
        """The walkable piece at a point (up to `slack_m` beside it), else the lane there, else
        "off"."""
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


def _by_place(features: Iterable[Feature]) -> tuple[shapely.STRtree, tuple[Feature, ...]]:
    held = tuple(features)
    return shapely.STRtree([feature.polygon for feature in held]), held


def street_of(edge: str) -> str:
    """What the two directions and the pieces of a street have in common: `-s12b` and `s12a` are
    s12, `-7#2` is 7."""
    return re.sub(r"(#-?\d+|(?<=\d)[a-d])$", "", edge.removeprefix("-"))


def union_closed(polygons: Sequence[shapely.Geometry]) -> Polygon | MultiPolygon:
    """Union of polygons, with gaps up to 2 x SEAM_M between them closed."""
    grown = shapely.buffer(np.asarray(polygons, dtype=object), SEAM_M, join_style="mitre")
    closed = shapely.buffer(overlay.union_all(grown), -SEAM_M, join_style="mitre")
    # Slivers of foreign nets can make the mitred outline cross itself.
    if closed.is_valid:
        return closed
    return shapely.make_valid(closed, method="structure", keep_collapsed=False)  # type: ignore[return-value]


class WalkableArea:
    """Fast tests of points against a walkable polygon."""

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
        """Distance of (N, 2) points to the edge of the area in metres, positive inside."""
        xy = np.asarray(xy, dtype=float).reshape(-1, 2)
        inside: NDArray[np.bool_] = shapely.contains_xy(self.polygon, xy[:, 0], xy[:, 1])
        if not len(self._sides):
            return np.full(len(xy), -np.inf)
        _, gap = self._sides.query_nearest(
            shapely.points(xy), return_distance=True, all_matches=False
        )
        return np.where(inside, gap, -gap)
