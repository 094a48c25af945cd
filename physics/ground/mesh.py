"""Triangle meshes and the basic shapes that all models are built from."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from physics.textures.layers import Colour

Ints = NDArray[np.int32]

_BOX_CORNERS = np.array([[x, y, z] for z in (-0.5, 0.5) for y in (-0.5, 0.5) for x in (-0.5, 0.5)])
"""(8, 3) corners of the unit cube."""

_BOX_FACES = {
    "top": (4, 5, 7, 6),
    "bottom": (0, 2, 3, 1),
    "front": (1, 3, 7, 5),
    "back": (0, 4, 6, 2),
    "left": (2, 6, 7, 3),
    "right": (0, 1, 5, 4),
}
"""Corner indices of each face, counter-clockwise from outside; the front is +x, left is +y."""


@dataclass(frozen=True, slots=True)
class Mesh:
    """Immutable triangle mesh.

    vertices: (V, 3) m
    normals: (V, 3) unit vectors
    triangles: (T, 3) vertex indices, counter-clockwise from the front
    """

    vertices: Floats
    normals: Floats
    triangles: Ints

    def __len__(self) -> int:
        return len(self.triangles)

    def moved(self, offset_m: Sequence[float] | Floats, heading_rad: float = 0.0) -> Mesh:
        """Return the mesh rotated about the vertical, then translated.

        offset_m: (3,) m
        """
        turn = yaw_matrix(heading_rad)
        return Mesh(
            self.vertices @ turn.T + np.asarray(offset_m), self.normals @ turn.T, self.triangles
        )

    def tilted(self, angle_rad: float, pivot_m: Sequence[float]) -> Mesh:
        """Return the mesh rotated about an axis parallel to y.

        angle_rad: positive angles swing parts below the pivot backwards
        pivot_m: (3,) point on the axis, m
        """
        cos, sin = np.cos(angle_rad), np.sin(angle_rad)
        turn = np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])
        pivot = np.asarray(pivot_m)
        return Mesh((self.vertices - pivot) @ turn.T + pivot, self.normals @ turn.T, self.triangles)


Detail = Literal["always", "plain", "textured", "near", "far"]
"""Cameras and distances that show a part.

always: every camera at every distance
plain: cameras without textures, and exports
textured: cameras with textures
near, far: these, at short or long distance
"""


class Part(NamedTuple):
    """A mesh with one colour.

    colour: sRGB; None uses the object's own paint
    cover: layer of `physics.textures.walls` tinted by the colour, "lamp" for lights at night, or
        ""; only cameras with textures show it
    shade: (V,) fraction of light that reaches each vertex
    glows: True if the part emits its colour as light
    detail: cameras and distances that show the part
    spots: (V, 2) texture coordinates from 0 to 1, for layers with cut-outs
    """

    mesh: Mesh
    colour: Colour | None = None
    cover: str = ""
    shade: Floats | None = None
    glows: bool = False
    detail: Detail = "always"
    spots: Floats | None = None


def parts_seen(parts: Sequence[Part], detail: Detail) -> tuple[Part, ...]:
    """Return the parts that one kind of camera or distance shows."""
    shown = ("always", detail) if detail == "plain" else ("always", "textured", detail)
    return tuple(part for part in parts if part.detail in shown)


_idle_rows: list[list[float]] = []
"""Recycled row lists for `pybullet_lists`."""


@contextmanager
def pybullet_lists(
    indices: Ints, *tables: Floats
) -> Iterator[tuple[list[int], list[list[list[float]]]]]:
    """Provide an index array and (N, 3) tables as the lists that PyBullet takes.

    PyBullet never releases a list or a row that it received. Rows are therefore reused, and all
    other lists are emptied on exit.
    """
    flat = indices.ravel().tolist()
    lists = []
    for table in tables:
        rows = table.tolist()
        for k, values in enumerate(rows):
            row = _idle_rows.pop() if _idle_rows else []
            row[:] = values
            rows[k] = row
        lists.append(rows)
    try:
        yield flat, lists
    finally:
        flat.clear()
        for rows in lists:
            _idle_rows.extend(rows)
            rows.clear()


EMPTY = Mesh(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int32))
"""Mesh without triangles."""


def yaw_matrix(heading_rad: float) -> Floats:
    """Return the (3, 3) rotation about the vertical."""
    cos, sin = np.cos(heading_rad), np.sin(heading_rad)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def join(meshes: Sequence[Mesh]) -> Mesh:
    """Return one mesh with all triangles."""
    if not meshes:
        return EMPTY
    starts = np.cumsum([0, *(len(m.vertices) for m in meshes[:-1])])
    return Mesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([m.normals for m in meshes]),
        np.concatenate(
            [m.triangles + start for m, start in zip(meshes, starts, strict=True)]
        ).astype(np.int32),
    )


def smooth_normals(vertices: Floats, triangles: Ints) -> Floats:
    """Return (V, 3) unit normals, averaged over adjacent triangles by area."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    face = np.cross(b - a, c - a)
    total = np.zeros_like(vertices)
    for axis in range(3):
        total[:, axis] = np.bincount(triangles.ravel(), np.repeat(face[:, axis], 3), len(vertices))
    return np.asarray(total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12))


def triangulate_areas(
    areas: Sequence[shapely.Geometry] | NDArray[np.object_],
) -> tuple[Floats, NDArray[np.int64]]:
    """Triangulate areas of the ground.

    Returns: (T, 3, 2) corners, counter-clockwise from above, and the (T,) index of each triangle's
        area
    """
    parts, area = shapely.get_parts(
        shapely.constrained_delaunay_triangles(np.asarray(areas, dtype=object)), return_index=True
    )
    corners = shapely.get_coordinates(parts).reshape(-1, 4, 2)[:, :3]
    one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    under = one[:, 0] * two[:, 1] < one[:, 1] * two[:, 0]
    corners[under] = corners[under][:, ::-1]
    return corners, area


def flat_shaded(corners: Floats, normals: Floats | None = None) -> Mesh:
    """Build a mesh of separate triangles.

    corners: (3 * T, 3) m, three per triangle
    normals: (3 * T, 3) unit vectors; None points all of them up
    """
    if normals is None:
        normals = np.tile([0.0, 0.0, 1.0], (len(corners), 1))
    return Mesh(corners, normals, np.arange(len(corners), dtype=np.int32).reshape(-1, 3))


def quads(corners: Floats) -> Mesh:
    """Build flat quadrilaterals.

    corners: (N, 4, 3) m, counter-clockwise from the front
    """
    if len(corners) == 0:
        return EMPTY
    normal = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    first = 4 * np.arange(len(corners))[:, None]
    triangles = np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])]).astype(
        np.int32
    )
    return Mesh(corners.reshape(-1, 3), np.repeat(normal, 4, axis=0), triangles)


def box(
    size_m: Sequence[float], centre_m: Sequence[float] = (0.0, 0.0, 0.0), skip: Sequence[str] = ()
) -> Mesh:
    """Build an upright box.

    size_m: length (x), width (y), height (z)
    skip: faces to leave out: top, bottom, front, back, left, right
    """
    corners = _BOX_CORNERS * np.asarray(size_m) + np.asarray(centre_m)
    return quads(
        np.stack([corners[list(face)] for name, face in _BOX_FACES.items() if name not in skip])
    )


def frustum(
    radius_low_m: tuple[float, float],
    radius_high_m: tuple[float, float],
    low_m: float,
    high_m: float,
    sides: int = 6,
) -> Mesh:
    """Build an upright tapered prism with a top and no bottom.

    radius_low_m, radius_high_m: half axes (x, y) at the two heights
    low_m, high_m: heights of the two ends
    """
    angle = 2.0 * np.pi * (np.arange(sides) + 0.5) / sides
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    low = np.column_stack([circle * radius_low_m, np.full(sides, low_m)])
    high = np.column_stack([circle * radius_high_m, np.full(sides, high_m)])
    outward = np.column_stack([circle, np.zeros(sides)])
    around = np.arange(sides)
    after = (around + 1) % sides
    side = np.stack(
        [around, after, after + sides, around, after + sides, around + sides], 1
    ).reshape(-1, 3)
    top = np.stack([np.zeros(sides - 2, int), around[1:-1], around[2:]], 1) + 2 * sides
    return Mesh(
        np.concatenate([low, high, high]),
        np.concatenate([outward, outward, np.tile([0.0, 0.0, 1.0], (sides, 1))]),
        np.concatenate([side, top]).astype(np.int32),
    )


def disc(radius_m: float, centre_m: Sequence[float], sides: int, turn_rad: float = 0.0) -> Mesh:
    """Build an upright regular polygon that faces +x; its first corner is on top unless turned."""
    angle = 0.5 * np.pi + turn_rad + 2.0 * np.pi * np.arange(sides) / sides
    at = np.column_stack(
        [np.zeros(sides), radius_m * np.cos(angle), radius_m * np.sin(angle)]
    ) + np.asarray(centre_m)
    k = np.arange(1, sides - 1)
    triangles = np.stack([np.zeros_like(k), k, k + 1], axis=1).astype(np.int32)
    return Mesh(at, np.tile([1.0, 0.0, 0.0], (sides, 1)), triangles)
