"""Skeletons of the built-in bodies: man, woman, child, elder."""

from __future__ import annotations

from functools import lru_cache
from typing import Final, Literal

import numpy as np

from cosim.core.geometry import Floats
from physics.people.skeleton import INDEX, JOINTS, MIRRORED, Skeleton

Family = Literal["man", "woman", "child", "elder"]
FAMILIES: Final[tuple[Family, ...]] = ("man", "woman", "child", "elder")

_LEFT_HALF: Final = {
    "pelvis": (-0.015, 0.0, 0.970),
    "left_hip": (-0.005, 0.088, 0.905),
    "spine1": (-0.025, 0.0, 1.075),
    "left_knee": (0.005, 0.092, 0.500),
    "spine2": (-0.020, 0.0, 1.190),
    "left_ankle": (-0.025, 0.092, 0.095),
    "spine3": (-0.015, 0.0, 1.270),
    "left_foot": (0.110, 0.100, 0.030),
    "neck": (-0.030, 0.0, 1.490),
    "left_collar": (-0.010, 0.055, 1.420),
    "head": (-0.005, 0.0, 1.575),
    "left_shoulder": (-0.020, 0.178, 1.435),
    "left_elbow": (-0.025, 0.458, 1.435),
    "left_wrist": (-0.020, 0.713, 1.435),
    "left_hand": (-0.015, 0.800, 1.435),
}
"""Joints of the left half of a man of 1.75 m in the T pose, metres."""


def skeleton(family: Family) -> Skeleton:
    """Return the skeleton of a family at its own stature: 1.75, 1.64, 1.25 or 1.66 m."""
    rest = man_rest_m()
    if family == "woman":
        _narrow(rest, shoulders=0.018, hips=-0.004)
        return Skeleton(rest * (1.64 / 1.75), 1.64)
    if family == "child":
        # Shorter legs against a longer trunk and a large head: a child of six to nine years.
        low = rest[:, 2] <= 0.91
        rest[:, 2] = np.where(low, rest[:, 2] * 0.94, rest[:, 2] - 0.0545)
        rest[INDEX["head"], 2] -= 0.01
        _narrow(rest, shoulders=0.022, hips=0.006)
        return Skeleton(rest * (1.25 / 1.75), 1.25)
    if family == "elder":
        _narrow(rest, shoulders=0.010, hips=0.0)
        return Skeleton(rest * (1.66 / 1.75), 1.66)
    return Skeleton(rest, 1.75)


def man_rest_m() -> Floats:
    """Return (24, 3) joints of the man of 1.75 m in the T pose, the base of all bodies."""
    return _man_rest_m().copy()


@lru_cache(maxsize=1)
def _man_rest_m() -> Floats:
    rest = np.zeros((24, 3))
    for name, place in _LEFT_HALF.items():
        rest[INDEX[name]] = place
        if name.startswith("left"):
            rest[MIRRORED[INDEX[name]]] = (place[0], -place[1], place[2])
    return rest


def _rows(*parts: str) -> list[int]:
    return [k for k, name in enumerate(JOINTS) if name.split("_")[-1] in parts]


def _narrow(rest: Floats, shoulders: float, hips: float) -> None:
    """Move the arms and the legs inwards by `shoulders` and `hips` metres on each side."""
    for k in _rows("shoulder", "elbow", "wrist", "hand"):
        rest[k, 1] -= shoulders * np.sign(rest[k, 1])
    for k in _rows("hip", "knee"):
        rest[k, 1] -= hips * np.sign(rest[k, 1])
