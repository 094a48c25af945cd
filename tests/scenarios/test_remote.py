"""Policies that are served from an environment of their own, with nothing in it but what
`policy_server.py` needs."""

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
    """The complete example of docs/hosting.md."""
    (block,) = blocks("python", "docs/hosting.md")
    return block.text


def free_endpoint() -> str:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{one.getsockname()[1]}"


def three_packages(folder: Path) -> list[str]:
    """A Python that has nothing but the three packages that are needed. Returns how it is
    called."""
    beside = folder / "packages"
    beside.mkdir()
    site = Path(np.__file__).parents[1]
    for name in ("zenoh", "msgspec", "numpy", "numpy.libs"):
        if (site / name).exists():
            (beside / name).symlink_to(site / name)
    start = (
        f"import sys; sys.path[:0] = [{str(folder)!r}, {str(beside)!r}]; import runpy; sys.argv "
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
def running(words: list[str], folder: Path) -> Iterator[None]:
    """A process that is started again whenever it has ended, until the block ends."""
    ended = threading.Event()
    now: list[subprocess.Popen[bytes]] = []

    def keep() -> None:
        while not ended.is_set():
            with (folder / "printed").open("ab") as printed:
                now[:] = [subprocess.Popen(words, cwd=folder, stdout=printed, stderr=printed)]
            now[0].wait()

    thread = threading.Thread(target=keep)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        while thread.is_alive():
            for process in now:
                process.kill()
            thread.join(0.1)


def seen_at(tick: int, driver: RemoteCaller) -> Observation:
    spec = driver.manifest.camera
    assert spec is not None
    rgb = np.zeros((spec.height, spec.width, 3), np.uint8)
    return Observation(
        tick, tick / 20.0, rgb, 0.5, 0.0, COURIER, camera=calibration_of(spec, COURIER)
    )


def found(name: str, endpoint: str, printed: Path) -> RemoteCaller:
    """The driver of a policy, as soon as it is served."""
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
    """Environments to serve from: with --whole one of every other Python that there is."""
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
    """At most ten lines, run as they are written but for the port, where there is no cosim: asked
    as any policy. With --whole in every other Python from 3.9 on."""
    assert len([line for line in example().splitlines() if line.strip()]) <= 10
    shutil.copy(SERVER, tmp_path)
    for python in pythons(request, tmp_path):
        endpoint = free_endpoint()
        assert "tcp/127.0.0.1:7449" in example()
        (tmp_path / "mine.py").write_text(example().replace("tcp/127.0.0.1:7449", endpoint))
        with running([*python, "mine.py"], tmp_path):
            driver = found("zenoh:mine", endpoint, tmp_path / "printed")
            driver.reset("k1", 1)
            assert [driver.act(seen_at(tick, driver)) for tick in (0, 4)] == [Command(1.0, 0.0)] * 2
            driver.close()


def test_the_file_that_is_copied_can_be_read_by_python_3_9() -> None:
    """Its grammar is that of 3.9, and it imports nothing of ours."""
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
def test_nobody_waits_for_a_server_that_hangs_to_hear_of_the_end(tmp_path: Path) -> None:
    """Its policy never answers: that the episode has ended is told, and what comes next is not held
    up."""
    shutil.copy(SERVER, tmp_path)
    shutil.copy(ROOT / "tests" / "support" / "served_policies.py", tmp_path)
    endpoint = free_endpoint()

    def asked() -> None:
        with suppress(PolicyServerLost):
            driver.act(seen_at(0, driver))

    with running(
        [*three_packages(tmp_path), "served_policies.py", "Stuck", "stuck", endpoint], tmp_path
    ):
        driver = found("zenoh:stuck", endpoint, tmp_path / "printed")
        driver.reset("k1", 1)
        asking = threading.Thread(target=asked, daemon=True)
        asking.start()
        while asking.is_alive() and not (tmp_path / "asked").exists():
            asking.join(0.02)
        telling = threading.Thread(target=driver.ended, daemon=True)
        telling.start()
        telling.join(PATIENCE_S)
        assert not telling.is_alive() and asking.is_alive()
    asking.join(PATIENCE_S)
    driver.close()


@pytest.mark.engine
def test_a_server_that_is_killed_loses_its_episode_which_is_run_again(
    tmp_path: Path, cosim: Cosim
) -> None:
    """kill -9 in the third question: another server drives it from its start, to the hash of a
    policy that drives in the simulator's process; the second time the episode has crashed. Rows and
    run.json say `remote`, and the record how long answers took. One that never answers has crashed
    at once."""
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
    with running(
        [*three_packages(tmp_path), "served_policies.py", "Dying", "dying", endpoint], tmp_path
    ):
        found("zenoh:dying", endpoint, tmp_path / "printed").close()
        said = cosim("run", "three.json", *words, "--answer-timeout", "5", cwd=tmp_path)
    a, b, c = sorted(read_records(tmp_path / "run"), key=lambda record: record.scenario.id)
    here = suite_run.run(
        Suite(name="three", version="1", scenarios=(one_second("a"),)),
        Honest(),
        options=EpisodeOptions(seed=seed),
    )
    assert (a.status, [a.state_hash]) == ("done", here["state_hash"].tolist()), (
        a.reason + said.stderr
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
        and "policy remote" in said.stdout
    )
    assert said.returncode == 1 and (tmp_path / "thirds").stat().st_size == 5
