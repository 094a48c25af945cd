"""Kerbs: where people stand who wait at red. SUMO lets them wait at the crossing's end, which may lie on the road.

A crossing that meets its corner at an angle begins, on one side of it, beyond the kerb; who waits there stands where
turning cars drive. A shown person stays behind: on the corner, with a shoulder's room to the road.
"""

from __future__ import annotations

from typing import Final

import shapely
from shapely.geometry import Point

from cosim.place import overlay
from cosim.place.street_map import Lane, StreetMap

_ROOM_M: Final = 0.3


class Kerbs:
    """The kerbs of a map, made when they are first asked for."""

    def __init__(self, street_map: StreetMap) -> None:
        self._map = street_map
        self._ground: dict[str, shapely.Geometry] = {}
        self._spots: dict[tuple[str, float, float], tuple[float, float]] = {}

    def behind(self, crossing: str, x_m: float, y_m: float) -> tuple[float, float]:
        """The nearest place to a point where one can wait before a crossing, in metres."""
        key = (crossing, x_m, y_m)
        if key not in self._spots:
            if len(self._spots) > 4096:
                self._spots.clear()
            self._spots[key] = self._spot(crossing, x_m, y_m)
        return self._spots[key]

    def _spot(self, crossing: str, x_m: float, y_m: float) -> tuple[float, float]:
        strip = self._map.strips[crossing]
        at = Point(x_m, y_m)
        corners = [corner for corner in strip.corners if corner is not None]
        if not corners:
            return x_m, y_m
        nearest = min(corners, key=lambda corner: shapely.distance(self._map.corners[corner].polygon, at))
        ground = self._standing(nearest)
        if shapely.is_empty(ground) or shapely.contains_xy(ground, x_m, y_m):
            return x_m, y_m
        (_, _), (to_x_m, to_y_m) = shapely.get_coordinates(shapely.shortest_line(at, ground)).tolist()
        return to_x_m, to_y_m

    def _standing(self, corner: str) -> shapely.Geometry:
        """A corner without the crossings and the road that reach into it, less ROOM_M at its edge."""
        if corner not in self._ground:
            polygon = self._map.corners[corner].polygon
            taken = [s.polygon for s in self._map.near("strip", polygon) if s.id.startswith(":")]
            taken += [s.polygon for s in self._map.near("lane", polygon) if isinstance(s, Lane) and s.kind == "road"]
            free = overlay.difference(polygon, overlay.union_all(taken)) if taken else polygon
            ground = shapely.buffer(free, -_ROOM_M)
            shapely.prepare(ground)
            self._ground[corner] = ground
        return self._ground[corner]
