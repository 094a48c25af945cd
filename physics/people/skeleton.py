"""The 24 joints of the SMPL layout, forward kinematics, and linear blend skinning.

Source: Loper, Mahmood, Romero, Pons-Moll, Black: SMPL, a skinned multi-person linear model, ACM TOG
34(6), 2015, section 3.
Our axes differ: x ahead, y left, z up, metres, the soles at z = 0.
The rest pose is a T: a joint without rotation has the axes of the body.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cosim.core.geometry import Floats

JOINTS: Final = (
    "pelvis",
    "left_hip",
    "right_hip",
    "spine1",
    "left_knee",
    "right_knee",
    "spine2",
    "left_ankle",
    "right_ankle",
    "spine3",
    "left_foot",
    "right_foot",
    "neck",
    "left_collar",
    "right_collar",
    "head",
    "left_shoulder",
    "right_shoulder",
    "left_elbow",
    "right_elbow",
    "left_wrist",
    "right_wrist",
    "left_hand",
    "right_hand",
)
"""Names in SMPL's order; a joint comes after its parent."""

PARENTS: Final = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)
"""Row of each joint's parent; the pelvis has none."""

INDEX: Final[Mapping[str, int]] = MappingProxyType({name: k for k, name in enumerate(JOINTS)})
MIRRORED: Final = (
    0,
    2,
    1,
    3,
    5,
    4,
    6,
    8,
    7,
    9,
    11,
    10,
    12,
    14,
    13,
    15,
    17,
    16,
    19,
    18,
    21,
    20,
    23,
    22,
)
"""Row of each joint's counterpart on the other side."""

REACH_RAD: Final = np.deg2rad(74.0)
"""Angle by which the arms are lowered from the T in the modelled pose, rad."""


@dataclass(frozen=True, slots=True)
class Skeleton:
    """Joint positions of a body at rest.

    rest_m: (24, 3)
    height_m: from sole to crown.
    """

    rest_m: Floats
    height_m: float

    @property
    def offsets_m(self) -> Floats:
        """Offsets (24, 3) of joints from their parents, and of the pelvis from the
        ground.
        """
        rest = self.rest_m
        return np.concatenate([rest[:1], rest[1:] - rest[list(PARENTS[1:])]])


def rodrigues(turns_rad: ArrayLike) -> Floats:
    """Return (..., 3, 3) rotations for (..., 3) axis-angle vectors.

    The paper calls it the exponential of a joint's axis-angle.
    """
    turns = np.asarray(turns_rad, dtype=float)
    angle = np.linalg.norm(turns, axis=-1)[..., None, None]
    across = np.cross(turns[..., None, :], -np.eye(3))
    # sin a / a and (1 - cos a) / a2; scipy's own would cost every process its import, 0.3 s
    once = np.sinc(angle / np.pi)
    twice = 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2
    return np.asarray(np.eye(3) + once * across + twice * (across @ across))


def axis_angle(matrices: Floats) -> Floats:
    """Return (..., 3) axis-angle vectors of (..., 3, 3) rotations of less than half a turn."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(matrices.reshape(-1, 3, 3)).as_rotvec().reshape(matrices.shape[:-1])


def forward(turns: Floats, pelvis_m: Floats, skeleton: Skeleton) -> tuple[Floats, Floats]:
    """Compute (F, 24, 3, 3) rotations and (F, 24, 3) positions of joints in the body frame.

    turns: (F, 24, 3, 3) rotations of each joint relative to its parent
    pelvis_m: (F, 3)

    It multiplies [turn | offset] along the chain of parents, as the paper's world transformation of
    a joint.
    """
    offsets = skeleton.offsets_m
    rotation = np.empty_like(turns)
    position = np.empty((*turns.shape[:2], 3))
    rotation[:, 0], position[:, 0] = turns[:, 0], pelvis_m
    for joint, parent in enumerate(PARENTS[1:], start=1):
        rotation[:, joint] = rotation[:, parent] @ turns[:, joint]
        position[:, joint] = position[:, parent] + rotation[:, parent] @ offsets[joint]
    return rotation, position


def model_pose(reach_rad: float = float(REACH_RAD)) -> Floats:
    """Return (24, 3, 3) rotations of the A pose of modelled bodies: the T with lowered arms."""
    turns = np.zeros((24, 3))
    turns[INDEX["left_shoulder"], 0], turns[INDEX["right_shoulder"], 0] = -reach_rad, reach_rad
    return rodrigues(turns)


def skinning(
    rotation: Floats, position: Floats, bind: tuple[Floats, Floats]
) -> NDArray[np.float32]:
    """Return (F, 24, 3, 4) float32 matrices from the modelled pose to the posed body.

    bind: rotations (24, 3, 3) and positions (24, 3) of the joints in the modelled pose

    They are the paper's G'(theta), which removes the transformation of the rest pose.
    """
    turn = rotation @ np.swapaxes(bind[0], -1, -2)
    shift = position - np.einsum("fjab,jb->fja", turn, bind[1])
    return np.concatenate([turn, shift[..., None]], axis=-1).astype(np.float32)
