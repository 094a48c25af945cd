"""Injected people, added to the event pedestrians by a wrapper around the director.

Injections come from any thread, or from a replayed record. They take effect at the start of a tick,
in their order of arrival.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from threading import Condition
from typing import Final, NamedTuple

import msgspec

from cosim.core.geometry import Polyline, Pose
from cosim.episode.interfaces import Director
from cosim.spec.events import EventQuery, EventReply
from cosim.spec.injection import Ack, Injected, Injection, InjectionRequest, RelativePoint
from scenarios.events.injected_person import (
    InjectedPerson,
    injected_actor,
    spawn_injected,
    step_injected,
)

MAX_INJECTED: Final = 100
"""Maximum number of injected people at a time, including accepted ones before their first tick."""
MAX_INJECTED_PER_EPISODE: Final = 5000
"""Maximum number of injected people in an episode, because its record lists all of them."""
SUGGESTED_AHEAD_M: Final = 10.0
"""Distance in m along the route from the robot to the valid point that a refusal suggests."""
TICK_TIMEOUT_S: Final = 2.0
"""Timeout in seconds for the end of the current tick, which gives the robot's pose."""


class RobotOnRoute(NamedTuple):
    """The robot at the start of a tick: its pose on the map and its arc length on the route in
    m."""

    tick: int
    pose: Pose
    route_s_m: float


class InjectedPeople:
    """Adds injected people to a director's replies.

    on_map(x_m, y_m): returns whether a point belongs to the place.
    route, start: of the robot.
    script: injections of a replayed record.
    """

    def __init__(
        self,
        director: Director,
        tick_ms: int,
        on_map: Callable[[float, float], bool],
        route: Polyline,
        start: Pose,
        script: Sequence[Injected] = (),
    ) -> None:
        self._director = director
        self._tick_ms = tick_ms
        self._on_map = on_map
        self._route = route
        self._robot = RobotOnRoute(0, start, 0.0)
        self._lock = Condition()
        self._coming: list[Injected] = list(script)
        self._log: list[Injected] = []
        self._here: dict[str, InjectedPerson] = {}
        self._names = {entry.injection.id for entry in script}
        self._next_tick = 0

    def set_robot(self, robot: RobotOnRoute) -> None:
        """Set the robot's pose at the start of a tick, the origin of relative points."""
        with self._lock:
            self._robot = robot
            self._lock.notify_all()

    def offer(self, request: InjectionRequest) -> Ack:
        """Accept an injection for the next tick, or refuse it with a reason. Thread-safe."""
        with self._lock:
            if request.has_relative_points and not self._lock.wait_for(
                self._robot_is_known, TICK_TIMEOUT_S
            ):
                late = f"the tick under way takes longer than {TICK_TIMEOUT_S:g} s: send it again"
                return Ack(id=request.id, status="refused", reason=late)
            injection = request.resolved(self._robot.pose)
            tick = self._next_tick
            if reason := self._objection(request, injection):
                return Ack(id=request.id, status="refused", reason=reason)
            self._coming.append(Injected(tick=tick, injection=injection))
            self._names.add(injection.id)
        (x_m, y_m), *_ = injection.path
        return Ack(
            id=request.id,
            status="accepted",
            tick=tick,
            time_s=tick * self._tick_ms / 1000,
            x_m=x_m,
            y_m=y_m,
        )

    def _robot_is_known(self) -> bool:
        """Return whether the robot's pose at the start of the next tick is known, which is not so
        during a tick."""
        return self._robot.tick == self._next_tick

    def _objection(self, request: InjectionRequest, injection: Injection) -> str:
        """Return why an injection is refused; "" if it is valid."""
        for i, (point, (x_m, y_m)) in enumerate(zip(request.path, injection.path, strict=True)):
            if not self._on_map(x_m, y_m):
                found = _in_json((x_m, y_m))
                if isinstance(point, RelativePoint):
                    found = f"{_in_json(point)} from the robot, {found} on the map"
                return f"path[{i}] is {found}: that is not on this map. {self._valid_point()}"
        if injection.id in self._names:
            return "there was one of this id in the episode already: choose another"
        if len(self._here) + len(self._coming) >= MAX_INJECTED:
            return f"{MAX_INJECTED} injected pedestrians are here already: wait until some are gone"
        if len(self._names) >= MAX_INJECTED_PER_EPISODE:
            return (
                f"{MAX_INJECTED_PER_EPISODE} pedestrians were injected into this episode: no more"
            )
        return ""

    def _valid_point(self) -> str:
        """Return a sentence with the robot's position and a valid point ahead of it."""
        pose, route_s_m = self._robot.pose, self._robot.route_s_m
        there = self._route.at(route_s_m + SUGGESTED_AHEAD_M)
        relative = RelativePoint.of(there.x_m, there.y_m, pose)
        return (
            f"The robot is at {_in_json(pose[:2])}, heading_rad {pose.heading_rad:.2f}. A "
            f"valid point on its route is "
            f"{_in_json((there.x_m, there.y_m))}, or {_in_json(relative)} from the robot"
        )

    @property
    def log(self) -> tuple[Injected, ...]:
        """Return the injections that have taken effect, in order."""
        with self._lock:
            return tuple(self._log)

    def react(self, query: EventQuery) -> EventReply:
        """Return the director's reply with the injected people of this tick."""
        with self._lock:
            due = [entry for entry in self._coming if entry.tick <= query.tick]
            self._coming = [entry for entry in self._coming if entry.tick > query.tick]
            self._log += due
            self._next_tick = query.tick + 1
            before = self._here
            new = {entry.injection.id: spawn_injected(entry) for entry in due}
            self._here = before | new
        reply = self._director.react(query)
        here = {}
        for name, person in before.items():
            after = step_injected(person, query)
            if after is not None:
                here[name] = after
        here |= new
        with self._lock:
            self._here = here
        if not here:
            return reply
        actors = (
            *reply.actors,
            *(injected_actor(person, self._tick_ms) for person in here.values()),
        )
        return msgspec.structs.replace(reply, actors=actors)


def _in_json(point: tuple[float, float] | RelativePoint) -> str:
    """Return a point as in a message, in m."""
    if isinstance(point, RelativePoint):
        return f'{{"ahead": {point.ahead:.10g}, "left": {point.left:.10g}}}'
    return f"[{point[0]:.1f}, {point[1]:.1f}]"
