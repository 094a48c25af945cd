"""Where SUMO takes a proxy to be on a sidewalk, whichever lanes it compares.

SUMO puts a proxy on the nearest of the lanes that it may be on: of pedestrians, the walk's and those of the junction
ahead; with car lanes allowed, all of the walk, those first in whose width the proxy is. To find the junction's it looks
through all lanes within 100 m, which takes it fifteen times as long as all the rest. In a sidewalk, between its ends,
that is the nearest of both kinds both ways end alike.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

import shapely
from shapely.geometry import LineString

if TYPE_CHECKING:  # a street that goes by itself does without SUMO
    from sumo_nets.engine import Sumo


class SidewalkLead:
    """By how much sidewalks are nearer than other lanes. internal: the edges inside each junction."""

    def __init__(self, engine: Sumo, internal: Mapping[str, Iterable[str]]) -> None:
        self._engine, self._internal = engine, internal
        self._lines: dict[tuple[str, str], tuple[shapely.Geometry, shapely.Geometry]] = {}

    def metres(self, first: str, second: str, x_m: float, y_m: float) -> float:
        """By how much a point in the sidewalk `first` is nearer to it than to any other lane that SUMO may compare, for
        a proxy whose walk is `first` and then `second`, or by twice how far it is from its sides if that is less.
        Negative where another lane is nearer; it changes by 2 m at most from a point to the next in 1 m.
        """
        if (first, second) not in self._lines:
            inside = self._internal.get(self._engine.edge.getToJunction(first), ())
            own, *others = [line for edge in (first, second, *inside) for line in self._of(edge)]
            self._lines[first, second] = own, shapely.multilinestrings(others)
        at = shapely.Point(x_m, y_m)
        sidewalk, rest = self._lines[first, second]
        own_m = shapely.distance(sidewalk, at)
        return float(min(shapely.distance(rest, at) - own_m, self._engine.lane.getWidth(f"{first}_0") - 2.0 * own_m))

    def _of(self, edge: str) -> list[LineString]:
        """The lines of an edge's lanes, the sidewalk's first."""
        lanes = [f"{edge}_{k}" for k in range(self._engine.edge.getLaneNumber(edge))]
        return [LineString([point[:2] for point in self._engine.lane.getShape(lane)]) for lane in lanes]
