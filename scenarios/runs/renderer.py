"""The shared renderer: one process that draws for all environments of a run.

It also queries a policy with `act_batch` for all episodes together. Environments connect, and send
one request at a time (`scenarios.ipc.render_protocol`). All requested pictures are drawn together.
An environment queries the policy after it has its picture, so a batch waits a moment for these
environments. A picture depends on robot and street only, so results do not depend on how requests
are batched.
"""

from __future__ import annotations

import os
import selectors
import signal
import socket
import struct
import time
import traceback
from collections.abc import Callable
from contextlib import ExitStack, suppress
from functools import lru_cache, partial
from math import inf
from typing import TYPE_CHECKING, Final

import msgspec

from bridge.policy_server import (
    ActRequest,
    EndRequest,
    PolicyDesk,
    Refusal,
    ResetRequest,
    error_text,
)
from cosim.core.framing import MessageSocket
from cosim.results.run_setup import NO_RENDERER
from cosim.spec.robot import robot_called
from cosim.spec.scenario import Place, Scenario
from physics.cameras.choice import renderer_of
from physics.dynamics.world import BulletWorld
from physics.street.surface import PlaceSurface
from scenarios.ipc.deadlines import PendingCallMemory
from scenarios.ipc.messages import Ready, decode_hello
from scenarios.ipc.observation_codec import ObservationDecoder
from scenarios.ipc.render_protocol import (
    Draw,
    Enter,
    Rendered,
    Reply,
    Request,
    decode_request,
    encode_exchange,
)
from scenarios.ipc.shared_memory import SharedMemory, observation_bytes
from scenarios.places.nets import make_surface, place
from scenarios.runs.worker import load_run_policy, send_to_run

if TYPE_CHECKING:
    from physics.cameras.gl.atlas import Atlas, SeatKey

_BEAT_S: Final = 1.0
"""Seconds between two heartbeats to the run."""
_PLACES_KEPT: Final = 8
"""Surfaces of places that are cached."""
_PEER: Final = struct.Struct("3i")
"""Layout of process, user and group id of a connected process (SO_PEERCRED)."""


def serve_pictures(pipe: int, pending_call: int, listening: int) -> None:
    """Serve environments until the run closes the socket.

    pipe: descriptor of the socket to the run.
    pending_call: descriptor of the shared memory of the pending call.
    listening: descriptor of the socket that environments connect to.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    wire = MessageSocket(socket.socket(fileno=pipe))
    send = partial(send_to_run, wire, os.getpid())
    hello = decode_hello(wire.receive())
    assert hello.renderer is not None
    desk = None
    if hello.renderer.asks:
        timer = PendingCallMemory(pending_call)
        policy = load_run_policy(hello, timer, send).policy
        desk = PolicyDesk(policy, decoder=ObservationDecoder, timer=timer, forget_after_s=inf)
    with ExitStack() as stack:
        atlas = None
        drawn_by = NO_RENDERER
        if (spec := hello.manifest.camera) is not None:
            from physics.cameras.gl.atlas import Atlas  # needs OpenGL

            appearance = hello.renderer.appearance
            atlas = stack.enter_context(Atlas(spec, appearance))
            drawn_by = renderer_of("gl", appearance)
        rendered = Rendered(hello.renderer.number, drawn_by)
        renderer = _Renderer(
            rendered, observation_bytes(hello.manifest), atlas, desk, partial(send, Ready())
        )
        renderer.serve(socket.socket(fileno=listening), pipe)


class _Environment:
    """A connected environment process.

    episode_reset: the request that began the current episode of the policy.
    seat: its place in the atlas.
    pending_request: the pending request.
    asks_next: whether its next request is to the policy, with the picture that it has.
    """

    def __init__(self, connection: socket.socket, memory_bytes: int) -> None:
        self.wire = MessageSocket(connection)
        self.memory = SharedMemory.new(memory_bytes)
        self.episode_reset: ResetRequest | None = None
        self.seat: SeatKey | None = None
        self.pending_request: Draw | ResetRequest | ActRequest | None = None
        self.asks_next = False
        socket.send_fds(connection, [b"\0"], [self.memory.descriptor])

    @property
    def order(self) -> str:
        """Return the key by which environments are sorted: the name of the episode."""
        return "" if self.episode_reset is None else self.episode_reset.episode

    def reply(self, reply: Reply) -> None:
        """Send a reply. Errors are ignored: the end of the process is detected when reading.

        After an error its policy call stays pending, because the policy may have closed its socket.
        """
        self.pending_request = None
        with suppress(OSError):
            self.wire.post(encode_exchange(reply))
            self.memory.busy = False

    def close(self) -> None:
        self.wire.close()
        self.memory.close()


class _Renderer:
    """Server of the environments of a run.

    rendered: reply to Enter.
    memory_bytes: bytes of an observation.
    beat: sends a heartbeat to the run.
    """

    def __init__(
        self,
        rendered: Rendered,
        memory_bytes: int,
        atlas: Atlas | None,
        desk: PolicyDesk | None,
        beat: Callable[[], None],
    ) -> None:
        self._rendered = rendered
        self._memory_bytes = memory_bytes
        self._atlas = atlas
        self._desk = desk
        self._beat = beat
        self._environments: list[_Environment] = []
        self._selector = selectors.DefaultSelector()
        self._since_s = 0.0
        self._open = True

    def serve(self, listening: socket.socket, pipe: int) -> None:
        self._selector.register(listening, selectors.EVENT_READ, partial(self._accept, listening))
        self._selector.register(pipe, selectors.EVENT_READ, self._run_ended)
        beat_at_s = 0.0
        while self._open:
            if time.monotonic() >= beat_at_s:
                self._beat()
                beat_at_s = time.monotonic() + _BEAT_S
            for key, _ in self._selector.select(self._left_s()):
                key.data()
            if self._left_s() <= 0.0:
                self._answer()

    def _left_s(self) -> float:
        """Return the seconds to wait for further requests."""
        wanted = [
            environment.pending_request
            for environment in self._environments
            if environment.pending_request is not None
        ]
        if not wanted:
            return _BEAT_S
        if self._desk is None or not all(
            isinstance(pending_request, ActRequest) for pending_request in wanted
        ):
            return 0.0
        expected = len(wanted) + sum(environment.asks_next for environment in self._environments)
        return self._desk.wait_s(len(wanted), expected, self._since_s)

    def _run_ended(self) -> None:
        """Stop serving: the run sends nothing after its first message, so its socket is closed."""
        self._open = False

    def _accept(self, listening: socket.socket) -> None:
        """Accept an environment's connection; one of another user is closed."""
        connection, _ = listening.accept()
        peer = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _PEER.size)
        if _PEER.unpack(peer)[1] != os.getuid():
            connection.close()
            return
        environment = _Environment(connection, self._memory_bytes)
        self._environments.append(environment)
        self._selector.register(
            connection, selectors.EVENT_READ, partial(self._read_requests, environment)
        )

    def _read_requests(self, environment: _Environment) -> None:
        """Read the requests of an environment. It is disconnected when it ends, or after an invalid
        request."""
        try:
            for message in environment.wire.received():
                if not self._take(environment, decode_request(message)):
                    self._disconnect(environment)
                    return
        except (EOFError, OSError, msgspec.DecodeError, ValueError, TypeError):
            self._disconnect(environment)

    def _disconnect(self, environment: _Environment) -> None:
        self._leave(environment)
        self._end(environment)
        self._selector.unregister(environment.wire)
        self._environments.remove(environment)
        environment.close()

    def _take(self, environment: _Environment, request: Request) -> bool:
        """Process or store a request. Returns False if it is out of order."""
        if environment.pending_request is not None:
            return False
        if isinstance(request, Enter):
            self._leave(environment)
            if request.scenario is not None:
                environment.reply(self._entered(environment, request.scenario))
        elif isinstance(request, EndRequest):
            self._end(environment)
        elif isinstance(request, Draw):
            if environment.seat is None:
                return False
            environment.pending_request = request
        elif self._desk is None:
            return False
        else:
            if not any(
                isinstance(other.pending_request, ActRequest) for other in self._environments
            ):
                self._since_s = time.monotonic()
            environment.pending_request = request
            environment.asks_next = False
        return True

    def _entered(self, environment: _Environment, scenario: Scenario) -> Reply:
        """Add the scenario of an environment to the atlas, and return the reply."""
        try:
            if self._atlas is not None:
                robot = robot_called(scenario.robot)
                world = BulletWorld(
                    _surface(scenario.place), scenario.barriers, robot, scenario.obstacles
                )
                environment.seat = self._atlas.join(world, scenario.light, scenario.conditions)
        except Exception as error:  # noqa: BLE001  concerns one scenario only
            return _refused(error)
        return self._rendered

    def _leave(self, environment: _Environment) -> None:
        """Remove the scenario of an environment from the atlas."""
        if environment.seat is not None and self._atlas is not None:
            self._atlas.leave(environment.seat)
        environment.seat = environment.pending_request = None
        environment.asks_next = False

    def _end(self, environment: _Environment) -> None:
        """End the policy's episode of an environment."""
        if environment.episode_reset is not None and self._desk is not None:
            self._desk.replies([EndRequest(*environment.episode_reset.signature)])
        environment.episode_reset = None

    def _answer(self) -> None:
        """Answer pending pictures and resets; if there are none, the policy's observations."""
        waiting = sorted(
            (
                environment
                for environment in self._environments
                if environment.pending_request is not None
            ),
            key=lambda environment: environment.order,
        )
        acts = [
            environment
            for environment in waiting
            if isinstance(environment.pending_request, ActRequest)
        ]
        if len(acts) == len(waiting):
            self._ask(acts)
        self._draw(
            [
                environment
                for environment in waiting
                if isinstance(environment.pending_request, Draw)
            ]
        )
        for environment in waiting:
            if isinstance(environment.pending_request, ResetRequest):
                self._end(environment)
                environment.episode_reset = environment.pending_request
                self._ask([environment])

    def _draw(self, environments: list[_Environment]) -> None:
        """Draw for environments together. After an error draw for each half, to isolate the
        environment that causes it."""
        if not environments or self._atlas is None:
            return
        wanted = [(environment.seat, environment.pending_request) for environment in environments]
        looks = [
            (seat, look.robot, look.street)
            for seat, look in wanted
            if isinstance(look, Draw) and seat is not None
        ]
        try:
            frames = self._atlas.render(looks)
        except Exception as error:  # noqa: BLE001  sent to the environment that causes it
            if len(environments) == 1:
                environments[0].reply(_refused(error))
                return
            self._draw(environments[: len(environments) // 2])
            self._draw(environments[len(environments) // 2 :])
            return
        for environment, frame in zip(environments, frames, strict=True):
            assert frame.labels is not None
            locations = environment.memory.write_arrays({"rgb": frame.rgb, "labels": frame.labels})
            environment.asks_next = self._desk is not None
            environment.reply(msgspec.structs.replace(self._rendered, arrays=locations))

    def _ask(self, environments: list[_Environment]) -> None:
        """Query the policy for environments together."""
        if not environments or self._desk is None:
            return
        for environment in environments:
            environment.memory.busy = True
        requests = [
            environment.pending_request
            for environment in environments
            if isinstance(environment.pending_request, ResetRequest | ActRequest)
        ]
        replies = self._desk.replies(
            requests, [environment.memory.map for environment in environments]
        )
        for environment, reply in zip(environments, replies, strict=True):
            environment.reply(reply)


def _refused(error: Exception) -> Refusal:
    """Print an error of the renderer itself for one environment, and return it as a message."""
    traceback.print_exception(error)
    return Refusal("renderer", f"the shared renderer: {type(error).__name__}: {error_text(error)}")


@lru_cache(maxsize=_PLACES_KEPT)
def _surface(where: Place) -> PlaceSurface:
    """Return the surface of a place, shared by all environments in it."""
    return make_surface(where, place(where)[1])
