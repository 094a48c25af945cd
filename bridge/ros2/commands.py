"""Commands and plans of received messages, and why a message is refused. Pure functions."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from bridge.ros2.messages import ns_of
from bridge.ros2.types import NO_HASH, from_cdr
from bridge.ros2.wire import Attachment
from cosim.core.geometry import Floats
from cosim.core.state import Command
from cosim.spec.odometry import Odometry
from cosim.spec.ros2 import CMD_VEL, LARGEST_B, PLAN, TAKEN, Ros2Wait

TWIST, TWIST_STAMPED = COMMAND_TYPES = TAKEN[CMD_VEL]
(PATH,) = TAKEN[PLAN]
_TWIST_B: Final = 52
"""Size of a Twist in bytes, by which it is known where keys do not name the type."""
_WALL_NS: Final = 10**18
"""Stamps above are of a wall clock, in nanoseconds."""
_MOST_POINTS: Final = 32
"""Largest number of points of a plan that are recorded."""
_FRAMES: Final = ("", "map", "odom")
"""Frames in which a plan is read."""


class Received(NamedTuple):
    """A received message.

    type, hash: From its key; "" if the key does not name them.
    by: Its publisher in words.
    """

    payload: bytes
    type: str = ""
    hash: str = ""
    attachment: Attachment | None = None
    by: str = "a node"


class Judged(NamedTuple):
    """A command of a message; or why it is refused, in words. early: it answers an older tick."""

    command: Command | None = None
    fault: str = ""
    early: bool = False


def judged(
    got: Received, wait: Ros2Wait, tick_ns: int, wanted_hash: str, *, attached: bool
) -> Judged:
    """Return the command of a message on /cmd_vel.

    tick_ns: Time of the current tick, which is that of /clock.
    wanted_hash: Hash of its type in the run's distribution.
    attached: Whether the dialect has attachments.
    """
    if fault := _fault_of_form(got, wanted_hash, attached):
        return Judged(fault=f"{got.by} {fault}")
    name = got.type or (TWIST if len(got.payload) <= _TWIST_B else TWIST_STAMPED)
    try:
        sent = from_cdr(got.payload, name)
    except ValueError as error:
        return Judged(fault=f"{got.by} sends {CMD_VEL} with bytes that are {error}"[:400])
    twist = sent if name == TWIST else sent.twist
    speeds = float(twist.linear.x), float(twist.angular.z)
    if not all(map(math.isfinite, speeds)):
        return Judged(
            fault=f"{got.by} sends {CMD_VEL} with linear.x {speeds[0]} and angular.z {speeds[1]}: "
            "both must be finite numbers"
        )
    stamp_ns = 0 if name == TWIST else ns_of(sent.header.stamp)
    if tick_ns < stamp_ns <= _WALL_NS:
        return Judged(
            fault=f"{got.by} stamps {CMD_VEL} ahead of /clock: give it the time of the observation"
        )
    if stamp_ns > tick_ns:
        return Judged(
            fault=f"{got.by} stamps {CMD_VEL} {stamp_ns / 1e9:.2f} s, and /clock is at "
            f"{tick_ns / 1e9:.2f} s: start it with use_sim_time:=true, so that it reads /clock"
        )
    if wait == "stamped":
        if name == TWIST:
            return Judged(
                fault=f"{got.by} sends {CMD_VEL} as Twist, which has no stamp: --ros2-wait stamped "
                "needs TwistStamped with the stamp of the picture; or choose --ros2-wait next"
            )
        if stamp_ns < tick_ns:
            return Judged(early=True)
    return Judged(Command(*speeds))


def _fault_of_form(got: Received, wanted_hash: str, attached: bool) -> str:
    """Return why a message is refused unread, "" if it is not."""
    if got.type and got.type not in COMMAND_TYPES:
        return f"publishes {CMD_VEL} as {got.type}: publish {TWIST} or {TWIST_STAMPED}"
    if got.hash and got.hash != wanted_hash:
        return hash_fault(got.type, got.hash, wanted_hash)
    if len(got.payload) > LARGEST_B:
        return f"sends {len(got.payload)} bytes on {CMD_VEL}: a message has at most {LARGEST_B}"
    if attached and got.attachment is None:
        return f"sends {CMD_VEL} without the attachment of rmw_zenoh: see --ros2-dialect"
    return ""


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


def plan_in_robot_frame(payload: bytes, pose: Odometry) -> Floats | None:
    """Return the points of a nav_msgs/msg/Path, (N, 2) metres ahead and to the left of a robot.

    pose: The robot's estimated pose in `odom`, which is also `map`.
    None if it is empty, malformed, or in another frame. At most 32 points are returned, at equal
    steps of the path.
    """
    try:
        path = from_cdr(payload, PATH)
    except ValueError:
        return None
    if path.header.frame_id.strip("/") not in _FRAMES or not path.poses:
        return None
    points = np.array([(one.pose.position.x, one.pose.position.y) for one in path.poses])
    if not np.isfinite(points).all():
        return None
    chosen = np.linspace(0, len(points) - 1, min(len(points), _MOST_POINTS)).round().astype(int)
    heading = pose.heading_rad or 0.0
    cos, sin = math.cos(heading), math.sin(heading)
    offset = points[chosen] - (pose.x_m, pose.y_m)
    ahead_left: Floats = offset @ np.array([[cos, -sin], [sin, cos]])
    return ahead_left
