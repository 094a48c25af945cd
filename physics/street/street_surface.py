"""Surface of a street map: tiles, buildings, props and heights, with a disk cache."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Mapping
from typing import Final

import numpy as np
import shapely
from numpy.typing import ArrayLike

from cosim.core.cache import Arrays
from cosim.core.errors import UsageError
from cosim.core.geometry import Floats
from cosim.place.open_ground import GROUND_LOOKS
from cosim.place.street_map import LandKind, StreetMap
from physics.ground.materials import APPEARANCE_OVERRIDES, PAVINGS, PLAIN_FRICTION, Paving, friction
from physics.ground.mesh import Mesh
from physics.ground.tiles import Key, Tile, build_tile, surface_look, tile_indices, tiles_touching
from physics.street.building_style import wall_style_of
from physics.street.buildings import Building, BuildingRows, with_foundation
from physics.street.covers import frontage_covers, land_covers
from physics.street.decals import tile_decals
from physics.street.furniture import Prop
from physics.street.mapped import MappedObjects
from physics.street.paint import tile_markings
from physics.street.placement import PropPlacement
from physics.street.props import SignalPost, signals_in_tile
from physics.street.surface import Chunk, Patch, PlaceSurface, TexturedDetails
from physics.street.tile_cache import (
    TileObjects,
    covers_as_arrays,
    covers_from_arrays,
    objects_as_arrays,
    objects_from_arrays,
    tile_as_arrays,
    tile_cache,
    tile_from_arrays,
)
from physics.textures.ground import layer_of

_CACHED_TILES: Final = 100
"""Number of tiles in the in-memory LRU cache."""


class StreetSurface(PlaceSurface):
    """Surface of a street map for a seed.

    roughness: unevenness of the ground, 0 (flat) to 1
    """

    def __init__(self, street_map: StreetMap, seed: int, roughness: float = 0.0) -> None:
        if not 0.0 <= roughness <= 1.0:
            raise UsageError(f"roughness is {roughness:g}, but it lies between 0 (flat) and 1")
        self.street_map = street_map
        self.seed = seed
        self.roughness = roughness
        self.level = street_map.terrain is None
        mapped = MappedObjects(street_map)
        self._frontage = BuildingRows(street_map, seed, mapped)
        self._paving = Paving(street_map, seed)
        self._placement = PropPlacement(street_map, seed, self._frontage, mapped)
        self._cache = tile_cache(street_map, seed, roughness)
        self._tiles: OrderedDict[Key, Tile] = OrderedDict()
        self._things: dict[Key, TileObjects] = {}

    def chunk(self, key: Key) -> Chunk:
        ground = [self._patch(name, mesh) for name, mesh in self.tile(key).parts.items()]
        return Chunk(tuple(ground), self.buildings(key), self.props(key))

    def _patch(self, name: str, mesh: Mesh) -> Patch:
        """Return a ground mesh with its label, colour and texture layer."""
        label, colour = surface_look(name)
        shown, colour = (
            (name, colour)
            if self.street_map.planned
            else APPEARANCE_OVERRIDES.get(name, (name, colour))
        )
        return Patch(
            name, mesh, friction(name), label, colour, layer_of(shown, self.seed), name in PAVINGS
        )

    def covers(self, key: Key) -> tuple[Patch, ...]:
        if self.street_map.planned:
            return ()
        arrays = self.kept(
            "covers",
            key,
            lambda: covers_as_arrays(land_covers(self.street_map, self.tile(key), rims=False)),
        )
        return self._cover_patches(covers_from_arrays(arrays))

    def _cover_patches(self, covers: Mapping[LandKind, Mesh]) -> tuple[Patch, ...]:
        """Return covers as patches with the look of their kind of land."""
        laid = []
        for kind, mesh in covers.items():
            name = f"ground:{kind}"
            colour = GROUND_LOOKS[kind].seen
            laid.append(
                Patch(name, mesh, PLAIN_FRICTION, "ground", colour, layer_of(name, self.seed))
            )
        return tuple(laid)

    def posts(self, key: Key) -> list[SignalPost]:
        return signals_in_tile(self.street_map, key)

    def finish(self, key: Key) -> TexturedDetails:
        tile = self.tile(key)
        painted = []
        laid = [*self._cover_patches(land_covers(self.street_map, tile, rims=True))]
        for mesh, (layer, colour) in frontage_covers(self.street_map, tile, self.seed):
            tint = colour or (1.0, 1.0, 1.0)
            laid.append(
                Patch(
                    f"ground:{layer}",
                    mesh,
                    PLAIN_FRICTION,
                    "ground",
                    tint,
                    layer,
                    colour is not None,
                )
            )
        for layer, mesh in tile_markings(self.street_map, tile).items():
            label = "road" if layer == "paint" else "sidewalk"
            painted.append(
                Patch(
                    f"{label}:{layer}", mesh, PLAIN_FRICTION, label, (1.0, 1.0, 1.0), layer, False
                )
            )
        styles = [wall_style_of(building, self.street_map) for building in self.buildings(key)]
        decals = tile_decals(self.street_map, tile, self.seed)
        return TexturedDetails(tuple(laid), tuple(painted), tuple(styles), decals)

    def tile(self, key: Key) -> Tile:
        """Return the ground of a tile from the cache, or build it."""
        if key not in self._tiles:
            arrays = self.kept("ground", key, lambda: tile_as_arrays(self._built(key)))
            self._tiles[key] = tile_from_arrays(arrays, key, self.street_map.terrain)
            if len(self._tiles) > _CACHED_TILES:
                self._tiles.popitem(last=False)
        self._tiles.move_to_end(key)
        return self._tiles[key]

    def kept(self, kind: str, key: Key, make: Callable[[], Arrays]) -> Arrays:
        return self._cache.get(f"{kind}_{key[0]}_{key[1]}", make)

    def buildings(self, key: Key) -> tuple[Building, ...]:
        return self._things_in(key).buildings

    def props(self, key: Key) -> tuple[tuple[Prop, float], ...]:
        """Return the props whose centre lies in the tile, each with the height of its foot."""
        props = self._things_in(key).props
        heights = self.tile(key).height([(prop.x_m, prop.y_m) for prop in props])
        if props and not self.level:
            sizes = np.array([prop.size_m[:2] for prop in props])
            heights = heights - self.drop_to_corner(
                [(p.x_m, p.y_m) for p in props], [p.heading_rad for p in props], sizes
            )
        return tuple(zip(props, heights.tolist(), strict=True))

    def land(self, xy: ArrayLike) -> Floats:
        terrain = self.street_map.terrain
        return (
            np.zeros(len(np.asarray(xy).reshape(-1, 2))) if terrain is None else terrain.height(xy)
        )

    def standing(self, area: shapely.Geometry) -> list[Prop]:
        return [prop for key in tiles_touching(area) for prop in self._things_in(key).props]

    def _things_in(self, key: Key) -> TileObjects:
        """Return buildings and props of a tile from the cache, or place them."""
        if key not in self._things:
            arrays = self.kept("things", key, lambda: objects_as_arrays(self._place_things(key)))
            self._things[key] = objects_from_arrays(arrays)
        return self._things[key]

    def _place_things(self, key: Key) -> TileObjects:
        buildings = self._frontage.in_tile(key)
        terrain = self.street_map.terrain
        grounded = (
            buildings if terrain is None else tuple(with_foundation(b, terrain) for b in buildings)
        )
        return TileObjects(grounded, self._placement.in_tile(key))

    def _built(self, key: Key) -> Tile:
        roots = self._tree_positions(key) if self.roughness > 0.0 else []
        return build_tile(self.street_map, key, self._paving, self.roughness, self.seed, roots)

    def _tree_positions(self, key: Key) -> list[tuple[float, float]]:
        """Return the positions of trees in a tile and its neighbours."""
        around = [(key[0] + i, key[1] + j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
        props = [
            prop for near in around for prop in self._things_in(near).props if prop.kind == "tree"
        ]
        return [(prop.x_m, prop.y_m) for prop in props]

    def heights(self, xy: ArrayLike) -> Floats:
        """Return the (N,) ground heights in metres at (N, 2) points."""
        xy = np.asarray(xy, dtype=float).reshape(-1, 2)
        cells = tile_indices(xy)
        if len(xy) and (cells == cells[0]).all():
            return self.tile((int(cells[0, 0]), int(cells[0, 1]))).height(xy)
        height = np.zeros(len(xy))
        key = (cells[:, 0] << 32) + cells[:, 1]
        for one in set(key.tolist()):
            here = key == one
            first = cells[here.argmax()].tolist()
            height[here] = self.tile((first[0], first[1])).height(xy[here])
        return height
