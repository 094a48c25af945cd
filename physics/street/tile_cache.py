"""Lossless conversion of tiles and their contents to arrays for the disk cache."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, TypeVar

import msgspec
import numpy as np
import shapely
from numpy.typing import NDArray

import cosim
import physics
from cosim.core.cache import ArrayCache, Arrays, sources_hash
from cosim.place.street_map import LandKind, StreetMap
from cosim.place.terrain import Terrain
from physics.ground.mesh import EMPTY, Mesh
from physics.ground.relief import Relief
from physics.ground.tiles import Key, Tile
from physics.street.buildings import Building
from physics.street.furniture import Prop

_SOURCE_FOLDERS: Final = (
    *(Path(cosim.__file__).parent / folder for folder in ("core", "place")),
    *(
        Path(physics.__file__).parent / folder
        for folder in ("ground", "street", "textures", "cameras/gl")
    ),
)
"""Folders whose source code determines the cached arrays."""

SOURCES_KEY: Final = f"{sources_hash(*_SOURCE_FOLDERS)} {shapely.geos_version_string}"
"""Cache key part: hash of the sources and version of GEOS."""

_Name = TypeVar("_Name", bound=str)


class TileObjects(msgspec.Struct, frozen=True, array_like=True):
    """Buildings, placed on the land, and props of a tile."""

    buildings: tuple[Building, ...]
    props: tuple[Prop, ...]


class _TileFields(msgspec.Struct, array_like=True):
    """Fields of a tile that are not arrays.

    parts: name, vertex count and triangle count of each mesh
    low, crossings: areas as WKB
    relief: roughness and seed, None without relief
    """

    parts: list[tuple[str, int, int]]
    low: bytes
    crossings: bytes
    relief: tuple[float, int] | None


def tile_cache(street_map: StreetMap, seed: int, roughness: float) -> ArrayCache:
    """Return the cache of a map's tiles."""
    key_text = f"{street_map.input_hash} {seed} {roughness!r} {SOURCES_KEY}"
    return ArrayCache(
        "tiles", hashlib.sha256(key_text.encode()).hexdigest()[:32] if street_map.input_hash else ""
    )


def tile_as_arrays(tile: Tile) -> Arrays:
    """Convert a tile to arrays for `tile_from_arrays`."""
    relief = tile.relief
    words = _TileFields(
        _rows(tile.parts),
        shapely.to_wkb(tile.low),
        shapely.to_wkb(tile.crossings),
        None if relief is None else (relief.roughness, relief.seed),
    )
    found = {"words": _as_array(words), **_joined_parts(tile.parts)}
    return found if relief is None else found | {"roots": relief.roots, "holes": relief.holes}


def tile_from_arrays(arrays: Arrays, key: Key, terrain: Terrain | None) -> Tile:
    """Restore a tile from arrays."""
    words = msgspec.msgpack.decode(arrays["words"].data, type=_TileFields)
    parts = _parts_of(words.parts, arrays)
    low, crossings = shapely.from_wkb([words.low, words.crossings])
    shapely.prepare([low, crossings])
    relief = None
    if words.relief is not None:
        roughness, seed = words.relief
        relief = Relief(roughness, seed, arrays["roots"], arrays["holes"])
    return Tile(key, parts, low, crossings, relief, terrain)


def covers_as_arrays(covers: Mapping[LandKind, Mesh]) -> Arrays:
    """Convert covers to arrays for `covers_from_arrays`."""
    words = np.frombuffer(msgspec.msgpack.encode(_rows(covers)), dtype=np.uint8)
    return {"words": words, **_joined_parts(covers)}


def covers_from_arrays(arrays: Arrays) -> dict[LandKind, Mesh]:
    """Restore covers from arrays."""
    return _parts_of(
        msgspec.msgpack.decode(arrays["words"].data, type=list[tuple[LandKind, int, int]]), arrays
    )


def _rows(parts: Mapping[_Name, Mesh]) -> list[tuple[_Name, int, int]]:
    """Return name, vertex count and triangle count of each mesh."""
    return [(name, len(mesh.vertices), len(mesh)) for name, mesh in parts.items()]


def _joined_parts(parts: Mapping[_Name, Mesh]) -> dict[str, NDArray[Any]]:
    meshes = [*parts.values(), EMPTY]
    return {
        "vertices": np.concatenate([mesh.vertices for mesh in meshes]),
        "normals": np.concatenate([mesh.normals for mesh in meshes]),
        "triangles": np.concatenate([mesh.triangles for mesh in meshes]),
    }


def _parts_of(rows: Sequence[tuple[_Name, int, int]], arrays: Arrays) -> dict[_Name, Mesh]:
    parts = {}
    corner = 0
    triangle = 0
    for name, corners, triangles in rows:
        here = slice(corner, corner + corners)
        faces = arrays["triangles"][triangle : triangle + triangles]
        parts[name] = Mesh(arrays["vertices"][here], arrays["normals"][here], faces)
        corner, triangle = corner + corners, triangle + triangles
    return parts


def objects_as_arrays(things: TileObjects) -> Arrays:
    """Convert tile contents to arrays for `objects_from_arrays`."""
    return {"words": _as_array(things)}


def objects_from_arrays(arrays: Arrays) -> TileObjects:
    """Restore tile contents from arrays."""
    return msgspec.msgpack.decode(arrays["words"].data, type=TileObjects, dec_hook=_decode)


def _as_array(words: msgspec.Struct) -> NDArray[np.uint8]:
    return np.frombuffer(msgspec.msgpack.encode(words, enc_hook=_encode), dtype=np.uint8)


def _encode(value: Any) -> Any:
    return shapely.to_wkb(value) if isinstance(value, shapely.Geometry) else value.item()


def _decode(_: type, wkb: Any) -> Any:
    return shapely.from_wkb(wkb)
