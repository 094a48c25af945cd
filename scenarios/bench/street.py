"""What a step of the street costs: SUMO's crowd with the robot and four event pedestrians mirrored in, nothing else."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Final, NamedTuple

import msgspec

from cosim.core.clock import Clock
from cosim.core.geometry import Pose
from cosim.core.state import PersonKind, RobotState
from cosim.spec.events import Actor, EventReply
from cosim.spec.scenario import CrowdSpec
from scenarios.bench.speed import Spent, alone, scenario_in

_PERSONS: Final = (50, 150)
VEHICLES: Final = 20
MEASURED_TICKS: Final = 1200
WARM_UP_TICKS: Final = 100
PACE_MPS: Final = 1.0
_AHEAD_M: Final = 6.0
"""The event pedestrians walk abreast this far before the robot."""

CAST: Final = 4
_ABREAST_M: Final = 0.7


class StreetStep(NamedTuple):
    """Wall milliseconds of a step on the mean, and of them inside SUMO's own step; shown: people, on the mean."""

    ms: float
    engine_ms: float
    shown: float


def time_street(rounds: int, tell: Callable[[str], None]) -> dict[int, list[StreetStep]]:
    """Each of PERSONS `rounds` times, every time in a fresh process."""
    found: dict[int, list[StreetStep]] = {persons: [] for persons in _PERSONS}
    for k in range(rounds):
        for persons in _PERSONS:
            tell(f"street of {persons} persons, round {k + 1} of {rounds}")
            found[persons].append(alone(street_step, persons))
    return found


def street_step(persons: int) -> StreetStep:
    """Walk a robot down a long-horizon route among so many persons for a simulated minute."""
    import sumo_nets.engine
    from scenarios.execution.wiring import crowd_of

    inside = Spent(float)
    scenario = msgspec.structs.replace(scenario_in(2000.0), crowd=CrowdSpec(persons=persons, vehicles=VEHICLES))
    line = scenario.route_line
    sumo_nets.engine.put_crowd_stopwatch(inside.timed)
    spent_s = shown = 0.0
    with crowd_of(scenario) as crowd:
        for tick in range(WARM_UP_TICKS + MEASURED_TICKS):
            if tick == WARM_UP_TICKS:
                inside.clear()
                spent_s = shown = 0.0
            way_m = PACE_MPS * Clock().tick_s * tick
            reply = EventReply(episode="", tick=tick, states=(), actors=cast(line.at(way_m + _AHEAD_M)))
            began = time.perf_counter()
            street = crowd.step(RobotState(line.at(way_m), PACE_MPS), reply)
            spent_s += time.perf_counter() - began
            shown += len(street.people)
    per_tick = 1.0 / MEASURED_TICKS
    return StreetStep(1000.0 * spent_s * per_tick, 1000.0 * inside["crowd"] * per_tick, shown * per_tick)


def cast(middle: Pose) -> tuple[Actor, ...]:
    """CAST people abreast of each other, walking ahead."""
    x_m, y_m, heading_rad = middle
    return tuple(
        Actor(
            id=f"e{k}",
            x_m=x_m - left_m * math.sin(heading_rad),
            y_m=y_m + left_m * math.cos(heading_rad),
            heading_rad=heading_rad,
            speed_mps=PACE_MPS,
            doing="walk",
            kind=PersonKind.EVENT,
        )
        for k, left_m in enumerate(_ABREAST_M * (n - (CAST - 1) / 2) for n in range(CAST))
    )
