"""Run folders that cannot be read: of another version, of other things, or not there yet; each in one line."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from tests.conftest import Cosim
from tests.records.driven_runs import run_of

READS: tuple[tuple[str, ...], ...] = (
    ("show", "run"),
    ("show", "run", "--episode", "s-000"),
    ("show", "run", "--events"),
    ("score", "run"),
    ("compare", "run", "other"),
    ("compare", "other", "run"),
    ("report", "run"),
    ("film", "run", "s-000"),
    ("replay", "run", "s-000"),
    ("counterfactual", "run", "s-000"),
    ("merge", "run", "other", "--out", "both"),
    ("merge", "other", "run", "--out", "both"),
    ("status", "run"),
    ("run", "reactive", "--policy", "straight", "--episodes", "1", "--out", "run", "--resume"),
    ("run", "reactive", "--policy", "straight", "--episodes", "1", "--seed", "1", "--out", "run", "--resume"),
)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two runs, `run` and `other`, of which the first is of another schema."""
    folder = tmp_path_factory.mktemp("runs")
    for name in ("run", "other"):
        run_of(folder / name, ["goal"])
    file = folder / "run" / "run.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"schema": 99, "scenarios": {"of": "another kind"}}))
    return folder


@pytest.mark.parametrize("words", READS, ids=" ".join)
def test_a_run_of_another_schema_is_refused_by_every_command(runs: Path, cosim: Cosim, words: tuple[str, ...]) -> None:
    """File, schema, what this version reads, and the remedy; exit code 2; the folder stays as it was."""
    before = sorted(path.name for path in (runs / "run").iterdir())
    said = cosim(*words, cwd=runs)
    told = "run.json: run schema 99, and this version reads 1: use the version of cosim that made the run"
    assert said.returncode == 2 and told in said.stderr.splitlines()[-1], said
    assert before == sorted(path.name for path in (runs / "run").iterdir()) and not (runs / "both").exists()


@pytest.mark.parametrize("more", [(), ("--seed", "1")], ids=["drawn-seed", "own-seed"])
def test_what_never_began_cannot_be_resumed(tmp_path: Path, cosim: Cosim, more: tuple[str, ...]) -> None:
    """Stopped before its folder was there, or before it was written: it is said how to begin it."""
    words = ("run", "reactive", "--policy", "straight", "--episodes", "1", *more, "--out")
    said = cosim(*words, "mine", "--resume", cwd=tmp_path)
    told = "mine: no run has begun there, so that nothing is kept: give the command of the run without"
    assert said.returncode == 2 and told in said.stderr.splitlines()[-1], said
    (tmp_path / "half" / "episodes").mkdir(parents=True)
    (tmp_path / "half" / "lock").touch()
    said = cosim(*words, "half", "--resume", cwd=tmp_path)
    assert said.returncode == 2 and "half: no run has begun there" in said.stderr.splitlines()[-1], said
    said = cosim("show", "half", cwd=tmp_path)
    assert said.returncode == 2 and "half: no run has begun there" in said.stderr.splitlines()[-1], said


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir], ids=["a-pipe", "a-folder"])
def test_a_run_json_that_is_no_file_is_refused(tmp_path: Path, cosim: Cosim, make: object) -> None:
    """It is not waited for."""
    (tmp_path / "run").mkdir()
    make(tmp_path / "run" / "run.json")  # type: ignore[operator]
    said = cosim("show", "run", cwd=tmp_path)
    assert said.returncode == 2 and "run.json: cannot be read: is no regular file" in said.stderr, said


def test_a_run_stopped_before_it_began_is_no_run_to_resume(
    tmp_path: Path, cosim: Cosim, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C while its policy is loaded: that nothing is kept is said."""

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("scenarios.execution.suite_run.planned_run", interrupted)
    said = cosim("run", "reactive", "--policy", "straight", "--out", "mine", cwd=tmp_path)
    assert said.returncode == 130 and "Stopped before the run began: mine holds nothing" in said.stderr, said
