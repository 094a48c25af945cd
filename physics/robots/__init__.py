"""The URDFs of the robots, written for this project; their numbers stand in `cosim.spec.robot`."""

from __future__ import annotations

import hashlib
from pathlib import Path

from cosim.spec.robot import Robot


def urdf_of(robot: Robot) -> Path:
    """The file of a robot's bodies and joints."""
    return Path(__file__).parent / robot.urdf


def hash_of_robot(robot: Robot) -> str:
    """Of its row and of the bodies and joints in its URDF: another robot under the same name has
    another."""
    return hashlib.blake2b(
        repr(robot).encode() + urdf_of(robot).read_bytes(), digest_size=8
    ).hexdigest()
