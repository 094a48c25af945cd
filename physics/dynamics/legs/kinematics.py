"""Compute the posture of a robot with legs from its joint angles, without an engine.

All arithmetic is in Python floats in a fixed order, so that no library changes the bits.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

from physics.robots.model import Model, Triple

Rotation = tuple[Triple, Triple, Triple]
"""Rows of a rotation matrix."""
Frames = Mapping[str, tuple[Triple, Rotation]]
"""Position in metres and rotation of each link in the base frame, by the link's name."""

_IDENTITY: Final[Rotation] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def link_frames(model: Model, angles_rad: Mapping[str, float]) -> Frames:
    """Return the frames of all links. angles_rad: by the names of the joints, 0 if missing."""
    frames: dict[str, tuple[Triple, Rotation]] = {"base": ((0.0, 0.0, 0.0), _IDENTITY)}
    for joint in model.joints:
        at, turn = frames[joint.parent]
        rest = product(turn, _attitude(joint.rpy_rad))
        if joint.axis is not None:
            rest = product(rest, about(joint.axis, angles_rad.get(joint.name, 0.0)))
        frames[joint.child] = add(at, rotate(turn, joint.at_m)), rest
    return frames


def centre_of_mass(model: Model, frames: Frames) -> Triple:
    """Return the centre of mass of a robot in its base frame, in metres."""
    total = (0.0, 0.0, 0.0)
    for link in model.links:
        at, turn = frames[link.name]
        x, y, z = add(at, rotate(turn, link.middle_m))
        total = add(total, (link.mass_kg * x, link.mass_kg * y, link.mass_kg * z))
    return total[0] / model.mass_kg, total[1] / model.mass_kg, total[2] / model.mass_kg


def about(axis: int, angle_rad: float) -> Rotation:
    """Return the rotation about an axis: 0, 1 or 2 for x, y or z."""
    s, c = math.sin(angle_rad), math.cos(angle_rad)
    if axis == 0:
        return (1.0, 0.0, 0.0), (0.0, c, -s), (0.0, s, c)
    if axis == 1:
        return (c, 0.0, s), (0.0, 1.0, 0.0), (-s, 0.0, c)
    return (c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)


def rotate(turn: Rotation, v: Triple) -> Triple:
    """Return a rotated vector."""
    (a, b, c), (x, y, z) = turn, v
    return (
        a[0] * x + a[1] * y + a[2] * z,
        b[0] * x + b[1] * y + b[2] * z,
        c[0] * x + c[1] * y + c[2] * z,
    )


def product(one: Rotation, other: Rotation) -> Rotation:
    """Return the rotation `other` followed by `one`."""
    a, b, c = other
    x = rotate(one, (a[0], b[0], c[0]))
    y = rotate(one, (a[1], b[1], c[1]))
    z = rotate(one, (a[2], b[2], c[2]))
    return (x[0], y[0], z[0]), (x[1], y[1], z[1]), (x[2], y[2], z[2])


def add(one: Triple, other: Triple) -> Triple:
    """Return the sum of two vectors."""
    return one[0] + other[0], one[1] + other[1], one[2] + other[2]


def _attitude(rpy_rad: Triple) -> Rotation:
    roll, pitch, yaw = rpy_rad
    return product(product(about(2, yaw), about(1, pitch)), about(0, roll))
