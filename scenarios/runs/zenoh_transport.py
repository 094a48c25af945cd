"""Workers on other machines, as a transport: whenever they are free they ask the run's coordinator
for jobs.

Threads of Zenoh's only put what they hear into a queue; all else is done by the thread of the run,
when it waits.
"""

from __future__ import annotations

import queue
import secrets
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Final, NamedTuple

import msgspec

from bridge import keys
from bridge.codec import decode
from bridge.session import Query, Session
from cosim.core.errors import EngineError
from cosim.results.run_spec import RunSpec
from scenarios.ipc.deadlines import Patience
from scenarios.ipc.messages import Done, Hello, Job, MessageHandler
from scenarios.runs.lease import LEASE_S, LeasedWorker
from scenarios.runs.net_transfer import Nets
from scenarios.runs.protocol import (
    MOST_SENT_BYTES,
    Briefing,
    Claim,
    Lease,
    LetGo,
    NoResult,
    NothingNow,
    Over,
    Received,
    Renewal,
    Result,
    TurnedAway,
    digest_of,
    installed_here,
    reply_in_bytes,
    run_hash,
)
from scenarios.runs.status import Roll
from scenarios.runs.transport import GoesOn, HeldRun, Late, Reception

HELD_S: Final = 2.0
"""A claim is answered after so long even when there is nothing to do."""
SETTLING_S: Final = 3.0
"""A run that is begun anew gives no jobs for so long: who works on one tells so first."""
PARTING_S: Final = 3.0
"""How long those who ask are told that the run is over."""


class _Departed(NamedTuple):
    """A worker is not seen any more."""

    worker: str


class RemoteWorkers:
    """A transport (`scenarios.runs.transport`) to all workers that come to a session.

    hello, patience: of the run. resumed: whether others may work for it already. roll: who is there
    and what is odd.
    """

    def __init__(
        self,
        session: Session,
        spec: RunSpec,
        hello: Hello,
        patience: Patience,
        roll: Roll,
        *,
        resumed: bool = False,
    ) -> None:
        self.run = run_hash(spec)
        self._session = session
        self._spec = spec
        self._hello = hello
        self._patience = patience
        self._roll = roll
        self._installed = msgspec.structs.replace(installed_here(), versions=spec.versions)
        self._inbox: queue.SimpleQueue[tuple[str, Query] | _Departed] = queue.SimpleQueue()
        self._claims: dict[tuple[str, int], tuple[Query, float]] = {}
        self._leased: dict[tuple[str, int], LeasedWorker] = {}
        self._unasked: list[GoesOn | Late] = []
        self._nets = Nets()
        self._number = secrets.randbits(48)
        self._opens_at = time.monotonic() + (SETTLING_S if resumed else 0.0)
        self._over = False
        self._taken: dict[str, Callable[[Query], None]] = {
            "claim": self._claimed,
            "renew": self._renewed,
            "result": self._delivered,
            "failed": self._failed,
            "status": self._told,
            "net": self._handed_out,
        }

    def open(self) -> None:
        """From now on workers are heard."""
        for act in ("claim", "renew", "result", "failed"):
            self._session.collect(keys.job(self.run, act), self._taken_in(act))
        self._session.collect(keys.status(self.run), self._taken_in("status"), found=True)
        self._session.collect(keys.net(self.run, "*"), self._taken_in("net"))
        self._session.watch(keys.worker(self.run, "*"), self._seen)

    def room(self, busy: int) -> int:
        return len(self._claims) if time.monotonic() >= self._opens_at else 0

    def start(self, hello: Hello) -> LeasedWorker:
        """The worker that has waited longest. Its first job must be given at once."""
        at, (query, _) = next(iter(self._claims.items()))
        del self._claims[at]
        self._number += 1
        one = self._leased[at] = LeasedWorker(self, at, self._number, query)
        return one

    def unasked(self) -> Iterable[GoesOn | Late]:
        found = self._unasked
        self._unasked = []
        return found

    def wait(self, timeout_s: float) -> None:
        """Take in all that has come; if nothing has, wait for something."""
        try:
            one = self._inbox.get(timeout=timeout_s)
            while True:
                self._take(one)
                one = self._inbox.get_nowait()
        except queue.Empty:
            pass
        now_s = time.monotonic()
        for at, (query, since_s) in list(self._claims.items()):
            if now_s - since_s > HELD_S:
                del self._claims[at]
                query.answer(reply_in_bytes(NothingNow()))
        self._roll.tend()

    def part(self) -> None:
        """The run is over: tell it to those who ask, until they have left; what is told just before
        a session closes may be lost."""
        self._over = True
        until_s = time.monotonic() + PARTING_S
        for query, _ in self._claims.values():
            query.answer(reply_in_bytes(Over()))
        self._claims.clear()
        while self._roll.anybody and (left_s := until_s - time.monotonic()) > 0.0:
            self.wait(left_s)

    def _taken_in(self, act: str) -> Callable[[Query], None]:
        return lambda query: self._inbox.put((act, query))

    def forget(self, one: LeasedWorker) -> None:
        """The lease of a worker has ended."""
        if self._leased.get(one.at) is one:
            del self._leased[one.at]

    def with_net(self, job: Job) -> Job:
        return msgspec.structs.replace(job, net_hash=self._nets.hash_of(job.scenario.place))

    def given(self, one: LeasedWorker) -> None:
        """A worker has been given a job."""
        self._roll.leased(*one.at, one.scenario)

    def ended_late(self, one: LeasedWorker) -> None:
        """A worker did not renew its lease."""
        self._roll.note(f"{one.name} has not renewed its lease of {one.scenario} for {LEASE_S:g} s")

    def _seen(self, key: str, there: bool) -> None:
        if not there:
            self._inbox.put(_Departed(key.rpartition("/")[2]))

    def _take(self, one: tuple[str, Query] | _Departed) -> None:
        if isinstance(one, _Departed):
            self._lose(one.worker)
            return
        act, query = one
        try:
            if len(query.payload) > MOST_SENT_BYTES + 4096:
                raise EngineError(f"{len(query.payload)} bytes are more than a message may have")
            self._taken[act](query)
        except EngineError as error:
            self._roll.odd(f"what came to '{act}' was refused: {error}")
            query.refuse(str(error)[:500])

    def _lose(self, worker: str) -> None:
        """A worker is gone, or cut off: all its jobs are free. What it says again later is
        heard."""
        self._roll.gone(worker)
        for at in [at for at in self._claims if at[0] == worker]:
            self._claims.pop(at)[0].answer(reply_in_bytes(NothingNow()))
        for one in [one for at, one in self._leased.items() if at[0] == worker]:
            one.lose(f"worker {worker} was lost")

    def _claimed(self, query: Query) -> None:
        claim = decode(query.payload, Claim)
        at = (claim.worker, claim.slot)
        if self._over:
            self._roll.left(claim.worker)
            query.answer(reply_in_bytes(Over()))
            return
        if other := claim.installed.differs_from(self._installed):
            self._roll.refused(claim.worker, claim.host, other)
            why = (
                f"this run needs another installation than that of {claim.host}, which has "
                f"{other}: install the same"
            )
            query.answer(reply_in_bytes(TurnedAway(why)))
            return
        self._roll.heard(claim.worker, claim.host, claim.slot)
        if not claim.ready:
            query.answer(reply_in_bytes(Briefing(self._hello, self._installed, self._patience)))
            return
        one = self._leased.get(at)
        if (
            one is not None and one.job is not None and not one.ended
        ):  # the answer to its last claim was lost
            query.answer(reply_in_bytes(Lease(one.number, one.job)))
            return
        if one is not None:
            one.lose(f"worker {claim.worker} does not go on with it")
        if at in self._claims:
            self._claims.pop(at)[0].answer(reply_in_bytes(NothingNow()))
        self._claims[at] = (query, time.monotonic())

    def _renewed(self, query: Query) -> None:
        renewal = decode(query.payload, Renewal)
        self._roll.renewed(renewal)
        at = (renewal.worker, renewal.slot)
        one = self._leased.get(at)
        if one is None or one.number != renewal.lease:
            if self._over or one is not None:
                query.answer(reply_in_bytes(LetGo()))
                return
            one = self._leased[at] = LeasedWorker(self, at, renewal.lease, None, renewal.scenario)
            self._unasked.append(GoesOn(renewal.scenario, one))
        one.renew(renewal, query)

    def _delivered(self, query: Query) -> None:
        result = decode(query.payload, Result)
        if digest_of(result.record, result.log) != result.digest:
            raise EngineError("the result was damaged on its way")
        one = self._leased.get((result.worker, result.slot))
        one = one if one is not None and one.number == result.lease else None
        if other := self._of_another(result):
            self._roll.refused(result.worker, "", other)
            if one is not None:
                one.lose(f"its worker was turned away: {other}")
            query.answer(reply_in_bytes(TurnedAway(other)))
            return
        self._roll.printed(result, result.printed)
        done = Done(result.scenario, result.status, result.record, result.log, result.again)
        if one is not None:
            one.deliver(done, query)
        elif self._over:
            self._answer_late(result, query, "duplicate")
        else:
            self._unasked.append(Late(done, lambda how: self._answer_late(result, query, how)))
        self._roll.delivered(result)

    def _answer_late(self, result: Result, query: Query, how: Reception) -> None:
        name = result.worker
        if how == "conflict":
            self._roll.conflict(
                f"CONFLICT: {result.scenario} by {name} came out otherwise than what is kept: the "
                "same scenario must give the same result on every machine; the first one stays"
            )
        else:
            self._roll.note(f"late result of {result.scenario} by {name}: {how}")
        query.answer(reply_in_bytes(Received(how)))

    def _of_another(self, result: Result) -> str:
        """Why a result cannot be of this run; "" where it can, or where it is too damaged to
        tell."""
        try:
            told = msgspec.json.decode(result.record, type=_Told)
        except msgspec.DecodeError:
            return ""
        run = self._spec
        if (told.suite_hash, told.run_seed, told.policy_source) != (
            run.suite_hash,
            run.seed,
            run.policy_source,
        ):
            return "its result is of another run"
        if told.versions != run.versions:
            return "its result is of another installation"
        if told.ended is not None and told.renderer != run.renderer:
            return (
                f"its pictures are drawn by {told.renderer}, those of the run by {run.renderer}: "
                "begin the run with --camera bullet"
            )
        return ""

    def _failed(self, query: Query) -> None:
        failure = decode(query.payload, NoResult)
        one = self._leased.get((failure.worker, failure.slot))
        self._roll.printed(failure, failure.printed)
        if one is not None and one.number == failure.lease:
            one.fail(failure)
        self._roll.failed(failure)
        query.answer(reply_in_bytes(Received()))

    def _handed_out(self, query: Query) -> None:
        query.answer(self._nets.part(query.key.rpartition("/")[2], query.payload))

    def _told(self, query: Query) -> None:
        query.answer(msgspec.json.encode(self._roll.status()))


class _Told(msgspec.Struct):
    """What a record says of where it comes from."""

    suite_hash: str
    run_seed: int
    policy_source: str
    versions: dict[str, str]
    renderer: str
    ended: str | None = None


@contextmanager
def workers_of_run(
    session: Session, run: HeldRun, tell: MessageHandler, *, resumed: bool
) -> Iterator[tuple[RemoteWorkers, MessageHandler]]:
    """The workers of a run, and what is to be told of their episodes in place of `tell`. At the end
    of the block, unless it failed, they are told that the run is over."""
    roll = Roll(run.held, run.picked, len(run.picked) - len(run.todo), tell)
    workers = RemoteWorkers(session, run.held.spec, run.hello, run.patience, roll, resumed=resumed)
    workers.open()
    roll.note(f"run {workers.run}: {len(run.todo)} of {len(run.picked)} episodes to be run")
    yield workers, roll.tell
    roll.note("the run is over")
    workers.part()
