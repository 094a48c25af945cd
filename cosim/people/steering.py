"""Steering of directed people around other people: an open heading, then ORCA half-planes.

ORCA alone stops before a standing person. So the preferred velocity is first turned to the nearest
heading that is free for a while. This follows RVO's choice among velocities: J. van den Berg, M.
Lin, D. Manocha, "Reciprocal velocity obstacles for real-time multi-agent navigation", ICRA 2008.
Then the half-planes of `cosim.people.orca` share the avoidance between people who see each other.
They slow down those without a free heading.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from cosim.core.state import DIRECTED, PERSON_RADIUS_M, People, PersonKind
from cosim.people.orca import HalfPlane, best_velocity, half_plane
from cosim.spec.events import NearbyPerson

STEERING_NEAR_M: Final = 4.0
"""Distance in metres within which people are considered."""

HORIZON_S: Final = 2.0
"""Time horizon of the steering and of the half-planes in seconds."""

PASSING_DISTANCE_M: Final = 2 * PERSON_RADIUS_M
"""Preferred distance between the centres of people who pass each other, in metres."""

SHOULDER_TO_SHOULDER_M: Final = 0.45
"""Distance between centres at which shoulders touch, in metres: used if no heading is free. People
who are closer separate."""

SEPARATION_TIME_S: Final = 0.5
"""Time in which people who are too close separate, in seconds."""

TURNS: Final = tuple(
    (math.cos(math.radians(turn)), math.sin(math.radians(turn))) for turn in range(10, 120, 10)
)
"""Cosine and sine of the turns that are tried to either side, 10 to 110 degrees."""

MIN_DISTANCE_SHARE: Final = 0.98
"""Share of their distance that people closer than two radii keep at least."""

_CROSSING: Final = 0.35
"""Sine of the angle from which two ways cross."""

_EPS: Final = 1e-9
"""Tolerance for rounding, in the units of its use."""

Vector = tuple[float, float]


class Neighbour(NamedTuple):
    """Another person: position (m), velocity (m/s) and behaviour.

    share: share of the avoidance for the steering person: 1 if the neighbour does not react, 1/2 if
        it steers in the same way.
    """

    x_m: float
    y_m: float
    vx_mps: float = 0.0
    vy_mps: float = 0.0
    share: float = 1.0


class _Disk(NamedTuple):
    """Neighbour relative to the steering person: offset, velocity and distance to keep."""

    offset_m: Vector
    velocity_mps: Vector
    keep_m: float
    share: float
    room_m2: float
    """Squared distance minus the squared distance to keep."""


def steered(
    position_m: Vector,
    velocity_mps: Vector,
    preferred_mps: Vector,
    neighbours: Sequence[Neighbour],
    *,
    horizon_s: float = HORIZON_S,
    room_m: float = PASSING_DISTANCE_M,
    walls: Sequence[HalfPlane] = (),
) -> Vector:
    """Return the velocity (m/s) of a person, no faster than preferred.

    It is exactly the preferred velocity if the way is free, or if that is zero.

    position_m: position.
    velocity_mps: current velocity.
    preferred_mps: preferred velocity.
    neighbours: other people; those beyond STEERING_NEAR_M, or behind and not too close, are
        ignored.
    horizon_s: time horizon; shorter for a person who arrives earlier.
    room_m: preferred distance between centres; less for a person in a hurry.
    walls: half-planes of velocities that stay on the permitted ground.
    """
    speed_mps = math.hypot(*preferred_mps)
    if speed_mps < _EPS:
        return preferred_mps
    disks = _relevant_disks(position_m, preferred_mps, neighbours, room_m)
    if not disks and all(_permits(wall, *preferred_mps) for wall in walls):
        return preferred_mps
    if (
        math.dist(velocity_mps, preferred_mps) < _EPS
        and _time_to_encounter_s(*preferred_mps, disks, walls, horizon_s) >= horizon_s
    ):
        return preferred_mps
    heading_mps, is_open = _freest_heading(preferred_mps, velocity_mps, disks, walls, horizon_s)
    if not is_open:
        disks = _relevant_disks(position_m, preferred_mps, neighbours, SHOULDER_TO_SHOULDER_M)
        heading_mps, _ = _freest_heading(preferred_mps, velocity_mps, disks, walls, horizon_s)
    planes = [
        half_plane(
            d.offset_m,
            velocity_mps,
            d.velocity_mps,
            d.keep_m,
            horizon_s,
            d.share,
            SEPARATION_TIME_S,
        )
        for d in disks
    ]
    planes += walls
    if all(_permits(plane, *heading_mps) for plane in planes):
        return heading_mps
    x_mps, y_mps = best_velocity(planes, np.array(heading_mps), speed_mps).tolist()
    return x_mps, y_mps


def _relevant_disks(
    position_m: Vector, preferred_mps: Vector, neighbours: Sequence[Neighbour], room_m: float
) -> list[_Disk]:
    """Return the relevant neighbours and the distance to keep: `room_m`, or the current distance if
    less."""
    disks = []
    for one in neighbours:
        dx, dy = one.x_m - position_m[0], one.y_m - position_m[1]
        far_m = math.hypot(dx, dy)
        ahead = dx * preferred_mps[0] + dy * preferred_mps[1] > 0.0
        if far_m < STEERING_NEAR_M and (ahead or far_m < SHOULDER_TO_SHOULDER_M):
            keep_m = min(room_m, max(MIN_DISTANCE_SHARE * far_m, SHOULDER_TO_SHOULDER_M))
            room_m2 = dx * dx + dy * dy - keep_m * keep_m
            disks.append(_Disk((dx, dy), (one.vx_mps, one.vy_mps), keep_m, one.share, room_m2))
    return disks


def _neighbour_yields(disk: _Disk, preferred_mps: Vector) -> bool:
    """Return whether a steering neighbour yields because it crosses from the left."""
    (dx, dy) = disk.offset_m
    (vx, vy) = disk.velocity_mps
    (x, y) = preferred_mps
    across = x * vy - y * vx < -_CROSSING * math.hypot(x, y) * math.hypot(vx, vy)
    return disk.share < 1.0 and across and x * dy - y * dx > 0.0


def _freest_heading(
    preferred_mps: Vector,
    velocity_mps: Vector,
    disks: Sequence[_Disk],
    walls: Sequence[HalfPlane],
    horizon_s: float,
) -> tuple[Vector, bool]:
    """Return the preferred velocity with the least turn that is free within the horizon, and True.

    If none is free, return the one with the latest encounter, and False. Of equal turns to both
    sides, the side of the current motion wins; for straight motion the right.
    """
    x, y = preferred_mps
    disks = [disk for disk in disks if not _neighbour_yields(disk, preferred_mps)]
    best = preferred_mps
    latest_s = _time_to_encounter_s(x, y, disks, walls, horizon_s)
    if latest_s >= horizon_s:
        return best, True
    side = 1.0 if x * velocity_mps[1] - y * velocity_mps[0] > _EPS else -1.0
    for cos, sin in TURNS:
        for aside in (side * sin, -side * sin):
            turned = (cos * x - aside * y, aside * x + cos * y)
            in_s = _time_to_encounter_s(*turned, disks, walls, horizon_s, latest_s)
            if in_s >= horizon_s:
                return turned, True
            if in_s > latest_s:
                best, latest_s = turned, in_s
    return best, False


def _time_to_encounter_s(
    x_mps: float,
    y_mps: float,
    disks: Sequence[_Disk],
    walls: Sequence[HalfPlane],
    horizon_s: float,
    enough_s: float = -1.0,
) -> float:
    """Return the time to the first encounter at a velocity, at most `horizon_s`; 0 at a wall.

    enough_s: the search stops when an encounter before this time is found.
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
    """Return the people within STEERING_NEAR_M of directed ones, in the order of the street.

    People of events are omitted, because their states are in the query. Injected people are
    included, so that they see each other.
    """
    if not people.kind.any():  # only crowd
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
    columns = zip(rows, people.xy[rows].tolist(), vx, vy, people.kind[rows].tolist(), strict=True)
    return tuple(
        NearbyPerson(people.ids[i], x, y, u, v, PersonKind(kind))
        for i, (x, y), u, v, kind in columns
    )
