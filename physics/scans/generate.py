"""Generated scans: a generated street as a mesh with colours and as Gaussian splats.

The colours contain the light of a time of day, without cast shadows, as those of a photographed
scan do. The frame is the street's, moved so that the middle of the box is at 0, 0.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import msgspec
import numpy as np
import shapely
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cosim.core.geometry import Floats
from cosim.core.progress import Progress, ignore
from cosim.place import overlay
from cosim.place.scan import AreaKind, ScanArea, encode_areas
from cosim.place.street_map import Lane, StreetMap, Strip
from cosim.spec.scenario import Light
from physics.cameras.sky import Sky, sky_of
from physics.ground.mesh import Ints, Mesh
from physics.ground.tiles import tiles_touching
from physics.scans.read_splats import SH_C0
from physics.scans.write_splats import SPLAT_ROW, write_splats
from physics.street.buildings import FACADES, WINDOW_COLOUR, facade_meshes
from physics.street.furniture import KINDS, footprints, parts_of
from physics.street.street_surface import StreetSurface
from physics.street.surface import Patch
from physics.textures.ground import scan_layers
from physics.textures.layers import Layers, linear_to_srgb, srgb_to_linear

Box = tuple[float, float, float, float]
"""x0, y0, x1, y1 in metres."""

SPACING_M: Final = 0.1
"""Default distance between splats on the ground in metres."""
_WALL_SPACING: Final = 1.7
"""Distance between splats elsewhere, as a multiple of that on the ground."""
_SPREAD: Final = 0.7
"""Standard deviation of a splat along its surface, as a share of their distance."""
_THICKNESS_M: Final = 0.004
"""Standard deviation of a splat across its surface in metres."""
_OPACITY: Final = 0.98
_MESH_EDGE_M: Final = 0.5
"""Longest edge of the mesh in metres, as colours are stored at its vertices."""
_COVER_M: Final = 0.1
"""Largest distance in metres between a wall and a window before it."""
_NEAR_SHARE: Final = 0.75
"""Distance within which a splat covers another, as a share of the distance between splats."""
_BORDER_M: Final = 0.5
"""Longest edge of triangles at the border of the box in metres."""
_TEXELS: Final = 256
_STEPS: Final = (0.7548776662466927, 0.5698402909980532)
"""Steps of the low-discrepancy sequence of points in triangles."""


class SurfaceSplats(NamedTuple):
    """Thin splats on surfaces.

    centres: (N, 3) metres.
    normals: (N, 3) unit vectors.
    colours: (N, 3) sRGB, 0 to 1.
    spacings: (N,) metres between splats.
    """

    centres: Floats
    normals: Floats
    colours: Floats
    spacings: Floats


class _Piece(NamedTuple):
    """Triangles of one look.

    layer: texture layer of the ground, -1 without.
    """

    mesh: Mesh
    colour: Floats
    layer: int = -1
    tinted: bool = True


def write_generated_scan(
    surface: StreetSurface,
    box: Box,
    folder: Path,
    light: Light | None = None,
    spacing_m: float = SPACING_M,
    progress: Progress = ignore,
) -> int:
    """Write a generated street as a scan: mesh.ply, splats.ply, areas.geojson and scan.json.

    spacing_m: distance between splats on the ground.
    Returns the number of splats. Raises OSError.
    """
    light = Light() if light is None else light
    sky = sky_of(light, surface.seed)
    middle = np.array([0.5 * (box[0] + box[2]), 0.5 * (box[1] + box[3]), 0.0])
    progress("building the street")
    pieces = [_clipped(piece, box) for piece in _pieces(surface, box)]
    pieces = [piece for piece in pieces if len(piece.mesh)]
    progress("sampling splats")
    splats = sample_splats(pieces, sky, surface.seed, spacing_m)
    folder.mkdir(parents=True, exist_ok=True)
    _write_splats(splats, middle, folder / "splats.ply")
    progress("writing the mesh")
    _write_mesh(pieces, sky, middle, folder / "mesh.ply")
    areas = [
        ScanArea(area.kind, part)
        for area in street_areas(surface, box)
        for part in _polygons(shapely.transform(area.polygon, lambda xy: xy - middle[:2]))
    ]
    (folder / "areas.geojson").write_bytes(encode_areas(areas))
    azimuth = math.degrees(math.atan2(sky.sun[0], sky.sun[1])) % 360.0
    facts = {
        "scale": 1.0,
        "up": "+z",
        "areas": "areas.geojson",
        "sun": {
            "azimuth_deg": round(azimuth, 2),
            "elevation_deg": round(math.degrees(math.asin(sky.sun[2])), 2),
        },
        "licence": "generated, without rights of others",
    }
    words = msgspec.json.format(msgspec.json.encode(facts), indent=2)
    (folder / "scan.json").write_bytes(words + b"\n")
    return len(splats.centres)


def street_areas(surface: StreetSurface, box: Box) -> list[ScanArea]:
    """Return the walkable ground, roads, verges and obstacles of a street within a box.

    Crossings lie on roads; no other two kinds of ground overlap.
    """
    inside = shapely.box(*box)
    street_map = surface.street_map
    ground: dict[AreaKind, list[shapely.Geometry]] = {
        "crossing": [s.polygon for s in _strips(street_map, inside) if s.kind == "crossing"],
        "sidewalk": [
            *(s.polygon for s in _strips(street_map, inside) if s.kind == "sidewalk"),
            *(corner.polygon for corner in street_map.near("corner", inside)),
        ],
        "road": [
            *(lane.polygon for lane in _lanes(street_map, inside) if lane.kind == "road"),
            *(junction.polygon for junction in street_map.near("junction", inside)),
        ],
        "verge": [lane.polygon for lane in _lanes(street_map, inside) if lane.kind == "verge"],
        "obstacle": list(footprints(surface.standing(inside))),
    }
    taken: shapely.Geometry = shapely.Polygon()
    areas = []
    for kind, shapes in ground.items():
        shape = overlay.intersection(overlay.union_all(shapes), inside)
        if kind not in ("crossing", "obstacle"):
            shape, taken = overlay.difference(shape, taken), overlay.union_all([taken, shape])
        areas += [ScanArea(kind, part) for part in _polygons(_without_slivers(shape))]
    return areas


def _without_slivers(shape: shapely.Geometry) -> shapely.Geometry:
    """Return a shape in whole millimetres, without parts and holes narrower than 4 cm."""
    smaller = shapely.buffer(shape, -0.02, join_style="mitre")
    larger = shapely.buffer(smaller, 0.04, join_style="mitre")
    return shapely.set_precision(shapely.buffer(larger, -0.02, join_style="mitre"), 1e-3)


def sample_splats(pieces: Sequence[_Piece], sky: Sky, seed: int, spacing_m: float) -> SurfaceSplats:
    """Return splats at regular distances on the surfaces."""
    rng = np.random.default_rng([seed, zlib.crc32(b"scan splats")])
    found = []
    for piece in pieces:
        spacing = spacing_m * (1.0 if piece.layer >= 0 else _WALL_SPACING)
        corners = piece.mesh.vertices[piece.mesh.triangles]
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        twice_m2 = np.sqrt((across**2).sum(axis=1))
        counts = np.diff(np.floor(np.cumsum([rng.random(), *(0.5 * twice_m2 / spacing**2)])))
        owner = np.repeat(np.arange(len(corners)), counts.astype(int))
        u, v = _points(len(owner), rng)
        a, b, c = (corners[owner, k] for k in range(3))
        centres = a + u[:, None] * (b - a) + v[:, None] * (c - a)
        normals = across[owner] / twice_m2[owner, None]
        colours = _lit(piece, centres, normals, sky, spacing)
        found.append(SurfaceSplats(centres, normals, colours, np.full(len(owner), spacing)))
    return _without_covered(SurfaceSplats(*map(np.concatenate, zip(*found, strict=True))), found)


def _without_covered(whole: SurfaceSplats, parts: Sequence[SurfaceSplats]) -> SurfaceSplats:
    """Return the splats that no parallel surface of another piece covers within `_COVER_M`.

    Walls continue behind windows, and would mix with them.
    """
    owner = np.repeat(np.arange(len(parts)), [len(part.centres) for part in parts])
    upright = np.flatnonzero(np.abs(whole.normals[:, 2]) < 0.5)
    at = whole.centres[upright]
    one, other = (
        cKDTree(at).query_pairs(_NEAR_SHARE * whole.spacings.max(), output_type="ndarray").T
    )
    one, other = np.concatenate([one, other]), np.concatenate([other, one])
    normals, offset = whole.normals[upright], at[other] - at[one]
    ahead_m = sum(offset[:, k] * normals[one, k] for k in range(3))
    parallel = sum(normals[one, k] * normals[other, k] for k in range(3))
    apart = owner[upright][one] != owner[upright][other]
    covered = apart & (parallel > 0.9) & (ahead_m > 1e-4) & (ahead_m < _COVER_M)
    shown = np.ones(len(whole.centres), dtype=bool)
    shown[upright[one[covered]]] = False
    return SurfaceSplats(*(column[shown] for column in whole))


def _pieces(surface: StreetSurface, box: Box) -> Iterator[_Piece]:
    """Yield everything that stands and lies in a box."""
    layers = scan_layers(_TEXELS)
    for key in tiles_touching(shapely.box(*box)):
        chunk, finish = surface.chunk(key), surface.finish(key)
        for patch in (*chunk.ground, *finish.laid):
            yield _ground_piece(patch, layers)
        for facade, mesh in facade_meshes(chunk.buildings).items():
            yield _Piece(mesh, np.array(WINDOW_COLOUR if facade < 0 else FACADES[facade]))
        for prop, z in chunk.props:
            for part in parts_of(*prop.form):
                paint = part.colour or KINDS[prop.kind].paints[prop.paint]
                placed = part.mesh.moved((prop.x_m, prop.y_m, z), prop.drawn_heading_rad)
                yield _Piece(placed, np.array(paint))


def _ground_piece(patch: Patch, layers: Layers) -> _Piece:
    return _Piece(patch.mesh, np.array(patch.colour), layers.index(patch.layer), patch.tinted)


def _clipped(piece: _Piece, box: Box) -> _Piece:
    """Return the part of a piece in a box; triangles across its border are divided."""
    vertices, triangles = piece.mesh.vertices, piece.mesh.triangles
    corners = vertices[triangles]
    low, high = corners.min(axis=1), corners.max(axis=1)
    out = ((high[:, :2] < box[:2]) | (low[:, :2] > box[2:])).any(axis=1)
    inside = ((low[:, :2] >= box[:2]) & (high[:, :2] <= box[2:])).all(axis=1)
    cut_vertices, cut = trimesh.remesh.subdivide_to_size(
        vertices, triangles[~out & ~inside], _BORDER_M, max_iter=16
    )
    x, y, _ = cut_vertices[cut].mean(axis=1).T
    cut = cut[(x > box[0]) & (x < box[2]) & (y > box[1]) & (y < box[3])]
    joined = np.concatenate([vertices, cut_vertices])
    faces = np.concatenate([triangles[inside], cut + len(vertices)]).astype(np.int32)
    across = np.cross(
        joined[faces[:, 1]] - joined[faces[:, 0]], joined[faces[:, 2]] - joined[faces[:, 0]]
    )
    faces = faces[(across != 0.0).any(axis=1)]
    return piece._replace(mesh=Mesh(joined, np.zeros_like(joined), faces))


def _lit(piece: _Piece, at: Floats, normals: Floats, sky: Sky, size_m: float) -> Floats:
    """Return (N, 3) sRGB colours of a piece at points, as a camera sees them."""
    albedo = _albedo(piece, at, size_m)
    up, side, down = sky.ambient
    rise = normals[:, 2:]
    light = side + rise * (0.5 * (up - down)) + np.abs(rise) * (0.5 * (up + down) - side)
    facing = sum(normals[:, k] * sky.sun[k] for k in range(3))
    light = light + np.maximum(facing, 0.0)[:, None] * sky.sun_colour
    x = albedo * light * sky.scan_exposure
    shown = np.minimum(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 1.0)
    return np.asarray(linear_to_srgb(shown))


def _albedo(piece: _Piece, at: Floats, size_m: float) -> Floats:
    tint = srgb_to_linear(piece.colour)
    if piece.layer < 0:
        return np.tile(tint, (len(at), 1))
    layers = scan_layers(_TEXELS)
    side = float(layers.metres[piece.layer, 0])
    texels = _coarse(layers.rgba[piece.layer], max(int(size_m / side * _TEXELS), 1))
    rows = np.floor(at[:, 1] / side % 1.0 * len(texels)).astype(int) % len(texels)
    columns = np.floor(at[:, 0] / side % 1.0 * len(texels)).astype(int) % len(texels)
    seen = texels[rows, columns]
    mix = seen[:, 3:] if piece.tinted else 0.0 * seen[:, 3:]
    return np.asarray(seen[:, :3] * (1.0 - mix + mix * tint / layers.mean[piece.layer]))


def _coarse(rgba: NDArray[np.uint8], factor: int) -> Floats:
    """Return the (S, S, 4) mean linear colour and tint share of squares of texels."""
    factor = 2 ** int(math.log2(min(factor, len(rgba))))
    values = np.concatenate([srgb_to_linear(rgba[..., :3] / 255.0), rgba[..., 3:] / 255.0], axis=2)
    count = len(rgba) // factor
    return np.asarray(values.reshape(count, factor, count, factor, 4).mean(axis=(1, 3)))


def _points(count: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Return evenly distributed barycentric coordinates."""
    number = np.arange(count)
    u, v = (
        (start + number * step) % 1.0 for start, step in zip(rng.random(2), _STEPS, strict=True)
    )
    far = u + v > 1.0
    return np.where(far, 1.0 - u, u), np.where(far, 1.0 - v, v)


def _write_splats(splats: SurfaceSplats, middle: Floats, path: Path) -> None:
    rows = np.zeros(len(splats.centres), dtype=SPLAT_ROW)
    for k, name in enumerate("xyz"):
        rows[name] = splats.centres[:, k] - middle[k]
        rows[f"n{name}"] = splats.normals[:, k]
        rows[f"f_dc_{k}"] = (splats.colours[:, k] - 0.5) / SH_C0
    rows["opacity"] = math.log(_OPACITY / (1.0 - _OPACITY))
    rows["scale_0"] = rows["scale_1"] = np.log(_SPREAD * splats.spacings)
    rows["scale_2"] = math.log(_THICKNESS_M)
    # The rotation turns the third axis to the normal: half-way between both.
    w = np.maximum(1.0 + splats.normals[:, 2], 0.0)
    turned = np.stack([w, -splats.normals[:, 1], splats.normals[:, 0], 0.0 * w], axis=1)
    turned[w < 1e-9] = (0.0, 1.0, 0.0, 0.0)
    turned /= np.sqrt((turned**2).sum(axis=1, keepdims=True))
    for k in range(4):
        rows[f"rot_{k}"] = turned[:, k]
    write_splats(rows, path)


def _write_mesh(pieces: Sequence[_Piece], sky: Sky, middle: Floats, path: Path) -> None:
    """Write all surfaces as one .ply file with colours of vertices."""
    parts = []
    for piece in pieces:
        vertices, triangles = trimesh.remesh.subdivide_to_size(
            piece.mesh.vertices, piece.mesh.triangles, _MESH_EDGE_M, max_iter=12
        )
        corners = vertices[triangles].reshape(-1, 3)
        faces = np.arange(len(corners), dtype=np.int32).reshape(-1, 3)
        across = np.cross(corners[1::3] - corners[::3], corners[2::3] - corners[::3])
        long = np.maximum(np.sqrt((across**2).sum(axis=1, keepdims=True)), 1e-12)
        normals = np.repeat(across / long, 3, axis=0)
        colours = _lit(piece, corners, normals, sky, _MESH_EDGE_M)
        parts.append(_merged(corners, faces, np.rint(255.0 * colours).astype(np.uint8)))
    starts = np.cumsum([0, *(len(part[0]) for part in parts)])
    mesh = trimesh.Trimesh(
        np.concatenate([part[0] for part in parts]) - middle,
        np.concatenate([part[1] + start for part, start in zip(parts, starts, strict=False)]),
        vertex_colors=np.concatenate([part[2] for part in parts]),
        process=False,
    )
    mesh.export(path, file_type="ply")


def _merged(
    vertices: Floats, triangles: Ints, colours: NDArray[np.uint8]
) -> tuple[Floats, Ints, NDArray[np.uint8]]:
    """Merge vertices of equal position and colour."""
    keys = np.concatenate([np.rint(vertices * 1e4), colours], axis=1).astype(np.int64)
    _, first, places = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    return vertices[first], places.reshape(-1)[triangles].astype(np.int32), colours[first]


def _strips(street_map: StreetMap, area: shapely.Geometry) -> list[Strip]:
    return [piece for piece in street_map.near("strip", area) if isinstance(piece, Strip)]


def _lanes(street_map: StreetMap, area: shapely.Geometry) -> list[Lane]:
    return [piece for piece in street_map.near("lane", area) if isinstance(piece, Lane)]


def _polygons(shape: shapely.Geometry) -> list[shapely.Polygon]:
    return [
        part
        for part in shapely.get_parts(shape)
        if isinstance(part, shapely.Polygon) and part.area > 0.01
    ]
