"""Thin covers over the ground: what shows that open ground is no sidewalk.

They are laid a few millimetres above the ground and change what cameras see, not labels, friction or what wheels touch.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import shapely

from cosim.core.geometry import Floats
from cosim.place.open_ground import open_ground
from cosim.place.street_map import LandKind, StreetMap
from physics.world.mesh import Mesh, join, plan_triangles, quads
from physics.world.tiles import Tile, square

_LIFT_M: Final = 0.003
_GRID_M: Final = 1e-4
"""Ends of edges nearer to one another than about this are the same."""


def covers_in(street_map: StreetMap, tile: Tile) -> list[tuple[LandKind, Mesh]]:
    """What lies on the open ground of a tile, by its look; where nothing lies the ground shows its own."""
    if "ground" not in tile.parts:
        return []
    laid = [
        (kind, laid_over(tile.parts["ground"], area))
        for kind, area in open_ground(street_map, shapely.box(*square(tile.key)))
    ]
    return [(kind, mesh) for kind, mesh in laid if len(mesh)]


def laid_over(mesh: Mesh, area: shapely.Geometry) -> Mesh:
    """The parts of a mesh that lie in an area, lifted a little, with an upright rim around them."""
    return _edged(_clipped(mesh, area))


def _clipped(mesh: Mesh, area: shapely.Geometry) -> Mesh:
    """The parts of a mesh's triangles that lie in an area, lifted a little."""
    shapely.prepare(area)
    corners = mesh.vertices[mesh.triangles]
    outlines = np.asarray(shapely.polygons(corners[:, :, :2]), dtype=object)
    met = np.flatnonzero(shapely.intersects(area, outlines))
    whole = shapely.contains_properly(area, outlines[met])
    kept = met[whole]
    used, index = np.unique(mesh.triangles[kept], return_inverse=True)
    lifted = mesh.vertices[used] + np.array([0.0, 0.0, _LIFT_M])
    found = [Mesh(lifted, mesh.normals[used], index.reshape(-1, 3).astype(np.int32))]
    for i in met[~whole].tolist():
        part = shapely.intersection(outlines[i], area)
        if shapely.area(part) > 1e-4:
            found.append(_cut(part, corners[i], mesh.normals[mesh.triangles[i]]))
    return join(found)


def _edged(mesh: Mesh) -> Mesh:
    """A mesh with an upright rim under every edge at which it ends, so that a low eye does not look under it."""
    if not len(mesh):
        return mesh
    corners = mesh.vertices[mesh.triangles]
    ends = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    grid = np.rint(ends[:, :, :2] / _GRID_M).astype(np.int64)
    one, two = (np.ascontiguousarray(grid[:, i]).view("i8,i8").ravel() for i in (0, 1))
    order = {(a, b): k for k, (a, b) in enumerate(zip(one.tolist(), two.tolist(), strict=True))}
    alone = ends[[k for (a, b), k in order.items() if (b, a) not in order and a != b]]
    if not len(alone):
        return mesh
    under = alone - np.array([0.0, 0.0, _LIFT_M])
    rim = quads(np.stack([under[:, 0], under[:, 1], alone[:, 1], alone[:, 0]], axis=1))
    lit = np.tile([0.0, 0.0, 1.0], (len(rim.vertices), 1))  # like the surface: a millimetre's wall would be a dark line
    return join([mesh, Mesh(rim.vertices, lit, rim.triangles)])


def _cut(part: shapely.Geometry, corners: Floats, normals: Floats) -> Mesh:
    """A part of a triangle, (3, 3) corners and normals, as triangles in its plane."""
    pieces = [p for p in shapely.get_parts(part) if shapely.get_dimensions(p) == 2]
    at = plan_triangles(pieces)[0].reshape(-1, 2)
    shares = np.column_stack([at, np.ones(len(at))]) @ np.linalg.inv(np.column_stack([corners[:, :2], np.ones(3)]))
    z = shares @ corners[:, 2] + _LIFT_M
    slopes = shares @ normals
    slopes /= np.linalg.norm(slopes, axis=1, keepdims=True)
    return Mesh(np.column_stack([at, z]), slopes, np.arange(len(at), dtype=np.int32).reshape(-1, 3))
