"""Check a record against the trajectory that was recorded with it.

The trajectory determines its duration, position and speed at each failure, resets, progress,
freezings, falls, the end, and the go-on rule between trigger and passing. Contacts, leaving the
walkable area, red light entries and other event outcomes need the engines; they are taken from the
record.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.core.clock import Clock
from cosim.core.geometry import Floats, Polyline
from cosim.episode.command_delay import median_ms
from cosim.episode.loop import ROUTE_WINDOW_M
from cosim.people.yielding import ROBOT_STANDS_MPS, STOOD_S
from cosim.results.go_on import Passing, is_measured, passing_of, rule_met
from cosim.results.log import Log, legs_width
from cosim.results.record import Record, TriggeredEvent
from cosim.results.referee import (
    APART_S,
    FALL_S,
    PUSHED_S,
    STOP_S,
    Ended,
    Failure,
    FreezeWindow,
    at_goal,
    is_loop,
    near_goal,
)
from cosim.results.walked import walked_m
from cosim.spec.robot import robot_called
from cosim.spec.scenario import Scenario

_ROUNDING_M = 1e-9
_NEAR_M = 0.3
"""Clearance, metres, within which a person may touch the robot: legs reach beyond its outline."""
_PUSH_TICKS = Clock().ticks(max(PUSHED_S, APART_S))
"""Longest time in ticks between two contacts of a push, and from the last one to the fall."""
_BLOCK_TICKS = 2000
"""Number of ticks per block; limits memory to a few MiB."""


class Contradiction(NamedTuple):
    """Field whose recorded value differs from the trajectory."""

    what: str
    recorded: object
    shown: object


def contradictions(record: Record, scenario: Scenario, log: Log) -> Iterator[Contradiction]:
    """Yield the differences between a record and its trajectory."""
    if record.ticks != len(log):
        yield Contradiction("ticks", record.ticks, len(log))
        return
    if record.setup.real_time and record.setup.latency_ms != (
        latency_ms := median_ms(log.answers, Clock().tick_ms)
    ):
        yield Contradiction("latency_ms", record.setup.latency_ms, latency_ms)
    if len(log) and log.legs.shape[1] != (width := legs_width(scenario.robot)):
        yield Contradiction("columns of legs", width, log.legs.shape[1])
        return
    outcomes, events = ([one.id for one in of] for of in (record.events, scenario.events))
    if outcomes != events:
        yield Contradiction("events", outcomes, events)
        return
    yield from _failures_as_driven(record, log)
    yield from _resets(record, log)
    yield from _red_light_entries(record, scenario, log)
    yield from _progress(scenario, log)
    yield from _freezings(record, scenario, log)
    yield from _falls(record, log)
    yield from _pushes(record, log)
    yield from _passings(record, scenario, log)
    if record.ended not in (ends := _ends(record, scenario, log)):
        yield Contradiction("ended", record.ended, " or ".join(ends) or "not yet over")


def _failures_as_driven(record: Record, log: Log) -> Iterator[Contradiction]:
    start_mps = _start_mps(log)
    for failure in (*record.failures, *record.walked_into):
        recorded = (failure.x_m, failure.y_m, failure.route_s_m, failure.robot_speed_mps)
        tick = failure.tick
        shown = (
            (*log.pose[tick, :2].tolist(), float(log.route_s_m[tick]), float(start_mps[tick]))
            if tick < len(log)
            else ()
        )
        if recorded != shown:
            yield Contradiction(
                f"{failure.kind} at tick {tick}: x_m, y_m, route_s_m, robot_speed_mps",
                recorded,
                shown,
            )


def _resets(record: Record, log: Log) -> Iterator[Contradiction]:
    """Check that the robot is reset after each tick with failures or falls, except the last."""
    put_back = (*record.failures, *_pushed_falls(record))
    failed = sorted({failure.tick for failure in put_back} - {len(log) - 1})
    resets = np.flatnonzero(np.isfinite(log.reset_s_m)).tolist()
    if failed != resets:
        tick = min({*failed} ^ {*resets})
        yield Contradiction(f"failures at tick {tick}", int(tick in failed), int(tick in resets))
        return
    for fall in _pushed_falls(record):
        if (to_m := float(log.reset_s_m[fall.tick])) > fall.route_s_m:
            what = f"reset after the fall at tick {fall.tick}"
            yield Contradiction(what, to_m, f"{fall.route_s_m} m or less")


def _red_light_entries(record: Record, scenario: Scenario, log: Log) -> Iterator[Contradiction]:
    """Check that the robot was on the crossing at each red light entry."""
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


def _progress(scenario: Scenario, log: Log) -> Iterator[Contradiction]:
    """Check that arc lengths match the poses.

    With legs, distances travelled follow from the poses. On wheels no tick moved farther than it
    travelled.
    """
    reset_to_m = _previous(log.reset_s_m, 0.0)
    last_m = np.where(np.isnan(reset_to_m), _previous(log.route_s_m, 0.0), reset_to_m)
    shown_m = places_on_route(scenario.route_line, log.pose, last_m)
    if len(differing := np.flatnonzero(shown_m != log.route_s_m)):
        tick = int(differing[0])
        yield Contradiction(
            f"route_s_m at tick {tick}", float(log.route_s_m[tick]), float(shown_m[tick])
        )
        return
    if cycle_s := robot_called(scenario.robot).drive.cycle_s:
        way_m = walked_m(log.pose[:, :2], log.reset_s_m, cycle_s / log.tick_s)
        differing = np.flatnonzero(~(np.abs(way_m - log.travelled_m) <= _ROUNDING_M))
        for tick in differing[:1].tolist():
            yield Contradiction(
                f"travelled_m at tick {tick}", float(log.travelled_m[tick]), float(way_m[tick])
            )
        return
    went_m = np.hypot(*np.diff(log.pose[:, :2], axis=0).T)
    short = (
        np.flatnonzero((went_m > log.travelled_m[1:] + _ROUNDING_M) & np.isnan(log.reset_s_m[:-1]))
        + 1
    )
    if len(short):
        tick = int(short[0])
        yield Contradiction(
            f"travelled_m at tick {tick}",
            float(log.travelled_m[tick]),
            f"{went_m[tick - 1]} or more",
        )


def places_on_route(route: Polyline, pose: Floats, last_s_m: Floats) -> Floats:
    """Return `cosim.episode.loop.place_on_route` (T,), bit-identical, of poses (T, 3) and last arc
    lengths (T,)."""
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
    """Check freezings by the referee's rule, in ticks without another failure."""
    if scenario.ends_on_failure:
        return
    window = FreezeWindow(Clock())
    kinds = {one.tick: one.kind for one in (*record.failures, *_pushed_falls(record))}
    for tick, (x_m, y_m, waits) in enumerate(
        zip(
            log.pose[:, 0].tolist(), log.pose[:, 1].tolist(), log.waits_at_red.tolist(), strict=True
        )
    ):
        kind = kinds.get(tick)
        if kind in (None, "freezing") and (frozen := not waits and window.update((x_m, y_m))) != (
            kind == "freezing"
        ):
            yield Contradiction(f"freezings at tick {tick}", int(kind == "freezing"), int(frozen))
            return
        if kind is not None:
            window.clear()


def _falls(record: Record, log: Log) -> Iterator[Contradiction]:
    """Check falls by the referee's rule, in ticks without another failure."""
    kinds: dict[int, str] = {failure.tick: failure.kind for failure in record.failures}
    kinds |= {one.tick: one.kind for one in _pushed_falls(record)}
    down_ticks = 0
    for tick, down in enumerate(_down(log).tolist()):
        down_ticks = down_ticks + 1 if down else 0
        kind = kinds.get(tick)
        fallen = down_ticks > Clock().ticks(FALL_S)
        if kind in (None, "fall", "freezing") and fallen != (kind == "fall"):
            yield Contradiction(f"falls at tick {tick}", int(kind == "fall"), int(fallen))
            return
        if kind is not None:
            down_ticks = 0


def _pushes(record: Record, log: Log) -> Iterator[Contradiction]:
    """Check that people could have pushed the robot over.

    Before each such fall, the same person walked into the robot, which had not driven for a second.
    From then on a person was near, with gaps of at most the times in the referee's rules.
    """
    if not (falls := _pushed_falls(record)):
        return
    began = {(one.tick, one.other) for one in record.walked_into if one.kind == "collision"}
    near = log.clearance_m <= _NEAR_M
    stands = _start_mps(log) < ROBOT_STANDS_MPS
    stood = Clock().ticks(STOOD_S)
    touched = {
        (tick, other)
        for tick, other in began
        if stood <= tick + 1 <= len(log)
        and near[tick]
        and stands[tick + 1 - stood : tick + 1].all()
    }
    for fall in falls:
        ticks = [tick for tick, other in touched if other == fall.other and tick <= fall.tick]
        if not ticks or _longest_gap(near, max(ticks), fall.tick) > _PUSH_TICKS:
            yield Contradiction(
                f"walked_into: fall at tick {fall.tick}", fall.other, "not pushed by this person"
            )


def _longest_gap(near: NDArray[np.bool_], first: int, last: int) -> int:
    """Return the longest time in ticks without a person near, between two ticks."""
    marks = first + np.flatnonzero(near[first : last + 1])
    return int(np.diff([first, *marks.tolist(), last]).max())


def _pushed_falls(record: Record) -> list[Failure]:
    """Return the falls at a person's fault."""
    return [one for one in record.walked_into if one.kind == "fall"]


def _down(log: Log) -> NDArray[np.bool_]:
    """Return (T,) whether the robot was down; never on wheels."""
    down: NDArray[np.bool_] = log.legs[:, 0] > 0.0 if log.on_legs else np.zeros(len(log), bool)
    return down


def _passings(record: Record, scenario: Scenario, log: Log) -> Iterator[Contradiction]:
    """Check the go-on rule in the windows of the record, which the goal ends at the latest.

    A group may break its other rule where the robot continues.
    """
    outcomes = {outcome.id: outcome for outcome in record.events}
    for event in (event for event in scenario.events if is_measured(event, scenario)):
        outcome = outcomes[event.id]
        triggered = outcome.triggered_at_s is not None
        if record.ended == "goal" and triggered and outcome.passed_at_s is None:
            yield Contradiction(f"passed_at_s of event {event.id}", None, "at the goal or before")
        passing = _passing(outcome, log)
        recorded = outcome.passing_mps, outcome.stopped_s
        if recorded != (shown := (None, None) if passing is None else tuple(passing)):
            yield Contradiction(f"passing_mps, stopped_s of event {event.id}", recorded, shown)
        if scenario.go_on_mps > 0.0:
            met = rule_met(event, passing, scenario.go_on_mps)
            if outcome.rule_met is not met and (event.people == 1 or not met):
                yield Contradiction(f"rule_met of event {event.id}", outcome.rule_met, met)


def _passing(outcome: TriggeredEvent, log: Log) -> Passing | None:
    """Return the motion in an event's window; None without one."""
    if outcome.triggered_at_s is None or outcome.passed_at_s is None:
        return None
    first, end = log.tick_at(outcome.triggered_at_s), log.tick_at(outcome.passed_at_s)
    return passing_of(log.route_s_m, log.speed[:, 0], log.tick_s, first, end)


def _ends(record: Record, scenario: Scenario, log: Log) -> list[Ended]:
    """Return the ends that the trajectory allows; none if it was over before its last tick.

    Whether the robot can walk straight to a near goal needs the map, so both answers are allowed.
    """
    last = len(log) - 1
    late = last + 1 >= Clock().ticks(scenario.time_limit_s)
    if any(failure.tick == last for failure in record.failures):
        return ["failure"] if scenario.ends_on_failure else ["timeout"] if late else []
    down = _down(log)
    if down[last]:  # also in a fall at a person's fault
        return ["timeout"] if late else []
    if scenario.ends_at == "stop":
        stopped = np.abs(log.speed[:, 0]) < ROBOT_STANDS_MPS
        stands = (stopped & ~down)[-Clock().ticks(STOP_S) :].all()
        passed = all(log.route_s_m[last] > event.route_s_m for event in scenario.events)
        return _allowed(("stop", bool(stands)), ("failure", passed), ("timeout", late))
    goals = at_goal(scenario, log.pose, log.route_s_m)
    goals[[failure.tick for failure in record.failures]] = False
    goals &= ~down
    if goals.any():
        return ["goal"] if int(np.argmax(goals)) == last else []
    near = bool(near_goal(scenario, log.pose[-1:]).any()) and not is_loop(scenario)
    return _allowed(("goal", near), ("timeout", late))


def _allowed(*ends: tuple[Ended, bool]) -> list[Ended]:
    return [ended for ended, allowed in ends if allowed]


def _start_mps(log: Log) -> Floats:
    """Return (T,) the magnitude of the speed at the beginning of each tick."""
    speed = _previous(log.speed[:, 0], 0.0)
    start: Floats = np.abs(np.where(np.isfinite(_previous(log.reset_s_m, np.nan)), 0.0, speed))
    return start


def _previous(values: Floats, first: float) -> Floats:
    """Return (T,) the values of the previous tick."""
    return np.concatenate([[first], values[:-1]])
