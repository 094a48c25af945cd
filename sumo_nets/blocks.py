"""What a street is made of: centre lines (straight, curve, S-bend, rounded corner, ring) and cross-sections, in metres.

Together with the T, X and Y junctions that the plan of a city makes of them these are the seven primitive blocks.
Trigonometry goes through `math`, not through numpy's kernels, which differ between processors.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

Point = tuple[float, float]
Line = list[Point]

STEP_M = 6.0
"""Spacing of the points of a curved line."""


class StreetClass(NamedTuple):
    """Cross-section of a street, from its middle outwards, per direction."""

    lanes: int
    lane_m: float
    speed_mps: float
    verge_m: float
    sidewalk_m: float
    frontage_m: float
    curb_m: float
    gutter_m: float
    priority: int


CLASSES = {
    "residential": StreetClass(1, 3.2, 8.33, 1.6, 3.2, 3.0, 0.15, 0.30, 3),
    "commercial": StreetClass(1, 3.5, 8.33, 0.0, 4.48, 1.0, 0.20, 0.30, 4),
    "avenue": StreetClass(2, 3.2, 13.89, 1.6, 3.2, 2.0, 0.20, 0.45, 6),
    "boulevard": StreetClass(2, 3.3, 13.89, 2.4, 4.48, 3.0, 0.20, 0.45, 7),
    "narrow": StreetClass(1, 3.0, 5.56, 0.0, 1.92, 0.6, 0.12, 0.20, 2),
    "ring": StreetClass(1, 4.5, 6.94, 0.0, 3.2, 1.0, 0.15, 0.30, 5),
}
"""Sidewalks are odd multiples of SUMO's 0.64 m stripes, or walkers jump sideways at every corner."""


def polar(centre: Point, radius_m: float, angle_rad: float) -> Point:
    """The point `radius_m` from `centre` in the direction `angle_rad`."""
    return centre[0] + radius_m * math.cos(angle_rad), centre[1] + radius_m * math.sin(angle_rad)


def direction(a: Point, b: Point) -> float:
    """Heading from a to b in radians."""
    return math.atan2(b[1] - a[1], b[0] - a[0])


def length(line: Sequence[Point]) -> float:
    """Length of a line in metres."""
    return sum(math.dist(p, q) for p, q in pairwise(line))


def straight(a: Point, b: Point) -> Line:
    """The straight block."""
    return [a, b]


def bend(a: Point, b: Point, leave_rad: float, arrive_rad: float) -> Line:
    """From a, leaving with heading `leave_rad`, to b, arriving with heading `arrive_rad`: a cubic Bezier."""
    handle = math.dist(a, b) / 3.0
    c, d = polar(a, handle, leave_rad), polar(b, -handle, arrive_rad)
    count = max(4, math.ceil(math.dist(a, b) / STEP_M))
    line = []
    for i in range(count + 1):
        t = i / count
        w = ((1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t * t * (1 - t), t**3)
        line.append(tuple(w[0] * a[k] + w[1] * c[k] + w[2] * d[k] + w[3] * b[k] for k in (0, 1)))
    return [a, *((x, y) for x, y in line[1:-1]), b]


def curve(a: Point, b: Point, turn_rad: float) -> Line:
    """The curve block: leaves a `turn_rad` left of the chord and arrives as much right of it."""
    chord = direction(a, b)
    return bend(a, b, chord + turn_rad, chord - turn_rad)


def s_bend(a: Point, b: Point, turn_rad: float) -> Line:
    """The S-bend block: leaves a and arrives at b `turn_rad` left of the chord."""
    chord = direction(a, b)
    return bend(a, b, chord + turn_rad, chord + turn_rad)


def corner(a: Point, via: Point, b: Point, radius_m: float) -> Line:
    """From a by `via` to b, the corner rounded with `radius_m` (less where the legs are too short)."""
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
    """A circular arc that starts at the angle `from_rad` and runs through `turn_rad`, left positive."""
    count = max(4, math.ceil(radius_m * abs(turn_rad) / (STEP_M / 2.0)))
    return [polar(centre, radius_m, from_rad + turn_rad * i / count) for i in range(count + 1)]


def ring(centre: Point, radius_m: float, angles_rad: Sequence[float]) -> list[Line]:
    """The roundabout block: counter-clockwise arcs from each of the ascending angles to the next one."""
    following = [*angles_rad[1:], angles_rad[0] + 2.0 * math.pi]
    return [arc(centre, radius_m, a, b - a) for a, b in zip(angles_rad, following, strict=True)]


def split(line: Line, s_m: float) -> tuple[Line, Line]:
    """A line cut in two at arc length `s_m`; points within 1 m of the cut are dropped."""
    walked = 0.0
    for i, (p, q) in enumerate(pairwise(line)):
        step = math.dist(p, q)
        if walked + step >= s_m:
            t = (s_m - walked) / step
            cut = (p[0] + t * (q[0] - p[0]), p[1] + t * (q[1] - p[1]))
            head = [r for k, r in enumerate(line[: i + 1]) if k == 0 or math.dist(r, cut) > 1.0]
            tail = [r for k, r in enumerate(line[i + 1 :], i + 1) if k == len(line) - 1 or math.dist(r, cut) > 1.0]
            return [*head, cut], [cut, *tail]
        walked += step
    raise ValueError(f"cannot cut a line of {walked:.1f} m at {s_m:.1f} m")
