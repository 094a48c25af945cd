"""Runs on a Ray cluster of several nodes."""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from cosim import run
from cosim.core.errors import UsageError
from cosim.policies.baselines import Straight
from cosim.results.run_folder import read_spec
from cosim.spec.scenario import Suite, write_suite
from scenarios.runs.ray_workers import RayWorkers, ray_cluster
from scenarios.tools.verify.doctor import small_scenario
from tests.conftest import PATIENCE_S, Cosim, still_runs
from tests.run_specs import changed

POLICY = '''
import os, time
from pathlib import Path
from cosim.core.state import Command
from cosim.spec.manifest import Manifest


class Waits:
    """Drives straight on, once there is a file."""

    manifest = Manifest("waits", rate_hz=4.0, camera=None)

    def reset(self, episode_id, seed):
        go = Path(os.environ["COSIM_TEST_GO"])
        (go.parent / f"begun-{os.getpid()}-{episode_id}").touch()

    def act(self, observation):
        while observation.time_s > 0.0 and not Path(os.environ["COSIM_TEST_GO"]).exists():
            time.sleep(0.01)
        return Command(0.8, 0.0)
'''
SCENARIOS = 4
_WAITS = (
    "gcs_rpc_server_connect_timeout_s",
    "gcs_server_request_timeout_seconds",
    "gcs_server_port_wait_time_s",
    "raylet_start_wait_time_s",
    "worker_register_timeout_seconds",
)


@pytest.fixture(scope="module")
def nodes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Any, list[Any], Path]]:
    """Return a head without CPUs, two nodes of one CPU each, and the file that the policy waits
    for; all are processes of this machine."""
    go = tmp_path_factory.mktemp("ray") / "go"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COSIM_TEST_GO", str(go))
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        for name in _WAITS:  # of Ray's own some are 5 s, which a busy machine needs
            patch.setenv(f"RAY_{name}", str(int(PATIENCE_S)))
        cluster_utils = pytest.importorskip(
            "ray.cluster_utils", reason="Ray is not installed: the extra [ray]"
        )
        store = {"object_store_memory": 80 << 20, "include_dashboard": False}
        cluster = cluster_utils.Cluster(
            initialize_head=True, head_node_args={"num_cpus": 0, **store}
        )
        patch.setenv("RAY_ADDRESS", cluster.address)
        try:
            yield (
                cluster,
                [cluster.add_node(num_cpus=1, object_store_memory=80 << 20) for _ in range(2)],
                go,
            )
        finally:
            cluster.shutdown()


@pytest.mark.engine
def test_a_run_on_ray_equals_that_of_one_process_when_a_node_dies(
    tmp_path: Path, nodes: tuple[Any, list[Any], Path], cosim: Cosim
) -> None:
    """The lost episode of a killed node is run again, and the tables are equal to the byte. The
    policy is on this machine alone; nodes with other versions are refused."""
    cluster, (first, _), go = nodes
    (tmp_path / "only_here.py").write_text(POLICY)
    one = msgspec.structs.replace(small_scenario(), time_limit_s=2.0)
    each = tuple(msgspec.structs.replace(one, id=f"n-{i}", seed=i) for i in range(SCENARIOS))
    write_suite(Suite(name="four", version="1", scenarios=each), tmp_path / "four.json")

    def kill_one() -> None:
        while len([*go.parent.glob("begun-*")]) < 2:
            time.sleep(0.05)
        pids = [int(path.name.split("-")[1]) for path in go.parent.glob("begun-*")]
        cluster.remove_node(first, allow_graceful=False)
        until_s = time.monotonic() + PATIENCE_S
        while (
            all(map(still_runs, pids)) and time.monotonic() < until_s
        ):  # what ran there must not end first
            time.sleep(0.05)
        go.touch()

    killer = threading.Thread(target=kill_one, daemon=True)
    killer.start()
    words = ("run", "four.json", "--policy", "only_here:Waits", "--seed", "3", "--out")
    done = cosim(*words, "ray", "--on", "ray", "--log-json", "log.jsonl", cwd=tmp_path)
    assert "2 workers on Ray" in done.stderr and done.returncode == 0, done
    killer.join(PATIENCE_S)
    assert len([*go.parent.glob("begun-*")]) > SCENARIOS, (
        "the episode of the node that died was not run again"
    )
    assert cosim(*words, "here", cwd=tmp_path).returncode == 0
    assert (tmp_path / "ray/results.csv").read_bytes() == (
        tmp_path / "here/results.csv"
    ).read_bytes()

    events = [
        json.loads(line)["event"] for line in (tmp_path / "log.jsonl").read_text().splitlines()
    ]
    assert (events[0], events[-1], events.count("done")) == ("run begun", "run over", SCENARIOS)
    assert events.count("lost") == events.count("retried") == 1
    (figures,) = json.loads((tmp_path / "ray/figures.json").read_text())
    assert (figures["episodes"], figures["retried"], figures["simulated_s"]) == (
        SCENARIOS,
        1,
        SCENARIOS * 2.0,
    )

    spec = read_spec(tmp_path / "ray")
    other_versions = changed(spec, versions=spec.setup.versions | {"numpy": "0.1"})
    with ray_cluster("auto", "straight", print):
        workers = RayWorkers(other_versions, tmp_path, 1, 1, print)
        with pytest.raises(
            UsageError, match=r"node .* has numpy .* in place of 0\.1: install on the nodes"
        ):
            while not workers.room(0):
                workers.wait(1.0)


def test_an_invalid_cluster_is_refused(cosim: Cosim, tmp_path: Path) -> None:
    """An unknown word, and options for local processes, are refused in one line, and no file is
    left."""
    pytest.importorskip("ray", reason="Ray is not installed: the extra [ray]")
    words = ("run", "reactive", "--policy", "straight", "--episodes", "1")
    done = cosim(*words, "--on", "spark", cwd=tmp_path)
    assert (
        done.returncode == 2
        and "--on spark: give ray, auto, or the address of a cluster" in done.stderr
    )
    done = cosim(*words, "--on", "ray", "--shared-renderer", cwd=tmp_path)
    assert (
        done.returncode == 2 and "--shared-renderer needs processes of this machine" in done.stderr
    )
    with pytest.raises(UsageError, match="shared_renderer needs processes of this machine"):
        run("reactive", "straight", on="ray", shared_renderer=True, out=tmp_path / "run")
    with pytest.raises(UsageError, match="on='ray' needs a policy by its name"):
        run("reactive", Straight(), on="ray")
    assert not [*tmp_path.iterdir()]


def test_a_missing_ray_is_named_with_its_installation(
    cosim: Cosim, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One line says what to install, before anything is loaded."""
    monkeypatch.setitem(sys.modules, "ray", None)
    done = cosim("run", "reactive", "--policy", "straight", "--on", "ray", cwd=tmp_path)
    assert (
        done.returncode == 2
        and "pip install -e '.[ray]' in the checkout" in done.stderr
        and not [*tmp_path.iterdir()]
    )
