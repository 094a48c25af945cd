"""Compute the line that a robot follows along a way of ports.

It runs along the middle of strips and through the inside of corners.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import shapely
from shapely.geometry import LineString, MultiPolygon, Polygon

from cosim.core.errors import MapError
from cosim.core.geometry import Floats, Polyline
from cosim.place.street_map import Port, StreetMap, Strip, union_closed

START_M = 30.0
"""Minimum length of the first and last sidewalk of a long route, in metres."""
ROUTE_M = (120.0, 560.0)
"""Minimum and maximum length of a long-horizon route, in metres."""
MARGINS_M = (0.6, 0.45, 0.3, 0.15, 0.02)
"""Distances from a corner's edge tried for the line through it, in metres, widest first."""

_STEP_M = 1.0
"""Distance between the points of a smoothed line, in metres."""
SMOOTHING_ROUNDS = 2
"""Number of rounds of corner cutting."""


def way_line(street_map: StreetMap, way: Sequence[Port], start_m: float, goal_m: float) -> Polyline:
    """Return the line along a way. Raises MapError if a corner cannot be passed.

    way: ports in order, from the exit of the first strip to the entrance of the last.
    start_m, goal_m: distance from those ports to the ends of the line, on the first and last strip.
    """
    first = street_map.strips[way[0].strip]
    last = street_map.strips[way[-1].strip]
    pieces = [tail(first, way[0], start_m)[::-1]]
    for leave, enter in itertools.pairwise(way):
        if leave.strip == enter.strip:
            line = street_map.strips[leave.strip].line[:, :2]
            pieces.append(line if leave.end == 0 else line[::-1])
        else:
            pieces.append(through_corner(street_map, leave, enter))
    pieces.append(tail(last, way[-1], goal_m))
    return smoothed(Polyline(np.vstack(pieces)))


def tail(strip: Strip, port: Port, length_m: float) -> Floats:
    """Return the first `length_m` metres of a strip's middle line from a port."""
    line = Polyline(strip.line[:, :2] if port.end == 0 else strip.line[::-1, :2])
    inner = line.points[(line.s_m > 0) & (line.s_m < length_m)]
    return np.vstack([line.points[:1], inner, line.at(length_m).xy[None]])


def through_corner(street_map: StreetMap, leave: Port, enter: Port) -> Floats:
    """Return the shortest line across a corner between two ports, at a distance from its edges.

    Raises MapError if there is none.
    """
    strips = [street_map.strips[port.strip] for port in (leave, enter)]
    corner_id = strips[0].corners[leave.end]
    if corner_id is None or corner_id != strips[1].corners[enter.end]:
        raise MapError(f"{leave} and {enter} do not meet at a corner of map '{street_map.name}'")
    a, b = (
        s.line[0 if p.end == 0 else -1, :2] for s, p in zip(strips, (leave, enter), strict=True)
    )
    area = union_closed([street_map.corners[corner_id].polygon, *(s.polygon for s in strips)])
    for margin_m in MARGINS_M:
        line = shortest_inside(shapely.buffer(area, -margin_m), a, b)
        if line is not None:
            return line
    raise MapError(
        f"no line through corner '{corner_id}' of map '{street_map.name}' from {leave} to {enter}"
    )


def shortest_inside(area: Polygon | MultiPolygon, a: Floats, b: Floats) -> Floats | None:
    """Return the shortest line from a to b inside an area, (N, 2) metres, or None.

    It uses the area's visibility graph.
    """
    from scipy.sparse import csr_array  # takes 0.2 s; episodes do not need it
    from scipy.sparse.csgraph import dijkstra

    grown = shapely.buffer(area, 0.01)
    shapely.prepare(grown)
    if not (shapely.contains_xy(grown, *a) and shapely.contains_xy(grown, *b)):
        return None
    if shapely.covers(grown, LineString([a, b])):
        return np.array([a, b])
    corners = shapely.get_coordinates(shapely.simplify(area, 0.02))
    nodes = np.vstack([a, b, np.unique(corners, axis=0)])
    i, j = np.triu_indices(len(nodes), 1)
    seen = shapely.covers(grown, shapely.linestrings(np.stack([nodes[i], nodes[j]], axis=1)))
    i, j = i[seen], j[seen]
    lengths = np.hypot(*(nodes[i] - nodes[j]).T)
    graph = csr_array((lengths, (i, j)), shape=(len(nodes), len(nodes)))
    distance, before = dijkstra(  # type: ignore[call-overload]
        graph, directed=False, indices=0, return_predecessors=True
    )
    if not np.isfinite(distance[1]):
        return None
    path = [1]
    while path[-1] != 0:
        path.append(int(before[path[-1]]))
    return np.asarray(nodes[path[::-1]])


def smoothed(line: Polyline) -> Polyline:
    """Return a line with bends rounded by corner cutting and a point about every metre; the ends
    stay."""
    points = line.resampled(_STEP_M).points
    for _ in range(SMOOTHING_ROUNDS):
        middle = (points[:-1] + points[1:]) / 2
        points = np.vstack([points[:1], middle, points[-1:]])
    return Polyline(points).resampled(_STEP_M)
