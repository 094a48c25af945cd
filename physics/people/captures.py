"""Motion captures that ship with PyBullet, converted to the SMPL joints.

The files are those of DeepMimic's humanoid: a list of frames of 44 numbers.
Each frame holds its duration, then the root's position and quaternion (w x y z).
The joints follow: chest, neck, right hip, knee, ankle, shoulder, elbow, and the same five of the
left.
Knees and elbows are one angle about z, all others are quaternions.
The file's axes are x ahead, y up, z right; in the rest pose the arms hang.
"""

from __future__ import annotations

import importlib.util
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from cosim.core.errors import EngineError
from cosim.core.geometry import Floats
from physics.people.skeleton import INDEX, model_pose, rodrigues

_COLUMNS: Final = {
    "pelvis": 4,
    "chest": 8,
    "neck": 12,
    "right_hip": 16,
    "right_knee": 20,
    "right_ankle": 21,
    "right_shoulder": 25,
    "right_elbow": 29,
    "left_hip": 30,
    "left_knee": 34,
    "left_ankle": 35,
    "left_shoulder": 39,
    "left_elbow": 43,
}
_HINGES: Final = ("right_knee", "right_elbow", "left_knee", "left_elbow")


@dataclass(frozen=True, slots=True)
class Capture:
    """Captured motion in the axes of the body.

    turns: (F, 24, 3, 3) rotations of each joint relative to its parent
    pelvis_m: (F, 3)
    """

    frame_s: float
    turns: Floats
    pelvis_m: Floats


def capture(name: str) -> Capture:
    """Load the capture `humanoid3d_<name>` of pybullet_data.

    Raises EngineError naming the file and the fault.
    """
    found = importlib.util.find_spec("pybullet_data")
    if found is None or not found.submodule_search_locations:
        raise EngineError(
            "pybullet_data is missing, which comes with PyBullet: install pybullet again"
        )
    return read_capture(
        Path(found.submodule_search_locations[0]) / "data" / "motions" / f"humanoid3d_{name}.txt"
    )


def read_capture(path: Path) -> Capture:
    """Read a capture from a file. Raises EngineError naming the file and the fault."""
    try:
        rows = np.array(json.loads(path.read_text())["Frames"], dtype=float)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise EngineError(f"{path}: not a motion capture: {error}") from error
    if rows.ndim != 2 or rows.shape[1] != 44 or len(rows) < 4 or not np.isfinite(rows).all():
        raise EngineError(
            f"{path}: not a motion capture: 'Frames' must be 4 or more rows of 44 numbers"
        )
    pelvis = rows[:, 1:4] @ np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    return Capture(float(rows[0, 0]), _turns(rows), pelvis)


def _turns(rows: Floats) -> Floats:
    """Return (F, 24, 3, 3) rotations relative to the T pose.

    The chest's rotation is divided among three joints, the neck's among two.
    """
    local = {name: _turn(rows, name) for name in _COLUMNS}
    turns = np.tile(np.eye(3), (len(rows), 24, 1, 1))
    for name in (
        "pelvis",
        "right_hip",
        "right_knee",
        "right_ankle",
        "left_hip",
        "left_knee",
        "left_ankle",
    ):
        turns[:, INDEX[name]] = rodrigues(local[name])
    for name in ("spine1", "spine2", "spine3"):
        turns[:, INDEX[name]] = rodrigues(local["chest"] / 3.0)
    for name in ("neck", "head"):
        turns[:, INDEX[name]] = rodrigues(local["neck"] / 2.0)
    hanging = model_pose(0.5 * np.pi)
    for side in ("left", "right"):
        down = hanging[INDEX[f"{side}_shoulder"]]
        turns[:, INDEX[f"{side}_shoulder"]] = rodrigues(local[f"{side}_shoulder"]) @ down
        turns[:, INDEX[f"{side}_elbow"]] = down.T @ rodrigues(local[f"{side}_elbow"]) @ down
    return turns


def _turn(rows: Floats, name: str) -> Floats:
    """Return (F, 3) axis-angle vectors of a joint relative to its parent, in the body's axes.

    Both rest poses have hanging arms.
    """
    at = _COLUMNS[name]
    if name in _HINGES:
        return np.column_stack([np.zeros(len(rows)), -rows[:, at], np.zeros(len(rows))])
    w, x, y, z = rows[:, at : at + 4].T
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(np.column_stack([x, -z, y, w])).as_rotvec()
