"""Messages between a run and its workers, as MessagePack."""

from __future__ import annotations

from collections.abc import Callable

import msgspec

from cosim.results.record import Status
from cosim.results.run_setup import RunSetup
from cosim.spec.manifest import Manifest
from cosim.spec.options import EpisodeOptions, PolicyHost, RendererAddress
from cosim.spec.scenario import Scenario
from scenarios.ipc.deadlines import Patience


class Hello(msgspec.Struct, frozen=True, tag=True):
    """Introduces the policy of a run to a worker, with the manifest and source hash that it must
    have there.

    renderer: address of the run's shared renderer, if it has one.
    host: where the policy runs.
    learner: a second policy, which drives at times while demonstrations are collected.
    patience: timeouts of the policy.
    repeat: failed episode that the process simulates again before it loads the policy.
    """

    policy: str
    manifest: Manifest
    source_hash: str
    renderer: RendererAddress | None = None
    host: PolicyHost = PolicyHost()
    learner: Hello | None = None
    patience: Patience = Patience()
    repeat: Repeat | None = None


class Job(msgspec.Struct, frozen=True, tag=True):
    """Requests an episode.

    setup: of the run; without one it follows from options and policy.
    net_hash: hash of its street net, if the worker is on another machine; else "".
    last_attempt: whether a failure of this attempt is recorded, so that its cause must be found.
    second: half of a run with decoys. No process of a policy runs episodes of both halves.
    """

    scenario: Scenario
    options: EpisodeOptions = EpisodeOptions()
    setup: RunSetup | None = None
    net_hash: str = ""
    last_attempt: bool = False
    second: bool = False


class Repeat(msgspec.Struct, frozen=True, tag=True):
    """Requests a replay of a failed episode without its policy.

    commands: bytes of the command log (`scenarios.ipc.command_log`).
    """

    job: Job
    commands: bytes


class Repeated(msgspec.Struct, frozen=True, tag=True):
    """Reports a replay.

    record: bytes of the record of what was driven.
    error: message of the engine error that ended the replay, "" if the simulator survived.
    """

    scenario: str
    record: bytes
    error: str = ""


class Ready(msgspec.Struct, frozen=True, tag=True):
    """Reports that the engines are imported and the policy is loaded."""


class Unable(msgspec.Struct, frozen=True, tag=True):
    """Reports that the policy cannot be loaded (`blames_policy`), or that the machine lacks
    something."""

    reason: str
    blames_policy: bool


class EpisodeProgress(msgspec.Struct, frozen=True, tag="Progress"):
    """Reports the progress of an episode.

    compared: share of the street that is simulated without the robot, 0 to 1; None before the
    episode is over.
    """

    scenario: str
    time_s: float
    route_s_m: float
    failures: int
    compared: float | None = None


class Waits(msgspec.Struct, frozen=True, tag=True):
    """Reports the reason for which an episode waits."""

    scenario: str
    reason: str


class FrameDrawn(msgspec.Struct, frozen=True, tag=True):
    """Carries a camera frame for the run folder, as PNG."""

    scenario: str
    tick: int
    png: bytes


class LostRenderer(msgspec.Struct, frozen=True, tag=True):
    """Reports that the shared renderer has ended in the middle of an episode; fields as in
    `RendererLost`."""

    scenario: str
    number: int
    asked: str


class Done(msgspec.Struct, frozen=True, tag=True):
    """Carries the result of an episode.

    record, log: the bytes of its files, as `encoded` by Record and Log; a crash has no log.
    again: whether an engine failed, which may not happen another time.
    demonstration: the bytes of its demonstration, while these are collected.
    """

    scenario: str
    status: Status
    record: bytes = b""
    log: bytes = b""
    again: bool = False
    demonstration: bytes = b""


Message = Ready | Unable | EpisodeProgress | Waits | FrameDrawn | LostRenderer | Done | Repeated
MessageHandler = Callable[[Message], None]

encode_message = msgspec.msgpack.Encoder().encode
decode_hello = msgspec.msgpack.Decoder(Hello).decode
decode_job = msgspec.msgpack.Decoder(Job).decode
decode_message = msgspec.msgpack.Decoder(Message).decode
