"""Build polygons of lanes and junctions without gaps between them."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NoReturn

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import MultiPolygon, Polygon

from cosim.core.geometry import Floats
from cosim.place import overlay

_SHORTEST_M = 0.1
"""Smallest length of a line and width of a band, metres."""
Polygons = NDArray[np.object_]
FARTHEST_M = 1e8
"""Largest coordinate of a map, metres; the origin may be that of a projection."""


def polylines(shapes: Sequence[str], names: Sequence[str]) -> list[Floats]:
    """Parse shapes into lines (N, 2), metres, with N >= 2 and a positive length; elevations are
    dropped.

    names: ids for errors.
    """
    flat, counts = coordinates(shapes, names)
    lines = np.split(flat, np.cumsum(counts)[:-1])
    for i, line in enumerate(lines):
        if len(line) < 2 or (len(line) == 2 and abs(line[1] - line[0]).sum() < 1e-3):
            lines[i] = line[0] + np.array([[-_SHORTEST_M / 2.0, 0.0], [_SHORTEST_M / 2.0, 0.0]])
        lines[i].flags.writeable = False
    return lines


def coordinates(shapes: Sequence[str], names: Sequence[str]) -> tuple[Floats, list[int]]:
    """Parse shapes into their points (sum of counts, 2), metres, and the count of each.

    Raises ValueError naming the first invalid shape.
    """
    points = [shape.split() for shape in shapes]
    counts = [len(row) for row in points]
    every = [point for row in points for point in row]
    if {p.count(",") for p in every} - {1}:
        # Points with and without elevation may be mixed, even in one shape.
        every = [",".join(p.split(",")[:2]) for p in every]
    numbers = ",".join(every).split(",") if every else []
    try:
        flat = np.fromiter(map(float, numbers), dtype=float, count=len(numbers))
    except ValueError:
        flat = np.empty(0)
    if len(flat) != 2 * len(every) or not (np.abs(flat) < FARTHEST_M).all() or not all(counts):
        _raise_for_first_invalid(points, names)
    return flat.reshape(-1, 2), counts


def _raise_for_first_invalid(points: Sequence[Sequence[str]], names: Sequence[str]) -> NoReturn:
    """Raise ValueError for the first invalid shape."""
    for name, row in zip(names, points, strict=True):
        wrong = [point for point in row if not _is_point(point)]
        if wrong:
            raise ValueError(
                f"'{name}': a shape with points that are not x,y in metres: '{wrong[0][:40]}'"
            )
        if not row:
            raise ValueError(f"'{name}': a shape without points")
    raise ValueError("a shape that cannot be read")


def _is_point(point: str) -> bool:
    try:
        x, y = (float(v) for v in point.split(",")[:2])
    except ValueError:
        return False
    return abs(x) < FARTHEST_M and abs(y) < FARTHEST_M


def bands(lines: Sequence[Floats], widths: Floats) -> list[Polygon]:
    """Return the polygons of the given widths around lines, with flat ends."""
    if not lines:
        return []
    owner = np.repeat(np.arange(len(lines)), [len(line) for line in lines])
    centres = shapely.linestrings(np.concatenate(lines), indices=owner)
    around = shapely.buffer(
        centres, np.maximum(widths, _SHORTEST_M) / 2.0, cap_style="flat", join_style="mitre"
    )
    polygons = [
        band if isinstance(band, Polygon) else polygon_parts(band, largest=True) for band in around
    ]
    if any(polygon is None or polygon.is_empty for polygon in polygons):
        raise ValueError("a shape whose band has no area")
    return polygons


def polygon_parts(shape: shapely.Geometry, *, largest: bool) -> Any:
    """Return the polygonal parts of a repaired shape: the largest, or all of them; None without
    any."""
    parts = [
        p
        for p in shapely.get_parts(shapely.get_parts(shape))
        if isinstance(p, Polygon) and p.area > 0.0
    ]
    if not parts:
        return None
    if largest or len(parts) == 1:
        return max(parts, key=lambda part: part.area)
    return MultiPolygon(parts)


_MEETS_LANE_M = 0.1
"""Distance from a lane, in metres, beyond which a part of a junction is no carriageway."""


def carriageways(outlines: Sequence[Polygon], walks: Polygons, lanes: Polygons) -> list[Polygon]:
    """Return outlines of junctions without the parts behind sidewalks, which no lane reaches.

    SUMO draws the outline of a junction, above all of a T-junction, beyond its far sidewalk.

    walks: polygons of sidewalks and corners.
    lanes: polygons of lanes for vehicles.
    """
    walk_tree, lane_tree = shapely.STRtree(walks), shapely.STRtree(lanes)
    found = []
    for outline in outlines:
        beside = walks[np.sort(walk_tree.query(outline, predicate="intersects"))]
        if not len(beside):
            found.append(outline)
            continue
        parts = shapely.get_parts(overlay.difference(outline, overlay.union_all(beside)))
        reached = np.array(
            [
                len(lane_tree.query(p, predicate="dwithin", distance=_MEETS_LANE_M)) > 0
                for p in parts
            ],
            dtype=bool,
        )
        if reached.any() and not reached.all():
            behind = overlay.union_all(parts[~reached])
            outline = polygon_parts(overlay.difference(outline, behind), largest=True) or outline
        found.append(outline)
    return found


_REACH_M = 2.5
"""Distance beyond its end, in metres, within which a strip is extended to its corner."""

WELD_M = 0.005
"""Distance by which wedges are grown, in metres, so that they merge with their strip."""


def close_seams(
    polygons: Sequence[Polygon],
    lines: Sequence[Floats],
    widths_m: Floats,
    corners: Sequence[tuple[shapely.Geometry | None, shapely.Geometry | None]],
) -> list[Polygon]:
    """Extend the polygons of N strips at both ends to the edges of their corners.

    corners: polygons at the start and end of each strip, or None.
    """
    if not len(polygons):
        return []
    grown = np.array(polygons, dtype=object)
    met = [np.array([pair[side] for pair in corners], dtype=object) for side in (0, 1)]
    at = [np.array([line[i, :2] for line in lines]) for i in (0, 1, -1, -2)]

    def both_ends(rows: slice) -> Polygons:
        one = extended_to_corners(
            grown[rows], at[0][rows], at[1][rows], widths_m[rows], met[0][rows]
        )
        return extended_to_corners(one, at[2][rows], at[3][rows], widths_m[rows], met[1][rows])

    # Strips are independent, and shapely releases the GIL.
    half = len(grown) // 2
    with ThreadPoolExecutor(2) as threads:
        return [
            p for part in threads.map(both_ends, (slice(0, half), slice(half, None))) for p in part
        ]


def extended_to_corners(
    polygons: Polygons, ends: Floats, inner: Floats, widths_m: Floats, corners: Polygons
) -> Polygons:
    """Extend strips at one end to the edge of their corner.

    polygons: (N,) polygons of the strips.
    ends, inner: (N, 2) metres, the last point of each middle line at that end and the one before.
    widths_m: (N,) metres.
    corners: (N,) polygons, None without a corner.

    Returns (N,) polygons.
    """
    forth = ends - inner
    forth /= np.maximum(np.hypot(forth[:, 0], forth[:, 1]), 1e-9)[:, None]
    aside = np.column_stack([-forth[:, 1], forth[:, 0]]) * (widths_m / 2)[:, None]
    left = ends + aside
    right = ends - aside
    beyond = shapely.polygons(
        np.stack([right, left, left + _REACH_M * forth, right + _REACH_M * forth], axis=1)
    )
    edges = shapely.linestrings(np.stack([right, left], axis=1))
    met = overlay.intersection(beyond, corners)
    wanted = ~(shapely.is_missing(met) | shapely.is_empty(met))
    hulls = overlay.intersection(shapely.convex_hull(overlay.union(edges, met)), beyond)
    # Slivers without width make GEOS divide by zero, without effect on the result.
    with np.errstate(divide="ignore", invalid="ignore"):
        wedges = shapely.buffer(overlay.difference(hulls, corners), WELD_M, join_style="mitre")
    out: Polygons = polygons.copy()
    grown = overlay.union(polygons, wedges)
    out[wanted] = [
        _part_with(shape, strip)
        for shape, strip in zip(grown[wanted], polygons[wanted], strict=True)
    ]
    return out


def _part_with(shape: Polygon | MultiPolygon, strip: Polygon) -> Polygon:
    """Return the part of a shape that overlaps a strip most, without slivers on the far side of
    a corner."""
    if isinstance(shape, Polygon):
        return shape
    return max(shape.geoms, key=lambda part: float(overlay.intersection(part, strip).area))
