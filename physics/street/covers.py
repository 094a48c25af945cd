"""Thin covers over the ground: what shows that open ground is no sidewalk.

They are laid a few millimetres above the ground and change what cameras see, not labels, friction
or what wheels touch.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import Polygon

from cosim.core.geometry import Floats
from cosim.place import overlay
from cosim.place.open_ground import open_ground
from cosim.place.street_map import LandKind, StreetMap
from physics.ground.mesh import Mesh, join, plan_triangles, quads
from physics.ground.tiles import Tile, square

_LIFT_M: Final = 0.003
_GRID_M: Final = 1e-4
"""Ends of edges nearer to one another than about this are the same."""
_AT_END_M: Final = 0.005
_LEVEL_M: Final = 1e-6


def covers_in(street_map: StreetMap, tile: Tile, rims: bool) -> dict[LandKind, Mesh]:
    """What lies on the open ground of a tile, by its look; where nothing lies the ground shows its
    own. rims: upright ones around each cover, so that a low eye does not look under it; they take
    two thirds of all triangles."""
    if "ground" not in tile.parts:
        return {}
    ground = tile.parts["ground"]
    found = {}
    areas = open_ground(street_map, shapely.box(*square(tile.key)))
    outline = overlay.union_all(_outlines(ground)) if areas and rims else None
    for kind, area in areas:
        mesh = _spread(ground, area)
        if outline is not None:
            mesh = _edged(mesh, shapely.boundary(overlay.intersection(area, outline)))
        if len(mesh):
            found[kind] = mesh
    return found


def laid_over(mesh: Mesh, area: shapely.Geometry) -> Mesh:
    """The parts of a mesh that lie in an area, lifted a little, with an upright rim around them."""
    return _edged(_clipped(mesh, area))


def _spread(mesh: Mesh, area: shapely.Geometry) -> Mesh:
    """As `_clipped`, but where the mesh is level in as few triangles as the area needs."""
    height = mesh.vertices[mesh.triangles][:, :, 2]
    level = (height > height.max() - _LEVEL_M).all(axis=1)
    sheet = overlay.intersection(overlay.union_all(_outlines(mesh)[level]), area)
    parts = [
        part
        for part in shapely.get_parts(shapely.simplify(sheet, 1e-3))
        if isinstance(part, Polygon)
    ]
    xy = plan_triangles(parts)[0].reshape(-1, 2) if parts else np.zeros((0, 2))
    corners = np.column_stack([xy, np.full(len(xy), height.max() + _LIFT_M)])
    up = np.tile([0.0, 0.0, 1.0], (len(xy), 1))
    flat = Mesh(corners, up, np.arange(len(xy), dtype=np.int32).reshape(-1, 3))
    return join([flat, _clipped(Mesh(mesh.vertices, mesh.normals, mesh.triangles[~level]), area)])


def _clipped(mesh: Mesh, area: shapely.Geometry) -> Mesh:
    """The parts of a mesh's triangles that lie in an area, lifted a little."""
    shapely.prepare(area)
    corners = mesh.vertices[mesh.triangles]
    outlines = _outlines(mesh)
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


def _outlines(mesh: Mesh) -> NDArray[np.object_]:
    """The triangles of a mesh from above."""
    return np.asarray(shapely.polygons(mesh.vertices[mesh.triangles][:, :, :2]), dtype=object)


def _edged(mesh: Mesh, ends: shapely.Geometry | None = None) -> Mesh:
    """A mesh with an upright rim under every edge at which it ends, so that a low eye does not look
    under it.

    ends: where it does; None: at every edge of one triangle alone, also where neighbours are
    divided otherwise.
    """
    if not len(mesh):
        return mesh
    corners = mesh.vertices[mesh.triangles]
    edges = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    grid = np.rint(edges[:, :, :2] / _GRID_M).astype(np.int64)
    one, two = (np.ascontiguousarray(grid[:, i]).view("i8,i8").ravel() for i in (0, 1))
    order = {(a, b): k for k, (a, b) in enumerate(zip(one.tolist(), two.tolist(), strict=True))}
    alone = edges[[k for (a, b), k in order.items() if (b, a) not in order and a != b]]
    if ends is not None and len(alone):
        alone = alone[
            shapely.dwithin(shapely.points(alone[:, :, :2].mean(axis=1)), ends, _AT_END_M)
        ]
    if not len(alone):
        return mesh
    under = alone - np.array([0.0, 0.0, _LIFT_M])
    rim = quads(np.stack([under[:, 0], under[:, 1], alone[:, 1], alone[:, 0]], axis=1))
    lit = np.tile(
        [0.0, 0.0, 1.0], (len(rim.vertices), 1)
    )  # like the surface: a millimetre's wall would be a dark line
    return join([mesh, Mesh(rim.vertices, lit, rim.triangles)])


def _cut(part: shapely.Geometry, corners: Floats, normals: Floats) -> Mesh:
    """A part of a triangle, (3, 3) corners and normals, as triangles in its plane."""
    pieces = [p for p in shapely.get_parts(part) if shapely.get_dimensions(p) == 2]
    at = plan_triangles(pieces)[0].reshape(-1, 2)
    shares = np.column_stack([at, np.ones(len(at))]) @ np.linalg.inv(
        np.column_stack([corners[:, :2], np.ones(3)])
    )
    z = shares @ corners[:, 2] + _LIFT_M
    slopes = shares @ normals
    slopes /= np.linalg.norm(slopes, axis=1, keepdims=True)
    return Mesh(np.column_stack([at, z]), slopes, np.arange(len(at), dtype=np.int32).reshape(-1, 3))
