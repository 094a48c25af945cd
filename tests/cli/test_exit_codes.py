"""Exit codes of the command line, each with one meaning."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from cosim.cli.app import main
from cosim.core import errors
from cosim.core.errors import CosimError
from tests.support.documents import text_of

CODES = {
    "UsageError": 2,
    "SpecError": 2,
    "MapError": 2,
    "RunError": 2,
    "AccessError": 2,
    "PolicyError": 1,
    "EngineError": 3,
    "RendererLost": 3,
    "PolicyServerLost": 3,
    "DirectorLost": 3,
    "MachineError": 3,
}


def ended(monkeypatch: pytest.MonkeyPatch, *words: str) -> int:
    """The exit code of `cosim` with these words."""
    monkeypatch.setattr(sys, "argv", ["cosim", *words])
    with pytest.raises(SystemExit) as ends:
        main()
    return ends.value.code or 0  # type: ignore[return-value]


def test_every_error_has_its_exit_code() -> None:
    """Each error class has one code, and the tree in the module's docstring agrees."""
    assert {name: vars(errors)[name].exit_code for name in CODES} == CODES
    classes = {
        name
        for name, value in vars(errors).items()
        if isinstance(value, type) and value.__base__ is not object
    }
    assert classes >= set(CODES) and {
        n for n in classes if issubclass(vars(errors)[n], CosimError)
    } == {
        *CODES,
        "CosimError",
    }
    for name, code in CODES.items():
        (line,) = [words for words in (errors.__doc__ or "").splitlines() if f"── {name} " in words]
        assert line.split(f"{name}")[1].split()[0] == str(code)


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (("list",), 0),
        (("list", "nowhere"), 2),
        (("list", "--wrong"), 2),
        (("list", "broken.json"), 2),
        (("run", "long-horizon", "--policy", "nobody"), 2),
        (("run", "long-horizon", "--policy", "sys:exit"), 2),
        (("city", "make", "--seed", "1", "--size", "1", "small"), 2),
        (("map", "import", "nothing.osm"), 2),
        (("show", "damaged"), 2),
        (("city", "make", "--seed", "1", "--size", "300", "file/city"), 3),
        (("run", "reactive", "--policy", "orca", "--episodes", "1", "--out", "file/run"), 3),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, tuple) else str(value),
)
def test_wrong_use_is_2_and_the_machine_is_3(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], code: int
) -> None:
    """A wrong name, option, suite file, map or run folder gives 2, an unwritable place 3, and
    success 0."""
    monkeypatch.chdir(tmp_path)
    Path("file").touch()
    Path("broken.json").write_text(json.dumps({"name": 3}))
    Path("damaged").mkdir()
    Path("damaged/run.json").write_text("{")
    assert ended(monkeypatch, *words) == code


@pytest.mark.parametrize(
    ("raised", "code"),
    [(CosimError("x"), 3), (errors.PolicyError("x"), 1), (KeyboardInterrupt(), 130)],
    ids=["an-engine", "a-policy", "ctrl-c"],
)
def test_a_raised_error_decides_the_exit_code(
    monkeypatch: pytest.MonkeyPatch, raised: BaseException, code: int
) -> None:
    """An error that reaches the command line gives the code of its class, and Ctrl-C 130."""

    def raises(*_: object) -> None:
        raise raised

    monkeypatch.setattr("scenarios.suites.catalog.load_suite", raises)
    assert ended(monkeypatch, "list") == code


def test_a_run_with_fewer_records_than_scenarios_is_no_success(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Scenarios without a record are named and the exit code is 1, whatever the cause."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("scenarios.runs.run.run_all", lambda *_, **__: None)
    words = ("run", "reactive", "--policy", "orca", "--episodes", "2", "--out", "run")
    assert ended(monkeypatch, *words) == 1
    assert (
        "No record of obstructing-001, obstructing-001-decoy, conversing-001, "
        "conversing-001-decoy: run it again with --resume" in capsys.readouterr().err
    )


def test_the_documents_list_the_exit_codes() -> None:
    """The table of docs/first-run.md names every code of the module."""
    page = text_of("docs/first-run.md")
    for code in (
        errors.ALL_SCORED,
        errors.SOME_CRASHED,
        errors.WRONG_USE,
        errors.BROKEN_MACHINE,
        errors.TIME_IS_UP,
        errors.INTERRUPTED,
        errors.BROKEN_PIPE,
    ):
        assert f"\n| {code} |" in page
