"""How one who walks steers round others: a way that is open, then ORCA's half-planes.

ORCA alone stops before somebody who stands in the way and stays there. So the wanted velocity is turned first to the
nearest heading that is open for a while (RVO's choice among velocities: J. van den Berg, M. Lin, D. Manocha,
"Reciprocal velocity obstacles for real-time multi-agent navigation", ICRA 2008); the half-planes of `cosim.orca` then
share the avoidance between those who see each other, and slow down who finds nothing open.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Final, NamedTuple

import numpy as np

from cosim.orca import HalfPlane, best_velocity, half_plane
from cosim.state import PERSON_RADIUS_M

NEAR_M: Final = 4.0
"""Who is farther away is not looked at."""

HORIZON_S: Final = 2.0
"""How far ahead one looks; half-planes too."""

LEAST_M: Final = 0.45
"""Middles of two people who touch shoulders; nearer ones part."""

PARTED_S: Final = 0.5
"""In this time those who are too near are parted."""

TURN_RAD: Final = math.radians(10.0)
TURNS: Final = 11
"""Headings that are tried: so many steps to either side, beyond a right angle."""

GIVES: Final = 0.98
"""Those who stand nearer than two radii come no nearer than this share of their distance."""

CROSSING: Final = 0.35
"""Sine of the angle between two ways from which on they cross."""

EPS: Final = 1e-9

Vector = tuple[float, float]


class Neighbour(NamedTuple):
    """Somebody else: where (m), how it moves (m/s), and how much of the avoidance it leaves to the one who steers.

    share: 1 for who pays no heed, 1/2 for who steers the same way.
    """

    x_m: float
    y_m: float
    vx_mps: float = 0.0
    vy_mps: float = 0.0
    share: float = 1.0


class _Disk(NamedTuple):
    """A neighbour as the one who steers sees it: from here to it in metres, its velocity, the distance to keep."""

    apart_m: Vector
    moving_mps: Vector
    keep_m: float
    share: float


def steered(
    at_m: Vector,
    moving_mps: Vector,
    wanted_mps: Vector,
    neighbours: Sequence[Neighbour],
    *,
    horizon_s: float = HORIZON_S,
    walls: Sequence[HalfPlane] = (),
) -> Vector:
    """The velocity (m/s) of one person who is at `at_m`, moves with `moving_mps` and wants `wanted_mps`.

    No faster than wanted; exactly as wanted, to the bit, where nobody is in the way. One who wants to stand stands.
    horizon_s: how far ahead to look; less for one who arrives before. walls: half-planes of velocities that stay on
    the ground one may walk on. Only who is nearer than NEAR_M counts, and of those behind only who is too near.
    """
    speed_mps = math.hypot(*wanted_mps)
    if speed_mps < EPS:
        return wanted_mps
    disks = _seen(at_m, wanted_mps, neighbours)
    if not disks and all(_permits(wall, *wanted_mps) for wall in walls):
        return wanted_mps
    meets_s = partial(_meets_in_s, horizon_s=horizon_s)
    if math.dist(moving_mps, wanted_mps) < EPS and meets_s(wanted_mps, disks, walls) >= horizon_s:
        return wanted_mps
    minded = [disk for disk in disks if not _lets_pass(disk, wanted_mps)]
    heading_mps = _most_open(wanted_mps, moving_mps, lambda v: meets_s(v, minded, walls), horizon_s)
    planes = [half_plane(d.apart_m, moving_mps, d.moving_mps, d.keep_m, horizon_s, d.share, PARTED_S) for d in disks]
    planes += walls
    if all(_permits(plane, *heading_mps) for plane in planes):
        return heading_mps
    x_mps, y_mps = best_velocity(planes, np.array(heading_mps), speed_mps).tolist()
    return x_mps, y_mps


def _seen(at_m: Vector, wanted_mps: Vector, neighbours: Sequence[Neighbour]) -> list[_Disk]:
    """Those who count, with the distance to keep from each: two radii, or what there is between them now."""
    disks = []
    for one in neighbours:
        dx, dy = one.x_m - at_m[0], one.y_m - at_m[1]
        far_m = math.hypot(dx, dy)
        ahead = dx * wanted_mps[0] + dy * wanted_mps[1] > 0.0
        if far_m < NEAR_M and (ahead or far_m < LEAST_M):
            keep_m = min(2 * PERSON_RADIUS_M, max(GIVES * far_m, LEAST_M))
            disks.append(_Disk((dx, dy), (one.vx_mps, one.vy_mps), keep_m, one.share))
    return disks


def _lets_pass(disk: _Disk, wanted_mps: Vector) -> bool:
    """Whether somebody who steers the same way crosses from the left: of two, the one from the right goes first."""
    (dx, dy), (vx, vy), (x, y) = disk.apart_m, disk.moving_mps, wanted_mps
    across = x * vy - y * vx < -CROSSING * math.hypot(x, y) * math.hypot(vx, vy)
    return disk.share < 1.0 and across and x * dy - y * dx > 0.0


def _most_open(wanted_mps: Vector, moving_mps: Vector, meets_s: Callable[[Vector], float], horizon_s: float) -> Vector:
    """The wanted velocity, turned no more than needed to meet nobody within the horizon; else to meet the latest.

    Of two that are turned alike, that on the side to which one moves already; to the right for who moves straight.
    """
    x, y = wanted_mps
    best, latest_s = wanted_mps, meets_s(wanted_mps)
    side = 1.0 if x * moving_mps[1] - y * moving_mps[0] > EPS else -1.0
    for k in range(2, 2 * TURNS + 2):
        if latest_s >= horizon_s:
            break
        turn_rad = (side if k % 2 == 0 else -side) * (k // 2) * TURN_RAD
        cos, sin = math.cos(turn_rad), math.sin(turn_rad)
        turned = (cos * x - sin * y, sin * x + cos * y)
        in_s = meets_s(turned)
        if in_s > latest_s:
            best, latest_s = turned, in_s
    return best


def _meets_in_s(velocity_mps: Vector, disks: Sequence[_Disk], walls: Sequence[HalfPlane], *, horizon_s: float) -> float:
    """When who goes on so comes too near to somebody, at most `horizon_s`; 0 where a wall is in the way."""
    if not all(_permits(wall, *velocity_mps) for wall in walls):
        return 0.0
    soonest_s = horizon_s
    for (dx, dy), (vx, vy), keep_m, _ in disks:
        rx, ry = velocity_mps[0] - vx, velocity_mps[1] - vy
        closing = dx * rx + dy * ry
        if closing <= 0.0:
            continue
        pace = rx * rx + ry * ry
        within = closing * closing - pace * (dx * dx + dy * dy - keep_m * keep_m)
        if within > 0.0:
            soonest_s = min(soonest_s, max((closing - math.sqrt(within)) / pace, 0.0))
    return soonest_s


def _permits(plane: HalfPlane, x_mps: float, y_mps: float) -> bool:
    return plane.nx * x_mps + plane.ny * y_mps - plane.offset >= -EPS
