"""A ROS 2 node for tests, on a Zenoh session of its own: it answers /odom with /cmd_vel.

As a program it steers to /goal_pose: python -m tests.support.ros2_peer ENDPOINT [DOMAIN]
"""

from __future__ import annotations

import math
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any, NamedTuple, Self

from bridge.ros2 import messages, types
from bridge.ros2.commands import TWIST, TWIST_STAMPED, Received
from bridge.ros2.node import Network, Ros2Node
from bridge.session import Session, open_session
from cosim.core.errors import EngineError
from cosim.core.state import Command
from cosim.spec.connection import Connection
from cosim.spec.ros2 import CMD_VEL, PUBLISHED_TOPICS


class Seen(NamedTuple):
    """What an /odom message says, and the goal before it."""

    time_ns: int
    x_m: float
    y_m: float
    heading_rad: float
    goal: tuple[float, float]


def steer(seen: Seen) -> Command:
    """Return the command towards the goal: slower where it is aside."""
    bearing = math.atan2(seen.goal[1] - seen.y_m, seen.goal[0] - seen.x_m) - seen.heading_rad
    bearing = math.atan2(math.sin(bearing), math.cos(bearing))
    return Command(1.0 if abs(bearing) < 0.5 else 0.2, bearing)


def heading_of(turn: Any) -> float:
    """Return the heading of a quaternion in radians."""
    return math.atan2(
        2.0 * (turn.w * turn.z + turn.x * turn.y), 1.0 - 2.0 * (turn.y**2 + turn.z**2)
    )


def twist(command: Command) -> Any:
    """Return a command as a Twist."""
    linear = types.message("geometry_msgs/msg/Vector3", command.v_mps, 0.0, 0.0)
    angular = types.message("geometry_msgs/msg/Vector3", 0.0, 0.0, command.w_radps)
    return types.message(TWIST, linear, angular)


def stamped(command: Command, time_ns: int) -> Any:
    """Return a command as a TwistStamped."""
    return types.message(TWIST_STAMPED, messages.header(time_ns, messages.BASE), twist(command))


Answer = Callable[["Peer", Seen], None]


def answers(peer: Peer, seen: Seen) -> None:
    """Steer to the goal."""
    peer.node.publish(CMD_VEL, twist(steer(seen)))


def _opened(endpoint: str) -> Session:
    """Return a session to a hub, which may not listen yet."""
    while True:
        with suppress(EngineError):
            return open_session(Connection(role="worker", connect=endpoint))


class Peer:
    """A node that calls `answer` for each /odom. seen: what it has received, by topic."""

    def __init__(
        self,
        endpoint: str,
        answer: Answer = answers,
        network: Network = Network(),  # noqa: B008
        type_name: str = TWIST,
        name: str = "driver",
        *,
        reads: bool = True,
    ) -> None:
        self.session = _opened(endpoint)
        self.node = Ros2Node(self.session, network, name, ordered=True)
        self.seen: dict[str, list[Any]] = {topic: [] for topic in PUBLISHED_TOPICS}
        self.goal: tuple[float, float] | None = None
        self._answer = answer
        self._lock = threading.Lock()
        self._closed = False
        self._unanswered: Any = None
        self.node.advertise(CMD_VEL, type_name)
        if reads:
            self.subscribe()

    def subscribe(self) -> None:
        for topic in ("/clock", "/cosim/episode", "/goal_pose", "/odom"):
            self.node.subscribe(
                topic, (PUBLISHED_TOPICS[topic],), lambda got, topic=topic: self._take(topic, got)
            )  # type: ignore[misc]

    def _take(self, topic: str, got: Received) -> None:
        message = types.from_cdr(got.payload, PUBLISHED_TOPICS[topic])
        self.seen[topic].append(message)
        with self._lock:
            if topic == "/goal_pose":
                self.goal = message.pose.position.x, message.pose.position.y
            if topic == "/odom":
                self._unanswered = message
            if self._unanswered is not None and self.goal is not None and not self._closed:
                odometry, self._unanswered = self._unanswered, None
                at, turn = odometry.pose.pose.position, odometry.pose.pose.orientation
                time_ns = messages.ns_of(odometry.header.stamp)
                self._answer(self, Seen(time_ns, at.x, at.y, heading_of(turn), self.goal))

    def close(self) -> None:
        with self._lock:
            self._closed = True
        self.session.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


if __name__ == "__main__":
    with Peer(sys.argv[1], network=Network(int(*sys.argv[2:3] or "0"))):
        print("here", flush=True)
        while True:
            time.sleep(3600.0)
