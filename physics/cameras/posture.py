"""Place and attitude of a robot's body in pictures."""

from __future__ import annotations

from typing import NamedTuple

from cosim.core.state import RobotState
from cosim.spec.robot import Legs, Robot
from physics.street.surface import Surface


class Posture(NamedTuple):
    """Attitude of a robot's base link.

    at_m: position of its frame.
    roll_rad, pitch_rad, heading_rad: rotations about x, then y, then z.
    angles_rad: joint angles of legs by joint, empty for wheels.
    """

    at_m: tuple[float, float, float]
    roll_rad: float
    pitch_rad: float
    heading_rad: float
    angles_rad: dict[str, float]


def posture_of(surface: Surface, model: Robot, robot: RobotState) -> Posture:
    """Return the posture of a robot.

    Wheels lean with the ground. Legs are as in `RobotState.legs`; without it they are at rest.
    """
    x, y, heading = robot.pose
    drive = model.drive
    if not isinstance(drive, Legs):
        _, roll, pitch = surface.lean(robot.pose, drive.span_m)
        return Posture((x, y, robot.z_m), roll, pitch, heading, {})
    at = x, y, robot.z_m + drive.stand_m
    if robot.legs is None:
        return Posture(at, 0.0, 0.0, heading, dict(zip(drive.joints, drive.rest_rad, strict=True)))
    legs = robot.legs
    angles = dict(zip(drive.joints, legs.angles_rad, strict=True))
    return Posture(at, legs.roll_rad, legs.pitch_rad, heading, angles)
