"""Sight: what one person of an event knows of a tick: the query, and the people round it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import msgspec

from cosim.core.state import PERSON_RADIUS_M, PersonKind
from cosim.people.orca import HalfPlane
from cosim.people.steering import (
    HORIZON_S,
    ROOM_M,
    SHOULDER_TO_SHOULDER_M,
    Neighbour,
    Vector,
    steered,
)
from cosim.people.yielding import STOOD_S
from cosim.spec.events import Event, EventQuery, NearbyPerson, Walker

COMES_UP_M = 1.5
"""From here on, who insists on a place walks up to whoever is there, not round."""

BESIDE_M = 1.0
"""So near to a place that is taken one comes; one who does not insist on it stands there."""

STILL_MPS = 0.1
"""Slower ones stand."""

SQUEEZES_S = 3.0
PRESSES_S = 6.0
"""Who insists on a place and is not there after the first time squeezes through; after the second
the crowd gives way."""

SAME_M = 0.001
"""Who is nearer is in the same place."""

SHARED = 0.5
"""Of the avoidance between two who steer the same way."""


class Sight(NamedTuple):
    """What somebody knows: the query, the people round it but not itself, the event on whose ground
    it stays.

    room_m: what it keeps from others where it can. robot_stands: whether the robot has stood long
    enough to be walked round like anything that stands.
    """

    query: EventQuery
    others: Sequence[Neighbour] = ()
    event: Event | None = None
    room_m: float = ROOM_M
    robot_stands: bool = False


def sight_of(event: Event, number: int, query: EventQuery, waited_s: float = 0.0) -> Sight:
    """The sight of person `number` of an event: it sees its fellows, people of other events, and
    who is near.

    waited_s: how long it has been on its way to a place on which it insists.
    """
    others = [
        fellow(walker)
        for one, state in zip(query.events, query.states, strict=False)
        if state.phase != "gone"
        for k, walker in enumerate(state.walkers)
        if (one.id, k) != (event.id, number)
    ]
    if waited_s < PRESSES_S:
        others += met(query.nearby)
    room_m = ROOM_M if waited_s < SQUEEZES_S else SHOULDER_TO_SHOULDER_M
    ticks = max((state.robot_stood_ticks for state in query.states), default=0)
    stands = ticks * query.tick_ms >= 1000 * STOOD_S
    return Sight(query, others + standing_robot(query) if stands else others, event, room_m, stands)


def standing_robot(query: EventQuery) -> list[Neighbour]:
    """The robot as two who stand, one behind the other."""
    quarter_m = query.robot_length_m / 4
    cos, sin = math.cos(query.robot_heading_rad), math.sin(query.robot_heading_rad)
    return [
        Neighbour(query.robot_x_m + m * cos, query.robot_y_m + m * sin)
        for m in (quarter_m, -quarter_m)
    ]


def sight_of_injected(name: str, person: Walker, query: EventQuery) -> Sight:
    """The sight of the injected person that is shown under this id."""
    walkers = [
        walker for state in query.states if state.phase != "gone" for walker in state.walkers
    ]
    others = (_told_apart(name, person, one) for one in query.nearby if one.id != name)
    return Sight(query, [*map(fellow, walkers), *met(others)])


def _told_apart(name: str, person: Walker, other: NearbyPerson) -> NearbyPerson:
    """Who is in the very same place, as two are who are injected there at once, is seen a little to
    one side: else they would walk in each other for ever."""
    if math.hypot(other.x_m - person.x_m, other.y_m - person.y_m) > SAME_M:
        return other
    left_m = SAME_M if name < other.id else -SAME_M
    cos, sin = math.cos(person.heading_rad), math.sin(person.heading_rad)
    return msgspec.structs.replace(
        other, x_m=person.x_m - left_m * sin, y_m=person.y_m + left_m * cos
    )


def fellow(walker: Walker | NearbyPerson) -> Neighbour:
    """Somebody who steers the same way, but for who stands: that one stays."""
    moves = walker.vx_mps != 0.0 or walker.vy_mps != 0.0
    return Neighbour(walker.x_m, walker.y_m, walker.vx_mps, walker.vy_mps, SHARED if moves else 1.0)


def met(nearby: Iterable[NearbyPerson]) -> list[Neighbour]:
    """The crowd pays no heed; injected people and residents who walk steer the same way."""
    return [
        Neighbour(b.x_m, b.y_m, b.vx_mps, b.vy_mps) if b.kind == PersonKind.CROWD else fellow(b)
        for b in nearby
    ]


def place_taken(walker: Walker, goal: Vector, sight: Sight) -> bool:
    """Whether somebody stands where the walker wants to stop, and the walker has come up to
    them."""
    return math.dist((walker.x_m, walker.y_m), goal) < BESIDE_M and any(
        math.dist(other[:2], goal) < SHOULDER_TO_SHOULDER_M
        and math.hypot(other.vx_mps, other.vy_mps) < STILL_MPS
        for other in sight.others
    )


def led_round(
    walker: Walker,
    wanted: Vector,
    sight: Sight,
    goal: Vector | None = None,
    *,
    insisting: bool = False,
) -> Vector:
    """Where a step ends that should end at `wanted` (m), once it is led round people; `wanted`
    itself where it is not.

    goal: where the walker is going to stop. insisting: even if somebody is there, who will make
    room.
    """
    tick_s = sight.query.tick_ms / 1000
    at = (walker.x_m, walker.y_m)
    velocity = ((wanted[0] - at[0]) / tick_s, (wanted[1] - at[1]) / tick_s)
    others = sight.others
    horizon_s = HORIZON_S
    if goal is not None:
        far_m = math.dist(at, goal)
        horizon_s = min(HORIZON_S, max(far_m / max(math.hypot(*velocity), 1e-9), tick_s))
        if insisting and far_m < COMES_UP_M:
            others = [
                other for other in others if math.dist(other[:2], goal) > SHOULDER_TO_SHOULDER_M
            ]
    if not others:
        return wanted
    vx, vy = steered(
        at,
        (walker.vx_mps, walker.vy_mps),
        velocity,
        others,
        horizon_s=horizon_s,
        room_m=sight.room_m,
        walls=edges(walker, wanted, sight.event, tick_s),
    )
    return wanted if (vx, vy) == velocity else (at[0] + vx * tick_s, at[1] + vy * tick_s)


def edges(
    walker: Walker, wanted: Vector, event: Event | None, tick_s: float
) -> tuple[HalfPlane, ...]:
    """The velocities that keep somebody on the sidewalk or crosswalk of its event; none for who
    leaves it anyway."""
    if event is None:
        return ()
    ahead_x, ahead_y = math.cos(event.heading_rad), math.sin(event.heading_rad)
    left_m = ahead_x * (walker.y_m - event.y_m) - ahead_y * (walker.x_m - event.x_m)
    wanted_left_m = ahead_x * (wanted[1] - event.y_m) - ahead_y * (wanted[0] - event.x_m)
    room_m = event.half_width_m - PERSON_RADIUS_M
    if max(abs(left_m), abs(wanted_left_m)) > room_m + 1e-6:
        return ()
    return (
        HalfPlane(ahead_y, -ahead_x, (left_m - room_m) / tick_s),
        HalfPlane(-ahead_y, ahead_x, (-left_m - room_m) / tick_s),
    )
