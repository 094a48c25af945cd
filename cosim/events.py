"""Event pedestrians: what is asked of a director at each tick, and what it answers.

The director keeps no memory: the simulator sends the states it got last time, so a director can be killed and
started again in the middle of an episode without a trace in the result.
"""

from __future__ import annotations

from typing import Literal

import msgspec

from cosim.errors import SpecError
from cosim.state import Doing

Kind = Literal["obstructing", "conversing", "queueing", "frontal", "lateral", "overtaking", "ped_crossing", "gesturing"]


class Event(msgspec.Struct, frozen=True, kw_only=True):
    """One event pedestrian (or group) on the way.

    x_m, y_m, heading_rad: the place on the middle of the sidewalk where it happens, heading along the robot's
    direction of travel. half_width_m: from there to either edge of the sidewalk. route_s_m: the same place as
    arc length of the reference route. speed_mps: walking speed. hold_s: how long a standing one stays.
    """

    id: str
    kind: Kind
    x_m: float
    y_m: float
    heading_rad: float
    route_s_m: float
    half_width_m: float
    speed_mps: float = 1.3
    hold_s: float = 20.0
    side: Literal[-1, 1] = 1

    def __post_init__(self) -> None:
        if not self.id.startswith("e"):
            raise SpecError(f"event id '{self.id}': ids of event pedestrians start with 'e'")
        if not 0.0 < self.speed_mps <= 3.0:
            raise SpecError(f"event '{self.id}': speed_mps must be in (0, 3], not {self.speed_mps}")
        if not self.half_width_m > 0.3:
            raise SpecError(f"event '{self.id}': half_width_m must exceed a person's 0.3 m, not {self.half_width_m}")


class EventState(msgspec.Struct, frozen=True, kw_only=True):
    """Where an event stands. phase: waiting for its trigger, acting, over, or gone for good. since_tick: in this phase.

    aim_rad: the heading an actor has committed to, if it has. blocked_ticks: how long it has stood against the robot.
    """

    phase: Literal["waiting", "acting", "over", "gone"]
    since_tick: int
    x_m: float
    y_m: float
    heading_rad: float
    triggered_tick: int | None = None
    trigger_distance_m: float | None = None
    aim_rad: float | None = None
    blocked_ticks: int = 0


class Actor(msgspec.Struct, frozen=True, kw_only=True):
    """An event pedestrian as the world shows it at one tick."""

    id: str
    x_m: float
    y_m: float
    heading_rad: float
    speed_mps: float
    doing: Doing


class EventQuery(msgspec.Struct, frozen=True, kw_only=True):
    """What the simulator sends at each tick. states: one per event, empty at the first tick.

    route_s_m: the robot's arc length on the reference route. robot_length_m, robot_width_m: its outline.
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


class EventReply(msgspec.Struct, frozen=True, kw_only=True):
    """What the director answers: the new states, one per event, and the pedestrians to show."""

    episode: str
    tick: int
    states: tuple[EventState, ...]
    actors: tuple[Actor, ...]
