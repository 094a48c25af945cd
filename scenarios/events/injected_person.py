"""Injected pedestrians: walk a path, stay at its end for a given time, then disappear.

They avoid people and the robot. An occupied point of the path counts as reached once the person is
near it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import msgspec
import numpy as np

from cosim.core.state import Age, PersonKind
from cosim.people.yielding import STEP_ROUND_GAP_M, touches
from cosim.spec.events import INJECTED_ID, Actor, EventQuery, Walker
from cosim.spec.injection import Injected, Injection
from scenarios.events.sight import STANDING_MPS, STOPS_NEAR_M, goal_occupied, sight_of_injected
from scenarios.events.walking import robot_body, turn_towards, walk_to


class InjectedPerson(NamedTuple):
    """State of an injected pedestrian.

    leg: Index of the path point it walks to.
    arrived_tick: Tick of arrival at the last point; None while walking.
    moved_m: Metres moved in the last tick.
    """

    injection: Injection
    walker: Walker
    leg: int = 1
    arrived_tick: int | None = None
    moved_m: float = 0.0


def spawn_injected(injected: Injected) -> InjectedPerson:
    """Return an injected person at its first point, facing the second."""
    injection = injected.injection
    (x, y), *others = injection.path
    facing = injection.heading_rad or 0.0
    if others:
        facing = math.atan2(others[0][1] - y, others[0][0] - x)
    return InjectedPerson(
        injection, Walker(x_m=x, y_m=y, heading_rad=facing), 1, None if others else injected.tick
    )


def step_injected(person: InjectedPerson, query: EventQuery) -> InjectedPerson | None:
    """Advance an injected person by one tick; None once it disappears."""
    injection, walker = person.injection, person.walker
    if person.arrived_tick is not None:
        if (query.tick - person.arrived_tick) * query.tick_ms / 1000 >= injection.stay_s:
            return None
        if injection.heading_rad is not None:
            heading = turn_towards(walker.heading_rad, injection.heading_rad, query.tick_ms / 1000)
            walker = msgspec.structs.replace(walker, heading_rad=heading)
        return person._replace(
            walker=msgspec.structs.replace(walker, vx_mps=0.0, vy_mps=0.0), moved_m=0.0
        )
    goal = injection.path[person.leg]
    sight = sight_of_injected(actor_id(injection), walker, query)
    after = walk_to(walker, *goal, injection.speed_mps, sight)
    reached = (
        (after.x_m, after.y_m) == goal
        or goal_occupied(walker, goal, sight)
        or _robot_stands_at(goal, walker, query)
    )
    vx_mps, vy_mps = (
        (b - a) * 1000 / query.tick_ms
        for a, b in ((walker.x_m, after.x_m), (walker.y_m, after.y_m))
    )
    after = msgspec.structs.replace(after, vx_mps=vx_mps, vy_mps=vy_mps)
    moved_m = math.hypot(after.x_m - walker.x_m, after.y_m - walker.y_m)
    leg = person.leg + reached
    arrived = query.tick if leg == len(injection.path) else None
    return person._replace(
        walker=after, leg=min(leg, len(injection.path) - 1), arrived_tick=arrived, moved_m=moved_m
    )


def _robot_stands_at(goal: tuple[float, float], walker: Walker, query: EventQuery) -> bool:
    """Return whether a standing robot blocks a point that the walker has come near."""
    near = math.dist((walker.x_m, walker.y_m), goal) < STOPS_NEAR_M
    return (
        near
        and abs(query.robot_v_mps) < STANDING_MPS
        and touches(np.array(goal), robot_body(query), STEP_ROUND_GAP_M)
    )


def actor_id(injection: Injection) -> str:
    """Return the id of an injected person in the world."""
    return f"{INJECTED_ID}{injection.id}"


def injected_actor(person: InjectedPerson, tick_ms: int) -> Actor:
    """Return the actor of an injected person; one that is blocked on the way stands."""
    walker = person.walker
    still = "stand" if person.arrived_tick is None else person.injection.doing
    return Actor(
        id=actor_id(person.injection),
        x_m=walker.x_m,
        y_m=walker.y_m,
        heading_rad=walker.heading_rad,
        speed_mps=person.moved_m * 1000 / tick_ms,
        doing=still if person.moved_m < 1e-6 else "walk",
        kind=PersonKind.INJECTED,
        age=Age[person.injection.age.upper()],
    )
