"""What workers on other machines and a run's coordinator say to each other: MessagePack, typed,
bounded.

A worker asks, the coordinator answers. Whatever is asked may be asked again: the answer is the
same.
"""

from __future__ import annotations

import hashlib
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Final, Literal

import msgspec
from msgspec import Meta

from cosim.core.cache import sources_hash
from cosim.core.errors import EngineError
from cosim.core.versions import versions
from cosim.episode.policy_caller import PolicyCall
from cosim.results.record import METRIC_SCHEMA, Status
from cosim.results.run_spec import RunSpec
from scenarios.ipc.deadlines import Patience, Question
from scenarios.ipc.messages import Compares, FrameDrawn, Hello, Job, Progress, Waits

PROTOCOL: Final = 1
"""Another one for every change of what is said here."""
MOST_SENT_BYTES: Final = 15 << 20
"""Of a message: Zenoh drops what is longer than 16 MiB."""

How = Literal["ended", "released", "unable"]
_Name = Annotated[str, Meta(pattern="^[A-Za-z0-9_-]{1,64}$")]
_Words = Annotated[str, Meta(max_length=2000)]
_Count = Annotated[int, Meta(ge=0, lt=1 << 62)]
_Seconds = Annotated[float, Meta(ge=0.0, le=1e9)]
_Printed = Annotated[bytes, Meta(max_length=1 << 16)]


class Installed(msgspec.Struct, frozen=True, kw_only=True):
    """What makes results: where all of it is the same they are the same to the bit. source: hash of
    this project's."""

    versions: dict[str, str]
    metric_schema: int
    source: str
    protocol: int = PROTOCOL

    def differs_from(self, run: Installed) -> str:
        """In words, where this is another one than the run's; "" where it is not."""
        here, there = (
            {
                **one.versions,
                "metric schema": str(one.metric_schema),
                "source": one.source,
                "protocol": str(one.protocol),
            }
            for one in (self, run)
        )
        names = sorted(
            name for name in here.keys() | there.keys() if here.get(name) != there.get(name)
        )
        return ", ".join(
            f"{n} {here.get(n, 'missing')} in place of {there.get(n, 'none')}" for n in names
        )


@lru_cache(maxsize=1)
def installed_here() -> Installed:
    """What is installed here."""
    rooms = Path(__file__).parents[2]
    source = sources_hash(
        *(rooms / name for name in ("cosim", "sumo_nets", "physics", "bridge", "scenarios"))
    )
    return Installed(versions=versions(), metric_schema=METRIC_SCHEMA, source=source)


class Asks(msgspec.Struct, frozen=True):
    """What a policy is asked (`Question`), and for how long by now."""

    doing: PolicyCall
    tick: int
    for_s: _Seconds

    def question(self, now_s: float) -> Question:
        """As of now, by the clock of whoever hears it."""
        return Question(now_s - self.for_s, self.doing, self.tick)


class Asking(msgspec.Struct, frozen=True, kw_only=True):
    """Who asks: the worker, by a name that no other has, and which of its environment processes."""

    worker: _Name
    slot: Annotated[int, Meta(ge=0, lt=4096)]


class Claim(Asking, frozen=True, kw_only=True):
    """It has nothing to do. ready: engines and policy are loaded; else it is to be told what is
    needed for that."""

    host: Annotated[str, Meta(max_length=255)]
    installed: Installed
    ready: bool


class Renewal(Asking, frozen=True, kw_only=True):
    """It goes on with the job of a lease. said: by its process since the last renewal."""

    lease: _Count
    scenario: _Words
    asks: Asks | None = None
    said: tuple[Progress | Waits | Compares | FrameDrawn, ...] = ()


class Result(Asking, frozen=True, kw_only=True):
    """Its episode is over: as `Done`. digest: of record and log; printed: by the process, its
    end."""

    lease: _Count
    scenario: _Words
    status: Status
    record: bytes
    log: bytes
    again: bool
    digest: str
    printed: _Printed = b""


class NoResult(Asking, frozen=True, kw_only=True):
    """It has no result. how: its process ended; it leaves and hands the job back; or it can run
    nothing at all. why: in words, "" for a process that ended before the episode began."""

    lease: _Count
    scenario: _Words
    how: How
    why: _Words
    in_engine: bool = False
    asks: Asks | None = None
    printed: _Printed = b""


class Briefing(msgspec.Struct, frozen=True, tag=True):
    """What a worker needs before it can be given jobs."""

    hello: Hello
    installed: Installed
    patience: Patience


class Lease(msgspec.Struct, frozen=True, tag=True):
    """A job, its worker's as long as it renews the lease."""

    number: int
    job: Job


class NothingNow(msgspec.Struct, frozen=True, tag=True):
    """Nothing to do now: ask again."""


class GoOn(msgspec.Struct, frozen=True, tag=True):
    """The lease is renewed."""


class LetGo(msgspec.Struct, frozen=True, tag=True):
    """The job is another's by now, or done: end it, and claim."""


class Over(msgspec.Struct, frozen=True, tag=True):
    """The run is over."""


class Received(msgspec.Struct, frozen=True, tag=True):
    """A result or a failure has been taken in. how: what became of a result."""

    how: Literal["kept", "duplicate", "conflict", "refused"] = "kept"


class TurnedAway(msgspec.Struct, frozen=True, tag=True):
    """This worker can do nothing for this run."""

    why: str


class NetPart(msgspec.Struct, frozen=True):
    """A part of what is handed out by its hash: from which byte, of how many."""

    begin: _Count
    whole: _Count
    data: bytes


class NetAsked(msgspec.Struct, frozen=True):
    """Give me this from that byte on."""

    begin: _Count = 0


CoordinatorSays = Briefing | Lease | NothingNow | GoOn | LetGo | Over | Received | TurnedAway


def digest_of(record: bytes, log: bytes) -> str:
    """By which a damaged result is told from a sound one."""
    return hashlib.blake2b(
        len(record).to_bytes(8, "big") + record + log, digest_size=16
    ).hexdigest()


def run_hash(spec: RunSpec) -> str:
    """The name of a run in keys: that of the same run begun anew, too."""
    return hashlib.blake2b(msgspec.json.encode(spec, order="sorted"), digest_size=8).hexdigest()


_encode_reply = msgspec.msgpack.Encoder().encode
_replies: msgspec.msgpack.Decoder[CoordinatorSays] = msgspec.msgpack.Decoder(CoordinatorSays)


def reply_in_bytes(reply: CoordinatorSays) -> bytes:
    return _encode_reply(reply)


def reply_in(payload: bytes) -> CoordinatorSays:
    """Raises EngineError for what is no reply."""
    try:
        return _replies.decode(payload)
    except (msgspec.DecodeError, RecursionError, ValueError) as error:
        raise EngineError(f"the coordinator's reply cannot be read: {error}") from error
