"""Kerbs: where people stand who wait at red. SUMO lets them wait at the crossing's end, which may
lie on the road.

A crossing that meets its corner at an angle begins, on one side of it, beyond the kerb; who waits
there stands where turning cars drive. A shown person stays behind: on the corner, with a shoulder's
room to the road.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import shapely

from cosim.core.geometry import Floats
from cosim.place import overlay
from cosim.place.street_map import Lane, StreetMap

_ROOM_M: Final = 0.3
_KEPT: Final = 4096

_Key = tuple[str, float, float]
"""A crossing, and the point x, y in metres of somebody before it."""


class Kerbs:
    """The kerbs of a map, made when they are first asked for."""

    def __init__(self, street_map: StreetMap) -> None:
        self._map = street_map
        self._ends: dict[str, tuple[list[str], list[shapely.Geometry | None]]] = {}
        self._ground: dict[str, shapely.Geometry] = {}
        self._spots: dict[_Key, tuple[float, float]] = {}

    def behind(self, crossings: Sequence[str], xy: Floats) -> Floats:
        """The nearest places (N, 2) to points (N, 2) where one can wait before crossings (N,), in
        metres."""
        if len(self._spots) > _KEPT:
            self._spots.clear()
        asked = [
            (crossing, x_m, y_m)
            for crossing, (x_m, y_m) in zip(crossings, xy.tolist(), strict=True)
        ]
        if new := [key for key in asked if key not in self._spots]:
            self._find(new)
        return np.array([self._spots[key] for key in asked]).reshape(-1, 2)

    def _find(self, new: list[_Key]) -> None:
        """Find the spots of those who were not here before."""
        xy = np.array([key[1:] for key in new])
        ends = [self._corners(crossing) for crossing, _, _ in new]
        outlines = np.array([outline for _, outline in ends], dtype=object)
        # Mostly somebody is on a corner; GEOS says that much faster than how far away the corners
        # are.
        on = shapely.intersects_xy(outlines, xy[:, :1], xy[:, 1:])
        away_m = np.where(on, 0.0, 1.0)
        off = ~on.any(axis=1)
        if off.any():
            away_m[off] = shapely.distance(
                outlines[off], np.array(shapely.points(xy[off]))[:, None]
            )
        last = (away_m[:, 1] < away_m[:, 0]).tolist()
        grounds = [
            self._standing(corners[k]) if corners else None
            for (corners, _), k in zip(ends, last, strict=True)
        ]
        ground = np.array(grounds, dtype=object)
        aside = ~(
            shapely.contains_xy(ground, *xy.T)
            | shapely.is_missing(ground)
            | shapely.is_empty(ground)
        )
        if aside.any():
            ways = shapely.shortest_line(shapely.points(xy[aside]), ground[aside])
            xy[aside] = shapely.get_coordinates(ways)[1::2]
        self._spots.update(zip(new, map(tuple, xy.tolist()), strict=True))

    def _corners(self, crossing: str) -> tuple[list[str], list[shapely.Geometry | None]]:
        """The corners at the ends of a crossing and two outlines, None for want of a corner."""
        if crossing not in self._ends:
            corners = [
                corner for corner in self._map.strips[crossing].corners if corner is not None
            ]
            outlines: list[shapely.Geometry] = [
                self._map.corners[corner].polygon for corner in corners
            ]
            shapely.prepare(outlines)
            self._ends[crossing] = corners, [*outlines, None, None][:2]
        return self._ends[crossing]

    def _standing(self, corner: str) -> shapely.Geometry:
        """A corner without the crossings and the road that reach into it, less ROOM_M at its
        edge."""
        if corner not in self._ground:
            polygon = self._map.corners[corner].polygon
            taken = [s.polygon for s in self._map.near("strip", polygon) if s.id.startswith(":")]
            taken += [
                s.polygon
                for s in self._map.near("lane", polygon)
                if isinstance(s, Lane) and s.kind == "road"
            ]
            free = overlay.difference(polygon, overlay.union_all(taken)) if taken else polygon
            ground = shapely.buffer(free, -_ROOM_M)
            shapely.prepare(ground)
            self._ground[corner] = ground
        return self._ground[corner]
