"""Episodes driven by a ROS 2 node in a process of its own."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import ClassVar

import pytest

from bridge.ros2 import encode
from cosim.core.state import Command
from cosim.episode.interfaces import Observation
from cosim.results.log import Log
from cosim.results.record import Record
from cosim.spec.connection import Connection
from cosim.spec.manifest import Manifest
from cosim.spec.options import EpisodeOptions, PolicyHost
from cosim.spec.ros2 import Ros2Settings
from scenarios.runs.run import run
from tests.conftest import ROOT
from tests.support.plain import free_port
from tests.support.ros2_peer import Seen, steer

pytestmark = pytest.mark.engine
SEEDED = EpisodeOptions(seed=1)


class Same:
    """The rule of the node, in this process."""

    manifest: ClassVar = Manifest(
        "same", rate_hz=10.0, camera=None, goal="route_point", odometry="exact"
    )

    def reset(self, episode_id: str, seed: int) -> None:
        self.sent = encode.SentGoal()

    def act(self, seen: Observation) -> Command:
        self.sent, *_ = encode.new_goal(seen, self.sent, 0)
        pose = encode.odometry(seen, 0).pose.pose
        assert self.sent.point is not None
        turn = encode.heading_of(pose.orientation)
        return steer(Seen(0, pose.position.x, pose.position.y, turn, self.sent.point))


@contextmanager
def node_at(endpoint: str) -> Iterator[None]:
    """A node in a process of its own, started before the run."""
    words = [sys.executable, "-m", "tests.support.ros2_peer", endpoint]
    with subprocess.Popen(words, cwd=ROOT) as process:
        try:
            yield
        finally:
            process.kill()


def test_a_node_drives_as_the_same_rule_in_this_process(tmp_path: Path) -> None:
    """Two runs of a node in its own process have the state hash and the commands of the rule as a
    policy of this process, and say how they waited."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    at = Connection(role="coordinator", listen=endpoint, guests=("ros2",))
    host = PolicyHost(ros2=Ros2Settings(connection=at, camera="none", odometry="exact"))
    chosen = {"scenarios": ["straight-001"], "options": SEEDED}
    run("unit", Same(), out=tmp_path / "here", **chosen)  # type: ignore[arg-type]
    with node_at(endpoint):
        for name in ("one", "two"):
            table = run("unit", "ros2:", host=host, out=tmp_path / name, **chosen)  # type: ignore[arg-type]
            assert table["policy_runs"].tolist() == ["ros2, next"]
            assert table["status"].tolist() == ["done"], table["reason"].tolist()
    logs = [
        Log.load(tmp_path / name / "episodes" / "straight-001" / "trajectory.npz")
        for name in ("here", "one", "two")
    ]
    assert all((one.command == logs[0].command).all() for one in logs)
    hashes = {
        Record.load(tmp_path / name / "episodes" / "straight-001" / "record.json").state_hash
        for name in ("here", "one", "two")
    }
    assert len(hashes) == 1
