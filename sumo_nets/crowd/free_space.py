"""Room: how much of the ground around a point can be walked on, for a crowd of a given density."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import shapely

from cosim.place.street_map import StreetMap

AGAIN_M: Final = 5.0
"""How far the point moves before the area is measured again."""


class Room:
    """The walkable area within `radius_m` of a point that moves slowly."""

    def __init__(self, street_map: StreetMap, radius_m: float) -> None:
        strips = [strip.polygon for strip in street_map.strips.values()]
        corners = [corner.polygon for corner in street_map.corners.values()]
        self._polygons = np.array([*strips, *corners], dtype=object)
        self._tree = shapely.STRtree(self._polygons)
        self._radius_m = radius_m
        self._at: tuple[float, float] | None = None
        self._area_m2 = 0.0

    def area_m2(self, x_m: float, y_m: float) -> float:
        """Square metres of sidewalks, crossings and corners around a point (up to AGAIN_M beside
        it)."""
        if self._at is None or math.hypot(x_m - self._at[0], y_m - self._at[1]) > AGAIN_M:
            self._at = (x_m, y_m)
            disk = shapely.Point(x_m, y_m).buffer(self._radius_m)
            near = self._polygons[self._tree.query(disk, predicate="intersects")]
            self._area_m2 = float(shapely.area(shapely.intersection(near, disk)).sum())
        return self._area_m2
