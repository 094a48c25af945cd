"""Hostile policies, in the simulator's process and isolated: every episode gets its row, and
nothing else breaks."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
import uuid
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import msgspec
import pandas as pd
import pytest

from cosim.core.errors import UsageError
from cosim.results.record import Record
from cosim.results.run_folder import read_records, read_spec
from cosim.spec.episode_id import episode_id_of
from cosim.spec.options import EpisodeOptions, PolicyHost
from cosim.spec.scenario import Scenario, Suite, write_suite
from scenarios.runs import run as suite_run
from scenarios.runs.isolated_policy import isolated_driver
from scenarios.tools.verify.doctor import small_scenario
from tests.conftest import PATIENCE_S, ROOT, WIDE, Cosim, Said, without_lines
from tests.support.hostile import ANSWER_S, DEEDS, DESK, DONE, FLOOD_BYTES, Honest

OF = "tests.support.hostile"
SEED = 5
MARK = "HOSTILE_MARK"
_WRITES = """
import os, stat
for i in range(3, 1024):
    try:
        if stat.S_ISSOCK(os.fstat(i).st_mode):
            os.write(i, b"0" * 99)
    except OSError:
        pass
"""


class War(NamedTuple):
    """One run of all behaviours of a hosting.

    folder: of the run
    outcome: DONE or a part of the crash's reason, by behaviour
    mark: what every process of the run has in its environment
    """

    folder: Path
    outcome: dict[str, str]
    said: Said
    records: dict[str, Record]
    mark: str


def named(name: str) -> Scenario:
    return msgspec.structs.replace(small_scenario(), time_limit_s=1.0, id=name)


def prepare(desk: Path, names: list[str], mark: str) -> dict[str, str]:
    """Write the suite of some behaviours; return the environment of its run."""
    suite = Suite(name="hostile", version="1", scenarios=tuple(map(named, names)))
    write_suite(suite, desk / "hostile.json")
    told = {episode_id_of(SEED, each).episode: each.id for each in suite.scenarios}
    (desk / "names.json").write_text(json.dumps(told))
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    return {DESK: str(desk), MARK: mark, "PYTHONPATH": path}


def war(desk: Path, fresh_cosim: Cosim, outcome: dict[str, str], *options: str) -> War:
    """Run all behaviours by two processes at a time."""
    mark = f"hostile-{uuid.uuid4()}"
    timeout = ("--answer-timeout", f"{ANSWER_S:g}", "--start-timeout", f"{ANSWER_S:g}")
    words = ("--policy", f"{OF}:Hostile", "--jobs", "2", "--seed", str(SEED), "--out", "run")
    with pytest.MonkeyPatch.context() as patch:
        for name, value in prepare(desk, [*outcome], mark).items():
            patch.setenv(name, value)
        said = fresh_cosim("run", "hostile.json", *words, *timeout, *options, cwd=desk)
    records = {one.scenario.id: one for one in read_records(desk / "run")}
    return War(desk / "run", outcome, said, records, mark)


@pytest.fixture(scope="module")
def here(tmp_path_factory: pytest.TempPathFactory, fresh_cosim: Cosim) -> War:
    outcome = {name: deed.here for name, deed in DEEDS.items() if deed.here is not None}
    options = ("--log-json", "log.jsonl", "--frames", "0.25")
    return war(tmp_path_factory.mktemp("here"), fresh_cosim, outcome, *options)


@pytest.fixture(scope="module")
def isolated(tmp_path_factory: pytest.TempPathFactory, fresh_cosim: Cosim) -> War:
    outcome = {name: deed.isolated for name, deed in DEEDS.items() if deed.isolated is not None}
    return war(tmp_path_factory.mktemp("isolated"), fresh_cosim, outcome, "--isolated=weak")


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
@pytest.mark.parametrize("hosting", ["here", "isolated"])
def test_a_hostile_policy_is_recorded_for_what_it_did(
    hosting: str, request: pytest.FixtureRequest
) -> None:
    """An episode has crashed with the reason, or is to the bit that of an honest policy."""
    run: War = request.getfixturevalue(hosting)
    honest = run.records["honest"]
    for name, expected in run.outcome.items():
        record = run.records[name]
        if expected == DONE:
            assert record.status == "done", f"{name}: {record.reason}"
            told = (record.state_hash, record.ended, record.measures, record.failures)
            assert told == (honest.state_hash, honest.ended, honest.measures, honest.failures), name
        else:
            reason = without_lines(record.reason)
            assert record.status == "crashed" and expected in reason, f"{name}: {reason}"
            assert len(reason) < 700, name
    began = Counter((run.folder.parent / "began.txt").read_text().split())
    attempts = {name: 1 if hosting == "isolated" else DEEDS[name].attempts for name in run.outcome}
    assert began == attempts
    assert {record.setup.policy_runs for record in run.records.values()} == {
        "in-process" if hosting == "here" else "isolated: weak"
    }


@pytest.mark.engine
@pytest.mark.parametrize("hosting", ["here", "isolated"])
def test_a_run_of_hostile_policies_ends_in_order(
    hosting: str, request: pytest.FixtureRequest
) -> None:
    """The run has a row for every episode, exit code 1, no traceback, small logs, and leaves no
    process."""
    run: War = request.getfixturevalue(hosting)
    assert run.said.returncode == 1 and "Traceback" not in run.said.stderr, run.said.stderr
    assert f"scheduled {len(run.outcome)}, scored {len(run.outcome)}" in run.said.stdout
    assert "crashed error" in run.said.stdout
    table = pd.read_csv(run.folder / "results.csv", index_col="scenario", keep_default_na=False)
    assert list(table.index) == sorted(run.outcome)
    assert {float(each) for each in table["success"][table["status"] == "crashed"]} == {0.0}
    logs = [path.read_bytes() for path in (run.folder / "logs").iterdir()]
    assert max(map(len, logs)) < FLOOD_BYTES / 2
    flood = (b"the flood begins", b"bytes were printed here and left out", b"the flood ends")
    for words in flood if hosting != "isolated" else ():
        assert any(words in log for log in logs), words
    assert with_mark(run.mark) == []


@pytest.mark.engine
def test_nobody_pays_for_what_another_did_to_the_process(here: War) -> None:
    """Processes end by what is expected to end them; others continue, or leave in order with a
    closed output."""
    log = (here.folder.parent / "log.jsonl").read_text().splitlines()
    lost = [one for one in map(json.loads, log) if one["event"] == "lost"]
    why = {one["why"] for one in lost if DEEDS[one["scenario"]].attempts == 1}
    assert why <= {"the environment process ended with exit code 0"}


@pytest.mark.engine
def test_pictures_are_kept_as_they_were_drawn(here: War) -> None:
    """A policy that blackens the picture it is given does not blacken the one that is kept."""
    episodes = here.folder / "episodes"
    honest, blackened = (
        [path.read_bytes() for path in sorted((episodes / name / "frames").glob("*.png"))]
        for name in ("honest", "scribbles")
    )
    assert len(honest) == 4 and honest == blackened


@pytest.mark.engine
def test_an_isolated_policy_sees_nothing_of_the_simulator(isolated: War) -> None:
    """Its process holds no engine and nothing of the street, and SUMO has no person there."""
    assert json.loads((isolated.folder.parent / "peeked.json").read_text()) == []
    assert read_spec(isolated.folder).setup.policy_runs == "isolated: weak"
    assert "policy isolated: weak" in isolated.said.stdout


@pytest.mark.engine
def test_isolated_or_not_an_episode_is_the_same_to_the_bit(isolated: War, tmp_path: Path) -> None:
    """In the simulator's process the same commands come out of the same pictures."""
    suite = Suite(name="hostile", version="1", scenarios=(named("honest"),))
    table = suite_run.run(suite, Honest(), out=tmp_path / "run", options=EpisodeOptions(seed=SEED))
    honest = isolated.records["honest"]
    assert table["policy_runs"].tolist() == ["in-process"]
    assert table["state_hash"].tolist() == [honest.state_hash]
    assert {"answer_median_ms", "answer_p95_ms"} <= honest.clock.keys()


@pytest.mark.engine
def test_nothing_is_left_of_a_run_that_is_killed(tmp_path: Path) -> None:
    """The processes that a policy has started, in their own sessions, end with a killed run."""
    mark = f"hostile-{uuid.uuid4()}"
    words = ("--policy", f"{OF}:Leaves", "--seed", str(SEED), "--out", "leaves")
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
    # The run, the shepherd, the worker, and the two that were left.
    while len(with_mark(mark)) < 5:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    run.kill()
    run.wait()
    while with_mark(mark):
        assert time.monotonic() < deadline, "processes are left"
        time.sleep(0.02)


def test_isolated_what_cannot_be_loaded_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cosim: Cosim
) -> None:
    """An isolated policy that is missing, ends its process, writes to its socket, hangs or is
    privileged is refused in a line."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "ends.py").write_text("import os\nos._exit(3)\n")
    (tmp_path / "writes.py").write_text(_WRITES)
    told = {
        f"{OF}:Honset": "unknown class in module 'tests.support.hostile' 'Honset'.*Did "
        "you mean Honest?",
        "ends:Any": "policy 'ends:Any' cannot be loaded: it gave no answer: the policy process "
        "ended with exit code 3",
        "writes:Any": "policy 'writes:Any' cannot be loaded: it ",
    }
    for name, words in told.items():
        with pytest.raises(UsageError, match=words):
            isolated_driver(name)
    with pytest.raises(UsageError, match=r"it gave no answer for 1 s: --start-timeout gives it"):
        isolated_driver(f"{OF}:Hanging", start_s=1.0)
    said = cosim("run", "unit", "--policy", "route", "--isolated", "--episodes", "1", cwd=tmp_path)
    assert said.returncode == 2 and "is told what the simulator knows (privileged)" in said.stderr
    with pytest.raises(UsageError, match="needs a policy by its name"):
        suite_run.run("unit", Honest(), host=PolicyHost(isolated="auto"))
