"""Step: all that happened in one tick, the value that the loop yields and everything else
consumes."""

from __future__ import annotations

from dataclasses import dataclass

from cosim.core.geometry import Pose
from cosim.core.state import Command, Frame, Motion, RobotState, Street
from cosim.spec.events import EventReply


@dataclass(frozen=True, slots=True)
class Step:
    """One tick. robot, street, route_s_m: at its start; motion, street_after, route_s_after_m: at
    its end.

    frame: what the camera saw, on ticks on which the policy was asked. route_s_m: arc length on the
    route.
    """

    tick: int
    robot: RobotState
    street: Street
    route_s_m: float
    frame: Frame | None
    command: Command
    events: EventReply
    motion: Motion
    street_after: Street
    route_s_after_m: float


@dataclass(frozen=True, slots=True)
class Reset:
    """Put the robot at rest at a pose, which lies at this arc length of the route."""

    pose: Pose
    route_s_m: float
