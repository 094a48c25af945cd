"""How one who walks steers round others: a way that is open, then ORCA's half-planes.

ORCA alone stops before somebody who stands in the way and stays there. So the wanted velocity is
turned first to the nearest heading that is open for a while (RVO's choice among velocities: J. van
den Berg, M. Lin, D. Manocha, "Reciprocal velocity obstacles for real-time multi-agent navigation",
ICRA 2008); the half-planes of `cosim.people.orca` then share the avoidance between those who see
each other, and slow down who finds nothing open."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from cosim.core.state import DIRECTED, PERSON_RADIUS_M, People, PersonKind
from cosim.people.orca import HalfPlane, best_velocity, half_plane
from cosim.spec.events import NearbyPerson

STEERING_NEAR_M: Final = 4.0
"""Who is farther away is not looked at."""

HORIZON_S: Final = 2.0
"""How far ahead one looks; half-planes too."""

ROOM_M: Final = 2 * PERSON_RADIUS_M
"""Middles of two people who pass keep so far apart, as long as that leaves a way."""

SHOULDER_TO_SHOULDER_M: Final = 0.45
"""Middles of two people who touch shoulders: one squeezes through where nothing else is open.
Nearer ones part."""

PARTED_S: Final = 0.5
"""In this time those who are too near are parted."""

TURNS: Final = tuple(
    (math.cos(math.radians(turn)), math.sin(math.radians(turn))) for turn in range(10, 120, 10)
)
"""Cosine and sine of the turns that are tried to either side: in steps of 10 degrees, beyond a
right angle."""

GIVES: Final = 0.98
"""Those who stand nearer than two radii come no nearer than this share of their distance."""

_CROSSING: Final = 0.35
"""Sine of the angle between two ways from which on they cross."""

_EPS: Final = 1e-9

Vector = tuple[float, float]


class Neighbour(NamedTuple):
    """Somebody else: where (m), how it moves (m/s), and how much of the avoidance it leaves to the
    one who steers.

    share: 1 for who pays no heed, 1/2 for who steers the same way.
    """

    x_m: float
    y_m: float
    vx_mps: float = 0.0
    vy_mps: float = 0.0
    share: float = 1.0


class _Disk(NamedTuple):
    """A neighbour as the one who steers sees it: from here to it in metres, its velocity, the
    distance to keep."""

    apart_m: Vector
    moving_mps: Vector
    keep_m: float
    share: float
    room_m2: float
    """The square of the distance minus that of the distance to keep."""


def steered(
    at_m: Vector,
    moving_mps: Vector,
    wanted_mps: Vector,
    neighbours: Sequence[Neighbour],
    *,
    horizon_s: float = HORIZON_S,
    room_m: float = ROOM_M,
    walls: Sequence[HalfPlane] = (),
) -> Vector:
    """The velocity (m/s) of one person who is at `at_m`, moves with `moving_mps` and wants
    `wanted_mps`.

    No faster than wanted; exactly as wanted, to the bit, where nobody is in the way. One who wants
    to stand stands. horizon_s: how far ahead to look; less for one who arrives before. room_m:
    between middles, where that is to be had; less for one in a hurry. walls: half-planes of
    velocities that stay on the ground one may walk on. Only who is nearer than NEAR_M counts, and
    of those behind only who is too near.
    """
    speed_mps = math.hypot(*wanted_mps)
    if speed_mps < _EPS:
        return wanted_mps
    disks = _seen(at_m, wanted_mps, neighbours, room_m)
    if not disks and all(_permits(wall, *wanted_mps) for wall in walls):
        return wanted_mps
    if (
        math.dist(moving_mps, wanted_mps) < _EPS
        and _meets_in_s(*wanted_mps, disks, walls, horizon_s) >= horizon_s
    ):
        return wanted_mps
    heading_mps, is_open = _most_open(wanted_mps, moving_mps, disks, walls, horizon_s)
    if not is_open:
        disks = _seen(at_m, wanted_mps, neighbours, SHOULDER_TO_SHOULDER_M)
        heading_mps, _ = _most_open(wanted_mps, moving_mps, disks, walls, horizon_s)
    planes = [
        half_plane(d.apart_m, moving_mps, d.moving_mps, d.keep_m, horizon_s, d.share, PARTED_S)
        for d in disks
    ]
    planes += walls
    if all(_permits(plane, *heading_mps) for plane in planes):
        return heading_mps
    x_mps, y_mps = best_velocity(planes, np.array(heading_mps), speed_mps).tolist()
    return x_mps, y_mps


def _seen(
    at_m: Vector, wanted_mps: Vector, neighbours: Sequence[Neighbour], room_m: float
) -> list[_Disk]:
    """Those who count, with the distance to keep from each: `room_m`, or what there is between them
    now."""
    disks = []
    for one in neighbours:
        dx, dy = one.x_m - at_m[0], one.y_m - at_m[1]
        far_m = math.hypot(dx, dy)
        ahead = dx * wanted_mps[0] + dy * wanted_mps[1] > 0.0
        if far_m < STEERING_NEAR_M and (ahead or far_m < SHOULDER_TO_SHOULDER_M):
            keep_m = min(room_m, max(GIVES * far_m, SHOULDER_TO_SHOULDER_M))
            room_m2 = dx * dx + dy * dy - keep_m * keep_m
            disks.append(_Disk((dx, dy), (one.vx_mps, one.vy_mps), keep_m, one.share, room_m2))
    return disks


def _lets_pass(disk: _Disk, wanted_mps: Vector) -> bool:
    """Whether somebody who steers the same way crosses from the left: of two, the one from the
    right goes first."""
    (dx, dy) = disk.apart_m
    (vx, vy) = disk.moving_mps
    (x, y) = wanted_mps
    across = x * vy - y * vx < -_CROSSING * math.hypot(x, y) * math.hypot(vx, vy)
    return disk.share < 1.0 and across and x * dy - y * dx > 0.0


def _most_open(
    wanted_mps: Vector,
    moving_mps: Vector,
    disks: Sequence[_Disk],
    walls: Sequence[HalfPlane],
    horizon_s: float,
) -> tuple[Vector, bool]:
    """The wanted velocity, turned no more than needed to meet nobody within the horizon, and True;
    else to meet the latest, and False.

    Of two that are turned alike, that on the side to which one moves already; to the right for who
    moves straight.
    """
    x, y = wanted_mps
    disks = [disk for disk in disks if not _lets_pass(disk, wanted_mps)]
    best = wanted_mps
    latest_s = _meets_in_s(x, y, disks, walls, horizon_s)
    if latest_s >= horizon_s:
        return best, True
    side = 1.0 if x * moving_mps[1] - y * moving_mps[0] > _EPS else -1.0
    for cos, sin in TURNS:
        for aside in (side * sin, -side * sin):
            turned = (cos * x - aside * y, aside * x + cos * y)
            in_s = _meets_in_s(*turned, disks, walls, horizon_s, latest_s)
            if in_s >= horizon_s:
                return turned, True
            if in_s > latest_s:
                best, latest_s = turned, in_s
    return best, False


def _meets_in_s(
    x_mps: float,
    y_mps: float,
    disks: Sequence[_Disk],
    walls: Sequence[HalfPlane],
    horizon_s: float,
    enough_s: float = -1.0,
) -> float:
    """When who goes on so comes too near to somebody, at most `horizon_s`; 0 where a wall is in the
    way.

    enough_s: once it is known to be no later than this, how much earlier does not matter.
    """
    for wall in walls:
        if not _permits(wall, x_mps, y_mps):
            return 0.0
    soonest_s = horizon_s
    for (dx, dy), (vx, vy), _, _, room_m2 in disks:
        rx, ry = x_mps - vx, y_mps - vy
        closing = dx * rx + dy * ry
        if closing <= 0.0:
            continue
        pace = rx * rx + ry * ry
        within = closing * closing - pace * room_m2
        if within > 0.0:
            in_s = (closing - math.sqrt(within)) / pace
            if in_s < soonest_s:
                soonest_s = max(in_s, 0.0)
                if soonest_s <= enough_s:
                    break
    return soonest_s


def _permits(plane: HalfPlane, x_mps: float, y_mps: float) -> bool:
    return plane.nx * x_mps + plane.ny * y_mps - plane.offset >= -_EPS


def nearby_people(people: People) -> tuple[NearbyPerson, ...]:
    """Those within STEERING_NEAR_M of somebody the director moves, in the order of the street; not
    the events' own people.

    The events' people are in the states of a query. Injected people are moved by the director and
    see each other here.
    """
    if not people.kind.any():  # all are of the crowd
        return ()
    moved = people.xy[people.are(*DIRECTED)]
    if not len(moved):
        return ()
    gap = people.xy[:, None] - moved[None]
    near = ((gap * gap).sum(axis=2) < STEERING_NEAR_M * STEERING_NEAR_M).any(axis=1)
    rows = np.flatnonzero(near & (people.kind != PersonKind.EVENT)).tolist()
    if not rows:
        return ()
    heading, speed = people.heading, people.speed
    vx, vy = (
        (speed[rows] * np.cos(heading[rows])).tolist(),
        (speed[rows] * np.sin(heading[rows])).tolist(),
    )
    told = zip(rows, people.xy[rows].tolist(), vx, vy, people.kind[rows].tolist(), strict=True)
    return tuple(
        NearbyPerson(people.ids[i], x, y, u, v, PersonKind(kind)) for i, (x, y), u, v, kind in told
    )
