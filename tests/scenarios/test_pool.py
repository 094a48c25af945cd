"""Environment processes: those that cannot begin, die or say nothing, and what is told of them,
once."""

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
def desk(tmp_path: Path) -> Path:
    """A folder with the policies."""
    (tmp_path / "mine.py").write_text(MODULES["mine"])
    return tmp_path


def run(cosim: Cosim, desk: Path, name: str, suite: str = "reactive") -> tuple[int, str]:
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
    said = cosim("run", suite, *words, cwd=desk)
    assert "Traceback" not in said.stderr and not list(desk.glob("run/episodes/*/record.json"))
    assert "crashed" not in said.stdout + said.stderr
    return said.returncode, said.stderr


@pytest.mark.engine
@pytest.mark.parametrize("name", CANNOT_BEGIN)
def test_a_policy_that_a_process_cannot_load_ends_the_run(
    cosim: Cosim, desk: Path, name: str
) -> None:
    """It was loaded when the run began, and is not in its processes: wrong use, once, and no
    episode has crashed."""
    code, said = run(cosim, desk, name)
    assert (code, said.count("error:")) == (2, 1) and CANNOT_BEGIN[name][1] in said


@pytest.mark.engine
def test_an_engine_that_cannot_be_imported_ends_the_run(fresh_cosim: Cosim, desk: Path) -> None:
    """What a process lacks is told once, with the remedy."""
    (desk / "libsumo.py").write_text(MODULES["libsumo"])
    write_suite(
        Suite(name="walked", version="1", scenarios=(small_scenario(),)), desk / "walked.json"
    )
    path = os.pathsep.join(
        [str(desk), os.environ.get("PYTHONPATH", str(Path(__file__).parents[2]))]
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", path)
        code, said = run(fresh_cosim, desk, "Mine", "walked.json")
    assert (code, said.count("error:")) == (3, 1)
    assert "SUMO cannot be loaded: libX11.so.6: cannot open shared object" in said


@pytest.mark.parametrize("printed", [0, 10, 100, 101, 150, 200, 201, 1000])
def test_a_log_keeps_its_beginning_and_its_end(tmp_path: Path, printed: int) -> None:
    """Short ones are whole; of longer ones the first and the last 100 bytes or more are kept, in
    order."""
    text = bytes(i % 251 for i in range(printed))
    with (tmp_path / "log").open("wb") as file:
        log = BoundedLog(file.fileno(), first=100, last=100)
        for start in range(0, printed, 30):
            log.write(text[start : start + 30])
        log.close()
    kept = (tmp_path / "log").read_bytes()
    if printed <= 200:
        assert kept == text
        return
    first, gap, last = kept.partition(b" bytes were printed here and left out]\n")
    first, _, left_out = first.rpartition(b"\n[")
    assert text.startswith(first or kept) and text.endswith(last) and len(kept) < 300
    assert not gap or (len(first), len(first) + int(left_out) + len(last)) == (100, printed)
    assert not gap or 100 <= len(last) < 130


@pytest.mark.parametrize("ended", ["worker", "supervisor"])
def test_a_nested_supervisor_stores_the_end_of_its_log(tmp_path: Path, ended: str) -> None:
    """Whether the worker that started it is killed or the run ends, the last output is stored."""
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
    """The first answer has its own timeout, and none runs before a query."""
    asked = PendingCallMemory.new()
    assert asked.pending_call is None
    asked.starts(doing, 64)
    time.sleep(0.001)
    pending_call = asked.pending_call
    assert pending_call is not None and pending_call.overdue(Patience(answer_s, start_s)) is overdue
    assert pending_call.when == ("act at 3.20 s" if "act" in doing else doing)
    asked.stops()
    assert asked.pending_call is None
    asked.close()


class Fake:
    """A process that says what a test has prepared, and then nothing; or it ends."""

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
        """It does not listen."""

    def listen(self, handle: MessageHandler) -> bool:
        messages = self._messages
        self._messages = ()
        for message in messages:
            handle(message)
        return not self._ends

    def hang_up(self) -> None:
        """It does not mind."""

    def wake(self) -> None:
        """It does not sleep."""

    def kill(self, *, wait: bool = True) -> None:
        self.killed = True

    def end(self) -> str:
        return "the environment process ended with exit code 7"


class Prepared:
    """A transport to one slot, for processes that a test has made."""

    def __init__(self, *fakes: Fake) -> None:
        self.waiting = iter(fakes)

    def room(self, busy: int) -> int:
        return 1 - busy

    def unsolicited(self) -> tuple[()]:
        return ()

    def start(self, hello: Hello) -> EnvironmentSlot:
        def start(hello: Hello) -> Fake:
            fake = next(self.waiting)
            fake.repeats = hello.repeat
            return fake

        return EnvironmentSlot(start, hello)

    def wait(self, timeout_s: float) -> None:
        """They have said everything."""


SCENARIO = Scenario(
    id="s-0",
    suite="s",
    place=City(seed=0),
    seed=0,
    start=(0.0, 0.0, 0.0),
    goal=(9.0, 0.0),
    route=((0.0, 0.0), (9.0, 0.0)),
)


def pooled(
    folder: Path, *fakes: Fake, renderer: SharedRenderer | None = None, **named: float
) -> Record:
    """The record of one scenario, run by these workers, one after the other."""
    (record,) = all_pooled(folder, (SCENARIO,), *fakes, renderer=renderer, **named)
    return record


def all_pooled(
    folder: Path,
    scenarios: tuple[Scenario, ...],
    *fakes: Fake,
    renderer: SharedRenderer | None = None,
    **named: float,
) -> list[Record]:
    """The same of several scenarios."""
    transport = Prepared(*fakes)
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
    """A process that says nothing, while its policy has nothing to answer, is killed; the second
    time it is a crash."""
    monkeypatch.setattr(environment_slot, "SILENCE_S", 0.0)
    monkeypatch.setattr(environment_slot, "TICK_S", 0.0)
    fakes = (Fake(Ready()), Fake(Ready()))
    record = pooled(tmp_path, *fakes)
    assert (
        record.reason.startswith("the environment process showed no sign of life, 2 times")
        and record.ticks == 0
    )
    assert all(fake.killed for fake in fakes)


def test_a_policy_that_hangs_is_not_tried_again(tmp_path: Path) -> None:
    """It is told once, with the policy, the time, and where."""
    record = pooled(tmp_path, Fake(Ready(), asks="act"), answer_s=0.0)
    assert record.reason == "policy 'stop' gave no answer for 0 s in act at 3.20 s of s-0"


def test_a_slow_policy_is_no_silence(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """While a policy has time left to answer, its process may say nothing for as long as it
    likes."""
    monkeypatch.setattr(environment_slot, "SILENCE_S", 0.0)
    monkeypatch.setattr(environment_slot, "TICK_S", 0.0)
    slow = Fake(Ready(), asks="act")
    began = time.monotonic()
    record = pooled(tmp_path, slow, answer_s=0.2)
    assert time.monotonic() - began > 0.2 and "gave no answer for 0.2 s" in record.reason


@pytest.mark.parametrize("came", ["half", "another"])
def test_a_damaged_record_is_a_crash(tmp_path: Path, came: str) -> None:
    """A worker that reports an episode as done with half a record, or another one's, has not
    finished it."""
    other = msgspec.structs.replace(SCENARIO, id="s-1")
    whole = record_of(other, load_policy("stop").manifest).encoded()
    done = Done("s-0", "done", whole[: len(whole) // 2] if came == "half" else whole)
    record = pooled(tmp_path, Fake(Ready(), done))
    assert record.status == "crashed" and record.reason == "its record was damaged when it arrived"


def test_a_record_and_its_log_are_written_as_they_came(tmp_path: Path) -> None:
    """A worker needs no folder: the run's own process writes the bytes, and a frame."""
    data = record_of(SCENARIO, load_policy("stop").manifest).encoded()
    log = os.urandom(3_000_000)
    record = pooled(
        tmp_path, Fake(Ready(), FrameDrawn("s-0", 5, b"png"), Done("s-0", "crashed", data, log))
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
def test_who_ends_its_process_gains_nothing_and_who_loses_it_to_an_engine_nothing_either(
    tmp_path: Path, in_engine: bool, status: str
) -> None:
    """Twice lost to a fault of compiled code while nothing was asked of the policy: the simulator
    owes the episode. However else a process ends, its policy may have ended it: that has failed."""
    dies = [
        Fake(Ready(), EpisodeProgress("s-0", 1.0, 1.0, 0), ends=True, in_engine=in_engine)
        for _ in range(2)
    ]
    (record,) = all_pooled(tmp_path, (SCENARIO,), *dies)
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
def test_a_replay_without_the_policy_finds_who_ended_a_process(
    tmp_path: Path, replays: list[tuple[int, str]], status: str, reason: str, in_engine: bool
) -> None:
    """After the last attempt its commands are simulated again: dead at the same tick is the
    simulator's fault; alive is the policy's, and the record keeps what was driven. A replay that
    was killed says nothing until a second one dies there, too."""
    driven = Driven(7, False, COMMANDS)
    record = record_of(SCENARIO, load_policy("stop").manifest)
    again = [
        Fake(ends=True, in_engine=end == "fault", driven=Driven(ticks))
        if end
        else Fake(Repeated("s-0", msgspec.structs.replace(record, ticks=ticks).encoded()))
        for ticks, end in replays
    ]
    dies = [
        Fake(
            Ready(),
            EpisodeProgress("s-0", 1.0, 1.0, 0),
            ends=True,
            in_engine=in_engine,
            driven=driven,
        )
        for _ in range(2)
    ]
    found = pooled(tmp_path, *dies, *again)
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
    """An engine error that a process reports is the simulator's only if it comes again without the
    policy."""
    failed = msgspec.structs.replace(
        record_of(SCENARIO, load_policy("stop").manifest), status="invalid", reason="gone"
    ).encoded()
    done = Done("s-0", "invalid", failed, again=True)
    replay = Fake(Repeated("s-0", failed, error), driven=Driven(ticks))
    twice = Again(Ready(), done, done)
    twice.driven = Driven(7, False, COMMANDS)
    record = pooled(tmp_path, twice, replay)
    assert record.status == status and record.reason.startswith("gone, 2 times: the"), record.reason


def test_an_engine_that_fails_is_tried_again(tmp_path: Path) -> None:
    """One error is forgotten; after the second the episode is invalid, with its reason."""
    failed = msgspec.structs.replace(
        record_of(SCENARIO, load_policy("stop").manifest), status="invalid", reason="gone"
    )
    fine = Done("s-0", "done", msgspec.structs.replace(failed, status="done", reason="").encoded())
    once = Again(Ready(), Done("s-0", "invalid", failed.encoded(), again=True), fine)
    assert all_pooled(tmp_path / "once", (SCENARIO,), once)[0].status == "done"
    twice = Again(Ready(), *[Done("s-0", "invalid", failed.encoded(), again=True)] * 2)
    (record,) = all_pooled(tmp_path / "twice", (SCENARIO,), twice)
    assert (
        record.status == "invalid" and record.reason == "gone, 2 times; see logs/ in the run folder"
    )


class DiesIdle(Fake):
    """It ends once it has said everything."""

    def listen(self, handle: MessageHandler) -> bool:
        left = bool(self._messages)
        super().listen(handle)
        return left


def test_a_process_that_died_between_two_episodes_has_not_tried_the_second(tmp_path: Path) -> None:
    """It was handed one before its end was known, and began nothing: the episode has both of its
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
    fakes = (DiesIdle(Ready(), done), Fake(Ready(), ends=True), Fake(Ready(), again))
    assert [one.status for one in all_pooled(tmp_path, (SCENARIO, second), *fakes)] == [
        "invalid",
        "invalid",
    ]


def test_an_episode_finished_before_its_process_died_is_kept(tmp_path: Path) -> None:
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
        Fake(Ready(), first_done, ends=True),
        Fake(Ready(), ends=True),
        Fake(Ready(), second_done),
    )
    assert [record.ticks for record in all_pooled(tmp_path, (SCENARIO, second), *fakes)] == [9, 9]


class Ended(SharedRenderer):
    """A renderer whose end a test has prepared; None: it goes on."""

    def __init__(self, end: RendererEnd | None) -> None:
        self.at = RendererAddress(address="nowhere", asks=True)
        self.end = end

    def check(self) -> None:
        """It has ended already."""

    def end_of(self, number: int) -> RendererEnd | None:
        return self.end

    def episode_ended(self) -> None:
        """It does not count."""


HUNG = RendererEnd("the renderer process was ended", 60.0)
DIED = RendererEnd("the renderer process ended with exit code 7")


@pytest.mark.parametrize(
    ("end", "asked", "lost", "reason"),
    [
        (DIED, "", 5, ""),
        (DIED, "act at 3.20 s", 1, ""),
        (
            DIED,
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
def test_an_episode_is_no_attempt_the_less_for_a_renderer_that_died_for_others(
    tmp_path: Path, end: RendererEnd | None, asked: str, lost: int, reason: str
) -> None:
    """It is run again as often as that happens; a policy that takes the renderer down when it is
    asked for the episode has used up an attempt of it, and one that does not answer all of them."""
    data = msgspec.structs.replace(
        record_of(SCENARIO, load_policy("stop").manifest), status="invalid"
    ).encoded()
    losses = [LostRenderer("s-0", 1, asked)] * lost
    over = () if reason else (Done("s-0", "done", data),)
    fakes = Again(Ready(), *losses, *over)
    record = pooled(tmp_path, fakes, renderer=Ended(end))
    assert record.status == ("crashed" if reason else "invalid") and record.reason.startswith(
        reason
    )


class Again(Fake):
    """It says one thing after another, one for each time that it is listened to."""

    def listen(self, handle: MessageHandler) -> bool:
        if self._messages:
            handle(self._messages[0])
            self._messages = self._messages[1:]
        return True


def test_processes_that_never_come_up_end_the_run(tmp_path: Path) -> None:
    """Twice in a row: the machine's fault, told with the log."""
    with pytest.raises(
        MachineError,
        match=r"ended with exit code 7 before it was ready, 2 times: see worker-0\.log",
    ):
        pooled(tmp_path, Fake(ends=True), Fake(ends=True))


def test_a_job_of_any_length_reaches_a_worker_that_listens_late() -> None:
    """More than a socket holds is posted without waiting, and arrives whole, in order, as it is
    taken."""
    ours, theirs = socket.socketpair()
    run = MessageSocket(ours)
    worker = MessageSocket(theirs)
    jobs = [os.urandom(3_000_000), b"the next"]
    for job in jobs:
        run.post(job)
    heard: list[bytes] = []
    while len(heard) < len(jobs):
        heard += worker.received()
        run.flush()
    assert heard == jobs
    worker.close()
    with pytest.raises(OSError):
        run.post(jobs[0])
    run.close()


class Notes(Fake):
    """It runs whatever it is given, at once, and notes it."""

    def __init__(self) -> None:
        super().__init__(Ready())
        self.given: list[Job] = []

    def give(self, job: Job) -> None:
        self.given.append(job)
        done = Record.begun(job.scenario, load_policy("stop").manifest, job.setup)
        self._messages = (*self._messages, Done(job.scenario.id, "crashed", done.encoded()))


def test_a_policy_that_counts_its_episodes_does_not_learn_which_they_are(tmp_path: Path) -> None:
    """A run goes through its scenarios in the order of the names that its policy is told: another
    one for each seed, always the same for one. Every job carries the run's seed."""
    suite = Suite(
        name="s",
        version="1",
        scenarios=tuple(msgspec.structs.replace(SCENARIO, id=f"s-{i}") for i in range(8)),
    )
    orders = {}
    for seed in (1, 2, 1):
        folder = tmp_path / f"{seed}-{len(orders)}"
        notes = Notes()
        spec = spec_of(suite, "stop", seed=seed)
        hello = Hello("stop", load_policy("stop").manifest, "")
        with RunFolder.create(folder, spec, suite) as held:
            pool.run_all(held, suite.scenarios, hello, Prepared(notes), handle=lambda _: None)
        assert {job.setup.seed for job in notes.given} == {seed}
        order = [job.scenario.id for job in notes.given]
        assert orders.setdefault(seed, order) == order
    assert sorted(orders[1]) == sorted(orders[2]) == list(spec.scenarios)
    assert orders[1] != orders[2] and list(spec.scenarios) not in orders.values()
