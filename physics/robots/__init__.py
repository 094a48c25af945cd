"""URDF files of the robots; dimensions and limits are in `cosim.spec.robot`."""

from __future__ import annotations

import hashlib
from pathlib import Path

from cosim.spec.robot import Robot


def urdf_path(robot: Robot) -> Path:
    """Return the path of a robot's URDF file."""
    return Path(__file__).parent / robot.urdf


def gait_path(robot: Robot) -> Path:
    """Return the path of the manifest of a robot's own gait."""
    return Path(__file__).parent / f"{robot.name}_gait.json"


def robot_hash(robot: Robot) -> str:
    """Return a hash of a robot's specification, its URDF file and its gait's manifest."""
    files = [path for path in (urdf_path(robot), gait_path(robot)) if path.is_file()]
    data = repr(robot).encode() + b"".join(path.read_bytes() for path in files)
    return hashlib.blake2b(data, digest_size=8).hexdigest()
