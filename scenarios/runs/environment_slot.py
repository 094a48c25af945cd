"""One of a worker's environment processes: what it is busy with, and what has to be said of it to
the coordinator.

It holds no session: it says what it wants asked, and is told the reply. What it wants is asked
again until there is one.
"""

from __future__ import annotations

import time
from logging import WARNING
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec

from bridge.codec import encode
from cosim.core.errors import MachineError, UsageError
from cosim.core.log_event import happened
from cosim.spec.connection import Connection
from cosim.spec.scenario import CityMap
from scenarios.ipc.child_process import WORKER, KeptProcess
from scenarios.ipc.deadlines import Question
from scenarios.ipc.messages import (
    Compares,
    Done,
    FrameDrawn,
    Job,
    LostRenderer,
    Message,
    Progress,
    Ready,
    Unable,
    Waits,
    encode_message,
)
from scenarios.runs.protocol import (
    MOST_SENT_BYTES,
    Asks,
    Briefing,
    Claim,
    CoordinatorSays,
    GoOn,
    How,
    Installed,
    Lease,
    LetGo,
    NoResult,
    Over,
    Received,
    Renewal,
    Result,
    TurnedAway,
    digest_of,
)

if TYPE_CHECKING:
    from scenarios.runs.net_transfer import Fetched

RENEW_S: Final = 1.0
_STARTS: Final = 2
"""So many environment processes in a row may end before they are ready."""
_SILENCE_S: Final = 300.0
_AT_ONCE_BYTES: Final = 4 << 20
"""Of frames, in one message."""
_LAST_PRINTED: Final = 60_000
_MOST_WORDS: Final = 2000
_FIRST_PAUSE_S = 0.1
_LONGEST_PAUSE_S = 1.0


NET: Final = "net:"
"""How what is asked begins when it is for a map, whose hash follows."""


class Wish(NamedTuple):
    """What is to be asked. act: under which key."""

    act: str
    payload: bytes
    timeout_s: float


class RunEnded(Exception):
    """The run is over."""


class WorkSlot:
    """worker, number: by what the coordinator knows it; host: for people; logs: the folder for what
    it prints; reach: how the coordinator is reached."""

    def __init__(
        self,
        worker: str,
        number: int,
        host: str,
        installed: Installed,
        logs: Path,
        reach: Connection,
    ) -> None:
        self._reach = reach
        self._worker = worker
        self._number = number
        self._host = host
        self._installed = installed
        self._log = logs / f"{number}.log"
        self._read = 0
        self._welcome: Briefing | None = None
        self._process: KeptProcess | None = None
        self._ready = self._ran = self._silent = self._leaving = False
        self._starts = 0
        self._heard_s = 0.0
        self._lease = 0
        self._fetched: Fetched | None = None
        self._job: Job | None = None
        self._said: list[Progress | Waits | Compares | FrameDrawn] = []
        self._underway = 0
        self._done: Done | None = None
        self._wish: Wish | None = None
        self._asked = self._renewing = False
        self._next_s = self._renew_s = 0.0
        self._pause_s = _FIRST_PAUSE_S

    @property
    def descriptor(self) -> int | None:
        """What can be waited for until its process says something."""
        return (
            self._process.wire.fileno()
            if self._process is not None and self._process.open
            else None
        )

    @property
    def holds_result(self) -> bool:
        """Whether there is something that the coordinator has not acknowledged."""
        return self._done is not None or (
            self._wish is not None and self._wish.act in ("result", "failed")
        )

    def wishes(self, now_s: float) -> list[Wish]:
        """What is to be asked now. Each is answered by `replied`."""
        found = []
        if self._wish is None:
            self._wish = self._wanted()
        if self._wish is not None and not self._asked and now_s >= self._next_s:
            self._asked = True
            found.append(self._wish)
        if self._job is not None and not self._renewing and now_s >= self._renew_s:
            self._renewing = True
            self._renew_s = now_s + RENEW_S
            found.append(Wish("renew", encode(self._renewal()), 5.0))
        return found

    def part_came(self, payload: bytes | None, refusal: str) -> None:
        """A part of a map has come, or nobody has answered. Raises MachineError when it is
        refused."""
        self._asked = False
        if refusal:
            raise MachineError(f"a map of the run cannot be had: {refusal}")
        if payload is None and self._fetched is not None:
            self._later()
            return
        self._wish = None
        self._pause_s = _FIRST_PAUSE_S
        if payload is not None and self._fetched is not None and self._fetched.take(payload):
            self._fetched = None
            self._give()

    def replied(self, act: str, reply: CoordinatorSays | None) -> None:
        """The reply to a wish, None where there was none. Raises RunEnded, or UsageError when there
        is nothing to be done here."""
        if act == "renew":
            self._renewing = False
            self._renewed(reply)
            return
        self._asked = False
        if reply is None:
            self._later()
            return
        self._pause_s = _FIRST_PAUSE_S
        self._wish = None
        match reply:
            case Briefing():
                self._welcome = reply
            case Lease():
                self._begin(reply)
            case TurnedAway():
                raise UsageError(reply.why)
            case Over() if not self._done:
                raise RunEnded
            case Received() if act == "result":
                if self._done is not None:
                    happened(
                        "done",
                        scenario=self._done.scenario,
                        status=self._done.status,
                        how=reply.how,
                    )
                self._done = None
            case _:
                pass

    def listen(self) -> None:
        """Take in what its process says. Raises the worker's error when it can run nothing."""
        process = self._process
        if process is None:
            if self._welcome is not None:
                self._start(self._welcome)
            return
        if not process.listen(self._take):
            self._ended(process)
            return
        question = process.question
        if not self._ready or (question is not None and question.doing == "loading"):
            self._loading(process, question)

    def release(self) -> None:
        """Hand the job back, if there is one: this worker leaves."""
        if self._job is not None and self._done is None:
            self._fail("released", "")
        self._leaving = True
        self.end()

    def end(self) -> None:
        """End the process."""
        process = self._process
        self._process = None
        self._ready = False
        self._fetched = None
        if process is not None:
            process.kill(wait=False)
            process.end()

    def _later(self) -> None:
        """What was not answered is asked again after a pause."""
        self._next_s = time.monotonic() + self._pause_s
        self._pause_s = min(2 * self._pause_s, _LONGEST_PAUSE_S)

    def _wanted(self) -> Wish | None:
        """What is to be asked next when nothing else is."""
        if self._done is not None and not self._said and not self._renewing:
            return self._result(self._done)
        if self._leaving:
            return None
        if self._fetched is not None:
            return Wish(f"{NET}{self._fetched.digest}", self._fetched.asks, 10.0)
        if self._welcome is None or (self._ready and self._job is None and self._done is None):
            ready = self._welcome is not None
            claim = Claim(
                worker=self._worker,
                slot=self._number,
                host=self._host,
                installed=self._installed,
                ready=ready,
            )
            return Wish("claim", encode(claim), 10.0)
        return None

    def _start(self, welcome: Briefing) -> None:
        self._process = KeptProcess(self._log, WORKER, "environment")
        hello = msgspec.structs.replace(welcome.hello, host=welcome.hello.host.seen_by(self._reach))
        self._process.send(encode_message(hello))
        self._ready = self._ran = False
        self._heard_s = time.monotonic()
        self._give()

    def _begin(self, lease: Lease) -> None:
        happened("claimed", scenario=lease.job.scenario.id, slot=self._number, lease=lease.number)
        self._lease = lease.number
        self._job = lease.job
        self._silent = True
        self._renew_s = time.monotonic() + RENEW_S
        where = lease.job.scenario.place
        if isinstance(where, CityMap):
            from scenarios.runs.net_transfer import Fetched, lacks  # with the importer of maps

            if lacks(where):
                self._fetched = Fetched(where, lease.job.net_hash)
        self._give()

    def _give(self) -> None:
        """Its job, to the process, if there are both, and the map that it takes place on."""
        if (
            self._process is not None
            and self._job is not None
            and self._done is None
            and self._fetched is None
        ):
            self._process.give(self._job)

    def _take(self, message: Message) -> None:
        self._heard_s = time.monotonic()
        self._silent = False
        if isinstance(message, Unable):
            raise (
                UsageError(message.reason)
                if message.blames_policy
                else MachineError(message.reason)
            )
        if isinstance(message, Ready):
            self._ready = True
            self._starts = 0
        elif self._job is None:
            return
        elif isinstance(message, Done):
            self._done = message
            self._ran = True
        elif not isinstance(message, LostRenderer):
            if isinstance(message, Progress):
                self._said[self._underway :] = [
                    m for m in self._said[self._underway :] if not isinstance(m, Progress)
                ]
            self._said.append(message)
            if isinstance(message, FrameDrawn):
                self._renew_s = 0.0

    def _renewal(self) -> Renewal:
        """What its process has said, as much as goes into one message."""
        assert self._job is not None
        self._underway = 0
        size = 0
        for message in self._said:
            size += len(message.png) if isinstance(message, FrameDrawn) else 100
            if self._underway and size > _AT_ONCE_BYTES:
                break
            self._underway += 1
        return Renewal(
            worker=self._worker,
            slot=self._number,
            lease=self._lease,
            scenario=self._job.scenario.id,
            asks=_asks(self._process),
            said=tuple(self._said[: self._underway]),
        )

    def _renewed(self, reply: CoordinatorSays | None) -> None:
        if isinstance(reply, GoOn):
            del self._said[: self._underway]
            if self._said or self._done is not None:
                self._renew_s = 0.0
        self._underway = 0
        if isinstance(reply, LetGo | Over) and self._done is None and self._job is not None:
            self._job = None
            self._said.clear()
            self.end()
        elif isinstance(reply, LetGo | Over):
            self._said.clear()

    def _result(self, done: Done) -> Wish | None:
        if len(done.record) + len(done.log) > MOST_SENT_BYTES - (1 << 17):
            megabytes = (len(done.record) + len(done.log)) >> 20
            self._fail(
                "ended", f"its result of {megabytes} MB is more than can be sent", in_engine=True
            )
            return self._wish
        assert self._job is not None
        result = Result(
            worker=self._worker,
            slot=self._number,
            lease=self._lease,
            scenario=done.scenario,
            status=done.status,
            record=done.record,
            log=done.log,
            again=done.again,
            digest=digest_of(done.record, done.log),
            printed=self._printed(),
        )
        self._job = None
        return Wish("result", encode(result), 30.0)

    def _ended(self, process: KeptProcess) -> None:
        why = process.end()
        self._process = None
        if not self._ready:
            self._not_started(why, process)
        elif self._job is not None and self._done is None:
            began = not (self._ran and self._silent) or process.question is not None
            self._fail(
                "ended", why if began else "", in_engine=process.in_engine, asks=_asks(process)
            )

    def _not_started(self, why: str, process: KeptProcess) -> None:
        """As the pool does with its own: when the next one has ended so too, there is nothing to be
        done here."""
        self._starts += 1
        if self._starts < _STARTS:
            return
        told = f"{why} before it was ready, {_STARTS} times: see {self._log}"
        if process.question is not None:
            raise UsageError(f"the policy of the run cannot be loaded here: {told}")
        raise MachineError(f"{told}, and `cosim doctor`")

    def _loading(self, process: KeptProcess, question: Question | None) -> None:
        """A policy that is loaded for too long, or engines that are."""
        assert self._welcome is not None
        if question is not None:
            self._heard_s = time.monotonic()
            if question.overdue(self._welcome.patience):
                process.kill()
                allowed_s = self._welcome.patience.of(question.doing)
                raise UsageError(
                    f"the policy of the run gave no answer for {allowed_s:g} s while it was loaded "
                    "here: begin the run with a longer --start-timeout"
                )
        elif time.monotonic() - self._heard_s > _SILENCE_S:
            process.kill()

    def _fail(
        self, how: How, why: str, *, in_engine: bool = False, asks: Asks | None = None
    ) -> None:
        assert self._job is not None
        happened(
            "handed back" if how == "released" else "failed",
            WARNING,
            scenario=self._job.scenario.id,
            why=why,
        )
        failure = NoResult(
            worker=self._worker,
            slot=self._number,
            lease=self._lease,
            scenario=self._job.scenario.id,
            how=how,
            why=why[:_MOST_WORDS],
            in_engine=in_engine,
            asks=asks,
            printed=self._printed(),
        )
        self._job = None
        self._done = None
        self._said.clear()
        self._wish = Wish("failed", encode(failure), 5.0)
        self._asked = False
        self._next_s = 0.0

    def unable(self, why: str) -> Wish:
        """That nothing can be run here, to be said once."""
        failure = NoResult(
            worker=self._worker,
            slot=self._number,
            lease=self._lease,
            scenario=self._job.scenario.id if self._job is not None else "",
            how="unable",
            why=why[:_MOST_WORDS],
            printed=self._printed(),
        )
        return Wish("failed", encode(failure), 5.0)

    def _printed(self) -> bytes:
        """What its processes have printed since this was asked last, the end of it."""
        try:
            with self._log.open("rb") as log:
                size = log.seek(0, 2)
                log.seek(max(self._read, size - _LAST_PRINTED))
                self._read = size
                return log.read(_LAST_PRINTED)
        except OSError:
            return b""


def _asks(process: KeptProcess | None) -> Asks | None:
    """What the policy is asked; its loading is watched over here."""
    question = process.question if process is not None else None
    if question is None or question.doing == "loading":
        return None
    return Asks(question.doing, question.tick, max(time.monotonic() - question.since_s, 0.0))
