"""What lies between sidewalks and houses in generated cities: paved before shops, gardens before
homes, driveways.

It is laid over the ground, a few millimetres thick: it changes colours, not labels or friction.
Nobody walks there.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping
from typing import Final, NamedTuple

import numpy as np
import shapely

from cosim.core.geometry import Polyline
from cosim.place.open_ground import beside
from cosim.place.street_map import StreetMap, Strip, street_of
from physics.ground.mesh import Mesh
from physics.ground.tiles import DRIVEWAY_M, Tile, square
from physics.street.covers import laid_over
from physics.street.placement import street_style
from physics.textures.layers import Colour

_REACH_M: Final = 12.0
_UNDER_M: Final = 0.6
"""So far it reaches under the houses, whose fronts are straight where a street bends."""
_DEEPEST_M: Final = 6.0
_YARD_M: Final = 3.0
"""Depth of the paved yards between the houses of a street that is paved."""
_BED_M: Final = (0.45, 0.8)
"""Width of the beds at the feet of houses with gardens."""


class Cover(NamedTuple):
    """A layer of ground (physics.textures.ground) and its colour; None is the layer's own."""

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
"""What the frontage of a class of streets may be paved with; other classes have gardens."""
_WAYS: Final = (
    Cover("concrete-cast", None),
    Cover("pavers-herringbone", (0.56, 0.52, 0.49)),
    Cover("gravel", None),
)
_BEDS: Final = Cover("earth", None)


class Laid(NamedTuple):
    """A part of a tile's ground that has a cover."""

    mesh: Mesh
    cover: Cover


def frontage_in(street_map: StreetMap, tile: Tile, seed: int) -> list[Laid]:
    """What lies on the open ground of a tile of a generated city, a few millimetres above it;
    nothing on other maps."""
    if not street_map.planned or "ground" not in tile.parts:
        return []
    x0, y0, x1, y1 = square(tile.key)
    reach = shapely.box(x0 - _REACH_M, y0 - _REACH_M, x1 + _REACH_M, y1 + _REACH_M)
    strips = [s for s in street_map.near("strip", reach) if isinstance(s, Strip)]
    areas: dict[Cover, list[shapely.Geometry]] = {}
    for strip in strips:
        if strip.kind == "sidewalk":
            for cover, area in _of(strip, seed):
                areas.setdefault(cover, []).append(area)
    triangles = tile.parts["ground"]
    found: list[Laid] = []
    taken: shapely.Geometry = shapely.Polygon()
    for cover in sorted(
        areas, key=lambda cover: (cover not in _WAYS, cover.layer, cover.colour or ())
    ):
        area = shapely.union_all(areas[cover])
        found.append(Laid(laid_over(triangles, shapely.difference(area, taken)), cover))
        taken = shapely.union(taken, area)
    return [laid for laid in found if len(laid.mesh)]


def paved(strip: Strip) -> bool:
    """Whether what lies before the houses of a sidewalk's street is paved; else there are
    gardens."""
    return street_style(strip.street_class) in _COVERS


def _of(strip: Strip, seed: int) -> list[tuple[Cover, shapely.Geometry]]:
    """The frontage of a sidewalk and its driveways."""
    rng = np.random.default_rng([seed, zlib.crc32(strip.id.encode()), 0xF207])
    edge = 0.5 * strip.width_m
    depth = min(strip.frontage_m, _DEEPEST_M)
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
        found.append((_BEDS, beside(strip, edge + depth - width, edge + depth + _UNDER_M)))
    way = _WAYS[int(of_street.integers(len(_WAYS)))]
    middle = Polyline(strip.line)
    for at_m in strip.driveways:
        x, y, heading = middle.at(at_m)
        aside = -strip.road_side * np.array([-math.sin(heading), math.cos(heading)])
        along = 0.5 * DRIVEWAY_M * np.array([math.cos(heading), math.sin(heading)])
        near, far = (np.array([x, y]) + d * aside for d in (edge - 0.05, edge + depth + _YARD_M))
        found.append((way, shapely.Polygon([near - along, near + along, far + along, far - along])))
    return found
