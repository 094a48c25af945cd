"""Robot body from the shapes of its URDF: boxes, cylinders, spheres and mesh files."""

from __future__ import annotations

import xml.etree.ElementTree as xml
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path

import numpy as np

from physics.ground.mesh import Mesh, Part
from physics.robots.kinematics import link_tree, origin_of
from physics.robots.shapes import shape_of

_GREY = (0.6, 0.6, 0.6)


def robot_parts(urdf: Path) -> tuple[Part, ...]:
    """Return the visible parts of a robot in its base link's frame, with joints at zero.

    Raises SpecError for an unknown shape.
    """
    places = link_tree(urdf).places({})
    parts = []
    for link, shapes in link_parts(urdf).items():
        turn, shift = places[link]
        for mesh, colour, *_ in shapes:
            vertices = mesh.vertices @ turn.T + shift
            parts.append(Part(Mesh(vertices, mesh.normals @ turn.T, mesh.triangles), colour))
    return tuple(parts)


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
