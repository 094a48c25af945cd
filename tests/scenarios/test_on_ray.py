"""A run by a Ray cluster of several nodes."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from cosim.core.errors import UsageError
from cosim.policies.load import load_policy
from cosim.records.run_folder import RunFolder
from cosim.spec.options import EpisodeOptions
from cosim.spec.scenario import Suite
from scenarios.checks import small_scenario
from scenarios.execution.messages import Hello, Message, Progress
from scenarios.execution.pool import run_all
from scenarios.execution.process import LocalProcesses
from scenarios.execution.suite_run import run_spec
from scenarios.many.on_ray import RayWorkers, ray_cluster
from tests.conftest import PATIENCE_S, Cosim

POLICY = '''
import os, time
from pathlib import Path
from cosim.core.state import Command
from cosim.episode.ports import Manifest


class Waits:
    """Drives straight on, once there is a file."""

    manifest = Manifest("waits", rate_hz=4.0, camera=None)

    def reset(self, episode_id, seed):
        pass

    def act(self, observation):
        while observation.time_s > 0.0 and not Path(os.environ["COSIM_TEST_GO"]).exists():
            time.sleep(0.01)
        return Command(0.8, 0.0)
'''
SCENARIOS = 4
_WAITS = (
    "gcs_rpc_server_connect_timeout_s", "gcs_server_request_timeout_seconds", "gcs_server_port_wait_time_s",
    "raylet_start_wait_time_s", "worker_register_timeout_seconds",
)  # fmt: skip


@pytest.fixture(scope="module")
def nodes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Any, list[Any], Path]]:
    """A head without CPUs and two nodes of one CPU, processes of this machine; and the file that is waited for."""
    go = tmp_path_factory.mktemp("ray") / "go"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COSIM_TEST_GO", str(go))
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        for name in _WAITS:  # of Ray's own some are 5 s, which a busy machine needs
            patch.setenv(f"RAY_{name}", str(int(PATIENCE_S)))
        cluster_utils = pytest.importorskip("ray.cluster_utils", reason="Ray is not installed: the extra [ray]")
        store = {"object_store_memory": 80 << 20, "include_dashboard": False}
        cluster = cluster_utils.Cluster(initialize_head=True, head_node_args={"num_cpus": 0, **store})
        patch.setenv("RAY_ADDRESS", cluster.address)
        try:
            yield cluster, [cluster.add_node(num_cpus=1, object_store_memory=80 << 20) for _ in range(2)], go
        finally:
            cluster.shutdown()


@pytest.mark.engine
def test_a_run_by_ray_is_the_run_of_one_process_also_when_a_node_dies(
    tmp_path: Path, nodes: tuple[Any, list[Any], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A policy that only this machine has is sent there; a node is killed while both run an episode: the episode that
    was lost is run again, and the tables are equal to the byte."""
    cluster, (first, _), go = nodes
    (tmp_path / "only_here.py").write_text(POLICY)
    monkeypatch.syspath_prepend(tmp_path)
    policy = "only_here:Waits"
    one = msgspec.structs.replace(small_scenario(), time_limit_s=2.0)
    whole = Suite(
        name="four", version="1",
        scenarios=tuple(msgspec.structs.replace(one, id=f"n-{i}", seed=i) for i in range(SCENARIOS)),
    )  # fmt: skip
    loaded = load_policy(policy)
    hello = Hello(policy, loaded.manifest, loaded.source_hash)
    spec = run_spec(whole, whole.scenarios, policy, loaded, EpisodeOptions(seed=3))
    begun: set[str] = set()
    told: list[str] = []

    def hear(message: Message) -> None:
        if isinstance(message, Progress):
            begun.add(message.scenario)
        if len(begun) == 2 and not go.exists():
            cluster.remove_node(first, allow_graceful=False)
            go.touch()

    with RunFolder.create(tmp_path / "ray", spec, whole) as held, ray_cluster("ray", policy, told.append):
        workers = RayWorkers(spec, held.path / "logs", None, SCENARIOS, told.append)
        assert workers.wanted == 2
        run_all(held, whole.scenarios, hello, workers, tell=hear)
        held.finish()
        with pytest.raises(UsageError, match=r"node .* has numpy .* in place of 0\.1: install on the nodes"):
            other = RayWorkers(
                msgspec.structs.replace(spec, versions=spec.versions | {"numpy": "0.1"}), held.path, 1, 1, told.append
            )
            run_all(held, whole.scenarios[:1], hello, other, tell=hear)
    assert go.exists() and workers.lost == 1
    with RunFolder.create(tmp_path / "here", spec, whole) as held:
        run_all(held, whole.scenarios, hello, LocalProcesses(held.path / "logs"), tell=lambda _: None)
        held.finish()
    assert (tmp_path / "ray/results.csv").read_bytes() == (tmp_path / "here/results.csv").read_bytes()


def test_what_is_no_cluster_is_refused(cosim: Cosim, tmp_path: Path) -> None:
    """A wrong word, and options of processes of this machine, in one line; and nothing is left."""
    pytest.importorskip("ray", reason="Ray is not installed: the extra [ray]")
    words = ("run", "reactive", "--policy", "straight", "--episodes", "1")
    said = cosim(*words, "--on", "spark", cwd=tmp_path)
    assert said.returncode == 2 and "--on spark: give ray, auto, or the address of a cluster" in said.stderr
    said = cosim(*words, "--on", "ray", "--shared-renderer", cwd=tmp_path)
    assert said.returncode == 2 and "--shared-renderer is of processes of this machine" in said.stderr
    assert not [*tmp_path.iterdir()]


def test_without_ray_it_is_said_what_to_install(cosim: Cosim, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In one line, before anything is loaded."""
    monkeypatch.setitem(sys.modules, "ray", None)
    said = cosim("run", "reactive", "--policy", "straight", "--on", "ray", cwd=tmp_path)
    assert said.returncode == 2 and "pip install 'sidewalk-cosim[ray]'" in said.stderr and not [*tmp_path.iterdir()]
