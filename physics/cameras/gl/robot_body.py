"""Robot body from the shapes of its URDF: boxes, cylinders and mesh files in their colours."""

from __future__ import annotations

import xml.etree.ElementTree as xml
from functools import lru_cache
from pathlib import Path

import numpy as np

from cosim.core.errors import EngineError, SpecError
from cosim.core.geometry import Floats
from physics.dynamics.bullet import p
from physics.ground.mesh import Mesh, Part, box, frustum, join

_GREY = (0.6, 0.6, 0.6)


@lru_cache(maxsize=8)
def robot_parts(urdf: Path) -> tuple[Part, ...]:
    """Return the visible parts of a robot in its base frame, with joints at zero.

    Raises EngineError for an unknown shape.
    """
    root = xml.parse(urdf).getroot()
    colours = {m.get("name", ""): _colour(m) for m in root.findall("material")}
    joints = {j.find("child").get("link", ""): j for j in root.findall("joint")}  # type: ignore[union-attr]
    parts = []
    for link in root.findall("link"):
        turn, shift = _placed(link.get("name", ""), joints)
        for visual in link.findall("visual"):
            own_turn, own_shift = _origin(visual)
            mesh = _shape(visual, urdf)
            vertices = (mesh.vertices @ own_turn.T + own_shift) @ turn.T + shift
            material = visual.find("material")
            name = material.get("name", "") if material is not None else ""
            turned = Mesh(vertices, mesh.normals @ own_turn.T @ turn.T, mesh.triangles)
            parts.append(Part(turned, colours.get(name, _GREY)))
    return tuple(parts)


def _placed(link: str, joints: dict[str, xml.Element]) -> tuple[Floats, Floats]:
    """Return rotation and position of a link in the base frame, every joint at zero."""
    turn, shift = np.eye(3), np.zeros(3)
    while link in joints:
        own_turn, own_shift = _origin(joints[link])
        turn = own_turn @ turn
        shift = own_turn @ shift + own_shift
        link = joints[link].find("parent").get("link", "")  # type: ignore[union-attr]
    return turn, shift


def _origin(element: xml.Element) -> tuple[Floats, Floats]:
    origin = element.find("origin")
    if origin is None:
        return np.eye(3), np.zeros(3)
    angles, shift = (
        [float(v) for v in origin.get(name, "0 0 0").split()] for name in ("rpy", "xyz")
    )
    turn = p.getMatrixFromQuaternion(p.getQuaternionFromEuler(angles))
    return np.array(turn).reshape(3, 3), np.array(shift)


def _shape(visual: xml.Element, urdf: Path) -> Mesh:
    geometry = visual.find("geometry")
    shape = next(iter(geometry), None) if geometry is not None else None
    if shape is not None and shape.tag == "box":
        return box([float(v) for v in shape.get("size", "").split()])
    if shape is not None and shape.tag == "cylinder":
        radius = float(shape.get("radius", ""))
        half = 0.5 * float(shape.get("length", ""))
        upper = frustum((radius, radius), (radius, radius), -half, half, sides=16)
        flip = np.array([1.0, -1.0, -1.0])
        return join([upper, Mesh(upper.vertices * flip, upper.normals * flip, upper.triangles)])
    if shape is not None and shape.tag == "mesh":
        scale = np.array([float(v) for v in shape.get("scale", "1 1 1").split()])
        return _mesh_of_file(urdf.parent / shape.get("filename", ""), scale)
    what = "nothing" if shape is None else f"a {shape.tag}"
    raise EngineError(
        f"{urdf}: a visual shows {what}; the gl camera draws boxes, cylinders and meshes"
    )


def _mesh_of_file(path: Path, scale: Floats) -> Mesh:
    """Load all triangles of a file that trimesh reads, flat shaded.

    Raises SpecError naming the file.
    """
    import trimesh  # import takes 0.2 s, and most robots do not need it

    try:
        scene = trimesh.load_scene(path)
    except (OSError, ValueError, KeyError, TypeError, IndexError, NotImplementedError) as error:
        raise SpecError(f"{path}: cannot be read as a mesh: {error}") from error
    if not any(len(getattr(shape, "faces", ())) for shape in scene.geometry.values()):
        raise SpecError(f"{path}: there is no triangle in it")
    mesh = scene.to_mesh().apply_scale(scale)
    corners = mesh.triangles.reshape(-1, 3)
    triangles = np.arange(len(corners), dtype=np.int32).reshape(-1, 3)
    return Mesh(corners, np.repeat(mesh.face_normals, 3, axis=0), triangles)


def _colour(material: xml.Element) -> tuple[float, float, float]:
    colour = material.find("color")
    if colour is None:
        return _GREY
    r, g, b = (float(v) for v in colour.get("rgba", "").split()[:3])
    return r, g, b
