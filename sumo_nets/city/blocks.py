"""Building blocks of streets: centre lines (straight, curve, S-bend, rounded corner, ring) and
cross-sections, metres.

Together with the T, X and Y junctions of a city plan these are the seven primitive blocks.
Trigonometry uses `math`, since numpy's kernels differ between processors.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

Point = tuple[float, float]
Line = list[Point]

_STEP_M = 6.0
"""Spacing of the points of a curved line, metres."""


class Section(NamedTuple):
    """Cross-section of a street per direction, from its middle outwards, metres.

    median_m: half of the median island.
    gutter_m, curb_m: drawn within the lanes and the verge.
    """

    median_m: float
    lanes: int
    lane_m: float
    gutter_m: float
    curb_m: float
    verge_m: float
    sidewalk_m: float
    frontage_m: float

    @property
    def half_m(self) -> float:
        """Distance from the middle of the street to the outer edge of the sidewalk, metres."""
        return self.median_m + self.lanes * self.lane_m + self.verge_m + self.sidewalk_m


Range = tuple[float, float]


class StreetClass(NamedTuple):
    """Common properties of the streets of a class; ranges of widths in metres.

    lanes: per direction.
    sidewalks_m: widths to choose from, odd multiples of SUMO's 0.64 m stripes; with others,
        pedestrians jump sideways at corners.
    driveways: number per metre of sidewalk.
    """

    lanes: int
    speed_mps: float
    priority: int
    lane_m: Range
    verge_m: Range
    sidewalks_m: tuple[float, ...]
    frontage_m: Range
    curb_m: Range
    gutter_m: Range
    median_m: Range = (0.0, 0.0)
    crossings_m: tuple[float, ...] = (3.2,)
    driveways: float = 0.0

    def section(self, rng: np.random.Generator) -> Section:
        """Draw a cross-section: widths in steps of 5 cm, and a sidewalk width of `sidewalks_m`."""

        def within(span: Range) -> float:
            return round(round(float(rng.uniform(*span)) / 0.05) * 0.05, 2)

        return Section(
            median_m=within(self.median_m),
            lanes=self.lanes,
            lane_m=within(self.lane_m),
            gutter_m=within(self.gutter_m),
            curb_m=within(self.curb_m),
            verge_m=within(self.verge_m),
            sidewalk_m=self.sidewalks_m[int(rng.integers(len(self.sidewalks_m)))],
            frontage_m=within(self.frontage_m),
        )


CLASSES = {
    "residential": StreetClass(
        1,
        8.33,
        3,
        (3.0, 3.4),
        (1.2, 2.2),
        (1.92, 3.2, 3.2),
        (2.0, 4.5),
        (0.1, 0.2),
        (0.25, 0.4),
        driveways=1 / 50,
    ),
    "commercial": StreetClass(
        1,
        8.33,
        4,
        (3.2, 3.6),
        (0.8, 1.4),
        (3.2, 4.48, 5.76),
        (0.6, 1.6),
        (0.15, 0.25),
        (0.25, 0.4),
        driveways=1 / 200,
    ),
    "avenue": StreetClass(
        2,
        13.89,
        6,
        (3.1, 3.4),
        (1.2, 2.0),
        (3.2, 4.48),
        (1.0, 3.0),
        (0.15, 0.25),
        (0.3, 0.5),
        (0.6, 0.9),
        (3.2, 4.48),
    ),
    "boulevard": StreetClass(
        2,
        13.89,
        7,
        (3.2, 3.5),
        (1.8, 3.0),
        (4.48, 5.76),
        (2.0, 4.0),
        (0.15, 0.25),
        (0.3, 0.5),
        (1.0, 1.5),
        (4.48,),
    ),
    "narrow": StreetClass(
        1,
        5.56,
        2,
        (2.8, 3.1),
        (0.3, 0.5),
        (1.92,),
        (0.4, 0.8),
        (0.1, 0.15),
        (0.15, 0.25),
        driveways=1 / 150,
    ),
    "ring": StreetClass(
        1, 6.94, 5, (4.3, 4.7), (0.6, 1.2), (3.2,), (0.8, 1.5), (0.1, 0.2), (0.25, 0.4)
    ),
}
"""Street classes by name. Streets with two or more lanes per direction have a median island as a
refuge for pedestrians."""


def polar(centre: Point, radius_m: float, angle_rad: float) -> Point:
    """Return the point `radius_m` from `centre` in the direction `angle_rad`."""
    return centre[0] + radius_m * math.cos(angle_rad), centre[1] + radius_m * math.sin(angle_rad)


def direction(a: Point, b: Point) -> float:
    """Return the heading from a to b, radians."""
    return math.atan2(b[1] - a[1], b[0] - a[0])


def length(line: Sequence[Point]) -> float:
    """Return the length of a line, metres."""
    return sum(math.dist(p, q) for p, q in pairwise(line))


def straight(a: Point, b: Point) -> Line:
    """Return the straight block."""
    return [a, b]


def bend(a: Point, b: Point, leave_rad: float, arrive_rad: float) -> Line:
    """Return a cubic Bezier curve from a with heading `leave_rad` to b with heading
    `arrive_rad`."""
    handle = math.dist(a, b) / 3.0
    c = polar(a, handle, leave_rad)
    d = polar(b, -handle, arrive_rad)
    count = max(4, math.ceil(math.dist(a, b) / _STEP_M))
    line = []
    for i in range(count + 1):
        t = i / count
        w = ((1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t * t * (1 - t), t**3)
        line.append(tuple(w[0] * a[k] + w[1] * c[k] + w[2] * d[k] + w[3] * b[k] for k in (0, 1)))
    return [a, *((x, y) for x, y in line[1:-1]), b]


def corner(a: Point, via: Point, b: Point, radius_m: float) -> Line:
    """Return the line from a by `via` to b, its corner rounded with at most `radius_m`."""
    into, out = direction(a, via), direction(via, b)
    turn = math.remainder(out - into, 2.0 * math.pi)
    if abs(turn) < 0.02:
        return [a, via, b]
    half = math.tan(abs(turn) / 2.0)
    tangent = min(radius_m * half, 0.45 * math.dist(a, via), 0.45 * math.dist(via, b))
    radius = tangent / half
    start = polar(via, -tangent, into)
    centre = polar(start, radius, into + math.copysign(math.pi / 2.0, turn))
    return [a, *arc(centre, radius, direction(centre, start), turn), b]


def arc(centre: Point, radius_m: float, from_rad: float, turn_rad: float) -> Line:
    """Return a circular arc from the angle `from_rad` through `turn_rad`, left positive."""
    count = max(4, math.ceil(radius_m * abs(turn_rad) / (_STEP_M / 2.0)))
    return [polar(centre, radius_m, from_rad + turn_rad * i / count) for i in range(count + 1)]


def ring(centre: Point, radius_m: float, angles_rad: Sequence[float]) -> list[Line]:
    """Return the roundabout block: counter-clockwise arcs between successive, ascending angles."""
    following = [*angles_rad[1:], angles_rad[0] + 2.0 * math.pi]
    return [arc(centre, radius_m, a, b - a) for a, b in zip(angles_rad, following, strict=True)]


def split(line: Line, s_m: float) -> tuple[Line, Line]:
    """Cut a line in two at arc length `s_m`; points within 1 m of the cut are dropped."""
    walked = 0.0
    for i, (p, q) in enumerate(pairwise(line)):
        step = math.dist(p, q)
        if walked + step >= s_m:
            t = (s_m - walked) / step
            cut = (p[0] + t * (q[0] - p[0]), p[1] + t * (q[1] - p[1]))
            head = [r for k, r in enumerate(line[: i + 1]) if k == 0 or math.dist(r, cut) > 1.0]
            tail = [
                r
                for k, r in enumerate(line[i + 1 :], i + 1)
                if k == len(line) - 1 or math.dist(r, cut) > 1.0
            ]
            return [*head, cut], [cut, *tail]
        walked += step
    raise ValueError(f"cannot cut a line of {walked:.1f} m at {s_m:.1f} m")
