"""Proxies of the robot and the event pedestrians in SUMO.

SUMO's persons and vehicles react to a proxy only if SUMO assigns its position to the lanes of its
walk. Most of this module chooses walks and positions for which that holds.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
import shapely
from shapely.geometry import LineString

from cosim.core.geometry import Circle, Floats, Pose, heading_to_sumo
from cosim.place.street_map import Located, StreetMap

if TYPE_CHECKING:
    from sumo_nets.engine import Sumo


_Segments = tuple[tuple[float, float, float, float, float], ...]
"""Straight pieces of lines: start x, y; direction x, y; length, in metres."""


def _distance_m(pieces: _Segments, x_m: float, y_m: float) -> float:
    """Return the distance of a point from the nearest of these pieces, metres."""
    least_m2 = math.inf
    for start_x, start_y, along_x, along_y, length_m in pieces:
        dx, dy = x_m - start_x, y_m - start_y
        along_m = dx * along_x + dy * along_y
        beyond_m = along_m if along_m < 0.0 else along_m - length_m if along_m > length_m else 0.0
        aside_m = dy * along_x - dx * along_y
        far_m2 = beyond_m * beyond_m + aside_m * aside_m
        if far_m2 < least_m2:
            least_m2 = far_m2
    return math.sqrt(least_m2)


class LocalLead(NamedTuple):
    """What `SidewalkLead.metres` compares within LOCAL_M of a point.

    own, others: pieces of the sidewalk's and of the other lanes' lines that are near.
    width_m: width of the sidewalk.
    """

    around: Circle
    own: _Segments
    others: _Segments
    width_m: float

    def metres(self, x_m: float, y_m: float) -> float:
        """Return the lead at a point, accurate to rounding."""
        own_m = _distance_m(self.own, x_m, y_m)
        return min(_distance_m(self.others, x_m, y_m) - own_m, self.width_m - 2.0 * own_m)


class SidewalkLead:
    """Distances by which a sidewalk is nearer than other lanes.

    internal: edges inside each junction.
    """

    def __init__(self, engine: Sumo, internal: Mapping[str, Iterable[str]]) -> None:
        self._engine = engine
        self._internal = internal
        self._lines: dict[tuple[str, str], tuple[shapely.Geometry, shapely.Geometry]] = {}
        self._pieces: dict[tuple[str, str], tuple[Floats, Floats]] = {}

    def metres(self, first: str, second: str, x_m: float, y_m: float) -> float:
        """Return by how much `first` is nearer to a point on it than any other lane that SUMO
        compares, metres.

        The walk is `first`, then `second`. The result is at most twice the distance to the
        sidewalk's sides, and negative where another lane is nearer. It changes by at most 2 m per
        metre.
        """
        at = shapely.points(x_m, y_m)
        sidewalk, rest = self._compared(first, second)
        own_m = float(shapely.distance(sidewalk, at))
        return min(float(shapely.distance(rest, at)) - own_m, self._width_m(first) - 2.0 * own_m)

    def around(self, first: str, second: str, x_m: float, y_m: float) -> LocalLead:
        """Return what is compared within LOCAL_M of a point."""
        if (first, second) not in self._pieces:
            own, rest = self._compared(first, second)
            self._pieces[first, second] = _pieces(own), _pieces(rest)
        own_pieces, others = self._pieces[first, second]
        return LocalLead(
            Circle(x_m, y_m, LOCAL_M),
            _pieces_near(own_pieces, x_m, y_m),
            _pieces_near(others, x_m, y_m),
            self._width_m(first),
        )

    def _compared(self, first: str, second: str) -> tuple[shapely.Geometry, shapely.Geometry]:
        """Return the line of the sidewalk, and those of the other lanes."""
        if (first, second) not in self._lines:
            inside = self._internal.get(self._engine.edge.getToJunction(first), ())
            own, *others = [line for edge in (first, second, *inside) for line in self._of(edge)]
            self._lines[first, second] = own, shapely.multilinestrings(others)
        return self._lines[first, second]

    def _width_m(self, sidewalk: str) -> float:
        return self._engine.lane.getWidth(f"{sidewalk}_0")

    def _of(self, edge: str) -> list[LineString]:
        """Return the lines of an edge's lanes, the sidewalk first."""
        lanes = [f"{edge}_{k}" for k in range(self._engine.edge.getLaneNumber(edge))]
        return [
            LineString([point[:2] for point in self._engine.lane.getShape(lane)]) for lane in lanes
        ]


LOCAL_M: Final = 5.0
"""Distance from a point within which the lines near it are compared without a search, metres."""


def _pieces(lines: shapely.Geometry) -> Floats:
    """Return the straight pieces of lines, (N, 5); see `_Segments`."""
    parts = [shapely.get_coordinates(line) for line in shapely.get_parts(lines)]
    starts = np.concatenate([points[:-1] for points in parts])
    steps = np.concatenate([np.diff(points, axis=0) for points in parts])
    lengths = np.hypot(steps[:, 0], steps[:, 1])
    rows = np.column_stack([starts, steps / np.maximum(lengths, 1e-9)[:, None], lengths])
    long: Floats = rows[lengths > 0.0]
    return long


def _pieces_near(pieces: Floats, x_m: float, y_m: float) -> _Segments:
    """Return the pieces that can be the nearest ones within LOCAL_M of a point."""
    dx, dy = x_m - pieces[:, 0], y_m - pieces[:, 1]
    along = dx * pieces[:, 2] + dy * pieces[:, 3]
    beyond = along - np.clip(along, 0.0, pieces[:, 4])
    far_m = np.hypot(beyond, dy * pieces[:, 2] - dx * pieces[:, 3])
    near = far_m <= far_m.min(initial=np.inf) + 2.0 * LOCAL_M + _ROUNDING_M
    return tuple(map(tuple, pieces[near].tolist()))


KEEP_ROUTE = 3
"""Mode of moveToXY: keep the walk, may leave the network. Other modes crash or clamp the
position."""

KEEP_ROUTE_ON_ROAD = 7
"""The same mode with car lanes allowed: cars stop for a proxy on the road."""

MATCH_M = 100.0
"""Largest distance of moveToXY's match, metres."""
ROUND_THE_CORNER_M = 2.0
"""SUMO may assign a proxy to the corner within this distance plus the width of a sidewalk's end,
metres."""

LEAD_MIN_M = 0.01
"""The lines of a proxy's own place must be nearer than others by this distance, metres."""

_TIE_M: Final = 1e-6
"""A lead this close to LEAD_MIN_M is computed by GEOS, metres."""
_ROUNDING_M: Final = 0.001
"""Tolerance of distances, metres."""

NUDGES = (0.0, 0.1, 0.2, 0.4, 0.7, 0.98)
"""Relative displacements tried to bring a proxy nearer to its own place than to others."""


class Walk(NamedTuple):
    """Walk of a proxy from sidewalk `first` to sidewalk `second` across their meeting place
    `around`."""

    around: str
    first: str
    second: str


class Walks:
    """Chooses a proxy's walk from its position and heading.

    A meeting place is named by the first of the corners that crossings of one junction join, or by
    the junction without a corner. A walk between sidewalks of one junction that do not meet crashes
    SUMO.
    """

    def __init__(self, engine: Sumo, street_map: StreetMap) -> None:
        self.street_map = street_map
        self._place = _meeting_places(street_map)
        self._ends: dict[str, tuple[str, str]] = {}
        self._into: dict[str, list[str]] = {}
        self._at: dict[str, list[str]] = {}
        self._best: dict[str, Walk | None] = {}
        self._touches: dict[tuple[Walk, str], int] = {}
        self._chords: dict[str, tuple[float, float, float, float, float]] = {}
        self._line: Callable[[str], shapely.Geometry] = lambda edge: _line(engine, edge)
        self._internal = _by_junction(engine.edge.getIDList())
        self.lead = SidewalkLead(engine, self._internal)
        self._lines: dict[Walk, tuple[shapely.Geometry, shapely.Geometry] | None] = {}
        for strip in street_map.strips.values():
            if strip.kind == "sidewalk":
                ends = (engine.edge.getFromJunction(strip.id), engine.edge.getToJunction(strip.id))
                self._ends[strip.id] = ends
                for end in (0, 1):
                    for place in {self._meeting(strip.id, end): 0, ends[end]: 0}:
                        self._at.setdefault(place, []).append(strip.id)
                        if end == 1:
                            self._into.setdefault(place, []).append(strip.id)

    def is_beside_road(self, place: Located) -> bool:
        """Return whether a place is a sidewalk or a corner, where no vehicle looks for people."""
        strip = self.street_map.strips.get(place.edge)
        return place.kind == "walk" and (strip is None or strip.kind == "sidewalk")

    def serves(self, walk: Walk, edge: str, pose: Pose) -> bool:
        """Return whether SUMO recognises a proxy on `edge` with this walk."""
        if edge.startswith(":"):
            best = self.choose(edge, pose)
            return best == walk or (
                best is not None
                and walk.around == best.around
                and walk.first in self._into[walk.around]
                and self._touched(walk, edge) >= self._touched(best, edge)
            )
        return walk.first == edge and walk.around == self._ahead(edge, pose)

    def choose(self, edge: str, pose: Pose) -> Walk | None:
        """Return a walk with which SUMO recognises a proxy on `edge`, or None."""
        if edge.startswith(":"):
            if edge not in self._best:
                around = self._inside(edge)
                self._best[edge] = self._pair(around, self._into.get(around, []), edge)
            return self._best[edge]
        if edge in self._ends:
            return self._pair(self._ahead(edge, pose), [edge], edge)
        return None

    def seen_at(self, walk: Walk, x_m: float, y_m: float) -> tuple[float, float] | None:
        """Return the nearest position at which SUMO recognises a proxy with a walk, metres, or
        None.

        At junctions whose corners are not joined by crossings, SUMO may assign a proxy to the wrong
        corner.
        """
        if walk not in self._lines:
            self._lines[walk] = self._own_and_others(walk)
        lines = self._lines[walk]
        if lines is None:
            return x_m, y_m
        own, others = lines
        to_own = shapely.get_coordinates(shapely.shortest_line(shapely.points(x_m, y_m), own))
        for share in NUDGES:
            x, y = (to_own[0] + share * (to_own[1] - to_own[0])).tolist()
            if shapely.distance(own, at := shapely.points(x, y)) + LEAD_MIN_M < shapely.distance(
                others, at
            ):
                return x, y
        return None

    def _own_and_others(self, walk: Walk) -> tuple[shapely.Geometry, shapely.Geometry] | None:
        """Return the lines of the walk and its place, and those of the junction's other places.

        Returns None without other places.
        """
        inside = self._internal.get(self._ends[walk.first][1], [])
        # Ids of walking areas end in "_w" and a number, those of crossings in "_c" and a number.
        inner = [edge for edge in inside if edge.rsplit("_", 1)[1][0] in "wc"]
        others = [piece for piece in inner if self._place.get(piece) != walk.around]
        if not others:
            return None
        own = [
            walk.first,
            walk.second,
            *(piece for piece in inner if self._place.get(piece) == walk.around),
        ]
        return shapely.union_all([*map(self._line, own)]), shapely.union_all(
            [*map(self._line, others)]
        )

    def _pair(self, around: str, firsts: list[str], edge: str) -> Walk | None:
        """Return the walk that touches most corners of `edge`, preferably on one side of the
        street."""
        walks = [
            Walk(around, first, to)
            for first in firsts
            for to in self._at.get(around, [])
            if to != first
        ]
        return max(
            walks,
            key=lambda walk: (
                self._touched(walk, edge),
                self._ends[walk.second] != self._ends[walk.first][::-1],
            ),
            default=None,
        )

    def _touched(self, walk: Walk, edge: str) -> int:
        """Return how many corners of an edge the walk's sidewalks touch; SUMO searches its path
        there."""
        if (walk, edge) not in self._touches:
            strips = self.street_map.strips
            corners = strips[edge].corners if edge in strips else (edge,)
            self._touches[walk, edge] = sum(
                corner is not None
                and (corner in strips[walk.first].corners or corner in strips[walk.second].corners)
                for corner in corners
            )
        return self._touches[walk, edge]

    def _inside(self, edge: str) -> str:
        """Return the meeting place of a corner or crossing, or the junction of another internal
        edge."""
        return self._place.get(edge) or junction_of(edge)

    def _meeting(self, strip: str, end: int) -> str:
        corner = self.street_map.strips[strip].corners[end]
        return self._ends[strip][end] if corner is None else self._place[corner]

    def _ahead(self, edge: str, pose: Pose) -> str:
        """Return the meeting place at the end of a sidewalk that a pose heads to.

        Close to the edge's end it is always that end: SUMO may assign a proxy there to the walking
        area, and crashes if its walk turns away.
        """
        if edge not in self._chords:
            strip = self.street_map.strips[edge]
            (x0, y0) = strip.line[0].tolist()
            (x1, y1) = strip.line[-1].tolist()
            self._chords[edge] = x1, y1, x1 - x0, y1 - y0, strip.width_m + ROUND_THE_CORNER_M
        x1, y1, along_x, along_y, end_m = self._chords[edge]
        forward = along_x * math.cos(pose.heading_rad) + along_y * math.sin(pose.heading_rad) >= 0.0
        at_end = math.hypot(pose.x_m - x1, pose.y_m - y1) < end_m
        return self._meeting(edge, 1 if forward or at_end else 0)


class Proxy:
    """SUMO person that represents one body.

    base: prefix of the names of its successive SUMO persons.
    """

    def __init__(
        self, engine: Sumo, walks: Walks, *, base: str, kind: str, serial: Iterator[int]
    ) -> None:
        self._engine = engine
        self._walks = walks
        self._base = base
        self._kind = kind
        self._serial = serial
        self._name: str | None = None
        self._walk: Walk | None = None
        self._place = Located("off", "")
        self._piece: shapely.Geometry | None = None
        self._outline: shapely.Geometry = shapely.LineString()
        self._border: Floats | None = None
        self._near_border: tuple[Circle, _Segments] = Circle(), ()
        self._inside = self._compared = Circle()
        self._compared_walk: Walk | None = None
        self._lead: LocalLead | None = None
        self._leads = False

    def update(self, pose: Pose, *, let_past: bool = False) -> None:
        """Move the proxy to a pose. Required before every simulation step; otherwise SUMO lets
        it walk on.

        let_past: remove it from sidewalks and corners, where it would block people.
        """
        x_m, y_m, heading_rad = pose
        place = self._locate(x_m, y_m)
        walk = self._walk
        if place.kind == "off" or (let_past and self._walks.is_beside_road(place)):
            walk = None
        elif walk is None or not self._walks.serves(walk, place.edge, pose):
            walk = self._walks.choose(place.edge, pose)
        mode = KEEP_ROUTE_ON_ROAD
        at = (x_m, y_m)
        if (
            walk is not None
            and place.kind != "road"
            and not self._is_on_sidewalk(walk, place, x_m, y_m)
        ):
            mode = KEEP_ROUTE
            seen_at = self._walks.seen_at(walk, x_m, y_m)
            walk, at = (None, at) if seen_at is None else (walk, seen_at)
        if walk != self._walk or self._name is None:
            self.remove()
            if walk is not None:
                self._add(walk)
        if self._name is not None:
            self._engine.person.moveToXY(
                self._name, "", *at, heading_to_sumo(heading_rad), mode, MATCH_M
            )

    def remove(self) -> None:
        """Remove the proxy from the simulation."""
        if self._name is not None and self._name in self._engine.person.getIDList():
            self._engine.person.remove(self._name)
        self._name = self._walk = None

    def _add(self, walk: Walk) -> None:
        person = self._engine.person
        self._name = f"{self._base}.{next(self._serial)}"
        self._walk = walk
        lengths = [self._engine.lane.getLength(f"{edge}_0") for edge in (walk.first, walk.second)]
        person.add(self._name, walk.first, lengths[0] / 2, typeID=self._kind)
        person.appendWalkingStage(self._name, [walk.first, walk.second], lengths[1] / 2)

    def _is_on_sidewalk(self, walk: Walk, place: Located, x_m: float, y_m: float) -> bool:
        """Return whether SUMO will assign the proxy to the first sidewalk of its walk."""
        if place.edge != walk.first or self._inside.radius_m == 0.0:
            return False
        if walk != self._compared_walk:
            self._compared_walk, self._compared, self._lead = walk, Circle(), None
        if not self._compared.holds(x_m, y_m):
            if self._lead is None or not self._lead.around.holds(x_m, y_m):
                self._lead = self._walks.lead.around(walk.first, walk.second, x_m, y_m)
            lead_m = self._lead.metres(x_m, y_m) - LEAD_MIN_M
            if abs(lead_m) < _TIE_M:
                lead_m = self._walks.lead.metres(walk.first, walk.second, x_m, y_m) - LEAD_MIN_M
            self._leads = lead_m > 0.0
            self._compared = Circle(x_m, y_m, max(abs(lead_m) - _TIE_M, 0.0) / 2.0)
        return self._leads

    def _locate(self, x_m: float, y_m: float) -> Located:
        """Locate a position on the map; cached while the body is on the same walkable piece."""
        if self._inside.holds(x_m, y_m) or self._is_still_inside(x_m, y_m):
            return self._place
        inside = self._piece is not None and shapely.contains_xy(self._piece, x_m, y_m)
        if not inside:
            street_map = self._walks.street_map
            self._place = place = street_map.locate(x_m, y_m)
            self._piece = None
            if place.kind == "walk":
                piece = street_map.strips.get(place.edge) or street_map.corners[place.edge]
                self._piece = piece.polygon
                self._outline = shapely.boundary(piece.polygon)
                self._border = None
                shapely.prepare(self._piece)
                inside = shapely.contains_xy(self._piece, x_m, y_m)
        room_m = 0.0
        if inside:
            room_m = max(
                float(shapely.distance(self._outline, shapely.points(x_m, y_m))) - _ROUNDING_M, 0.0
            )
        self._inside = Circle(x_m, y_m, room_m)
        return self._place

    def _is_still_inside(self, x_m: float, y_m: float) -> bool:
        """Return whether a position is surely on the present piece, and update the disk inside.

        It is where its distance from the outline and the disk's radius exceed the way from the
        disk's centre.
        """
        if self._piece is None or self._inside.radius_m == 0.0:
            return False
        if self._border is None:
            self._border = _pieces(self._outline)
            self._near_border = Circle(), ()
        if not self._near_border[0].holds(x_m, y_m):
            near = _pieces_near(self._border, x_m, y_m)
            self._near_border = Circle(x_m, y_m, LOCAL_M), near
        room_m = _distance_m(self._near_border[1], x_m, y_m) - _ROUNDING_M
        way_m = math.hypot(x_m - self._inside.x_m, y_m - self._inside.y_m)
        if room_m < _TIE_M or way_m >= self._inside.radius_m + room_m:
            return False
        self._inside = Circle(x_m, y_m, room_m)
        return True


def junction_of(internal: str) -> str:
    """Return the junction of an internal edge: "a_b" of ":a_b_w0"."""
    return internal[1:].rsplit("_", 1)[0]


def _by_junction(edges: Iterable[str]) -> dict[str, list[str]]:
    """Group internal edges by junction, including those too small for the map."""
    inside: dict[str, list[str]] = {}
    for edge in edges:
        if edge.startswith(":"):
            inside.setdefault(junction_of(edge), []).append(edge)
    return inside


def _line(engine: Sumo, edge: str) -> shapely.Geometry:
    """Return the line that SUMO measures distances to: an edge's middle line, or a walking
    area's open outline."""
    return LineString([point[:2] for point in engine.lane.getShape(f"{edge}_0")])


def _meeting_places(street_map: StreetMap) -> dict[str, str]:
    """Map each corner and crossing to the first of the corners that crossings join with it."""
    crossings = [
        strip
        for strip in street_map.strips.values()
        if strip.kind == "crossing" and any(strip.corners)
    ]
    joined: dict[str, list[str]] = defaultdict(list)
    for crossing in crossings:
        ends = [corner for corner in crossing.corners if corner is not None]
        joined[ends[0]].append(ends[-1])
        joined[ends[-1]].append(ends[0])
    place: dict[str, str] = {}
    for first in sorted(street_map.corners):
        reached = [first]
        while reached:
            if (corner := reached.pop()) not in place:
                place[corner] = first
                reached += joined[corner]
    return place | {
        one.id: place[next(corner for corner in one.corners if corner is not None)]
        for one in crossings
    }
