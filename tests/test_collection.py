"""The collected tests: equal in every process and at any time, with readable ids."""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import COLLECTED, LONGEST, PATIENCE_S, collected_by

ROOT = Path(__file__).parents[1]
COLLECT = (
    sys.executable,
    "-m",
    "pytest",
    "-o",
    "addopts=--import-mode=importlib",
    "--collect-only",
    "-q",
    "tests",
)
LONGEST_PARAMETERS = 120


def runs_all(config: pytest.Config) -> bool:
    """Return whether all tests are run, not some files."""
    return all(Path(asked).resolve() in (ROOT, ROOT / "tests") for asked in config.args)


@pytest.fixture(scope="module")
def ids_of_another_process(request: pytest.FixtureRequest) -> list[str]:
    """Return the ids of all tests, including engine tests, as a process with other hashes collects
    them: another worker of this run, or a new one."""
    here = os.environ.get("PYTEST_XDIST_WORKER")
    if here and runs_all(request.config) and "PYTHONHASHSEED" not in os.environ:
        count = int(os.environ["PYTEST_XDIST_WORKER_COUNT"])
        others = [worker for worker in map("gw{}".format, range(count)) if worker != here]
        for path in filter(Path.exists, map(collected_by, others)):
            ids: list[str] = json.loads(path.read_text())
            return ids
    environment = os.environ | {"PYTHONHASHSEED": "1"}
    done = subprocess.run(
        COLLECT, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=PATIENCE_S
    )
    assert done.returncode == 0, done.stdout
    return [line for line in done.stdout.splitlines() if "::" in line]


def unreadable(test_id: str) -> bool:
    """Return whether the parameters in an id are too long to read, or hold bytes that are no
    letters."""
    parameters = test_id.partition("[")[2]
    escaped = "\\" in parameters.replace(r"\\", "")
    return len(parameters) > LONGEST_PARAMETERS or escaped or not test_id.isprintable()


def by_function(test_ids: list[str]) -> list[str]:
    """Return ids sorted by function, with each function's parameters in their order, as pytest
    groups those that share a fixture."""
    return sorted(test_ids, key=lambda test_id: test_id.partition("[")[0])


def test_two_processes_collect_the_same_tests(
    ids_of_another_process: list[str], request: pytest.FixtureRequest
) -> None:
    """Ids depend neither on the clock nor on the order of sets, as processes that divide the tests
    must agree. In a partial run the requested ids are compared."""
    collected_here = request.config.stash[COLLECTED]
    assert len(ids_of_another_process) == len(set(ids_of_another_process)) > 900
    collected_there = (
        ids_of_another_process
        if runs_all(request.config)
        else [test_id for test_id in ids_of_another_process if test_id in set(collected_here)]
    )
    assert by_function(collected_here) == by_function(collected_there)


def test_every_id_can_be_read(ids_of_another_process: list[str]) -> None:
    """No id has bytes or a complete message: it can be typed, and fits on one line."""
    assert [test_id for test_id in ids_of_another_process if unreadable(test_id)] == []


def test_the_longest_files_exist() -> None:
    """A renamed file would lose its place at the beginning."""
    assert [name for name in LONGEST if not (ROOT / "tests" / name).exists()] == []


def test_no_test_has_a_constant_timeout() -> None:
    """Timeouts are PATIENCE_S, as any constant is too short on some machine."""
    found = []
    for path in sorted((ROOT / "tests").rglob("*.py")):
        for call in ast.walk(ast.parse(path.read_text())):
            limits = (
                [k.value for k in call.keywords if k.arg == "timeout"]
                if isinstance(call, ast.Call)
                else []
            )
            found += [
                f"{path.name}:{limit.lineno}" for limit in limits if isinstance(limit, ast.Constant)
            ]
    assert found == []


@pytest.mark.parametrize(
    ("test_id", "refused"),
    [
        ("tests/test_a.py::test_b[good-2-words in a row]", False),
        ("tests/test_a.py::test_b[body\\\\.npz]", False),
        ("tests/test_a.py::test_b[\\x1f\\x8b\\x08]", True),
        ("tests/test_a.py::test_b[one\\ntwo]", True),
        ("tests/test_a.py::test_b[" + 200 * "a" + "]", True),
    ],
    ids=["words", "an escaped dot", "bytes", "two lines", "long"],
)
def test_unreadable_ids_are_found(test_id: str, refused: bool) -> None:
    """Bytes, several lines and long parameters count as unreadable."""
    assert unreadable(test_id) is refused
