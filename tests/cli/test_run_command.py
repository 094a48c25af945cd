"""`cosim run` as a newcomer uses it: a policy by its file, what is printed, what to do next."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec
import pytest

from cosim.spec.scenario import Suite, write_suite
from scenarios.tools.verify.doctor import small_scenario
from tests.conftest import Cosim

POLICY = """
import numpy as np
import speeds
from cosim.core.state import Command
from cosim.spec.manifest import Manifest

class Far:
    manifest = Manifest("far", camera=None, goal="route_point", odometry="wheel")
    def reset(self, episode_id, seed): pass
    def act(self, observation):
        ahead_m, _ = np.asarray(observation.goal)
        return Command(min(ahead_m, speeds.AHEAD_MPS), 0.0 * np.asarray(observation.odometry).sum())
"""


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a suite of one short scenario, and a policy in a folder of its own, beside what
    it imports."""
    folder = tmp_path_factory.mktemp("desk")
    one = msgspec.structs.replace(small_scenario(), id="n-0", time_limit_s=1.0)
    write_suite(Suite(name="one", version="1", scenarios=(one,)), folder / "one.json")
    (folder / "deeper").mkdir()
    (folder / "deeper/far.py").write_text(POLICY)
    (folder / "deeper/speeds.py").write_text("AHEAD_MPS = 1.0")
    return folder


@pytest.mark.engine
def test_a_policy_by_its_file_is_the_one_by_its_module(desk: Path, cosim: Cosim) -> None:
    """Also in processes that only inherit where it is: isolated ones. The run goes on by any
    spelling, until edited."""
    suite, out = str(desk / "one.json"), str(desk / "run")
    by_file = ("run", suite, "--policy", "deeper/far.py:Far", "--isolated", "--out", out)
    said = cosim(*by_file, cwd=desk)
    assert said.returncode == 0, said.stderr
    assert (
        f"Next:\n  cosim film {out} --failure -o film.mp4\n  cosim report {out} -o report.html\n"
        in said.stderr
    )
    spec = json.loads((desk / "run/run.json").read_text())
    kind = spec["policy_runs"]
    assert kind in ("isolated: namespaces", "isolated: landlock") and spec["policy"] == "far:Far"
    row = f"policy far; at 4 Hz; goal route_point; odometry wheel; policy {kind}; seed"
    assert row in said.stdout
    weak = cosim(*(*by_file[:4], "--isolated=weak", *by_file[5:]), "--resume", cwd=desk)
    assert (
        weak.returncode == 2
        and f"its policy_runs is {kind}, now asked for is isolated: weak" in weak.stderr
    ), weak.stderr
    by_module = ("run", suite, "--policy", "far:Far", "--isolated", "--out", out, "--resume")
    again = cosim(*by_module, cwd=desk / "deeper")
    assert again.returncode == 0 and "1 of 1 episodes are finished already" in again.stderr, (
        again.stderr
    )
    (desk / "deeper/far.py").write_text(POLICY + "# edited")
    edited = cosim(*by_file, "--resume", cwd=desk)
    assert (
        edited.returncode == 2
        and "the source of policy 'far:Far' was edited since it began" in edited.stderr
    )


def test_the_file_of_a_policy_is_sent_to_a_cluster(
    desk: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ray is given the file that its name says, as for a module."""
    from scenarios.runs.ray_workers import _own_module

    monkeypatch.chdir(desk)
    monkeypatch.syspath_prepend(desk)
    assert _own_module("deeper/far.py:Far") == str(desk / "deeper/far.py")
    assert _own_module("orca") == ""


def test_what_is_of_one_machine_is_refused_in_words(cosim: Cosim, tmp_path: Path) -> None:
    """Before anything is loaded, listened to or written; its help does not offer it."""
    for words in (
        ("--shared-renderer",),
        ("--real-time",),
        ("--pace", "1"),
        ("--live", "tcp/127.0.0.1:7448"),
        ("--director", "x"),
    ):
        said = cosim("coordinator", "reactive", *words, cwd=tmp_path)
        assert said.returncode == 2 and f"{words[0]} is of one machine" in said.stderr, said.stderr
        assert "leave it out, or use `cosim run`" in said.stderr
    assert "--live" not in (told := cosim("coordinator", "--help").stdout) and "--shard" in told
    assert not [*tmp_path.iterdir()]


def test_a_shard_of_a_coordinator_is_one_of_a_run(cosim: Cosim, tmp_path: Path) -> None:
    """It needs the run's seed, and there are no more shards than scenarios."""
    words = (
        "coordinator",
        "reactive",
        "--policy",
        "straight",
        "--episodes",
        "2",
        "--listen",
        "unixsock-stream/hub",
    )
    assert "--shard needs --seed" in cosim(*words, "--shard", "1/2", cwd=tmp_path).stderr
    assert (
        "the run has 2 scenarios"
        in cosim(*words, "--shard", "1/3", "--seed", "1", cwd=tmp_path).stderr
    )
    assert not [*tmp_path.iterdir()]
