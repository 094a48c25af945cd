"""Free space for the crowd: walkable area around a point, and spots where persons or vehicles
may enter."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Final, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from cosim.core.geometry import Floats, Polyline, Pose
from cosim.place.street_map import StreetMap

INSET_M: Final = 0.2
"""Distance of the middles of people from the edge of a scan's ground, metres."""
REMEASURE_M: Final = 5.0
"""Distance that the point moves before the area is measured again, metres."""


class LocalWalkableArea:
    """The walkable area within `radius_m` of a slowly moving point."""

    def __init__(self, street_map: StreetMap, radius_m: float) -> None:
        strips = [strip.polygon for strip in street_map.strips.values()]
        corners = [corner.polygon for corner in street_map.corners.values()]
        self._polygons = np.array([*strips, *corners], dtype=object)
        self._tree = shapely.STRtree(self._polygons)
        self._radius_m = radius_m
        self._at: tuple[float, float] | None = None
        self._area_m2 = 0.0

    def area_m2(self, x_m: float, y_m: float) -> float:
        """Return the area of sidewalks, crossings and corners around a point, m2, accurate to a
        shift of REMEASURE_M."""
        if self._at is None or math.hypot(x_m - self._at[0], y_m - self._at[1]) > REMEASURE_M:
            self._at = (x_m, y_m)
            disk = shapely.Point(x_m, y_m).buffer(self._radius_m)
            near = self._polygons[self._tree.query(disk, predicate="intersects")]
            self._area_m2 = float(shapely.area(shapely.intersection(near, disk)).sum())
        return self._area_m2


class InnerGround:
    """Walkable ground of a scan, without its outermost part."""

    def __init__(self, street_map: StreetMap) -> None:
        self._inner = shapely.buffer(street_map.walkable, -INSET_M)
        shapely.prepare(self._inner)

    def nearest(self, xy: Floats) -> Floats:
        """Return points (N, 2) inside, the nearest to each point that is outside, metres."""
        outside = ~shapely.contains_xy(self._inner, xy[:, 0], xy[:, 1])
        if not outside.any() or self._inner.is_empty:
            return xy
        xy = xy.copy()
        lines = shapely.shortest_line(shapely.points(xy[outside]), self._inner)
        xy[outside] = shapely.get_coordinates(lines)[1::2]
        return xy


Rows = NDArray[np.intp]
_NO_ROWS: Final = np.zeros(0, dtype=np.intp)


class EntrySpot(NamedTuple):
    """A pose on the middle line of an edge, heading along it.

    share: share of the edge's length before it.
    """

    edge: str
    share: float
    pose: Pose

    def beside(self, left_m: float, ahead_m: float) -> tuple[float, float]:
        """Return the point `left_m` to its left and `ahead_m` ahead of it, metres."""
        cos, sin = math.cos(self.pose.heading_rad), math.sin(self.pose.heading_rad)
        return (
            self.pose.x_m - left_m * sin + ahead_m * cos,
            self.pose.y_m + left_m * cos + ahead_m * sin,
        )


class Spots:
    """Entry spots every `step_m` along lines, computed per line on demand."""

    def __init__(self, lines: Iterable[tuple[str, Floats, float, float]], step_m: float) -> None:
        """Index the lines: edge id, points (N, 2), and margins without spots at the start and
        end, metres."""
        self._lines = list(lines)
        self._step_m = step_m
        self._made: dict[int, tuple[Floats, Floats]] = {}
        points = [line for _, line, _, _ in self._lines]
        starts = np.cumsum([0, *map(len, points)])[:-1]
        if points:
            whole = np.concatenate(points)
            self._low = np.minimum.reduceat(whole, starts)
            self._high = np.maximum.reduceat(whole, starts)

    def ring(self, x_m: float, y_m: float, low_m: float, high_m: float) -> Ring:
        """Return the spots whose distance from (x_m, y_m) is in [low_m, high_m] metres."""
        if not self._lines:
            return Ring(self, _NO_ROWS, _NO_ROWS, _NO_ROWS)
        gap_m = np.maximum(np.maximum(self._low - (x_m, y_m), (x_m, y_m) - self._high), 0.0)
        lines = np.flatnonzero((gap_m * gap_m).sum(axis=1) <= high_m * high_m + 1.0)
        if not len(lines):
            return Ring(self, lines, lines, lines)
        poses = [self._on(number)[1] for number in lines.tolist()]
        starts = np.cumsum([0, *map(len, poses)])
        gap = np.concatenate(poses)[:, :2] - (x_m, y_m)
        dx, dy = gap.T.copy()
        here = (dx * dx + dy * dy <= high_m * high_m) & (np.hypot(dx, dy) >= low_m)
        return Ring(self, lines, starts, np.flatnonzero(here))

    def spot(self, number: int, k: int) -> EntrySpot:
        """Return the spot `k` of a line."""
        shares, poses = self._on(number)
        return EntrySpot(self._lines[number][0], float(shares[k]), Pose(*poses[k].tolist()))

    def _on(self, number: int) -> tuple[Floats, Floats]:
        """Return the shares (N,) and poses (N, 3) of the spots of a line."""
        if number not in self._made:
            _, xy, start_m, end_m = self._lines[number]
            line = Polyline(xy)
            s = np.arange(start_m, line.length_m - end_m, self._step_m)
            x, y = (np.interp([s - 0.1, s, s + 0.1], line.s_m, line.points[:, k]) for k in (0, 1))
            poses = np.column_stack([x[1], y[1], np.arctan2(y[2] - y[0], x[2] - x[0])])
            self._made[number] = s / line.length_m, poses
        return self._made[number]


class Ring:
    """Entry spots at some distances from a point, as a sequence.

    lines: (L,) lines with spots. starts: (L + 1,) number of spots on the lines before each.
    here: (N,) numbers of the spots of the ring among all on these lines.
    """

    def __init__(self, spots: Spots, lines: Rows, starts: Rows, here: Rows) -> None:
        self._spots = spots
        self._lines = lines
        self._starts = starts
        self._here = here

    def __len__(self) -> int:
        return len(self._here)

    def __getitem__(self, k: int) -> EntrySpot:
        number = int(self._here[k])
        line = int(np.searchsorted(self._starts, number, side="right")) - 1
        return self._spots.spot(int(self._lines[line]), number - int(self._starts[line]))
