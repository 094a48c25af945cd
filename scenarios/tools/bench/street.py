"""What a step of the street costs: SUMO's crowd with the robot and four event pedestrians mirrored
in, nothing else."""

from __future__ import annotations

import math
import time
from typing import Final

import msgspec

from cosim.core.clock import Clock
from cosim.core.geometry import Pose
from cosim.core.state import PersonKind, RobotState
from cosim.spec.events import Actor, EventReply
from cosim.spec.scenario import CrowdSpec
from scenarios.tools.bench.driving import scenario_in
from scenarios.tools.bench.figures import Figure, Spent

_VEHICLES: Final = 20
_MEASURED_TICKS: Final = 1200
_WARM_UP_TICKS: Final = 100
_PACE_MPS: Final = 1.0
_AHEAD_M: Final = 6.0
"""The event pedestrians walk abreast this far before the robot."""

_CAST: Final = 4
_ABREAST_M: Final = 0.7


def walking(persons: int) -> list[Figure]:
    """Walk a robot down a long-horizon route among so many persons for a simulated minute."""
    import sumo_nets.engine
    from scenarios.episodes.wiring import crowd_of

    inside = Spent(float)
    scenario = msgspec.structs.replace(
        scenario_in(2000.0), crowd=CrowdSpec(persons=persons, vehicles=_VEHICLES)
    )
    line = scenario.route_line
    sumo_nets.engine.put_crowd_stopwatch(inside.timed)
    spent_s = 0.0
    with crowd_of(scenario) as crowd:
        for tick in range(_WARM_UP_TICKS + _MEASURED_TICKS):
            if tick == _WARM_UP_TICKS:
                inside.clear()
                spent_s = 0.0
            way_m = _PACE_MPS * Clock().tick_s * tick
            reply = EventReply(
                episode="", tick=tick, states=(), actors=_cast(line.at(way_m + _AHEAD_M))
            )
            began = time.perf_counter()
            crowd.step(RobotState(line.at(way_m), _PACE_MPS), reply)
            spent_s += time.perf_counter() - began
    ms, engine_ms = (1000.0 * seconds / _MEASURED_TICKS for seconds in (spent_s, inside["crowd"]))
    return [
        Figure(
            f"step of the street, {persons} persons, ms",
            ms,
            engine_ms,
            "SUMO's own step",
            2.0,
            reach_ratio=True,
        )
    ]


def _cast(middle: Pose) -> tuple[Actor, ...]:
    """_CAST people abreast of each other, walking ahead."""
    x_m, y_m, heading_rad = middle
    return tuple(
        Actor(
            id=f"e{k}",
            x_m=x_m - left_m * math.sin(heading_rad),
            y_m=y_m + left_m * math.cos(heading_rad),
            heading_rad=heading_rad,
            speed_mps=_PACE_MPS,
            doing="walk",
            kind=PersonKind.EVENT,
        )
        for k, left_m in enumerate(_ABREAST_M * (n - (_CAST - 1) / 2) for n in range(_CAST))
    )
