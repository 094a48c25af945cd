"""Shared parts of all tests: waiting, example generation, places, and the command line."""

from __future__ import annotations

import hashlib
import importlib
import io
import itertools
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import psutil
import pytest
from hypothesis import HealthCheck, settings

if TYPE_CHECKING:
    from cosim.spec.episode_id import EpisodeId
    from cosim.spec.scenario import Scenario

ROOT = Path(__file__).parents[1]
PATIENCE_S = 600.0
"""Longest time that a test waits for a condition, far beyond what a slow and busy machine needs. A
test never waits for it to pass, so it costs nothing if the test passes."""

WIDE = {"COLUMNS": "200", "NO_COLOR": "1"}
"""Environment in which a test can read the output of the command line."""

settings.register_profile(
    "tests", deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck)
)
settings.load_profile("tests")


LONGEST = (
    "scenarios/test_hostile.py",
    "cli/test_cli.py",
    "scenarios/test_reactive_suite.py",
    "scenarios/test_scan_import.py",
    "scenarios/test_chaos.py",
    "report/test_page_in_chromium.py",
    "sumo_nets/test_importer.py",
    "scenarios/test_exploit.py",
    "scenarios/test_collect.py",
    "policies/test_orca_policy.py",
    "scenarios/test_setup.py",
    "scenarios/test_remote.py",
    "sumo_nets/test_crossings.py",
    "cli/test_run_command.py",
    "scenarios/test_cheats.py",
    "sumo_nets/test_crowd.py",
    "scenarios/test_verify.py",
)
"""Files of engine tests that take longest. They run before the other engine tests, so that no worker
of pytest-xdist is left with one of them at the end."""

COLLECTED = pytest.StashKey[list[str]]()
"""The ids of all tests of a session, including those that it deselects."""


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    config.stash[COLLECTED] = [item.nodeid for item in items]
    if worker := os.environ.get("PYTEST_XDIST_WORKER"):
        collected_by(worker).write_text(json.dumps(config.stash[COLLECTED]))
    slow = {item.path for item in items if item.get_closest_marker("engine")}
    rank = {ROOT / "tests" / name: place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: (item.path in slow, rank.get(item.path, len(rank))))


def pytest_sessionfinish() -> None:
    if worker := os.environ.get("PYTEST_XDIST_WORKER"):
        collected_by(worker).unlink(missing_ok=True)


def collected_by(worker: str) -> Path:
    """Return the file with the ids of all tests as a worker of this run has collected them."""
    run = os.environ["PYTEST_XDIST_TESTRUNUID"]
    return Path(tempfile.gettempdir(), f"cosim-tests-{run}-{worker}.json")


def still_runs(pid: int) -> bool:
    """Return whether a process is running; a zombie is not."""
    try:
        return bool(psutil.Process(pid).status() != psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return False


def seed_in_order(scenarios: Sequence[Scenario]) -> int:
    """Return the least seed of a run that takes these scenarios in the given order."""
    from cosim.spec.episode_id import episode_id_of

    def ids_in_order(seed: int) -> list[EpisodeId]:
        return [episode_id_of(seed, scenario) for scenario in scenarios]

    return next(
        seed for seed in itertools.count() if ids_in_order(seed) == sorted(ids_in_order(seed))
    )


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--whole", action="store_true", help="all where a sample is tested by default")


def pytest_configure(config: pytest.Config) -> None:
    """Store nets between runs in a folder for each version of their sources, separate from the
    user's. Let Ctrl-C interrupt the tests and their child processes, also from a background shell.
    Compile modules once instead of in each of hundreds of processes."""
    sys.dont_write_bytecode = False
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    made_by = hashlib.sha256(f"{version('eclipse-sumo')} {version('numpy')}".encode())
    for source in sorted((ROOT / "sumo_nets").rglob("*.py")):
        made_by.update(source.read_bytes())
    os.environ["COSIM_CACHE"] = str(ROOT / ".pytest_cache" / f"nets-{made_by.hexdigest()[:12]}")
    with pytest.MonkeyPatch.context() as patch:
        for name, value in WIDE.items():
            patch.setenv(name, value)
        importlib.import_module(
            "cosim.cli.app"
        )  # consoles look at the environment once, when they are made


class CliResult(NamedTuple):
    """Output and exit code of a command."""

    returncode: int
    stdout: str
    stderr: str


Cosim = Callable[..., CliResult]
"""cosim(*words, cwd=folder)."""


@pytest.fixture(scope="session")
def cosim() -> Cosim:
    """Run the command line by its entry point in this process; modules stay loaded, the rest is as
    for a user."""
    return _in_this_process


@pytest.fixture(scope="session")
def fresh_cosim() -> Cosim:
    """Run the command line in a new process."""
    return _in_new_process


def _in_new_process(*words: str, cwd: Path | None = None) -> CliResult:
    command = [sys.executable, "-m", "cosim", *words]
    done = subprocess.run(
        command,
        cwd=cwd,
        env=os.environ | WIDE,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    return CliResult(done.returncode, done.stdout, done.stderr)


def _in_this_process(*words: str, cwd: Path | None = None) -> CliResult:
    from cosim.__main__ import main

    out, err = io.StringIO(), io.StringIO()
    with _as_a_program(words, cwd or Path.cwd()), redirect_stdout(out), redirect_stderr(err):
        try:
            main()
            code = 0
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else int(end.code is not None)
    return CliResult(code, out.getvalue(), err.getvalue())


@contextmanager
def _as_a_program(words: tuple[str, ...], folder: Path) -> Iterator[None]:
    """Run in a folder with arguments; afterwards remove modules of the folder and restore
    signals."""
    before = Path.cwd(), sys.argv, [*sys.path], {*sys.modules}, signal.getsignal(signal.SIGTERM)
    os.chdir(folder)
    sys.argv = ["cosim", *words]
    try:
        yield
    finally:
        os.chdir(before[0])
        sys.argv = before[1]
        sys.path[:] = before[2]
        # Modules of the project and of its environment stay, also where the folder is the project's.
        others = () if folder == ROOT else {*sys.modules} - before[3]
        for name in others:
            source = getattr(sys.modules[name], "__file__", None)
            if source and Path(source).is_relative_to(folder):
                del sys.modules[name]
        signal.signal(signal.SIGTERM, before[4])


def wait_until(holds: Callable[[], object]) -> None:
    """Wait until a condition holds, for at most PATIENCE_S."""
    deadline = time.monotonic() + PATIENCE_S
    while not holds():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def without_lines(text: str) -> str:
    """Return text without the file and line that a policy's crash names."""
    return re.sub(r" in \w+\.py:\d+", "", text)


@pytest.fixture(scope="session")
def walker_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the humanoid's network, converted from the published file; skip the test
    if that is missing."""
    from physics.dynamics.legs.walker import WALKER_NETWORK

    shared = Path(os.environ.get("COSIM_WEIGHTS") or ROOT.parent / "shared" / "weights")
    published = shared / "unitree_g1" / WALKER_NETWORK.weights.name
    if not published.is_file():
        pytest.skip(f"the humanoid's published network {published} is missing (COSIM_WEIGHTS)")
    folder = tmp_path_factory.mktemp("weights")
    WALKER_NETWORK.write(published, folder)
    return folder


@pytest.fixture
def walker_weights(walker_folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Set $COSIM_WEIGHTS to a folder with the humanoid's network."""
    monkeypatch.setenv("COSIM_WEIGHTS", str(walker_folder))
    return walker_folder
