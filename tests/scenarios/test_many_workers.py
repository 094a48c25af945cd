"""Workers of other machines and a run's coordinator, over real Zenoh sessions without engines: job
assignment, results, and refusals."""

from __future__ import annotations

import secrets
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import msgspec
import pytest

from bridge import keys
from bridge.codec import encode
from bridge.security import settings
from bridge.session import open_session
from cosim.core.errors import CosimError, EngineError, MachineError
from cosim.core.versions import versions
from cosim.policies.load import load_policy
from cosim.results.record import Record
from cosim.results.run_folder import RunFolder, read_records
from cosim.spec.connection import Connection
from cosim.spec.scenario import City, CityMap, Scenario, Suite
from scenarios.ipc.faults import RULES, AttemptFailure
from scenarios.ipc.messages import Done, EpisodeProgress, Hello
from scenarios.runs import status
from scenarios.runs import zenoh_transport as remote
from scenarios.runs.net_transfer import MapDownload, RunMaps, is_missing
from scenarios.runs.pool import run_all
from scenarios.runs.protocol import (
    Assignment,
    Claim,
    CoordinatorReply,
    Reply,
    Report,
    decode_reply,
    digest_of,
    installed_here,
    run_hash,
)
from scenarios.runs.status import RunStatus
from scenarios.runs.transport import LockedRun
from scenarios.runs.zenoh_transport import workers_of_run
from sumo_nets.net.raw_file import net_xml_hash
from tests.conftest import PATIENCE_S, Cosim, wait_until
from tests.run_specs import changed, spec_of

pytestmark = pytest.mark.engine

DRIVER = load_policy("stop")
SUITE = Suite(
    name="s",
    version="1",
    scenarios=tuple(
        Scenario(
            id=f"s-{i}",
            suite="s",
            place=City(seed=0, net_hash="h"),
            seed=i,
            start=(0.0, 0.0, 0.0),
            goal=(9.0, 0.0),
            route=((0.0, 0.0), (9.0, 0.0)),
        )
        for i in range(2)
    ),
)
SPEC = spec_of(SUITE, "stop", policy_source=DRIVER.source_hash, versions=versions(), seed=3)


IDLE, RENEWED, REVOKED = Reply("idle"), Reply("renewed"), Reply("revoked")
KEPT = Reply("kept")
DUPLICATE = Reply("duplicate")
CONFLICT = Reply("conflict")
REFUSED = Reply("refused")
KILLED = AttemptFailure("process_ended", "its process was killed by SIGKILL")
ATTEMPTS, LOSSES = (RULES[fault].attempts for fault in ("process_ended", "machine_lost"))
GARBAGE = (
    b"",
    b"\xc1" * 100,
    encode(EpisodeProgress("s-0", 1.0, 1.0, 0)),
    b"\x91" * 100_000,
    b"\xdd\xff\xff\xff\xff",
)


@pytest.fixture(autouse=True)
def _no_parting_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    """Skip the wait for late requests at the end of a run."""
    monkeypatch.setattr(remote, "PARTING_S", 0.0)


class Run:
    """A run that is coordinated in its own thread and folder; closing its session kills it."""

    def __init__(self, folder: Path, *, resumed: bool = False) -> None:
        self.folder = folder / "run"
        self._resumed = resumed
        self.endpoint = f"unixsock-stream/{folder}/hub.sock"
        self.error: CosimError | None = None
        self.opened = threading.Event()
        self._hub = None
        self._thread = threading.Thread(target=self._coordinate, daemon=True)
        self._thread.start()
        assert self.opened.wait(PATIENCE_S)

    def over(self) -> dict[str, Record]:
        """Wait until the run is over, and return its records."""
        self._thread.join(PATIENCE_S)
        assert not self._thread.is_alive()
        return {record.scenario.id: record for record in read_records(self.folder)}

    @property
    def log(self) -> str:
        return (self.folder / "logs" / "coordinator.log").read_text()

    def _coordinate(self) -> None:
        hello = Hello("stop", DRIVER.manifest, DRIVER.source_hash)
        held = (
            RunFolder.resume(self.folder, SPEC)
            if self._resumed
            else RunFolder.create(self.folder, SPEC, SUITE)
        )
        with (
            held,
            open_session(Connection(role="coordinator", listen=self.endpoint)) as hub,
            suppress(_CoordinatorKilled),
        ):
            done = held.finished_ids()
            todo = [one for one in SUITE.scenarios if one.id not in done]
            try:
                run = LockedRun(held, hello, SUITE.scenarios, todo)
                with workers_of_run(hub, run, lambda _: None, resumed=self._resumed) as (
                    transport,
                    tell,
                ):
                    self.kill = _killer(transport)
                    self.opened.set()
                    run_all(held, todo, hello, transport, handle=tell)
            except MachineError as error:
                self.error = error


class _CoordinatorKilled(BaseException):
    """The coordinator was killed."""


def _killer(transport: remote.ZenohWorkers) -> Callable[[], None]:
    """Make a transport raise an error in its thread at its next wait."""
    wait = transport.wait
    killed = threading.Event()

    def until_killed(timeout_s: float) -> None:
        wait(min(timeout_s, 0.05))
        if killed.is_set():
            raise _CoordinatorKilled

    transport.wait = until_killed  # type: ignore[method-assign]
    return killed.set


class ManualWorker:
    """A worker that a test controls."""

    def __init__(self, endpoint: str) -> None:
        self.session = open_session(Connection(role="worker", connect=endpoint))
        self.name = f"w-{secrets.token_hex(4)}"
        self.run = run_hash(SPEC)
        self.session.declare_token(keys.worker(self.run, self.name))
        self.lease = 0
        self.scenario = ""

    def claim(self, *, ready: bool = True, **other: str) -> CoordinatorReply:
        installed = {**installed_here(), **other}
        payload = encode(Claim(**self.me(), host="here", installed=installed, ready=ready))
        return decode_reply(
            self.session.query(keys.job(self.run, "claim"), payload, timeout_s=PATIENCE_S)
        )

    def job(self) -> str:
        """Claim until there is a job, and return its scenario."""
        while not isinstance(reply := self.claim(), Assignment):
            assert reply == IDLE
        self.lease = reply.lease
        self.scenario = reply.job.scenario.id
        return self.scenario

    def report(self, **fields: object) -> CoordinatorReply:
        payload = self.payload(**fields)
        return decode_reply(
            self.session.query(keys.job(self.run, "report"), payload, timeout_s=PATIENCE_S)
        )

    def payload(self, **fields: object) -> bytes:
        return encode(
            Report(**self.me(), **{"lease": self.lease, "scenario": self.scenario} | fields)
        )

    def renew(self) -> CoordinatorReply:
        return self.report(said=(EpisodeProgress(self.scenario, 1.0, 4.5, 0),))

    def result(
        self, *, scenario_id: str = "", ticks: int = 40, record: Record | None = None
    ) -> dict[str, object]:
        name = scenario_id or self.scenario
        scenario = next(one for one in SUITE.scenarios if one.id == name)
        record = record or msgspec.structs.replace(
            Record.begun(scenario, DRIVER.manifest, SPEC.setup),
            status="done",
            ended="goal",
            ticks=ticks,
            state_hash=f"hash-{ticks}",
            clock={"wall_s": time.monotonic()},
        )
        done = Done(name, "done", record.encoded(), b"log")
        return {"scenario": name, "done": done, "digest": digest_of(done)}

    def deliver(self, **named: object) -> CoordinatorReply:
        return self.report(**self.result(**named))

    def fail(self, failure: AttemptFailure = KILLED) -> CoordinatorReply:
        return self.report(fault=failure.fault, why=failure.why)

    def me(self) -> dict[str, object]:
        return {"worker": self.name, "slot": 0}

    def status(self) -> RunStatus:
        (payload,) = self.session.query_all(keys.EVERY_RUN, timeout_s=PATIENCE_S).values()
        return msgspec.json.decode(payload, type=RunStatus)


@contextmanager
def manual_workers(run: Run, count: int) -> Iterator[list[ManualWorker]]:
    """Connect a number of workers to a run."""
    with ExitStack() as stack:
        found = [ManualWorker(run.endpoint) for _ in range(count)]
        for one in found:
            stack.enter_context(one.session)
        yield found


def test_jobs_are_claimed_renewed_and_delivered_once(tmp_path: Path) -> None:
    """A job is claimed and delivered once; a second result changes nothing, and one that differs is
    logged as a conflict."""
    run = Run(tmp_path)
    with manual_workers(run, 2) as (one, other):
        welcome = one.claim(ready=False)
        assert isinstance(welcome, Hello) and welcome.policy == "stop"
        first = one.job()
        assert one.job() == first and one.renew() == RENEWED
        assert other.job() != first
        working = {
            w.name: [episode.scenario for episode in w.episodes.values()]
            for w in one.status().workers
        }
        assert working[one.name] == [first]
        assert one.deliver() == KEPT and one.deliver() == DUPLICATE
        assert one.deliver(ticks=41) == CONFLICT
        assert len(one.status().conflicts) == 1 and one.status().finished == 1
        assert other.deliver() == KEPT
        records = run.over()
    assert {name: record.state_hash for name, record in records.items()} == {
        "s-0": "hash-40",
        "s-1": "hash-40",
    }
    assert f"CONFLICT: {first} by {one.name}" in run.log


def test_the_job_of_a_lost_worker_goes_to_the_next(tmp_path: Path) -> None:
    """Once the loss is noticed, the job of a worker goes to the next one that asks, without waiting
    for the end of its lease. The first result of either counts."""
    run = Run(tmp_path)
    with manual_workers(run, 3) as (lost, other, third):
        first = lost.job()
        lost.session.close()
        wait_until(lambda: f"{lost.name}: lost" in run.log)
        assert other.job() == first
        lost.session = open_session(Connection(role="worker", connect=run.endpoint))
        with lost.session:
            assert lost.renew() == REVOKED
            assert lost.deliver() == KEPT
            assert other.renew() == REVOKED and other.deliver() == DUPLICATE
        assert third.job() != first and third.deliver() == KEPT
        assert len(run.over()) == 2
    assert f"{lost.name}: lost" in run.log


def test_a_reconnected_worker_keeps_its_job(tmp_path: Path) -> None:
    """A worker that reconnects keeps its job if no other has claimed it."""
    run = Run(tmp_path)
    with manual_workers(run, 1) as (one,):
        one.job()
        one.session.close()
        wait_until(lambda: f"{one.name}: lost" in run.log)
        one.session = open_session(Connection(role="worker", connect=run.endpoint))
        with one.session:
            assert one.renew() == RENEWED and one.deliver() == KEPT
            one.job()
            assert one.deliver() == KEPT
        assert len(run.over()) == 2


def test_a_restarted_coordinator_accepts_running_jobs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A restarted coordinator accepts the leases and results of its workers."""
    monkeypatch.setattr(
        remote, "SETTLING_S", PATIENCE_S
    )  # no job may be assigned before both have reported
    run = Run(tmp_path)
    with manual_workers(run, 2) as (one, other):
        names = {one.job(), other.job()}
        run.kill()
        assert run.over() == {}
        run = Run(tmp_path, resumed=True)
        assert one.renew() == RENEWED
        assert one.deliver() == KEPT and other.deliver() == KEPT
        assert set(run.over()) == names


def test_attempts_are_bounded_and_leaving_is_not_an_attempt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A scenario crashes after two ended processes or eight lost workers; handing a job back costs
    no attempt."""
    run = Run(tmp_path)
    with manual_workers(run, 1) as (one,):
        poison = one.job()
        for _ in range(ATTEMPTS + 1):
            assert one.fail(AttemptFailure("handed_back")) == KEPT
            assert one.job() == poison
        for _ in range(ATTEMPTS):
            assert one.job() == poison
            one.fail()
        unlucky = one.job()
        assert unlucky != poison
        for losses in range(1, LOSSES):
            with manual_workers(run, 1) as (another,):
                one.session.close()
                assert another.job() == unlucky
            wait_until(lambda losses=losses: run.log.count("lost, with") > losses)
        records = run.over()
    assert (
        records[poison].status == "crashed"
        and "killed by SIGKILL, 2 times" in records[poison].reason
    )
    assert (
        records[unlucky].status == "crashed"
        and f"was lost, {LOSSES} times" in records[unlucky].reason
    )


def test_attempts_are_counted_across_coordinators(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Attempts of a scenario count across a restart of the coordinator."""
    monkeypatch.setattr(remote, "SETTLING_S", 0.0)  # no other worker exists
    run = Run(tmp_path)
    with manual_workers(run, 1) as (one,):
        poison = one.job()
        one.fail()
        assert one.job() == poison
        run.kill()
        assert run.over() == {}
        run = Run(tmp_path, resumed=True)
        assert one.job() == poison
        one.fail()
        assert one.job() != poison and one.deliver() == KEPT
        records = run.over()
    assert (
        records[poison].status == "crashed"
        and "killed by SIGKILL, 2 times" in records[poison].reason
    )


def test_malformed_and_foreign_messages_are_refused(tmp_path: Path) -> None:
    """Malformed, oversized and foreign messages are refused with a reason and change nothing."""
    run = Run(tmp_path)
    with manual_workers(run, 2) as (one, hostile):
        name = one.job()
        for act in ("claim", "report"):
            for payload in GARBAGE:
                with pytest.raises(EngineError, match="not a"):
                    hostile.session.query(keys.job(hostile.run, act), payload, timeout_s=PATIENCE_S)
        with pytest.raises(EngineError, match="more than a message may have"):
            hostile.session.query(
                keys.job(hostile.run, "report"), bytes((15 << 20) + 5000), timeout_s=PATIENCE_S
            )
        with pytest.raises(EngineError, match="ask for exactly"):
            hostile.session.query("cosim/*/jobs/claim", b"", timeout_s=PATIENCE_S)
        with pytest.raises(TimeoutError):
            hostile.session.query(keys.job("another-run", "claim"), b"", timeout_s=0.2)
        for other in ({"libsumo": "0.1"}, {"metric schema": "0"}):
            reply = hostile.claim(**other)
            words = " ".join(*other.items())
            assert (
                isinstance(reply, Reply)
                and reply.kind == "turned_away"
                and f"{words} in place of" in reply.why
            )
        with pytest.raises(EngineError, match="damaged on its way"):
            hostile.report(**one.result() | {"digest": "0"})
        scenario = SUITE.scenarios[0]
        foreign_record = changed(
            Record.begun(scenario, DRIVER.manifest, SPEC.setup), suite_hash="another suite"
        )
        reply = hostile.deliver(scenario_id=name, record=foreign_record)
        assert (
            isinstance(reply, Reply) and reply.kind == "turned_away" and "another run" in reply.why
        )
        unknown = msgspec.structs.replace(one.result()["done"], scenario="../../../etc")
        assert (
            hostile.report(
                scenario="../../../etc", lease=77, done=unknown, digest=digest_of(unknown)
            )
            == REFUSED
        )
        hostile.lease = 5
        hostile.scenario = name
        assert hostile.renew() == REVOKED and hostile.fail() == KEPT
        assert one.status().refused > 10 and one.status().finished == 0
        assert one.renew() == RENEWED and one.deliver() == KEPT
        one.job()
        assert one.deliver() == KEPT
        assert len(run.over()) == 2


def test_a_result_that_cannot_be_written_is_not_acknowledged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A full disk ends the run, and a resumed run accepts the same result."""

    def full(self: RunFolder, record: Record, *data: bytes) -> None:
        raise MachineError("cannot be written: no space left on device")

    monkeypatch.setattr(remote, "SETTLING_S", 0.0)  # no other worker exists
    run = Run(tmp_path)
    with manual_workers(run, 1) as (one,):
        one.job()
        with monkeypatch.context() as patch:
            patch.setattr(RunFolder, "write_episode", full)
            with pytest.raises(TimeoutError):
                one.session.query(
                    keys.job(one.run, "report"), one.payload(**one.result()), timeout_s=0.5
                )
            assert run.over() == {} and "no space left" in str(run.error)
        run = Run(tmp_path, resumed=True)
        assert one.deliver() == KEPT
        one.job()
        assert one.deliver() == KEPT
        assert len(run.over()) == 2


def test_a_missing_map_is_sent_to_workers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A missing map is sent in parts and stored only if its hash is right."""
    coordinator_cache, worker_cache = tmp_path / "coordinator", tmp_path / "worker"
    where = CityMap(
        map="mine",
        net_hash=net_xml_hash(net := b"<net>" + secrets.token_hex(3 << 20).encode() + b"</net>"),
    )
    (coordinator_cache / "maps" / "mine").mkdir(parents=True)
    (coordinator_cache / "maps" / "mine" / "net.xml").write_bytes(net)
    (coordinator_cache / "maps" / "mine" / "about.json").write_bytes(b"{}")

    def fetched(expected: str) -> None:
        monkeypatch.setenv("COSIM_CACHE", str(coordinator_cache))
        nets = RunMaps()
        parts = 0
        last = False
        digest = nets.hash_of(where)
        wanted = MapDownload(where, expected)
        while not last:
            monkeypatch.setenv("COSIM_CACHE", str(coordinator_cache))
            part = nets.part(digest, wanted.request)
            monkeypatch.setenv("COSIM_CACHE", str(worker_cache))
            last = wanted.take(part)
            parts = parts + 1
        assert parts > 1
        with pytest.raises(EngineError, match="has no map 'another'"):
            nets.part("another", wanted.request)

    with pytest.raises(EngineError, match=f"came with hash {where.net_hash} in place of wrong"):
        fetched("wrong")
    assert is_missing(where) and not (worker_cache / "maps" / "mine").exists()
    fetched(where.net_hash)
    assert (
        not is_missing(where) and (worker_cache / "maps" / "mine" / "net.xml").read_bytes() == net
    )


def test_status_shows_lost_silent_and_working_workers(
    cosim: Cosim, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`cosim status` shows them from the run folder or the address."""
    monkeypatch.setattr(status, "SILENT_S", 0.0)
    monkeypatch.setattr(status, "_WRITTEN_EVERY_S", 0.0)
    run = Run(tmp_path)
    with manual_workers(run, 3) as (lost, one, silent):
        lost.job()
        name = one.job()
        lost.session.close()
        wait_until(lambda: f"{lost.name}: lost" in run.log)
        silent.job()
        wait_until(
            lambda: (
                (run.folder / "status.json").exists()
                and silent.name in (run.folder / "status.json").read_text()
            )
        )
        output = cosim("status", str(run.folder)).stdout
        assert output.startswith(
            "s, policy stop: 0 of 2 episodes; 1 lost with their workers and run again"
        )
        lines = {line.split()[0]: line.split() for line in output.splitlines() if line.strip()}
        assert lines[lost.name][1] == "lost" and lines[silent.name][1] == "silent"
        monkeypatch.setattr(status, "SILENT_S", PATIENCE_S)
        assert one.renew() == RENEWED
        output = cosim("status", "--connect", run.endpoint).stdout
        lines = {line.split()[0]: line.split() for line in output.splitlines() if line.strip()}
        assert lines[one.name][1] == "working" and lines[one.name][-5:] == [
            name,
            "at",
            "1",
            "s,",
            "50%",
        ]
        assert one.deliver() == KEPT and silent.deliver() == KEPT
        run.over()
    monkeypatch.setattr(settings, "CONNECTS_WITHIN_S", 0.1)
    assert cosim("status", str(run.folder)).stdout == "s, policy stop: 2 of 2 episodes\n"
    assert (
        result := cosim("status", "--connect", run.endpoint)
    ).returncode == 3 and "no hub answers" in result.stderr
    assert (result := cosim("status")).returncode == 2 and "name a run folder" in result.stderr
