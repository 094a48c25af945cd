"""Links and joints of a URDF, and the places of links for joint angles.

Angles and frames are Python floats, summed in a fixed order, so that no library changes the bits.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as xml
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from cosim.core.geometry import Floats
from physics.robots.model import Model, Triple

Rotation = tuple[Triple, Triple, Triple]
"""Rows of a rotation matrix."""
Frame = tuple[Rotation, Triple]
"""Rotation and position of a frame in another one, metres."""
Place = tuple[Floats, Floats]
"""The same as arrays (3, 3) and (3,)."""

_IDENTITY: Final[Rotation] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
_ZERO: Final[Triple] = (0.0, 0.0, 0.0)


class TreeJoint(NamedTuple):
    """Joint between two links.

    axis: unit vector in the child's frame.
    """

    name: str
    parent: str
    child: str
    origin: Frame
    axis: Triple


class LinkTree(NamedTuple):
    """Links of a robot, each joint after those of its parents.

    base: name of the base link.
    """

    base: str
    joints: tuple[TreeJoint, ...]

    def frames(self, angles_rad: Mapping[str, float]) -> dict[str, Frame]:
        """Return the frame of each link in the base link's frame.

        angles_rad: angles of joints by name; all others are at zero
        """
        found: dict[str, Frame] = {self.base: (_IDENTITY, _ZERO)}
        for joint in self.joints:
            turn, at = found[joint.parent]
            own_turn, own_at = joint.origin
            rotated = product(turn, own_turn)
            if angle := angles_rad.get(joint.name, 0.0):
                rotated = product(rotated, _about(joint.axis, angle))
            found[joint.child] = rotated, _sum(at, rotate(turn, own_at))
        return found

    def places(self, angles_rad: Mapping[str, float]) -> dict[str, Place]:
        """Return the frames as arrays."""
        return {
            link: (np.array(turn), np.array(at))
            for link, (turn, at) in self.frames(angles_rad).items()
        }


@lru_cache(maxsize=8)
def link_tree(urdf: Path) -> LinkTree:
    """Return the tree of a URDF file."""
    return tree_of(xml.parse(urdf).getroot())


def tree_of(root: xml.Element) -> LinkTree:
    """Return the tree of a URDF; it lacks joints that are not connected to the base link."""
    links = [link.get("name", "") for link in root.findall("link")]
    joints = {}
    for element in root.findall("joint"):
        parent, child = (element.find(end) for end in ("parent", "child"))
        axis = element.find("axis")
        joint = TreeJoint(
            element.get("name", ""),
            "" if parent is None else parent.get("link", ""),
            "" if child is None else child.get("link", ""),
            origin_of(element),
            (1.0, 0.0, 0.0) if axis is None else _triple(axis.get("xyz", "1 0 0")),
        )
        joints[joint.child] = joint
    known = [name for name in links if name not in joints]
    order: list[TreeJoint] = []
    while len(order) < len(joints):
        ready = [j for j in joints.values() if j.parent in known and j.child not in known]
        if not ready:
            break
        order += ready
        known += [joint.child for joint in ready]
    return LinkTree(known[0], tuple(order))


def origin_of(element: xml.Element) -> Frame:
    """Return the origin of an element of a URDF."""
    origin = element.find("origin")
    if origin is None:
        return _IDENTITY, _ZERO
    return attitude(*_triple(origin.get("rpy", "0 0 0"))), _triple(origin.get("xyz", "0 0 0"))


def centre_of_mass(model: Model, frames: Mapping[str, Frame]) -> Triple:
    """Return the centre of mass of a robot in its base link's frame, in metres."""
    total = _ZERO
    for link in model.links:
        turn, at = frames[link.name]
        x, y, z = _sum(at, rotate(turn, link.middle_m))
        total = _sum(total, (link.mass_kg * x, link.mass_kg * y, link.mass_kg * z))
    return total[0] / model.mass_kg, total[1] / model.mass_kg, total[2] / model.mass_kg


def rows_of(m: Sequence[float]) -> Rotation:
    """Return the rotation with nine entries of a matrix, by rows."""
    return (m[0], m[1], m[2]), (m[3], m[4], m[5]), (m[6], m[7], m[8])


def inverse(turn: Rotation) -> Rotation:
    """Return the inverse rotation."""
    a, b, c = turn
    return (a[0], b[0], c[0]), (a[1], b[1], c[1]), (a[2], b[2], c[2])


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
    x, y, z = inverse(other)
    return inverse((rotate(one, x), rotate(one, y), rotate(one, z)))


def attitude(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Rotation:
    """Return the rotation about x, then y, then z."""
    cz, sz = math.cos(yaw_rad), math.sin(yaw_rad)
    cy, sy = math.cos(pitch_rad), math.sin(pitch_rad)
    cx, sx = math.cos(roll_rad), math.sin(roll_rad)
    return (
        (cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx),
        (sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx),
        (-sy, cy * sx, cy * cx),
    )


def turned(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Floats:
    """Return the rotation `attitude` as a (3, 3) array."""
    return np.array(attitude(roll_rad, pitch_rad, yaw_rad))


def angles_of(turn: Floats) -> tuple[float, float, float]:
    """Return roll, pitch and yaw of a (3, 3) rotation."""
    roll = math.atan2(turn[2, 1], turn[2, 2])
    pitch = math.asin(min(max(-turn[2, 0], -1.0), 1.0))
    return roll, pitch, math.atan2(turn[1, 0], turn[0, 0])


def _triple(text: str) -> tuple[float, float, float]:
    try:
        x, y, z = (float(value) for value in text.split())
    except ValueError:
        raise ValueError(f"'{text}' must be three numbers") from None
    return x, y, z


def _sum(one: Triple, other: Triple) -> Triple:
    return one[0] + other[0], one[1] + other[1], one[2] + other[2]


def _about(axis: Triple, angle_rad: float) -> Rotation:
    """Return the rotation about a unit vector, with exact zeros for an axis of the frame."""
    (x, y, z), s, c = axis, math.sin(angle_rad), math.cos(angle_rad)
    xy, xz, yz = ((1.0 - c) * one for one in (x * y, x * z, y * z))
    return (
        (x * x + c * (1.0 - x * x), xy - s * z, xz + s * y),
        (xy + s * z, y * y + c * (1.0 - y * y), yz - s * x),
        (xz - s * y, yz + s * x, z * z + c * (1.0 - z * z)),
    )
