"""What one person of an event knows in a tick: the query and the people nearby."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import msgspec

from cosim.core.state import PERSON_RADIUS_M, PersonKind
from cosim.people.orca import HalfPlane
from cosim.people.steering import (
    HORIZON_S,
    PASSING_DISTANCE_M,
    SHOULDER_TO_SHOULDER_M,
    Neighbour,
    Vector,
    steered,
)
from cosim.people.yielding import STOOD_S
from cosim.spec.events import Event, EventQuery, NearbyPerson, Walker

APPROACH_M = 1.5
"""Metres from an occupied goal below which an insisting person approaches instead of avoiding."""

STOPS_NEAR_M = 1.0
"""Metres from an occupied goal at which a person that does not insist stops."""

STANDING_MPS = 0.1
"""Speed in m/s below which a person counts as standing."""

SMALL_GAPS_AFTER_S = 3.0
"""Seconds after which a person insisting on its goal accepts smaller gaps."""
IGNORES_CROWD_AFTER_S = 6.0
"""Seconds after which a person insisting on its goal ignores the crowd."""

SAME_POSITION_M = 0.001
"""Metres below which two people count as being at the same position."""

AVOIDANCE_SHARE = 0.5
"""Fraction of the avoidance that each of two people using the same steering takes."""


class Sight(NamedTuple):
    """Knowledge of one person: the query, other people nearby, and the event whose area bounds it.

    people: Other people.
    robot: The robot as neighbours if it has stood long enough to be avoided like an obstacle.
    room_m: Gap in metres to others where possible.
    """

    query: EventQuery
    people: Sequence[Neighbour] = ()
    event: Event | None = None
    room_m: float = PASSING_DISTANCE_M
    robot: Sequence[Neighbour] = ()

    @property
    def others(self) -> list[Neighbour]:
        """People and robot to avoid."""
        return [*self.people, *self.robot]


def sight_of(event: Event, number: int, query: EventQuery, waited_s: float = 0.0) -> Sight:
    """Return the sight of a person of an event: people of all events and people nearby.

    number: Index of the person in the event.
    waited_s: Seconds it has been on its way to a goal on which it insists.
    """
    others = [
        cooperative_neighbour(walker)
        for one, state in zip(query.events, query.states, strict=False)
        if state.phase != "gone"
        for k, walker in enumerate(state.walkers)
        if (one.id, k) != (event.id, number)
    ]
    if waited_s < IGNORES_CROWD_AFTER_S:
        others += nearby_neighbours(query.nearby)
    room_m = PASSING_DISTANCE_M if waited_s < SMALL_GAPS_AFTER_S else SHOULDER_TO_SHOULDER_M
    ticks = max((state.robot_stood_ticks for state in query.states), default=0)
    stands = ticks * query.tick_ms >= 1000 * STOOD_S
    return Sight(query, others, event, room_m, standing_robot(query) if stands else ())


def standing_robot(query: EventQuery) -> list[Neighbour]:
    """Return the robot as two standing people, one behind the other."""
    quarter_m = query.robot_length_m / 4
    cos, sin = math.cos(query.robot_heading_rad), math.sin(query.robot_heading_rad)
    return [
        Neighbour(query.robot_x_m + m * cos, query.robot_y_m + m * sin)
        for m in (quarter_m, -quarter_m)
    ]


def sight_of_injected(name: str, person: Walker, query: EventQuery) -> Sight:
    """Return the sight of the injected person with this id."""
    walkers = [
        walker for state in query.states if state.phase != "gone" for walker in state.walkers
    ]
    others = (_separated(name, person, one) for one in query.nearby if one.id != name)
    return Sight(query, [*map(cooperative_neighbour, walkers), *nearby_neighbours(others)])


def _separated(name: str, person: Walker, other: NearbyPerson) -> NearbyPerson:
    """Shift a person at the same position to one side.

    Otherwise two people injected at one point would walk inside each other for ever.
    """
    if math.hypot(other.x_m - person.x_m, other.y_m - person.y_m) > SAME_POSITION_M:
        return other
    left_m = SAME_POSITION_M if name < other.id else -SAME_POSITION_M
    cos, sin = math.cos(person.heading_rad), math.sin(person.heading_rad)
    return msgspec.structs.replace(
        other, x_m=person.x_m - left_m * sin, y_m=person.y_m + left_m * cos
    )


def cooperative_neighbour(walker: Walker | NearbyPerson) -> Neighbour:
    """Return a person that uses the same steering; a standing one does not move aside."""
    moves = walker.vx_mps != 0.0 or walker.vy_mps != 0.0
    return Neighbour(
        walker.x_m, walker.y_m, walker.vx_mps, walker.vy_mps, AVOIDANCE_SHARE if moves else 1.0
    )


def nearby_neighbours(nearby: Iterable[NearbyPerson]) -> list[Neighbour]:
    """Return people nearby as neighbours; the crowd does not avoid, others do."""
    return [
        Neighbour(b.x_m, b.y_m, b.vx_mps, b.vy_mps)
        if b.kind == PersonKind.CROWD
        else cooperative_neighbour(b)
        for b in nearby
    ]


def goal_occupied(walker: Walker, goal: Vector, sight: Sight) -> bool:
    """Return whether a person stands at the walker's goal, and the walker has come near."""
    return math.dist((walker.x_m, walker.y_m), goal) < STOPS_NEAR_M and any(
        math.dist(other[:2], goal) < SHOULDER_TO_SHOULDER_M
        and math.hypot(other.vx_mps, other.vy_mps) < STANDING_MPS
        for other in sight.others
    )


def avoiding_step(
    walker: Walker,
    wanted: Vector,
    sight: Sight,
    goal: Vector | None = None,
    *,
    insisting: bool = False,
) -> Vector:
    """Return where a step to `wanted` (m) ends after avoiding people.

    goal: Where the walker is going to stop.
    insisting: Approach the goal even if it is occupied; the other person makes room.
    Returns `wanted` itself if it is free.
    """
    tick_s = sight.query.tick_ms / 1000
    at = (walker.x_m, walker.y_m)
    velocity = ((wanted[0] - at[0]) / tick_s, (wanted[1] - at[1]) / tick_s)
    others = sight.others
    horizon_s = HORIZON_S
    if goal is not None:
        far_m = math.dist(at, goal)
        horizon_s = min(HORIZON_S, max(far_m / max(math.hypot(*velocity), 1e-9), tick_s))
        if insisting and far_m < APPROACH_M:
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
        walls=edge_half_planes(walker, wanted, sight.event, tick_s),
    )
    return wanted if (vx, vy) == velocity else (at[0] + vx * tick_s, at[1] + vy * tick_s)


def edge_half_planes(
    walker: Walker, wanted: Vector, event: Event | None, tick_s: float
) -> tuple[HalfPlane, ...]:
    """Return half-planes of velocities that keep a person on the ground of its event.

    Empty for a person that is leaving it anyway.
    """
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
