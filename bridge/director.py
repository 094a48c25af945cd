"""The director of the event pedestrians, at either end of a Zenoh session.

Lockstep pull: at every tick the simulator asks and waits. The director keeps no state (see `cosim.events`), so a
query may be repeated and a director restarted without changing the episode.
"""

from __future__ import annotations

from collections.abc import Callable

from bridge.codec import decode, encode
from bridge.session import Session
from cosim.errors import DirectorLost, EngineError
from cosim.events import EventQuery, EventReply

React = Callable[[EventQuery], EventReply]


def serve_director(session: Session, key: str, react: React) -> None:
    """Answer the simulator's queries on `key` with the pure function `react`."""
    session.serve(key, lambda payload: encode(react(decode(payload, EventQuery))))


class RemoteDirector:
    """The simulator's end: a `cosim.ports.Director` that asks over Zenoh."""

    def __init__(self, session: Session, key: str, *, timeout_s: float = 10.0) -> None:
        self._session = session
        self._key = key
        self._timeout_s = timeout_s

    def react(self, query: EventQuery) -> EventReply:
        """The director's reply. Raises DirectorLost when none comes or it answers something else."""
        try:
            reply = decode(self._session.ask(self._key, encode(query), timeout_s=self._timeout_s), EventReply)
        except (TimeoutError, EngineError) as error:
            raise DirectorLost(f"tick {query.tick} of '{query.episode}': {error}") from error
        if (reply.episode, reply.tick) != (query.episode, query.tick) or len(reply.states) != len(query.events):
            raise DirectorLost(
                f"tick {query.tick} of '{query.episode}': the director answered tick {reply.tick} of "
                f"'{reply.episode}' with {len(reply.states)} states for {len(query.events)} events"
            )
        return reply
