"""Road markings and tactile paving, which change only the look of the ground.

Markings are lane lines, centre lines and stop lines before signalised crossings. Tactile domes lie
where a crossing begins. A marking belongs to the tile of its centre and follows that tile's
heights. Domes are cut along the triangles of each tile.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Final

import numpy as np
import shapely
from numpy.typing import NDArray

from cosim.core.geometry import Floats, Polyline
from cosim.place.street_map import Lane, StreetMap, Strip
from physics.ground.mesh import EMPTY, Mesh, flat_shaded, join, triangulate_areas
from physics.ground.tiles import Tile, ground_kind, grown_box, tile_at, tile_bounds

LINE_M: Final = 0.12
"""Width of lane lines in metres."""

STOP_LINE_M: Final = 0.40
"""Width of stop lines in metres."""

TACTILE_M: Final = 0.60
"""Depth of tactile paving along the crossing in metres."""
_DASH_M: Final = (3.0, 6.0)
"""Length of a lane-line dash and of the gap after it in metres."""

_CENTRE_DASH_M: Final = (3.0, 3.0)
"""Length of a centre-line dash and of the gap after it in metres."""
_QUAD_MAX_M: Final = 1.0
"""Largest length in metres of a quad, so that lines follow bends and slopes."""

_STOP_BEFORE_M: Final = 0.5
"""Distance in metres between a stop line and the crossing."""

_STOP_WITHIN_M: Final = 12.0
"""Largest distance in metres between a lane's end and its crossing."""

_TACTILE_BEHIND_M: Final = 0.25
"""Distance in metres between the curb and tactile paving."""

_LIFT_M: Final = 0.004
"""Height of paint above the ground in metres."""

_SEARCH_M: Final = 8.0
"""Distance in metres from a tile within which streets may have paint in it."""

_WALKABLE: Final = ("sidewalk", "ramp", "curb")
"""Kinds of ground that tactile paving covers."""


def tile_markings(street_map: StreetMap, tile: Tile) -> Mapping[str, Mesh]:
    """Return the paint of a tile by ground layer, 4 mm above the ground."""
    reach = grown_box(tile_bounds(tile.key), _SEARCH_M)
    lanes = [lane for lane in street_map.near("lane", reach) if isinstance(lane, Lane)]
    roads = [lane for lane in lanes if lane.kind == "road" and not lane.internal]
    strips = [strip for strip in street_map.near("strip", reach) if isinstance(strip, Strip)]
    crossings = [strip for strip in strips if strip.kind == "crossing"]
    lines = [quad for lane in roads for quad in _lane_lines(street_map, lane)]
    lines += [quad for lane in roads for quad in _stop_line(lane, crossings)]
    found = {"paint": _marking_mesh([np.asarray(quad) for quad in lines], tile)}
    found["tactile-domes"] = _tactile_mesh(street_map, crossings, tile)
    return {name: mesh for name, mesh in found.items() if len(mesh)}


def _lane_lines(street_map: StreetMap, lane: Lane) -> Iterator[Floats]:
    """Return quads (4, 2) along the inner side of a lane: a lane line or a centre line."""
    side = -1.0 if street_map.left_hand else 1.0
    edge, _, index = lane.id.rpartition("_")
    neighbour = street_map.lanes.get(f"{edge}_{int(index) + 1}") if index.isdecimal() else None
    if neighbour is not None and neighbour.kind == "road":
        dash = _DASH_M
    elif _is_adjacent(street_map, lane, side, f"-{edge}"):
        dash = _CENTRE_DASH_M
    else:
        return
    line = Polyline(lane.line)
    end_m = line.length_m - 1.0
    for start in np.arange(0.5, end_m, sum(dash)):
        stop = min(start + dash[0], end_m)
        count = max(math.ceil((stop - start) / _QUAD_MAX_M), 1)
        cuts = np.linspace(start, stop, count + 1)
        yield from _band(line, cuts, side * 0.5 * lane.width_m, LINE_M)


def _is_adjacent(street_map: StreetMap, lane: Lane, side: float, edge: str) -> bool:
    """Return whether lanes of another edge are adjacent, without a verge.

    side: 1 for left, -1 for right
    """
    line = Polyline(lane.line)
    x, y, heading = line.at(0.5 * line.length_m)
    aside = side * (0.5 * lane.width_m + 0.3)
    spot = shapely.Point(x - aside * math.sin(heading), y + aside * math.cos(heading))
    return any(
        isinstance(piece, Lane) and piece.edge == edge for piece in street_map.near("lane", spot)
    )


def _stop_line(lane: Lane, crossings: Sequence[Strip]) -> Iterator[Floats]:
    """Return the stop line of a lane that ends before a signalised crossing."""
    end = shapely.Point(lane.line[-1])
    for crossing in crossings:
        if (
            crossing.signalised
            and lane.edge in crossing.crosses
            and end.distance(crossing.polygon) < _STOP_WITHIN_M
        ):
            line = Polyline(lane.line)
            at_m = min(line.length_m, _crossing_at_m(line, crossing)) - _STOP_BEFORE_M
            if at_m > 1.0:
                yield from _band(
                    line, np.array([at_m - STOP_LINE_M, at_m]), 0.0, lane.width_m - 0.2
                )
            return


def _crossing_at_m(line: Polyline, crossing: Strip) -> float:
    """Return the arc length at which a line meets a crossing; infinite if it does not."""
    met = shapely.intersection(shapely.LineString(line.points), crossing.polygon)
    if shapely.is_empty(met):
        return math.inf
    along = shapely.line_locate_point(
        shapely.LineString(line.points), shapely.points(shapely.get_coordinates(met))
    )
    return float(np.min(along))


def _band(line: Polyline, cuts: Floats, aside_m: float, width_m: float) -> Iterator[Floats]:
    """Return quads (4, 2) between arc lengths, at an offset to the left of a line."""
    rows = []
    for s in cuts.tolist():
        x, y, heading = line.at(s)
        left = np.array([-math.sin(heading), math.cos(heading)])
        middle = np.array([x, y]) + aside_m * left
        rows.append((middle - 0.5 * width_m * left, middle + 0.5 * width_m * left))
    for (right0, left0), (right1, left1) in pairwise(rows):
        yield np.stack([right0, right1, left1, left0])


def _marking_mesh(quads: Sequence[Floats], tile: Tile) -> Mesh:
    """Return the mesh of quads (4, 2) whose centre is in the tile, on its ground."""
    own = [quad for quad in quads if tile_at(*quad.mean(axis=0).tolist()) == tile.key]
    if not own:
        return EMPTY
    xy = np.concatenate(own)
    first = 4 * np.arange(len(own))[:, None]
    triangles = np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])])
    return _on_ground(xy, triangles, tile)


def _on_ground(xy: Floats, triangles: NDArray[np.int64], tile: Tile) -> Mesh:
    """Return a mesh at the height of the ground."""
    up = np.tile([0.0, 0.0, 1.0], (len(xy), 1))
    return Mesh(
        np.column_stack([xy, tile.height(xy) + _LIFT_M]), up, np.asarray(triangles, dtype=np.int32)
    )


def _tactile_mesh(street_map: StreetMap, crossings: Sequence[Strip], tile: Tile) -> Mesh:
    """Return tactile paving at both ends of crossings, clipped to walkable ground of the tile."""
    border = shapely.box(*tile_bounds(tile.key))
    ends = [(line, one.width_m) for one in crossings for line in (one.line, one.line[::-1])]
    fields = [_tactile_area(street_map, Polyline(line), width_m) for line, width_m in ends]
    here = [field for field in fields if shapely.intersects(field, border)]
    if not here:
        return EMPTY
    walkable = join([mesh for name, mesh in tile.parts.items() if ground_kind(name) in _WALKABLE])
    return join([_drape(field, walkable) for field in here])


def _drape(field: shapely.Geometry, ground: Mesh) -> Mesh:
    """Return a field cut along the ground's triangles and lifted 4 mm above them."""
    faces = ground.vertices[ground.triangles]
    normal = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
    x0, y0, x1, y1 = shapely.bounds(field)
    low, high = faces[:, :, :2].min(axis=1), faces[:, :, :2].max(axis=1)
    near = (normal[:, 2] > 1e-9) & ((low < (x1, y1)) & (high > (x0, y0))).all(axis=1)
    faces, normal = faces[near], normal[near]
    pieces = shapely.intersection(shapely.polygons(faces[:, :, :2]), field)
    own = shapely.area(pieces) > 1e-6
    faces, normal = faces[own], normal[own]
    xy, of = triangulate_areas(pieces[own])
    slope = normal[of, None, :2] / normal[of, None, 2:]
    z = faces[of, :1, 2] - ((xy - faces[of, :1, :2]) * slope).sum(axis=2)
    vertices = np.concatenate([xy, z[..., None] + _LIFT_M], axis=2).reshape(-1, 3)
    return flat_shaded(vertices)


def _tactile_area(street_map: StreetMap, line: Polyline, width_m: float) -> shapely.Geometry:
    """Return the area of tactile paving beyond the end of a crossing's line."""
    x, y, heading = line.at(line.length_m)
    along = np.array([math.cos(heading), math.sin(heading)])
    left = 0.5 * (width_m - 0.3) * np.array([-along[1], along[0]])
    near = np.array([x, y]) + _TACTILE_BEHIND_M * along
    far = near + TACTILE_M * along
    field = shapely.Polygon([near - left, far - left, far + left, near + left])
    walkable = [corner.polygon for corner in street_map.near("corner", field)]
    walkable += [
        s.polygon
        for s in street_map.near("strip", field)
        if isinstance(s, Strip) and s.kind == "sidewalk"
    ]
    return (
        shapely.intersection(field, shapely.union_all(walkable)) if walkable else shapely.Polygon()
    )
