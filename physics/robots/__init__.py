"""The URDFs of the robots, written for this project; their numbers stand in `cosim.spec.robot`."""

from __future__ import annotations

from pathlib import Path

from cosim.spec.robot import Robot


def urdf_of(robot: Robot) -> Path:
    """The file of a robot's bodies and joints."""
    return Path(__file__).parent / robot.urdf
