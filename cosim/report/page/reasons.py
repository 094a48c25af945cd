"""Describe in words why an episode failed, from its record and log."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from cosim.core.clock import Clock
from cosim.core.geometry import Floats
from cosim.results.go_on import STOP_S
from cosim.results.log import Log
from cosim.results.record import Record, TriggeredEvent
from cosim.results.referee import FREEZE_MOVE_M, FREEZE_WINDOW_S, Failure
from cosim.results.validity import BYPASSED
from cosim.spec.events import Event
from cosim.spec.scenario import Scenario

_STANDS_MPS: Final = 0.2
"""Speed below which a body counts as standing."""
_SIDE_LIMIT_M: Final = 5.0
"""Distance from the route, metres, beyond which its side is meaningless."""
_VELOCITY_SPAN_S: Final = 0.4
"""Time span, seconds, over which a velocity is estimated from recorded positions."""
CAUSES: Final = (
    "person",
    "vehicle",
    "obstacle",
    "off the sidewalk",
    "froze",
    "fell",
    "out of time",
    "broke the rule",
    "bypassed the event",
    "policy crashed",
)
"""Causes of failures, in display order."""
_THING_NAMES: Final = {
    "sign": "sandwich board",
    "cafe": "cafe table",
    "bike": "parked bike",
    "box": "pile of parcels",
    "fence": "construction fence",
    "scooter": "parked scooter",
    "barrier": "barrier",
    "building": "wall",
    "prop": "piece of street furniture",
}


class MetBody(NamedTuple):
    """Body that the robot met, in the robot's frame: x ahead and y left, metres and m/s."""

    x_m: float
    y_m: float
    vx_mps: float
    vy_mps: float

    @classmethod
    def seen_from(cls, robot: Floats, at: Floats, velocity: Floats) -> MetBody:
        """Convert from the world frame.

        robot: (3,) x, y, heading
        at, velocity: (2,).
        """
        cos, sin = math.cos(robot[2]), math.sin(robot[2])
        turn = np.array([[cos, sin], [-sin, cos]])
        return cls(*(turn @ (at - robot[:2])).tolist(), *(turn @ velocity).tolist())


class Mishap(NamedTuple):
    """Cause and time of a failed episode.

    tick: index into the log
    cause: one of CAUSES
    failure: None if the referee counted none, for example at a timeout
    """

    tick: int
    cause: str
    failure: Failure | None = None


def mishaps_of(record: Record) -> list[Mishap]:
    """Return everything that went wrong in an episode, in order; empty if it succeeded or is
    invalid."""
    if record.status == "crashed":
        return [Mishap(record.ticks, "policy crashed")]
    if record.status == "invalid":
        return []
    found = [Mishap(failure.tick, cause_of(failure), failure) for failure in record.failures]
    if not found and not record.measures.get("success"):
        broke = record.ended in ("goal", "failure", "stop")
        cause = "broke the rule" if broke else "out of time"
        if record.reason.startswith(BYPASSED):
            cause = "bypassed the event"
        found.append(Mishap(max(record.ticks - 1, 0), cause))
    return found


def cause_of(failure: Failure) -> str:
    """Return which of CAUSES a failure has."""
    if failure.kind == "out_of_lane":
        return "off the sidewalk"
    if failure.kind == "freezing":
        return "froze"
    if failure.kind == "fall":
        return "fell"
    return {"pedestrian": "person", "vehicle": "vehicle"}.get(failure.other_kind, "obstacle")


def reason_of(
    scenario: Scenario,
    record: Record,
    mishap: Mishap,
    log: Log | None,
    other: MetBody | None = None,
) -> str:
    """Return the reason of a mishap as one sentence without its full stop.

    other: body that the robot met, if known more precisely than from the log
    """
    if mishap.cause == "policy crashed":
        return f"the policy crashed: {record.reason}"
    failure = mishap.failure
    if mishap.cause == "bypassed the event":
        return record.reason
    if failure is None:
        return _missed_goal(scenario, record)
    if failure.kind == "freezing":
        near = _nearest(log, failure.tick)
        return f"stayed within {FREEZE_MOVE_M:g} m for {FREEZE_WINDOW_S:g} s{near}"
    if failure.kind == "fall":
        return f"fell at {failure.robot_speed_mps:.1f} m/s"
    if failure.kind == "out_of_lane":
        return _off_sidewalk(scenario, failure)
    if failure.other_kind == "pedestrian":
        other = other or _in_tracks(scenario, failure, log)
        return f"{_met(failure, other, 'a person')}{_after_trigger(scenario, record, failure)}"
    if failure.other_kind == "vehicle":
        return _met(failure, other, "a vehicle")
    return f"drove into {thing_in_words(failure)} at {failure.robot_speed_mps:.1f} m/s"


def thing_in_words(failure: Failure) -> str:
    """Return the touched thing, neither person nor vehicle, such as "a parked bike"."""
    of, _, which = failure.other.partition(":")
    kind = which.rpartition(":")[2] if of == "obstacle" else of
    words = (
        _THING_NAMES.get(kind, kind if of == "obstacle" else failure.other_kind).replace("_", " ")
        or "something"
    )
    return f"{'an' if words[0] in 'aeiou' else 'a'} {words}"


def event_of(scenario: Scenario, mishap: Mishap) -> Event | None:
    """Return the event of the person who was met, or the scenario's only event."""
    person = mishap.failure.other if mishap.failure else ""
    matching = [event for event in scenario.events if person in event.names]
    if not matching and scenario.ends_on_failure and len(scenario.events) == 1:
        return scenario.events[0]
    return matching[0] if matching else None


def _met(failure: Failure, other: MetBody | None, body: str) -> str:
    """Describe a collision with a person or vehicle.

    The speed is the other's, or the robot's if the other stood.
    """
    stood = failure.robot_speed_mps < _STANDS_MPS
    at = "where it stood" if stood else f"at {failure.robot_speed_mps:.1f} m/s"
    if other is None:
        return f"{'was touched by' if stood else 'ran into'} {body} {at}"
    speed_mps = math.hypot(other.vx_mps, other.vy_mps)
    body += " who" if body == "a person" else " that"
    if speed_mps < _STANDS_MPS:
        where = _side(other.x_m, other.y_m, "ahead")
        return (
            f"touched {body} stood {where}, both at rest"
            if stood
            else f"drove into {body} stood {where}, {at}"
        )
    side = _side(-other.vx_mps, -other.vy_mps, "from the front", "from the ", "from behind")
    if side == "from behind" and other.x_m > 0.0:
        verb = "touched" if stood else "drove into"
        return f"{verb} {body} went ahead of it at {speed_mps:.1f} m/s"
    both = failure.fault == "shared" or failure.other_kind == "vehicle" or side == "from behind"
    verb = "was hit by" if stood else "collided with" if both else "drove into"
    return f"{verb} {body} came {side} at {speed_mps:.1f} m/s"


def _side(x: float, y: float, front: str, aside: str = "to the ", behind: str = "behind") -> str:
    """Return the side of the robot that a direction in its frame points to."""
    angle = abs(math.degrees(math.atan2(y, x)))
    if angle <= 45.0:
        return front
    return behind if angle >= 135.0 else aside + ("left" if y > 0.0 else "right")


def _in_tracks(scenario: Scenario, failure: Failure, log: Log | None) -> MetBody | None:
    """Return the event person that was met, from the event tracks; None for any other person."""
    if log is None:
        return None
    for number, event in enumerate(scenario.events):
        if failure.other in event.names:
            of_it = (log.event_tracks[:, 1] == number) & (
                log.event_tracks[:, 2] == event.names.index(failure.other)
            )
            track = log.event_tracks[of_it & (log.event_tracks[:, 0] <= failure.tick)]
            if len(track):
                since = track[track[:, 0] >= track[-1, 0] - round(_VELOCITY_SPAN_S / log.tick_s)]
                ticks = max(since[-1, 0] - since[0, 0], 1.0)
                velocity = (since[-1, 3:5] - since[0, 3:5]) / (ticks * log.tick_s)
                return MetBody.seen_from(log.pose[failure.tick], track[-1, 3:5], velocity)
    return None


def _after_trigger(scenario: Scenario, record: Record, failure: Failure) -> str:
    event = event_of(scenario, Mishap(failure.tick, "person", failure))
    outcome: TriggeredEvent | None = next(
        (e for e in record.events if event is not None and e.id == event.id), None
    )
    if outcome is None:
        return ""
    if outcome.triggered_at_s is None:
        return ", before its event began"
    after_s = Clock().time_s(failure.tick + 1) - outcome.triggered_at_s
    return f", {after_s:.1f} s after the trigger" if after_s >= 0.0 else ", before its event began"


def _off_sidewalk(scenario: Scenario, failure: Failure) -> str:
    near = (failure.route_s_m - 5.0, failure.route_s_m + 5.0)
    _, left_m = scenario.route_line.project(failure.x_m, failure.y_m, near)
    if abs(left_m) > _SIDE_LIMIT_M:
        return (
            f"left the walkable ground at {failure.robot_speed_mps:.1f} m/s, {abs(left_m):.0f} m "
            f"off the route"
        )
    crossing = any(c.enter_s_m <= failure.route_s_m <= c.leave_s_m for c in scenario.crossings)
    where = "crosswalk" if crossing else "sidewalk"
    side = "left" if left_m > 0.0 else "right"
    return (
        f"left the {where} on its {side} side at {failure.robot_speed_mps:.1f} m/s, "
        f"{abs(left_m):.1f} m off the route"
    )


def _nearest(log: Log | None, tick: int) -> str:
    if log is None or not tick < len(log) or not log.person_m[tick] < 3.0:
        return ""
    return f", the nearest person {log.person_m[tick]:.1f} m away"


def _missed_goal(scenario: Scenario, record: Record) -> str:
    """Describe an episode that failed without a failure of the referee."""
    done = 100.0 * (record.measures.get("route_completion") or 0.0)
    if record.ended == "goal" and scenario.go_on_mps > 0.0:
        return _broke_speed_rule(scenario, record)
    if record.ended == "goal":
        return "came to the goal, but went between people that it should have passed round"
    if record.ended == "failure":
        return "passed the person who held out a stopping hand"
    if scenario.ends_at == "stop":
        return f"made no stop before the stopping hand within {scenario.time_limit_s:.0f} s"
    return (
        f"ran out of time after {scenario.time_limit_s:.0f} s, with {done:.0f} % of the route done"
    )


def _broke_speed_rule(scenario: Scenario, record: Record) -> str:
    """Describe how the robot broke the go-on rule of a decoy, at its slowest event, or did not give
    way in an event."""
    passed = [event for event in record.events if event.passing_mps is not None]
    if not any(event.decoy for event in scenario.events):
        fastest_mps = max((event.passing_mps or 0.0 for event in passed), default=0.0)
        return (
            f"did not give way: it drove {fastest_mps:.2f} m/s on average without a stop, where "
            f"a stop or less than {scenario.go_on_mps:.2f} m/s was needed"
        )
    if not passed:
        return "came to the goal, but did not go on past the person of its decoy"
    slowest = min(passed, key=lambda event: event.passing_mps or 0.0)
    if (stopped_s := slowest.stopped_s or 0.0) >= STOP_S:
        return f"stopped for {stopped_s:.1f} s, though nothing was in its way"
    return (
        f"passed at {slowest.passing_mps:.2f} m/s on average, where at least "
        f"{scenario.go_on_mps:.2f} m/s was needed"
    )
