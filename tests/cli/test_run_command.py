"""`cosim run` as a newcomer uses it: a policy from its file, the output, and the next steps."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

import msgspec
import pytest

from cosim.spec.episode_id import drives_second
from cosim.spec.scenario import CrowdSpec, Suite, write_suite
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
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a suite of one short scenario, and a policy in its own folder with a module
    that it imports."""
    folder = tmp_path_factory.mktemp("workspace")
    one = msgspec.structs.replace(small_scenario(), id="n-0", time_limit_s=1.0)
    write_suite(Suite(name="one", version="1", scenarios=(one,)), folder / "one.json")
    (folder / "deeper").mkdir()
    (folder / "deeper/far.py").write_text(POLICY)
    (folder / "deeper/speeds.py").write_text("AHEAD_MPS = 1.0")
    return folder


PEEKS = """
from pathlib import Path
import cosim

Path(__file__).parents[1].joinpath("secret.txt").read_text()

class Peeks:
    manifest = cosim.Manifest("peeks", camera=None, goal="route_point")
    def reset(self, episode, seed): pass
    def act(self, observation):
        return cosim.Command(0.5, 0.1 * float(observation.goal.y_m))
"""
OWN = """
name = "own"
place = {city = 1, size_m = 500}
way = {kind = "straight", length_m = 30}
limits = {time_s = 1}
"""


@pytest.mark.engine
def test_every_command_that_runs_a_policy_can_isolate_it(tmp_path: Path, cosim: Cosim) -> None:
    """In runs, checks and collections it cannot read beyond its folder; --policy-data adds a
    folder."""
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/peeks.py").write_text(PEEKS)
    (tmp_path / "secret.txt").write_text("secret")
    (tmp_path / "own.toml").write_text(OWN)
    write_suite(Suite(name="one", version="1", scenarios=(small_scenario(),)), tmp_path / "s.json")
    name = "mine/peeks.py:Peeks"
    commands = {
        "check": ("policy", "check", name, "--frames", "2"),
        "own": ("scenario", "run", "own.toml", "--policy", name, "--out", "own"),
        "collect": ("collect", "s.json", "--policy", name, "--unsolved", "--out", "demos"),
    }
    for command in commands.values():
        result = cosim(*command, "--isolated", cwd=tmp_path)
        assert result.returncode == 2 and "--policy-data" in result.stderr, (command, result.stderr)
    shown = ("--isolated", "--policy-data", "secret.txt")
    result = cosim(*commands["own"], *shown, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    spec = json.loads((tmp_path / "own/run.json").read_text())
    assert spec["policy_runs"] in ("isolated: namespaces", "isolated: landlock")
    result = cosim(*commands["check"], *shown, cwd=tmp_path)
    assert result.returncode in (0, 1) and "peeks" in result.stdout, result.stderr


MEMORY = """
import os
from pathlib import Path
import cosim

SEEN = []
FILE = Path(__file__).with_name("seen.txt")


class Memory:
    manifest = cosim.Manifest("memory", camera=None, goal="final_point", rate_hz=4.0)

    def reset(self, episode, seed):
        self.begins = True

    def act(self, observation):
        if self.begins:
            place = round(observation.goal.x_m, 3)
            with FILE.open("a") as file:
                file.write(f"{place} {os.getpid()} {place in SEEN}\\n")
            SEEN.append(place)
            self.begins = False
        return cosim.Command(0.0, 0.0)
"""
"""Policy that recognizes the second member of a pair by its first view, if its process has run the
first one."""


@pytest.mark.engine
def test_no_process_of_a_policy_runs_both_members_of_a_pair(tmp_path: Path, cosim: Cosim) -> None:
    """A policy with memory cannot recognize a decoy, because each half of the run has its own
    process."""
    (tmp_path / "memory.py").write_text(MEMORY)
    nobody = CrowdSpec(persons=0, vehicles=0)
    small = msgspec.structs.replace(small_scenario(), time_limit_s=0.5, crowd=nobody)
    x_m, y_m, heading_rad = small.start
    events = [
        msgspec.structs.replace(small, id=f"n-{k}", start=(x_m, y_m, heading_rad + 0.1 * k))
        for k in range(3)
    ]
    decoys = [msgspec.structs.replace(one, id=f"{one.id}-decoy", decoy_of=one.id) for one in events]
    suite = Suite(name="pairs", version="1", scenarios=(*events, *decoys))
    write_suite(suite, tmp_path / "pairs.json")
    for seed in (1, 2):
        halves = [{one.id: drives_second(seed, one) for one in those} for those in (events, decoys)]
        assert all(halves[0][one.decoy_of] != halves[1][one.id] for one in decoys)
    words = ("--policy", "memory.py:Memory", "--seed", "1", "--jobs", "1", "--out", "run")
    result = cosim("run", "pairs.json", *words, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    rows = [line.split() for line in (tmp_path / "seen.txt").read_text().splitlines()]
    places = Counter(place for place, _, _ in rows)
    assert sorted(places.values()) == [2, 2, 2]
    assert {seen for _, _, seen in rows} == {"False"}
    assert len({process for _, process, _ in rows}) == 2


@pytest.mark.engine
def test_a_policy_by_file_equals_the_policy_by_module(workspace: Path, cosim: Cosim) -> None:
    """Isolated processes load it too, and a run resumes with either spelling until the file is
    edited."""
    suite, out = str(workspace / "one.json"), str(workspace / "run")
    by_file = ("run", suite, "--policy", "deeper/far.py:Far", "--isolated", "--out", out)
    result = cosim(*by_file, cwd=workspace)
    assert result.returncode == 0, result.stderr
    assert (
        f"Next:\n  cosim film {out} --failure -o film.mp4\n  cosim report {out} -o report.html\n"
        in result.stderr
    )
    spec = json.loads((workspace / "run/run.json").read_text())
    kind = spec["policy_runs"]
    assert kind in ("isolated: namespaces", "isolated: landlock") and spec["policy"] == "far:Far"
    row = f"policy far; sensor track blind; at 4 Hz; goal route_point; odometry wheel; policy {kind}; seed"
    assert row in result.stdout
    weak = cosim(*(*by_file[:4], "--isolated=weak", *by_file[5:]), "--resume", cwd=workspace)
    assert (
        weak.returncode == 2
        and f"its policy_runs is {kind}, and this command has isolated: weak" in weak.stderr
    ), weak.stderr
    by_module = ("run", suite, "--policy", "far:Far", "--isolated", "--out", out, "--resume")
    again = cosim(*by_module, cwd=workspace / "deeper")
    assert again.returncode == 0 and "1 of 1 episodes are finished already" in again.stderr, (
        again.stderr
    )
    (workspace / "deeper/far.py").write_text(POLICY + "# edited")
    edited = cosim(*by_file, "--resume", cwd=workspace)
    assert (
        edited.returncode == 2
        and "the source of policy 'far:Far' was edited since it began" in edited.stderr
    )


def test_the_file_of_a_policy_is_sent_to_a_cluster(
    workspace: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ray gets the named file, as for a module."""
    from scenarios.runs.ray_workers import _own_module

    monkeypatch.chdir(workspace)
    monkeypatch.syspath_prepend(workspace)
    assert _own_module("deeper/far.py:Far") == str(workspace / "deeper/far.py")
    assert _own_module("orca") == ""


def test_options_of_a_single_machine_are_refused_with_a_reason(
    cosim: Cosim, tmp_path: Path
) -> None:
    """They are refused before anything is loaded, opened or written, and the help does not offer
    them."""
    for words in (
        ("--shared-renderer",),
        ("--real-time",),
        ("--pace", "1"),
        ("--live", "tcp/127.0.0.1:7448"),
        ("--director", "x"),
    ):
        result = cosim("coordinator", "reactive", *words, cwd=tmp_path)
        assert result.returncode == 2 and f"{words[0]} is of one machine" in result.stderr, (
            result.stderr
        )
        assert "leave it out, or use `cosim run`" in result.stderr
    assert "--live" not in (result := cosim("coordinator", "--help").stdout) and "--shard" in result
    assert not [*tmp_path.iterdir()]


def test_a_shard_of_a_coordinator_is_checked_like_that_of_a_run(
    cosim: Cosim, tmp_path: Path
) -> None:
    """It needs the run's seed, and at most as many shards as scenarios."""
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
