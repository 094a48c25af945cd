"""Medial axis of walkable ground, cut into pieces of nearly constant width.

The axis follows the Voronoi diagram of points on the outline. Branches into corners are pruned.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Collection, Sequence
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import LineString, MultiPolygon, Polygon

from cosim.core.geometry import Floats, Polyline
from cosim.place import overlay

OPENED_M: Final = 0.4
"""Radius of the opening before the axis is computed, in metres: robots pass where it is wider."""
WIDTH_STEP_M: Final = 0.5
"""Change of the clear width at which an axis is cut, in metres."""
LONGEST_M: Final = 50.0
"""Longest piece, in metres: routes start and end on different pieces."""
SHORTEST_M: Final = 4.0
"""Shortest piece that a change of width cuts off, in metres."""
_SPACING_M: Final = 0.25
"""Distance of points on the outline, in metres."""
_ISLAND_GAP_M: Final = 1.2
"""Gap beside an obstacle below which the axis passes only on the other side, in metres."""
_STEP_M: Final = 0.5
_NARROW_M: Final = 1.0
"""Clearance below which the axis stays in the middle, in metres."""
_SMOOTHED: Final = 5
"""Number of points of the moving average."""
_END_GAP_M: Final = 0.3
"""Distance of the axis from the end of the ground, in metres."""
_PRUNED: Final = 1.3
"""Length of pruned branches, as a multiple of the clearance where they begin."""
_PRUNED_M: Final = 0.5
"""Length added to it, in metres."""
_SHORT_M: Final = 3.0
"""Length of branches that are pruned anyway, in metres."""
_JOINED: Final = 0.8
"""Length of an arc that is contracted to one node, as a multiple of the clearance."""


class Piece(NamedTuple):
    """Piece of an axis.

    start, end: indices of its nodes.
    line: (N, 2) metres.
    clear_m: narrowest clear width around it.
    """

    start: int
    end: int
    line: Floats
    clear_m: float


class Axis(NamedTuple):
    """Medial axis.

    nodes: (N, 2) metres.
    """

    nodes: Floats
    pieces: tuple[Piece, ...]


class _Chain(NamedTuple):
    """Vertices from one node, a fork or an end, to another."""

    nodes: tuple[int, ...]
    length_m: float


def medial_axis(ground: Polygon | MultiPolygon, *, whole: bool = False) -> Axis:
    """Return the medial axis of ground, in the order of its coordinates.

    whole: whether pieces run from fork to fork, however long and of whatever width.

    Ground narrower than twice OPENED_M has no axis.
    """
    nodes: list[Floats] = []
    pieces: list[Piece] = []
    boundary = ground.boundary
    shapely.prepare(boundary)
    wide = shapely.simplify(opened(ground, OPENED_M), 0.05)
    for part in shapely.get_parts(shapely.get_parts(wide)):
        if part.area < OPENED_M:
            continue
        for line, ends in _lines(_with_islands_joined(part)):
            here = [_node_of(nodes, end) for end in (line[0], line[-1])]
            loop = here[0] == here[1]
            s_m, clear_m = clear_widths(line, boundary, ends)
            parts = [(0.0, float(s_m[-1]))] if whole else _parts(s_m, clear_m, loop)
            before = here[0]
            for low_m, high_m in parts:
                last = high_m == parts[-1][1]
                after = here[1] if last else _node_of(nodes, Polyline(line).at(high_m).xy)
                inside = (s_m >= low_m - 1e-6) & (s_m <= high_m + 1e-6)
                least_m = float(clear_m[inside].min())
                pieces.append(Piece(before, after, between(line, low_m, high_m), least_m))
                before = after
    return Axis(np.array(nodes).reshape(-1, 2), tuple(pieces))


def clear_widths(
    line: Floats, boundary: shapely.Geometry, dead: tuple[bool, bool] = (False, False)
) -> tuple[Floats, Floats]:
    """Return arc lengths along a line, and the clear width around each, in metres.

    dead: whether each end is a dead end, whose own edge does not narrow the line.
    """
    whole = Polyline(line)
    count = max(2, math.ceil(whole.length_m / _STEP_M) + 1)
    s_m = np.linspace(0.0, whole.length_m, count)
    poses = [whole.at(s) for s in s_m.tolist()]
    xy = np.array([pose.xy for pose in poses])
    clear_m: Floats = np.asarray(2.0 * shapely.distance(shapely.points(xy), boundary))
    for end, gaps_m in zip(dead, (s_m, s_m[-1] - s_m), strict=True):
        for i in np.flatnonzero(gaps_m < 0.5 * clear_m.max() + _END_GAP_M) if end else ():
            across = np.array([-math.sin(poses[i].heading_rad), math.cos(poses[i].heading_rad)])
            rays = [LineString([xy[i], xy[i] + 50.0 * side * across]) for side in (1.0, -1.0)]
            hits = shapely.distance(shapely.intersection(rays, boundary), shapely.Point(xy[i]))
            clear_m[i] = 2.0 * min(25.0, float(np.nan_to_num(hits, nan=25.0).min()))
    return s_m, clear_m


def between(line: Floats, from_m: float, to_m: float) -> Floats:
    """Return the part of a line between two arc lengths, (N, 2) metres."""
    whole = Polyline(line)
    inner = whole.points[(whole.s_m > from_m + 1e-6) & (whole.s_m < to_m - 1e-6)]
    return np.vstack([whole.at(from_m).xy[None], inner, whole.at(to_m).xy[None]])


def opened(ground: shapely.Geometry, radius_m: float) -> Polygon | MultiPolygon:
    """Return ground without what is narrower than twice a radius."""
    found: Polygon | MultiPolygon = overlay.grown(
        shapely.buffer(ground, -radius_m, quad_segs=4), radius_m
    )
    return found


def _with_islands_joined(part: Polygon) -> Polygon:
    """Return ground whose obstacles are joined to the edges that are very near."""
    for _ in range(len(part.interiors)):
        gaps = []
        for ring in part.interiors:
            others = [part.exterior, *(other for other in part.interiors if other is not ring)]
            gap = min(
                (shapely.shortest_line(ring, other) for other in others), key=lambda one: one.length
            )
            gaps.append(gap)
        nearest = min(gaps, key=lambda one: (round(one.length, 6), one.bounds), default=None)
        if nearest is None or nearest.length > _ISLAND_GAP_M:
            break
        cut = overlay.difference(part, shapely.buffer(nearest, 0.02, cap_style="square"))
        part = max(shapely.get_parts(cut), key=lambda one: float(one.area))
    return part


def _lines(part: Polygon) -> list[tuple[Floats, tuple[bool, bool]]]:
    """Return the smoothed lines of the axis of one part, and which of their ends are dead."""
    xy, graph = _voronoi_graph(part)
    if not graph:
        return []
    boundary = part.boundary
    shapely.prepare(boundary)
    clearance = np.asarray(shapely.distance(shapely.points(xy), boundary))
    _prune(xy, graph, clearance)
    merged = _contracted(xy, graph, clearance, part)
    found = []
    for chain in _chains(xy, graph, merged):
        ends = (chain.nodes[0], chain.nodes[-1])
        first, last = (len(graph[end]) == 1 and end not in merged for end in ends)
        dead = (first, last)
        line = xy[list(chain.nodes)]
        line[0], line[-1] = (xy[merged.get(end, end)] for end in ends)
        if merged.get(ends[0], ends[0]) == merged.get(ends[1], ends[1]) and len(line) < 8:
            continue
        if len(line) < 2 or np.hypot(*np.diff(line, axis=0).T).sum() < OPENED_M:
            continue
        for end in (0, 1):
            if dead[end]:
                line = _extended(line[::-1], part)[::-1] if end == 0 else _extended(line, part)
        if Polyline(line).length_m > 2.0 * OPENED_M:
            found.append((_smoothed(line, boundary), dead))
    return sorted(found, key=lambda one: (one[0][0].tolist(), one[0][-1].tolist()))


_Graph = dict[int, set[int]]


def _voronoi_graph(part: Polygon) -> tuple[Floats, _Graph]:
    """Return the vertices inside of ground, (N, 2), and the graph of the Voronoi diagram there."""
    from scipy.spatial import Voronoi

    rings = [
        shapely.get_coordinates(shapely.segmentize(ring, _SPACING_M))[:-1]
        for ring in (part.exterior, *part.interiors)
    ]
    points = np.concatenate(rings)
    following = np.concatenate(
        [
            start + np.roll(np.arange(len(ring)), -1)
            for ring, start in zip(rings, _starts(rings), strict=True)
        ]
    )
    diagram = Voronoi(points - points.mean(axis=0))
    xy: Floats = diagram.vertices + points.mean(axis=0)
    ridges = np.array(diagram.ridge_vertices)
    pairs = np.asarray(diagram.ridge_points)
    inside = np.append(shapely.contains_xy(part, xy[:, 0], xy[:, 1]), False)
    neighbours = (following[pairs[:, 0]] == pairs[:, 1]) | (following[pairs[:, 1]] == pairs[:, 0])
    arcs = ridges[inside[ridges].all(axis=1) & ~neighbours]
    shapely.prepare(part)
    # Across thin obstacles, arcs may run from one side to the other.
    arcs = arcs[shapely.covers(part, shapely.linestrings(xy[arcs]))]
    graph: _Graph = defaultdict(set)
    for a, b in arcs.tolist():
        graph[a].add(b)
        graph[b].add(a)
    return xy, dict(graph)


def _starts(rings: Sequence[Floats]) -> list[int]:
    starts: list[int] = np.cumsum([0, *map(len, rings)])[:-1].tolist()
    return starts


def _chains(xy: Floats, graph: _Graph, forks: Collection[int] = ()) -> list[_Chain]:
    """Return the chains between forks and ends, loops included.

    forks: nodes that are forks whatever the number of their neighbours.
    """
    found = []
    seen: set[tuple[int, int]] = set()
    inner = {node for node, near in graph.items() if len(near) == 2 and node not in forks}
    for start in sorted(graph, key=lambda i: (i in inner, xy[i].tolist())):
        for second in sorted(graph[start], key=lambda i: xy[i].tolist()):
            if (start, second) in seen or (start in inner and _visited(seen, start)):
                continue
            nodes = [start, second]
            while nodes[-1] in inner and nodes[-1] != start:
                nodes.append(next(i for i in graph[nodes[-1]] if i != nodes[-2]))
            seen.update(pairwise(nodes))
            seen.update(pairwise(reversed(nodes)))
            steps = np.diff(xy[nodes], axis=0)
            found.append(_Chain(tuple(nodes), float(np.hypot(*steps.T).sum())))
    return found


def _visited(seen: set[tuple[int, int]], node: int) -> bool:
    return any(a == node for a, _ in seen)


def _prune(xy: Floats, graph: _Graph, clearance: NDArray[np.float64]) -> None:
    """Remove short branches, the shortest first, in place."""
    while True:
        branches = []
        for chain in _chains(xy, graph):
            ends = [len(graph[node]) for node in (chain.nodes[0], chain.nodes[-1])]
            if sorted(ends)[0] == 1 and sorted(ends)[1] > 2:
                nodes = chain.nodes if ends[0] == 1 else chain.nodes[::-1]
                most_m = _PRUNED * float(clearance[nodes[-1]]) + _PRUNED_M
                if chain.length_m < max(most_m, _SHORT_M):
                    branches.append((chain.length_m, nodes))
        if not branches:
            return
        forks: set[int] = set()
        for _, nodes in sorted(branches):
            # A fork with two branches left becomes one line: decide on it again.
            if nodes[-1] not in forks:
                forks.add(nodes[-1])
                for a, b in pairwise(nodes):
                    graph[a].discard(b)
                    graph[b].discard(a)
        for node in [node for node, near in graph.items() if not near]:
            del graph[node]


def _contracted(
    xy: Floats, graph: _Graph, clearance: NDArray[np.float64], part: Polygon
) -> dict[int, int]:
    """Return the node that replaces each fork next to another fork, in sight of it."""
    merged: dict[int, int] = {}
    for chain in sorted(_chains(xy, graph), key=lambda one: one.length_m):
        a, b = (merged.get(node, node) for node in (chain.nodes[0], chain.nodes[-1]))
        forks = all(len(graph[node]) > 2 for node in (chain.nodes[0], chain.nodes[-1]))
        sight = LineString([xy[a], xy[b]]).buffer(OPENED_M)
        most_m = _JOINED * float(clearance[a] + clearance[b])
        if forks and a != b and chain.length_m < most_m and part.covers(sight):
            for node in [a, b, *(n for n, target in merged.items() if target in (a, b))]:
                merged[node] = min(a, b)
            for c, d in pairwise(chain.nodes):
                graph[c].discard(d)
                graph[d].discard(c)
    return merged


def _extended(line: Floats, part: Polygon) -> Floats:
    """Return a line whose dead end runs straight to the end of the ground."""
    whole = Polyline(line)
    radius_m = float(
        shapely.distance(shapely.Point(whole.at(0.5 * whole.length_m).xy), part.boundary)
    )
    cut_m = max(0.5 * whole.length_m, whole.length_m - 2.2 * radius_m)
    short = between(line, 0.0, cut_m)
    back = Polyline(short).at(max(0.0, cut_m - 2.0)).xy
    along = short[-1] - back
    along /= max(float(np.hypot(*along)), 1e-9)
    ray = LineString([short[-1], short[-1] + 4.0 * (radius_m + 1.0) * along])
    inside = [
        p
        for p in shapely.get_parts(shapely.intersection(ray, part))
        if p.distance(shapely.Point(short[-1])) < 1e-6
    ]
    ahead_m = max((p.length for p in inside), default=0.0) - _END_GAP_M
    return np.vstack([short, short[-1] + ahead_m * along]) if ahead_m > 0.0 else short


def _smoothed(line: Floats, boundary: shapely.Geometry) -> Floats:
    """Return a line as a moving average of points every half metre; its ends stay.

    Points stay, too, where the average would be nearer to the edge of a narrow place.
    """
    points = Polyline(line).resampled(_STEP_M).points
    half = _SMOOTHED // 2
    for _ in range(2):
        out = points.copy()
        for i in range(1, len(points) - 1):
            reach = min(half, i, len(points) - 1 - i)
            out[i] = points[i - reach : i + reach + 1].mean(axis=0)
        before, after = (shapely.distance(shapely.points(xy), boundary) for xy in (points, out))
        points = np.where((after < np.minimum(before, _NARROW_M))[:, None], points, out)
    return shapely.get_coordinates(shapely.simplify(LineString(points), 0.04))


def _parts(s_m: Floats, clear_m: Floats, loop: bool) -> list[tuple[float, float]]:
    """Cut a line where its clear width changes, and where it is too long or a loop."""
    bounds = [0.0, *(float(s_m[i]) for i in _width_cuts(s_m, clear_m)), float(s_m[-1])]
    parts: list[tuple[float, float]] = []
    for low, high in pairwise(bounds):
        count = max(1, math.ceil((high - low) / LONGEST_M), 3 if loop and len(bounds) == 2 else 1)
        parts += pairwise(np.linspace(low, high, count + 1).tolist())
    return parts


def _width_cuts(s_m: Floats, clear_m: Floats) -> list[int]:
    """Return the indices at which the clear width has changed by WIDTH_STEP_M.

    Narrow places are first extended to half of SHORTEST_M on both sides.
    """
    near = np.abs(s_m[:, None] - s_m) <= 0.5 * SHORTEST_M
    least = np.where(near, clear_m, np.inf).min(axis=1)
    cuts = []
    low = high = least[0]
    for i, width_m in enumerate(least.tolist()):
        low, high = min(low, width_m), max(high, width_m)
        if high - low > WIDTH_STEP_M:
            # The wider piece ends beside the narrow place, not in it.
            cuts.append(max(i - 1, 1) if width_m < least[i - 1] else i)
            low = high = width_m
    while cuts:
        edges = [0, *cuts, len(s_m) - 1]
        lengths = [s_m[b] - s_m[a] for a, b in pairwise(edges)]
        shortest = int(np.argmin(lengths))
        if lengths[shortest] >= SHORTEST_M - _STEP_M:
            break
        widths = [float(clear_m[a : b + 1].min()) for a, b in pairwise(edges)]
        sides = [i for i in (shortest - 1, shortest + 1) if 0 <= i < len(widths)]
        # A join with a narrower neighbour narrows no other piece.
        side = min(
            sides,
            key=lambda i: (widths[i] > widths[shortest], abs(widths[i] - widths[shortest]), i),
        )
        cuts.pop(min(side, shortest))
    return cuts


def _node_of(nodes: list[Floats], xy: Floats) -> int:
    """Return the index of a node, added if it is new."""
    for i, known in enumerate(nodes):
        if abs(known - xy).max() < 0.01:
            return i
    nodes.append(np.asarray(xy, dtype=float))
    return len(nodes) - 1
