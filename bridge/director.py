"""Director of event pedestrians over a Zenoh session: client and server.

The simulator queries the director in every tick and waits (lockstep). The director is stateless
(`cosim.spec.events`), so a query may be repeated, and a director may be restarted without changing
the episode.

Messages carry the version of the behaviours of their sender. Each end rejects other versions.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from functools import lru_cache
from typing import Annotated, TypeVar

import msgspec

from bridge.codec import decode, encode
from bridge.session import Session
from cosim.core.errors import DirectorLost, EngineError
from cosim.core.progress import Progress
from cosim.core.state import PersonKind
from cosim.spec.events import Event, EventQuery, EventReply

React = Callable[[EventQuery], EventReply]

NOTICE_S = 2.0
"""Seconds without a reply after which the progress callback is called."""
LONGEST_REASON = 500
"""Longest error of a director in characters."""

_T = TypeVar("_T")


class VersionedMessage(msgspec.Struct, frozen=True):
    """Message with the version of the sender's behaviours."""

    version: Annotated[str, msgspec.Meta(max_length=64)] = msgspec.field(default="", name="by")
    message: msgspec.Raw = msgspec.Raw(b"")


def encode_versioned(message: msgspec.Struct, version: str) -> bytes:
    """Encode a message with the version of its sender's behaviours."""
    return encode(VersionedMessage(version, msgspec.Raw(encode(message))))


def decode_versioned(payload: bytes, kind: type[_T], version: str) -> _T:
    """Decode a message. Raises EngineError if it is invalid or from another version."""
    envelope = decode(payload, VersionedMessage)
    if envelope.version != version:
        raise EngineError(
            f"behaviours '{envelope.version}' met behaviours '{version}': run and director must be "
            f"started from the same code"
        )
    return decode(bytes(envelope.message), kind)


class QueryParts(msgspec.Struct, frozen=True):
    """Query with its events as a separate block, because they are the same in every tick."""

    query: msgspec.Raw
    events: msgspec.Raw


def encode_query(query: EventQuery, version: str) -> bytes:
    """Encode a query with the version of its sender's behaviours."""
    bare = msgspec.structs.replace(query, events=())
    return encode_versioned(
        QueryParts(msgspec.Raw(encode(bare)), msgspec.Raw(encode(query.events))), version
    )


def decode_query(payload: bytes, version: str) -> EventQuery:
    """Decode a query. Raises EngineError as `decode_versioned` does."""
    parts = decode_versioned(payload, QueryParts, version)
    query = decode(bytes(parts.query), EventQuery)
    return msgspec.structs.replace(query, events=_events(bytes(parts.events)))


@lru_cache(maxsize=64)
def _events(payload: bytes) -> tuple[Event, ...]:
    """Decode events; cached for an episode."""
    return decode(payload, tuple[Event, ...])


def serve_director(session: Session, key: str, react: React, version: str = "") -> None:
    """Answer queries on `key` with the pure function `react`.

    version: Version of its behaviours.
    """
    session.serve(
        key, lambda payload: encode_versioned(react(decode_query(payload, version)), version)
    )


class RemoteDirector:
    """`cosim.episode.interfaces.Director` that queries over Zenoh.

    version: Version of the simulator's behaviours.
    wait_s: Timeout of a reply in seconds.
    waiting: Called after NOTICE_S without a reply.
    """

    def __init__(
        self,
        session: Session,
        key: str,
        *,
        version: str = "",
        wait_s: float = 10.0,
        waiting: Progress | None = None,
    ) -> None:
        self._session = session
        self._key = key
        self._version = version
        self._wait_s = wait_s
        self._waiting = waiting

    def react(self, query: EventQuery) -> EventReply:
        """Return the director's reply.

        Raises DirectorLost on timeout or an invalid reply. A director in this process cannot be
        lost: its errors are the simulator's, EngineError.
        """
        try:
            reply = decode_versioned(
                self._query(encode_query(query, self._version), query.tick),
                EventReply,
                self._version,
            )
            _check(reply, query)
        except (TimeoutError, EngineError) as error:
            why = str(error)[:LONGEST_REASON]
            failed = EngineError if self._session.in_process else DirectorLost
            raise failed(f"director, tick {query.tick} of '{query.episode}': {why}") from error
        return reply

    def _query(self, payload: bytes, tick: int) -> bytes:
        """Return the reply, with retries until the timeout."""
        began = time.monotonic()
        if self._waiting is not None and self._wait_s > NOTICE_S:
            try:
                return self._session.query(self._key, payload, timeout_s=NOTICE_S)
            except TimeoutError:
                self._waiting(f"waits at tick {tick} for the director, {self._wait_s:g} s at most")
        try:
            return self._session.query(
                self._key, payload, timeout_s=self._wait_s - (time.monotonic() - began)
            )
        except TimeoutError:
            raise TimeoutError(f"no reply on '{self._key}' within {self._wait_s:g} s") from None


def _check(reply: EventReply, query: EventQuery) -> None:
    """Raise EngineError for a reply to another query, or with invalid people."""
    if (reply.episode, reply.tick) != (query.episode, query.tick):
        raise EngineError(f"it answered tick {reply.tick} of '{reply.episode}'")
    people = [event.people for event in query.events]
    if [len(state.walkers) for state in reply.states] != people:
        raise EngineError(
            f"it answered with {len(reply.states)} states for {len(people)} events, or with "
            f"other people"
        )
    known = {name for event in query.events for name in event.names}
    shown = {actor.id for actor in reply.actors}
    if len(shown) < len(reply.actors) or not shown <= known:
        raise EngineError(
            f"it showed people of no event, or twice: {', '.join(sorted(shown - known)[:5])}"
        )
    if other := [actor.id for actor in reply.actors if actor.kind != PersonKind.EVENT]:
        raise EngineError(f"it showed people of events as others: {', '.join(other[:5])}")
    walkers = [walker for state in reply.states for walker in state.walkers]
    total = sum(abs(w.x_m) + abs(w.y_m) + abs(w.heading_rad) for w in walkers)
    total += sum(
        abs(a.x_m) + abs(a.y_m) + abs(a.heading_rad) + abs(a.speed_mps) + abs(a.pace_mps or 0.0)
        for a in reply.actors
    )
    if not math.isfinite(total):
        raise EngineError("it answered with a place, heading or speed that is no number")
