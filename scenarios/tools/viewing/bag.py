"""Recording of an episode as rosbag2 in MCAP, for Foxglove, rviz and `ros2 bag play`.

It has the topics and stamps that a ROS 2 node of the episode gets (`bridge.ros2.messages.TOPICS`),
/cmd_vel with each answer of the policy, and /plan with its waypoints. The observations come from a
replay, which must reach the recorded state hash. The same record gives the same bytes.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from bridge.ros2 import messages
from bridge.ros2.commands import PATH, TWIST_STAMPED
from bridge.ros2.types import message_store, to_cdr
from cosim.core.errors import UsageError, unwritable
from cosim.core.files import atomic_folder
from cosim.core.progress import Progress, ignore
from cosim.core.state import Command, WaypointCommand
from cosim.spec.camera import CameraSpec
from cosim.spec.goal import GOALS, Instruction, PointGoal
from cosim.spec.manifest import Manifest
from cosim.spec.ros2 import CMD_VEL, PLAN
from cosim.spec.run_config import CameraChoice
from scenarios.episodes.replay import (
    RecordedEpisode,
    ReplayChecker,
    check_state_hash,
    load_recorded,
    observed_replay,
)

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag2 import Writer

_VERSION: Final = 9
"""Version of the bag's metadata."""
_TYPES: Final = {name: row.type for name, row in messages.TOPICS.items()} | {
    CMD_VEL: TWIST_STAMPED,
    PLAN: PATH,
}
"""Type of each recorded topic."""
_SENT_GOALS: Final = (PointGoal, Instruction)
"""Goals that have a topic."""


def write_bag(
    folder: Path,
    scenario_id: str,
    output: Path,
    *,
    picture: CameraSpec | None = None,
    camera: CameraChoice = "auto",
    progress: Progress = ignore,
) -> int:
    """Write the bag of a finished episode of a run, and return its number of messages.

    output: New folder.
    picture: Camera in place of the policy's, for an episode without pictures or with others.
    camera: Renderer.

    Raises MachineError without the extra [ros2] or if the folder cannot be written, UsageError if
    it exists, RunError if the episode does not exist or the replay differs.
    """
    message_store()
    if output.exists():
        raise UsageError(f"{output} is there already: choose another name, or remove it")
    recorded = load_recorded(folder, scenario_id)
    manifest = manifest_of_bag(recorded.record.manifest, picture)
    try:
        with atomic_folder(output, existing="refuse") as part:
            return _write(folder, recorded, manifest, part / "bag", camera, progress)
    except OSError as error:
        raise unwritable(output, error) from error


def manifest_of_bag(recorded: Manifest, picture: CameraSpec | None) -> Manifest:
    """Return the sensors of a bag: those of the policy without privileged state.

    Odometry without a heading becomes the exact one, because /odom needs a heading. Goals without
    a topic are not computed.
    """
    return replace(
        recorded,
        privileged=False,
        goal=recorded.goal if GOALS[recorded.goal].type in _SENT_GOALS else "none",
        camera=recorded.camera if picture is None else picture,
        odometry="wheel" if recorded.odometry == "wheel" else "exact",
    )


def _write(
    folder: Path,
    recorded: RecordedEpisode,
    manifest: Manifest,
    path: Path,
    camera: CameraChoice,
    progress: Progress,
) -> int:
    """Replay an episode into a bag, whose files are moved up to the parent of `path`."""
    from rosbags.rosbag2 import StoragePlugin, Writer

    progress("reading the street map, starting SUMO and PyBullet")
    episode, answers = observed_replay(recorded, manifest, camera)
    stream = messages.EpisodeStream(episode.id, episode.seed)
    with Writer(path, version=_VERSION, storage_plugin=StoragePlugin.MCAP) as writer, episode:
        bag_writer = _BagWriter(writer)
        episode.watch(ReplayChecker(folder, recorded).watch)
        for topic, sent in stream.begun():
            bag_writer.write(topic, sent, stream.time_ns(0))
        seen = episode.reset()
        while not episode.over:
            now_ns = stream.time_ns(seen.tick)
            for topic, sent in stream.observed(seen, lambda _: False):
                at_ns = messages.ns_of(sent.clock) if topic == messages.CLOCK else now_ns
                bag_writer.write(topic, sent, at_ns)
            command, delay = answers.at(seen.tick)
            bag_writer.answer(command, now_ns)
            seen = episode.advance(command, delay=delay)
            progress(f"recording {recorded.scenario.id}", episode.moment.tick / len(recorded.log))
        check_state_hash(folder, recorded, episode.state_hash)
    for file in path.iterdir():
        file.rename(path.parent / file.name)
    path.rmdir()
    return bag_writer.count


class _BagWriter:
    """Writes into a bag; a topic is declared with its first message."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._connections: dict[str, Connection] = {}
        self.count = 0

    def write(self, topic: str, sent: Any, time_ns: int) -> None:
        if topic not in self._connections:
            row = messages.TOPICS.get(topic)
            self._connections[topic] = self._writer.add_connection(
                topic,
                _TYPES[topic],
                typestore=message_store(),
                offered_qos_profiles=[_qos(latched=row is not None and row.qos.latched)],
            )
        self._writer.write(self._connections[topic], time_ns, to_cdr(sent))
        self.count += 1

    def answer(self, command: Command, time_ns: int) -> None:
        """Write an answer of the policy."""
        self.write(CMD_VEL, messages.stamped_command(command, time_ns), time_ns)
        if isinstance(command, WaypointCommand):
            self.write(PLAN, messages.waypoint_path(command.waypoints, time_ns), time_ns)


def _qos(*, latched: bool) -> Any:
    """Return the quality of service that players offer for a topic."""
    from rosbags.interfaces import (
        Qos,
        QosDurability,
        QosHistory,
        QosLiveliness,
        QosReliability,
        QosTime,
    )

    never = QosTime(2147483647, 4294967295)
    return Qos(
        QosHistory.KEEP_LAST,
        1 if latched else 10,
        QosReliability.RELIABLE,
        QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        never,
        never,
        QosLiveliness.AUTOMATIC,
        never,
        False,
    )
