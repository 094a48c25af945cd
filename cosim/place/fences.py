"""The ground that barriers cover, and what they leave of a walkable area."""

from __future__ import annotations

import math
from collections.abc import Iterable

import shapely
from shapely.geometry import LineString, MultiPolygon, Polygon

from cosim.place import overlay
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
