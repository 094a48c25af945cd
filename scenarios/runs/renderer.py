"""The shared renderer: one process that draws for all environments of a run and, where the policy
answers for many episodes at once, asks it.

Environments connect, and ask for one thing at a time (`scenarios.ipc.render_protocol`). All
pictures that are waited for are drawn together, at once: the busier the renderer, the more they
are. Who has just got one asks the policy next; for those a moment is waited, so that it is asked
for all of them. A picture is a function of robot and street alone, and each environment goes on
when it has its own reply: who was drawn or asked together changes nothing.
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
from typing import TYPE_CHECKING, Final

import msgspec
import shapely
from shapely.geometry import MultiPolygon, Polygon

from cosim.core.clock import Clock
from cosim.core.errors import PolicyError
from cosim.core.framing import Wire
from cosim.core.state import Planned
from cosim.episode.interfaces import Observation, Privileged
from cosim.episode.manifest_checks import calibration_of
from cosim.episode.policy_caller import BatchDriver, said_by
from cosim.results.record import NO_RENDERER
from cosim.spec.robot import robot_called
from cosim.spec.scenario import Place, Scenario
from physics.street.street_surface import StreetSurface
from scenarios.episodes.wiring import world_of
from scenarios.ipc.deadlines import Asked
from scenarios.ipc.messages import Ready
from scenarios.ipc.picture_memory import PictureMemory
from scenarios.ipc.render_protocol import (
    Ask,
    Begin,
    Draw,
    Enter,
    Fine,
    Knowledge,
    Leave,
    Refused,
    Reply,
    Request,
    Told,
    Welcome,
    decode_renderer_hello,
    decode_request,
    encode_exchange,
)
from scenarios.places.nets import place
from scenarios.runs.worker import policy_here, said_to_run

if TYPE_CHECKING:
    from physics.cameras.gl.atlas import Atlas, SeatKey

_WINDOW_S: Final = 0.002
"""So long the policy is not asked for those who wait for it, while others are about to."""
_BEAT_S: Final = 1.0
_PLACES_KEPT: Final = 8
_PEER: Final = struct.Struct("3i")
"""Process, user and group of who has connected (SO_PEERCRED)."""


def serve_pictures(pipe: int, asked: int, listening: int) -> None:
    """Draw and ask until the run has gone. pipe, asked: as of a worker; listening: the descriptor
    of the socket that environments connect to."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    wire = Wire(socket.socket(fileno=pipe))
    say = partial(said_to_run, wire, os.getpid())
    asked_for = decode_renderer_hello(wire.receive())
    hello = asked_for.hello
    driver = None
    if hello.renderer is not None and hello.renderer.asks:
        driver = BatchDriver(policy_here(hello, Asked(asked), say))
    with ExitStack() as stack:
        atlas = None
        drawn_by = NO_RENDERER
        size = (0, 0)
        if (spec := hello.manifest.camera) is not None:
            from physics.cameras.choice import renderer_of
            from physics.cameras.gl.atlas import Atlas

            atlas = stack.enter_context(Atlas(spec))
            drawn_by = renderer_of("gl")
            size = spec.size
        welcome = Welcome(asked_for.number, drawn_by, size)
        _Renderer(welcome, atlas, driver, partial(say, Ready())).serve(
            socket.socket(fileno=listening), pipe
        )


class _Environment:
    """An environment process that has connected. scenario: which it runs, None for none; episode:
    what that is called before the policy, "" until it begins; seat: its place in the atlas; wants:
    what it waits for; asks_next: it has a picture that the policy was not asked about; free: where
    its robot may be."""

    def __init__(self, end: socket.socket, size: tuple[int, int]) -> None:
        self.wire = Wire(end)
        self.memory = PictureMemory.new(size)
        self.scenario: Scenario | None = None
        self.episode = ""
        self.seat: SeatKey | None = None
        self.wants: Draw | Begin | Ask | None = None
        self.asks_next = False
        self.free: Polygon | MultiPolygon = MultiPolygon()
        socket.send_fds(end, [b"\0"], [self.memory.descriptor])

    def reply(self, reply: Reply) -> None:
        """Let it go on. One that has ended does not hear it: reading from it tells. One that cannot
        be told any more, because the policy has closed what is not its own, is left as one that the
        policy is asked for."""
        self.wants = None
        with suppress(OSError):
            self.wire.post(encode_exchange(reply))
            self.memory.asked = False

    def close(self) -> None:
        self.wire.close()
        self.memory.close()


class _Renderer:
    """Answers environments until the run has gone. beat: tells the run that this is alive."""

    def __init__(
        self,
        welcome: Welcome,
        atlas: Atlas | None,
        driver: BatchDriver | None,
        beat: Callable[[], None],
    ) -> None:
        self._welcome = welcome
        self._atlas = atlas
        self._driver = driver
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
        """How long may be waited for what else is asked."""
        wanted = [one.wants for one in self._environments if one.wants is not None]
        if not wanted:
            return _BEAT_S
        if all(isinstance(wants, Ask) for wants in wanted) and any(
            one.asks_next for one in self._environments
        ):
            return self._since_s + _WINDOW_S - time.monotonic()
        return 0.0

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
        one = _Environment(end, self._welcome.size)
        one.reply(self._welcome)
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
        except (
            EOFError,
            OSError,
            msgspec.DecodeError,
            ValueError,
            TypeError,
            shapely.errors.ShapelyError,
        ):
            self._part(one)

    def _part(self, one: _Environment) -> None:
        self._leave(one)
        self._selector.unregister(one.wire)
        self._environments.remove(one)
        one.close()

    def _take(self, one: _Environment, request: Request) -> bool:
        """Note what is asked. False when it is out of turn."""
        if one.wants is not None:
            return False
        if isinstance(request, Enter):
            self._leave(one)
            one.reply(self._entered(one, request.scenario))
        elif isinstance(request, Leave):
            self._leave(one)
        elif (
            one.scenario is None
            or (self._atlas if isinstance(request, Draw) else self._driver) is None
        ):
            return False
        else:
            if isinstance(request, Ask) and request.known is not None and request.known.free:
                one.free = _ground(request.known.free)
            if not any(isinstance(other.wants, Ask) for other in self._environments):
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
        except Exception as error:  # noqa: BLE001  of one scenario: the others go on
            return _refused(error)
        one.scenario = scenario
        one.free = MultiPolygon()
        return Fine()

    def _leave(self, one: _Environment) -> None:
        if one.seat is not None and self._atlas is not None:
            self._atlas.leave(one.seat)
        if one.episode and self._driver is not None:
            self._driver.ended(one.episode)
        one.scenario = one.seat = one.wants = None
        one.episode = ""
        one.asks_next = False

    def _answer(self) -> None:
        """Answer what waits: pictures and resets, and if none of these does, questions to the
        policy."""
        waiting = sorted(
            (one for one in self._environments if one.wants is not None),
            key=lambda one: one.episode,
        )
        asks = [one for one in waiting if isinstance(one.wants, Ask)]
        if len(asks) == len(waiting):
            self._act(asks)
        self._draw([one for one in waiting if isinstance(one.wants, Draw)])
        for one in waiting:
            if isinstance(one.wants, Begin):
                self._begin(one)

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
            one.memory.put(frame)
            one.asks_next = self._driver is not None
            one.reply(Fine())

    def _begin(self, one: _Environment) -> None:
        assert self._driver is not None and isinstance(one.wants, Begin)
        one.episode = one.wants.episode
        one.memory.asked = True
        try:
            self._driver.reset(one.episode, one.wants.seed)
            one.reply(Fine())
        except PolicyError as error:
            one.reply(Refused(str(error), by_policy=True))

    def _act(self, which: list[_Environment]) -> None:
        """Ask the policy for these, together."""
        if not which or self._driver is None:
            return
        seen = [self._observed(one) for one in which]
        for one in which:
            one.memory.asked = True
        for one, answer in zip(which, self._driver.act_batch(seen), strict=True):
            if isinstance(answer, PolicyError):
                one.reply(Refused(str(answer), by_policy=True))
            else:
                plan = (answer.waypoints, answer.index) if isinstance(answer, Planned) else ()
                one.reply(Told(answer.v_mps, answer.w_radps, *plan))

    def _observed(self, one: _Environment) -> Observation:
        """What the policy is given for an environment."""
        ask, scenario = one.wants, one.scenario
        assert isinstance(ask, Ask) and scenario is not None
        robot = robot_called(scenario.robot)
        spec = self._driver.manifest.camera if self._driver is not None else None
        frame = None if self._atlas is None else one.memory.take()
        return Observation(
            tick=ask.tick,
            time_s=Clock().time_s(ask.tick),
            rgb=None if frame is None else frame.rgb,
            v_mps=ask.v_mps,
            w_radps=ask.w_radps,
            robot=robot,
            privileged=None if ask.known is None else _known(ask.known, scenario, one.free),
            episode=one.episode,
            reset=ask.reset,
            goal=ask.goal,
            odometry=ask.odometry,
            camera=None if spec is None else calibration_of(spec, robot),
            labels=None if frame is None or spec is None or not spec.labels else frame.labels,
        )


def _known(told: Knowledge, scenario: Scenario, free: Polygon | MultiPolygon) -> Privileged:
    people, vehicles, route = told.people, told.vehicles, scenario.route_line
    return Privileged(
        told.robot, route, told.route_s_m, people, vehicles, told.signals, told.crossings, free
    )


def _ground(wkb: bytes) -> Polygon | MultiPolygon:
    """Where a robot may be. Raises ValueError when it is none."""
    free = shapely.from_wkb(wkb)
    if not isinstance(free, Polygon | MultiPolygon):
        raise ValueError(f"a {type(free).__name__} is no ground")
    shapely.prepare(free)
    return free


def _refused(error: Exception) -> Refused:
    """Something of the renderer's own has failed for one environment."""
    traceback.print_exception(error)
    return Refused(
        f"the shared renderer: {type(error).__name__}: {said_by(error)}", by_policy=False
    )


@lru_cache(maxsize=_PLACES_KEPT)
def _surface(where: Place) -> StreetSurface:
    """The surface of a place, one for all environments in it."""
    _, street_map = place(where)
    return StreetSurface(street_map, where.seed, where.roughness)
