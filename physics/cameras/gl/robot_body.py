"""Robot body from the shapes of its URDF: boxes, cylinders, spheres and mesh files."""

from __future__ import annotations

import xml.etree.ElementTree as xml
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Final

import numpy as np

from cosim.core.geometry import Floats
from cosim.core.state import RobotState
from cosim.spec.robot import Robot
from physics.cameras.posture import posture_of
from physics.ground.mesh import Mesh, Part
from physics.robots import urdf_path
from physics.robots.kinematics import link_tree, origin_of, turned
from physics.robots.shapes import shape_of
from physics.street.surface import Surface

_GREY = (0.6, 0.6, 0.6)
_ZERO: Final[Mapping[str, float]] = MappingProxyType({})
"""Joint angles of a robot whose joints are all at zero."""


def robot_parts(urdf: Path, angles_rad: Mapping[str, float] = _ZERO) -> tuple[Part, ...]:
    """Return the visible parts of a robot in its base link's frame.

    angles_rad: joint angles; joints without one are at zero.

    Raises SpecError for an unknown shape.
    """
    places = link_tree(urdf).places(angles_rad)
    return tuple(
        _turned(part, *places[link]) for link, parts in link_parts(urdf).items() for part in parts
    )


def parts_in_place(surface: Surface, model: Robot, robot: RobotState) -> tuple[Part, ...]:
    """Return the visible parts of a robot in the map's frame."""
    posture = posture_of(surface, model, robot)
    turn = turned(posture.roll_rad, posture.pitch_rad, posture.heading_rad)
    parts = robot_parts(urdf_path(model), posture.angles_rad)
    return tuple(_turned(part, turn, np.array(posture.at_m)) for part in parts)


def _turned(part: Part, turn: Floats, shift: Floats) -> Part:
    mesh = part.mesh
    moved = Mesh(mesh.vertices @ turn.T + shift, mesh.normals @ turn.T, mesh.triangles)
    return Part(moved, part.colour)


@lru_cache(maxsize=8)
def link_parts(urdf: Path) -> dict[str, tuple[Part, ...]]:
    """Return the visible parts of each link in its own frame.

    Raises SpecError for an unknown shape.
    """
    root = xml.parse(urdf).getroot()
    colours = {m.get("name", ""): _colour(m) for m in root.findall("material")}
    found = {}
    for link in root.findall("link"):
        parts = []
        for visual in link.findall("visual"):
            turn, shift = map(np.array, origin_of(visual))
            mesh = shape_of(visual, urdf)
            turned = Mesh(mesh.vertices @ turn.T + shift, mesh.normals @ turn.T, mesh.triangles)
            parts.append(Part(turned, _colour_of(visual, colours)))
        found[link.get("name", "")] = tuple(parts)
    return found


def _colour_of(
    visual: xml.Element, named: Mapping[str, tuple[float, float, float]]
) -> tuple[float, float, float]:
    """Return the colour in a visual's material, else the one of its name under `robot`."""
    material = visual.find("material")
    if material is None:
        return _GREY
    if material.find("color") is not None:
        return _colour(material)
    return named.get(material.get("name", ""), _GREY)


def _colour(material: xml.Element) -> tuple[float, float, float]:
    colour = material.find("color")
    if colour is None:
        return _GREY
    r, g, b = (float(v) for v in colour.get("rgba", "").split()[:3])
    return r, g, b
