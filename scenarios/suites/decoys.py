"""Decoys of reactive scenarios, where their people stay, and limits by the proofs of the expert."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final

import msgspec
import shapely

from cosim.core.state import PERSON_RADIUS_M
from cosim.spec.events import EventKinds
from cosim.spec.obstacle import footprint
from cosim.spec.scenario import Scenario
from scenarios.events import EVENT_KINDS

DECOY: Final = "-decoy"
"""End of a decoy's id, after that of its scenario."""
LIMIT_FACTOR: Final = 1.5
"""Time limit of a short scenario as a multiple of the expert's time, without LIMIT_MORE_S."""
DECOY_FACTOR: Final = 1.3
"""The same for decoys."""
LIMIT_MORE_S: Final = 3.0
GO_ON_SHARE: Final = 0.6
"""Least mean speed past the person of a decoy, as a share of the expert's."""
DRAWN_GO_ON_MPS: Final = 0.8
"""Least mean speed past the person of a drawn scenario, near the middle of those of `reactive`."""
_TICKS_PER_S: Final = 20
_GO_ON_DIGITS: Final = 4


def decoy_of(scenario: Scenario, kinds: EventKinds = EVENT_KINDS) -> Scenario:
    """Return the decoy of a scenario: equal until its event begins, and ending at the goal.

    Raises SpecError if a kind of its events has no decoys.
    """
    return msgspec.structs.replace(
        scenario,
        id=scenario.id + DECOY,
        decoy_of=scenario.id,
        events=tuple(kinds[event.kind].decoy_of(event) for event in scenario.events),
        ends_at="goal",
    )


def has_decoy(scenario: Scenario) -> bool:
    """Return whether a scenario must have a decoy: short ones with an event."""
    return scenario.ends_on_failure and bool(scenario.events) and not scenario.decoy_of


def must_give_way(scenario: Scenario, kinds: EventKinds = EVENT_KINDS) -> bool:
    """Return whether the robot must give way in a scenario, at the pace that its decoy requires."""
    return has_decoy(scenario) and any(kinds[event.kind].gives_way for event in scenario.events)


def differing_fields(scenario: Scenario, decoy: Scenario) -> list[str]:
    """Return the fields in which a decoy differs from its scenario, but must not."""
    should = msgspec.structs.replace(
        decoy_of(scenario), time_limit_s=decoy.time_limit_s, go_on_mps=decoy.go_on_mps
    )
    return [
        name for name in decoy.__struct_fields__ if getattr(decoy, name) != getattr(should, name)
    ]


def people_in_obstacles(scenario: Scenario) -> Iterator[str]:
    """Yield the people of a short scenario who may stay inside an obstacle after the trigger."""
    if not scenario.ends_on_failure or not scenario.obstacles:
        return
    obstacles = shapely.union_all([footprint(one) for one in scenario.obstacles])
    for event in scenario.events:
        for number in range(event.people):
            places = EVENT_KINDS[event.kind].stays_of(event, number)
            inside_m = PERSON_RADIUS_M - obstacles.distance(shapely.MultiPoint(places).convex_hull)
            if places and inside_m > 0.0:
                yield f"person '{event.names[number]}' stays {inside_m:.2f} m inside an obstacle"


def time_limit_s(scenario: Scenario, expert_s: float) -> float:
    """Return the time limit of a short scenario that the expert solves in expert_s, whole ticks."""
    factor = DECOY_FACTOR if scenario.decoy_of else LIMIT_FACTOR
    ticks = math.ceil((factor * expert_s + LIMIT_MORE_S) * _TICKS_PER_S - 1e-6)
    return ticks / _TICKS_PER_S


def least_pace_mps(scenario: Scenario, expert_mps: float | None) -> float:
    """Return `go_on_mps` of a scenario past whose person the expert drives at expert_mps.

    It follows from this speed in decoys in which nothing happens. A scenario in which the robot
    must give way has that of its decoy already. It is 0 for all others.
    """
    if must_give_way(scenario):
        return scenario.go_on_mps
    if expert_mps is None or not any(event.decoy for event in scenario.events):
        return 0.0
    return round(GO_ON_SHARE * expert_mps, _GO_ON_DIGITS)


def paced(scenario: Scenario) -> Scenario:
    """Return a drawn scenario with the rules of its kind, though no proof says how fast to go on.

    Events in which the robot must give way, and decoys in which nothing happens, get
    `DRAWN_GO_ON_MPS`. Others are returned as they are.
    """
    judged = must_give_way(scenario) or any(event.decoy for event in scenario.events)
    return msgspec.structs.replace(scenario, go_on_mps=DRAWN_GO_ON_MPS) if judged else scenario


def limited(scenario: Scenario, expert_s: float, expert_mps: float | None) -> Scenario:
    """Return the scenario with the limits that follow from its proof.

    Scenarios that do not end on a failure keep their limits.
    """
    if not scenario.ends_on_failure:
        return scenario
    return msgspec.structs.replace(
        scenario,
        time_limit_s=time_limit_s(scenario, expert_s),
        go_on_mps=least_pace_mps(scenario, expert_mps),
    )
