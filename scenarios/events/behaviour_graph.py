"""Behaviour graph of the streets near a route: waypoints on sidewalks, and interaction spots.

A pure function of the place, its seed, the route, its barriers and obstacles. Edges stay on
sidewalks and corners near the route, never cross a road or crosswalk, and keep a person's radius
from all objects.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Final

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree
from shapely.geometry import LineString

from cosim.core.geometry import Floats, Polyline
from cosim.core.state import PERSON_RADIUS_M
from cosim.place import overlay
from cosim.place.barriers import outline
from cosim.place.street_map import Corner, Lane, StreetMap, Strip, union_closed
from cosim.spec.obstacle import Obstacle, footprint
from cosim.spec.scenario import Barrier
from physics.ground.tiles import tile_at
from physics.street.furniture import footprints
from physics.street.interaction_spots import InteractionSpot, SpotKind, spots
from physics.street.placement import CLEAR_HALF_M
from physics.street.surface import PlaceSurface

_REACH_M: Final = 55.0
"""Metres from the route within which sidewalks are in the graph."""
SPACING_M: Final = 4.0
"""Metres between waypoints along a sidewalk."""
OPEN_GROUND_M: Final = 1.2
"""Metres of open ground beyond the sidewalk on which people may use a window or bench."""
_GAP_M: Final = 0.04
"""Metres between a person's disk and objects."""
_EDGE_M: Final = 0.35
"""Metres between waypoints and the edge of the walkable area."""
_NEXT_M: Final = 2.2 * SPACING_M
"""Metres within which two waypoints are joined by an edge."""
_ROUND_M: Final = 14.0
"""Metres within which the middle of a corner is joined to waypoints."""
_STEP_OUT_M: Final = 3.5
"""Metres within which an interaction spot needs a waypoint."""
_SPUR_M: Final = 0.12
"""Half the width in metres of the path between an interaction spot and its waypoint."""
_MIN_NODES: Final = 4
"""Fewest waypoints of a connected part; smaller parts are removed."""


@dataclass(frozen=True)
class BehaviorGraph:
    """Graph of N nodes: first the W waypoints, then the interaction spots.

    xy: Positions of nodes, (N, 2) metres.
    idle: (W,) whether a person standing at the waypoint leaves the middle of the sidewalk free.
    spots: Interaction spots; spots[i] is node W + i.
    arcs: (N, N) symmetric sparse matrix of edge lengths in metres.
    part: (N,) index of each node's connected part.
    ground: Area that the centre of a person may occupy, including paths to the spots.
    """

    xy: Floats
    idle: NDArray[np.bool_]
    spots: tuple[InteractionSpot, ...]
    arcs: csr_array
    part: NDArray[np.int32]
    ground: shapely.Geometry

    @property
    def waypoints(self) -> int:
        return len(self.idle)

    def __len__(self) -> int:
        return len(self.xy)

    def spot(self, node: int) -> InteractionSpot | None:
        """Return the interaction spot of a node; None for a waypoint."""
        return self.spots[node - self.waypoints] if node >= self.waypoints else None

    def free(self, x_m: float, y_m: float) -> bool:
        """Return whether the centre of a person may be at a point."""
        return bool(shapely.contains_xy(self.ground, x_m, y_m))

    @cached_property
    def points(self) -> list[tuple[float, float]]:
        """`xy` as plain floats, faster to read one by one."""
        return [(x, y) for x, y in self.xy.tolist()]

    @cached_property
    def nodes_by_activity(self) -> Mapping[SpotKind, NDArray[np.intp]]:
        """Nodes of the interaction spots by activity."""
        found: dict[SpotKind, list[int]] = {}
        for i, spot in enumerate(self.spots):
            found.setdefault(spot.what, []).append(self.waypoints + i)
        return {what: np.array(found[what], dtype=np.intp) for what in sorted(found)}

    def distances(self, node: int) -> tuple[Floats, NDArray[np.int32]]:
        """Return (N,) walking distances in metres (inf if unreachable) and (N,) predecessors."""
        return self._reached(node)

    def way(self, start: int, goal: int) -> tuple[int, ...]:
        """Return the nodes of the shortest path without the start; empty if unreachable."""
        distance, before = self._reached(start)
        if not np.isfinite(distance[goal]):
            return ()
        nodes = [goal]
        while (node := int(before[nodes[-1]])) != start and node >= 0:
            nodes.append(node)
        return tuple(reversed(nodes))

    def nearest(self, x_m: float, y_m: float) -> int | None:
        """Return the nearest node that is reachable in a straight line; None if none is near."""
        away = np.hypot(self.xy[:, 0] - x_m, self.xy[:, 1] - y_m)
        for node in np.argsort(away, kind="stable")[:8].tolist():
            if away[node] < _NEXT_M and shapely.covers(
                self.ground, LineString([(x_m, y_m), self.xy[node]])
            ):
                return int(node)
        return None

    @cached_property
    def _reached(self) -> Callable[[int], tuple[Floats, NDArray[np.int32]]]:
        def reached(node: int) -> tuple[Floats, NDArray[np.int32]]:
            distance, before = dijkstra(
                self.arcs, directed=False, indices=node, return_predecessors=True
            )  # type: ignore[call-overload]
            return distance, before

        return lru_cache(maxsize=64)(reached)


def behavior_graph(
    street_map: StreetMap,
    ground: PlaceSurface,
    route: Sequence[tuple[float, float]],
    barriers: Sequence[Barrier] = (),
    obstacles: Sequence[Obstacle] = (),
) -> BehaviorGraph:
    """Build the graph of the streets around a route."""
    area = shapely.buffer(LineString(route), _REACH_M)
    strips = [
        s
        for s in street_map.near("strip", area)
        if isinstance(s, Strip) and s.kind == "sidewalk" and s.going == "plain" and s.length_m > 2.0
    ]
    corners = [c for c in street_map.near("corner", area) if isinstance(c, Corner)]
    props = ground.standing(area)
    x0, y0, x1, y1 = area.bounds
    (i0, j0) = tile_at(x0, y0)
    (i1, j1) = tile_at(x1, y1)
    buildings = [
        b for i in range(i0, i1 + 1) for j in range(j0, j1 + 1) for b in ground.buildings((i, j))
    ]
    lanes = [lane for lane in street_map.near("lane", area) if isinstance(lane, Lane)]
    roads = [lane.polygon for lane in lanes if lane.kind == "road"]
    things = [
        *footprints(props),
        *(b.polygon for b in buildings),
        *map(outline, barriers),
        *map(footprint, obstacles),
    ]
    walk = (
        union_closed([s.polygon for s in strips] + [c.polygon for c in corners])
        if strips
        else shapely.Polygon()
    )
    blocked = overlay.union_all(
        _grown(things, PERSON_RADIUS_M + _GAP_M) + _grown(roads, PERSON_RADIUS_M)
    )
    open_ground = overlay.difference(shapely.buffer(walk, OPEN_GROUND_M, quad_segs=4), blocked)
    footing = overlay.difference(shapely.buffer(walk, -_EDGE_M), blocked)
    for shape in (open_ground, footing):
        shapely.prepare(shape)

    lanes_xy, idle = _along(strips, footing)
    middles = _middles(corners, footing)
    xy = np.concatenate([lanes_xy, middles])
    idle = np.concatenate([idle, np.zeros(len(middles), dtype=bool)])
    ends = _pairs(xy, middles)
    ends = ends[shapely.covers(footing, _segments(xy[ends[:, 0]], xy[ends[:, 1]]))]
    found, at = _places(list(spots(street_map, props, buildings)), xy, open_ground, strips, things)
    spurs = np.column_stack([at, len(xy) + np.arange(len(at))]).reshape(-1, 2)
    places = np.array([(s.x_m, s.y_m) for s in found]).reshape(-1, 2)
    return _joined(
        np.concatenate([xy, places]),
        idle,
        found,
        np.concatenate([ends, spurs]),
        footing,
        open_ground,
    )


def _joined(
    xy: Floats,
    idle: NDArray[np.bool_],
    found: list[InteractionSpot],
    ends: NDArray[np.intp],
    footing: shapely.Geometry,
    open_ground: shapely.Geometry,
) -> BehaviorGraph:
    """Build the graph without connected parts that have too few waypoints."""
    length = np.hypot(*(xy[ends[:, 0]] - xy[ends[:, 1]]).T)
    arcs = csr_array((length, (ends[:, 0], ends[:, 1])), shape=(len(xy), len(xy)))
    _, part = connected_components(arcs, directed=False)
    large = np.bincount(part[: len(idle)], minlength=part.max(initial=0) + 1) >= _MIN_NODES
    kept = np.flatnonzero(large[part]) if len(part) else np.zeros(0, dtype=np.intp)
    ways = kept[kept < len(idle)]
    points = kept[kept >= len(idle)]
    spurs = ends[np.isin(ends[:, 1], points)]
    ways_out = shapely.buffer(_segments(xy[spurs[:, 0]], xy[spurs[:, 1]]), _SPUR_M, quad_segs=2)
    reach = overlay.union_all([footing, *overlay.intersection(ways_out, open_ground)])
    shapely.prepare(reach)
    places = tuple(found[i - len(idle)] for i in points.tolist())
    whole = xy[kept]
    whole.flags.writeable = False
    return BehaviorGraph(
        whole, idle[ways], places, csr_array(arcs[kept][:, kept]), part[kept], reach
    )


def _along(strips: Sequence[Strip], footing: shapely.Geometry) -> tuple[Floats, NDArray[np.bool_]]:
    """Return waypoints in up to two lanes along each sidewalk, and whether people may idle
    there."""
    rows: list[tuple[float, float, bool]] = []
    for strip in strips:
        line = Polyline(strip.line[:, :2])
        half = 0.5 * strip.width_m
        lane_m = min(half - _EDGE_M - 0.05, max(CLEAR_HALF_M + PERSON_RADIUS_M + 0.05, 0.55 * half))
        aside = lane_m - PERSON_RADIUS_M >= CLEAR_HALF_M
        count = max(round((line.length_m - 2.0) / SPACING_M), 1)
        for s_m in np.linspace(1.0, line.length_m - 1.0, count + 1).tolist():
            x, y, heading = line.at(s_m)
            lanes_m = (-lane_m, lane_m) if lane_m > 0.15 else (0.0,)
            rows += [
                (x - left_m * math.sin(heading), y + left_m * math.cos(heading), aside)
                for left_m in lanes_m
            ]
    table = np.array(rows, dtype=float).reshape(-1, 3)
    table = table[shapely.contains_xy(footing, table[:, 0], table[:, 1])]
    return table[:, :2], table[:, 2] > 0.0


def _middles(corners: Sequence[Corner], footing: shapely.Geometry) -> Floats:
    """Return (C, 2) points in the middle of corners."""
    parts = [
        p
        for c in corners
        for p in shapely.get_parts(shapely.intersection(c.polygon, footing))
        if p.area > 0.2
    ]
    return shapely.get_coordinates(shapely.point_on_surface(np.array(parts, dtype=object))).reshape(
        -1, 2
    )


def _places(
    offered: Sequence[InteractionSpot],
    xy: Floats,
    open_ground: shapely.Geometry,
    strips: Sequence[Strip],
    things: Sequence[shapely.Geometry],
) -> tuple[list[InteractionSpot], NDArray[np.intp]]:
    """Return the usable spots, at most one per seat or window, and the waypoint of each.

    A usable spot fits a person, leaves the middle of the sidewalk free and has a clear view of its
    object.
    """
    if not offered or not len(xy):
        return [], np.zeros(0, dtype=np.intp)
    at = np.array([(s.x_m, s.y_m) for s in offered])
    fits = shapely.contains_xy(open_ground, at[:, 0], at[:, 1])
    middles = shapely.STRtree([LineString(strip.line[:, :2]) for strip in strips])
    in_the_way, _ = middles.query(
        shapely.points(at), predicate="dwithin", distance=CLEAR_HALF_M + PERSON_RADIUS_M
    )
    fits[np.unique(in_the_way)] = False
    stands = shapely.STRtree(list(things))
    for i in [i for i in np.flatnonzero(fits).tolist() if offered[i].what == "window"]:
        short = np.array(offered[i].at_m) + 0.1 * (at[i] - offered[i].at_m)
        fits[i] = not len(stands.query(LineString([at[i], short]), predicate="intersects"))
    tree = cKDTree(xy)
    found: dict[str, tuple[InteractionSpot, int]] = {}
    for i in np.flatnonzero(fits).tolist():
        if offered[i].thing in found:
            continue
        away, near = tree.query(at[i], k=min(6, len(xy)), distance_upper_bound=_STEP_OUT_M)
        for far_m, node in zip(
            np.atleast_1d(away).tolist(), np.atleast_1d(near).tolist(), strict=True
        ):
            if math.isfinite(far_m) and shapely.covers(open_ground, LineString([at[i], xy[node]])):
                found[offered[i].thing] = offered[i], int(node)
                break
    return [spot for spot, _ in found.values()], np.array(
        [node for _, node in found.values()], dtype=np.intp
    )


def _pairs(xy: Floats, middles: Floats) -> NDArray[np.intp]:
    """Return (P, 2) index pairs of waypoints to join, the smaller index first.

    middles: The last rows of xy.
    """
    if not len(xy):
        return np.zeros((0, 2), dtype=np.intp)
    near = cKDTree(xy).query_pairs(_ROUND_M if len(middles) else _NEXT_M, output_type="ndarray")
    far = np.hypot(*(xy[near[:, 0]] - xy[near[:, 1]]).T)
    near = near[(far < _NEXT_M) | (near[:, 1] >= len(xy) - len(middles))]
    return np.asarray(near[np.lexsort((near[:, 1], near[:, 0]))])


def _segments(start: Floats, end: Floats) -> NDArray[np.object_]:
    return np.asarray(shapely.linestrings(np.stack([start, end], axis=1)), dtype=object).reshape(-1)


def _grown(shapes: Sequence[shapely.Geometry], by_m: float) -> list[shapely.Geometry]:
    return list(shapely.buffer(np.array(shapes, dtype=object), by_m, quad_segs=4)) if shapes else []
