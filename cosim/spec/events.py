"""Events with pedestrians: their kinds, and the messages between simulator and event director.

The director is stateless: each query contains the states of the previous reply. So a director can
be restarted during an episode without changing the result.

`scenarios.events.EVENT_KINDS` is the shipped table of kinds. Code that samples, directs, judges or
shows events takes a table, so a kind is added by its row: `EVENT_KINDS | {MINE.name: MINE}`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Final, Literal, NamedTuple

import msgspec
import numpy as np

from cosim.core.errors import SpecError
from cosim.core.state import PERSON_RADIUS_M, Age, Doing, PersonKind
from cosim.spec.validation import ARC_LENGTH_M, COORDINATE_M, HEADING_RAD, Ranged, Within, shown

INJECTED_ID: Final = "ei-"
"""Prefix of the ids of injected pedestrians."""


class Event(Ranged, frozen=True, kw_only=True):
    """One event: a pedestrian or a group on the way.

    kind: name of a row in a table of `EventKinds`.
    x_m, y_m: place on the middle of the sidewalk or crosswalk.
    heading_rad: direction of the robot's travel there.
    half_width_m: distance from there to either edge.
    half_length_m: for a crosswalk, distance to either end along the heading.
    route_s_m: arc length of the place on the reference route.
    people: number of people.
    speed_mps: walking speed.
    side: side of the sidewalk, left (1) or right (-1), on which they wait or from which they come.
    free_side: side on which the robot can pass people who stand; 0 if their places leave it open.
    trigger_m: distance before the event along the route at which it begins; None for the kind's.
    patience_s: time for which a person waits in front of a standing robot.
    decoy: whether nothing that matters to the robot happens after the trigger.
    """

    id: str
    kind: str
    x_m: Annotated[float, COORDINATE_M]
    y_m: Annotated[float, COORDINATE_M]
    heading_rad: Annotated[float, HEADING_RAD]
    route_s_m: Annotated[float, ARC_LENGTH_M]
    half_width_m: Annotated[float, Within(PERSON_RADIUS_M, 50, above=True)]
    speed_mps: Annotated[float, Within(0, 3, above=True)] = 1.3
    side: Literal[-1, 1] = 1
    people: Annotated[int, Within(0, 100)] = 1
    half_length_m: Annotated[float, Within(0, 50)] = 0.0
    free_side: Literal[-1, 0, 1] = 0
    trigger_m: Annotated[float | None, Within(-10, 60)] = None
    patience_s: Annotated[float, Within(0, 60)] = 2.5
    decoy: bool = False

    @property
    def prefix(self) -> str:
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
        """Ids of its people: its own id, then with "-1", "-2" and so on."""
        return (self.id, *(f"{self.id}-{k}" for k in range(1, self.people)))


class Walker(msgspec.Struct, frozen=True, kw_only=True):
    """State of one person in an event.

    aim_rad, pace_mps: heading and speed that the person has committed to, if any.
    blocked_ticks: time that the robot has stood before the person, or touched it.
    counted_ticks: duration so far of the condition that ends the event.
    nearest_m: least distance of the robot behind the person, since it slowed down.
    vx_mps, vy_mps: velocity of the last step.
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
    """State of an event.

    phase: waiting for the trigger, acting, over, or gone for good.
    since_tick: start of the phase.
    trigger_distance_m: distance along the route from the robot to the event when it triggered,
        negative behind it.
    lane_m: offset of the robot from the middle of the way at that moment, left positive.
    robot_stood_ticks: time that the robot has stood still.
    """

    phase: Literal["waiting", "acting", "over", "gone"]
    since_tick: int
    walkers: tuple[Walker, ...]
    triggered_tick: int | None = None
    trigger_distance_m: float | None = None
    lane_m: float = 0.0
    robot_stood_ticks: int = 0


class Actor(msgspec.Struct, frozen=True, kw_only=True):
    """A directed pedestrian at one tick.

    id: unique id, see `Event.names`.
    speed_mps: speed of its last step.
    pace_mps: speed that its body shows, if different: a person who turns on the spot moves the
        feet.
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
    """Position, velocity and kind of a person who belongs to no event."""

    id: str
    x_m: float
    y_m: float
    vx_mps: float
    vy_mps: float
    kind: PersonKind = PersonKind.CROWD


class StandingBody(msgspec.Struct, frozen=True, array_like=True):
    """Static obstacle for people: a rectangle with length_m along its heading.

    closed_x, closed_y: unit vector to the side without a passage; (0, 0) if both sides are free.
    """

    x_m: float
    y_m: float
    heading_rad: float
    length_m: float
    width_m: float
    closed_x: float = 0.0
    closed_y: float = 0.0


class EventQuery(msgspec.Struct, frozen=True, kw_only=True):
    """Message to the director at each tick.

    route_s_m: robot's arc length on the reference route.
    robot_length_m, robot_width_m: its footprint.
    states: one for each event, empty at the first tick.
    nearby: people near the directed ones, see `cosim.people.steering`.
    standing: obstacles near them.
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
    """Reply of the director: the new state of each event, and the pedestrians to show."""

    episode: str
    tick: int
    states: tuple[EventState, ...]
    actors: tuple[Actor, ...]


class SidewalkLayout(NamedTuple):
    """Space that a sampled event needs along a sidewalk.

    way_m: shortest and longest way.
    event_m: least and largest distance from the start to the event, beyond the range of its
        trigger.
    half_width_m: least half width of the sidewalk.
    gate_half_m: least and largest half width of the way at an event with a free side, for a robot
        of `COURIER`'s width; None if any width fits. Wider sidewalks need fences there.
    after_m: least length of route behind the event in a reactive scenario; negative if its place
        may be beyond the goal.
    """

    way_m: tuple[float, float]
    event_m: tuple[float, float]
    half_width_m: float = 1.3
    gate_half_m: tuple[float, float] | None = None
    after_m: float = 2.0


Places = Callable[[Event, int], tuple[tuple[float, float], ...]]
"""Where person `number` of an event may stay after the trigger: world (x_m, y_m).

One point, the ends of a line on which it stays, or none for a person who walks on.
"""


def walking_on(event: Event, number: int) -> tuple[tuple[float, float], ...]:
    """Return the places of a person who stays nowhere: none."""
    return ()


class Decoy(NamedTuple):
    """Behaviour of an event with `Event.decoy` from the trigger on, in place of the kind's.

    step, ends, stays: as in `EventKind`.
    poses: activities of people who stand; one is chosen by the event's place.
    """

    step: Callable[[Event, EventState, int, EventQuery], Walker]
    ends: Callable[[Event, EventState, EventQuery], bool]
    poses: tuple[Doing, ...] = ("stand",)
    stays: Places = walking_on


@dataclass(frozen=True, kw_only=True)
class EventKind:
    """One kind of event, with its behaviour as pure functions.

    name: name in scenarios, on the command line and in tables.
    people: fewest and most people.
    layout: placement in a reactive scenario, and space on a long way; None for a crosswalk.
    group: samples the number of people from (half_width_m, rng); None for any number.
    trigger_m: distance before the event along the route at which it begins. A negative one is
        behind it; None means that the robot is on the crosswalk.
    begin: returns person `number` of an event before the trigger.
    step: returns person `number` one tick later, from the trigger on.
    ends: returns whether the event is over. Then its people walk away and are removed out of sight.
    stays: returns where person `number` may stay until then, see `Places`.
    pose, age: activity of people who stand during the event, and their age.
    passed_as_group: whether the robot must pass round the whole group.
    ends_at: end of a reactive scenario: the goal, or a stop before the people.
    blocked: returns the lateral interval (right, left) in metres that people of an event with a
        free side block, left positive; None for people who block none.
    has_free_side: whether a suite draws `Event.free_side`. People who block no side then stand
        next to the robot's way.
    decoy: behaviour of its decoys; None if a decoy is the event with the other side free.
    gives_way: whether the robot must give way in a reactive scenario, see `Scenario.go_on_mps`.
    """

    name: str
    people: tuple[int, int] = (1, 1)
    layout: SidewalkLayout | None
    group: Callable[[float, np.random.Generator], int] | None = None
    trigger_m: float | None
    begin: Callable[[Event, int], Walker]
    step: Callable[[Event, EventState, int, EventQuery], Walker]
    ends: Callable[[Event, EventState, EventQuery], bool]
    stays: Places = walking_on
    pose: Doing = "stand"
    age: Age = Age.ADULT
    passed_as_group: bool = False
    ends_at: Literal["goal", "stop"] = "goal"
    blocked: Callable[[Event], tuple[float, float]] | None = None
    has_free_side: bool = False
    decoy: Decoy | None = None
    gives_way: bool = False

    def trigger_m_of(self, event: Event) -> float | None:
        """Return the distance before an event at which it begins, in metres: its own, else the
        kind's."""
        return self.trigger_m if event.trigger_m is None else event.trigger_m

    def stays_of(self, event: Event, number: int) -> tuple[tuple[float, float], ...]:
        """Return where a person of an event or decoy may stay after the trigger, see `Places`."""
        row = self.decoy if self.decoy is not None and event.decoy else self
        return row.stays(event, number)

    def decoy_of(self, event: Event) -> Event:
        """Return the event's decoy, equal to it until the trigger.

        Raises SpecError if the kind has no decoys, or the event no free side to mirror.
        """
        if self.decoy is not None:
            return msgspec.structs.replace(event, decoy=True)
        if self.blocked is None:
            raise SpecError(f"events of kind '{self.name}' have no decoys")
        if event.free_side == 0:
            raise SpecError(f"{event.prefix}its decoy needs free_side -1 or 1, not 0")
        return msgspec.structs.replace(event, free_side=-event.free_side)


EventKinds = Mapping[str, EventKind]
"""Table of event kinds by name."""
