"""Thin covers on open ground: land use on mapped places, frontages in generated cities.

Frontages are paved areas before shops, gardens before homes, and driveways. Covers lie a few
millimetres above the ground. They change camera images, but not labels, friction or wheel contacts.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping
from typing import Final, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import Polygon

from cosim.core.geometry import Floats, Polyline
from cosim.place import overlay
from cosim.place.open_ground import beside, open_ground
from cosim.place.street_map import LandKind, StreetMap, Strip, street_of
from physics.ground.mesh import Mesh, flat_shaded, join, quads, triangulate_areas
from physics.ground.tiles import DRIVEWAY_M, Tile, grown_box, tile_bounds
from physics.street.placement import street_style
from physics.textures.layers import Colour

_LIFT_M: Final = 0.003
"""Height of a cover above the ground in metres."""

_EDGE_GRID_M: Final = 1e-4
"""Distance in metres below which edge ends coincide."""
_AT_END_M: Final = 0.005
"""Tolerance in metres for an edge on the border of a cover."""

_LEVEL_M: Final = 1e-6
"""Height tolerance in metres of level ground."""

_SEARCH_M: Final = 12.0
"""Distance in metres from a tile within which sidewalks may have frontage in it."""

_BED_OVERLAP_M: Final = 0.6
"""Overlap in metres of beds and buildings; fronts are straight where a street bends."""
_MAX_DEPTH_M: Final = 6.0
"""Largest depth of a frontage in metres."""

_YARD_M: Final = 3.0
"""Depth in metres of paved yards between the buildings of a paved street."""
_BED_M: Final = (0.45, 0.8)
"""Smallest and largest width in metres of garden beds along buildings."""


class Cover(NamedTuple):
    """A layer of `physics.textures.ground` and its tint; None keeps the layer's own colour."""

    layer: str
    colour: Colour | None


_SLABS: Final = (0.62, 0.60, 0.57)
_WARM: Final = (0.64, 0.59, 0.52)
_COVERS: Final[Mapping[str, tuple[Cover, ...]]] = {
    "commercial": (
        Cover("slabs-running", _SLABS),
        Cover("slabs-mixed", _WARM),
        Cover("pavers-running", (0.55, 0.53, 0.52)),
        Cover("setts", None),
    ),
    "avenue": (
        Cover("slabs-square", _SLABS),
        Cover("slabs-worn", None),
        Cover("concrete-cast", None),
    ),
    "boulevard": (
        Cover("slabs-mixed", _WARM),
        Cover("gravel", None),
        Cover("pavers-mixed", (0.60, 0.56, 0.50)),
    ),
    "narrow": (Cover("setts", None), Cover("cobbles", None), Cover("slabs-worn", None)),
    "ring": (Cover("slabs-square", _SLABS), Cover("concrete-cast", None)),
}
"""Possible frontage pavings by street class; other classes have gardens."""
_DRIVEWAYS: Final = (
    Cover("concrete-cast", None),
    Cover("pavers-herringbone", (0.56, 0.52, 0.49)),
    Cover("gravel", None),
)
"""Possible surfaces of driveways."""

_BEDS: Final = Cover("earth", None)
"""Surface of garden beds."""


class CoveredMesh(NamedTuple):
    """A mesh on the ground with its cover."""

    mesh: Mesh
    cover: Cover


def land_covers(street_map: StreetMap, tile: Tile, rims: bool) -> dict[LandKind, Mesh]:
    """Return the covers of open ground in a tile by kind of land.

    rims: add vertical rims, so that low cameras do not see under a cover; they are two thirds of
        all triangles
    """
    if "ground" not in tile.parts:
        return {}
    ground = tile.parts["ground"]
    found = {}
    areas = open_ground(street_map, shapely.box(*tile_bounds(tile.key)))
    outline = overlay.union_all(_outlines(ground)) if areas and rims else None
    for kind, area in areas:
        mesh = _clip_simplified(ground, area)
        if outline is not None:
            mesh = _with_rim(mesh, shapely.boundary(overlay.intersection(area, outline)))
        if len(mesh):
            found[kind] = mesh
    return found


def clip_with_rim(mesh: Mesh, area: shapely.Geometry) -> Mesh:
    """Return the parts of a mesh within an area, lifted slightly, with a vertical rim."""
    return _with_rim(_clip(mesh, area))


def _clip_simplified(mesh: Mesh, area: shapely.Geometry) -> Mesh:
    """Clip a mesh to an area like `_clip`, but with few triangles where it is level."""
    height = mesh.vertices[mesh.triangles][:, :, 2]
    level = (height > height.max() - _LEVEL_M).all(axis=1)
    sheet = overlay.intersection(overlay.union_all(_outlines(mesh)[level]), area)
    parts = [
        part
        for part in shapely.get_parts(shapely.simplify(sheet, 1e-3))
        if isinstance(part, Polygon)
    ]
    xy = triangulate_areas(parts)[0].reshape(-1, 2) if parts else np.zeros((0, 2))
    corners = np.column_stack([xy, np.full(len(xy), height.max() + _LIFT_M)])
    flat = flat_shaded(corners)
    return join([flat, _clip(Mesh(mesh.vertices, mesh.normals, mesh.triangles[~level]), area)])


def _clip(mesh: Mesh, area: shapely.Geometry) -> Mesh:
    """Return the parts of a mesh within an area, lifted slightly."""
    shapely.prepare(area)
    corners = mesh.vertices[mesh.triangles]
    outlines = _outlines(mesh)
    touched = np.flatnonzero(shapely.intersects(area, outlines))
    whole = shapely.contains_properly(area, outlines[touched])
    inside = touched[whole]
    used, index = np.unique(mesh.triangles[inside], return_inverse=True)
    lifted = mesh.vertices[used] + np.array([0.0, 0.0, _LIFT_M])
    found = [Mesh(lifted, mesh.normals[used], index.reshape(-1, 3).astype(np.int32))]
    for i in touched[~whole].tolist():
        part = shapely.intersection(outlines[i], area)
        if shapely.area(part) > 1e-4:
            found.append(_clip_triangle(part, corners[i], mesh.normals[mesh.triangles[i]]))
    return join(found)


def _outlines(mesh: Mesh) -> NDArray[np.object_]:
    """Return the triangles of a mesh as plan polygons."""
    return np.asarray(shapely.polygons(mesh.vertices[mesh.triangles][:, :, :2]), dtype=object)


def _with_rim(mesh: Mesh, ends: shapely.Geometry | None = None) -> Mesh:
    """Add a vertical rim under the outer edges of a mesh, so that low cameras do not see under it.

    ends: border of the mesh; None adds a rim at every edge with only one triangle
    """
    if not len(mesh):
        return mesh
    corners = mesh.vertices[mesh.triangles]
    edges = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    grid = np.rint(edges[:, :, :2] / _EDGE_GRID_M).astype(np.int64)
    one, two = (np.ascontiguousarray(grid[:, i]).view("i8,i8").ravel() for i in (0, 1))
    order = {(a, b): k for k, (a, b) in enumerate(zip(one.tolist(), two.tolist(), strict=True))}
    outer = edges[[k for (a, b), k in order.items() if (b, a) not in order and a != b]]
    if ends is not None and len(outer):
        outer = outer[
            shapely.dwithin(shapely.points(outer[:, :, :2].mean(axis=1)), ends, _AT_END_M)
        ]
    if not len(outer):
        return mesh
    below = outer - np.array([0.0, 0.0, _LIFT_M])
    rim = quads(np.stack([below[:, 0], below[:, 1], outer[:, 1], outer[:, 0]], axis=1))
    # Upward normals light the rim like the surface; otherwise it would be a dark line.
    normals = np.tile([0.0, 0.0, 1.0], (len(rim.vertices), 1))
    return join([mesh, Mesh(rim.vertices, normals, rim.triangles)])


def _clip_triangle(part: shapely.Geometry, corners: Floats, normals: Floats) -> Mesh:
    """Triangulate a part of a triangle in the triangle's plane.

    corners, normals: (3, 3) of the triangle
    """
    pieces = [p for p in shapely.get_parts(part) if shapely.get_dimensions(p) == 2]
    at = triangulate_areas(pieces)[0].reshape(-1, 2)
    shares = np.column_stack([at, np.ones(len(at))]) @ np.linalg.inv(
        np.column_stack([corners[:, :2], np.ones(3)])
    )
    z = shares @ corners[:, 2] + _LIFT_M
    slopes = shares @ normals
    slopes /= np.linalg.norm(slopes, axis=1, keepdims=True)
    return flat_shaded(np.column_stack([at, z]), slopes)


def frontage_covers(street_map: StreetMap, tile: Tile, seed: int) -> list[CoveredMesh]:
    """Return the frontage covers in a tile of a generated city; empty on other maps."""
    if not street_map.planned or "ground" not in tile.parts:
        return []
    reach = grown_box(tile_bounds(tile.key), _SEARCH_M)
    strips = [s for s in street_map.near("strip", reach) if isinstance(s, Strip)]
    areas: dict[Cover, list[shapely.Geometry]] = {}
    for strip in strips:
        if strip.kind == "sidewalk":
            for cover, area in _frontage_of(strip, seed):
                areas.setdefault(cover, []).append(area)
    triangles = tile.parts["ground"]
    found: list[CoveredMesh] = []
    taken: shapely.Geometry = shapely.Polygon()
    for cover in sorted(
        areas, key=lambda cover: (cover not in _DRIVEWAYS, cover.layer, cover.colour or ())
    ):
        area = shapely.union_all(areas[cover])
        found.append(CoveredMesh(clip_with_rim(triangles, shapely.difference(area, taken)), cover))
        taken = shapely.union(taken, area)
    return [laid for laid in found if len(laid.mesh)]


def has_paved_frontage(strip: Strip) -> bool:
    """Return whether the frontage of a sidewalk's street is paved instead of gardens."""
    return street_style(strip.street_class) in _COVERS


def _frontage_of(strip: Strip, seed: int) -> list[tuple[Cover, shapely.Geometry]]:
    """Return the frontage and driveways of a sidewalk with their covers."""
    rng = np.random.default_rng([seed, zlib.crc32(strip.id.encode()), 0xF207])
    edge = 0.5 * strip.width_m
    depth = min(strip.frontage_m, _MAX_DEPTH_M)
    covers = _COVERS.get(street_style(strip.street_class))
    of_street = np.random.default_rng([seed, zlib.crc32(street_of(strip.id).encode()), 0xF207])
    found: list[tuple[Cover, shapely.Geometry]] = []
    if strip.road_side == 0 or depth <= 0.0:
        return found
    if covers is not None:
        cover = covers[int(of_street.integers(len(covers)))]
        found.append((cover, beside(strip, edge - 0.05, edge + depth + _YARD_M)))
    elif strip.street_class == "residential" and rng.random() < 0.6:
        width = float(rng.uniform(*_BED_M))
        found.append((_BEDS, beside(strip, edge + depth - width, edge + depth + _BED_OVERLAP_M)))
    way = _DRIVEWAYS[int(of_street.integers(len(_DRIVEWAYS)))]
    middle = Polyline(strip.line)
    for at_m in strip.driveways:
        x, y, heading = middle.at(at_m)
        aside = -strip.road_side * np.array([-math.sin(heading), math.cos(heading)])
        along = 0.5 * DRIVEWAY_M * np.array([math.cos(heading), math.sin(heading)])
        near, far = (np.array([x, y]) + d * aside for d in (edge - 0.05, edge + depth + _YARD_M))
        found.append((way, shapely.Polygon([near - along, near + along, far + along, far - along])))
    return found
