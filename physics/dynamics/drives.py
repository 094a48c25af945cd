"""Choice of a robot's drive."""

from __future__ import annotations

from cosim.spec.robot import Legs, Robot
from physics.dynamics.drive import SUBSTEP_S, Drive, SkidDrive
from physics.dynamics.legs.gait_file import network_gait, robot_legs, user_gait
from physics.dynamics.legs.leg_drive import LegDrive
from physics.dynamics.legs.network_gait import NetworkSetup


def drive_of(robot: Robot, dt_s: float) -> Drive:
    """Return the drive of a robot.

    dt_s: duration of a substep.
    """
    if isinstance(robot.drive, Legs):
        return LegDrive(robot, robot.drive, dt_s)
    return SkidDrive(robot, robot.drive, dt_s)


def gait_drive(robot: Robot, gait: NetworkSetup, dt_s: float = SUBSTEP_S) -> Drive:
    """Return the drive of a robot with a gait of the user (`user_gait`)."""
    legs = robot_legs(robot, gait.manifest.name)
    return LegDrive(robot, legs, dt_s, network_gait(robot, legs, dt_s, gait), of_user=True)


def gait_hash(gait: str, robot: Robot) -> str:
    """Return the hash of the files of a user's gait; "" for the robot's own one.

    Raises as `user_gait` does, also if the weights of the robot's own gait are missing.
    """
    if gait:
        return user_gait(gait, robot, SUBSTEP_S).digest
    drive_of(robot, SUBSTEP_S)
    return ""
