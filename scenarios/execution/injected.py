"""Injected people, beside those of the events. A director around a director.

Injections come from any thread, or from a record that is replayed; they take effect at the boundary of a step, in the
order in which they came.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from threading import Lock
from typing import Final

import msgspec

from cosim.episode.ports import Director
from cosim.spec.events import EventQuery, EventReply
from cosim.spec.injection import Ack, Injected, Injection
from scenarios.events.injected_person import InjectedPerson, arriving, injected_actor, injected_moved_on

MOST_INJECTED: Final = 100
"""At once, those under way to their first step included."""
MOST_EVER: Final = 5000
"""In one episode: its record holds them all."""


class InjectedPeople:
    """Adds injected people to a director's replies. on_map(x_m, y_m): whether a point belongs to the place at all."""

    def __init__(
        self, director: Director, tick_ms: int, on_map: Callable[[float, float], bool], script: Sequence[Injected] = ()
    ) -> None:
        self._director, self._tick_ms, self._on_map = director, tick_ms, on_map
        self._lock = Lock()
        self._coming: list[Injected] = list(script)
        self._log: list[Injected] = []
        self._here: dict[str, InjectedPerson] = {}
        self._names = {entry.injection.id for entry in script}
        self._next_tick = 0

    def offer(self, injection: Injection) -> Ack:
        """Take an injection in for the next step, or say why not. Any thread may call this."""
        off = next((point for point in injection.path if not self._on_map(*point)), None)
        with self._lock:
            reason = ""
            if off is not None:
                reason = f"path holds ({off[0]:g}, {off[1]:g}): that is not on this map"
            elif injection.id in self._names:
                reason = "there was one of this id in the episode already"
            elif len(self._here) + len(self._coming) >= MOST_INJECTED:
                reason = f"{MOST_INJECTED} injected pedestrians are here already: wait until some are gone"
            elif len(self._names) >= MOST_EVER:
                reason = f"{MOST_EVER} pedestrians were injected into this episode: no more"
            if reason:
                return Ack(id=injection.id, status="refused", reason=reason)
            self._coming.append(Injected(tick=self._next_tick, injection=injection))
            self._names.add(injection.id)
            tick = self._next_tick
        return Ack(id=injection.id, status="accepted", tick=tick, time_s=tick * self._tick_ms / 1000)

    @property
    def log(self) -> tuple[Injected, ...]:
        """What took effect so far, in order."""
        with self._lock:
            return tuple(self._log)

    def react(self, query: EventQuery) -> EventReply:
        """The director's reply, with the injected people of this tick among its actors."""
        with self._lock:
            due = [entry for entry in self._coming if entry.tick <= query.tick]
            self._coming = [entry for entry in self._coming if entry.tick > query.tick]
            self._log += due
            self._next_tick = query.tick + 1
            before, new = self._here, {entry.injection.id: arriving(entry) for entry in due}
            self._here = before | new
        reply = self._director.react(query)
        here = {}
        for name, person in before.items():
            after = injected_moved_on(person, query)
            if after is not None:
                here[name] = after
        here |= new
        with self._lock:
            self._here = here
        if not here:
            return reply
        actors = (*reply.actors, *(injected_actor(person, self._tick_ms) for person in here.values()))
        return msgspec.structs.replace(reply, actors=actors)
