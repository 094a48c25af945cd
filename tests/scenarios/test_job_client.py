"""What a worker reports to the coordinator about the jobs of one slot, with a fake process and
without a session."""

from __future__ import annotations

import threading
from pathlib import Path

import msgspec
import pytest

from cosim.core.errors import MachineError, UsageError
from cosim.policies.load import load_policy
from cosim.spec.connection import Connection
from scenarios.ipc.messages import Done, EpisodeProgress, FrameDrawn, Hello, Job, Message, Ready
from scenarios.runs import job_client, zenoh_worker
from scenarios.runs.job_client import CoordinatorRequest, JobClient, WorkerIdentity
from scenarios.runs.protocol import Assignment, Claim, CoordinatorReply, Reply, Report, encode_reply
from scenarios.runs.zenoh_worker import work
from tests.conftest import wait_until
from tests.scenarios.test_many_workers import Run
from tests.scenarios.test_pool import SCENARIO, Fake

IDENTITY = WorkerIdentity(
    "w", "here", {"source": "s"}, Connection(role="worker", connect="unixsock-stream/nowhere")
)
DRIVER = load_policy("stop")
HELLO = Hello("stop", DRIVER.manifest, DRIVER.source_hash)
JOB = Assignment(7, Job(SCENARIO))


class Process(Fake):
    """A process that says what a test hands it."""

    def says(self, *messages: Message) -> None:
        self._messages = messages


class Bench:
    """A client whose requests a test answers; `process` is the one that it has started last."""

    def __init__(self, folder: Path) -> None:
        self.processes: list[Process] = []
        self.client = JobClient("r", 0, IDENTITY, folder, self._start)
        self.now_s = 0.0

    def _start(self, log: Path, hello: Hello) -> Process:
        self.processes.append(Process(Ready()))
        return self.processes[-1]

    def request(self) -> CoordinatorRequest:
        """The one request that is due within a second."""
        self.client.poll()
        (request,) = self.client.requests(float("inf"))
        return request

    def report(self) -> tuple[CoordinatorRequest, Report]:
        request = self.request()
        assert request.act == "report"
        return request, msgspec.msgpack.decode(request.payload, type=Report)

    def answer(self, request: CoordinatorRequest, reply: CoordinatorReply | None) -> None:
        self.client.answered(request, None if reply is None else encode_reply(reply), "")

    def assigned(self) -> Process:
        """Claim a job, and return the process that runs it."""
        for reply in (HELLO, JOB):
            request = self.request()
            assert isinstance(msgspec.msgpack.decode(request.payload, type=Claim), Claim)
            self.answer(request, reply)
        return self.processes[-1]


def test_a_result_is_sent_until_it_is_acknowledged(tmp_path: Path) -> None:
    """Progress renews the lease; a result that gets no reply is sent again; afterwards the next job
    is claimed."""
    bench = Bench(tmp_path)
    process = bench.assigned()
    process.says(EpisodeProgress("s-0", 1.0, 1.0, 0))
    request, report = bench.report()
    assert (
        report.said == (EpisodeProgress("s-0", 1.0, 1.0, 0),)
        and report.done is None
        and report.lease == 7
    )
    bench.answer(request, Reply("renewed"))
    done = Done("s-0", "done", b"record", b"log")
    process.says(done)
    for reply in (None, None, Reply("kept")):
        request, report = bench.report()
        assert report.done == done and report.said == () and bench.client.has_unsent
        bench.answer(request, reply)
    assert bench.request().act == "claim" and not bench.client.has_unsent and not process.killed


def test_a_revoked_job_is_dropped_and_its_process_replaced(tmp_path: Path) -> None:
    """The job of another worker is not run to its end; a result that is ready all the same is
    delivered."""
    bench = Bench(tmp_path)
    process = bench.assigned()
    bench.answer(bench.report()[0], Reply("revoked"))
    assert process.killed and bench.request().act == "claim" and len(bench.processes) == 2
    bench = Bench(tmp_path)
    process = bench.assigned()
    request, _ = bench.report()
    process.says(Done("s-0", "done", b"record"))
    bench.client.poll()
    bench.answer(request, Reply("revoked"))
    assert bench.report()[1].done is not None and not process.killed


def test_frames_go_in_parts_and_before_the_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """None is lost or sent out of order, whatever a message holds; a result that no message holds
    is a failure."""
    monkeypatch.setattr(job_client, "_FRAMES_BYTES", 10)
    bench = Bench(tmp_path)
    frames = [FrameDrawn("s-0", tick, bytes(6)) for tick in range(3)]
    bench.assigned().says(*frames, Done("s-0", "done", b"record"))
    said = []
    while True:
        request, report = bench.report()
        said += report.said
        if report.done is not None:
            break
        bench.answer(request, Reply("renewed"))
    assert said == frames
    monkeypatch.setattr(job_client, "_RESULT_BYTES", 3)
    bench = Bench(tmp_path)
    bench.assigned().says(Done("s-0", "done", b"record"))
    _, report = bench.report()
    assert report.fault == "engine_failed" and "more than can be sent" in report.why


def test_a_worker_that_leaves_hands_its_job_back(tmp_path: Path) -> None:
    """Once, with what its process has printed; then it requests nothing."""
    bench = Bench(tmp_path)
    process = bench.assigned()
    (tmp_path / "0.log").write_text("printed")
    bench.client.release()
    request, report = bench.report()
    assert process.killed and report.fault == "handed_back" and report.printed == b"printed"
    bench.answer(request, Reply("kept"))
    assert bench.client.requests(float("inf")) == []


def test_a_worker_that_is_turned_away_ends(tmp_path: Path) -> None:
    """With the reason, whether its claim or its report is refused."""
    bench = Bench(tmp_path)
    with pytest.raises(UsageError, match="another installation"):
        bench.answer(bench.request(), Reply("turned_away", "another installation"))
    bench = Bench(tmp_path)
    bench.assigned()
    with pytest.raises(UsageError, match="another run"):
        bench.answer(bench.report()[0], Reply("turned_away", "another run"))


@pytest.mark.engine
def test_a_worker_for_one_run_does_not_wait_for_ever(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It ends, and says why, when it was cut off from a run that is over, and when none was ever
    there."""
    monkeypatch.setattr(zenoh_worker, "_LOOK_AFTER_S", 0.0)
    run = Run(tmp_path)
    said = list[str]()

    def over_unheard() -> None:
        wait_until(lambda: ": is connected" in run.log)
        monkeypatch.setattr(zenoh_worker, "GIVEN_UP_S", 0.5)
        run.kill()

    other = threading.Thread(target=over_unheard)
    other.start()
    at = Connection(role="worker", connect=run.endpoint)
    with pytest.raises(MachineError, match=r"no run replied at .* for 0\.5 s: is it over\?"):
        work(at, 1, lambda line, *_: said.append(line), once=True)
    other.join()
    assert any(line.startswith("works for run") for line in said)
    run.over()
    with pytest.raises(MachineError, match="no run replied"):
        work(at, 1, lambda line, *_: said.append(line), once=True)
