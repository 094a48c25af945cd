"""The director of an episode's event pedestrians, in this process or in another one.

By default an episode has its own director in a Zenoh session without a socket, which replies in the
same thread. `cosim direct` serves any number of runs and episodes (`cosim run --director
ENDPOINT`). Both are queried over Zenoh at every tick, and give the same bits.
"""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import cache, partial
from pathlib import Path
from typing import Final

import msgspec

import scenarios.events
from bridge import keys
from bridge.director import RemoteDirector, serve_director
from bridge.session import LocalSession, Session, open_session
from cosim.core.errors import AccessError, DirectorLost, EngineError
from cosim.core.progress import Progress
from cosim.core.state import DIRECTED, People
from cosim.episode.interfaces import Director
from cosim.people.yielding import StandingObstacles
from cosim.spec.events import EventKinds, EventQuery, EventReply
from cosim.spec.options import DirectorAddress
from scenarios.events import EVENT_KINDS, react

RETRY_S: Final = 0.2
"""Seconds between two attempts to connect to a director."""
_NEAR_M: Final = 0.5
"""Distance in m from people within which obstacles are sent to the director."""
_OURS: Final = ("cosim.", "scenarios.")
"""Prefixes of the modules whose source is part of the version of the behaviours."""


def director_of(
    episode: str,
    outside: DirectorAddress | None,
    waiting: Progress,
    kinds: EventKinds = EVENT_KINDS,
) -> AbstractContextManager[Director]:
    """Return the director of an episode: the remote one, or without an address one in this
    process."""
    return (
        in_process_director(episode, kinds)
        if outside is None
        else remote_director(outside, waiting, episode)
    )


@contextmanager
def in_process_director(episode: str, kinds: EventKinds = EVENT_KINDS) -> Iterator[Director]:
    """Serve a director in a Zenoh session of its own, and yield the client."""
    key = keys.director("local", keys.chunk(episode))
    with LocalSession() as session:
        serve_director(session, key, partial(react, kinds=kinds))
        yield RemoteDirector(session, key)


@contextmanager
def remote_director(
    outside: DirectorAddress, waiting: Progress, episode: str
) -> Iterator[Director]:
    """Connect to a remote director for one episode. Raises DirectorLost if there is none in
    time."""
    with _connected(outside, waiting) as session:
        key = keys.director(outside.run, keys.chunk(episode))
        yield RemoteDirector(
            session, key, version=behaviour_version(), wait_s=outside.wait_s, waiting=waiting
        )


class ObstacleAwareDirector:
    """Adds obstacles near event pedestrians to the queries of a director.

    people: returns the people on the street now.
    """

    def __init__(
        self, director: Director, standing: StandingObstacles, people: Callable[[], People]
    ) -> None:
        self._director = director
        self._standing = standing
        self._people = people

    def react(self, query: EventQuery) -> EventReply:
        """Return the director's reply to a query with nearby obstacles."""
        people = self._people()
        near = self._standing.near(people.xy[people.are(*DIRECTED)], _NEAR_M)
        return self._director.react(
            msgspec.structs.replace(query, standing=near) if near else query
        )


def serve_all_directors(session: Session) -> None:
    """Serve all runs and episodes that query on this session."""
    serve_director(session, keys.EVERY_DIRECTOR, react, behaviour_version())


@cache
def behaviour_version() -> str:
    """Return the version of the behaviours: a hash of their source and of the project's modules
    that it imports, 16 hexadecimal digits."""
    digest = hashlib.sha256()
    for name, source in sorted(imported_sources(scenarios.events.__name__).items()):
        digest.update(name.encode() + b"\0" + source + b"\0")
    return digest.hexdigest()[:16]


def imported_sources(name: str) -> dict[str, bytes]:
    """Return the source of a module and of the project's modules that it imports, directly or not,
    by name."""
    found: dict[str, bytes] = {}
    for each in (name, "cosim.rounding"):  # every package imports cosim.rounding
        _gather(each, found)
    return found


def _gather(name: str, found: dict[str, bytes]) -> None:
    """Add the source of a module and of the project's modules that it imports to `found`."""
    if name in found:
        return
    try:
        spec = importlib.util.find_spec(name)
    except ModuleNotFoundError:  # an attribute of a module
        return
    if spec is None or spec.origin is None:
        return
    found[name] = Path(spec.origin).read_bytes()
    for node in ast.walk(ast.parse(found[name])):
        imported: list[str] = []
        if isinstance(node, ast.Import):
            imported = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            imported = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        for other in imported:
            if other.startswith(_OURS):
                parts = other.split(".")
                for depth in range(2, len(parts) + 1):  # its packages are imported first
                    _gather(".".join(parts[:depth]), found)


def _connected(outside: DirectorAddress, waiting: Progress) -> Session:
    """Connect to the director's hub, with retries until the timeout. Raises DirectorLost."""
    deadline = time.monotonic() + outside.wait_s
    endpoint = outside.connection.endpoint
    reported = False
    while True:
        try:
            return open_session(outside.connection)
        except AccessError as error:
            raise DirectorLost(str(error)) from error
        except EngineError as error:
            if time.monotonic() > deadline:
                raise DirectorLost(
                    f"no director at {endpoint} within {outside.wait_s:g} s: start one with `cosim "
                    f"direct --listen {endpoint}` ({error})"
                ) from error
        if not reported:
            waiting(f"waits for a director at {endpoint}, {outside.wait_s:g} s at most")
            reported = True
        time.sleep(RETRY_S)
