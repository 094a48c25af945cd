"""Episodes driven by a ROS 2 node in another process."""

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


class LocalRule:
    """The rule of the node as a policy of this process."""

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
    """Run a node in another process, started before the run."""
    words = [sys.executable, "-m", "tests.support.ros2_peer", endpoint]
    with subprocess.Popen(words, cwd=ROOT) as process:
        try:
            yield
        finally:
            process.kill()


@contextmanager
def idle_at(endpoint: str) -> Iterator[None]:
    """Run a node that joins the run and publishes /cmd_vel without sending a command."""
    peers: list[Peer] = []
    joining = threading.Thread(
        target=lambda: peers.append(Peer(endpoint, name="idle", reads=False)), daemon=True
    )
    joining.start()
    try:
        yield
    finally:
        for one in peers:
            one.close()


@pytest.fixture(scope="module")
def local_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a run of the rule as a policy of this process."""
    folder = tmp_path_factory.mktemp("runs") / "here"
    run("unit", LocalRule(), scenarios=[NAME], options=SEEDED, out=folder)
    return folder


def test_a_node_drives_like_the_same_rule_in_this_process(local_run: Path, tmp_path: Path) -> None:
    """Two runs of a node have the state hash and the commands of the local rule, and end soon after
    their last episode. A second, silent publisher is reported."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    at = Connection(role="coordinator", listen=endpoint, guests=("ros2",))
    host = PolicyHost(ros2=Ros2Settings(connection=at, camera="none", odometry="exact"))
    chosen = {"scenarios": [NAME], "options": SEEDED}
    with node_at(endpoint):
        for name in ("one", "two"):
            received: list[tuple[Message, float]] = []

            def record_message(
                message: Message, received: list[tuple[Message, float]] = received
            ) -> None:
                received.append((message, time.monotonic()))

            with idle_at(endpoint) if name == "two" else nullcontext():
                table = run(
                    "unit", "ros2:", host=host, out=tmp_path / name, tell=record_message, **chosen
                )  # type: ignore[arg-type]
                over_s = time.monotonic()
            (done_s,) = [at_s for message, at_s in received if isinstance(message, Done)]
            assert over_s - done_s < 0.9 * ENDING_S, "its process was killed"
            reasons = [message.reason for message, _ in received if isinstance(message, Waits)]
            assert sum("two publishers of /cmd_vel" in one for one in reasons) == (name == "two")
            assert table["policy_runs"].tolist() == ["ros2, next"]
            assert table["status"].tolist() == ["done"], table["reason"].tolist()
    folders = [run / "episodes" / NAME for run in (local_run, tmp_path / "one", tmp_path / "two")]
    logs = [Log.load(folder / "trajectory.npz") for folder in folders]
    assert all((one.command == logs[0].command).all() for one in logs)
    assert len({Record.load(folder / "record.json").state_hash for folder in folders}) == 1


def test_a_bag_equals_the_messages_of_a_node(local_run: Path, tmp_path: Path) -> None:
    """Counts and stamps are those of the log, /clock precedes stamps of its time, every picture has
    a transform, and two exports are equal to the byte."""
    picture = CameraSpec(64, 40)
    for name in ("a", "b"):
        count = write_bag(local_run, NAME, tmp_path / name, picture=picture, camera="bullet")
    files = sorted(file.name for file in (tmp_path / "a").iterdir())
    assert files == ["bag.mcap", "metadata.yaml"]
    for name in files:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    log = Log.load(local_run / "episodes" / NAME / "trajectory.npz")
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
        write_bag(local_run, NAME, tmp_path / "a")
