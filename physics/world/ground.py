"""The place as the engines ask for it: tiles, buildings and props by key, heights by point; built when first needed."""

from __future__ import annotations

import math
from collections import OrderedDict
from typing import Final

import numpy as np
import shapely
from numpy.typing import ArrayLike

from cosim.core.errors import UsageError
from cosim.core.geometry import Floats, Pose
from cosim.place.street_map import StreetMap
from physics.robots import RobotModel
from physics.street.buildings import Building, Frontage, on_land
from physics.street.furniture import Prop
from physics.street.mapped import MappedThings
from physics.street.placement import Placement
from physics.world.materials import Paving
from physics.world.tiles import Key, Tile, build_tile, cells_of, key_at, square

_KEPT: Final = 100
_WHEELS: Final = np.array([0.32, 0.4])
"""Where a vehicle's wheels are, as shares of its length and width from its middle."""


class Ground:
    """Tiles, buildings and props of a street map under a seed; the least recently used tiles are forgotten.

    roughness: of the ground, from 0 (flat) to 1.
    """

    def __init__(self, street_map: StreetMap, seed: int, roughness: float = 0.0) -> None:
        if not 0.0 <= roughness <= 1.0:
            raise UsageError(f"roughness is {roughness:g}, but it lies between 0 (flat) and 1")
        self.street_map = street_map
        self.seed = seed
        self.roughness = roughness
        self.mapped = mapped = MappedThings(street_map)
        self._frontage = Frontage(street_map, seed, mapped)
        self._paving = Paving(street_map, seed)
        self._placement = Placement(street_map, seed, self._frontage, mapped)
        self._tiles: OrderedDict[Key, Tile] = OrderedDict()
        self._leant: tuple[Pose, RobotModel, tuple[float, float, float]] | None = None

    def tile(self, key: Key) -> Tile:
        if key not in self._tiles:
            roots = self._trees(key) if self.roughness > 0.0 else []
            self._tiles[key] = build_tile(self.street_map, key, self._paving, self.roughness, self.seed, roots)
            if len(self._tiles) > _KEPT:
                self._tiles.popitem(last=False)
        self._tiles.move_to_end(key)
        return self._tiles[key]

    def buildings(self, key: Key) -> tuple[Building, ...]:
        """Buildings whose centre lies in the tile, on their land."""
        buildings, terrain = self._frontage.in_tile(key), self.street_map.terrain
        return buildings if terrain is None else tuple(on_land(b, terrain) for b in buildings)

    def props(self, key: Key) -> tuple[tuple[Prop, float], ...]:
        """Props whose middle lies in the tile, each with the height of its foot in metres."""
        props = self._placement.in_tile(key)
        heights = self.tile(key).height([(prop.x_m, prop.y_m) for prop in props])
        if self.street_map.terrain is not None and props:
            sizes = np.array([prop.size_m[:2] for prop in props])
            heights = heights - self._fall([(p.x_m, p.y_m) for p in props], [p.heading_rad for p in props], sizes)
        return tuple(zip(props, heights.tolist(), strict=True))

    def foot(self, x_m: float, y_m: float, heading_rad: float, size_m: tuple[float, float]) -> float:
        """Height of the foot of a level thing of some length (along its heading) and width: nothing of it floats."""
        height = float(self.heights([[x_m, y_m]])[0])
        if self.street_map.terrain is None:
            return height
        return height - float(self._fall([(x_m, y_m)], [heading_rad], [size_m])[0])

    def road(self, xy: ArrayLike, heading_rad: ArrayLike, size_m: ArrayLike) -> Floats:
        """(N, 3) height, roll and pitch of N vehicles at (N, 2) points, (N, 2) long and wide, on their wheels."""
        size = np.asarray(size_m, dtype=float).reshape(-1, 2)
        land = self._land_around(xy, heading_rad, _WHEELS * size)
        if land is None:
            return np.zeros((len(size), 3))
        front_left, front_right, rear_left, rear_right = land.T
        pitch = np.arctan2(rear_left + rear_right - front_left - front_right, 4.0 * _WHEELS[0] * size[:, 0])
        roll = np.arctan2(front_left + rear_left - front_right - rear_right, 4.0 * _WHEELS[1] * size[:, 1])
        return np.column_stack([land.mean(axis=1), roll, pitch])

    def _fall(self, xy: ArrayLike, heading_rad: ArrayLike, size_m: ArrayLike) -> Floats:
        """(N,) how far the land at the lowest corner of things lies below that at their middle."""
        land = self._land_around(xy, heading_rad, 0.5 * np.asarray(size_m, dtype=float).reshape(-1, 2))
        if land is None or self.street_map.terrain is None:
            return np.zeros(len(np.asarray(xy).reshape(-1, 2)))
        return np.asarray(np.maximum(self.street_map.terrain.height(xy) - land.min(axis=1), 0.0))

    def _land_around(self, xy: ArrayLike, heading_rad: ArrayLike, half_m: Floats) -> Floats | None:
        """(N, 4) land at the corners of N rectangles: front left, front right, rear left, rear right; None if flat."""
        if self.street_map.terrain is None:
            return None
        at, heading = np.asarray(xy, dtype=float).reshape(-1, 2), np.asarray(heading_rad, dtype=float)
        ahead = half_m[:, :1] * np.column_stack([np.cos(heading), np.sin(heading)])
        left = half_m[:, 1:] * np.column_stack([-np.sin(heading), np.cos(heading)])
        corners = np.stack([at + ahead + left, at + ahead - left, at - ahead + left, at - ahead - left], axis=1)
        return self.street_map.terrain.height(corners.reshape(-1, 2)).reshape(-1, 4)

    def standing(self, area: shapely.Geometry) -> list[Prop]:
        """Props in the tiles that an area touches."""
        x0, y0, x1, y1 = shapely.bounds(area).tolist()
        (i0, j0), (i1, j1) = key_at(x0, y0), key_at(x1, y1)
        keys = [(i, j) for i in range(i0, i1 + 1) for j in range(j0, j1 + 1)]
        squares = np.array([shapely.box(*square(key)) for key in keys], dtype=object)
        shapely.prepare(area)
        return [
            prop for k in np.flatnonzero(shapely.intersects(area, squares)) for prop in self._placement.in_tile(keys[k])
        ]

    def _trees(self, key: Key) -> list[tuple[float, float]]:
        """Where trees stand in a tile and around it."""
        around = [(key[0] + i, key[1] + j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
        props = [prop for near in around for prop in self._placement.in_tile(near) if prop.kind == "tree"]
        return [(prop.x_m, prop.y_m) for prop in props]

    def heights(self, xy: ArrayLike) -> Floats:
        """Height of the ground at (N, 2) points, (N,) metres."""
        xy = np.asarray(xy, dtype=float).reshape(-1, 2)
        cells = cells_of(xy)
        if len(xy) and (cells == cells[0]).all():
            return self.tile((int(cells[0, 0]), int(cells[0, 1]))).height(xy)
        height = np.zeros(len(xy))
        for i, j in dict.fromkeys(map(tuple, cells.tolist())):
            here = (cells[:, 0] == i) & (cells[:, 1] == j)
            height[here] = self.tile((i, j)).height(xy[here])
        return height

    def lean(self, pose: Pose, model: RobotModel) -> tuple[float, float, float]:
        """How a robot stands at a pose: height of the base frame in metres, roll and pitch in radians. Who asks for the
        same pose again gets the last answer."""
        if self._leant is None or self._leant[0] != pose or self._leant[1] is not model:
            self._leant = pose, model, self._lean(pose, model)
        return self._leant[2]

    def _lean(self, pose: Pose, model: RobotModel) -> tuple[float, float, float]:
        cos, sin = math.cos(pose.heading_rad), math.sin(pose.heading_rad)
        ahead, aside = 0.5 * model.wheelbase_m, 0.5 * model.track_m
        feet = [(a * ahead, b * aside) for a in (1, -1) for b in (1, -1)]
        at = [(pose.x_m + cos * u - sin * v, pose.y_m + sin * u + cos * v) for u, v in feet]
        front_left, front_right, rear_left, rear_right = self.heights(at).tolist()
        pitch = math.atan2(rear_left + rear_right - front_left - front_right, 4.0 * ahead)
        roll = math.atan2(front_left + rear_left - front_right - rear_right, 4.0 * aside)
        return 0.25 * (front_left + front_right + rear_left + rear_right), roll, pitch
