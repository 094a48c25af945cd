"""Received messages: the inbox, the commands and plans in them, and why a message is refused."""

from __future__ import annotations

import math
import threading
from collections import Counter, deque
from typing import Final, Literal, NamedTuple

import numpy as np

from bridge.ros2.messages import ns_of
from bridge.ros2.types import NO_HASH, from_cdr
from cosim.core.geometry import Floats
from cosim.core.state import Command
from cosim.spec.odometry import Odometry
from cosim.spec.ros2 import CMD_VEL, COMMAND_TOPICS, MAX_MESSAGE_B, PLAN, Ros2Wait

TWIST, TWIST_STAMPED = COMMAND_TYPES = COMMAND_TOPICS[CMD_VEL]
(PATH,) = COMMAND_TOPICS[PLAN]
_TWIST_B: Final = 52
"""Size of a Twist in bytes, by which it is known where keys do not name the type."""
_WALL_NS: Final = 10**18
"""Stamps above are of a wall clock, in nanoseconds."""
_MAX_POINTS: Final = 32
"""Largest number of points of a plan that are recorded."""
_FRAMES: Final = ("", "map", "odom")
"""Frames in which a plan is read."""

FaultKind = Literal[
    "type", "hash", "size", "attachment", "bytes", "number", "stamp", "frame", "publishers"
]
"""Kinds of faults of messages. Each is reported once in an episode for each topic."""


class Fault(NamedTuple):
    """Why a message is refused.

    words: its publisher and the remedy.
    """

    topic: str
    kind: FaultKind
    words: str


class Received(NamedTuple):
    """A received message.

    payload: Its bytes; empty if it is longer than `MAX_MESSAGE_B`.
    type, hash: From its key; "" if the key does not name them.
    sender: The gid of its publisher; empty if it is not known.
    by: Its publisher in words.
    size_b: Its size in bytes.
    """

    payload: bytes
    type: str = ""
    hash: str = ""
    sender: bytes = b""
    by: str = "a node"
    size_b: int = 0


class Judged(NamedTuple):
    """The command of a message. Without one the message is skipped, or refused with a fault."""

    command: Command | None = None
    fault: Fault | None = None


def judged(
    got: Received, wait: Ros2Wait, tick_ns: int, wanted_hash: str, *, attached: bool
) -> Judged:
    """Return the command of a message on /cmd_vel.

    tick_ns: Time of the current tick, which is that of /clock.
    wanted_hash: Hash of its type in the run's distribution.
    attached: Whether the dialect has attachments.
    """
    if fault := fault_of_form(got, CMD_VEL, wanted_hash, attached=attached):
        return Judged(fault=fault)

    def refused(kind: FaultKind, words: str) -> Judged:
        return Judged(fault=Fault(CMD_VEL, kind, f"{got.by} {words}"))

    name = got.type or (TWIST if len(got.payload) <= _TWIST_B else TWIST_STAMPED)
    try:
        sent = from_cdr(got.payload, name)
    except ValueError as error:
        return refused("bytes", f"sends {CMD_VEL} with bytes that are {error}"[:400])
    twist = sent if name == TWIST else sent.twist
    speeds = float(twist.linear.x), float(twist.angular.z)
    if not all(map(math.isfinite, speeds)):
        return refused(
            "number",
            f"sends {CMD_VEL} with linear.x {speeds[0]} and angular.z {speeds[1]}: both must be "
            "finite numbers",
        )
    stamp_ns = 0 if name == TWIST else ns_of(sent.header.stamp)
    if stamp_ns > tick_ns:
        return refused("stamp", _late_stamp(stamp_ns, tick_ns))
    if wait == "stamped" and name == TWIST:
        return refused(
            "stamp",
            f"sends {CMD_VEL} as Twist, which has no stamp: --ros2-wait stamped needs "
            "TwistStamped with the stamp of the observation; or choose --ros2-wait next",
        )
    if wait == "stamped" and stamp_ns < tick_ns:
        return Judged()  # an answer to an older observation
    return Judged(Command(*speeds))


def _late_stamp(stamp_ns: int, tick_ns: int) -> str:
    """Return the remedy for a stamp after the time of /clock, in words."""
    if stamp_ns <= _WALL_NS:
        return f"stamps {CMD_VEL} ahead of /clock: give it the time of the observation"
    return (
        f"stamps {CMD_VEL} {stamp_ns / 1e9:.2f} s, and /clock is at {tick_ns / 1e9:.2f} s: give it "
        "the time of the observation, or start a node of rclpy or rclcpp with use_sim_time:=true"
    )


def fault_of_form(got: Received, topic: str, wanted_hash: str, *, attached: bool) -> Fault | None:
    """Return why a message on a topic is refused unread.

    wanted_hash: Hash of its type in the run's distribution.
    attached: Whether the dialect has attachments.
    """
    kind: FaultKind
    if got.type and got.type not in COMMAND_TOPICS[topic]:
        kind = "type"
        words = f"publishes {topic} as {got.type}: publish {' or '.join(COMMAND_TOPICS[topic])}"
    elif got.hash and got.hash != wanted_hash:
        kind, words = "hash", hash_fault(got.type, got.hash, wanted_hash)
    elif got.size_b > MAX_MESSAGE_B:
        kind = "size"
        words = f"sends {got.size_b} bytes on {topic}: a message has at most {MAX_MESSAGE_B}"
    elif attached and not got.sender:
        kind = "attachment"
        words = f"sends {topic} without the attachment of rmw_zenoh: see --ros2-dialect"
    else:
        return None
    return Fault(topic, kind, f"{got.by} {words}")


def hash_fault(name: str, hash: str, wanted: str) -> str:
    """Return the remedy for a type hash of another distribution, in words."""
    if hash == NO_HASH:
        return "is of Humble, which has no type hashes: run with --ros2-distro humble"
    if wanted == NO_HASH:
        return f"sends type hashes ({hash[:14]}...), so it is not of Humble: see --ros2-distro"
    return (
        f"has another definition of {name} (hash {hash[:14]}..., here {wanted[:14]}...): such "
        "messages are not exchanged"
    )


def plan_points(
    got: Received, pose: Odometry, wanted_hash: str, *, attached: bool
) -> Floats | Fault:
    """Return the points of a message on /plan, (N, 2) metres ahead and to the left of a robot.

    At most 32 points are returned, at equal steps of the path.

    pose: The robot's estimated pose in `odom`, which is also `map`.
    wanted_hash, attached: See `fault_of_form`.
    """
    if fault := fault_of_form(got, PLAN, wanted_hash, attached=attached):
        return fault

    def refused(kind: FaultKind, words: str) -> Fault:
        return Fault(PLAN, kind, f"{got.by} sends {PLAN} {words}")

    try:
        path = from_cdr(got.payload, PATH)
    except ValueError as error:
        return refused("bytes", f"with bytes that are {error}"[:400])
    if path.header.frame_id.strip("/") not in _FRAMES:
        return refused("frame", f"in the frame '{path.header.frame_id[:64]}': use map or odom")
    if not path.poses:
        return refused("number", "without poses: a path has one or more")
    points = np.array([(one.pose.position.x, one.pose.position.y) for one in path.poses])
    if not np.isfinite(points).all():
        return refused("number", "with positions that are not finite numbers")
    chosen = np.linspace(0, len(points) - 1, min(len(points), _MAX_POINTS)).round().astype(int)
    heading = pose.heading_rad or 0.0
    cos, sin = math.cos(heading), math.sin(heading)
    offset = points[chosen] - (pose.x_m, pose.y_m)
    ahead_left: Floats = offset @ np.array([[cos, -sin], [sin, cos]])
    return ahead_left


class Inbox:
    """Unread messages of a topic, at most `most` of them and `max_b` bytes.

    newest: Whether the oldest message is dropped if it is full, instead of the new one.
    """

    def __init__(self, *, newest: bool, most: int = 1024, max_b: int = 4 << 20) -> None:
        self._newest = newest
        self._most = most
        self._max_b = max_b
        self._lock = threading.Lock()
        self._messages: deque[Received] = deque()
        self._held_b = 0

    def __len__(self) -> int:
        return len(self._messages)

    def put(self, got: Received) -> None:
        """Add a message, or drop one."""
        with self._lock:
            self._messages.append(got)
            self._held_b += len(got.payload)
            while len(self._messages) > self._most or self._held_b > self._max_b:
                lost = self._messages.popleft() if self._newest else self._messages.pop()
                self._held_b -= len(lost.payload)

    def take(self) -> Received | None:
        """Remove and return the oldest message; None without one."""
        with self._lock:
            if not self._messages:
                return None
            got = self._messages.popleft()
            self._held_b -= len(got.payload)
            return got

    def take_all(self) -> list[Received]:
        """Remove and return all messages, the oldest first."""
        with self._lock:
            taken, self._held_b = list(self._messages), 0
            self._messages.clear()
            return taken


class Remarks:
    """Faults of an episode's messages, by topic and kind. Any thread may add one."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._words: dict[tuple[str, FaultKind], str] = {}
        self._counts: Counter[tuple[str, FaultKind]] = Counter()

    def add(self, fault: Fault) -> bool:
        """Count a fault, and return whether it is the first one of its topic and kind."""
        key = fault.topic, fault.kind
        with self._lock:
            self._counts[key] += 1
            self._words.setdefault(key, fault.words)
            return self._counts[key] == 1

    @property
    def kinds(self) -> list[str]:
        """The first fault of each kind."""
        with self._lock:
            return list(self._words.values())

    @property
    def words(self) -> list[str]:
        """The first fault of each kind, with the number of such messages if there are several."""
        with self._lock:
            return [
                words + (f" ({count} messages)" if (count := self._counts[key]) > 1 else "")
                for key, words in self._words.items()
            ]

    def ended(self) -> list[str]:
        """Forget all faults, and return those that came several times."""
        with self._lock:
            repeated = [
                f"{self._counts[key]} messages in the episode: {words}"
                for key, words in self._words.items()
                if self._counts[key] > 1
            ]
            self._words.clear()
            self._counts.clear()
            return repeated
