"""Barriers that close the branches of a route, and the proof that one path remains."""

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
    """Return the footprint of a barrier, grown by a margin."""
    cos, sin = math.cos(barrier.heading_rad), math.sin(barrier.heading_rad)
    half = barrier.length_m / 2
    line = LineString(
        [
            (barrier.x_m - half * sin, barrier.y_m + half * cos),
            (barrier.x_m + half * sin, barrier.y_m - half * cos),
        ]
    )
    return shapely.buffer(line, barrier.thickness_m / 2 + margin_m, cap_style="flat")


def without_barriers(
    area: Polygon | MultiPolygon, barriers: Iterable[Barrier]
) -> Polygon | MultiPolygon:
    """Return the walkable area without the footprints of the barriers."""
    fences = [outline(barrier) for barrier in barriers]
    if not fences:
        return area
    left: Polygon | MultiPolygon = overlay.difference(area, overlay.union_all(fences))
    return left


INTO_STRIP_M = 0.5
"""Distance of a barrier from the corner into a sidewalk, in metres. Barriers of crossings are at
the edge of the road, which stays free."""

OVERHANG_M = 0.12
"""Length by which a barrier exceeds the strip on either side, in metres."""
THICKNESS_M = 0.16
"""Thickness of a barrier in metres."""
SEAM_HOLE_M2 = 0.25
"""Area in m2 below which a hole in the walkable area is a seam of the net, not an obstacle."""

MOUTH_M = 4.0
"""Range before and behind a strip's end in which a slanting corner's edge is searched, in metres.
"""

_REACH_M = 30.0
"""Distance around the way within which the reachable area must end, in metres."""

BACK_M: Final = 5.0
"""Maximum length by which a route may lead back towards its start, in metres.

Measured: at most 0.4 m on the 105 shipped routes. Of 562 routes sampled on 15 maps, 555 have at
    most 2.5 m; the other seven double back by 11 to 69 m.
"""
_SAMPLE_M: Final = 2.0
"""Distance between the points of a route in the search for shorter walks, in metres."""
_SEGMENT_M: Final = 30.0
"""Maximum length of a straight segment in that search, in metres."""


def ports_to_close(street_map: StreetMap, way: Sequence[Port]) -> list[Port]:
    """Return the ports to close: the others at the corners of a way, and the far ends of its first
    and last strip."""
    corners = sorted({corner_of(street_map, port) for port in way} - {""})
    inner = {port for corner in corners for port in street_map.corners[corner].ports} - set(way)
    ends = {port for port in (way[0].other, way[-1].other) if corner_of(street_map, port)}
    return sorted(inner | ends)


def corner_of(street_map: StreetMap, port: Port) -> str:
    """Return the id of the corner at a port, "" at a dead end."""
    return street_map.strips[port.strip].corners[port.end] or ""


def barrier_at(street_map: StreetMap, port: Port, *, slanting: bool = False) -> Barrier:
    """Return the barrier that closes a port.

    slanting: follow the slant of the strip's mouth instead of a right angle to the strip.
    """
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
        left, right = (
            edge_at_corner(edge, along, reach_m, corner.polygon) for edge in (left, right)
        )
    return barrier_along(left - right, (left + right) / 2 + into_m * along, port)


def barrier_along(across: Floats, middle: Floats, port: Port) -> Barrier:
    """Return the barrier that closes a port along a vector.

    across: (2,) vector along the barrier, metres.
    middle: (2,) centre of the barrier, metres.
    """
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


def edge_at_corner(
    end: Floats, along: Floats, reach_m: float, corner: Polygon | MultiPolygon
) -> Floats:
    """Return where an edge of a strip meets a corner, (2,) metres; `end` if it does not.

    end: (2,) end of the edge at the port.
    along: (2,) unit vector from there into the strip.
    reach_m: range of the search in metres.
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
    """Return the area reachable from the start, after proving that exactly one path leads to the
    goal.

    The proof uses the walkable polygon without the barriers:
      1. The part that contains the start contains the goal.
      2. It ends within _REACH_M of the way, so that nothing leads elsewhere.
      3. It has no hole, so that all paths between two points are homotopic.
      4. Start and goal stay connected after erosion by half the robot's width.
      5. No shorter walk skips a part of the route.
    half_width_m: half width of the robot in metres.
    ground: result of `ground_around`, if known.
    Raises SpecError with the first condition that fails.
    """
    surroundings, walkable = ground_around(street_map, route, way) if ground is None else ground
    free = without_barriers(walkable, barriers)
    start = Point(route.points[0])
    goal = Point(route.points[-1])
    part = _part_containing(free, start)
    if part is None or not part.covers(goal):
        raise SpecError("start and goal are not connected")
    if not shapely.buffer(surroundings, -0.5).covers(part):
        raise SpecError("a branch is left open: the area reached leads away from the route")
    holes = [ring for ring in part.interiors if Polygon(ring).area >= SEAM_HOLE_M2]
    if holes:
        x, y = Polygon(holes[0]).centroid.coords[0]
        raise SpecError(f"two ways remain: they lead round ({x:.1f}, {y:.1f})")
    passable = _part_containing(shapely.buffer(part, -half_width_m), start)
    if passable is None or not passable.covers(goal):
        raise SpecError(f"somewhere the way is narrower than {2 * half_width_m:.2f} m")
    if not passable.covers(LineString(route.points)):
        raise SpecError(
            f"the route comes nearer than {half_width_m:.2f} m to the edge of the walkable area"
        )
    _check_doubling_back(part, route)
    return part


def _check_doubling_back(part: Polygon, route: Polyline) -> None:
    """Raise SpecError if the walk from the start to a place is shorter than to an earlier place.

    A difference of BACK_M is allowed. This finds routes that go out along one strip and back along
    another that touches it.
    """
    spots = route.resampled(_SAMPLE_M)
    walk_m = _walking_distances_m(part, spots.points)
    back_m = np.maximum.accumulate(walk_m) - walk_m
    if back_m.max() > BACK_M:
        worst = int(back_m.argmax())
        before = int(walk_m[:worst].argmax())
        raise SpecError(
            f"the way doubles back: its start is {back_m[worst]:.0f} m nearer on foot "
            f"{spots.s_m[worst]:.0f} m along it than {spots.s_m[before]:.0f} m along it"
        )


def _walking_distances_m(area: Polygon, spots: Floats) -> Floats:
    """Return walking distances from the first of (N, 2) points to each, (N,) metres.

    Walks are straight segments between the points, inside the area.
    """
    from scipy.sparse import csr_array  # takes 0.2 s; episodes do not need it
    from scipy.sparse.csgraph import dijkstra

    i, j = np.triu_indices(len(spots), 1)
    apart_m = np.hypot(*(spots[i] - spots[j]).T)
    i, j, apart_m = (values[apart_m <= _SEGMENT_M] for values in (i, j, apart_m))
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
    """Return the area within _REACH_M of a way, and the walkable ground there."""
    strips = union_closed([street_map.strips[port.strip].polygon for port in way])
    surroundings = shapely.buffer(overlay.union(strips, LineString(route.points)), _REACH_M)
    return surroundings, street_map.walkable_near(surroundings)


def _part_containing(area: Polygon | MultiPolygon, point: Point) -> Polygon | None:
    return next((part for part in shapely.get_parts(area) if part.covers(point)), None)
