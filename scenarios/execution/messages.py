"""What a run and its environment processes say to each other: MessagePack over a pipe."""

from __future__ import annotations

import msgspec

from cosim.episode.ports import Manifest
from cosim.records.record import Status
from cosim.spec.options import EpisodeOptions
from cosim.spec.scenario import Scenario


class Hello(msgspec.Struct, frozen=True, tag=True):
    """The first message to an environment process: which policy it drives with, and what that was for the run."""

    policy: str
    manifest: Manifest
    source_hash: str


class Job(msgspec.Struct, frozen=True, tag=True):
    """Run this. folder: where record.json and trajectory.npz go."""

    scenario: Scenario
    folder: str
    options: EpisodeOptions = EpisodeOptions()


class Ready(msgspec.Struct, frozen=True, tag=True):
    """The engines are imported and the policy is loaded."""


class Unable(msgspec.Struct, frozen=True, tag=True):
    """No episode can be run here: the policy cannot be loaded (`blames_policy`), or the machine lacks something."""

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


class Done(msgspec.Struct, frozen=True, tag=True):
    """The episode is over and its record is on disk."""

    scenario: str
    status: Status


class Unsaved(msgspec.Struct, frozen=True, tag=True):
    """The episode is over, but its record could not be written."""

    scenario: str
    reason: str


Message = Ready | Unable | Progress | Waits | Compares | Done | Unsaved

encode_message = msgspec.msgpack.Encoder().encode
decode_hello = msgspec.msgpack.Decoder(Hello).decode
decode_job = msgspec.msgpack.Decoder(Job).decode
decode_message = msgspec.msgpack.Decoder(Message).decode
