"""Compute the posture of a robot from its joint angles, without an engine.

Sums have a fixed order, so the results are the same on every processor.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

Vector = tuple[float, float, float]
Rotation = tuple[Vector, Vector, Vector]
"""Rows of a rotation matrix."""

_IDENTITY: Final[Rotation] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
_ZERO: Final[Vector] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Segment:
    """Link of a robot with the joint that carries it.

    parent: index of the carrying link; -1 for the base.
    joint: name of the joint; "" for the base.
    at_m, turn: the joint's frame in the parent's frame at angle 0.
    axis: unit vector of the joint in its frame; zero if fixed.
    mass_kg, centre_m: mass, and its centre in the link's frame.
    """

    name: str
    parent: int
    joint: str
    at_m: Vector
    turn: Rotation
    axis: Vector
    mass_kg: float
    centre_m: Vector


@dataclass(frozen=True, slots=True)
class Skeleton:
    """Links of a robot, each after its parent."""

    segments: tuple[Segment, ...]

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints that move."""
        return tuple(one.joint for one in self.segments if one.axis != _ZERO)

    def frames(self, angles_rad: Mapping[str, float]) -> dict[str, tuple[Vector, Rotation]]:
        """Return position and rotation of each link in the base frame, by the link's name."""
        found: list[tuple[Vector, Rotation]] = []
        for one in self.segments:
            if one.parent < 0:
                found.append((_ZERO, _IDENTITY))
                continue
            at, turn = found[one.parent]
            place = add(at, rotate(turn, one.at_m))
            rest = product(turn, one.turn)
            found.append((place, product(rest, about(one.axis, angles_rad.get(one.joint, 0.0)))))
        return {one.name: frame for one, frame in zip(self.segments, found, strict=True)}

    def centre(self, frames: Mapping[str, tuple[Vector, Rotation]]) -> Vector:
        """Return the centre of mass in the base frame, in metres."""
        mass = 0.0
        total = _ZERO
        for one in self.segments:
            at, turn = frames[one.name]
            x, y, z = add(at, rotate(turn, one.centre_m))
            mass += one.mass_kg
            total = add(total, (one.mass_kg * x, one.mass_kg * y, one.mass_kg * z))
        return total[0] / mass, total[1] / mass, total[2] / mass


def read_skeleton(path: Path) -> Skeleton:
    """Return the links of a URDF file. Raises ValueError if they are no tree."""
    root = ElementTree.parse(path).getroot()
    links = {link.get("name", ""): link for link in root.findall("link")}
    joints = {_named(joint, "child"): joint for joint in root.findall("joint")}
    waiting = sorted(links.keys() - joints.keys())
    if len(waiting) != 1:
        raise ValueError(f"{path}: has {len(waiting)} links without a joint; wanted is one base")
    segments: list[Segment] = []
    indices: dict[str, int] = {}
    while waiting:
        name = waiting.pop(0)
        joint = joints.get(name)
        parent = -1 if joint is None else indices[_named(joint, "parent")]
        indices[name] = len(segments)
        segments.append(_segment(links[name], joint, parent))
        waiting += [child for child, one in joints.items() if _named(one, "parent") == name]
    if len(segments) != len(links):
        raise ValueError(f"{path}: {len(links) - len(segments)} links do not hang on the base")
    return Skeleton(tuple(segments))


def _segment(
    link: ElementTree.Element, joint: ElementTree.Element | None, parent: int
) -> Segment:
    inertial = link.find("inertial")
    mass = None if inertial is None else inertial.find("mass")
    name = link.get("name", "")
    kilograms = 0.0 if mass is None else float(mass.get("value", "0"))
    centre, _ = _origin(inertial)
    if joint is None:
        return Segment(name, parent, "", _ZERO, _IDENTITY, _ZERO, kilograms, centre)
    at, turn = _origin(joint)
    axis = joint.find("axis")
    along = _ZERO if joint.get("type") == "fixed" else (1.0, 0.0, 0.0)
    if axis is not None and along != _ZERO:
        along = _vector(axis.get("xyz"))
    return Segment(name, parent, joint.get("name", ""), at, turn, along, kilograms, centre)


def _named(joint: ElementTree.Element, kind: str) -> str:
    found = joint.find(kind)
    return "" if found is None else found.get("link", "")


def _origin(element: ElementTree.Element | None) -> tuple[Vector, Rotation]:
    origin = None if element is None else element.find("origin")
    if origin is None:
        return _ZERO, _IDENTITY
    roll, pitch, yaw = _vector(origin.get("rpy"))
    turn = product(about((0.0, 0.0, 1.0), yaw), about((0.0, 1.0, 0.0), pitch))
    return _vector(origin.get("xyz")), product(turn, about((1.0, 0.0, 0.0), roll))


def _vector(text: str | None) -> Vector:
    x, y, z = map(float, (text or "0 0 0").split())
    return x, y, z


def about(axis: Vector, angle_rad: float) -> Rotation:
    """Return the rotation about a unit vector; identity for a zero vector."""
    if axis == _ZERO or angle_rad == 0.0:
        return _IDENTITY
    x, y, z = axis
    s, c = math.sin(angle_rad), math.cos(angle_rad)
    d = 1.0 - c
    return (
        (c + d * x * x, d * x * y - s * z, d * x * z + s * y),
        (d * x * y + s * z, c + d * y * y, d * y * z - s * x),
        (d * x * z - s * y, d * y * z + s * x, c + d * z * z),
    )


def rotate(turn: Rotation, v: Vector) -> Vector:
    """Return a rotated vector."""
    a, b, c = turn
    x, y, z = v
    return (
        a[0] * x + a[1] * y + a[2] * z,
        b[0] * x + b[1] * y + b[2] * z,
        c[0] * x + c[1] * y + c[2] * z,
    )


def product(one: Rotation, other: Rotation) -> Rotation:
    """Return the rotation `other` followed by `one`."""
    columns: Sequence[Vector] = list(zip(*other, strict=True))
    x, y, z = (rotate(one, column) for column in columns)
    return (x[0], y[0], z[0]), (x[1], y[1], z[1]), (x[2], y[2], z[2])


def add(one: Vector, other: Vector) -> Vector:
    """Return the sum of two vectors."""
    return one[0] + other[0], one[1] + other[1], one[2] + other[2]
