"""Ground cover off the streets, from the map's land use or from the neighbouring objects.

Cameras and top-down maps use this table. No cover resembles a sidewalk.
"""

from __future__ import annotations

import zlib
from collections import defaultdict
from collections.abc import Mapping
from typing import Final, NamedTuple, cast

import numpy as np
import shapely
from shapely.geometry import MultiPolygon, Polygon

from cosim.place import overlay
from cosim.place.street_map import LandKind, StreetMap, Strip, street_of

_NEAR_M: Final = 4.0
"""Distance to a house and a sidewalk within which the ground is a bed, in metres."""
_UNDER_HOUSE_M: Final = 0.6
"""Length by which beds reach under the houses of unmapped buildings, in metres. Their fronts are
straight where a street bends."""
_REACH_M: Final = 12.0
"""Margin around the area in which sidewalks and houses are considered, in metres."""
_MIN_PIECE_M2: Final = 1e-3
"""Area in m2 below which a piece is dropped."""


class GroundLook(NamedTuple):
    """Colours of a ground cover.

    seen: mean sRGB colour in pictures, 0 to 1.
    drawn: colour on top-down maps, 0 to 255.
    """

    seen: tuple[float, float, float]
    drawn: tuple[int, int, int]


GROUND_LOOKS: Final[Mapping[LandKind, GroundLook]] = {
    "lawn": GroundLook((0.33, 0.40, 0.21), (214, 226, 214)),
    "planting": GroundLook((0.24, 0.31, 0.17), (176, 203, 168)),
    "soil": GroundLook((0.30, 0.25, 0.20), (208, 193, 172)),
    "yard": GroundLook((0.33, 0.33, 0.34), (172, 174, 178)),
    "water": GroundLook((0.16, 0.28, 0.36), (170, 198, 222)),
}
"""Colours by ground cover."""
PLAIN_GROUND: Final[LandKind] = "lawn"
"""Cover where neither the map nor the neighbours determine one."""

_BEDS: Final[tuple[LandKind, ...]] = ("planting", "lawn", "soil")
"""Covers between sidewalks and houses; the street's name selects one."""


def open_ground(
    street_map: StreetMap, area: shapely.Polygon
) -> list[tuple[LandKind, Polygon | MultiPolygon]]:
    """Return the covers within `area`, as areas that do not overlap and reach under streets and
    houses.

    It is empty for a generated city, whose ground comes from `physics/street/covers.py`.
    """
    if street_map.planned:
        return []
    lands = [(cast(LandKind, land.kind), land.polygon) for land in street_map.land_near(area)]
    found: dict[LandKind, list[Polygon]] = defaultdict(list)
    taken: shapely.Geometry = Polygon()
    for kind, whole in (*lands, *_beds(street_map, area)):
        part = overlay.intersection(whole, area)
        rest = shapely.get_parts(overlay.difference(part, taken))
        found[kind] += [
            piece for piece in rest if isinstance(piece, Polygon) and piece.area > _MIN_PIECE_M2
        ]
        taken = overlay.union(taken, part)
    return [
        (kind, overlay.union_all(parts))
        for kind, parts in found.items()
        if kind != PLAIN_GROUND and parts
    ]


def beside(strip: Strip, near_m: float, far_m: float) -> shapely.Geometry:
    """Return the area between two distances from a sidewalk's middle, on the side away from the
    road."""
    line = shapely.LineString((strip.line if strip.road_side < 0 else strip.line[::-1])[:, :2])
    one, two = (
        shapely.buffer(line, d, cap_style="flat", join_style="mitre", single_sided=True)
        for d in (far_m, near_m)
    )
    return shapely.difference(one, two)


def _beds(street_map: StreetMap, area: shapely.Polygon) -> list[tuple[LandKind, shapely.Geometry]]:
    """Return the covers between sidewalks and houses."""
    x0, y0, x1, y1 = shapely.bounds(area).tolist()
    reach = shapely.box(x0 - _REACH_M, y0 - _REACH_M, x1 + _REACH_M, y1 + _REACH_M)
    outlines = np.array([house.polygon for house in street_map.houses_near(reach)], dtype=object)
    houses = shapely.buffer(overlay.union_all(outlines), _NEAR_M, quad_segs=2)
    shapely.prepare(houses)
    found: dict[LandKind, list[shapely.Geometry]] = {kind: [] for kind in _BEDS}
    for strip in street_map.near("strip", reach):
        if not isinstance(strip, Strip) or strip.kind != "sidewalk":
            continue
        bed = _BEDS[zlib.crc32(street_of(strip.id).encode()) % len(_BEDS)]
        edge = 0.5 * strip.width_m
        line = shapely.LineString(strip.line[:, :2])
        if shapely.intersects(houses, line):
            around = shapely.buffer(line, edge + _NEAR_M, cap_style="flat", join_style="mitre")
            found[bed].append(overlay.intersection(around, houses))
        elif strip.road_side != 0 and strip.frontage_m > 0.0:
            found[bed].append(beside(strip, edge, edge + strip.frontage_m + _UNDER_HOUSE_M))
    return [(kind, overlay.union_all(parts)) for kind, parts in found.items() if parts]
