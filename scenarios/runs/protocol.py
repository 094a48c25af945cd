"""Messages between a run's coordinator and its workers on other machines, as bounded MessagePack.

A worker sends a request, the coordinator replies. Every request may be repeated, and gets the same
reply.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Final, Literal

import msgspec
from msgspec import Meta

from cosim.core.cache import sources_hash
from cosim.core.errors import EngineError
from cosim.core.versions import versions
from cosim.results.run_setup import METRIC_SCHEMA
from cosim.results.run_spec import RUN_FILE, RunSpec
from scenarios.ipc.faults import Fault
from scenarios.ipc.messages import Done, EpisodeProgress, FrameDrawn, Hello, Job, Waits

PROTOCOL: Final = 3
"""Version of these messages, raised with every change."""
MAX_SENT_BYTES: Final = 15 << 20
"""Size limit of a message in bytes: Zenoh drops messages of more than 16 MiB."""
MAX_WORDS: Final = 2000
"""Length limit of a reason in characters."""
MAX_DRIVEN_BYTES: Final = 1 << 20
"""Size limit in bytes of the record of a failed episode."""
_Name = Annotated[str, Meta(pattern="^[A-Za-z0-9_-]{1,64}$")]
_Words = Annotated[str, Meta(max_length=MAX_WORDS)]
_Count = Annotated[int, Meta(ge=0, lt=1 << 62)]
_Slot = Annotated[int, Meta(ge=0, lt=4096)]
_Driven = Annotated[bytes, Meta(max_length=MAX_DRIVEN_BYTES)]
_Printed = Annotated[bytes, Meta(max_length=1 << 16)]

Installed = Mapping[str, str]
"""Versions by name. Equal installations give results that are equal to the bit."""


@lru_cache(maxsize=1)
def installed_here() -> Installed:
    """Return the versions and the hash of the source that are installed here."""
    checkout = Path(__file__).parents[2]
    source = sources_hash(
        *(checkout / name for name in ("cosim", "sumo_nets", "physics", "bridge", "scenarios"))
    )
    return {
        **versions(),
        "metric schema": str(METRIC_SCHEMA),
        "source": source,
        "protocol": str(PROTOCOL),
    }


def difference(here: Installed, run: Installed) -> str:
    """Return how an installation differs from that of the run, in words; "" if it does not."""
    names = sorted(name for name in here.keys() | run.keys() if here.get(name) != run.get(name))
    return ", ".join(
        f"{n} {here.get(n, 'missing')} in place of {run.get(n, 'none')}" for n in names
    )


def installed_for(spec: RunSpec) -> Installed:
    """Return the installation that the workers of a run need."""
    own = {name: version for name, version in installed_here().items() if name not in versions()}
    return {**spec.setup.versions, **own}


class Claim(msgspec.Struct, frozen=True, kw_only=True):
    """Requests a job for a slot; one that is not `ready` requests the introduction of the policy
    first."""

    worker: _Name
    slot: _Slot
    host: Annotated[str, Meta(max_length=255)]
    installed: dict[str, str]
    ready: bool


class Report(msgspec.Struct, frozen=True, kw_only=True):
    """Renews the lease of a job, and ends it if there is a result or a fault.

    worker, slot: the sender; the name of a worker is unique.
    said: messages of the environment process since the last report.
    done: the result, with the `digest` of its record and log.
    fault: the kind of failure, with its reason `why`.
    found, driven: the result of its replay, as in `AttemptFailure`.
    printed: the end of the output of the environment process.
    """

    worker: _Name
    slot: _Slot
    lease: _Count
    scenario: _Words
    said: tuple[EpisodeProgress | Waits | FrameDrawn, ...] = ()
    done: Done | None = None
    digest: str = ""
    fault: Fault | None = None
    why: _Words = ""
    found: _Words = ""
    driven: _Driven = b""
    printed: _Printed = b""


class Assignment(msgspec.Struct, frozen=True, tag=True):
    """Grants the lease of a job."""

    lease: int
    job: Job


class Reply(msgspec.Struct, frozen=True, tag=True):
    """Replies to a claim or a report.

    idle: there is no job now.
    over: the run is over.
    renewed: the lease is renewed.
    revoked: the job is done, or another worker's.
    kept, duplicate, conflict, refused: the outcome of a result; a failure is "kept".
    turned_away: this worker cannot work for this run, for the reason `why`.
    """

    kind: Literal[
        "idle",
        "over",
        "renewed",
        "revoked",
        "kept",
        "duplicate",
        "conflict",
        "refused",
        "turned_away",
    ]
    why: str = ""


class NetPart(msgspec.Struct, frozen=True):
    """Carries a part of a map of `whole` bytes, from byte `begin` on; without data, requests it."""

    begin: _Count
    whole: _Count = 0
    data: bytes = b""


CoordinatorReply = Hello | Assignment | Reply


def digest_of(done: Done) -> str:
    """Return a hash of the record and the log of a result, which detects damage."""
    return hashlib.blake2b(
        len(done.record).to_bytes(8, "big") + done.record + done.log, digest_size=16
    ).hexdigest()


class Origin(msgspec.Struct):
    """The fields of a record that identify its run and machine."""

    suite_hash: str
    run_seed: int
    policy_source: str
    versions: dict[str, str]
    renderer: str
    ended: str | None = None


def origin_of(done: Done) -> Origin | None:
    """Decode the origin of a result; None if it is damaged."""
    try:
        return msgspec.json.decode(done.record, type=Origin)
    except msgspec.DecodeError:
        return None


def other_renderer(done: Done, renderer: str) -> str:
    """Return how the renderer of a result differs from that of the run, in words; "" if it does
    not."""
    origin = origin_of(done)
    if origin is None or origin.ended is None or origin.renderer == renderer:
        return ""
    return f"its pictures are drawn by {origin.renderer}, those of the run by {renderer}"


def run_hash(spec: RunSpec) -> str:
    """Return the name of a run in keys, which does not change when it is resumed."""
    return hashlib.blake2b(RUN_FILE.encode(spec), digest_size=8).hexdigest()


encode_reply: Final = msgspec.msgpack.Encoder().encode
_replies: msgspec.msgpack.Decoder[CoordinatorReply] = msgspec.msgpack.Decoder(CoordinatorReply)


def decode_reply(payload: bytes) -> CoordinatorReply:
    """Decode a reply of the coordinator. Raises EngineError."""
    try:
        return _replies.decode(payload)
    except (msgspec.DecodeError, RecursionError, ValueError) as error:
        raise EngineError(f"the coordinator's reply cannot be read: {error}") from error
