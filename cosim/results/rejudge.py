"""Evidence: what a record says came out of an episode, held against the trajectory that was
recorded with it.

From the trajectory alone follow how long it was, where and how fast the robot was at each failure,
when it was put back, how it came forward on its route, every freezing, and its end. Recorded as
they were found, because only the engines can find them, are contacts, being off the walkable area,
crossings entered at red, what became of events.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from cosim.core.clock import Clock
from cosim.core.geometry import Floats, Polyline
from cosim.episode.command_delay import median_ms
from cosim.episode.loop import ROUTE_WINDOW_M
from cosim.people.yielding import ROBOT_STANDS_MPS
from cosim.results.log import Log
from cosim.results.record import Ended, Record
from cosim.results.referee import STOP_S, FreezeWindow, at_goal, is_round, near_goal
from cosim.spec.scenario import Scenario

_ROUNDING_M = 1e-9
_BLOCK_TICKS = 2000
"""So many at a time need a few MiB."""


class Contradiction(NamedTuple):
    """What a record says, and what its trajectory shows instead."""

    what: str
    recorded: object
    shown: object


def contradictions(record: Record, scenario: Scenario, log: Log) -> Iterator[Contradiction]:
    """Where a record is not what its trajectory shows; nothing where all of it is."""
    if record.ticks != len(log):
        yield Contradiction("ticks", record.ticks, len(log))
        return
    if record.setup.real_time and record.setup.latency_ms != (
        latency_ms := median_ms(log.answers, Clock().tick_ms)
    ):
        yield Contradiction("latency_ms", record.setup.latency_ms, latency_ms)
    yield from _failures_as_driven(record, log)
    yield from _resets(record, scenario, log)
    yield from _red_entries(record, scenario, log)
    yield from _way(scenario, log)
    yield from _freezings(record, scenario, log)
    if record.ended not in (ends := _ends(record, scenario, log)):
        yield Contradiction("ended", record.ended, " or ".join(ends) or "not yet over")


def _failures_as_driven(record: Record, log: Log) -> Iterator[Contradiction]:
    start_mps = np.abs(
        np.where(np.isfinite(_before(log.reset_s_m, np.nan)), 0.0, _before(log.speed[:, 0], 0.0))
    )
    for failure in (*record.failures, *record.walked_into):
        told = (failure.x_m, failure.y_m, failure.route_s_m, failure.robot_speed_mps)
        k = failure.tick
        shown = (
            (*log.pose[k, :2].tolist(), float(log.route_s_m[k]), float(start_mps[k]))
            if k < len(log)
            else ()
        )
        if told != shown:
            yield Contradiction(
                f"{failure.kind} at tick {k}: x_m, y_m, route_s_m, robot_speed_mps", told, shown
            )


def _resets(record: Record, scenario: Scenario, log: Log) -> Iterator[Contradiction]:
    """After every tick with failures the robot is put back, but where they end the episode."""
    failed = sorted({failure.tick for failure in record.failures} - {len(log) - 1})
    resets = np.flatnonzero(np.isfinite(log.reset_s_m)).tolist()
    if failed != resets:
        k = min({*failed} ^ {*resets})
        yield Contradiction(f"failures at tick {k}", int(k in failed), int(k in resets))


def _red_entries(record: Record, scenario: Scenario, log: Log) -> Iterator[Contradiction]:
    """Whatever the signal showed, the robot was on the crossing then."""
    crossings = {crossing.id: crossing for crossing in scenario.crossings}
    for entry in record.red_light_entries:
        crossing = crossings.get(entry.crossing)
        s_m = [*log.route_s_m[entry.tick : entry.tick + 1].tolist()]
        if crossing is None or not s_m or not crossing.enter_s_m < s_m[0] < crossing.leave_s_m:
            yield Contradiction(
                f"red_light_entries at tick {entry.tick}",
                entry.crossing,
                f"at {s_m} m of the route",
            )


def _way(scenario: Scenario, log: Log) -> Iterator[Contradiction]:
    """Arc lengths are those of the poses, and no tick went farther than was travelled in it."""
    reset_to_m = _before(log.reset_s_m, 0.0)
    last_m = np.where(np.isnan(reset_to_m), _before(log.route_s_m, 0.0), reset_to_m)
    shown_m = places_on_route(scenario.route_line, log.pose, last_m)
    if len(apart := np.flatnonzero(shown_m != log.route_s_m)):
        k = int(apart[0])
        yield Contradiction(f"route_s_m at tick {k}", float(log.route_s_m[k]), float(shown_m[k]))
        return
    went_m = np.hypot(*np.diff(log.pose[:, :2], axis=0).T)
    short = (
        np.flatnonzero((went_m > log.travelled_m[1:] + _ROUNDING_M) & np.isnan(log.reset_s_m[:-1]))
        + 1
    )
    if len(short):
        k = int(short[0])
        yield Contradiction(
            f"travelled_m at tick {k}", float(log.travelled_m[k]), f"{went_m[k - 1]} or more"
        )


def places_on_route(route: Polyline, pose: Floats, last_s_m: Floats) -> Floats:
    """(T,) what `cosim.episode.loop.place_on_route` gives, to the bit, for (T, 3) poses and last
    arc lengths (T,)."""
    first = np.maximum(np.searchsorted(route.s_m, last_s_m - ROUTE_WINDOW_M, side="right") - 1, 0)
    steps = np.diff(route.points, axis=0)
    lengths = np.hypot(steps[:, 0], steps[:, 1])
    directions = steps / lengths[:, None]
    first = np.minimum(first, len(lengths) - 1)
    last = np.minimum(
        np.searchsorted(route.s_m, last_s_m + ROUTE_WINDOW_M, side="left"), len(lengths)
    )
    last = np.maximum(last, first + 1)
    found = np.empty(len(pose))
    for block in np.array_split(np.arange(len(pose)), len(pose) // _BLOCK_TICKS + 1):
        segment = first[block][:, None] + np.arange((last - first)[block].max(initial=1))
        inside = segment < last[block][:, None]
        segment = np.minimum(segment, len(lengths) - 1)
        dx, dy = (pose[block, None, axis] - route.points[segment, axis] for axis in (0, 1))
        along = np.maximum(dx * directions[segment, 0] + dy * directions[segment, 1], 0.0)
        along = np.minimum(along, lengths[segment])
        ox, oy = dx - along * directions[segment, 0], dy - along * directions[segment, 1]
        nearest = (
            np.arange(len(block)),
            np.argmin(np.where(inside, ox * ox + oy * oy, np.inf), axis=1),
        )
        found[block] = route.s_m[segment[nearest]] + along[nearest]
    return found


def _freezings(record: Record, scenario: Scenario, log: Log) -> Iterator[Contradiction]:
    """By the referee's rule, where nothing else had failed."""
    if scenario.ends_on_failure:
        return
    window = FreezeWindow(Clock())
    told = {failure.tick: failure.kind for failure in record.failures}
    for k, (x_m, y_m, waits) in enumerate(
        zip(
            log.pose[:, 0].tolist(), log.pose[:, 1].tolist(), log.waits_at_red.tolist(), strict=True
        )
    ):
        kind = told.get(k)
        if kind in (None, "freezing") and (frozen := not waits and window.frozen((x_m, y_m))) != (
            kind == "freezing"
        ):
            yield Contradiction(f"freezings at tick {k}", int(kind == "freezing"), int(frozen))
            return
        if kind is not None:
            window.clear()


def _ends(record: Record, scenario: Scenario, log: Log) -> list[Ended]:
    """The ends that the trajectory allows; one that is over before its last tick has none. Only the
    map tells whether one can walk straight on to a goal that is near."""
    last = len(log) - 1
    late = last + 1 >= Clock().ticks(scenario.time_limit_s)
    if any(failure.tick == last for failure in record.failures):
        return ["failure"] if scenario.ends_on_failure else ["timeout"] if late else []
    if scenario.ends_at == "stop":
        stands = np.abs(log.speed[-Clock().ticks(STOP_S) :, 0]).max() < ROBOT_STANDS_MPS
        passed = all(log.route_s_m[last] > event.route_s_m for event in scenario.events)
        return _allowed(("stop", bool(stands)), ("failure", passed), ("timeout", late))
    goals = at_goal(scenario, log.pose, log.route_s_m)
    goals[[failure.tick for failure in record.failures]] = False
    if goals.any():
        return ["goal"] if int(np.argmax(goals)) == last else []
    near = bool(near_goal(scenario, log.pose[-1:]).any()) and not is_round(scenario)
    return _allowed(("goal", near), ("timeout", late))


def _allowed(*ends: tuple[Ended, bool]) -> list[Ended]:
    return [ended for ended, allowed in ends if allowed]


def _before(values: Floats, first: float) -> Floats:
    """(T,) each tick's value of the tick before it."""
    return np.concatenate([[first], values[:-1]])
