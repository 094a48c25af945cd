"""Episodes driven by a ROS 2 node in a process of its own."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import ClassVar

import pytest
from rosbags.rosbag2 import Reader

from bridge.ros2 import messages
from bridge.ros2.types import from_cdr
from cosim.core.errors import UsageError
from cosim.core.state import Command
from cosim.episode.interfaces import Observation
from cosim.results.log import Log
from cosim.results.record import Record
from cosim.spec.camera import CameraSpec
from cosim.spec.connection import Connection
from cosim.spec.manifest import Manifest
from cosim.spec.options import EpisodeOptions, PolicyHost
from cosim.spec.ros2 import CMD_VEL, Ros2Settings
from scenarios.ipc.child_process import ENDING_S
from scenarios.ipc.messages import Done, Message, Waits
from scenarios.runs.run import run
from scenarios.tools.viewing.bag import write_bag
from tests.conftest import ROOT
from tests.support.plain import free_port
from tests.support.ros2_peer import Peer, Seen, heading_of, steer

pytestmark = pytest.mark.engine
SEEDED = EpisodeOptions(seed=1)
NAME = "straight-001"


class Same:
    """The rule of the node, in this process."""

    manifest: ClassVar = Manifest(
        "same", rate_hz=10.0, camera=None, goal="route_point", odometry="exact"
    )

    def reset(self, episode_id: str, seed: int) -> None:
        self.sent = messages.SentGoal()

    def act(self, seen: Observation) -> Command:
        self.sent, *_ = messages.new_goal(seen, self.sent, 0)
        pose = messages.odometry(seen, 0).pose.pose
        assert self.sent.point is not None
        turn = heading_of(pose.orientation)
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


@contextmanager
def idle_at(endpoint: str) -> Iterator[None]:
    """A node that joins the run, and publishes /cmd_vel without sending anything."""
    there: list[Peer] = []
    joins = threading.Thread(
        target=lambda: there.append(Peer(endpoint, name="idle", reads=False)), daemon=True
    )
    joins.start()
    try:
        yield
    finally:
        for one in there:
            one.close()


@pytest.fixture(scope="module")
def here(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the rule as a policy of this process."""
    folder = tmp_path_factory.mktemp("runs") / "here"
    run("unit", Same(), scenarios=[NAME], options=SEEDED, out=folder)
    return folder


def test_a_node_drives_as_the_same_rule_in_this_process(here: Path, tmp_path: Path) -> None:
    """Two runs of a node in its own process have the state hash and the commands of the rule as a
    policy of this process, say how they waited, and end soon after their last episode. A second
    publisher, which is silent, is shown."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    at = Connection(role="coordinator", listen=endpoint, guests=("ros2",))
    host = PolicyHost(ros2=Ros2Settings(connection=at, camera="none", odometry="exact"))
    chosen = {"scenarios": [NAME], "options": SEEDED}
    with node_at(endpoint):
        for name in ("one", "two"):
            told: list[tuple[Message, float]] = []

            def tell(message: Message, told: list[tuple[Message, float]] = told) -> None:
                told.append((message, time.monotonic()))

            with idle_at(endpoint) if name == "two" else nullcontext():
                table = run("unit", "ros2:", host=host, out=tmp_path / name, tell=tell, **chosen)  # type: ignore[arg-type]
                over_s = time.monotonic()
            (done_s,) = [at_s for message, at_s in told if isinstance(message, Done)]
            assert over_s - done_s < 0.9 * ENDING_S, "its process was killed"
            reasons = [message.reason for message, _ in told if isinstance(message, Waits)]
            assert sum("two publishers of /cmd_vel" in one for one in reasons) == (name == "two")
            assert table["policy_runs"].tolist() == ["ros2, next"]
            assert table["status"].tolist() == ["done"], table["reason"].tolist()
    folders = [run / "episodes" / NAME for run in (here, tmp_path / "one", tmp_path / "two")]
    logs = [Log.load(folder / "trajectory.npz") for folder in folders]
    assert all((one.command == logs[0].command).all() for one in logs)
    assert len({Record.load(folder / "record.json").state_hash for folder in folders}) == 1


def test_a_bag_is_the_episode_as_a_node_gets_it(here: Path, tmp_path: Path) -> None:
    """Its counts and stamps are those of the log, /clock rises before stamps of its time, every
    picture has a transform of its time, and two exports are equal to the byte."""
    picture = CameraSpec(64, 40)
    for name in ("a", "b"):
        count = write_bag(here, NAME, tmp_path / name, picture=picture, camera="bullet")
    files = sorted(file.name for file in (tmp_path / "a").iterdir())
    assert files == ["bag.mcap", "metadata.yaml"]
    for name in files:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    log = Log.load(here / "episodes" / NAME / "trajectory.npz")
    times: dict[str, list[int]] = {}
    speeds = []
    with Reader(tmp_path / "a") as bag:
        assert bag.message_count == count
        for connection, at_ns, data in bag.messages():
            sent = from_cdr(data, connection.msgtype)
            times.setdefault(connection.topic, []).append(at_ns)
            if connection.topic == "/clock":
                assert messages.ns_of(sent.clock) == at_ns
            elif hasattr(sent, "header"):
                assert messages.ns_of(sent.header.stamp) == at_ns <= times["/clock"][-1]
            if connection.topic == CMD_VEL:
                speeds.append((sent.twist.linear.x, sent.twist.angular.z))
    observed = [messages.stamp_ns(int(tick)) for tick in log.answers[:, 0]]
    assert times["/camera/image_raw"] == times["/tf"] == times[CMD_VEL] == observed
    assert speeds == list(map(tuple, log.answers[:, 2:].tolist()))
    assert times["/clock"] == [messages.stamp_ns(tick) for tick in range(len(times["/clock"]))]
    with pytest.raises(UsageError, match="is there already"):
        write_bag(here, NAME, tmp_path / "a")
