"""Buildings and props that a map shows, by tile.

No objects of the same kind are generated near them (see `MappedObjects.shows`).
"""

from __future__ import annotations

import math
import zlib
from collections import defaultdict
from collections.abc import Sequence
from typing import Final

import numpy as np
import shapely
from shapely.geometry import Polygon

from cosim.place import overlay
from cosim.place.street_map import LAND_KINDS, Feature, StreetMap
from cosim.place.terrain import Terrain
from physics.ground.tiles import Key, tile_at, tile_bounds
from physics.street.buildings import FACADES, Building, Wall
from physics.street.furniture import KINDS, PROP_VARIANTS, Prop

BUILDING_EXCLUSION_M: Final = 30.0
"""Distance in metres from mapped buildings within which none are generated."""

PROP_EXCLUSION_M: Final = 40.0
"""Distance in metres from mapped props within which none of the same kind are generated."""
_MIN_PART_M2: Final = 0.05
"""Area in square metres below which a part of a building in a tile is dropped."""


class MappedObjects:
    """Buildings and props of a map; a pure function of the map.

    kinds: kinds of the mapped props
    """

    def __init__(self, street_map: StreetMap) -> None:
        by_kind: dict[str, list[Feature]] = defaultdict(list)
        for feature in street_map.features:
            if feature.kind not in LAND_KINDS:
                by_kind[feature.kind].append(feature)
        self._buildings = by_kind.pop("building", [])
        self._floors_m = [
            _floor_m(building.polygon, street_map.terrain) for building in self._buildings
        ]
        self._building_tree = shapely.STRtree([building.polygon for building in self._buildings])
        self._trees = {
            kind: shapely.STRtree([shapely.Point(f.x_m, f.y_m) for f in features])
            for kind, features in by_kind.items()
        }
        self._trees["building"] = self._building_tree
        self.kinds = frozenset(by_kind)
        self._props: dict[Key, list[Prop]] = defaultdict(list)
        for i, feature in enumerate(
            f for f in street_map.features if f.kind not in ("building", *LAND_KINDS)
        ):
            self._props[tile_at(feature.x_m, feature.y_m)].append(_prop(i, feature))

    @property
    def all_props(self) -> tuple[Prop, ...]:
        """Props of all tiles."""
        return tuple(prop for props in self._props.values() for prop in props)

    def props(self, key: Key) -> Sequence[Prop]:
        """Return the props whose centre lies in a tile."""
        return self._props.get(key, ())

    def buildings(self, key: Key) -> tuple[Building, ...]:
        """Return the parts of buildings in a tile, each as a building."""
        tile = shapely.box(*tile_bounds(key))
        found = []
        for i in np.sort(self._building_tree.query(tile, predicate="intersects")).tolist():
            parts = shapely.get_parts(overlay.intersection(self._buildings[i].polygon, tile))
            solid = [p for p in parts if isinstance(p, Polygon) and p.area > _MIN_PART_M2]
            found += [_building(i, self._buildings[i], part, self._floors_m[i]) for part in solid]
        return tuple(found)

    def shows(self, kind: str, place: shapely.Geometry) -> bool:
        """Return whether the map shows objects of a kind near a place."""
        tree = self._trees.get(kind)
        reach = BUILDING_EXCLUSION_M if kind == "building" else PROP_EXCLUSION_M
        return tree is not None and bool(
            len(tree.query(place, predicate="dwithin", distance=reach))
        )


def _prop(number: int, feature: Feature) -> Prop:
    """Convert a feature to a prop.

    The size is the nearest to the mapped height; without a height it is random by number. The paint
    is random by number.
    """
    kind = KINDS[feature.kind]
    random_number = zlib.crc32(f"{feature.kind}:{number}".encode())
    variant = random_number % PROP_VARIANTS
    if feature.height_m > 0.0:
        variant = min(range(PROP_VARIANTS), key=lambda v: abs(kind.size_m(v)[2] - feature.height_m))
    paint = random_number // PROP_VARIANTS % len(kind.paints)
    turned_rad = number % 7 * 0.9 if kind.grown else 0.0
    return Prop(
        f"prop:map:{number}",
        feature.kind,
        variant,
        feature.x_m,
        feature.y_m,
        feature.heading_rad,
        paint,
        turned_rad,
    )


def _floor_m(whole: Polygon, terrain: Terrain | None) -> float:
    """Return a building's floor height: the mean height of the land around it."""
    if terrain is None:
        return 0.0
    return float(
        terrain.height(shapely.get_coordinates(shapely.segmentize(whole.exterior, 1.0))).mean()
    )


def _building(number: int, building: Feature, part: Polygon, floor_m: float) -> Building:
    """Return a part of a mapped building as a building.

    It has the whole building's name and appearance. Its box is the bounding box along the street.
    """
    part = shapely.orient_polygons(part)
    cos, sin = math.cos(building.heading_rad), math.sin(building.heading_rad)
    turn = np.array([[cos, -sin], [sin, cos]])
    corners = shapely.get_coordinates(part) @ turn
    low, high = corners.min(axis=0), corners.max(axis=0)
    x, y = (turn @ (0.5 * (low + high))).tolist()
    length, deep = (high - low).tolist()
    return Building(
        id=f"building:map:{number}",
        x_m=x,
        y_m=y,
        heading_rad=building.heading_rad,
        size_m=(length, deep, building.height_m),
        facade=zlib.crc32(f"{number}:{building.x_m:.2f}".encode()) % len(FACADES),
        outline=part,
        walls=_walls(part, building.polygon),
        floor_m=floor_m,
        base_m=floor_m,
    )


def _walls(part: Polygon, whole: Polygon) -> tuple[Wall, ...]:
    """Return the sides of a part that belong to the whole building, without tile cuts."""
    sides = []
    for ring in (part.exterior, *part.interiors):
        xy = shapely.get_coordinates(ring)
        sides += list(zip(xy[:-1].tolist(), xy[1:].tolist(), strict=True))
    middles = shapely.points(np.array(sides).mean(axis=1))
    outer = shapely.dwithin(middles, whole.boundary, 1e-3)
    return tuple(
        (*a, *b) for (a, b), is_wall in zip(sides, outer, strict=True) if is_wall and a != b
    )
