"""Reports of a worker to the coordinator about the jobs of one slot, with a fake process and
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
from tests.scenarios.test_pool import SCENARIO, FakeProcess

IDENTITY = WorkerIdentity(
    "w", "here", {"source": "s"}, Connection(role="worker", connect="unixsock-stream/nowhere")
)
DRIVER = load_policy("stop")
HELLO = Hello("stop", DRIVER.manifest, DRIVER.source_hash)
JOB = Assignment(7, Job(SCENARIO))


class ScriptedProcess(FakeProcess):
    """A process with messages that a test sets."""

    def sends(self, *messages: Message) -> None:
        self._messages = messages


class ClientBench:
    """A client whose requests a test answers; `process` is the last one that it started."""

    def __init__(self, folder: Path) -> None:
        self.processes: list[ScriptedProcess] = []
        self.client = JobClient("r", 0, IDENTITY, folder, self._start)
        self.now_s = 0.0

    def _start(self, log: Path, hello: Hello) -> ScriptedProcess:
        self.processes.append(ScriptedProcess(Ready()))
        return self.processes[-1]

    def request(self) -> CoordinatorRequest:
        """Return the one request that is due within a second."""
        self.client.poll()
        (request,) = self.client.requests(float("inf"))
        return request

    def report(self) -> tuple[CoordinatorRequest, Report]:
        request = self.request()
        assert request.act == "report"
        return request, msgspec.msgpack.decode(request.payload, type=Report)

    def answer(self, request: CoordinatorRequest, reply: CoordinatorReply | None) -> None:
        self.client.answered(request, None if reply is None else encode_reply(reply), "")

    def assigned(self) -> ScriptedProcess:
        """Claim a job, and return the process that runs it."""
        for reply in (HELLO, JOB):
            request = self.request()
            assert isinstance(msgspec.msgpack.decode(request.payload, type=Claim), Claim)
            self.answer(request, reply)
        return self.processes[-1]


def test_a_result_is_sent_until_it_is_acknowledged(tmp_path: Path) -> None:
    """Progress renews the lease, a result without a reply is sent again, and then the next job is
    claimed."""
    bench = ClientBench(tmp_path)
    process = bench.assigned()
    process.sends(EpisodeProgress("s-0", 1.0, 1.0, 0))
    request, report = bench.report()
    assert (
        report.said == (EpisodeProgress("s-0", 1.0, 1.0, 0),)
        and report.done is None
        and report.lease == 7
    )
    bench.answer(request, Reply("renewed"))
    done = Done("s-0", "done", b"record", b"log")
    process.sends(done)
    for reply in (None, None, Reply("kept")):
        request, report = bench.report()
        assert report.done == done and report.said == () and bench.client.has_unsent
        bench.answer(request, reply)
    assert bench.request().act == "claim" and not bench.client.has_unsent and not process.killed


def test_a_revoked_job_is_dropped_and_its_process_replaced(tmp_path: Path) -> None:
    """A job that was reassigned is stopped; a result that is ready anyway is delivered."""
    bench = ClientBench(tmp_path)
    process = bench.assigned()
    bench.answer(bench.report()[0], Reply("revoked"))
    assert process.killed and bench.request().act == "claim" and len(bench.processes) == 2
    bench = ClientBench(tmp_path)
    process = bench.assigned()
    request, _ = bench.report()
    process.sends(Done("s-0", "done", b"record"))
    bench.client.poll()
    bench.answer(request, Reply("revoked"))
    assert bench.report()[1].done is not None and not process.killed


def test_frames_are_sent_in_parts_before_the_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No frame is lost or out of order at any message size, and a result larger than a message is a
    failure."""
    monkeypatch.setattr(job_client, "_FRAMES_BYTES", 10)
    bench = ClientBench(tmp_path)
    frames = [FrameDrawn("s-0", tick, bytes(6)) for tick in range(3)]
    bench.assigned().sends(*frames, Done("s-0", "done", b"record"))
    sent = []
    while True:
        request, report = bench.report()
        sent += report.said
        if report.done is not None:
            break
        bench.answer(request, Reply("renewed"))
    assert sent == frames
    monkeypatch.setattr(job_client, "_RESULT_BYTES", 3)
    bench = ClientBench(tmp_path)
    bench.assigned().sends(Done("s-0", "done", b"record"))
    _, report = bench.report()
    assert report.fault == "engine_failed" and "more than can be sent" in report.why


def test_a_worker_that_leaves_hands_its_job_back(tmp_path: Path) -> None:
    """It hands the job back once, with the output of its process, and then requests nothing."""
    bench = ClientBench(tmp_path)
    process = bench.assigned()
    (tmp_path / "0.log").write_text("printed")
    bench.client.release()
    request, report = bench.report()
    assert process.killed and report.fault == "handed_back" and report.printed == b"printed"
    bench.answer(request, Reply("kept"))
    assert bench.client.requests(float("inf")) == []


def test_a_rejected_worker_ends(tmp_path: Path) -> None:
    """It ends with the reason, whether its claim or its report is rejected."""
    bench = ClientBench(tmp_path)
    with pytest.raises(UsageError, match="another installation"):
        bench.answer(bench.request(), Reply("turned_away", "another installation"))
    bench = ClientBench(tmp_path)
    bench.assigned()
    with pytest.raises(UsageError, match="another run"):
        bench.answer(bench.report()[0], Reply("turned_away", "another run"))


@pytest.mark.engine
def test_a_worker_for_one_run_does_not_wait_for_ever(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It ends with the reason when it was disconnected from a finished run, and when there was no
    run."""
    monkeypatch.setattr(zenoh_worker, "_LOOK_AFTER_S", 0.0)
    run = Run(tmp_path)
    lines = list[str]()

    def end_run_unnoticed() -> None:
        wait_until(lambda: ": is connected" in run.log)
        monkeypatch.setattr(zenoh_worker, "GIVEN_UP_S", 0.5)
        run.kill()

    killer = threading.Thread(target=end_run_unnoticed)
    killer.start()
    connection = Connection(role="worker", connect=run.endpoint)
    with pytest.raises(MachineError, match=r"no run replied at .* for 0\.5 s: is it over\?"):
        work(connection, 1, lambda line, *_: lines.append(line), once=True)
    killer.join()
    assert any(line.startswith("works for run") for line in lines)
    run.over()
    with pytest.raises(MachineError, match="no run replied"):
        work(connection, 1, lambda line, *_: lines.append(line), once=True)
