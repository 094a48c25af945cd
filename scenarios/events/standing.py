"""Events of people standing in the way: `obstructing`, `conversing`, `queueing`, `gesturing`.

They wait at the edge of the sidewalk and step to their places when triggered: on the middle of the
sidewalk, in front of a robot that drives elsewhere, or on the side opposite to `Event.free_side`.
There they leave less than the width of a robot between them and the edge (`blocked`). They stay
until the robot has passed; `gesturing` ends when the robot has stopped. Then they step back.

The decoy of `gesturing` shows another gesture beside the robot's way. With a free side, event and
decoy differ in the gesture alone: both stand beside the way from the beginning.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

import msgspec
import numpy as np

from cosim.core.geometry import Pose, wrap_angle
from cosim.core.state import PERSON_RADIUS_M
from cosim.people.yielding import ROBOT_STANDS_MPS
from cosim.results.referee import STOP_S, is_in_front_of_event
from cosim.spec.events import (
    Decoy,
    Event,
    EventKind,
    EventQuery,
    EventState,
    Places,
    SidewalkLayout,
    Walker,
)
from cosim.spec.robot import COURIER
from scenarios.events.gates import gate_half_m
from scenarios.events.sight import SMALL_GAPS_AFTER_S, sight_of
from scenarios.events.walking import (
    MIDDLE_M,
    along_m,
    edge_m,
    meeting_offset_m,
    turn_towards,
    walk_to,
    walker_at,
    world_point,
)

_TRIGGER_M: Final = 10.0
"""Route distance in metres at which these events trigger."""
LOOK_PERIOD_S: Final = 4.0
"""Seconds of one swing of the head while looking around."""
LOOK_SWING_RAD: Final = 1.0
"""Amplitude of the swing in radians."""
TALK_M: Final = 0.62
"""Radius in metres of a group of talkers; groups of four are 15 % larger."""
QUEUE_M: Final = 0.65
"""Metres between people in a queue: tight, but more than two radii."""
OPEN_M: Final = 1.25
"""Metres of sidewalk that a queue leaves free."""
GROUP_M: Final = 1.95
"""Smallest half width in metres of a sidewalk on which one can pass a group of talkers."""
CLOSED_M: Final = 0.25
"""Gap in metres between people and the edge on the closed side, too narrow for any robot."""
BESIDE_M: Final = 0.9
"""Lateral distance in metres between the robot's line and a person who gestures beside it."""
_WALKS_FOR: Final = 0.55
"""Fraction of the time until the fastest robot arrives in which people reach the closed side."""
_FASTEST_MPS: Final = 3.0
"""Highest speed in m/s at which they walk there."""
WAITING_M: Final = 0.8
"""Metres between people waiting at the edge."""
PASSED_BY_M: Final = 3.0
"""Metres along the route beyond the last person at which the robot has passed."""

_Step = Callable[[Event, EventState, int, EventQuery], Walker]
_Place = tuple[float, float]
"""Metres along the event's heading and to the left."""
_Places = Callable[[Event, float], tuple[_Place, ...]]
"""Places of an event's people, given the robot's lateral offset at the trigger."""
_Asides = Callable[[Event, int], _Place]
"""Place where a person waits for the trigger."""
_Facing = Callable[[Event, Walker, EventQuery, EventState], float]
_PASSABLE: Final = SidewalkLayout((18.0, 20.0), (11.0, 13.0))


def talking_places(event: Event, lane_m: float) -> tuple[_Place, ...]:
    """Return places on a circle, two of them side by side across the robot's path.

    With a free side, the first person is the one nearest to the other side.
    """
    radius_m = _radius_m(event.people)
    angles = [math.pi / 2 + 2.0 * math.pi * k / event.people for k in range(event.people)]
    if event.free_side:
        off_m = event.half_width_m - CLOSED_M - PERSON_RADIUS_M - radius_m
        return tuple(
            (radius_m * math.cos(a), -event.free_side * (off_m + radius_m * math.sin(a)))
            for a in angles
        )
    left_m = meeting_offset_m(lane_m, max(edge_m(event) - radius_m, 0.0))
    return tuple((radius_m * math.cos(a), left_m + radius_m * math.sin(a)) for a in angles)


def _radius_m(people: int) -> float:
    return TALK_M * (1.15 if people == 4 else 1.0)


def queue_places(event: Event, lane_m: float) -> tuple[_Place, ...]:
    """Return a tight line across the sidewalk.

    It starts at the edge of the closed side, else at the event's edge or the robot's.
    """
    side = _queue_side(event, lane_m)
    first_m = event.half_width_m - PERSON_RADIUS_M
    return tuple((0.0, side * (first_m - k * QUEUE_M)) for k in range(event.people))


def _queue_side(event: Event, lane_m: float) -> float:
    if event.free_side:
        return -event.free_side
    return math.copysign(1.0, lane_m) if abs(lane_m) > MIDDLE_M else event.side


def obstructing_places(event: Event, lane_m: float) -> tuple[_Place, ...]:
    """Return the place of a single person."""
    if event.free_side:
        off_m = event.half_width_m - PERSON_RADIUS_M - CLOSED_M
        return ((0.0, -event.free_side * off_m),)
    return ((0.0, meeting_offset_m(lane_m, edge_m(event))),)


def gesturing_places(event: Event, lane_m: float) -> tuple[_Place, ...]:
    """Return the place of a person who gestures, beside the robot's way if it may pass."""
    if event.free_side:
        return (_beside_way(event, 0),)
    if event.decoy:
        own_m = lane_m + event.side * BESIDE_M
        left_m = own_m if abs(own_m) <= edge_m(event) else lane_m - event.side * BESIDE_M
        return ((0.0, max(-edge_m(event), min(edge_m(event), left_m))),)
    return obstructing_places(event, lane_m)


def _beside_way(event: Event, number: int) -> _Place:
    """Return the place where a person with a free side waits and gestures."""
    if not event.free_side:
        return _aside(event, number)
    return (0.0, -event.free_side * min(edge_m(event), BESIDE_M))


def _aside(event: Event, number: int) -> _Place:
    """Return the place at the edge where a person waits for the trigger."""
    return (WAITING_M * (number - (event.people - 1) / 2), event.side * edge_m(event))


def _pace_mps(event: Event, place: _Place, aside: _Place) -> float:
    """Return the speed in m/s between both places.

    With a free side, people are in place before the fastest robot arrives.
    """
    if not event.free_side:
        return event.speed_mps
    trigger_m = _TRIGGER_M if event.trigger_m is None else event.trigger_m
    arrives_s = max(trigger_m - COURIER.length_m, 0.1) / COURIER.v_max_mps
    hurried_mps = math.dist(place, aside) / (_WALKS_FOR * arrives_s)
    return max(event.speed_mps, min(hurried_mps, _FASTEST_MPS))


def _blocked(places: _Places) -> Callable[[Event], tuple[float, float]]:
    """Build the function of the lateral interval in metres that people at `places` block."""

    def interval(event: Event) -> tuple[float, float]:
        lateral = [left for _, left in places(event, 0.0)]
        return min(lateral) - PERSON_RADIUS_M, max(lateral) + PERSON_RADIUS_M

    return interval


def _stays(places: _Places) -> Places:
    """Build the function of where people at `places` stay, for any robot."""

    def stays(event: Event, number: int) -> tuple[tuple[float, float], ...]:
        ends = {places(event, lane_m)[number] for lane_m in (-math.inf, math.inf)}
        return tuple(world_point(event, *place) for place in sorted(ends))

    return stays


def _waiting(aside: _Asides) -> Callable[[Event, int], Walker]:
    return lambda event, number: walker_at(event, *aside(event, number), math.pi)


def _ends(event: Event, state: EventState, query: EventQuery) -> bool:
    """Return whether the robot has passed all of them."""
    last_m = max(along_m(event, walker.x_m, walker.y_m) for walker in state.walkers)
    return query.route_s_m - event.route_s_m >= max(last_m, 0.0) + PASSED_BY_M


def _obeyed(event: Event, state: EventState, query: EventQuery) -> bool:
    """Return whether the robot has stopped for the gesture or has passed."""
    (walker,) = state.walkers
    return walker.counted_ticks * query.tick_ms / 1000 >= STOP_S or _ends(event, state, query)


def _standing(places: _Places, facing: _Facing, aside: _Asides = _aside) -> _Step:
    """Build the step function of people who go to `places`, and back to `aside`."""

    def step(event: Event, state: EventState, number: int, query: EventQuery) -> Walker:
        walker = state.walkers[number]
        acting = state.phase == "acting"
        tick_s = query.tick_ms / 1000
        place, waits_at = places(event, state.lane_m)[number], aside(event, number)
        x_m, y_m = world_point(event, *(place if acting else waits_at))
        if (walker.x_m, walker.y_m) != (x_m, y_m):
            walked_s = (query.tick - state.since_tick) * tick_s if acting else 0.0
            in_hurry_s = SMALL_GAPS_AFTER_S if acting and event.free_side else 0.0
            sight = sight_of(event, number, query, walked_s + in_hurry_s)
            pace_mps = _pace_mps(event, place, waits_at) if acting else event.speed_mps
            return walk_to(walker, x_m, y_m, pace_mps, sight, insisting=acting)
        if acting:
            heading = turn_towards(walker.heading_rad, facing(event, walker, query, state), tick_s)
            return msgspec.structs.replace(walker, heading_rad=heading)
        return walker

    return step


def _with_hand(step: _Step) -> _Step:
    """Extend a step function to count the ticks that the robot has stood in front of the person."""

    def counted(event: Event, state: EventState, number: int, query: EventQuery) -> Walker:
        after = step(event, state, number, query)
        pose = Pose(query.robot_x_m, query.robot_y_m, query.robot_heading_rad)
        stands = abs(query.robot_v_mps) < ROBOT_STANDS_MPS and is_in_front_of_event(
            pose, event, state
        )
        ticks = after.counted_ticks + 1 if stands and state.phase == "acting" else 0
        return msgspec.structs.replace(after, counted_ticks=ticks)

    return counted


def _about(event: Event, walker: Walker, query: EventQuery, state: EventState) -> float:
    """Return a heading against the robot's direction that swings to both sides."""
    phase = 2 * math.pi * (query.tick - state.since_tick) * query.tick_ms / 1000 / LOOK_PERIOD_S
    return event.heading_rad + math.pi + LOOK_SWING_RAD * math.sin(phase)


def _inward(event: Event, walker: Walker, query: EventQuery, state: EventState) -> float:
    """Return the heading to the middle of the group."""
    places = talking_places(event, state.lane_m)
    x_m, y_m = world_point(event, 0.0, sum(left for _, left in places) / len(places))
    return math.atan2(y_m - walker.y_m, x_m - walker.x_m)


def _forward(event: Event, walker: Walker, query: EventQuery, state: EventState) -> float:
    """Return the heading to the head of the queue."""
    return wrap_angle(event.heading_rad + _queue_side(event, state.lane_m) * math.pi / 2)


def _at_robot(event: Event, walker: Walker, query: EventQuery, state: EventState) -> float:
    """Return the heading to the robot."""
    return math.atan2(query.robot_y_m - walker.y_m, query.robot_x_m - walker.x_m)


def _queue(half_width_m: float, rng: np.random.Generator) -> int:
    """Return the longest queue past the middle that leaves OPEN_M free."""
    return max(2, min(5, int((2 * half_width_m - OPEN_M - 2 * PERSON_RADIUS_M) / QUEUE_M) + 1))


def _block_m(people: int) -> float:
    """Return the width in metres that a group of talkers takes from the closed side's edge."""
    across = [math.sin(math.pi / 2 + 2.0 * math.pi * k / people) for k in range(people)]
    return CLOSED_M + 2.0 * PERSON_RADIUS_M + _radius_m(people) * (max(across) - min(across))


OBSTRUCTING: Final = EventKind(
    name="obstructing",
    layout=_PASSABLE._replace(gate_half_m=gate_half_m([CLOSED_M + 2.0 * PERSON_RADIUS_M])),
    trigger_m=_TRIGGER_M,
    begin=_waiting(_aside),
    step=_standing(obstructing_places, _about),
    ends=_ends,
    stays=_stays(obstructing_places),
    pose="look",
    blocked=_blocked(obstructing_places),
    has_free_side=True,
)
CONVERSING: Final = EventKind(
    name="conversing",
    people=(2, 4),
    layout=SidewalkLayout(
        (18.0, 20.0), (11.5, 13.0), GROUP_M, gate_half_m([_block_m(n) for n in (2, 3, 4)])
    ),
    trigger_m=_TRIGGER_M,
    begin=_waiting(_aside),
    step=_standing(talking_places, _inward),
    ends=_ends,
    stays=_stays(talking_places),
    pose="talk",
    passed_as_group=True,
    blocked=_blocked(talking_places),
    has_free_side=True,
)
QUEUEING: Final = EventKind(
    name="queueing",
    people=(2, 5),
    layout=_PASSABLE._replace(half_width_m=1.4, gate_half_m=(1.58, 2.9)),
    group=_queue,
    trigger_m=_TRIGGER_M,
    begin=_waiting(_aside),
    step=_standing(queue_places, _forward),
    ends=_ends,
    stays=_stays(queue_places),
    pose="queue",
    passed_as_group=True,
    blocked=_blocked(queue_places),
    has_free_side=True,
)
_GESTURES: Final = _standing(gesturing_places, _at_robot, _beside_way)
GESTURING: Final = EventKind(
    name="gesturing",
    layout=_PASSABLE,
    trigger_m=_TRIGGER_M,
    begin=_waiting(_beside_way),
    step=_with_hand(_GESTURES),
    ends=_obeyed,
    stays=_stays(gesturing_places),
    pose="stop",
    ends_at="stop",
    has_free_side=True,
    decoy=Decoy(_GESTURES, _ends, ("wave", "call", "point", "scratch"), _stays(gesturing_places)),
)
