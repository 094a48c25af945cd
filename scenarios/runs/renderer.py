"""The shared renderer: one process that draws for all environments of a run.

Where the policy has `act_batch`, this process queries it for all episodes together. Environments
connect, and send one request at a time (`scenarios.ipc.render_protocol`). All requested pictures
are drawn together, at once. An environment that has just got one queries the policy next: a batch
waits for those a moment. A picture is a function of robot and street alone, and each environment
continues with its own reply: it makes no difference which of them are served together.
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

from bridge.policy_server import AskAct, AskEnded, AskReset, PolicyDesk, Refusal, said_by
from cosim.core.framing import Wire
from cosim.results.run_setup import NO_RENDERER
from cosim.spec.robot import robot_called
from cosim.spec.scenario import Place, Scenario
from physics.street.street_surface import StreetSurface
from scenarios.episodes.wiring import world_of
from scenarios.ipc.deadlines import Asked
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
from scenarios.ipc.shared_memory import SharedMemory, room_for
from scenarios.places.nets import place
from scenarios.runs.worker import policy_here, said_to_run

if TYPE_CHECKING:
    from physics.cameras.gl.atlas import Atlas, SeatKey

_BEAT_S: Final = 1.0
"""Seconds between two heartbeats to the run."""
_PLACES_KEPT: Final = 8
"""Surfaces of places that are cached."""
_PEER: Final = struct.Struct("3i")
"""Process, user and group of who has connected (SO_PEERCRED)."""


def serve_pictures(pipe: int, asked: int, listening: int) -> None:
    """Draw and query until the run has gone. pipe, asked: as of a worker; listening: the descriptor
    of the socket that environments connect to."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    wire = Wire(socket.socket(fileno=pipe))
    say = partial(said_to_run, wire, os.getpid())
    hello = decode_hello(wire.receive())
    assert hello.renderer is not None
    desk = None
    if hello.renderer.asks:
        timer = Asked(asked)
        policy = policy_here(hello, timer, say).policy
        desk = PolicyDesk(policy, decoder=ObservationDecoder, timer=timer, forget_after_s=inf)
    with ExitStack() as stack:
        atlas = None
        drawn_by = NO_RENDERER
        if (spec := hello.manifest.camera) is not None:
            from physics.cameras.choice import renderer_of
            from physics.cameras.gl.atlas import Atlas

            atlas = stack.enter_context(Atlas(spec))
            drawn_by = renderer_of("gl")
        rendered = Rendered(hello.renderer.number, drawn_by)
        renderer = _Renderer(rendered, room_for(hello.manifest), atlas, desk, partial(say, Ready()))
        renderer.serve(socket.socket(fileno=listening), pipe)


class _Environment:
    """An environment process that has connected.

    began: the last request that began an episode of the policy, until it ends. seat: its place in
    the atlas. wants: the request that waits for a reply. asks_next: it has a picture that the
    policy has not got yet.
    """

    def __init__(self, end: socket.socket, room: int) -> None:
        self.wire = Wire(end)
        self.memory = SharedMemory.new(room)
        self.began: AskReset | None = None
        self.seat: SeatKey | None = None
        self.wants: Draw | AskReset | AskAct | None = None
        self.asks_next = False
        socket.send_fds(end, [b"\0"], [self.memory.descriptor])

    @property
    def order(self) -> str:
        """By which environments are served: what their episodes are called."""
        return "" if self.began is None else self.began.episode

    def reply(self, reply: Reply) -> None:
        """Send a reply. One that has ended does not get it: reading from it shows its end.

        One that cannot be reached, because the policy has closed its socket, stays one for which
        the policy is queried.
        """
        self.wants = None
        with suppress(OSError):
            self.wire.post(encode_exchange(reply))
            self.memory.busy = False

    def close(self) -> None:
        self.wire.close()
        self.memory.close()


class _Renderer:
    """Answers environments until the run has gone.

    rendered: the reply to Enter. room: bytes of a picture. beat: the heartbeat to the run.
    """

    def __init__(
        self,
        rendered: Rendered,
        room: int,
        atlas: Atlas | None,
        desk: PolicyDesk | None,
        beat: Callable[[], None],
    ) -> None:
        self._rendered = rendered
        self._room = room
        self._atlas = atlas
        self._desk = desk
        self._beat = beat
        self._environments: list[_Environment] = []
        self._selector = selectors.DefaultSelector()
        self._since_s = 0.0
        self._open = True

    def serve(self, listening: socket.socket, pipe: int) -> None:
        self._selector.register(listening, selectors.EVENT_READ, partial(self._welcomed, listening))
        self._selector.register(pipe, selectors.EVENT_READ, self._ended)
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
        """Return how long to wait for further requests."""
        wanted = [one.wants for one in self._environments if one.wants is not None]
        if not wanted:
            return _BEAT_S
        if self._desk is None or not all(isinstance(wants, AskAct) for wants in wanted):
            return 0.0
        expected = len(wanted) + sum(one.asks_next for one in self._environments)
        return self._desk.wait_s(len(wanted), expected, self._since_s)

    def _ended(self) -> None:
        """The run has gone: it says nothing after its first message."""
        self._open = False

    def _welcomed(self, listening: socket.socket) -> None:
        end, _ = listening.accept()
        if (
            _PEER.unpack(end.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _PEER.size))[1]
            != os.getuid()
        ):
            end.close()
            return
        one = _Environment(end, self._room)
        self._environments.append(one)
        self._selector.register(end, selectors.EVENT_READ, partial(self._hear, one))

    def _hear(self, one: _Environment) -> None:
        """Something that an environment asks, or its end. One that does not speak as it should is
        left."""
        try:
            for message in one.wire.received():
                if not self._take(one, decode_request(message)):
                    self._part(one)
                    return
        except (EOFError, OSError, msgspec.DecodeError, ValueError, TypeError):
            self._part(one)

    def _part(self, one: _Environment) -> None:
        self._leave(one)
        self._end(one)
        self._selector.unregister(one.wire)
        self._environments.remove(one)
        one.close()

    def _take(self, one: _Environment, request: Request) -> bool:
        """Note a request. False when it is out of turn."""
        if one.wants is not None:
            return False
        if isinstance(request, Enter):
            self._leave(one)
            if request.scenario is not None:
                one.reply(self._entered(one, request.scenario))
        elif isinstance(request, AskEnded):
            self._end(one)
        elif isinstance(request, Draw):
            if one.seat is None:
                return False
            one.wants = request
        elif self._desk is None:
            return False
        else:
            if not any(isinstance(other.wants, AskAct) for other in self._environments):
                self._since_s = time.monotonic()
            one.wants = request
            one.asks_next = False
        return True

    def _entered(self, one: _Environment, scenario: Scenario) -> Reply:
        try:
            if self._atlas is not None:
                robot = robot_called(scenario.robot)
                world = world_of(
                    _surface(scenario.place), scenario.barriers, robot, scenario.obstacles
                )
                one.seat = self._atlas.join(world, scenario.light)
        except Exception as error:  # noqa: BLE001  of one scenario: the others continue
            return _refused(error)
        return self._rendered

    def _leave(self, one: _Environment) -> None:
        if one.seat is not None and self._atlas is not None:
            self._atlas.leave(one.seat)
        one.seat = one.wants = None
        one.asks_next = False

    def _end(self, one: _Environment) -> None:
        """End the policy's episode of an environment."""
        if one.began is not None and self._desk is not None:
            self._desk.replies([AskEnded(*one.began.signature)])
        one.began = None

    def _answer(self) -> None:
        """Answer what waits: pictures and resets, and if none of these does, queries of the
        policy."""
        waiting = sorted(
            (one for one in self._environments if one.wants is not None), key=lambda one: one.order
        )
        acts = [one for one in waiting if isinstance(one.wants, AskAct)]
        if len(acts) == len(waiting):
            self._ask(acts)
        self._draw([one for one in waiting if isinstance(one.wants, Draw)])
        for one in waiting:
            if isinstance(one.wants, AskReset):
                self._end(one)
                one.began = one.wants
                self._ask([one])

    def _draw(self, which: list[_Environment]) -> None:
        """Draw for these, together. Where that cannot be, by halves: it may be the fault of one of
        them."""
        if not which or self._atlas is None:
            return
        wanted = [(one.seat, one.wants) for one in which]
        looks = [
            (seat, look.robot, look.street)
            for seat, look in wanted
            if isinstance(look, Draw) and seat is not None
        ]
        try:
            frames = self._atlas.render(looks)
        except Exception as error:  # noqa: BLE001  told to whom it concerns
            if len(which) == 1:
                which[0].reply(_refused(error))
                return
            self._draw(which[: len(which) // 2])
            self._draw(which[len(which) // 2 :])
            return
        for one, frame in zip(which, frames, strict=True):
            assert frame.labels is not None
            laid = one.memory.lay({"rgb": frame.rgb, "labels": frame.labels})
            one.asks_next = self._desk is not None
            one.reply(msgspec.structs.replace(self._rendered, arrays=laid))

    def _ask(self, which: list[_Environment]) -> None:
        """Query the policy for these, together."""
        if not which or self._desk is None:
            return
        for one in which:
            one.memory.busy = True
        requests = [one.wants for one in which if isinstance(one.wants, AskReset | AskAct)]
        replies = self._desk.replies(requests, [one.memory.map for one in which])
        for one, reply in zip(which, replies, strict=True):
            one.reply(reply)


def _refused(error: Exception) -> Refusal:
    """Print an error of the renderer itself for one environment, and return it as a message."""
    traceback.print_exception(error)
    return Refusal("renderer", f"the shared renderer: {type(error).__name__}: {said_by(error)}")


@lru_cache(maxsize=_PLACES_KEPT)
def _surface(where: Place) -> StreetSurface:
    """The surface of a place, one for all environments in it."""
    _, street_map = place(where)
    return StreetSurface(street_map, where.seed, where.roughness)
