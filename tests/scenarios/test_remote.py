"""Policies served from a separate environment that has only what `policy_server.py` needs."""

from __future__ import annotations

import ast
import shutil
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import msgspec
import numpy as np
import pytest

from cosim.core.errors import MachineError, PolicyServerLost
from cosim.core.state import Command
from cosim.episode.interfaces import Observation
from cosim.episode.manifest_checks import calibration_of
from cosim.results.run_folder import read_records, read_spec
from cosim.spec.connection import Connection
from cosim.spec.options import EpisodeOptions, PolicyHost
from cosim.spec.robot import COURIER
from cosim.spec.scenario import Scenario, Suite, write_suite
from scenarios.runs import run as suite_run
from scenarios.runs.remote_policy import RemoteCaller, remote_caller
from scenarios.tools.verify.doctor import small_scenario
from tests.conftest import PATIENCE_S, ROOT, Cosim, seed_in_order
from tests.support.documents import blocks
from tests.support.hostile import Honest

SERVER = ROOT / "bridge" / "policy_server.py"
OTHERS = ("python3.9", "python3.10", "python3.12", "python3.13", "python3.14")
NEEDS = ("eclipse-zenoh>=1.10,<2", "msgspec", "numpy")


def example() -> str:
    """Return the complete example of docs/hosting.md."""
    (block,) = blocks("python", "docs/hosting.md")
    return block.text


def free_endpoint() -> str:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{one.getsockname()[1]}"


def three_packages(folder: Path) -> list[str]:
    """Return the command of a Python that has only the three required packages."""
    packages = folder / "packages"
    packages.mkdir()
    site = Path(np.__file__).parents[1]
    for name in ("zenoh", "msgspec", "numpy", "numpy.libs"):
        if (site / name).exists():
            (packages / name).symlink_to(site / name)
    start = (
        f"import sys; sys.path[:0] = [{str(folder)!r}, {str(packages)!r}]; import runpy; sys.argv "
        f"= sys.argv[1:]; "
    )
    return [
        sys.executable,
        "-I",
        "-S",
        "-c",
        start + "runpy.run_path(sys.argv[0], run_name='__main__')",
    ]


@contextmanager
def restarting(words: list[str], folder: Path) -> Iterator[None]:
    """Run a process that is restarted whenever it ends, until the block ends."""
    ended = threading.Event()
    current: list[subprocess.Popen[bytes]] = []

    def restart() -> None:
        while not ended.is_set():
            with (folder / "printed").open("ab") as printed:
                current[:] = [subprocess.Popen(words, cwd=folder, stdout=printed, stderr=printed)]
            current[0].wait()

    thread = threading.Thread(target=restart)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        while thread.is_alive():
            for process in current:
                process.kill()
            thread.join(0.1)


def seen_at(tick: int, driver: RemoteCaller) -> Observation:
    spec = driver.manifest.camera
    assert spec is not None
    rgb = np.zeros((spec.height, spec.width, 3), np.uint8)
    return Observation(
        tick, tick / 20.0, rgb, 0.5, 0.0, COURIER, camera=calibration_of(spec, COURIER)
    )


def driver_when_served(name: str, endpoint: str, printed: Path) -> RemoteCaller:
    """Return the driver of a policy as soon as it is served."""
    for _ in range(int(PATIENCE_S / 10)):
        try:
            return remote_caller(
                name,
                PolicyHost(servers=(Connection(role="coordinator", connect=endpoint),), run="r"),
            )
        except MachineError:
            continue
    raise AssertionError(printed.read_text())


def pythons(request: pytest.FixtureRequest, folder: Path) -> Iterator[list[str]]:
    """Yield commands of Python environments to serve from; with --whole one of every other
    installed version."""
    yield three_packages(folder)
    for name in OTHERS if request.config.getoption("--whole") else ():
        if (python := shutil.which(name)) is not None and not subprocess.run(
            [python, "-V"], check=False
        ).returncode:
            subprocess.run([python, "-m", "venv", folder / name], check=True)
            subprocess.run([folder / name / "bin" / "pip", "install", "-q", *NEEDS], check=True)
            yield [
                str(folder / name / "bin" / "python"),
                "-c",
                "import runpy, sys; sys.path.insert(0, '.'); "
                "runpy.run_path(sys.argv[1], run_name='__main__')",
            ]


@pytest.mark.engine
def test_the_example_of_the_documents_serves_from_a_clean_environment(
    tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    """The documented example has at most ten lines and serves a policy without cosim. With --whole
    it runs in every other installed Python from 3.9 on."""
    assert len([line for line in example().splitlines() if line.strip()]) <= 10
    shutil.copy(SERVER, tmp_path)
    for python in pythons(request, tmp_path):
        endpoint = free_endpoint()
        assert "tcp/127.0.0.1:7449" in example()
        (tmp_path / "mine.py").write_text(example().replace("tcp/127.0.0.1:7449", endpoint))
        with restarting([*python, "mine.py"], tmp_path):
            driver = driver_when_served("zenoh:mine", endpoint, tmp_path / "printed")
            driver.reset("k1", 1)
            assert [driver.act(seen_at(tick, driver)) for tick in (0, 4)] == [Command(1.0, 0.0)] * 2
            driver.close()


def test_policy_server_is_valid_python_3_9() -> None:
    """The file has the grammar of 3.9 and imports no package of this project."""
    module = ast.parse(SERVER.read_text(), feature_version=(3, 9))
    names = {
        alias.name
        for node in ast.walk(module)
        if isinstance(node, ast.Import)
        for alias in node.names
    }
    names |= {node.module or "" for node in ast.walk(module) if isinstance(node, ast.ImportFrom)}
    assert not {name.partition(".")[0] for name in names} & {
        "cosim",
        "scenarios",
        "bridge",
        "sumo_nets",
        "physics",
    }


def one_second(name: str) -> Scenario:
    return msgspec.structs.replace(small_scenario(), time_limit_s=1.0, id=name)


@pytest.mark.engine
def test_a_hanging_server_does_not_delay_the_end_of_an_episode(tmp_path: Path) -> None:
    """The message that an episode has ended returns while an answer is still pending."""
    shutil.copy(SERVER, tmp_path)
    shutil.copy(ROOT / "tests" / "support" / "served_policies.py", tmp_path)
    endpoint = free_endpoint()

    def query() -> None:
        with suppress(PolicyServerLost):
            driver.act(seen_at(0, driver))

    with restarting(
        [*three_packages(tmp_path), "served_policies.py", "Stuck", "stuck", endpoint], tmp_path
    ):
        driver = driver_when_served("zenoh:stuck", endpoint, tmp_path / "printed")
        driver.reset("k1", 1)
        querying = threading.Thread(target=query, daemon=True)
        querying.start()
        while querying.is_alive() and not (tmp_path / "asked").exists():
            querying.join(0.02)
        ending = threading.Thread(target=driver.ended, daemon=True)
        ending.start()
        ending.join(PATIENCE_S)
        assert not ending.is_alive() and querying.is_alive()
    querying.join(PATIENCE_S)
    driver.close()


@pytest.mark.engine
def test_an_episode_of_a_killed_server_is_run_again(tmp_path: Path, cosim: Cosim) -> None:
    """After kill -9 in the third query another server repeats the episode with the state hash of a
    local policy, and a second loss is a crash. Records have `remote` and answer times; a policy
    that never answers has crashed."""
    shutil.copy(SERVER, tmp_path)
    shutil.copy(ROOT / "tests" / "support" / "served_policies.py", tmp_path)
    suite = Suite(
        name="three", version="1", scenarios=(one_second("a"), one_second("b"), one_second("c"))
    )
    seed = seed_in_order(suite.scenarios)
    endpoint = free_endpoint()
    write_suite(suite, tmp_path / "three.json")
    words = (
        "--policy",
        "zenoh:dying",
        "--policy-at",
        endpoint,
        "--seed",
        str(seed),
        "--out",
        "run",
    )
    with restarting(
        [*three_packages(tmp_path), "served_policies.py", "Dying", "dying", endpoint], tmp_path
    ):
        driver_when_served("zenoh:dying", endpoint, tmp_path / "printed").close()
        done = cosim("run", "three.json", *words, "--answer-timeout", "5", cwd=tmp_path)
    a, b, c = sorted(read_records(tmp_path / "run"), key=lambda record: record.scenario.id)
    local = suite_run.run(
        Suite(name="three", version="1", scenarios=(one_second("a"),)),
        Honest(),
        options=EpisodeOptions(seed=seed),
    )
    assert (a.status, [a.state_hash]) == ("done", local["state_hash"].tolist()), (
        a.reason + done.stderr
    )
    assert b.status == "crashed" and "of policy 'dying' is gone, 2 times" in b.reason
    assert (
        c.status == "crashed"
        and "policy 'honest' gave no answer for 5 s in act at 0.50 s of c" in c.reason
    )
    assert (
        a.setup.policy_runs
        == b.setup.policy_runs
        == read_spec(tmp_path / "run").setup.policy_runs
        == "remote"
    )
    assert (
        a.clock["answer_p95_ms"] >= a.clock["answer_median_ms"] > 0.0
        and "policy remote" in done.stdout
    )
    assert done.returncode == 1 and (tmp_path / "thirds").stat().st_size == 5
