"""Generated buildings along sidewalks, and meshes of all buildings.

Each sidewalk generates its own row from the map and a seed. A building belongs to the tile of its
centre, so tiles do not depend on the order in which they are built.
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass, replace
from typing import Final, Protocol

import numpy as np
import shapely
from numpy.typing import NDArray

from cosim.core.geometry import Polyline
from cosim.place.street_map import Lane, PieceKind, StreetMap, Strip
from cosim.place.terrain import Terrain
from physics.ground.mesh import Mesh, box, flat_shaded, join, quads, triangulate_areas
from physics.ground.tiles import CURB_M, Key, grown_box, tile_at, tile_bounds

_MARGIN_M: Final = 0.2
"""Smallest distance in metres between a building and walkable or drivable ground."""

_SEARCH_M: Final = 40.0
"""Distance in metres from a tile within which sidewalks may place buildings in it."""

_STOREY_M: Final = 3.2
"""Height of a storey in metres."""

_LOT_M: Final = (9.0, 20.0)
"""Smallest and largest length of a lot along the street in metres."""

_DEPTH_M: Final = (8.0, 14.0)
"""Smallest and largest depth of a building in metres."""

_HEIGHT_M: Final = (6.0, 25.0)
"""Smallest and largest height of a building in metres."""

_WINDOW_WALL_M: Final = 4.0
"""Smallest length in metres of a mapped wall with windows."""

FACADES: Final = (
    (0.71, 0.45, 0.36),
    (0.82, 0.74, 0.60),
    (0.60, 0.62, 0.66),
    (0.76, 0.66, 0.52),
    (0.55, 0.38, 0.33),
    (0.84, 0.82, 0.78),
)
"""sRGB colours of facades."""

WINDOW_COLOUR: Final = (0.23, 0.27, 0.33)
"""sRGB colour of windows and doors."""


Wall = tuple[float, float, float, float]
"""x0, y0, x1, y1 of a wall on the ground in metres, with the outside on its right."""


@dataclass(frozen=True, slots=True)
class Building:
    """A box-shaped or mapped building on high ground.

    size_m: along the street, away from it, and height
    heading_rad: along the sidewalk, with the street on the right
    facade: index in FACADES
    outline, walls: ground plan of a mapped building; the box is its bounding box
    floor_m: height of the land at the front
    base_m: lowest height of the land under the building
    """

    id: str
    x_m: float
    y_m: float
    heading_rad: float
    size_m: tuple[float, float, float]
    facade: int
    outline: shapely.Polygon | None = None
    walls: tuple[Wall, ...] = ()
    floor_m: float = 0.0
    base_m: float = 0.0

    @property
    def polygon(self) -> shapely.Polygon:
        """Outline on the ground."""
        if self.outline is not None:
            return self.outline
        along = (
            0.5
            * self.size_m[0]
            * np.array([math.cos(self.heading_rad), math.sin(self.heading_rad)])
        )
        away = (
            0.5
            * self.size_m[1]
            * np.array([-math.sin(self.heading_rad), math.cos(self.heading_rad)])
        )
        middle = np.array([self.x_m, self.y_m])
        return shapely.Polygon(
            middle + np.array([along + away, away - along, -along - away, along - away])
        )


class _Mapped(Protocol):
    """Buildings that a map shows."""

    def buildings(self, key: Key) -> tuple[Building, ...]:
        """Return the mapped buildings, or parts of them, in a tile."""

    def shows(self, kind: str, place: shapely.Geometry) -> bool:
        """Return whether the map shows objects of a kind near a place."""


class BuildingRows:
    """Generator of a map's buildings.

    mapped: mapped buildings, near which none are generated; None without them

    `in_tile` is a pure function of the map, the seed and the tile. Rows are cached.
    """

    def __init__(self, street_map: StreetMap, seed: int, mapped: _Mapped | None = None) -> None:
        self._map = street_map
        self._seed = seed
        self._mapped = mapped
        self._rows: dict[str, tuple[Building, ...]] = {}

    def in_tile(self, key: Key) -> tuple[Building, ...]:
        """Return the buildings whose centre lies in a tile, in map order."""
        reach = grown_box(tile_bounds(key), _SEARCH_M)
        found = [] if self._mapped is None else list(self._mapped.buildings(key))
        for strip in self._map.near("strip", reach):
            if isinstance(strip, Strip) and strip.kind == "sidewalk" and strip.road_side != 0:
                if strip.id not in self._rows:
                    self._rows[strip.id] = self._generate_row(strip)
                found += [b for b in self._rows[strip.id] if tile_at(b.x_m, b.y_m) == key]
        return tuple(found)

    def _generate_row(self, strip: Strip) -> tuple[Building, ...]:
        """Return the generated buildings along a sidewalk."""
        rng = np.random.default_rng([self._seed, zlib.crc32(strip.id.encode())])
        line = Polyline(strip.line if strip.road_side < 0 else strip.line[::-1])
        row = []
        at_m = float(rng.uniform(0.0, 2.0))
        n = 0
        while line.length_m - at_m > 4.0:
            lot = min(float(rng.uniform(*_LOT_M)), line.length_m - at_m)
            depth, height = float(rng.uniform(*_DEPTH_M)), float(rng.uniform(*_HEIGHT_M))
            facade = int(rng.integers(len(FACADES)))
            gap = float(rng.choice([0.0, 0.0, 3.0]))
            building = self._fit_building(strip, line, at_m, lot, (depth, height, facade), n)
            if building is not None:
                row.append(building)
            at_m += lot + gap
            n += 1
        return tuple(row)

    def _fit_building(
        self,
        strip: Strip,
        line: Polyline,
        at_m: float,
        lot_m: float,
        shape: tuple[float, float, int],
        n: int,
    ) -> Building | None:
        """Return the building of a lot, shrunk until it is clear of streets; None if none fits.

        at_m, lot_m: start and length of the lot along the line
        shape: depth and height in metres, and facade index
        n: number of the building along the sidewalk
        """
        depth, height, facade = shape
        for share_along, share_deep in ((1.0, 1.0), (1.0, 0.6), (0.7, 0.8), (0.5, 0.5)):
            start = line.at(at_m)
            end = line.at(at_m + lot_m * share_along)
            chord = end.xy - start.xy
            width = float(np.hypot(*chord))
            deep = depth * share_deep
            if width < 3.0:
                continue
            left = np.array([-chord[1], chord[0]]) / width
            sagitta = float(
                np.max(
                    (line.points - start.xy) @ left, initial=0.0, where=_between(line, at_m, lot_m)
                )
            )
            away = sagitta + 0.5 * strip.width_m + strip.frontage_m + 0.5 * deep
            x, y = 0.5 * (start.xy + end.xy) + away * left
            heading = math.atan2(chord[1], chord[0])
            built = Building(
                f"building:{strip.id}:{n}",
                float(x),
                float(y),
                heading,
                (width, deep, height),
                facade,
            )
            if self._is_clear(built):
                return built
        return None

    def _is_clear(self, building: Building) -> bool:
        """Return whether a building overlaps neither streets nor mapped buildings."""
        outline = building.polygon
        if self._mapped is not None and self._mapped.shows("building", outline):
            return False
        area = shapely.buffer(outline, _MARGIN_M, join_style="mitre")
        kinds: tuple[PieceKind, ...] = ("strip", "corner", "junction", "lane")
        return not any(p for kind in kinds for p in self._map.near(kind, area) if not _is_verge(p))


def _is_verge(piece: object) -> bool:
    return isinstance(piece, Lane) and piece.kind == "verge"


def _between(line: Polyline, at_m: float, lot_m: float) -> NDArray[np.bool_]:
    inside: NDArray[np.bool_] = (line.s_m >= at_m) & (line.s_m <= at_m + lot_m)
    return inside


def with_foundation(building: Building, terrain: Terrain) -> Building:
    """Return the building with its floor and base set to the terrain.

    The floor of a generated building is level with the land at its front. A mapped building keeps
    its floor, because it may be a part of a larger one. The base is the lowest land around the
    outline.
    """
    around = shapely.get_coordinates(shapely.segmentize(building.polygon.exterior, 1.0))
    lowest = float(terrain.height(around).min())
    if building.outline is not None:
        return replace(building, base_m=min(building.floor_m, lowest))
    away = 0.5 * building.size_m[1]
    front = (
        building.x_m + away * math.sin(building.heading_rad),
        building.y_m - away * math.cos(building.heading_rad),
    )
    floor = float(terrain.height([front])[0])
    return replace(building, floor_m=floor, base_m=min(floor, lowest))


def facade_meshes(buildings: tuple[Building, ...]) -> dict[int, Mesh]:
    """Return walls and roofs by facade index; index -1 holds windows and doors."""
    walls: dict[int, list[Mesh]] = {}
    for b in buildings:
        if b.outline is not None:
            walls.setdefault(b.facade, []).append(_mapped_walls(b, b.outline))
            walls.setdefault(-1, []).append(_mapped_windows(b))
        else:
            width, deep, height = b.size_m
            body = box((width, deep, height), (0.0, 0.0, 0.5 * height), skip=("bottom",))
            at = (b.x_m, b.y_m, b.floor_m + CURB_M)
            walls.setdefault(b.facade, []).append(body.moved(at, b.heading_rad))
            walls.setdefault(-1, []).append(_openings(b).moved(at, b.heading_rad))
        if b.base_m < b.floor_m:
            walls[b.facade].append(_base(b))
    return {facade: join(meshes) for facade, meshes in sorted(walls.items())}


def _mapped_walls(building: Building, outline: shapely.Polygon) -> Mesh:
    """Build walls and the flat roof of a mapped building."""
    x0, y0, x1, y1 = np.array(building.walls).reshape(-1, 4).T
    ground = building.floor_m + CURB_M
    roof_m = building.floor_m + CURB_M + building.size_m[2]
    low, high = np.full(len(x0), ground), np.full(len(x0), roof_m)
    at = [
        np.column_stack(corner)
        for corner in ((x0, y0, low), (x1, y1, low), (x1, y1, high), (x0, y0, high))
    ]
    roof, _ = triangulate_areas([outline])
    top = np.column_stack([roof.reshape(-1, 2), np.full(3 * len(roof), roof_m)])
    return join([quads(np.stack(at, axis=1)), flat_shaded(top)])


def _mapped_windows(building: Building) -> Mesh:
    """Build windows and doors in the walls of a mapped building that are long enough."""
    found = []
    for x0, y0, x1, y1 in building.walls:
        length, heading = math.hypot(x1 - x0, y1 - y0), math.atan2(y1 - y0, x1 - x0)
        if length >= _WINDOW_WALL_M:
            wall = Building("", 0.0, 0.0, 0.0, (length, 0.0, building.size_m[2]), 0)
            found.append(
                _openings(wall).moved(
                    (0.5 * (x0 + x1), 0.5 * (y0 + y1), building.floor_m + CURB_M), heading
                )
            )
    return join(found)


def _base(building: Building) -> Mesh:
    """Build blank walls from the floor down to the lowest land."""
    if building.outline is not None:
        a, b = np.array(building.walls).reshape(-1, 2, 2).transpose(1, 0, 2)
    else:
        ring = shapely.get_coordinates(shapely.orient_polygons(building.polygon).exterior)
        a = ring[:-1]
        b = ring[1:]
    low = np.full(len(a), building.base_m)
    high = np.full(len(a), building.floor_m + CURB_M)
    at = [np.column_stack(corner) for corner in ((a, low), (b, low), (b, high), (a, high))]
    return quads(np.stack(at, axis=1))


def _openings(building: Building) -> Mesh:
    """Build a row of windows per storey on the street side; the lowest row has a door."""
    width, deep, height = building.size_m
    y = -0.5 * deep - 0.03
    half = 0.5 * width - 0.7
    door = 0.6
    panes = [(-half, -door - 0.5, 0.9, 2.4), (-door, door, 0.0, 2.3), (door + 0.5, half, 0.9, 2.4)]
    storeys = int((height - 0.5) / _STOREY_M)
    panes += [
        (-half, half, k * _STOREY_M + 0.9, k * _STOREY_M + 2.3) for k in range(1, min(storeys, 4))
    ]
    corners = [
        [(x0, y, z0), (x1, y, z0), (x1, y, z1), (x0, y, z1)] for x0, x1, z0, z1 in panes if x1 > x0
    ]
    return quads(np.array(corners))
