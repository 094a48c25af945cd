"""Links and joints of a URDF, and the places of links for joint angles."""

from __future__ import annotations

import math
import xml.etree.ElementTree as xml
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cosim.core.geometry import Floats

Place = tuple[Floats, Floats]
"""Rotation (3, 3) and position (3,) of a frame in another one, metres."""


class TreeJoint(NamedTuple):
    """Joint between two links. axis: (3,) unit vector in the child's frame."""

    name: str
    parent: str
    child: str
    origin: Place
    axis: Floats


class LinkTree(NamedTuple):
    """Links of a robot, each joint after those of its parents. base: name of the base link."""

    base: str
    joints: tuple[TreeJoint, ...]

    def places(self, angles_rad: Mapping[str, float]) -> dict[str, Place]:
        """Return the place of each link in the base link's frame.

        angles_rad: angles of joints by name; all others are at zero
        """
        found = {self.base: (np.eye(3), np.zeros(3))}
        for joint in self.joints:
            turn, shift = found[joint.parent]
            own_turn, own_shift = joint.origin
            angle = angles_rad.get(joint.name, 0.0)
            rotated = turn @ own_turn
            if angle:
                rotated = rotated @ _about(joint.axis, angle)
            found[joint.child] = rotated, turn @ own_shift + shift
        return found


@lru_cache(maxsize=8)
def link_tree(urdf: Path) -> LinkTree:
    """Return the tree of a URDF file."""
    root = xml.parse(urdf).getroot()
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
            np.array([1.0, 0.0, 0.0] if axis is None else _triple(axis.get("xyz", "1 0 0"))),
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


def origin_of(element: xml.Element) -> Place:
    """Return the origin of an element of a URDF: rotation and position."""
    origin = element.find("origin")
    if origin is None:
        return np.eye(3), np.zeros(3)
    roll, pitch, yaw = _triple(origin.get("rpy", "0 0 0"))
    return turned(roll, pitch, yaw), np.array(_triple(origin.get("xyz", "0 0 0")))


def turned(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Floats:
    """Return the (3, 3) rotation about x, then y, then z."""
    cz, sz = math.cos(yaw_rad), math.sin(yaw_rad)
    cy, sy = math.cos(pitch_rad), math.sin(pitch_rad)
    cx, sx = math.cos(roll_rad), math.sin(roll_rad)
    return np.array(
        [
            [cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx],
            [sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx],
            [-sy, cy * sx, cy * cx],
        ]
    )


def angles_of(turn: Floats) -> tuple[float, float, float]:
    """Return roll, pitch and yaw of a (3, 3) rotation."""
    roll = math.atan2(turn[2, 1], turn[2, 2])
    pitch = math.asin(min(max(-turn[2, 0], -1.0), 1.0))
    return roll, pitch, math.atan2(turn[1, 0], turn[0, 0])


def _triple(text: str) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in text.split())
    return x, y, z


def _about(axis: Floats, angle_rad: float) -> Floats:
    """Return the (3, 3) rotation about a unit vector."""
    x, y, z = axis.tolist()
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    outer = np.outer(axis, axis)
    return cos * np.eye(3) + sin * cross + (1.0 - cos) * outer
