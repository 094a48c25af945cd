"""Pictures on roads and sidewalks: covers, drains, cracks, repairs, stains, litter, grass edges.

They change only colours. Each lies flat within one kind of ground and belongs to the tile of its
centre. Places depend on the seed and on the name of a lane or sidewalk.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np

from cosim.core.geometry import Floats, Polyline
from cosim.place.street_map import Lane, StreetMap, Strip
from physics.ground.mesh import Mesh
from physics.ground.tiles import Tile, grown_box, tile_bounds, tile_indices
from physics.street.covers import has_paved_frontage
from physics.textures.decals import DECALS

_LIFT_M: Final = 0.004
"""Height above the ground in metres."""
_SEARCH_M: Final = 8.0
"""Distance in metres from a tile within which streets may have pictures in it."""
_ENDS_M: Final = 2.5
"""Length without pictures at both ends of a lane or sidewalk in metres."""
_MARGIN_M: Final = 0.25
"""Distance in metres of pictures from the edges of a lane or sidewalk."""
_DRAIN_M: Final = (18.0, 0.45)
"""Spacing of drains along a curb, and distance from the lane's edge, in metres."""
_TUFT_OVER_M: Final = 0.22
"""Length in metres of grass over paving."""


class _Sort(NamedTuple):
    """A kind of picture.

    layer: name in `physics.textures.decals`
    every_m: mean distance between two, along a lane or sidewalk
    scale: smallest and largest size, as multiples of the layer's
    opacity: smallest and largest
    """

    layer: str
    every_m: float
    scale: tuple[float, float]
    opacity: tuple[float, float] = (1.0, 1.0)


_ON_ROADS: Final = (
    _Sort("decal-repair", 19.0, (0.5, 1.15), (0.7, 1.0)),
    _Sort("decal-dust", 20.0, (0.5, 0.9), (0.3, 0.8)),
    _Sort("decal-crack", 10.0, (0.5, 0.95), (0.6, 1.0)),
    _Sort("decal-stain", 12.0, (0.5, 1.2), (0.4, 0.9)),
    _Sort("decal-cover", 26.0, (0.95, 1.05)),
)
_ON_SIDEWALKS: Final = (
    _Sort("decal-dust", 20.0, (0.3, 0.5), (0.3, 0.9)),
    _Sort("decal-stain", 11.0, (0.3, 0.7), (0.25, 0.7)),
    _Sort("decal-crack", 16.0, (0.3, 0.6), (0.5, 0.9)),
    _Sort("decal-gum", 9.0, (0.45, 0.7), (0.5, 1.0)),
    _Sort("decal-leaves", 11.0, (0.5, 0.9)),
    _Sort("decal-litter", 21.0, (0.6, 1.0)),
    _Sort("decal-lid", 30.0, (0.7, 1.1)),
)
"""Pictures by kind of ground, from the lowest to the highest."""


class Decals(NamedTuple):
    """Pictures of one layer.

    mesh: four corners for each
    spots: (V, 2) texture coordinates from 0 to 1
    opacity: (V,) from 0 to 1
    """

    layer: str
    mesh: Mesh
    spots: Floats
    opacity: Floats


class _Quad(NamedTuple):
    """A picture: its corners (4, 2) from the lower left, counter-clockwise, and its opacity."""

    layer: str
    corners: Floats
    opacity: float


def tile_decals(street_map: StreetMap, tile: Tile, seed: int) -> tuple[Decals, ...]:
    """Return the pictures on the ground of a tile by layer, in drawing order."""
    reach = grown_box(tile_bounds(tile.key), _SEARCH_M)
    quads: list[_Quad] = []
    for lane in street_map.near("lane", reach):
        if isinstance(lane, Lane) and lane.kind == "road" and not lane.internal:
            rng = np.random.default_rng([seed, zlib.crc32(lane.id.encode()), 0xDECA])
            quads += _scattered(lane.line, lane.width_m, _ON_ROADS, rng)
            quads += _drains(street_map, lane)
    for strip in street_map.near("strip", reach):
        if isinstance(strip, Strip) and strip.kind == "sidewalk" and strip.going == "plain":
            rng = np.random.default_rng([seed, zlib.crc32(strip.id.encode()), 0xDECA])
            quads += _scattered(strip.line, strip.width_m, _ON_SIDEWALKS, rng)
            quads += _grass_edges(strip) if street_map.planned else ()
    if not quads:
        return ()
    middles = np.array([quad.corners.mean(axis=0) for quad in quads])
    own = (tile_indices(middles) == tile.key).all(axis=1)
    by_layer: dict[str, list[_Quad]] = {}
    for quad, here in zip(quads, own.tolist(), strict=True):
        if here:
            by_layer.setdefault(quad.layer, []).append(quad)
    return tuple(_laid(name, by_layer[name], tile) for name in _ORDER if name in by_layer)


_ORDER: Final = tuple(
    dict.fromkeys(
        [
            *(sort.layer for sort in (*_ON_ROADS, *_ON_SIDEWALKS)),
            "decal-tufts",
            "decal-drain",
        ]
    )
)


def _laid(layer: str, quads: Sequence[_Quad], tile: Tile) -> Decals:
    """Return quads at the height of the ground."""
    xy = np.concatenate([quad.corners for quad in quads])
    first = 4 * np.arange(len(quads))[:, None]
    triangles = np.concatenate([first + np.array((0, 1, 2)), first + np.array((0, 2, 3))]).astype(
        np.int32
    )
    up = np.tile([0.0, 0.0, 1.0], (len(xy), 1))
    mesh = Mesh(np.column_stack([xy, tile.height(xy) + _LIFT_M]), up, triangles)
    corner = np.array([(0.0, 1.0), (1.0, 1.0), (1.0, 0.0), (0.0, 0.0)])
    opacity = np.repeat([quad.opacity for quad in quads], 4)
    return Decals(layer, mesh, np.tile(corner, (len(quads), 1)), opacity)


def _scattered(
    points: Floats, width_m: float, sorts: Sequence[_Sort], rng: np.random.Generator
) -> Iterator[_Quad]:
    """Yield pictures at random places of a lane or sidewalk."""
    line = Polyline(points[:, :2])
    for sort in sorts:
        count = int(rng.poisson(max(line.length_m - 2.0 * _ENDS_M, 0.0) / sort.every_m))
        at_m = rng.uniform(_ENDS_M, max(line.length_m - _ENDS_M, _ENDS_M), count)
        aside = rng.uniform(-1.0, 1.0, count)
        scale, opacity = rng.uniform(*sort.scale, count), rng.uniform(*sort.opacity, count)
        stretch = rng.uniform(0.8, 1.8, count) if sort.layer == "decal-repair" else np.ones(count)
        turn = rng.integers(0, 4, count) * 0.5 * np.pi
        long_m, wide_m = np.broadcast_to(DECALS[sort.layer].metres, 2)
        for k in range(count):
            half = 0.5 * scale[k] * np.array([long_m * stretch[k], wide_m])
            room_m = 0.5 * width_m - _MARGIN_M - float(half.max())
            if room_m > 0.0:
                place = line.at(float(at_m[k]))
                corners = _rectangle(place, room_m * float(aside[k]), half, float(turn[k]))
                yield _Quad(sort.layer, corners, float(opacity[k]))


def _rectangle(
    place: tuple[float, float, float], aside_m: float, half: Floats, turn_rad: float = 0.0
) -> Floats:
    """Return the corners (4, 2) of a rectangle left of a point of a line.

    half: half length and half width in metres
    turn_rad: rotation of the picture relative to the line
    """
    x, y, heading = place
    middle = np.array([x - aside_m * np.sin(heading), y + aside_m * np.cos(heading)])
    way = heading + turn_rad
    along, left = np.array([np.cos(way), np.sin(way)]), np.array([-np.sin(way), np.cos(way)])
    signs = np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
    return np.asarray(middle + signs[:, :1] * half[0] * along + signs[:, 1:] * half[1] * left)


def _drains(street_map: StreetMap, lane: Lane) -> Iterator[_Quad]:
    """Yield drains along the curb of a lane that has one."""
    edge, _, index = lane.id.rpartition("_")
    outer = street_map.lanes.get(f"{edge}_{int(index) - 1}") if index.isdecimal() else None
    if outer is not None and outer.kind == "road":
        return
    line = Polyline(lane.line[:, :2])
    side = 1.0 if street_map.left_hand else -1.0
    aside_m = side * (0.5 * lane.width_m - _DRAIN_M[1])
    half = 0.5 * np.broadcast_to(DECALS["decal-drain"].metres, 2)
    for at_m in np.arange(0.5 * _DRAIN_M[0], line.length_m - _ENDS_M, _DRAIN_M[0]).tolist():
        yield _Quad("decal-drain", _rectangle(line.at(at_m), aside_m, half), 1.0)


def _grass_edges(strip: Strip) -> Iterator[_Quad]:
    """Yield grass over the edges of a sidewalk that borders on a verge or gardens."""
    sides = []
    if strip.verge_m > 0.3 and strip.road_side:
        sides.append(float(strip.road_side))
    if strip.frontage_m > 0.5 and strip.road_side and not has_paved_frontage(strip):
        sides.append(-float(strip.road_side))
    line = Polyline(strip.line[:, :2])
    long_m, wide_m = np.broadcast_to(DECALS["decal-tufts"].metres, 2).tolist()
    count = int((line.length_m - 2.0 * _ENDS_M) / long_m)
    for side in sides:
        aside_m = side * (0.5 * strip.width_m + 0.5 * wide_m - _TUFT_OVER_M)
        for k in range(count):
            place = line.at(_ENDS_M + (k + 0.5) * long_m)
            # The picture's dense side lies away from the paving.
            half = 0.5 * np.array([1.02 * long_m, wide_m])
            turn = 0.0 if side > 0.0 else np.pi
            yield _Quad("decal-tufts", _rectangle(place, aside_m, half, turn), 1.0)
