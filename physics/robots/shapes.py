"""Shapes of a URDF as triangles: boxes, cylinders, spheres and mesh files."""

from __future__ import annotations

import xml.etree.ElementTree as xml
from pathlib import Path

import numpy as np

from cosim.core.errors import SpecError
from cosim.core.geometry import Floats
from physics.ground.mesh import Mesh, box, frustum, join


def shape_of(element: xml.Element, urdf: Path) -> Mesh:
    """Return the shape of a `visual` or `collision` element in its own frame.

    Raises SpecError for another shape, and for a mesh file that cannot be read.
    """
    geometry = element.find("geometry")
    shape = next(iter(geometry), None) if geometry is not None else None
    if shape is not None and shape.tag == "box":
        return box([float(v) for v in shape.get("size", "").split()])
    if shape is not None and shape.tag == "cylinder":
        radius = float(shape.get("radius", ""))
        half = 0.5 * float(shape.get("length", ""))
        upper = frustum((radius, radius), (radius, radius), -half, half, sides=16)
        flip = np.array([1.0, -1.0, -1.0])
        return join([upper, Mesh(upper.vertices * flip, upper.normals * flip, upper.triangles)])
    if shape is not None and shape.tag == "sphere":
        return _ball(float(shape.get("radius", "")))
    if shape is not None and shape.tag == "mesh":
        scale = np.array([float(v) for v in shape.get("scale", "1 1 1").split()])
        return _mesh_of_file(urdf.parent / shape.get("filename", ""), scale)
    what = "nothing" if shape is None else f"a {shape.tag}"
    raise SpecError(f"{urdf}: a {element.tag} is {what}; valid are box, cylinder, sphere and mesh")


def _ball(radius_m: float, rings: int = 8, sides: int = 12) -> Mesh:
    """Return a sphere around the origin."""
    up = np.linspace(-0.5 * np.pi, 0.5 * np.pi, rings + 1)[:, None]
    round_ = np.linspace(0.0, 2.0 * np.pi, sides + 1)[None]
    normals = np.stack(
        np.broadcast_arrays(np.cos(up) * np.cos(round_), np.cos(up) * np.sin(round_), np.sin(up)),
        axis=-1,
    ).reshape(-1, 3)
    first = (np.arange(rings)[:, None] * (sides + 1) + np.arange(sides)[None]).ravel()
    above = first + sides + 1
    triangles = np.concatenate(
        [np.column_stack([first, first + 1, above + 1]), np.column_stack([first, above + 1, above])]
    ).astype(np.int32)
    return Mesh(radius_m * normals, normals, triangles)


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
