"""A person's body as six rigid parts that swing: what is drawn of a pedestrian.

The body frame lies on the ground below the person, x ahead, y left. Gait follows time and speed alone, so a picture
depends on nothing but the snapshot it shows.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from cosim.geometry import Floats
from cosim.state import Doing, People
from physics.mesh import Mesh, box, frustum, join

PERSON_M: Final = 1.7
_CADENCE_HZ: Final = 0.95
"""Double steps in a second."""

Colour = tuple[float, float, float]
Coat = Literal["skin", "shirt", "trousers"]

_SHIRTS: Final[tuple[Colour, ...]] = (
    (0.75, 0.18, 0.16), (0.14, 0.32, 0.62), (0.90, 0.76, 0.25), (0.20, 0.50, 0.32),
    (0.88, 0.88, 0.86), (0.30, 0.20, 0.42), (0.16, 0.17, 0.19), (0.80, 0.45, 0.55),
)  # fmt: skip
_TROUSERS: Final[tuple[Colour, ...]] = ((0.15, 0.18, 0.28), (0.25, 0.23, 0.21), (0.42, 0.38, 0.32), (0.10, 0.10, 0.11))
_SKINS: Final[tuple[Colour, ...]] = ((0.87, 0.68, 0.56), (0.72, 0.52, 0.40), (0.48, 0.32, 0.24), (0.94, 0.78, 0.68))


@dataclass(frozen=True, slots=True)
class Part:
    """A rigid part. mesh: about its joint, metres; joint_m: where that is on the upright body."""

    mesh: Mesh
    joint_m: tuple[float, float, float]
    coat: Coat


def _leg(side: int) -> Part:
    thigh = frustum((0.055, 0.055), (0.09, 0.085), -0.82, 0.02, sides=5)
    foot = box((0.25, 0.09, 0.07), (0.06, 0.0, -0.825))
    return Part(join([thigh, foot]), (0.0, 0.09 * side, 0.86), "trousers")


def _arm(side: int) -> Part:
    arm = frustum((0.035, 0.035), (0.055, 0.05), -0.56, 0.02, sides=5)
    hand = box((0.04, 0.10, 0.18), (0.0, 0.0, -0.62), skip=("top",))
    return Part(join([arm, hand]), (0.0, 0.225 * side, 1.38), "skin")


PARTS: Final[tuple[Part, ...]] = (
    Part(
        join(
            [
                frustum((0.10, 0.15), (0.115, 0.19), -0.04, 0.42, sides=8),
                frustum((0.115, 0.19), (0.05, 0.06), 0.42, 0.58, sides=8),
            ]
        ),
        (0.0, 0.0, 0.86),
        "shirt",
    ),
    Part(
        join(
            [
                frustum((0.05, 0.05), (0.05, 0.05), -0.06, 0.04, sides=5),
                frustum((0.075, 0.065), (0.105, 0.085), 0.02, 0.15, sides=7),
                frustum((0.105, 0.085), (0.06, 0.05), 0.15, 0.25, sides=7),
            ]
        ),
        (0.0, 0.0, 1.45),
        "skin",
    ),
    _leg(1),
    _leg(-1),
    _arm(1),
    _arm(-1),
)
"""Torso, head, left leg, right leg, left arm, right arm."""


def colours(name: str) -> dict[Coat, Colour]:
    """The colours of the person called `name`: always the same."""
    draw = zlib.crc32(name.encode())
    return {
        "shirt": _SHIRTS[draw % len(_SHIRTS)],
        "trousers": _TROUSERS[draw // 8 % len(_TROUSERS)],
        "skin": _SKINS[draw // 64 % len(_SKINS)],
    }


def swings(people: People, time_s: float) -> tuple[Floats, Floats]:
    """How far each part is turned: (N, 6) about y, a positive angle swings a hanging limb backwards; (N, 6) about z."""
    n = len(people)
    about_y, about_z = np.zeros((n, len(PARTS))), np.zeros((n, len(PARTS)))
    offset = np.array([zlib.crc32(name.encode()) % 1000 for name in people.ids]) * 2e-3 * np.pi
    phase = 2.0 * np.pi * _CADENCE_HZ * time_s + offset
    stride = np.minimum(people.speed / 1.4, 1.3) * np.sin(phase)
    about_y[:, 2], about_y[:, 3] = 0.48 * stride, -0.48 * stride
    about_y[:, 4], about_y[:, 5] = -0.40 * stride, 0.40 * stride
    slow = np.sin(0.25 * phase)
    for i, doing in enumerate(people.doing):
        _gesture(doing, float(slow[i]), about_y[i], about_z[i])
    return about_y, about_z


def _gesture(doing: Doing, slow: float, about_y: Floats, about_z: Floats) -> None:
    """Turn head and arms of one person for what they do. slow: in [-1, 1], changes over seconds."""
    if doing == "stop":
        about_y[5] = -1.9
    elif doing == "look":
        about_z[1] = 1.1 * slow
    elif doing == "talk":
        about_y[4], about_y[5] = -0.5 - 0.3 * slow, -0.2
        about_z[1] = 0.2 * slow
    elif doing == "queue":
        about_y[1] = 0.35
