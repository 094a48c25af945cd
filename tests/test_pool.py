"""Environment processes that cannot begin: the run's error in words, once, and not a crash of every episode."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from cosim.driver import Doing
from scenarios.asked import Asked, Patience
from scenarios.shepherd import BoundedLog
from tests.conftest import Cosim

MODULES = {
    "libsumo": "raise ImportError('libX11.so.6: cannot open shared object file: No such file or directory')",
    "mine": """
import os, sys, time
from pathlib import Path
from cosim.ports import Manifest
from cosim.state import STILL
IN_A_WORKER = sys.argv[:1] == ["-c"]

class Mine:
    manifest = Manifest("mine", camera=None)
    def reset(self, scenario_id, seed): pass
    def act(self, observation): return STILL
class Exits(Mine):
    def __init__(self):
        if IN_A_WORKER: sys.exit("no GPU left")
class Dies(Mine):
    def __init__(self):
        if IN_A_WORKER: os._exit(7)
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
    "Dies": (2, "error: policy 'mine:Dies' cannot be loaded: the environment process ended with exit code 7"),
    "Hangs": (2, "error: policy 'mine' gave no answer for 3 s while it was loaded in an environment process"),
    "Changes": (2, "error: policy 'mine:Changes' has another manifest in each process"),
    "Edits": (2, "error: policy 'mine:Edits' was edited while the run was going on: begin another run"),
}


@pytest.fixture
def desk(tmp_path: Path) -> Path:
    """A folder with the policies."""
    (tmp_path / "mine.py").write_text(MODULES["mine"])
    return tmp_path


def run(cosim: Cosim, desk: Path, name: str) -> tuple[int, str]:
    words = ("--policy", f"mine:{name}", "--episodes", "3", "--start-timeout", "3", "--out", "run")
    said = cosim("run", "reactive", *words, cwd=desk)
    assert "Traceback" not in said.stderr and not list(desk.glob("run/episodes/*/record.json"))
    assert "crashed" not in said.stdout + said.stderr
    return said.returncode, said.stderr


@pytest.mark.engine
@pytest.mark.parametrize("name", CANNOT_BEGIN)
def test_a_policy_that_a_process_cannot_load_ends_the_run(cosim: Cosim, desk: Path, name: str) -> None:
    """It was loaded when the run began, and is not in its processes: wrong use, once, and no episode has crashed."""
    code, said = run(cosim, desk, name)
    assert (code, said.count("error:")) == (2, 1) and CANNOT_BEGIN[name][1] in said


@pytest.mark.engine
def test_an_engine_that_cannot_be_imported_ends_the_run(fresh_cosim: Cosim, desk: Path) -> None:
    """What a process lacks is told once, with the remedy."""
    (desk / "libsumo.py").write_text(MODULES["libsumo"])
    path = os.pathsep.join([str(desk), os.environ.get("PYTHONPATH", str(Path(__file__).parents[1]))])
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", path)
        code, said = run(fresh_cosim, desk, "Mine")
    assert (code, said.count("error:")) == (3, 1)
    assert "an environment process cannot start: libX11.so.6: cannot open shared object" in said


@pytest.mark.parametrize("printed", [0, 10, 100, 101, 150, 200, 201, 1000])
def test_a_log_keeps_its_beginning_and_its_end(tmp_path: Path, printed: int) -> None:
    """Short ones are whole; of longer ones the first and the last 100 bytes or more are kept, in order."""
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
def test_a_first_answer_may_take_longer(doing: Doing, answer_s: float, start_s: float, overdue: bool) -> None:
    """What loads a model has a time of its own; nobody is late before anything is asked."""
    asked = Asked.new()
    assert asked.question is None
    asked.starts(doing, 64)
    time.sleep(0.001)
    question = asked.question
    assert question is not None and question.overdue(Patience(answer_s, start_s)) is overdue
    assert question.when == ("act at 3.20 s" if "act" in doing else doing)
    asked.stops()
    assert asked.question is None
    asked.close()
