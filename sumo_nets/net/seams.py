"""Closing the wedge between a strip's square end and the slanting edge of the corner that it meets.

SUMO stores a sidewalk or crossing as a middle line and a width. Where it meets its corner at an angle, the band
around the line leaves a gap on one side that is nothing but an artefact, and that nobody could drive over without
"leaving" the walkable area.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import MultiPolygon, Polygon

from cosim.core.geometry import Floats
from cosim.place import overlay

_REACH_M = 2.5
"""How far beyond its end a strip may look for its corner."""

WELD_M = 0.005
"""Wedges are grown by this much, so that they and the strip become one polygon."""

Polygons = NDArray[np.object_]


def close_seams(
    polygons: Sequence[Polygon],
    lines: Sequence[Floats],
    widths_m: Floats,
    corners: Sequence[tuple[shapely.Geometry | None, shapely.Geometry | None]],
) -> list[Polygon]:
    """The polygons of N strips, extended at both ends to the edges of their corners (None: no corner there)."""
    if not len(polygons):
        return []
    grown = np.array(polygons, dtype=object)
    met = [np.array([pair[side] for pair in corners], dtype=object) for side in (0, 1)]
    at = [np.array([line[i, :2] for line in lines]) for i in (0, 1, -1, -2)]

    def both_ends(rows: slice) -> Polygons:
        one = joined(grown[rows], at[0][rows], at[1][rows], widths_m[rows], met[0][rows])
        return joined(one, at[2][rows], at[3][rows], widths_m[rows], met[1][rows])

    # Strips do not depend on each other, and shapely works outside of Python's lock.
    half = len(grown) // 2
    with ThreadPoolExecutor(2) as threads:
        return [p for part in threads.map(both_ends, (slice(0, half), slice(half, None))) for p in part]


def joined(polygons: Polygons, ends: Floats, inner: Floats, widths_m: Floats, corners: Polygons) -> Polygons:
    """Strips extended at one end to the edge of their corner.

    polygons: (N,) of the strips. ends, inner: (N, 2) metres, the last point of each middle line at that end and the
    one before. widths_m: (N,). corners: (N,) polygons, None where a strip ends nowhere. Returns (N,) polygons.
    """
    forth = ends - inner
    forth /= np.maximum(np.hypot(forth[:, 0], forth[:, 1]), 1e-9)[:, None]
    aside = np.column_stack([-forth[:, 1], forth[:, 0]]) * (widths_m / 2)[:, None]
    left, right = ends + aside, ends - aside
    beyond = shapely.polygons(np.stack([right, left, left + _REACH_M * forth, right + _REACH_M * forth], axis=1))
    edges = shapely.linestrings(np.stack([right, left], axis=1))
    met = overlay.intersection(beyond, corners)
    wanted = ~(shapely.is_missing(met) | shapely.is_empty(met))
    hulls = overlay.intersection(shapely.convex_hull(overlay.union(edges, met)), beyond)
    # Slivers without width make GEOS divide by zero; it copes.
    with np.errstate(divide="ignore", invalid="ignore"):
        wedges = shapely.buffer(overlay.difference(hulls, corners), WELD_M, join_style="mitre")
    out: Polygons = polygons.copy()
    grown = overlay.union(polygons, wedges)
    out[wanted] = [_holding(shape, strip) for shape, strip in zip(grown[wanted], polygons[wanted], strict=True)]
    return out


def _holding(shape: Polygon | MultiPolygon, strip: Polygon) -> Polygon:
    """The part of a shape that holds a strip: slivers of a wedge on the far side of a corner are nothing."""
    if isinstance(shape, Polygon):
        return shape
    return max(shape.geoms, key=lambda part: float(overlay.intersection(part, strip).area))
