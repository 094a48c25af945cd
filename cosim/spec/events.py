"""Event pedestrians: what is asked of a director at each tick, and what it answers.

The director keeps no memory: the simulator sends the states it got last time, so a director can be
killed and started again in the middle of an episode without a trace in the result.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Final, Literal, NamedTuple

import msgspec
import numpy as np

from cosim.core.state import PERSON_RADIUS_M, Age, Doing, PersonKind
from cosim.spec.validation import ALONG_M, HEADING_RAD, WHERE_M, Ranged, Within, shown

INJECTED_ID: Final = "ei-"
"""What the ids of injected pedestrians begin with."""


class Event(Ranged, frozen=True, kw_only=True):
    """One event: a pedestrian or a group on the way. kind: a row of a table of `EventKinds`, by its
    name.

    x_m, y_m, heading_rad: the place on the middle of the sidewalk (of the crosswalk) where it
    happens, heading along the robot's direction of travel. half_width_m: from there to either edge.
    half_length_m: of a crosswalk, from there to either end along the heading. route_s_m: the same
    place as arc length of the reference route. people: how many. speed_mps: walking speed. side: of
    the sidewalk, left (1) or right (-1).
    """

    id: str
    kind: str
    x_m: Annotated[float, WHERE_M]
    y_m: Annotated[float, WHERE_M]
    heading_rad: Annotated[float, HEADING_RAD]
    route_s_m: Annotated[float, ALONG_M]
    half_width_m: Annotated[float, Within(PERSON_RADIUS_M, 50, above=True)]
    speed_mps: Annotated[float, Within(0, 3, above=True)] = 1.3
    side: Literal[-1, 1] = 1
    people: Annotated[int, Within(0, 100)] = 1
    half_length_m: Annotated[float, Within(0, 50)] = 0.0

    @property
    def called(self) -> str:
        return f"event {shown(self.id)}: "

    def contradictions(self) -> Iterator[str]:
        if not re.fullmatch(r"e[A-Za-z0-9_-]{0,31}", self.id):
            yield (
                f"event id {shown(self.id)}: ids of event pedestrians start with 'e', "
                "and at most 31 of A-Z a-z 0-9 _ - follow"
            )
        if re.match(INJECTED_ID, self.id):
            yield f"event id '{self.id}': '{INJECTED_ID}' begins the ids of injected pedestrians"

    @property
    def names(self) -> tuple[str, ...]:
        """The ids of its people: its own, and with "-1", "-2" for the further ones."""
        return (self.id, *(f"{self.id}-{k}" for k in range(1, self.people)))


class Walker(msgspec.Struct, frozen=True, kw_only=True):
    """One person of an event. aim_rad, pace_mps: the heading and the speed it has committed to, if
    it has.

    blocked_ticks: how long it has stood against the robot. counted_ticks: how long that lasts which
    ends its event. nearest_m: how near the robot has come to it from behind since it slowed down
    before it. vx_mps, vy_mps: of its last step.
    """

    x_m: float
    y_m: float
    heading_rad: float
    aim_rad: float | None = None
    pace_mps: float | None = None
    blocked_ticks: int = 0
    counted_ticks: int = 0
    nearest_m: float | None = None
    vx_mps: float = 0.0
    vy_mps: float = 0.0


class EventState(msgspec.Struct, frozen=True, kw_only=True):
    """Where an event stands. phase: waiting for its trigger, acting, over, or gone for good.
    since_tick: in this phase.

    trigger_distance_m: along the route from the robot to the event's place when it triggered,
    negative behind it. lane_m: how far left of the middle of the way the robot was then.
    robot_stood_ticks: how long the robot has stood.
    """

    phase: Literal["waiting", "acting", "over", "gone"]
    since_tick: int
    walkers: tuple[Walker, ...]
    triggered_tick: int | None = None
    trigger_distance_m: float | None = None
    lane_m: float = 0.0
    robot_stood_ticks: int = 0


class Actor(msgspec.Struct, frozen=True, kw_only=True):
    """A pedestrian of ours as the world shows it at one tick. id: unlike all others; see
    `Event.names`.

    speed_mps: of its last step. pace_mps: the speed that its body shows where that is another: who
    turns or rises on the spot treads.
    """

    id: str
    x_m: float
    y_m: float
    heading_rad: float
    speed_mps: float
    doing: Doing
    kind: PersonKind
    age: Age = Age.ADULT
    pace_mps: float | None = None


class NearbyPerson(msgspec.Struct, frozen=True, array_like=True):
    """Somebody who is not of an event: place, velocity and kind."""

    id: str
    x_m: float
    y_m: float
    vx_mps: float
    vy_mps: float
    kind: PersonKind = PersonKind.CROWD


class StandingBody(msgspec.Struct, frozen=True, array_like=True):
    """What stands in the way of people: a rectangle, length_m along its heading. closed_x,
    closed_y: unit vector to the side on which nobody can pass it, (0, 0) where one can on
    either."""

    x_m: float
    y_m: float
    heading_rad: float
    length_m: float
    width_m: float
    closed_x: float = 0.0
    closed_y: float = 0.0


class EventQuery(msgspec.Struct, frozen=True, kw_only=True):
    """What the simulator sends at each tick. states: one per event, empty at the first tick.

    route_s_m: the robot's arc length on the reference route. robot_length_m, robot_width_m: its
    outline. nearby: who is near the people that the director moves, see `cosim.people.steering`.
    standing: what stands there.
    """

    episode: str
    tick: int
    tick_ms: int
    robot_x_m: float
    robot_y_m: float
    robot_heading_rad: float
    robot_v_mps: float
    robot_w_radps: float
    route_s_m: float
    robot_length_m: float
    robot_width_m: float
    events: tuple[Event, ...]
    states: tuple[EventState, ...] = ()
    nearby: tuple[NearbyPerson, ...] = ()
    standing: tuple[StandingBody, ...] = ()


class EventReply(msgspec.Struct, frozen=True, kw_only=True):
    """What the director answers: the new states, one per event, and the pedestrians to show."""

    episode: str
    tick: int
    states: tuple[EventState, ...]
    actors: tuple[Actor, ...]


class SidewalkLayout(NamedTuple):
    """Where a drawn event is along a sidewalk. way_m: length of the way, shortest and longest;
    event_m: from the start to the event's place, nearest and farthest, farther than its trigger
    reaches; half_width_m: least half of the sidewalk's width."""

    way_m: tuple[float, float]
    event_m: tuple[float, float]
    half_width_m: float = 1.3


@dataclass(frozen=True, kw_only=True)
class EventKind:
    """One kind of event.

    name: in scenarios, on the command line, in tables. people: fewest and most. layout: where a
    reactive scenario has it, and the room that it needs on a long way; None over a crosswalk.
    group(half_width_m, rng) -> how many people a drawn one has; None: any number.

    trigger_m: it begins when the robot is so far before its place along the route; below 0, when
    the robot has just come so far past it; None, when the robot is on the crosswalk. begin(event,
    number) -> person `number` before that. step(event, state, number, query) -> the same person a
    tick on, from the trigger on. ends(event, state, query) -> whether what began is over: its
    people go their ways, and once they are out of sight they are gone. pose, age: what its people
    show who stand while it goes on, and how old they look.

    passed_round: the robot is to pass round all of its people, never between two. ends_at: a
    reactive scenario of it ends at the goal, or when the robot has stopped before its people.
    """

    name: str
    people: tuple[int, int] = (1, 1)
    layout: SidewalkLayout | None
    group: Callable[[float, np.random.Generator], int] | None = None
    trigger_m: float | None
    begin: Callable[[Event, int], Walker]
    step: Callable[[Event, EventState, int, EventQuery], Walker]
    ends: Callable[[Event, EventState, EventQuery], bool]
    pose: Doing = "stand"
    age: Age = Age.ADULT
    passed_round: bool = False
    ends_at: Literal["goal", "stop"] = "goal"


EventKinds = Mapping[str, EventKind]
"""The table: kinds of events by their names."""
