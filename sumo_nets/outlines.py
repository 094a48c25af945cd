"""Shapes of a street net as arrays and polygons, many at a time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import shapely
from shapely.geometry import MultiPolygon, Polygon

from cosim.geometry import Floats

SHORTEST_M = 0.1


def polylines(shapes: Sequence[str]) -> list[Floats]:
    """(N, 2) metres of every shape, N >= 2 and never of zero length; elevations are dropped."""
    flat, counts = coordinates(shapes)
    lines = np.split(flat, np.cumsum(counts)[:-1])
    for i, line in enumerate(lines):
        if len(line) < 2 or (len(line) == 2 and abs(line[1] - line[0]).sum() < 1e-3):
            lines[i] = line[0] + np.array([[-SHORTEST_M / 2.0, 0.0], [SHORTEST_M / 2.0, 0.0]])
        lines[i].flags.writeable = False
    return lines


def coordinates(shapes: Sequence[str]) -> tuple[Floats, list[int]]:
    """All points of all shapes, (sum of counts, 2) metres, and the count of each."""
    points = [shape.split() for shape in shapes]
    counts = [len(row) for row in points]
    if not all(counts):
        raise ValueError("a shape without points")
    every = [point for row in points for point in row]
    if {p.count(",") for p in every} - {1}:
        # Points with and without elevation mix, even in one shape.
        every = [",".join(p.split(",")[:2]) for p in every]
    numbers = ",".join(every).split(",")
    flat = np.fromiter(map(float, numbers), dtype=float, count=len(numbers)) if numbers != [""] else np.empty(0)
    if len(flat) != 2 * len(every) or not np.isfinite(flat).all():
        raise ValueError("a shape with points that are not x,y")
    return flat.reshape(-1, 2), counts


def bands(lines: Sequence[Floats], widths: Floats) -> list[Polygon]:
    """The bands of the given widths around lines, square at the ends."""
    if not lines:
        return []
    owner = np.repeat(np.arange(len(lines)), [len(line) for line in lines])
    centres = shapely.linestrings(np.concatenate(lines), indices=owner)
    around = shapely.buffer(centres, np.maximum(widths, SHORTEST_M) / 2.0, cap_style="flat", join_style="mitre")
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
