"""Shapes of a street net as arrays and polygons, many at a time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NoReturn

import numpy as np
import shapely
from shapely.geometry import MultiPolygon, Polygon

from cosim.core.geometry import Floats

_SHORTEST_M = 0.1
FARTHEST_M = 1e8
"""No point of a map in metres is farther from its origin, which may be that of a projection."""


def polylines(shapes: Sequence[str], names: Sequence[str]) -> list[Floats]:
    """(N, 2) metres of every shape, N >= 2 and never of zero length; elevations are dropped. names: for errors."""
    flat, counts = coordinates(shapes, names)
    lines = np.split(flat, np.cumsum(counts)[:-1])
    for i, line in enumerate(lines):
        if len(line) < 2 or (len(line) == 2 and abs(line[1] - line[0]).sum() < 1e-3):
            lines[i] = line[0] + np.array([[-_SHORTEST_M / 2.0, 0.0], [_SHORTEST_M / 2.0, 0.0]])
        lines[i].flags.writeable = False
    return lines


def coordinates(shapes: Sequence[str], names: Sequence[str]) -> tuple[Floats, list[int]]:
    """All points of all shapes, (sum of counts, 2) metres, and the count of each.

    Raises ValueError with the name of a shape that is none.
    """
    points = [shape.split() for shape in shapes]
    counts = [len(row) for row in points]
    every = [point for row in points for point in row]
    if {p.count(",") for p in every} - {1}:
        # Points with and without elevation mix, even in one shape.
        every = [",".join(p.split(",")[:2]) for p in every]
    numbers = ",".join(every).split(",") if every else []
    try:
        flat = np.fromiter(map(float, numbers), dtype=float, count=len(numbers))
    except ValueError:
        flat = np.empty(0)
    if len(flat) != 2 * len(every) or not (np.abs(flat) < FARTHEST_M).all() or not all(counts):
        _refuse(points, names)
    return flat.reshape(-1, 2), counts


def _refuse(points: Sequence[Sequence[str]], names: Sequence[str]) -> NoReturn:
    """The error for the first shape that is none."""
    for name, row in zip(names, points, strict=True):
        wrong = [point for point in row if not _is_point(point)]
        if wrong:
            raise ValueError(f"'{name}': a shape with points that are not x,y in metres: '{wrong[0][:40]}'")
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
    """The bands of the given widths around lines, square at the ends."""
    if not lines:
        return []
    owner = np.repeat(np.arange(len(lines)), [len(line) for line in lines])
    centres = shapely.linestrings(np.concatenate(lines), indices=owner)
    around = shapely.buffer(centres, np.maximum(widths, _SHORTEST_M) / 2.0, cap_style="flat", join_style="mitre")
    polygons = [band if isinstance(band, Polygon) else areas_of(band, largest=True) for band in around]
    if any(polygon is None or polygon.is_empty for polygon in polygons):
        raise ValueError("a shape whose band has no area")
    return polygons


def areas_of(shape: shapely.Geometry, *, largest: bool) -> Any:
    """The areas of a repaired shape: the largest as a Polygon, or all of them; None without any."""
    parts = [p for p in shapely.get_parts(shapely.get_parts(shape)) if isinstance(p, Polygon) and p.area > 0.0]
    if not parts:
        return None
    if largest or len(parts) == 1:
        return max(parts, key=lambda part: part.area)
    return MultiPolygon(parts)
