"""Ground of a street map, built as square tiles of triangles.

Roads and crossings lie at height 0 and all other ground at CURB_M. Towards crossings and driveways
the high ground slopes down at 1:12. One formula, min(CURB_M, distance / 12), gives curb ramps and
their flares.

On hilly maps the ground is added to the terrain. Edges of terrain triangles divide the faces, so
that ground triangles lie in terrain planes.

A tile is one planar arrangement. All outlines are noded on a millimetre grid, then the faces
between them are classified and triangulated. Neighbouring faces share vertices, so there are no
cracks. Each tile depends only on the map around it, so adjacent tiles fit.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from cosim.core.geometry import Floats, Polyline
from cosim.place import overlay
from cosim.place.street_map import PieceKind, StreetMap, Strip, union_closed
from cosim.place.terrain import Terrain
from physics.ground.materials import PAVINGS, Paving, end_lines
from physics.ground.mesh import Mesh, join, quads, smooth_normals, triangulate_areas
from physics.ground.relief import Relief, potholes

TILE_M: Final = 48.0
"""Side of a tile in metres."""

CURB_M: Final = 0.12
"""Height of a curb in metres."""

RAMP_SLOPE: Final = 1.0 / 12.0
"""Slope of curb ramps."""

_MANY: Final = 50
"""Number of points from which those beyond all ramps are sorted out first."""
RAMP_M: Final = CURB_M / RAMP_SLOPE
"""Length of a curb ramp in metres."""

CURBSTONE_M: Final = 0.15
"""Width of the curb's top in metres."""

DRIVEWAY_M: Final = 3.0
"""Width of a driveway at the road in metres."""
STRIPE_M: Final = 0.5
"""Length of a zebra stripe, and of the gap after it, along the crossing in metres."""

_GRID_M = 1e-3
"""Grid size in metres to which vertices are rounded."""

_ORIGIN_M = 0.4137
"""Offset of the tile grid in metres, so that no street edge lies on a tile border."""

SURFACES: Mapping[str, tuple[str, tuple[float, float, float]]] = {
    "road": ("road", (0.29, 0.29, 0.31)),
    "crossing": ("crosswalk", (0.31, 0.31, 0.33)),
    "stripe": ("crosswalk", (0.93, 0.93, 0.90)),
    "sidewalk": ("sidewalk", (0.66, 0.63, 0.58)),
    "ramp": ("sidewalk", (0.72, 0.66, 0.50)),
    "curb": ("curb", (0.80, 0.80, 0.78)),
    "verge": ("verge", (0.35, 0.50, 0.24)),
    "ground": ("ground", (0.50, 0.55, 0.40)),
}
"""Label (see `cosim.core.state.LABELS`) and sRGB colour of each kind of ground."""


def surface_look(name: str) -> tuple[str, tuple[float, float, float]]:
    """Return the label and sRGB colour of a surface name."""
    label, colour = SURFACES[ground_kind(name)]
    return label, PAVINGS.get(name, colour)


def ground_kind(name: str) -> str:
    """Return the kind of ground of a surface name."""
    return name.partition(":")[0]


_WALKABLE: Final[tuple[PieceKind, ...]] = ("strip", "corner")
"""Kinds of map pieces that are walkable."""

_LOW = ("road", "crossing", "stripe")
"""Kinds of ground at road level."""

Key = tuple[int, int]
"""Column and row of a tile."""


@dataclass(frozen=True, slots=True)
class Tile:
    """Ground of one square.

    parts: mesh of each surface name
    low: area of roads and crossings
    crossings: area that ramps lead to: crossings and mouths of driveways
    relief: unevenness, None at roughness 0
    terrain: heights of the land, None on flat maps

    Both areas extend at least RAMP_M beyond the square.
    """

    key: Key
    parts: Mapping[str, Mesh]
    low: shapely.Geometry
    crossings: shapely.Geometry
    relief: Relief | None = None
    terrain: Terrain | None = None

    def height(self, xy: ArrayLike) -> Floats:
        """Return the (N,) ground heights in metres at (N, 2) points in the square."""
        xy = np.asarray(xy, dtype=float).reshape(-1, 2)
        _, low, high = _heights(xy, self.crossings, self.relief, self.terrain)
        return np.where(shapely.contains_xy(self.low, xy[:, 0], xy[:, 1]), low, high)


def tile_at(x_m: float, y_m: float) -> Key:
    """Return the tile that contains a point."""
    return math.floor((x_m - _ORIGIN_M) / TILE_M), math.floor((y_m - _ORIGIN_M) / TILE_M)


def tile_indices(xy: Floats) -> NDArray[np.int64]:
    """Return the (N, 2) tiles that contain (N, 2) points."""
    return np.asarray(np.floor((xy - _ORIGIN_M) / TILE_M), dtype=np.int64)


def tile_bounds(key: Key) -> tuple[float, float, float, float]:
    """Return x0, y0, x1, y1 of a tile in metres."""
    x, y = key[0] * TILE_M + _ORIGIN_M, key[1] * TILE_M + _ORIGIN_M
    return x, y, x + TILE_M, y + TILE_M


def grown_box(bounds: Iterable[float], margin_m: float) -> shapely.Polygon:
    """Return the box of bounds (x0, y0, x1, y1) enlarged by a margin, in metres."""
    x0, y0, x1, y1 = (float(b) for b in bounds)
    return shapely.box(x0 - margin_m, y0 - margin_m, x1 + margin_m, y1 + margin_m)


def tiles_within(x_m: float, y_m: float, radius_m: float) -> list[Key]:
    """Return the tiles within a radius of a point, row by row."""
    return [key for _, key in tile_distances_within(x_m, y_m, radius_m)]


def tile_distances_within(x_m: float, y_m: float, radius_m: float) -> list[tuple[float, Key]]:
    """Return the tiles of `tiles_within`, each with its distance in metres."""
    (i0, j0) = tile_at(x_m - radius_m, y_m - radius_m)
    (i1, j1) = tile_at(x_m + radius_m, y_m + radius_m)
    keys = [(i, j) for j in range(j0, j1 + 1) for i in range(i0, i1 + 1)]
    found = [(tile_distance(key, x_m, y_m), key) for key in keys]
    return [one for one in found if one[0] <= radius_m]


def tiles_touching(area: shapely.Geometry) -> list[Key]:
    """Return the tiles that an area touches, column by column."""
    x0, y0, x1, y1 = shapely.bounds(area).tolist()
    (i0, j0) = tile_at(x0, y0)
    (i1, j1) = tile_at(x1, y1)
    keys = [(i, j) for i in range(i0, i1 + 1) for j in range(j0, j1 + 1)]
    shapely.prepare(area)
    return [key for key in keys if shapely.intersects(area, shapely.box(*tile_bounds(key)))]


def tile_distance(key: Key, x_m: float, y_m: float) -> float:
    """Return the distance in metres from a point to a tile; 0 inside."""
    x0, y0, x1, y1 = tile_bounds(key)
    return math.hypot(max(x0 - x_m, x_m - x1, 0.0), max(y0 - y_m, y_m - y1, 0.0))


def build_tile(
    street_map: StreetMap,
    key: Key,
    paving: Paving | None = None,
    roughness: float = 0.0,
    seed: int = 0,
    roots: ArrayLike = (),
) -> Tile:
    """Build the ground of one tile.

    paving: materials of the streets; None for plain ground
    roughness: 0 (flat) to 1
    seed: seed of the unevenness
    roots: (N, 2) trees in and around the tile, m
    """
    border = shapely.box(*tile_bounds(key))
    reach = grown_box(tile_bounds(key), RAMP_M + 1.0)
    zones, stripes = _zones(street_map, reach)
    low = shapely.union_all([zones["road"], zones["crossing"]])
    shapely.prepare(low)
    pieces = paving.pieces(reach) if paving else []
    ends = end_lines(pieces)
    relief = None
    if roughness > 0.0:
        holes = potholes(zones["road"], tile_bounds(key), roughness, seed)
        relief = Relief(roughness, seed, np.asarray(roots, dtype=float).reshape(-1, 2), holes)
        ends = np.concatenate([ends, relief.lines(zones["pavement"], tile_bounds(key))])
    terrain = street_map.terrain
    if terrain is not None:
        ends = np.concatenate([ends, shapely.linestrings(terrain.creases(tile_bounds(key)))])
    faces = _faces(border, zones, low, stripes, ends)
    points = shapely.get_coordinates(shapely.point_on_surface(faces))
    names = _classify(points, zones, stripes)
    if paving:
        names = paving.surface_names(names, points, pieces, reach)
    parts = _triangulate(faces, names, zones["ramp_to"], relief, terrain)
    return Tile(key, parts, low, zones["ramp_to"], relief, terrain)


def _zones(
    street_map: StreetMap, reach: shapely.Polygon
) -> tuple[dict[str, shapely.Geometry], shapely.Geometry]:
    """Return disjoint areas of the ground within `reach`, and the zebra stripes.

    Where pieces overlap, pavement takes precedence over crossings, then roads, then verges.
    "ramp_to" is the union of all crossings and driveway mouths. "apron" is where driveways cross
    the verge.
    """
    strips = [s for s in street_map.near("strip", reach) if isinstance(s, Strip)]
    lanes = street_map.near("lane", reach)
    sidewalks = [s.polygon for s in strips if s.kind == "sidewalk"]
    corners: list[shapely.Geometry] = [c.polygon for c in street_map.near("corner", reach)]
    roads: list[shapely.Geometry] = [
        lane.polygon for lane in lanes if getattr(lane, "kind", "") == "road"
    ]
    roads += [
        part
        for j in street_map.near("junction", reach)
        for part in _junction_roads(street_map, j.polygon)
    ]
    verges = [lane.polygon for lane in lanes if getattr(lane, "kind", "") == "verge"]
    crossings = [s for s in strips if s.kind == "crossing"]

    pavement = _union([*sidewalks, *corners], reach)
    zebras = _union([s.polygon for s in crossings], reach, closed=False)
    crossing = overlay.difference(zebras, pavement)
    road = overlay.difference(_union(roads, reach), overlay.union(pavement, zebras))
    verge = overlay.difference(_union(verges, reach), overlay.union_all([pavement, zebras, road]))
    mouths = [_driveway_part(s, at_m, 0.0, 0.1) for s in strips for at_m in s.driveways]
    aprons = [
        _driveway_part(s, at_m, -s.verge_m, 0.0)
        for s in strips
        for at_m in s.driveways
        if s.verge_m
    ]
    apron = overlay.intersection(_union(aprons, reach, closed=False), verge)
    ramp_to = overlay.union(zebras, _union(mouths, reach, closed=False))
    verge = overlay.difference(verge, apron)
    bars = [_stripes(s) for s in crossings]
    stripes = overlay.intersection(overlay.union_all(bars), crossing)
    zones = {
        "pavement": pavement,
        "crossing": crossing,
        "road": road,
        "verge": verge,
        "apron": apron,
    }
    zones["ramp_to"] = ramp_to
    for zone in (*zones.values(), stripes):
        shapely.prepare(zone)
    return zones, stripes


def _driveway_part(strip: Strip, at_m: float, from_m: float, to_m: float) -> shapely.Polygon:
    """Return the part of a driveway between two distances from the road's edge.

    Distances are positive on the road.
    """
    x, y, heading = Polyline(strip.line).at(at_m)
    road = strip.road_side * (0.5 * strip.width_m + strip.verge_m)
    along = 0.5 * DRIVEWAY_M * np.array([math.cos(heading), math.sin(heading)])
    aside = np.array([-math.sin(heading), math.cos(heading)])
    near, far = (np.array([x, y]) + (road + strip.road_side * d) * aside for d in (from_m, to_m))
    return shapely.Polygon([near - along, near + along, far + along, far - along])


def _junction_roads(street_map: StreetMap, outline: shapely.Geometry) -> list[shapely.Geometry]:
    """Return the parts of a junction that belong to its roads, without slivers behind corners."""
    junction = shapely.make_valid(outline)
    walked: list[shapely.Geometry] = [
        p.polygon for kind in _WALKABLE for p in street_map.near(kind, junction)
    ]
    lanes = [
        lane.polygon
        for lane in street_map.near("lane", junction)
        if getattr(lane, "kind", "") == "road"
    ]
    if not lanes or not walked:
        return [junction]
    parts = shapely.get_parts(
        overlay.difference(junction, union_closed([shapely.make_valid(p) for p in walked]))
    )
    return list(parts[shapely.dwithin(parts, overlay.union_all(lanes), 0.01)])


def _union(
    polygons: Sequence[shapely.Geometry], reach: shapely.Polygon, closed: bool = True
) -> shapely.Geometry:
    """Return the union of polygons within `reach`; `closed` also fills small gaps."""
    if not polygons:
        return shapely.Polygon()
    cut = overlay.intersection(shapely.make_valid(np.asarray(polygons, dtype=object)), reach)
    parts = [part for part in shapely.get_parts(cut) if shapely.area(part) > 0.0]
    if not parts:
        return shapely.Polygon()
    return union_closed(parts) if closed else overlay.union_all(parts)


def _stripes(crossing: Strip) -> shapely.Geometry:
    """Return the zebra stripes of a crossing: bars across it, evenly spaced."""
    line = Polyline(crossing.line)
    count = max(int(line.length_m / (2.0 * STRIPE_M)), 1)
    bars = []
    for s in (np.arange(count) + 0.5) * line.length_m / count:
        x, y, heading = line.at(float(s))
        along = 0.5 * STRIPE_M * np.array([math.cos(heading), math.sin(heading)])
        aside = 0.5 * (crossing.width_m - 0.2) * np.array([-math.sin(heading), math.cos(heading)])
        middle = np.array([x, y])
        bars.append(
            shapely.Polygon(
                middle + np.array([along + aside, aside - along, -along - aside, along - aside])
            )
        )
    return overlay.union_all(bars)


def _faces(
    border: shapely.Polygon,
    zones: Mapping[str, shapely.Geometry],
    low: shapely.Geometry,
    stripes: shapely.Geometry,
    ends: NDArray[np.object_],
) -> NDArray[np.object_]:
    """Return the faces of the arrangement of all outlines within `border`.

    ends: additional lines that divide the faces
    """
    contours = [
        shapely.buffer(zones["ramp_to"], share * RAMP_M, quad_segs=3) for share in (0.5, 1.0)
    ]
    curbstone = shapely.buffer(zones["road"], CURBSTONE_M, join_style="mitre", mitre_limit=2.0)
    on_high = overlay.difference(
        shapely.boundary(np.array([*contours, curbstone], dtype=object)), low
    )
    outlines = shapely.boundary(
        np.array([*(zones[k] for k in ("pavement", "crossing", "road", "verge", "apron")), stripes])
    )
    inside = shapely.intersection(np.concatenate([on_high, outlines, ends]), border)
    lines = [part for part in shapely.get_parts(inside) if shapely.get_dimensions(part) == 1]
    noded = shapely.union_all([*lines, shapely.boundary(border)], grid_size=_GRID_M)
    return np.asarray(shapely.get_parts(shapely.polygonize(shapely.get_parts(noded))), dtype=object)


def _classify(
    point: Floats, zones: Mapping[str, shapely.Geometry], stripes: shapely.Geometry
) -> list[str]:
    """Return the kind of ground at (N, 2) points."""
    x, y = point[:, 0], point[:, 1]
    kind = np.full(len(point), "ground", dtype=object)
    kind[shapely.contains_xy(zones["verge"], x, y)] = "verge"
    pavement = shapely.contains_xy(zones["pavement"], x, y)
    kind[pavement] = "sidewalk"
    kind[pavement & (_height_above_land(point, zones["ramp_to"]) < CURB_M - 1e-6)] = "ramp"
    kind[shapely.contains_xy(zones["apron"], x, y)] = "ramp"
    points = shapely.points(point)
    kind[shapely.distance(points, zones["road"]) < CURBSTONE_M] = "curb"
    kind[shapely.contains_xy(zones["road"], x, y)] = "road"
    kind[shapely.contains_xy(zones["crossing"], x, y)] = "crossing"
    kind[shapely.contains_xy(stripes, x, y)] = "stripe"
    return list(kind)


def _triangulate(
    faces: NDArray[np.object_],
    names: Sequence[str],
    ramp_to: shapely.Geometry,
    relief: Relief | None,
    terrain: Terrain | None,
) -> dict[str, Mesh]:
    """Return a mesh for each surface name; the mesh of curbs includes their walls."""
    corners, face = triangulate_areas(faces)
    grid, index = np.unique(
        np.rint(corners.reshape(-1, 2) / _GRID_M).astype(np.int64), axis=0, return_inverse=True
    )
    triangles = index.reshape(-1, 3)
    xy: Floats = grid.astype(float) * _GRID_M
    land, low, high = _heights(xy, ramp_to, relief, terrain)
    found = [*SURFACES, *sorted(set(names) - SURFACES.keys())]
    surface_of = np.array([found.index(name) for name in names])[face]
    at_road_level = np.array([ground_kind(name) in _LOW for name in found])
    parts = {
        name: _surface_mesh(
            xy,
            low if at_road_level[i] else high,
            triangles[surface_of == i],
            relief is not None or terrain is not None,
        )
        for i, name in enumerate(found)
    }
    walls = _walls(xy, land, high, triangles, at_road_level[surface_of])
    parts["curb"] = join([parts["curb"], walls])
    return {name: mesh for name, mesh in parts.items() if len(mesh)}


def _walls(
    xy: Floats, land: Floats, high: Floats, triangles: NDArray[np.int64], is_low: NDArray[np.bool_]
) -> Mesh:
    """Build vertical faces between adjacent low and high triangles; they face the low side."""
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    low = np.tile(is_low, 3)
    codes = edges[:, 0] * len(xy) + edges[:, 1]
    twins = edges[:, 1] * len(xy) + edges[:, 0]
    step = low & np.isin(twins, codes[~low])
    a, b = edges[step].T
    keep = np.maximum(high[a] - land[a], high[b] - land[b]) > 1e-4
    a, b = a[keep], b[keep]
    at = [
        np.column_stack([xy[i], z])
        for i, z in ((b, land[b]), (a, land[a]), (a, high[a]), (b, high[b]))
    ]
    walls = quads(np.stack(at, axis=1))
    one, two = (
        walls.vertices[walls.triangles[:, i]] - walls.vertices[walls.triangles[:, 0]]
        for i in (1, 2)
    )
    real = np.linalg.norm(np.cross(one, two), axis=1) > 1e-9
    return Mesh(walls.vertices, walls.normals, walls.triangles[real])


def _surface_mesh(
    xy: Floats, z: Floats, triangles: NDArray[np.int64], shaded: bool = False
) -> Mesh:
    """Build a mesh from the used vertices; `scale_brightness` computes smooth normals."""
    used, index = np.unique(triangles, return_inverse=True)
    corners = index.reshape(-1, 3).astype(np.int32)
    vertices = np.column_stack([xy[used], z[used]])
    normals = np.tile([0.0, 0.0, 1.0], (len(used), 1))
    if shaded:
        slopes = smooth_normals(vertices, corners)
        normals = np.where(slopes[:, 2:] > 0.0, slopes, normals)
    return Mesh(vertices, normals, corners)


def _heights(
    xy: Floats, ramp_to: shapely.Geometry, relief: Relief | None, terrain: Terrain | None
) -> tuple[Floats, Floats, Floats]:
    """Return heights of the land, of the road and of high ground at (N, 2) points, each (N,) m.

    The unevenness of pavement fades out along ramps.
    """
    land = np.zeros(len(xy)) if terrain is None else terrain.height(xy)
    low = land
    high = _height_above_land(xy, ramp_to)
    if relief is not None:
        low = land + relief.on_road(xy)
        high = high + relief.pavement_offset(xy) * high / CURB_M
    return land, low, high if terrain is None else land + high


def _height_above_land(xy: Floats, ramp_to: shapely.Geometry) -> Floats:
    """Return the height of high ground above the land at (N, 2) points: CURB_M, less on ramps."""
    if shapely.is_empty(ramp_to):
        return np.full(len(xy), CURB_M)
    if len(xy) < _MANY:
        return _up_the_ramp(xy, ramp_to)
    height = np.full(len(xy), CURB_M)
    bounds = shapely.bounds(shapely.get_parts(ramp_to))
    lowest, highest = bounds[:, :2], bounds[:, 2:]
    reach = RAMP_M + 0.01  # beyond it no distance is needed
    inside = (xy[:, None] > lowest - reach) & (xy[:, None] < highest + reach)
    rows = np.flatnonzero(np.any(np.all(inside, axis=2), axis=1))
    height[rows] = _up_the_ramp(xy[rows], ramp_to)
    return height


def _up_the_ramp(xy: Floats, ramp_to: shapely.Geometry) -> Floats:
    gap = np.asarray(shapely.distance(shapely.points(xy), ramp_to), dtype=float)
    return np.minimum(CURB_M, gap * RAMP_SLOPE)
