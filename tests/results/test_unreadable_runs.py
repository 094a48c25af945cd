"""Unreadable run folders: of another version, of other content, or not there yet; each refused in
one line."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from cosim.results.run_folder import FailedAttempt, RunFolder, read_spec
from tests.conftest import Cosim
from tests.support.driven_runs import run_of

READS: tuple[tuple[str, ...], ...] = (
    ("show", "run"),
    ("show", "run", "--episode", "s-000"),
    ("score", "run"),
    ("compare", "run", "other"),
    ("report", "run"),
    ("film", "run", "s-000"),
    ("replay", "run", "s-000"),
    ("counterfactual", "run", "s-000"),
    ("merge", "run", "other", "--out", "both"),
    ("status", "run"),
    (
        "run",
        "reactive",
        "--policy",
        "straight",
        "--episodes",
        "1",
        "--seed",
        "1",
        "--out",
        "run",
        "--resume",
    ),
)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two runs, `run` and `other`, of which the first has another schema."""
    folder = tmp_path_factory.mktemp("runs")
    for name in ("run", "other"):
        run_of(folder / name, ["goal"])
    file = folder / "run" / "run.json"
    file.write_text(
        json.dumps(
            json.loads(file.read_text()) | {"schema": 99, "scenarios": {"of": "another kind"}}
        )
    )
    return folder


@pytest.mark.parametrize("words", READS, ids=" ".join)
def test_a_run_of_another_schema_is_refused_by_every_command(
    runs: Path, cosim: Cosim, words: tuple[str, ...]
) -> None:
    """File, schema, readable schema and remedy are named, the exit code is 2, and the folder is
    unchanged."""
    before = sorted(path.name for path in (runs / "run").iterdir())
    result = cosim(*words, cwd=runs)
    expected = (
        "run.json: run schema 99, and this version reads 1: use the version of cosim that made "
        "the run"
    )
    assert result.returncode == 2 and expected in result.stderr.splitlines()[-1], result
    assert (
        before == sorted(path.name for path in (runs / "run").iterdir())
        and not (runs / "both").exists()
    )


def test_a_run_that_never_began_cannot_be_resumed(tmp_path: Path, cosim: Cosim) -> None:
    """A run that was stopped before its folder existed or was written is refused with how to begin
    it."""
    words = ("run", "reactive", "--policy", "straight", "--episodes", "1", "--out")
    result = cosim(*words, "mine", "--resume", "--seed", "1", cwd=tmp_path)
    expected = "mine: no run has begun there, so there is nothing to resume: give the command of the run without"
    assert result.returncode == 2 and expected in result.stderr.splitlines()[-1], result
    (tmp_path / "half" / "episodes").mkdir(parents=True)
    (tmp_path / "half" / "lock").touch()
    result = cosim(*words, "half", "--resume", cwd=tmp_path)
    assert (
        result.returncode == 2 and "half: no run has begun there" in result.stderr.splitlines()[-1]
    ), result
    result = cosim("show", "half", cwd=tmp_path)
    assert (
        result.returncode == 2 and "half: no run has begun there" in result.stderr.splitlines()[-1]
    ), result


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir], ids=["a-pipe", "a-folder"])
def test_a_run_json_that_is_no_file_is_refused(tmp_path: Path, cosim: Cosim, make: object) -> None:
    """It is refused without waiting for it."""
    (tmp_path / "run").mkdir()
    make(tmp_path / "run" / "run.json")  # type: ignore[operator]
    result = cosim("show", "run", cwd=tmp_path)
    assert (
        result.returncode == 2 and "run.json: cannot be read: is no regular file" in result.stderr
    ), result


def test_ctrl_c_before_a_run_began_reports_that_nothing_is_saved(
    tmp_path: Path, cosim: Cosim, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C while the policy is loaded leaves no run to resume."""

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("scenarios.runs.run.planned_run", interrupted)
    result = cosim("run", "reactive", "--policy", "straight", "--out", "mine", cwd=tmp_path)
    assert (
        result.returncode == 130
        and "Stopped before the run began: mine holds nothing" in result.stderr
    ), result


def test_a_run_whose_events_never_triggered_has_no_sheet(tmp_path: Path, cosim: Cosim) -> None:
    """A line replaces the table, also where the scenarios have no events."""
    run_of(tmp_path / "run", ["goal"])
    result = cosim("show", "run", "--events", cwd=tmp_path)
    assert (result.returncode, result.stdout) == (
        0,
        "No event of this run's episodes was triggered.\n",
    ), result


def test_an_unreadable_results_table_is_refused(tmp_path: Path, cosim: Cosim) -> None:
    """A results.csv with an endless cell, or with bytes of another encoding, is refused."""
    run = run_of(tmp_path / "run", ["goal"])
    for content in (b"scenario\n" + b"9" * 200_000, b'scenario\n"a\0b\n', b"\xff\xfe"):
        (run / "results.csv").write_bytes(content)
        result = cosim("score", "run", cwd=tmp_path)
        assert (
            result.returncode == 2
            and "results.csv: not the table of this run: remove it" in result.stderr
        ), result


def test_unreadable_attempts_are_ignored(tmp_path: Path) -> None:
    """Lines that are no text or have endless brackets are ignored, and the others count."""
    run = run_of(tmp_path / "run", ["goal"])
    (run / "attempts.jsonl").write_bytes(
        b'\x9f\n["s-000", false]\n' + b"[" * 100_000 + b'\n["s-000"'
    )
    with RunFolder.resume(run, read_spec(run)) as folder:
        assert folder.failed_attempts() == {FailedAttempt("s-000", False): 1}
