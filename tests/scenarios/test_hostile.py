"""Hostile policies, in the simulator's process and isolated: every episode gets its row, and no
other episode is affected."""

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
from tests.conftest import PATIENCE_S, ROOT, WIDE, CliResult, Cosim, without_lines
from tests.support import hostile
from tests.support.hostile import ANSWER_S, BEHAVIOURS, DONE, FLOOD_BYTES, FORGED, START_S, Honest

MODULE = "hostile_policy"
SEED = 5
MARK = "LC_HOSTILE_MARK"
"""Environment variable that the sandbox passes on."""
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
"""The command line with a timeout of ticks and a short timeout of ending processes."""


class HostileRun(NamedTuple):
    """One run of behaviours in a hosting. folder: of the run; names: of the behaviours; lost:
    scenarios of the attempts that ended with their process; mark: value of the variable MARK in
    every process of the run."""

    folder: Path
    names: tuple[str, ...]
    output: CliResult
    records: dict[str, Record]
    lost: list[str]
    mark: str


class HostingRuns(NamedTuple):
    """The runs of a hosting, which run at the same time. hanging: behaviours that a short timeout
    ends; seeing: those that need a picture, and an honest policy with a camera; harmful: those that
    harm the run folder (in a sandbox they are in `others`); others: the others, with timeouts that
    a slow machine does not miss."""

    others: HostileRun
    hanging: HostileRun
    seeing: HostileRun
    harmful: HostileRun | None

    @property
    def all(self) -> list[HostileRun]:
        return [run for run in self if run is not None]

    def run_with(self, name: str) -> HostileRun:
        """Return the run of a behaviour."""
        return next(run for run in self.all if name in run.names)


@cache
def short_scenario() -> Scenario:
    """Return a second in a small city without crowd and obstacles, whose engines start fast."""
    empty = CrowdSpec(persons=0, vehicles=0)
    return msgspec.structs.replace(small_scenario(), time_limit_s=1.0, crowd=empty, obstacles=())


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
    """Run behaviours with a number of processes; runs of hanging behaviours have short timeouts."""
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
    output = CliResult(done.returncode, done.stdout, done.stderr)
    assert output.returncode in (ALL_SCORED, SOME_CRASHED), output
    records = {one.scenario.id: one for one in read_records(folder / "run")}
    log = map(json.loads, (folder / "log.jsonl").read_text().splitlines())
    lost = [one["scenario"] for one in log if one["event"] == "lost"]
    return HostileRun(folder / "run", names, output, records, lost, mark)


_ALWAYS = ("--log-json", "log.jsonl")
HOSTINGS = {"in-process": _ALWAYS, "isolated": (*_ALWAYS, "--isolated")}
SIGHT = {
    "in-process": ("--camera", "bullet", "--frames", "0.25"),
    "isolated": ("--camera", "bullet"),
}
SANDBOXED = {f"isolated: {kind}" for kind in KINDS}
HARMLESS = {name: one for name, one in BEHAVIOURS.items() if one.in_process == DONE}
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
        futures = [
            pool.submit(
                run_behaviours, tmp_path_factory.mktemp("hostile"), names, *words, jobs=jobs
            )
            for names, jobs, words in runs
        ]
    others, hanging, seeing, *harmful = [one.result() for one in futures]
    return HostingRuns(others, hanging, seeing, *(harmful or [None]))


def processes_with_mark(mark: str) -> list[int]:
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
    """Each episode either crashes with the expected reason or equals that of an honest policy to
    the bit."""
    behaviour = BEHAVIOURS[name]
    run = hosting_runs.run_with(name)
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


def test_the_table_has_59_behaviours() -> None:
    """None is invalid anywhere, and only one forges a result in the simulator's process."""
    assert len(BEHAVIOURS) - 1 == 59
    assert [
        name
        for name, behaviour in BEHAVIOURS.items()
        if FORGED in (behaviour.in_process, behaviour.isolated)
    ] == ["patches-the-referee"]


@pytest.mark.engine
def test_a_run_of_hostile_policies_ends_in_order(hosting: str, hosting_runs: HostingRuns) -> None:
    """The run has a row for every episode, the right exit code and no traceback, and leaves no
    process. Its logs are small, with begin and end of floods."""
    for run in hosting_runs.all:
        crashed = [one for one in run.records.values() if one.status == "crashed"]
        assert run.output.returncode == bool(crashed) and "Traceback" not in run.output.stderr, (
            run.output
        )
        assert f"scheduled {len(run.names)}, scored {len(run.names)}" in run.output.stdout
        table = pd.read_csv(run.folder / "results.csv", index_col="scenario", keep_default_na=False)
        assert list(table.index) == sorted(run.names)
        assert {float(one) for one in table["success"][table["status"] == "crashed"]} <= {0.0}
        for name, record in run.records.items():
            assert Record.load(run.folder / "episodes" / name / "record.json") == record
        assert processes_with_mark(run.mark) == []
    logs = [path.read_bytes() for path in (hosting_runs.others.folder / "logs").iterdir()]
    assert max(map(len, logs)) < FLOOD_BYTES / 2
    # Two floods may share a log, whose middle is left out.
    for words in (b"bytes were printed here and left out", b"flood begins", b"flood ends"):
        assert any(words in log for log in logs), words


@pytest.mark.engine
def test_a_policy_harms_no_other_episode_of_its_process(
    hosting: str, hosting_runs: HostingRuns
) -> None:
    """No harmless episode was lost with its process."""
    harmless = BEHAVIOURS if hosting == "isolated" else HARMLESS
    assert harmless.keys() & {*hosting_runs.others.lost} == set()


@pytest.mark.engine
def test_pictures_are_stored_as_drawn(hosting: str, hosting_runs: HostingRuns) -> None:
    """A policy that blackens its picture does not change the stored one, and the record names the
    renderer."""
    if hosting == "isolated":
        pytest.skip("frames are stored in the simulator's process")
    assert hosting_runs.seeing.records["honest"].setup.renderer == renderer_of("bullet")
    episodes = hosting_runs.seeing.folder / "episodes"
    honest, blackened = (
        [path.read_bytes() for path in sorted((episodes / name / "frames").glob("*.png"))]
        for name in ("honest", "scribbles")
    )
    assert len(honest) == 4 and honest == blackened


@pytest.mark.engine
def test_a_run_states_the_sandbox_of_its_policy(hosting: str, hosting_runs: HostingRuns) -> None:
    """The run's specification and output name the kind of sandbox."""
    runs = read_spec(hosting_runs.others.folder).setup.policy_runs
    assert runs in (SANDBOXED if hosting == "isolated" else {"in-process"})
    assert hosting == "in-process" or f"policy {runs}" in hosting_runs.others.output.stdout


@pytest.mark.engine
def test_an_isolated_episode_equals_one_in_the_simulators_process(
    hosting: str, hosting_runs: HostingRuns, tmp_path: Path
) -> None:
    """The same pictures give the same commands and the same state hash."""
    if hosting == "in-process":
        pytest.skip("the isolated run is compared")
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
    """Processes that a policy has started, in sessions of their own, end with a killed run."""
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
    while len(processes_with_mark(mark)) < 5:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    run.kill()
    run.wait()
    while processes_with_mark(mark):
        assert time.monotonic() < deadline, "processes are left"
        time.sleep(0.02)


def test_an_isolated_policy_that_cannot_be_loaded_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cosim: Cosim
) -> None:
    """A policy that is missing, ends its process, writes to its socket, hangs or is privileged is
    refused in one line."""
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
    done = cosim("run", "unit", "--policy", "route", "--isolated", "--episodes", "1", cwd=tmp_path)
    assert done.returncode == 2 and "needs privileged state" in done.stderr
    with pytest.raises(UsageError, match="needs a policy by its name"):
        suite_run.run("unit", Honest(), host=PolicyHost(isolated="auto"))
