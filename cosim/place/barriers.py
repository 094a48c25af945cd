"""Barriers that close the branches of a route, and the ground that they leave."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np
import shapely
from shapely.geometry import LineString, MultiPolygon, Point, Polygon

from cosim.core.errors import SpecError
from cosim.core.geometry import Floats, Polyline
from cosim.place import overlay
from cosim.place.street_map import SEAM_M, Port, StreetMap, union_closed
from cosim.spec.scenario import Barrier


def outline(barrier: Barrier, margin_m: float = 0.0) -> Polygon:
    """The ground that a barrier covers, grown by a margin."""
    cos, sin = math.cos(barrier.heading_rad), math.sin(barrier.heading_rad)
    half = barrier.length_m / 2
    line = LineString(
        [
            (barrier.x_m - half * sin, barrier.y_m + half * cos),
            (barrier.x_m + half * sin, barrier.y_m - half * cos),
        ]
    )
    return shapely.buffer(line, barrier.thickness_m / 2 + margin_m, cap_style="flat")


def fenced(area: Polygon | MultiPolygon, barriers: Iterable[Barrier]) -> Polygon | MultiPolygon:
    """The walkable area minus the ground of the barriers."""
    fences = [outline(barrier) for barrier in barriers]
    if not fences:
        return area
    left: Polygon | MultiPolygon = overlay.difference(area, overlay.union_all(fences))
    return left


INTO_STRIP_M = 0.5
"""A sidewalk is closed this far from its corner; a crossing at its edge, so that the road stays
free."""

OVERHANG_M = 0.12
THICKNESS_M = 0.16
SEAM_HOLE_M2 = 0.25
"""Smaller holes in the walkable area are seams of the net, not ways round something."""

MOUTH_M = 4.0
"""How far before and behind a strip's end the edge of a slanting corner is looked for."""

_REACH_M = 30.0
"""The walkable area is examined this far around the way; what can be reached must end before."""

BACK_M: Final = 5.0
"""Nowhere does a route lead back towards its start by more than this.

Measured: at most 0.4 m on the 105 shipped routes; of 562 drawn on 15 maps at most 2.5 m on 555, and
11 to 69 m on the seven that double back."""
_SPOT_M: Final = 2.0
_SIGHT_M: Final = 30.0
"""Walks are put together from straight lines between spots of the route so far from each other, at
most."""


def branches(street_map: StreetMap, way: Sequence[Port]) -> list[Port]:
    """The ports to close: all others at the corners of a way, and the far ends of its first and
    last strip."""
    corners = sorted({corner_of(street_map, port) for port in way} - {""})
    inner = {port for corner in corners for port in street_map.corners[corner].ports} - set(way)
    ends = {port for port in (way[0].other, way[-1].other) if corner_of(street_map, port)}
    return sorted(inner | ends)


def corner_of(street_map: StreetMap, port: Port) -> str:
    """Id of the corner at a port, "" at a dead end."""
    return street_map.strips[port.strip].corners[port.end] or ""


def barrier_at(street_map: StreetMap, port: Port, *, slanting: bool = False) -> Barrier:
    """The barrier that closes a port: square to its strip, or slanting where the strip's mouth
    does."""
    if slanting:
        return _slanting_barrier(street_map, port)
    strip = street_map.strips[port.strip]
    line = Polyline(strip.line[:, :2] if port.end == 0 else strip.line[::-1, :2])
    into_m = (
        min(INTO_STRIP_M, line.length_m / 2)
        if strip.kind == "sidewalk"
        else -THICKNESS_M / 2 + 0.02
    )
    pose = line.at(max(into_m, 0.0))
    back_m = min(into_m, 0.0)
    return Barrier(
        x_m=round(pose.x_m + back_m * math.cos(pose.heading_rad), 3),
        y_m=round(pose.y_m + back_m * math.sin(pose.heading_rad), 3),
        heading_rad=round(pose.heading_rad, 5),
        length_m=round(strip.width_m + 2 * OVERHANG_M, 3),
        strip=port.strip,
        end=port.end,
        thickness_m=THICKNESS_M,
    )


def _slanting_barrier(street_map: StreetMap, port: Port) -> Barrier:
    strip = street_map.strips[port.strip]
    line = Polyline(strip.line[:, :2] if port.end == 0 else strip.line[::-1, :2])
    x_m, y_m, heading_rad = line.at(0.0)
    along = np.array([math.cos(heading_rad), math.sin(heading_rad)])
    left, right = (
        np.array([x_m, y_m]) + side
        for side in np.outer((0.5, -0.5), strip.width_m * along[::-1] * (-1, 1))
    )
    into_m = min(INTO_STRIP_M, line.length_m / 2) if strip.kind == "sidewalk" else 0.0
    corner = street_map.corners.get(corner_of(street_map, port))
    if corner is not None:
        reach_m = min(MOUTH_M, line.length_m / 2)
        left, right = (mouth(edge, along, reach_m, corner.polygon) for edge in (left, right))
    return barrier_along(left - right, (left + right) / 2 + into_m * along, port)


def barrier_along(across: Floats, middle: Floats, port: Port) -> Barrier:
    """The barrier that closes a port along the vector (2,) `across`, about (2,) `middle`,
    metres."""
    x_m, y_m = middle.tolist()
    return Barrier(
        x_m=round(x_m, 3),
        y_m=round(y_m, 3),
        heading_rad=round(math.atan2(-across[0], across[1]), 5),
        length_m=round(float(np.hypot(*across)) + 2 * OVERHANG_M, 3),
        strip=port.strip,
        end=port.end,
        thickness_m=THICKNESS_M,
    )


def mouth(end: Floats, along: Floats, reach_m: float, corner: Polygon | MultiPolygon) -> Floats:
    """Where an edge of a strip meets a corner, (2,) metres; the edge's own end where it does not.

    end: (2,) of the edge at the port. along: (2,) unit vector from there into the strip. reach_m:
    how far to look.
    """
    inside = end + reach_m * along
    met = LineString([inside, end - MOUTH_M * along]).intersection(corner)
    return end if met.is_empty else inside - met.distance(Point(inside)) * along


def prove_single_path(
    street_map: StreetMap,
    route: Polyline,
    barriers: Sequence[Barrier],
    way: Sequence[Port],
    half_width_m: float,
    ground: tuple[shapely.Geometry, Polygon | MultiPolygon] | None = None,
) -> Polygon:
    """The area that can be reached from the start, once exactly one path leads to the goal.
    SpecError otherwise.

    What is shown, on the walkable polygon itself: (1) the part of walkable-minus-barriers that
    holds the start holds the goal; (2) it ends within REACH_M of the way, so nothing leads
    elsewhere; (3) it has no hole, and in an area without holes all paths between two points are the
    same but for bending; (4) start and goal stay connected when the area is eroded by half the
    robot's width, so the robot fits through; (5) no shorter walk skips a part of the route. ground:
    what `ground_around` gives, where it is known.
    """
    surroundings, walkable = ground_around(street_map, route, way) if ground is None else ground
    free = fenced(walkable, barriers)
    start = Point(route.points[0])
    goal = Point(route.points[-1])
    part = _part_with(free, start)
    if part is None or not part.covers(goal):
        raise SpecError("start and goal are not connected")
    if not shapely.buffer(surroundings, -0.5).covers(part):
        raise SpecError("a branch is left open: the area reached leads away from the route")
    holes = [ring for ring in part.interiors if Polygon(ring).area >= SEAM_HOLE_M2]
    if holes:
        x, y = Polygon(holes[0]).centroid.coords[0]
        raise SpecError(f"two ways remain: they lead round ({x:.1f}, {y:.1f})")
    passable = _part_with(shapely.buffer(part, -half_width_m), start)
    if passable is None or not passable.covers(goal):
        raise SpecError(f"somewhere the way is narrower than {2 * half_width_m:.2f} m")
    if not passable.covers(LineString(route.points)):
        raise SpecError(
            f"the route comes nearer than {half_width_m:.2f} m to the edge of the walkable area"
        )
    _refuse_doubling_back(part, route)
    return part


def _refuse_doubling_back(part: Polygon, route: Polyline) -> None:
    """Raises SpecError where the walk from the start of a route to a place on it is shorter, by
    more than BACK_M, than the walk to an earlier place: out along one strip and back along another
    one that touches it."""
    spots = route.resampled(_SPOT_M)
    walk_m = _walks_m(part, spots.points)
    back_m = np.maximum.accumulate(walk_m) - walk_m
    if back_m.max() > BACK_M:
        worst = int(back_m.argmax())
        before = int(walk_m[:worst].argmax())
        raise SpecError(
            f"the way doubles back: its start is {back_m[worst]:.0f} m nearer on foot "
            f"{spots.s_m[worst]:.0f} m along it than {spots.s_m[before]:.0f} m along it"
        )


def _walks_m(area: Polygon, spots: Floats) -> Floats:
    """(N,) m: from the first of (N, 2) spots of a line to each, by straight lines between spots
    inside an area."""
    from scipy.sparse import csr_array  # 0.2 s, and episodes have their routes
    from scipy.sparse.csgraph import dijkstra

    i, j = np.triu_indices(len(spots), 1)
    apart_m = np.hypot(*(spots[i] - spots[j]).T)
    i, j, apart_m = (values[apart_m <= _SIGHT_M] for values in (i, j, apart_m))
    grown = shapely.buffer(area, SEAM_M)
    shapely.prepare(grown)
    seen = (j == i + 1) | shapely.covers(
        grown, shapely.linestrings(np.stack([spots[i], spots[j]], axis=1))
    )
    graph = csr_array((apart_m[seen], (i[seen], j[seen])), shape=(len(spots), len(spots)))
    found: Floats = dijkstra(graph, directed=False, indices=0)  # type: ignore[call-overload]
    return found


def ground_around(
    street_map: StreetMap, route: Polyline, way: Sequence[Port]
) -> tuple[shapely.Geometry, Polygon | MultiPolygon]:
    """The area within REACH_M of a way, and the walkable ground there."""
    strips = union_closed([street_map.strips[port.strip].polygon for port in way])
    surroundings = shapely.buffer(overlay.union(strips, LineString(route.points)), _REACH_M)
    return surroundings, street_map.walkable_near(surroundings)


def _part_with(area: Polygon | MultiPolygon, point: Point) -> Polygon | None:
    return next((part for part in shapely.get_parts(area) if part.covers(point)), None)
