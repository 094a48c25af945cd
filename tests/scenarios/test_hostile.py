"""Hostile policies, in the simulator's process and isolated: every episode gets its row, and
nothing else breaks."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
import uuid
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import NamedTuple

import msgspec
import pandas as pd
import pytest

from cosim.core.errors import ALL_SCORED, SOME_CRASHED, UsageError
from cosim.results.record import Record
from cosim.results.run_folder import read_records, read_spec
from cosim.spec.episode_id import episode_id_of
from cosim.spec.options import EpisodeOptions, PolicyHost
from cosim.spec.scenario import CrowdSpec, Scenario, Suite, write_suite
from physics.cameras.choice import renderer_of
from scenarios.ipc.sandbox import KINDS
from scenarios.runs import run as suite_run
from scenarios.runs.isolated_policy import isolated_caller
from scenarios.tools.verify.doctor import small_scenario
from tests.conftest import PATIENCE_S, ROOT, WIDE, Cosim, Said, without_lines
from tests.support import hostile
from tests.support.hostile import ANSWER_S, BEHAVIOURS, DONE, FLOOD_BYTES, FORGED, START_S, Honest

MODULE = "hostile_policy"
SEED = 5
MARK = "LC_HOSTILE_MARK"
"""A variable that the sandbox passes on."""
_WRITES = """
import os, stat
for i in range(3, 1024):
    try:
        if stat.S_ISSOCK(os.fstat(i).st_mode):
            os.write(i, b"0" * 99)
    except OSError:
        pass
"""


_SHORT_TIMEOUTS = """
import sys
from scenarios.ipc import child_process
from scenarios.runs import environment_slot
child_process.ENDING_S = 2.0
environment_slot.TICK_S = {tick_s}
from cosim.__main__ import main
main()
"""
"""The command line with timeouts of ticks and, short, of the end of processes."""


class HostileRun(NamedTuple):
    """One run of behaviours in a hosting.

    folder: of the run
    names: of the behaviours
    lost: the scenarios of the attempts that ended with their process
    mark: value of the variable MARK of every process of the run
    """

    folder: Path
    names: tuple[str, ...]
    said: Said
    records: dict[str, Record]
    lost: list[str]
    mark: str


class HostingRuns(NamedTuple):
    """The runs of a hosting, which run at the same time.

    hanging: of behaviours that are ended by a timeout, which is short
    seeing: of those that need a picture, and of an honest policy with a camera
    harmful: of those that harm the run folder; in a sandbox, where none can, they are in `others`
    others: of the others, whose timeouts are so long that a slow machine misses none
    """

    others: HostileRun
    hanging: HostileRun
    seeing: HostileRun
    harmful: HostileRun | None

    @property
    def all(self) -> list[HostileRun]:
        return [run for run in self if run is not None]

    def of(self, name: str) -> HostileRun:
        """Return the run of a behaviour."""
        return next(run for run in self.all if name in run.names)


@cache
def short_scenario() -> Scenario:
    """A second in a small city without crowd and obstacles, so that its engines start fast."""
    nobody = CrowdSpec(persons=0, vehicles=0)
    return msgspec.structs.replace(small_scenario(), time_limit_s=1.0, crowd=nobody, obstacles=())


def named(name: str) -> Scenario:
    return msgspec.structs.replace(short_scenario(), id=name)


def prepare(folder: Path, names: Sequence[str], mark: str) -> dict[str, str]:
    """Write the suite of some behaviours, and their policy in a folder of its own; return the
    environment of the run."""
    suite = Suite(name="hostile", version="1", scenarios=tuple(map(named, names)))
    write_suite(suite, folder / "hostile.json")
    names_by_id = {episode_id_of(SEED, each).episode: each.id for each in suite.scenarios}
    own = folder / "policy"
    own.mkdir()
    (own / "names.json").write_text(json.dumps(names_by_id))
    shutil.copy(hostile.__file__, own / f"{MODULE}.py")
    path = os.pathsep.join([str(own), str(ROOT), os.environ.get("PYTHONPATH", "")])
    return {MARK: mark, "PYTHONPATH": path}


def run_behaviours(folder: Path, names: tuple[str, ...], *options: str, jobs: int) -> HostileRun:
    """Run behaviours by some processes at a time; a run of hanging ones has short timeouts."""
    mark = f"hostile-{uuid.uuid4()}"
    hangs = HANGING[0] in names
    answer_s, start_s = (ANSWER_S, START_S) if hangs else (PATIENCE_S, PATIENCE_S)
    timeout = ("--answer-timeout", f"{answer_s:g}", "--start-timeout", f"{start_s:g}")
    kind = "SeeingHostile" if names == SEEING else "Hostile"
    words = (
        "--policy",
        f"{MODULE}:{kind}",
        "--jobs",
        str(jobs),
        "--seed",
        str(SEED),
        "--out",
        "run",
    )
    code = _SHORT_TIMEOUTS.format(tick_s=answer_s)
    done = subprocess.run(
        [sys.executable, "-c", code, "run", "hostile.json", *words, *timeout, *options],
        cwd=folder,
        env=os.environ | WIDE | prepare(folder, names, mark),
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    said = Said(done.returncode, done.stdout, done.stderr)
    assert said.returncode in (ALL_SCORED, SOME_CRASHED), said
    records = {one.scenario.id: one for one in read_records(folder / "run")}
    log = map(json.loads, (folder / "log.jsonl").read_text().splitlines())
    lost = [one["scenario"] for one in log if one["event"] == "lost"]
    return HostileRun(folder / "run", names, said, records, lost, mark)


_ALWAYS = ("--log-json", "log.jsonl")
HOSTINGS = {"in-process": _ALWAYS, "isolated": (*_ALWAYS, "--isolated")}
SIGHT = {
    "in-process": ("--camera", "bullet", "--frames", "0.25"),
    "isolated": ("--camera", "bullet"),
}
SANDBOXED = {f"isolated: {kind}" for kind in KINDS}
HANGING = tuple(name for name, behaviour in BEHAVIOURS.items() if behaviour.hangs)
HARMFUL = tuple(name for name, behaviour in BEHAVIOURS.items() if behaviour.harms_folder)
SEEING = ("honest", *(name for name, behaviour in BEHAVIOURS.items() if behaviour.sees))
OTHERS = tuple(name for name in BEHAVIOURS if name not in HANGING + HARMFUL + SEEING[1:])


@pytest.fixture(scope="module", params=HOSTINGS)
def hosting(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def hosting_runs(hosting: str, tmp_path_factory: pytest.TempPathFactory) -> HostingRuns:
    options = HOSTINGS[hosting]
    isolated = hosting == "isolated"
    # Most of the time of those that hang is waiting, in which the others run.
    runs = [
        (OTHERS + HARMFUL if isolated else OTHERS, 2, options),
        (HANGING, 2, options),
        (SEEING, 1, (*options, *SIGHT[hosting])),
    ]
    runs += [] if isolated else [(("honest", *HARMFUL), 1, options)]
    with ThreadPoolExecutor(len(runs)) as pool:
        begun = [
            pool.submit(
                run_behaviours, tmp_path_factory.mktemp("hostile"), names, *words, jobs=jobs
            )
            for names, jobs, words in runs
        ]
    others, hanging, seeing, *harmful = [one.result() for one in begun]
    return HostingRuns(others, hanging, seeing, *(harmful or [None]))


def with_mark(mark: str) -> list[int]:
    """Return the processes that have a mark in their environment."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if mark.encode() in (folder / "environ").read_bytes():
                found.append(int(folder.name))
        except OSError:
            continue
    return found


@pytest.mark.engine
@pytest.mark.parametrize("name", BEHAVIOURS)
def test_each_behaviour_has_its_outcome(hosting: str, hosting_runs: HostingRuns, name: str) -> None:
    """An episode has crashed with the reason, or is to the bit that of an honest policy."""
    behaviour = BEHAVIOURS[name]
    run = hosting_runs.of(name)
    record = run.records[name]
    expected = behaviour.in_process if hosting == "in-process" else behaviour.isolated
    if expected == FORGED:
        assert (record.status, record.ended, record.measures["success"]) == ("done", "goal", 1.0)
    elif expected == DONE:
        assert record.status == "done", record.reason
        honest = run.records["honest"]
        outcome = (record.state_hash, record.ended, record.measures, record.failures)
        assert outcome == (honest.state_hash, honest.ended, honest.measures, honest.failures)
    else:
        reason = without_lines(record.reason)
        assert record.status == "crashed" and expected in reason, reason
        assert len(reason) < 700 and record.ended is None
        driven = {"reset": 0, "ended": 20}.get(behaviour.call, 5)
        assert record.ticks >= driven, "what was driven is lost"
    if hosting == "in-process":
        began = Counter((run.folder.parent / "began.txt").read_text().split())
        assert (began[name], record.setup.policy_runs) == (behaviour.attempts, "in-process")
    else:
        assert name not in run.lost and record.setup.policy_runs in SANDBOXED


def test_the_table_is_complete() -> None:
    """It has 59 behaviours, none of which is invalid anywhere, and those that a process alone
    cannot prevent are named."""
    assert len(BEHAVIOURS) - 1 == 59
    assert [
        name
        for name, behaviour in BEHAVIOURS.items()
        if FORGED in (behaviour.in_process, behaviour.isolated)
    ] == ["patches-the-referee"]


@pytest.mark.engine
def test_a_run_of_hostile_policies_ends_in_order(hosting: str, hosting_runs: HostingRuns) -> None:
    """The run has a row for every episode, exit code 1, no traceback, small logs with the begin and
    the end of floods, and leaves no process."""
    for run in hosting_runs.all:
        crashed = [one for one in run.records.values() if one.status == "crashed"]
        assert run.said.returncode == bool(crashed) and "Traceback" not in run.said.stderr, run.said
        assert f"scheduled {len(run.names)}, scored {len(run.names)}" in run.said.stdout
        table = pd.read_csv(run.folder / "results.csv", index_col="scenario", keep_default_na=False)
        assert list(table.index) == sorted(run.names)
        assert {float(one) for one in table["success"][table["status"] == "crashed"]} <= {0.0}
        for name, record in run.records.items():
            assert Record.load(run.folder / "episodes" / name / "record.json") == record
        assert with_mark(run.mark) == []
    logs = [path.read_bytes() for path in (hosting_runs.others.folder / "logs").iterdir()]
    assert max(map(len, logs)) < FLOOD_BYTES / 2
    # Two floods may share a log, whose middle is left out.
    for words in (b"bytes were printed here and left out", b"flood begins", b"flood ends"):
        assert any(words in log for log in logs), words


@pytest.mark.engine
def test_a_policy_harms_no_other_episode_of_its_process(
    hosting: str, hosting_runs: HostingRuns
) -> None:
    """An attempt fails only by what its own policy did."""
    if hosting == "isolated":
        return
    assert {
        name for name in hosting_runs.others.lost if BEHAVIOURS[name].in_process == DONE
    } == set()


@pytest.mark.engine
def test_pictures_are_stored_as_drawn(hosting: str, hosting_runs: HostingRuns) -> None:
    """A policy that blackens its picture does not change the stored one; the record names the
    renderer."""
    if hosting == "isolated":
        return
    assert hosting_runs.seeing.records["honest"].setup.renderer == renderer_of("bullet")
    episodes = hosting_runs.seeing.folder / "episodes"
    honest, blackened = (
        [path.read_bytes() for path in sorted((episodes / name / "frames").glob("*.png"))]
        for name in ("honest", "scribbles")
    )
    assert len(honest) == 4 and honest == blackened


@pytest.mark.engine
def test_a_run_states_the_sandbox_of_its_policy(hosting: str, hosting_runs: HostingRuns) -> None:
    """Its specification and its output name the kind."""
    runs = read_spec(hosting_runs.others.folder).setup.policy_runs
    assert runs in (SANDBOXED if hosting == "isolated" else {"in-process"})
    assert hosting == "in-process" or f"policy {runs}" in hosting_runs.others.said.stdout


@pytest.mark.engine
def test_isolated_or_not_an_episode_is_the_same_to_the_bit(
    hosting: str, hosting_runs: HostingRuns, tmp_path: Path
) -> None:
    """In the simulator's process the same commands come out of the same pictures."""
    if hosting == "in-process":
        return
    suite = Suite(name="hostile", version="1", scenarios=(named("honest"),))
    table = suite_run.run(
        suite, Honest(), out=tmp_path / "run", options=EpisodeOptions(seed=SEED, camera="bullet")
    )
    honest = hosting_runs.seeing.records["honest"]
    assert table["policy_runs"].tolist() == ["in-process"]
    assert table["state_hash"].tolist() == [honest.state_hash]
    assert {"answer_median_ms", "answer_p95_ms"} <= honest.clock.keys()


@pytest.mark.engine
def test_a_killed_run_leaves_no_process(tmp_path: Path) -> None:
    """The processes that a policy has started, in their own sessions, end with a killed run."""
    mark = f"hostile-{uuid.uuid4()}"
    words = ("--policy", f"{MODULE}:Leaves", "--seed", str(SEED), "--out", "leaves")
    run = subprocess.Popen(
        [sys.executable, "-m", "cosim", "run", "hostile.json", *words],
        cwd=tmp_path,
        env=os.environ | WIDE | prepare(tmp_path, ["honest"], mark),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    deadline = time.monotonic() + PATIENCE_S
    while not (tmp_path / "left").exists():
        assert run.poll() is None and time.monotonic() < deadline
        time.sleep(0.02)
    # The run, the supervisor, the worker, and the two that were left.
    while len(with_mark(mark)) < 5:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    run.kill()
    run.wait()
    while with_mark(mark):
        assert time.monotonic() < deadline, "processes are left"
        time.sleep(0.02)


def test_an_isolated_policy_that_cannot_be_loaded_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cosim: Cosim
) -> None:
    """An isolated policy that is missing, ends its process, writes to its socket, hangs or is
    privileged is refused in a line."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "ends.py").write_text("import os\nos._exit(3)\n")
    (tmp_path / "writes.py").write_text(_WRITES)
    messages = {
        f"{hostile.__name__}:Honset": "unknown class in module 'tests.support.hostile' 'Honset'.*Did "
        "you mean Honest?",
        "ends:Any": "policy 'ends:Any' cannot be loaded: it gave no answer: the policy process "
        "ended with exit code 3",
        "writes:Any": "policy 'writes:Any' cannot be loaded: it ",
    }
    for name, words in messages.items():
        with pytest.raises(UsageError, match=words):
            isolated_caller(name)
    with pytest.raises(UsageError, match=r"it gave no answer for 1 s: --start-timeout gives it"):
        isolated_caller(f"{hostile.__name__}:Hanging", start_s=1.0)
    said = cosim("run", "unit", "--policy", "route", "--isolated", "--episodes", "1", cwd=tmp_path)
    assert said.returncode == 2 and "needs privileged state" in said.stderr
    with pytest.raises(UsageError, match="needs a policy by its name"):
        suite_run.run("unit", Honest(), host=PolicyHost(isolated="auto"))
