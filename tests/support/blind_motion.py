"""Kinematic robots that drive by a schedule without sensors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from cosim.core.geometry import Pose, box_disk_gap
from cosim.spec.events import Event, EventQuery, EventState
from cosim.spec.robot import COURIER
from scenarios.events import react

TICK_S = 0.05
HALF_M = (COURIER.length_m / 2, COURIER.width_m / 2)
Outcome = Literal["solved", "hit", "out", "timeout"]


class Schedule(NamedTuple):
    """Speed, stops (driven metres, seconds) and lanes (driven metres, lateral metres)."""

    v_mps: float
    stops: Sequence[tuple[float, float]] = ()
    lanes: Sequence[tuple[float, float]] = ()


def outcome(
    planned: Event, schedule: Schedule, before_m: float, limit_s: float, after_m: float = 13.0
) -> Outcome:
    """Drive along the x axis from `before_m` before an event at x = 0 to `after_m` beyond it, and
    return the result."""
    x_m, y_m, heading, v_mps, w_radps, driven_m = -before_m, 0.0, 0.0, 0.0, 0.0, 0.0
    stops = list(schedule.stops)
    stands_until_s = math.inf
    states: tuple[EventState, ...] = ()
    for tick in range(round(limit_s / TICK_S)):
        query = EventQuery(
            episode="t",
            tick=tick,
            tick_ms=50,
            robot_x_m=x_m,
            robot_y_m=y_m,
            robot_heading_rad=heading,
            robot_v_mps=v_mps,
            robot_w_radps=w_radps,
            route_s_m=planned.route_s_m + x_m,
            robot_length_m=COURIER.length_m,
            robot_width_m=COURIER.width_m,
            events=(planned,),
            states=states,
        )
        states = react(query).states
        lane_m = ([0.0] + [left for at, left in schedule.lanes if driven_m >= at])[-1]
        wanted = schedule.v_mps
        if stops and driven_m >= stops[0][0]:
            stands_until_s = min(stands_until_s, tick * TICK_S + stops[0][1])
            wanted = 0.0
            if tick * TICK_S >= stands_until_s:
                stops, stands_until_s = stops[1:], math.inf
        change = COURIER.acceleration_mps2 * TICK_S
        v_mps += max(-change, min(change, wanted - v_mps))
        turn = 2.0 * (math.atan2(lane_m - y_m, 1.2) - heading)
        most = COURIER.w_max_radps
        w_radps = max(-most, min(most, turn)) if v_mps > 0.01 else 0.0
        heading += w_radps * TICK_S
        x_m += v_mps * math.cos(heading) * TICK_S
        y_m += v_mps * math.sin(heading) * TICK_S
        driven_m += v_mps * TICK_S
        at = np.array([(w.x_m, w.y_m) for w in states[0].walkers])
        if np.hypot(*(at - (x_m, y_m)).T).min() < 2.0:
            gaps = box_disk_gap(np.array([Pose(x_m, y_m, heading)]), *HALF_M, at[None])
            if float(gaps.min()) < 0.3:
                return "hit"
        if abs(y_m) > planned.half_width_m:
            return "out"
        if x_m > after_m:
            return "solved"
    return "timeout"
