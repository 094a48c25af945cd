"""Transport to workers on other machines over Zenoh, which claim jobs from the run's coordinator.

Zenoh's threads put arriving messages into a queue, which the run's thread processes in `wait`.
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
from scenarios.ipc.faults import AttemptFailure
from scenarios.ipc.messages import Done, Hello, Job, MessageHandler
from scenarios.runs.lease import Lease
from scenarios.runs.net_transfer import RunMaps
from scenarios.runs.protocol import (
    MAX_SENT_BYTES,
    Assignment,
    Claim,
    CoordinatorReply,
    Reply,
    Report,
    difference,
    digest_of,
    encode_reply,
    installed_for,
    origin_of,
    other_renderer,
    run_hash,
)
from scenarios.runs.status import WorkerRegistry
from scenarios.runs.transport import AdoptedJob, LateResult, LockedRun, ResultOutcome

LEASE_S: Final = 15.0
"""Seconds without a report after which a worker has lost its lease, whether or not Zenoh still
lists it."""
HELD_S: Final = 2.0
"""Seconds after which a claim is answered even if there is no job."""
SETTLING_S: Final = 3.0
"""Seconds for which a resumed run gives no jobs: workers that already run one report it first."""
PARTING_S: Final = 3.0
"""Seconds for which claims are answered after the run is over."""
_OVERHEAD_BYTES: Final = 4096
"""Bytes that a message may have beyond `MAX_SENT_BYTES`."""

_SlotKey = tuple[str, int]
"""The name of a worker and the number of its slot."""


class _Disconnected(NamedTuple):
    """A worker that Zenoh no longer lists."""

    worker: str


class _LeasedWorker(Lease):
    """A slot of a worker as long as it has one lease (`scenarios.runs.transport.Worker`)."""

    def __init__(
        self,
        server: ZenohWorkers,
        slot_key: _SlotKey,
        number: int,
        claim: Query | None,
        scenario: str = "",
    ) -> None:
        super().__init__(slot_key[0], number, LEASE_S, scenario)
        self.slot_key = slot_key
        self.log = f"logs/{slot_key[0]}-{slot_key[1]}.log"
        self.job: Job | None = None
        self._server = server
        self._claim = claim

    def give(self, job: Job) -> None:
        self.scenario = job.scenario.id
        self.job = self._server.with_net(job)
        if self._claim is not None:
            _answer(self._claim, Assignment(self.number, self.job))
            self._server.registry.assigned(*self.slot_key, self.scenario)

    def take_report(self, report: Report, query: Query) -> None:
        """Take in a report, which is answered once it is processed."""
        done = () if report.done is None else (report.done,)
        failure = _failure_in(report)
        self.add_report((*report.said, *done), failure, lambda reply: _answer(query, reply))

    def poll(self, handle: MessageHandler) -> AttemptFailure | None:
        failure = super().poll(handle)
        if self.expired:
            words = f"has not renewed its lease of {self.scenario} for {LEASE_S:g} s"
            self._server.registry.note(f"{self.slot_key[0]}/{self.slot_key[1]} {words}")
        if self.ended:
            self._server.forget(self)
        return failure

    def cancel(self) -> None:
        self.revoke()
        self._server.forget(self)

    def stop(self) -> None:
        self.revoke(silently=True)
        self._server.forget(self)

    def end(self) -> None:
        """Do nothing: the worker ends its job after the reply to its next report."""


class ZenohWorkers:
    """A transport (`scenarios.runs.transport`) to all workers that connect to a session.

    hello: introduces the policy of the run.
    registry: lists the workers.
    resumed: whether workers may run jobs of this run already.
    """

    def __init__(
        self,
        session: Session,
        spec: RunSpec,
        hello: Hello,
        registry: WorkerRegistry,
        *,
        resumed: bool = False,
    ) -> None:
        self.run = run_hash(spec)
        self.registry = registry
        self._session = session
        self._spec = spec
        self._hello = hello
        self._installed = installed_for(spec)
        self._inbox: queue.SimpleQueue[tuple[str, Query] | _Disconnected] = queue.SimpleQueue()
        self._claims: dict[_SlotKey, tuple[Query, float]] = {}
        self._leases: dict[_SlotKey, _LeasedWorker] = {}
        self._unsolicited: list[AdoptedJob | LateResult] = []
        self._maps = RunMaps()
        self._number = secrets.randbits(48)
        self._opens_at = time.monotonic() + (SETTLING_S if resumed else 0.0)
        self._over = False
        self._handlers: dict[str, Callable[[Query], None]] = {
            "claim": self._claimed,
            "report": self._reported,
            "status": self._status,
            "net": self._net,
        }

    def open(self) -> None:
        """Start to answer workers."""
        for act in ("claim", "report"):
            self._session.serve_later(keys.job(self.run, act), self._queued(act))
        self._session.serve_later(keys.status(self.run), self._queued("status"), found=True)
        self._session.serve_later(keys.net(self.run, "*"), self._queued("net"))
        self._session.watch_tokens(keys.worker(self.run, "*"), self._seen)

    def room(self, busy: int) -> int:
        return len(self._claims) if time.monotonic() >= self._opens_at else 0

    def start(self, hello: Hello) -> _LeasedWorker:
        """Return the worker that has waited longest. Its first job must be given at once."""
        slot_key, (query, _) = next(iter(self._claims.items()))
        del self._claims[slot_key]
        self._number += 1
        lease = self._leases[slot_key] = _LeasedWorker(self, slot_key, self._number, query)
        return lease

    def unsolicited(self) -> Iterable[AdoptedJob | LateResult]:
        found = self._unsolicited
        self._unsolicited = []
        return found

    def wait(self, timeout_s: float) -> None:
        """Take in all messages that have arrived; if there is none, wait for one."""
        try:
            one = self._inbox.get(timeout=timeout_s)
            while True:
                self._take(one)
                one = self._inbox.get_nowait()
        except queue.Empty:
            pass
        now_s = time.monotonic()
        for slot_key in [
            slot_key for slot_key, (_, since_s) in self._claims.items() if now_s - since_s > HELD_S
        ]:
            self._drop_claim(slot_key)
        self.registry.write()

    def close(self) -> None:
        """Answer claims with "over" until all workers have left, because a reply just before the
        session closes may be lost."""
        self._over = True
        until_s = time.monotonic() + PARTING_S
        for query, _ in self._claims.values():
            _answer(query, Reply("over"))
        self._claims.clear()
        while self.registry.any_connected and (left_s := until_s - time.monotonic()) > 0.0:
            self.wait(left_s)

    def forget(self, lease: _LeasedWorker) -> None:
        """Forget a lease that has ended."""
        if self._leases.get(lease.slot_key) is lease:
            del self._leases[lease.slot_key]

    def with_net(self, job: Job) -> Job:
        """Return a job with the hash of its street net."""
        return msgspec.structs.replace(job, net_hash=self._maps.hash_of(job.scenario.place))

    def _queued(self, act: str) -> Callable[[Query], None]:
        return lambda query: self._inbox.put((act, query))

    def _seen(self, key: str, connected: bool) -> None:
        if not connected:
            self._inbox.put(_Disconnected(key.rpartition("/")[2]))

    def _take(self, one: tuple[str, Query] | _Disconnected) -> None:
        if isinstance(one, _Disconnected):
            self._disconnected(one.worker)
            return
        act, query = one
        try:
            if len(query.payload) > MAX_SENT_BYTES + _OVERHEAD_BYTES:
                raise EngineError(f"{len(query.payload)} bytes are more than a message may have")
            self._handlers[act](query)
        except EngineError as error:
            self.registry.refused(f"a message to '{act}' was refused: {error}")
            query.refuse(str(error)[:500])

    def _disconnected(self, worker: str) -> None:
        """Free the jobs of a worker that is lost or cut off. Its later reports are still
        accepted."""
        self.registry.disconnected(worker)
        for slot_key in [slot_key for slot_key in self._claims if slot_key[0] == worker]:
            self._drop_claim(slot_key)
        for lease in [lease for slot_key, lease in self._leases.items() if slot_key[0] == worker]:
            lease.mark_lost(f"worker {worker} was lost")

    def _drop_claim(self, slot_key: _SlotKey) -> None:
        if slot_key in self._claims:
            _answer(self._claims.pop(slot_key)[0], Reply("idle"))

    def _claimed(self, query: Query) -> None:
        claim = decode(query.payload, Claim)
        slot_key = (claim.worker, claim.slot)
        if self._over:
            self.registry.left(claim.worker)
            _answer(query, Reply("over"))
            return
        if other := difference(claim.installed, self._installed):
            self.registry.turned_away(claim.worker, claim.host, other)
            why = (
                f"this run needs another installation than that of {claim.host}, which has "
                f"{other}: install the same"
            )
            _answer(query, Reply("turned_away", why))
            return
        self.registry.claimed(claim.worker, claim.host, claim.slot)
        if not claim.ready:
            _answer(query, self._hello)
            return
        lease = self._leases.get(slot_key)
        if lease is not None and lease.job is not None and not lease.ended:
            _answer(query, Assignment(lease.number, lease.job))  # the first reply was lost
            return
        if lease is not None:
            lease.mark_lost(f"worker {claim.worker} does not continue with it")
        self._drop_claim(slot_key)
        self._claims[slot_key] = (query, time.monotonic())

    def _reported(self, query: Query) -> None:
        report = decode(query.payload, Report)
        if report.done is not None and (refusal := self._refusal(report)):
            self._turn_away(report, query, refusal)
            return
        self.registry.printed(report)
        self.registry.reported(report)
        lease = self._lease_of(report)
        if lease is not None:
            lease.take_report(report, query)
        elif report.done is not None:
            self._late(report, report.done, query)
        elif report.fault is not None:
            _answer(query, Reply("kept"))
        elif self._over or (report.worker, report.slot) in self._leases:
            _answer(query, Reply("revoked"))
        else:
            self._adopt(report, query)

    def _lease_of(self, report: Report) -> _LeasedWorker | None:
        lease = self._leases.get((report.worker, report.slot))
        return lease if lease is not None and lease.number == report.lease else None

    def _adopt(self, report: Report, query: Query) -> None:
        """Renew a lease that is not known here, if the run can use its job."""
        slot_key = (report.worker, report.slot)
        lease = self._leases[slot_key] = _LeasedWorker(
            self, slot_key, report.lease, None, report.scenario
        )
        lease.take_report(report, query)
        self._unsolicited.append(AdoptedJob(report.scenario, lease))

    def _late(self, report: Report, done: Done, query: Query) -> None:
        """Offer the run the result of a lease that has ended."""

        def answer(outcome: ResultOutcome) -> None:
            if outcome == "conflict":
                self.registry.conflict(
                    f"{report.scenario} by {report.worker} differs from the stored "
                    f"result: the same scenario "
                    "must give the same result on every machine; the first one is used"
                )
            else:
                self.registry.note(
                    f"late result of {report.scenario} by {report.worker}: {outcome}"
                )
            _answer(query, Reply(outcome))

        if self._over:
            answer("duplicate")
        else:
            self._unsolicited.append(LateResult(done, answer))

    def _turn_away(self, report: Report, query: Query, why: str) -> None:
        self.registry.turned_away(report.worker, "", why)
        if (lease := self._lease_of(report)) is not None:
            lease.mark_lost(f"its worker was turned away: {why}")
        _answer(query, Reply("turned_away", why))

    def _refusal(self, report: Report) -> str:
        """Return why a result cannot be of this run; "" if it can, or if it is damaged inside.

        Raises EngineError if it was damaged on its way."""
        assert report.done is not None
        if digest_of(report.done) != report.digest or report.done.scenario != report.scenario:
            raise EngineError("the result was damaged on its way")
        run = self._spec.setup
        origin = origin_of(report.done)
        if origin is None:
            return ""
        if (origin.suite_hash, origin.run_seed, origin.policy_source) != (
            run.suite_hash,
            run.seed,
            run.policy_source,
        ):
            return "its result is of another run"
        if origin.versions != run.versions:
            return "its result is of another installation"
        other = other_renderer(report.done, run.renderer)
        return f"{other}: begin the run with --camera bullet" if other else ""

    def _net(self, query: Query) -> None:
        query.answer(self._maps.part(query.key.rpartition("/")[2], query.payload))

    def _status(self, query: Query) -> None:
        query.answer(msgspec.json.encode(self.registry.status()))


def _failure_in(report: Report) -> AttemptFailure | None:
    """Return the failure that a report has, if any."""
    if report.fault is None:
        return None
    return AttemptFailure(report.fault, report.why, report.found, report.driven)


def _answer(query: Query, reply: CoordinatorReply) -> None:
    query.answer(encode_reply(reply))


@contextmanager
def workers_of_run(
    session: Session, run: LockedRun, handle: MessageHandler, *, resumed: bool
) -> Iterator[tuple[ZenohWorkers, MessageHandler]]:
    """Create the transport of a run and wrap its progress callback.

    At the end of the block, unless it failed, workers are informed that the run is over."""
    registry = WorkerRegistry(run.folder, run.scenarios, len(run.scenarios) - len(run.todo), handle)
    workers = ZenohWorkers(session, run.folder.spec, run.hello, registry, resumed=resumed)
    workers.open()
    registry.note(f"run {workers.run}: {len(run.todo)} of {len(run.scenarios)} episodes to be run")
    yield workers, registry.handle
    registry.note("the run is over")
    workers.close()
