"""Where the event pedestrians of an episode are decided: in a session beside it, or in a process of
their own.

By default an episode brings its director along: a Zenoh session with nobody else in it, which asks
and answers in the same thread, with no socket. `cosim direct` serves any number of runs and
episodes from outside (`cosim run --director ENDPOINT`). Both are asked over Zenoh at every tick,
and both give the same bits.
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
from bridge.session import LoneSession, Session, open_session
from cosim.core.errors import AccessError, DirectorLost, EngineError
from cosim.core.progress import Progress
from cosim.core.state import DIRECTED, People
from cosim.episode.interfaces import Director
from cosim.people.yielding import Standing
from cosim.spec.events import EventKinds, EventQuery, EventReply
from cosim.spec.options import Outside
from scenarios.events import EVENT_KINDS, react

RETRY_S: Final = 0.2
_NEAR_M: Final = 0.5
"""Of what stands there directors are told so much before people reach it."""
_OURS: Final = ("cosim.", "scenarios.")


def director_of(
    episode: str, outside: Outside | None, waiting: Progress, kinds: EventKinds = EVENT_KINDS
) -> AbstractContextManager[Director]:
    """The director of an episode's event pedestrians: the one outside, or one of its own."""
    return directed(episode, kinds) if outside is None else directed_by(outside, waiting, episode)


@contextmanager
def directed(episode: str, kinds: EventKinds = EVENT_KINDS) -> Iterator[Director]:
    """A director of event pedestrians and the simulator's end of it, both in one Zenoh session."""
    key = keys.director("local", keys.chunk(episode))
    with LoneSession() as session:
        serve_director(session, key, partial(react, kinds=kinds))
        yield RemoteDirector(session, key)


@contextmanager
def directed_by(outside: Outside, waiting: Progress, episode: str) -> Iterator[Director]:
    """The simulator's end of a director outside, for one episode. Raises DirectorLost when it never
    comes."""
    with _reached(outside, waiting) as session:
        key = keys.director(outside.run, keys.chunk(episode))
        yield RemoteDirector(session, key, by=behaviours(), wait_s=outside.wait_s, waiting=waiting)


class AmongObstacles:
    """A director that is told what stands near the people whom it moves. people: those on the
    street now."""

    def __init__(
        self, director: Director, standing: Standing, people: Callable[[], People]
    ) -> None:
        self._director = director
        self._standing = standing
        self._people = people

    def react(self, query: EventQuery) -> EventReply:
        """The director's reply, the obstacles being known."""
        people = self._people()
        near = self._standing.near(people.xy[people.are(*DIRECTED)], _NEAR_M)
        return self._director.react(
            msgspec.structs.replace(query, standing=near) if near else query
        )


def direct_all(session: Session) -> None:
    """Direct every run and episode that asks on this session."""
    serve_director(session, keys.EVERY_DIRECTOR, react, behaviours())


@cache
def behaviours() -> str:
    """What the behaviours are: a hash of their source and of all of ours that it imports. 16
    hexadecimal digits."""
    digest = hashlib.sha256()
    for name, source in sorted(sources(scenarios.events.__name__).items()):
        digest.update(name.encode() + b"\0" + source + b"\0")
    return digest.hexdigest()[:16]


def sources(name: str) -> dict[str, bytes]:
    """The source of a module and of all of ours that it imports, however indirectly, by their
    names."""
    found: dict[str, bytes] = {}
    for each in (name, "cosim.rounding"):  # the second is loaded with any of our rooms
        _gather(each, found)
    return found


def _gather(name: str, found: dict[str, bytes]) -> None:
    """Put the source of a module, and of what it imports of ours, into `found`."""
    if name in found:
        return
    try:
        spec = importlib.util.find_spec(name)
    except ModuleNotFoundError:  # what is imported from a module that is no package
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
                rooms = other.split(".")
                for depth in range(
                    2, len(rooms) + 1
                ):  # the rooms that it lies in are loaded before it
                    _gather(".".join(rooms[:depth]), found)


def _reached(outside: Outside, waiting: Progress) -> Session:
    """A session with the director's hub, as soon as there is one."""
    deadline = time.monotonic() + outside.wait_s
    endpoint = outside.connection.endpoint
    told = False
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
        if not told:
            waiting(f"waits for a director at {endpoint}, {outside.wait_s:g} s at most")
            told = True
        time.sleep(RETRY_S)
