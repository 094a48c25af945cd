"""`--isolated`: whatever a policy does, the street is that of the same commands sent by an honest
one."""

from __future__ import annotations

import json
import os
import uuid
from pathlib import Path
from typing import NamedTuple

import msgspec
import pytest

from cosim.core.errors import UsageError
from cosim.results.record import Record
from cosim.results.run_folder import read_records, read_spec
from cosim.spec.episode_id import pseudonym_of
from cosim.spec.options import EpisodeOptions, PolicyHost
from cosim.spec.scenario import Scenario, Suite, write_suite
from scenarios.runs import run as suite_run
from scenarios.runs.isolated_policy import isolated_driver
from scenarios.tools.verify.doctor import small_scenario
from tests.conftest import Cosim, Said, without_lines
from tests.support.isolated_policies import DEEDS, DESK, FLOOD_BYTES, Honest

OF = "tests.support.isolated_policies"
SEED = 5
ANSWER_S = 3.0
CRASHED = {
    "closes-descriptors": "gave no answer: the policy process ended with exit "
    "code 1 (act at 0.25 s)",
    "writes-garbage": "gave no answer: the policy process",
    "ends": "policy 'honest' gave no answer: the policy process ended with exit code 0 (act at "
    "0.25 s)",
    "pretends": "policy 'honest' raised PolicyServerLost: the server is gone (act at 0.25 s)",
    "stops-itself": f"policy 'honest' gave no answer for {ANSWER_S:g} s in act at 0.25 s of "
    f"stops-itself",
    "too-many-numbers": "policy 'honest' answered an array of shape (50001, 2): 100002 numbers; "
    "an answer holds at most 100000 (act at 0.25 s)",
    "far-too-many-numbers": "answered an array of shape (1000000, 4): 4000000 numbers; an answer "
    "holds at most 100000",
    "hangs-afterwards": f"policy 'honest' gave no answer for {ANSWER_S:g} s in "
    f"ended of hangs-afterwards",
}
"""Those that give no answer, by their own fault; all others are done."""


_WRITES = """
import os, stat
for i in range(3, 1024):
    try:
        if stat.S_ISSOCK(os.fstat(i).st_mode):
            os.write(i, b"0" * 99)
    except OSError:
        pass
"""


class Court(NamedTuple):
    """The one run of all deeds. mark: what every process of it has in its environment."""

    folder: Path
    said: Said
    records: dict[str, Record]
    mark: str


def one_second() -> Scenario:
    return msgspec.structs.replace(small_scenario(), time_limit_s=1.0)


@pytest.fixture(scope="module")
def court(tmp_path_factory: pytest.TempPathFactory, fresh_cosim: Cosim) -> Court:
    desk = tmp_path_factory.mktemp("desk")
    mark = f"isolated-{uuid.uuid4()}"
    suite = Suite(
        name="deeds",
        version="1",
        scenarios=tuple(msgspec.structs.replace(one_second(), id=name) for name in DEEDS),
    )
    write_suite(suite, desk / "deeds.json")
    names = {pseudonym_of(SEED, each).episode: each.id for each in suite.scenarios}
    (desk / "names.json").write_text(json.dumps(names))
    words = (
        "--policy",
        f"{OF}:Cheat",
        "--isolated",
        "--jobs",
        "2",
        "--seed",
        str(SEED),
        "--out",
        "run",
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(DESK, str(desk))
        patch.setenv("ISOLATED_MARK", mark)
        patch.setenv(
            "PYTHONPATH",
            os.pathsep.join([str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")]),
        )
        said = fresh_cosim(
            "run", "deeds.json", *words, "--answer-timeout", f"{ANSWER_S:g}", cwd=desk
        )
    return Court(
        desk / "run", said, {one.scenario.id: one for one in read_records(desk / "run")}, mark
    )


@pytest.mark.engine
def test_isolated_the_street_is_that_of_an_honest_policy(court: Court) -> None:
    """Patching the referee, asking libsumo, writing into what is given, forking, 64 MB on stdout,
    another folder, going when all is over: same hash, same verdict, same measures; and the run says
    that the policy was isolated."""
    honest = court.records["honest"]
    assert honest.status == "done" and honest.setup.policy_runs == "isolated", court.said.stderr
    for name in DEEDS.keys() - CRASHED:
        record = court.records[name]
        assert (record.status, record.state_hash) == ("done", honest.state_hash), (
            f"{name}: {record.reason}"
        )
        assert (record.ended, record.measures, record.failures) == (
            honest.ended,
            honest.measures,
            honest.failures,
        )
    assert json.loads((court.folder.parent / "peeked.json").read_text()) == []
    assert (
        read_spec(court.folder).setup.policy_runs == "isolated"
        and "policy isolated" in court.said.stdout
    )


@pytest.mark.engine
def test_isolated_who_gives_no_answer_has_crashed_once(court: Court) -> None:
    """Death, garbage, closed descriptors, another's error and SIGSTOP: crashed by its own fault,
    never invalid, and the environment's processes, two, go on, but for the two that had to be ended
    because nothing came."""
    for name, words in CRASHED.items():
        record = court.records[name]
        assert record.status == "crashed" and words in without_lines(record.reason), (
            f"{name}: {record.status} {record.reason}"
        )
    assert court.said.returncode == 1
    assert len([*(court.folder / "logs").glob("worker-*.log")]) <= 4
    assert sum(path.stat().st_size for path in (court.folder / "logs").iterdir()) < FLOOD_BYTES // 4


@pytest.mark.engine
def test_isolated_nothing_is_left_of_a_run(court: Court) -> None:
    """No process that the run or its policy has started is there when the run has ended."""
    left = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if court.mark.encode() in (folder / "environ").read_bytes():
                left.append(folder.name)
        except OSError:
            continue
    assert left == []


@pytest.mark.engine
def test_isolated_or_not_an_episode_is_the_same_to_the_bit(court: Court, tmp_path: Path) -> None:
    """In the simulator's process the same commands come out of the same pictures; that run is
    marked `in-process`, and neither is resumed as the other."""
    suite = Suite(
        name="deeds", version="1", scenarios=(msgspec.structs.replace(one_second(), id="honest"),)
    )
    table = suite_run.run(suite, Honest(), out=tmp_path / "run", options=EpisodeOptions(seed=SEED))
    assert table["policy_runs"].tolist() == ["in-process"]
    assert table["state_hash"].tolist() == [court.records["honest"].state_hash]
    assert {"answer_median_ms", "answer_p95_ms"} <= court.records["honest"].clock.keys()


def test_isolated_what_cannot_be_loaded_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cosim: Cosim
) -> None:
    """A class that is not there, who ends its process, who writes to its socket, who is privileged:
    in a line."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "ends.py").write_text("import os\nos._exit(3)\n")
    (tmp_path / "writes.py").write_text(_WRITES)
    told = {
        f"{OF}:Honset": "unknown class in module 'tests.support.isolated_policies' 'Honset'.*Did "
        "you mean Honest?",
        "ends:Any": "policy 'ends:Any' cannot be loaded: it gave no answer: the policy process "
        "ended with exit code 3",
        "writes:Any": "policy 'writes:Any' cannot be loaded: it ",
    }
    for name, words in told.items():
        with pytest.raises(UsageError, match=words):
            isolated_driver(name)
    said = cosim("run", "unit", "--policy", "route", "--isolated", "--episodes", "1", cwd=tmp_path)
    assert said.returncode == 2 and "is told what the simulator knows (privileged)" in said.stderr
    with pytest.raises(UsageError, match="needs a policy by its name"):
        suite_run.run("unit", Honest(), host=PolicyHost(isolated=True))


def test_an_isolated_policy_that_is_never_made_is_refused() -> None:
    """A run that only wants to know who it is gives it the start timeout, and leaves nothing."""
    with pytest.raises(
        UsageError,
        match=r"cannot be loaded: it gave no answer for 1 s: --start-timeout gives it longer",
    ):
        isolated_driver(f"{OF}:Hanging", start_s=1.0)
