"""An environment's end of the shared renderer: what draws for it, and, for a policy that answers
for many episodes at once, what asks it.

One connection lasts as long as the process; when it ends the renderer knows that the environment
has.
"""

from __future__ import annotations

import select
import socket
from collections.abc import Callable
from contextlib import suppress
from types import TracebackType
from typing import Final, Self

import msgspec
import shapely

from cosim.core.errors import EngineError, PolicyError, RendererLost
from cosim.core.framing import Wire
from cosim.core.state import Command, Frame, Planned, RobotState, Street
from cosim.episode.interfaces import Observation, Privileged
from cosim.episode.policy_caller import Driver, when
from cosim.spec.manifest import Manifest
from cosim.spec.options import RendererAt
from cosim.spec.scenario import Scenario
from scenarios.ipc.picture_memory import PictureMemory
from scenarios.ipc.render_protocol import (
    Ask,
    Begin,
    Draw,
    Enter,
    Knowledge,
    Leave,
    Refused,
    Reply,
    Request,
    Told,
    Welcome,
    decode_reply,
    encode_exchange,
)

_TELLS_EVERY_S: Final = 60.0
"""Who waits for the renderer says so that often: it is no silence."""


class RendererLink:
    """The connection. renderer: what draws, as records name it. waiting: called now and then while
    a reply is waited for. Raises RendererLost, here and whenever it is used, when the renderer is
    gone."""

    def __init__(self, address: str, waiting: Callable[[], None] | None = None) -> None:
        self.waiting = waiting
        self._number = 0
        self._memory: PictureMemory | None = None
        self._end = socket.socket(socket.AF_UNIX)
        self._wire = Wire(self._end)
        try:
            self._end.connect(f"\0{address}")
            self._wait()
            _, (descriptor,), *_ = socket.recv_fds(self._end, 1, 1)
            welcome = self._received()
        except (OSError, ValueError, EOFError, msgspec.DecodeError) as error:
            raise self.lost() from error
        assert isinstance(welcome, Welcome)
        self._number = welcome.number
        self.renderer = welcome.renderer
        self._memory = PictureMemory(descriptor, welcome.size)

    def tell(self, request: Request) -> None:
        """Say something that is not replied to."""
        try:
            self._wire.send(encode_exchange(request))
        except OSError as error:
            raise self.lost() from error

    def ask(self, request: Request, asked: str = "") -> Reply:
        """The reply to a request. asked: what the policy is asked by it. Raises PolicyError and
        EngineError with what the renderer says."""
        self.tell(request)
        return self.reply(asked)

    def reply(self, asked: str = "") -> Reply:
        """The reply to what was told."""
        try:
            reply = self._received()
        except (OSError, EOFError, msgspec.DecodeError) as error:
            raise self.lost(asked) from error
        if isinstance(reply, Refused):
            raise PolicyError(reply.reason) if reply.by_policy else EngineError(reply.reason)
        return reply

    def picture(self) -> Frame:
        """The last one that was drawn."""
        if self._memory is None:
            raise self.lost()
        return self._memory.take()

    def lost(self, asked: str = "") -> RendererLost:
        """The error for a connection that is of no use any more; the next one is made anew."""
        _links.clear()
        self._wire.close()
        if self._memory is not None:
            asked = asked if self._memory.asked else ""
            self._memory.close()
            self._memory = None
        return RendererLost(self._number, asked)

    def _received(self) -> Reply:
        self._wait()
        reply: Reply = decode_reply(self._wire.receive())
        return reply

    def _wait(self) -> None:
        while not select.select([self._end], [], [], _TELLS_EVERY_S)[0]:
            if self.waiting is not None:
                self.waiting()


def link_to(address: str, waiting: Callable[[], None] | None = None) -> RendererLink:
    """This process's connection to the renderer at an address, made when it is first needed.
    waiting: called from now on while a reply is waited for, that to the connection too: a renderer
    that loads a large policy lets it wait."""
    if address not in _links:
        _links[address] = RendererLink(address, waiting)
    elif waiting is not None:
        _links[address].waiting = waiting
    return _links[address]


_links: Final[dict[str, RendererLink]] = {}


class SharedCamera:
    """This environment's place in the shared renderer while it runs a scenario. Use it in a `with`
    block.

    renderer: what draws, as records name it."""

    def __init__(self, renderer: RendererAt, scenario: Scenario) -> None:
        self._link = link_to(renderer.address)
        self._scenario = scenario
        self.renderer = self._link.renderer

    def __enter__(self) -> Self:
        self._link.ask(Enter(self._scenario))
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with suppress(RendererLost):
            self._link.tell(Leave())

    def render(self, robot: RobotState, street: Street) -> Frame:
        self._link.ask(Draw(robot, street))
        return self._link.picture()


class AskedElsewhere(Driver):
    """The driver of a policy that the shared renderer asks, for all episodes together."""

    def __init__(self, manifest: Manifest, source_hash: str, renderer: RendererAt) -> None:
        super().__init__(self, manifest, source_hash)
        self._address = renderer.address
        self._free: object = None

    def reset(self, episode_id: str, seed: int) -> None:
        self._free = None
        link_to(self._address).ask(Begin(episode_id, seed), when("reset", 0))

    def act(self, observation: Observation) -> Command:
        known = observation.privileged if self.manifest.privileged else None
        told = None if known is None else self._told(known)
        seen = observation
        request = Ask(
            seen.tick, seen.v_mps, seen.w_radps, told, seen.reset, seen.goal, seen.odometry
        )
        reply = link_to(self._address).ask(request, when("act", observation.tick))
        assert isinstance(reply, Told)
        if reply.waypoints is None:
            return Command(reply.v_mps, reply.w_radps)
        return Planned(reply.v_mps, reply.w_radps, reply.waypoints, reply.index)

    def _told(self, known: Privileged) -> Knowledge:
        """What the renderer is told of it: the ground where the robot may be once for each
        episode."""
        free = b"" if known.free is self._free else shapely.to_wkb(known.free)
        self._free = known.free
        people, vehicles, signals = known.people, known.vehicles, known.signals
        return Knowledge(
            known.robot, known.route_s_m, people, vehicles, signals, known.crossings, free
        )
