"""Environment processes that cannot start, die or do not respond, and what is reported about
them."""

from __future__ import annotations

import os
import signal
import socket
import time
from pathlib import Path

import msgspec
import pytest

from cosim.core.errors import MachineError
from cosim.core.framing import MessageSocket
from cosim.episode.policy_caller import PolicyCall
from cosim.policies.load import load_policy
from cosim.results.record import Record
from cosim.results.run_folder import RunFolder, read_records
from cosim.spec.options import RendererAddress
from cosim.spec.scenario import City, Scenario, Suite, write_suite
from scenarios.ipc.child_process import ChildProcess
from scenarios.ipc.command_log import Driven
from scenarios.ipc.deadlines import Patience, PendingCall, PendingCallMemory
from scenarios.ipc.messages import (
    Done,
    EpisodeProgress,
    FrameDrawn,
    Hello,
    Job,
    LostRenderer,
    Message,
    MessageHandler,
    Ready,
    Repeat,
    Repeated,
)
from scenarios.ipc.supervisor import BoundedLog
from scenarios.runs import environment_slot, pool
from scenarios.runs.environment_slot import EnvironmentSlot
from scenarios.runs.shared_renderer import RendererEnd, SharedRenderer
from scenarios.tools.verify.doctor import small_scenario
from tests.conftest import PATIENCE_S, Cosim, seed_in_order, still_runs
from tests.run_specs import record_of, spec_of
from tests.support.nested import FLOOD

MODULES = {
    "libsumo": "raise ImportError('libX11.so.6: cannot open shared object file: No such file or "
    "directory')",
    "mine": """
import os, sys, time
from pathlib import Path
from cosim.spec.manifest import Manifest
from cosim.core.state import STILL
IN_A_WORKER = sys.argv[:1] == ["-c"]

class Mine:
    manifest = Manifest("mine", camera=None)
    def reset(self, episode_id, seed): pass
    def act(self, observation): return STILL
class Exits(Mine):
    def __init__(self):
        if IN_A_WORKER: sys.exit("no GPU left")
class Hangs(Mine):
    def __init__(self):
        if IN_A_WORKER: time.sleep(3600)
class Changes(Mine):
    manifest = Manifest("mine", camera=None, version=str(os.getpid()))
class Edits(Mine):
    def __init__(self):
        if IN_A_WORKER: Path(__file__).open("a").write("# edited")
""",
}
CANNOT_BEGIN = {
    "Exits": (2, "error: policy 'mine:Exits' cannot be made: SystemExit: no GPU left"),
    "Hangs": (
        2,
        "error: policy 'mine' gave no answer for 1 s while it was loaded in an environment process",
    ),
    "Changes": (2, "error: policy 'mine:Changes' has another manifest in each process"),
    "Edits": (
        2,
        "error: policy 'mine:Edits' was edited during the run: begin another run",
    ),
}


@pytest.fixture
def policy_folder(tmp_path: Path) -> Path:
    """Return a folder with the policies."""
    (tmp_path / "mine.py").write_text(MODULES["mine"])
    return tmp_path


def run_policy(
    cosim: Cosim, policy_folder: Path, name: str, suite: str = "reactive"
) -> tuple[int, str]:
    """Run a policy that cannot start, and return exit code and error output; no episode may have a
    record."""
    patience_s = "1" if name == "Hangs" else str(PATIENCE_S)
    words = (
        "--policy",
        f"mine:{name}",
        "--episodes",
        "3",
        "--start-timeout",
        patience_s,
        "--out",
        "run",
    )
    done = cosim("run", suite, *words, cwd=policy_folder)
    assert "Traceback" not in done.stderr and not list(
        policy_folder.glob("run/episodes/*/record.json")
    )
    assert "crashed" not in done.stdout + done.stderr
    return done.returncode, done.stderr


@pytest.mark.engine
@pytest.mark.parametrize("name", CANNOT_BEGIN)
def test_a_policy_that_a_process_cannot_load_ends_the_run(
    cosim: Cosim, policy_folder: Path, name: str
) -> None:
    """A policy that loads at the start of the run but not in its processes is reported once, with
    exit code 2 and without crashed episodes."""
    code, errors = run_policy(cosim, policy_folder, name)
    assert (code, errors.count("error:")) == (2, 1) and CANNOT_BEGIN[name][1] in errors


@pytest.mark.engine
def test_an_engine_that_cannot_be_imported_ends_the_run(
    fresh_cosim: Cosim, policy_folder: Path
) -> None:
    """The missing library is reported once, with exit code 3."""
    (policy_folder / "libsumo.py").write_text(MODULES["libsumo"])
    write_suite(
        Suite(name="walked", version="1", scenarios=(small_scenario(),)),
        policy_folder / "walked.json",
    )
    path = os.pathsep.join(
        [str(policy_folder), os.environ.get("PYTHONPATH", str(Path(__file__).parents[2]))]
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", path)
        code, errors = run_policy(fresh_cosim, policy_folder, "Mine", "walked.json")
    assert (code, errors.count("error:")) == (3, 1)
    assert "SUMO cannot be loaded: libX11.so.6: cannot open shared object" in errors


@pytest.mark.parametrize("printed", [0, 10, 100, 101, 150, 200, 201, 1000])
def test_a_log_keeps_its_beginning_and_its_end(tmp_path: Path, printed: int) -> None:
    """Short logs are complete; longer ones have the first and the last 100 bytes or more, in
    order."""
    text = bytes(i % 251 for i in range(printed))
    with (tmp_path / "log").open("wb") as file:
        log = BoundedLog(file.fileno(), first=100, last=100)
        for start in range(0, printed, 30):
            log.write(text[start : start + 30])
        log.close()
    stored = (tmp_path / "log").read_bytes()
    if printed <= 200:
        assert stored == text
        return
    first, gap, last = stored.partition(b" bytes were printed here and left out]\n")
    first, _, left_out = first.rpartition(b"\n[")
    assert text.startswith(first or stored) and text.endswith(last) and len(stored) < 300
    assert not gap or (len(first), len(first) + int(left_out) + len(last)) == (100, printed)
    assert not gap or 100 <= len(last) < 130


@pytest.mark.parametrize("ended", ["worker", "supervisor"])
def test_a_nested_supervisor_stores_the_end_of_its_log(tmp_path: Path, ended: str) -> None:
    """The last output is stored whether the worker that started it is killed or the run ends."""
    log = tmp_path / "log"
    process = ChildProcess(log, "tests.support.nested:starts_another", "worker")
    worker = int(process.wire.receive(PATIENCE_S))
    if ended == "worker":
        os.kill(worker, signal.SIGKILL)
        process.end()
    else:
        process.kill()
    written = log.read_bytes()
    assert b"the flood begins" in written and b"the flood ends" in written
    assert len(written) < len(FLOOD)
    assert not still_runs(worker)


@pytest.mark.parametrize(
    ("doing", "answer_s", "start_s", "overdue"),
    [
        ("act", 0.0, 1e9, True),
        ("act", 1e9, 0.0, False),
        ("first act", 0.0, 1e9, False),
        ("first act", 1e9, 0.0, True),
        ("reset", 1e9, 0.0, True),
        ("loading", 1e9, 0.0, True),
    ],
)
def test_a_first_answer_may_take_longer(
    doing: PolicyCall, answer_s: float, start_s: float, overdue: bool
) -> None:
    """The first answer has its own timeout, and no timeout runs before a query."""
    memory = PendingCallMemory.new()
    assert memory.pending_call is None
    memory.starts(doing, 64)
    time.sleep(0.001)
    pending_call = memory.pending_call
    assert pending_call is not None and pending_call.overdue(Patience(answer_s, start_s)) is overdue
    assert pending_call.when == ("act at 3.20 s" if "act" in doing else doing)
    memory.stops()
    assert memory.pending_call is None
    memory.close()


class FakeProcess:
    """A process that sends prepared messages, and then stays silent or ends."""

    log = "worker-0.log"
    kind = "environment"
    descriptor = None

    def __init__(
        self,
        *messages: Message,
        asks: PolicyCall | None = None,
        ends: bool = False,
        in_engine: bool = False,
        driven: Driven | None = None,
    ) -> None:
        self.in_engine = in_engine
        self.in_policy = False
        self.driven = driven
        self.progress = (0, False)
        self.repeats: Repeat | None = None
        self.pending_call = None if asks is None else PendingCall(time.monotonic(), asks, 64)
        self.killed = False
        self._messages = messages
        self._ends = ends

    def give(self, job: Job) -> None:
        """Ignores the job."""

    def listen(self, handle: MessageHandler) -> bool:
        messages = self._messages
        self._messages = ()
        for message in messages:
            handle(message)
        return not self._ends

    def hang_up(self) -> None:
        """Does nothing."""

    def wake(self) -> None:
        """Does nothing."""

    def kill(self, *, wait: bool = True) -> None:
        self.killed = True

    def end(self) -> str:
        return "the environment process ended with exit code 7"


class FakeTransport:
    """A transport to one slot with prepared processes."""

    def __init__(self, *fakes: FakeProcess) -> None:
        self.waiting = iter(fakes)

    def room(self, busy: int) -> int:
        return 1 - busy

    def unsolicited(self) -> tuple[()]:
        return ()

    def start(self, hello: Hello) -> EnvironmentSlot:
        def start(hello: Hello) -> FakeProcess:
            fake = next(self.waiting)
            fake.repeats = hello.repeat
            return fake

        return EnvironmentSlot(start, hello)

    def wait(self, timeout_s: float) -> None:
        """Returns at once."""


SCENARIO = Scenario(
    id="s-0",
    suite="s",
    place=City(seed=0),
    seed=0,
    start=(0.0, 0.0, 0.0),
    goal=(9.0, 0.0),
    route=((0.0, 0.0), (9.0, 0.0)),
)


def record_by(
    folder: Path, *fakes: FakeProcess, renderer: SharedRenderer | None = None, **named: float
) -> Record:
    """Return the record of one scenario, run by these workers one after the other."""
    (record,) = records_by(folder, (SCENARIO,), *fakes, renderer=renderer, **named)
    return record


def records_by(
    folder: Path,
    scenarios: tuple[Scenario, ...],
    *fakes: FakeProcess,
    renderer: SharedRenderer | None = None,
    **named: float,
) -> list[Record]:
    """Return the records of several scenarios, run by these workers one after the other."""
    transport = FakeTransport(*fakes)
    suite = Suite(name="s", version="1", scenarios=scenarios)
    driver = load_policy("stop")
    spec = spec_of(suite, "stop", seed=seed_in_order(scenarios))
    hello = Hello("stop", driver.manifest, driver.source_hash, patience=Patience(**named))
    with RunFolder.create(folder / "run", spec, suite) as held:
        pool.run_all(
            held, suite.scenarios, hello, transport, handle=lambda _: None, renderer=renderer
        )
        assert next(transport.waiting, None) is None and held.finished_ids() == set(spec.scenarios)
    return sorted(read_records(folder / "run"), key=lambda record: record.scenario.id)


def test_an_engine_that_hangs_is_tried_again(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A process that is silent while its policy has nothing to answer is killed, and the second
    time is a crash."""
    monkeypatch.setattr(environment_slot, "SILENCE_S", 0.0)
    monkeypatch.setattr(environment_slot, "TICK_S", 0.0)
    fakes = (FakeProcess(Ready()), FakeProcess(Ready()))
    record = record_by(tmp_path, *fakes)
    assert (
        record.reason.startswith("the environment process showed no sign of life, 2 times")
        and record.ticks == 0
    )
    assert all(fake.killed for fake in fakes)


def test_a_policy_that_hangs_is_not_tried_again(tmp_path: Path) -> None:
    """The reason names the policy, the timeout, and the call."""
    record = record_by(tmp_path, FakeProcess(Ready(), asks="act"), answer_s=0.0)
    assert record.reason == "policy 'stop' gave no answer for 0 s in act at 3.20 s of s-0"


def test_a_process_may_be_silent_while_its_policy_answers(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Silence ends the process only after the timeout of the policy."""
    monkeypatch.setattr(environment_slot, "SILENCE_S", 0.0)
    monkeypatch.setattr(environment_slot, "TICK_S", 0.0)
    slow = FakeProcess(Ready(), asks="act")
    began = time.monotonic()
    record = record_by(tmp_path, slow, answer_s=0.2)
    assert time.monotonic() - began > 0.2 and "gave no answer for 0.2 s" in record.reason


@pytest.mark.parametrize("damage", ["half", "another"])
def test_a_damaged_record_is_a_crash(tmp_path: Path, damage: str) -> None:
    """A worker that reports an episode as done with half a record, or another episode's, has not
    finished it."""
    other = msgspec.structs.replace(SCENARIO, id="s-1")
    record_bytes = record_of(other, load_policy("stop").manifest).encoded()
    done = Done(
        "s-0", "done", record_bytes[: len(record_bytes) // 2] if damage == "half" else record_bytes
    )
    record = record_by(tmp_path, FakeProcess(Ready(), done))
    assert record.status == "crashed" and record.reason == "its record was damaged when it arrived"


def test_received_records_logs_and_frames_are_written_unchanged(tmp_path: Path) -> None:
    """A worker needs no folder: the run's own process writes the bytes of the record, the log and a
    frame."""
    data = record_of(SCENARIO, load_policy("stop").manifest).encoded()
    log = os.urandom(3_000_000)
    record = record_by(
        tmp_path,
        FakeProcess(Ready(), FrameDrawn("s-0", 5, b"png"), Done("s-0", "crashed", data, log)),
    )
    folder = tmp_path / "run" / "episodes" / "s-0"
    assert (folder / "trajectory.npz").read_bytes() == log and (
        folder / "record.json"
    ).read_bytes() == data
    assert (folder / "frames" / "000005.png").read_bytes() == b"png" and record.encoded() == data
    assert not list((tmp_path / "run").rglob("*.part"))


@pytest.mark.parametrize(
    ("in_engine", "status"),
    [(True, "invalid"), (False, "crashed")],
    ids=["a fault of an engine", "anything else"],
)
def test_an_ended_process_is_invalid_only_after_a_fault_of_an_engine(
    tmp_path: Path, in_engine: bool, status: str
) -> None:
    """Two faults of compiled code outside of policy calls make the episode invalid; any other end
    of a process is a crash."""
    dies = [
        FakeProcess(Ready(), EpisodeProgress("s-0", 1.0, 1.0, 0), ends=True, in_engine=in_engine)
        for _ in range(2)
    ]
    (record,) = records_by(tmp_path, (SCENARIO,), *dies)
    assert record.status == status and record.reason.startswith(
        "the environment process ended with exit code 7, 2"
    )


COMMANDS = b"commands up to the failure"
DIED = "the environment process ended with exit code 7, 2 times: the"


@pytest.mark.parametrize("in_engine", [True, False], ids=["fault", "exit"])
@pytest.mark.parametrize(
    ("replays", "status", "reason"),
    [
        ([(7, "fault")], "invalid", f"{DIED} simulator is at fault"),
        ([(8, "")], "crashed", f"{DIED} policy is at fault"),
        ([(6, "fault"), (7, "fault")], "invalid", f"{DIED} simulator is at fault"),
        ([(6, "fault"), (8, "")], "crashed", f"{DIED} policy is at fault"),
        (
            [(6, "fault"), (6, "fault")],
            "crashed",
            f"{DIED} simulator fails without the policy, too, but",
        ),
        ([(7, "killed"), (8, "")], "crashed", f"{DIED} policy is at fault"),
        ([(7, "killed"), (7, "killed")], "invalid", f"{DIED} simulator is at fault"),
    ],
    ids=[
        "dies-there",
        "survives",
        "dies-before-then-there",
        "dies-before-then-survives",
        "before",
        "killed-there-then-survives",
        "killed-there-twice",
    ],
)
def test_a_replay_without_the_policy_decides_who_ended_a_process(
    tmp_path: Path, replays: list[tuple[int, str]], status: str, reason: str, in_engine: bool
) -> None:
    """The commands of the last attempt are simulated again: death at the same tick is the
    simulator's fault, survival the policy's. A killed replay counts only if a second one dies
    there, too."""
    driven = Driven(7, False, COMMANDS)
    record = record_of(SCENARIO, load_policy("stop").manifest)
    again = [
        FakeProcess(ends=True, in_engine=end == "fault", driven=Driven(ticks))
        if end
        else FakeProcess(Repeated("s-0", msgspec.structs.replace(record, ticks=ticks).encoded()))
        for ticks, end in replays
    ]
    dies = [
        FakeProcess(
            Ready(),
            EpisodeProgress("s-0", 1.0, 1.0, 0),
            ends=True,
            in_engine=in_engine,
            driven=driven,
        )
        for _ in range(2)
    ]
    found = record_by(tmp_path, *dies, *again)
    assert found.status == status and found.reason.startswith(reason), found.reason
    assert [fake.repeats for fake in dies] == [None, None]
    assert all(fake.repeats.commands == COMMANDS for fake in again if fake.repeats is not None)
    assert None not in [fake.repeats for fake in again]
    assert found.ticks == (0 if replays[-1][1] else 8) and found.ended is None


@pytest.mark.parametrize(
    ("error", "ticks", "status"),
    [("SUMO failed", 7, "invalid"), ("SUMO failed", 8, "crashed"), ("", 9, "crashed")],
    ids=["fails-there", "fails-later", "survives"],
)
def test_an_error_that_the_policy_may_have_caused_is_replayed(
    tmp_path: Path, error: str, ticks: int, status: str
) -> None:
    """A reported engine error is the simulator's only if it occurs again without the policy."""
    failed = msgspec.structs.replace(
        record_of(SCENARIO, load_policy("stop").manifest), status="invalid", reason="gone"
    ).encoded()
    done = Done("s-0", "invalid", failed, again=True)
    replay = FakeProcess(Repeated("s-0", failed, error), driven=Driven(ticks))
    twice = OneMessageAtATime(Ready(), done, done)
    twice.driven = Driven(7, False, COMMANDS)
    record = record_by(tmp_path, twice, replay)
    assert record.status == status and record.reason.startswith("gone, 2 times: the"), record.reason


def test_an_engine_that_fails_is_tried_again(tmp_path: Path) -> None:
    """One error is ignored; after the second the episode is invalid, with its reason."""
    failed = msgspec.structs.replace(
        record_of(SCENARIO, load_policy("stop").manifest), status="invalid", reason="gone"
    )
    fine = Done("s-0", "done", msgspec.structs.replace(failed, status="done", reason="").encoded())
    once = OneMessageAtATime(Ready(), Done("s-0", "invalid", failed.encoded(), again=True), fine)
    assert records_by(tmp_path / "once", (SCENARIO,), once)[0].status == "done"
    twice = OneMessageAtATime(Ready(), *[Done("s-0", "invalid", failed.encoded(), again=True)] * 2)
    (record,) = records_by(tmp_path / "twice", (SCENARIO,), twice)
    assert (
        record.status == "invalid" and record.reason == "gone, 2 times; see logs/ in the run folder"
    )


class DiesWhenDone(FakeProcess):
    """A process that ends after its last message."""

    def listen(self, handle: MessageHandler) -> bool:
        left = bool(self._messages)
        super().listen(handle)
        return left


def test_a_process_that_died_between_episodes_costs_no_attempt(tmp_path: Path) -> None:
    """An episode that was given to a process just before its end was noticed has both of its
    attempts left."""
    manifest = load_policy("stop").manifest
    second = msgspec.structs.replace(SCENARIO, id="s-1")
    done, again = (
        Done(
            one.id,
            "done",
            msgspec.structs.replace(record_of(one, manifest), status="invalid").encoded(),
        )
        for one in (SCENARIO, second)
    )
    fakes = (
        DiesWhenDone(Ready(), done),
        FakeProcess(Ready(), ends=True),
        FakeProcess(Ready(), again),
    )
    assert [one.status for one in records_by(tmp_path, (SCENARIO, second), *fakes)] == [
        "invalid",
        "invalid",
    ]


def test_an_episode_finished_before_its_process_died_counts(tmp_path: Path) -> None:
    """A process that dies after sending its record has finished the episode; one that dies before
    has not, and the episode is run again."""
    second = msgspec.structs.replace(SCENARIO, id="s-1")
    first_done, second_done = (
        Done(
            one.id,
            "done",
            msgspec.structs.replace(
                record_of(one, load_policy("stop").manifest), ticks=9
            ).encoded(),
        )
        for one in (SCENARIO, second)
    )
    fakes = (
        FakeProcess(Ready(), first_done, ends=True),
        FakeProcess(Ready(), ends=True),
        FakeProcess(Ready(), second_done),
    )
    assert [record.ticks for record in records_by(tmp_path, (SCENARIO, second), *fakes)] == [9, 9]


class EndedRenderer(SharedRenderer):
    """A renderer with a prepared end; None: it continues."""

    def __init__(self, end: RendererEnd | None) -> None:
        self.at = RendererAddress(address="nowhere", asks=True)
        self.end = end

    def check(self) -> None:
        """Does nothing."""

    def end_of(self, number: int) -> RendererEnd | None:
        return self.end

    def episode_ended(self) -> None:
        """Does nothing."""


HUNG = RendererEnd("the renderer process was ended", 60.0)
RENDERER_DIED = RendererEnd("the renderer process ended with exit code 7")


@pytest.mark.parametrize(
    ("end", "pending_call", "lost", "reason"),
    [
        (RENDERER_DIED, "", 5, ""),
        (RENDERER_DIED, "act at 3.20 s", 1, ""),
        (
            RENDERER_DIED,
            "act at 3.20 s",
            2,
            "the renderer process ended with exit code 7, 2 times; see logs/ in the run folder",
        ),
        (HUNG, "", 5, ""),
        (HUNG, "act at 3.20 s", 1, "policy 'stop' gave no answer for 60 s in act at 3.20 s of s-0"),
        (
            None,
            "",
            2,
            "the environment process lost its connection to the shared renderer, 2 times; "
            "see logs/ in the ",
        ),
    ],
    ids=[
        "died",
        "died-when-asked",
        "died-twice-when-asked",
        "hung",
        "hung-when-asked",
        "connection",
    ],
)
def test_a_renderer_that_died_for_another_episode_costs_no_attempt(
    tmp_path: Path, end: RendererEnd | None, pending_call: str, lost: int, reason: str
) -> None:
    """The episode is run again each time. A policy that kills the renderer in a call for the
    episode costs an attempt, and one that hangs costs all of them."""
    data = msgspec.structs.replace(
        record_of(SCENARIO, load_policy("stop").manifest), status="invalid"
    ).encoded()
    losses = [LostRenderer("s-0", 1, pending_call)] * lost
    over = () if reason else (Done("s-0", "done", data),)
    fakes = OneMessageAtATime(Ready(), *losses, *over)
    record = record_by(tmp_path, fakes, renderer=EndedRenderer(end))
    assert record.status == ("crashed" if reason else "invalid") and record.reason.startswith(
        reason
    )


class OneMessageAtATime(FakeProcess):
    """A process that sends one message each time it is polled."""

    def listen(self, handle: MessageHandler) -> bool:
        if self._messages:
            handle(self._messages[0])
            self._messages = self._messages[1:]
        return True


def test_processes_that_never_start_end_the_run(tmp_path: Path) -> None:
    """Two processes in a row that end before they are ready are reported as the machine's fault,
    with the log."""
    with pytest.raises(
        MachineError,
        match=r"ended with exit code 7 before it was ready, 2 times: see worker-0\.log",
    ):
        record_by(tmp_path, FakeProcess(ends=True), FakeProcess(ends=True))


def test_a_job_of_any_length_reaches_a_worker_that_listens_late() -> None:
    """More than a socket buffers is posted without waiting, and arrives complete and in order."""
    ours, theirs = socket.socketpair()
    run = MessageSocket(ours)
    worker = MessageSocket(theirs)
    jobs = [os.urandom(3_000_000), b"the next"]
    for job in jobs:
        run.post(job)
    received: list[bytes] = []
    while len(received) < len(jobs):
        received += worker.received()
        run.flush()
    assert received == jobs
    worker.close()
    with pytest.raises(OSError):
        run.post(jobs[0])
    run.close()


class RecordingProcess(FakeProcess):
    """A process that finishes each job at once and records it."""

    def __init__(self) -> None:
        super().__init__(Ready())
        self.given: list[Job] = []

    def give(self, job: Job) -> None:
        self.given.append(job)
        done = Record.begun(job.scenario, load_policy("stop").manifest, job.setup)
        self._messages = (*self._messages, Done(job.scenario.id, "crashed", done.encoded()))


def test_the_order_of_episodes_depends_on_the_seed_alone(tmp_path: Path) -> None:
    """A run takes its scenarios in the order of their episode names: each seed has one order, and
    every job carries the run's seed."""
    suite = Suite(
        name="s",
        version="1",
        scenarios=tuple(msgspec.structs.replace(SCENARIO, id=f"s-{i}") for i in range(8)),
    )
    orders = {}
    for seed in (1, 2, 1):
        folder = tmp_path / f"{seed}-{len(orders)}"
        notes = RecordingProcess()
        spec = spec_of(suite, "stop", seed=seed)
        hello = Hello("stop", load_policy("stop").manifest, "")
        with RunFolder.create(folder, spec, suite) as held:
            pool.run_all(held, suite.scenarios, hello, FakeTransport(notes), handle=lambda _: None)
        assert {job.setup.seed for job in notes.given} == {seed}
        order = [job.scenario.id for job in notes.given]
        assert orders.setdefault(seed, order) == order
    assert sorted(orders[1]) == sorted(orders[2]) == list(spec.scenarios)
    assert orders[1] != orders[2] and list(spec.scenarios) not in orders.values()
