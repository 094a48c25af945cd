"""What a run and its workers say to each other; between processes and machines as MessagePack."""

from __future__ import annotations

from collections.abc import Callable

import msgspec

from cosim.results.record import Status
from cosim.spec.manifest import Manifest
from cosim.spec.options import EpisodeOptions, RendererAt
from cosim.spec.policy_host import PolicyHost
from cosim.spec.scenario import Scenario


class Learner(msgspec.Struct, frozen=True):
    """Who drives at times in place of an expert whose drives are collected, and what that was for
    the run."""

    policy: str
    manifest: Manifest
    source_hash: str


class Hello(msgspec.Struct, frozen=True, tag=True):
    """The first message to a worker: which policy it drives with, and what that was for the run.
    renderer: the run's shared one, where there is one. host: where the policy is."""

    policy: str
    manifest: Manifest
    source_hash: str
    renderer: RendererAt | None = None
    host: PolicyHost = PolicyHost()
    learner: Learner | None = None


class Job(msgspec.Struct, frozen=True, tag=True):
    """Run this. net_hash: that of its place for a run on another machine; "" where it need not be
    compared."""

    scenario: Scenario
    options: EpisodeOptions = EpisodeOptions()
    net_hash: str = ""


class Ready(msgspec.Struct, frozen=True, tag=True):
    """The engines are imported and the policy is loaded."""


class Unable(msgspec.Struct, frozen=True, tag=True):
    """No episode can be run here: the policy cannot be loaded (`blames_policy`), or the machine
    lacks something."""

    reason: str
    blames_policy: bool


class Progress(msgspec.Struct, frozen=True, tag=True):
    """A sign of life: how far the episode is."""

    scenario: str
    time_s: float
    route_s_m: float
    failures: int


class Waits(msgspec.Struct, frozen=True, tag=True):
    """The episode stands still: what it waits for."""

    scenario: str
    reason: str


class Compares(msgspec.Struct, frozen=True, tag=True):
    """The episode is over and its street is simulated without the robot: which share of it."""

    scenario: str
    share: float


class FrameDrawn(msgspec.Struct, frozen=True, tag=True):
    """A camera frame that is to be kept, as PNG."""

    scenario: str
    tick: int
    png: bytes


class LostRenderer(msgspec.Struct, frozen=True, tag=True):
    """The shared renderer has ended in the middle of the episode. number, asked: see
    `RendererLost`."""

    scenario: str
    number: int
    asked: str


class Done(msgspec.Struct, frozen=True, tag=True):
    """The episode is over. record, log: the bytes of its files, as `encoded` by Record and Log; a
    crash has no log. again: see `Outcome`. demonstration: what is kept of it where demonstrations
    are collected, if anything."""

    scenario: str
    status: Status
    record: bytes = b""
    log: bytes = b""
    again: bool = False
    demonstration: bytes = b""


Message = Ready | Unable | Progress | Waits | Compares | FrameDrawn | LostRenderer | Done
MessageHandler = Callable[[Message], None]

encode_message = msgspec.msgpack.Encoder().encode
decode_hello = msgspec.msgpack.Decoder(Hello).decode
decode_job = msgspec.msgpack.Decoder(Job).decode
decode_message = msgspec.msgpack.Decoder(Message).decode
