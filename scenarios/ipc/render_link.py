"""Connection of an environment to the shared renderer, and the camera that uses it.

One connection lasts as long as the process; when it closes, the environment has ended.
"""

from __future__ import annotations

import select
import socket
from collections.abc import Callable
from contextlib import suppress
from types import TracebackType
from typing import Final, Self

import msgspec

from bridge.policy_server import PackedArray, Refusal
from cosim.core.errors import EngineError, RendererLost
from cosim.core.framing import MessageSocket
from cosim.core.state import Frame, RobotState, Street
from cosim.spec.options import RendererAddress
from cosim.spec.scenario import Scenario
from scenarios.ipc.observation_codec import Arrays
from scenarios.ipc.render_protocol import (
    Draw,
    Enter,
    Rendered,
    Request,
    decode_rendered,
    encode_exchange,
)
from scenarios.ipc.shared_memory import SharedMemory

WAITING_EVERY_S: Final = 60.0
"""Seconds between two reports of an environment that waits for the renderer."""


class RendererLink:
    """Connection to the shared renderer. Its methods raise RendererLost when it has ended.

    waiting: called every waiting_every_s seconds while a reply is pending.
    number, renderer: of the last `Rendered`.
    """

    def __init__(
        self,
        address: str,
        waiting: Callable[[], None] | None = None,
        waiting_every_s: float = WAITING_EVERY_S,
    ) -> None:
        self.waiting = waiting
        self._address = address
        self.number = 0
        self.renderer = ""
        self._waiting_every_s = waiting_every_s
        self._memory: SharedMemory | None = None
        self._drawn: tuple[Arrays, dict[str, PackedArray]] = {}, {}
        self._end = socket.socket(socket.AF_UNIX)
        self._wire = MessageSocket(self._end)
        try:
            self._end.connect(f"\0{address}")
            self._wait()
            _, (descriptor,), *_ = socket.recv_fds(self._end, 1, 1)
        except (OSError, ValueError) as error:
            raise self.lost() from error
        self._memory = SharedMemory(descriptor)

    def send(self, request: Request) -> None:
        """Send a request without waiting for a reply."""
        try:
            self._wire.send(encode_exchange(request))
        except OSError as error:
            raise self.lost() from error

    def exchange(self, request: Request, call: str = "") -> bytes:
        """Return the reply to a request. call: the policy call in words, for errors."""
        self.send(request)
        return self.received(call)

    def received(self, call: str = "") -> bytes:
        """Wait for the reply to the last request."""
        try:
            self._wait()
            return self._wire.receive()
        except (OSError, EOFError) as error:
            raise self.lost(call) from error

    def enter(self, scenario: Scenario) -> None:
        """Report the scenario that this environment runs. Raises EngineError."""
        self._decode_rendered(self.exchange(Enter(scenario)))

    def draw(self, robot: RobotState, street: Street) -> Frame:
        """Return the picture of the robot's camera. Raises EngineError."""
        return self.decode_frame(self.exchange(Draw(robot, street)))

    def decode_frame(self, payload: bytes) -> Frame:
        """Return a copy of the picture that a reply describes. Raises EngineError."""
        locations = self._decode_rendered(payload).arrays
        if self._memory is None:
            raise self.lost()
        arrays = self._memory.read_arrays(locations)
        self._drawn = arrays, locations
        return Frame(arrays["rgb"], arrays["labels"])

    def location_of(self, name: str, array: object) -> PackedArray | None:
        """Return the location of an array of the last picture; None for any other array."""
        arrays, locations = self._drawn
        return locations[name] if arrays.get(name) is array else None

    def leave(self) -> None:
        """Report that this environment runs no scenario."""
        self.send(Enter(None))

    def close(self) -> None:
        """Close the connection; the next use of `link_to` makes another one."""
        if _links.get(self._address) is self:
            del _links[self._address]
        self._wire.close()
        if self._memory is not None:
            self._memory.close()
            self._memory = None

    def lost(self, call: str = "") -> RendererLost:
        """Close the connection, and return the error to raise."""
        busy = self._memory is not None and self._memory.busy
        self.close()
        return RendererLost(self.number, call if busy else "")

    def _decode_rendered(self, payload: bytes) -> Rendered:
        try:
            reply: Rendered | Refusal = decode_rendered(payload)
        except msgspec.DecodeError as error:
            raise self.lost() from error
        if isinstance(reply, Refusal):
            raise EngineError(reply.words)
        self.number = reply.number
        self.renderer = reply.renderer
        return reply

    def _wait(self) -> None:
        while not select.select([self._end], [], [], self._waiting_every_s)[0]:
            if self.waiting is not None:
                self.waiting()


def link_to(address: str, waiting: Callable[[], None] | None = None) -> RendererLink:
    """Return this process's connection to the renderer at an address, made when first needed.

    waiting: called from now on while a reply is waited for, and while the renderer accepts no
    connection because it loads a large policy.
    """
    if address not in _links:
        _links[address] = RendererLink(address, waiting)
    elif waiting is not None:
        _links[address].waiting = waiting
    return _links[address]


_links: Final[dict[str, RendererLink]] = {}


class SharedCamera:
    """This environment's camera in the shared renderer, for one scenario. Use it in a `with`
    block."""

    def __init__(self, renderer: RendererAddress, scenario: Scenario) -> None:
        self._link = link_to(renderer.address)
        self._scenario = scenario

    @property
    def renderer(self) -> str:
        """Return the name of the renderer in records."""
        return self._link.renderer

    def __enter__(self) -> Self:
        self._link.enter(self._scenario)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with suppress(RendererLost):
            self._link.leave()

    def render(self, robot: RobotState, street: Street) -> Frame:
        return self._link.draw(robot, street)
