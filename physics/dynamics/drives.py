"""Choice of a robot's drive."""

from __future__ import annotations

from cosim.spec.robot import Legs, Robot
from physics.dynamics.drive import Drive, SkidDrive
from physics.dynamics.legs.leg_drive import LegDrive


def drive_of(robot: Robot, dt_s: float) -> Drive:
    """Return the drive of a robot. dt_s: duration of a substep."""
    if isinstance(robot.drive, Legs):
        return LegDrive(robot, robot.drive, dt_s)
    return SkidDrive(robot, robot.drive, dt_s)
