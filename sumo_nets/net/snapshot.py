"""Cache of street maps read from nets: loading a snapshot takes a fifth of the time.

The cache key is a hash of the net's bytes, the reader's source and the geometry libraries. A
snapshot holds plain data only.
"""

from __future__ import annotations

import gc
import hashlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final, get_args, get_origin, get_type_hints

import msgspec
import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import MultiPolygon, Polygon

import cosim
import sumo_nets
from cosim.core.cache import cache_folder, cached, sources_hash
from cosim.place.street_map import StreetMap

SNAPSHOT_FOLDER: Final = "read"

_Pools = tuple[list[NDArray[Any]], list[shapely.Geometry]]
_Maker = Callable[[Any, _Pools], Any]


class _Snapshot(msgspec.Struct, array_like=True):
    """A serialized StreetMap.

    body: the map as msgpack, with indices in place of arrays and geometries.
    arrays: bytes of all arrays; `forms` gives the dtype, shape and offset of each.
    geometries: WKB.
    """

    body: bytes
    arrays: bytes
    forms: list[tuple[str, tuple[int, ...], int]]
    geometries: list[bytes]


def street_map_of(path: Path) -> StreetMap:
    """Return the StreetMap of a net from its snapshot, or read it with `read_net`, which may raise
    MapError.

    If the cache cannot be written, the net is read without storing a snapshot.
    """
    try:
        net = path.read_bytes()
    except OSError:
        return _read(path)
    key = _key(path.name, net)
    snapshot = cache_folder() / SNAPSHOT_FOLDER / f"{key}.map"
    street_map = cached(
        snapshot, lambda: _read(path), lambda made: [map_as_bytes(made)], map_from_bytes
    )
    return street_map.with_input_hash(key)


def _read(path: Path) -> StreetMap:
    from sumo_nets.net.net_file import read_net  # slow import, not needed for cached nets

    return read_net(path)


def map_as_bytes(street_map: StreetMap) -> bytes:
    """Serialize a StreetMap: equal maps give equal bytes."""
    arrays: list[NDArray[Any]] = []
    geometries: list[shapely.Geometry] = []

    def index_of(value: Any) -> int:
        if isinstance(value, np.ndarray):
            arrays.append(value)
            return len(arrays) - 1
        if isinstance(value, Polygon | MultiPolygon):
            geometries.append(value)
            return len(geometries) - 1
        raise TypeError(f"a StreetMap cannot be stored with a {type(value).__name__} in it")

    field_values = {name: getattr(street_map, name) for name in _FIELDS}
    body = msgspec.msgpack.encode(field_values, enc_hook=index_of)
    ends = np.cumsum([0, *(a.nbytes for a in arrays)]).tolist()
    forms = [(a.dtype.str, a.shape, at) for a, at in zip(arrays, ends[:-1], strict=True)]
    wkb = shapely.to_wkb(np.array(geometries, dtype=object)).tolist() if geometries else []
    snapshot_data = _Snapshot(
        body, b"".join(np.ascontiguousarray(a).tobytes() for a in arrays), forms, wkb
    )
    return msgspec.msgpack.encode(snapshot_data)


def map_from_bytes(data: bytes | memoryview) -> StreetMap:
    """Deserialize the result of `map_as_bytes`."""
    with _without_gc():
        snapshot_data = msgspec.msgpack.decode(data, type=_Snapshot)
        arrays = [
            np.ndarray(shape, dtype, buffer=snapshot_data.arrays, offset=at)
            for dtype, shape, at in snapshot_data.forms
        ]
        geometries = shapely.from_wkb(np.array(snapshot_data.geometries, dtype=object)).tolist()
        made: StreetMap = _maker(StreetMap)(
            msgspec.msgpack.decode(snapshot_data.body), (arrays, geometries)
        )
        return made


@cache
def _maker(kind: Any) -> _Maker:
    """Return the function that builds a value of a type from plain data and the pools."""
    parts, origin = get_args(kind), get_origin(kind)
    if origin is np.ndarray:
        return lambda number, pools: pools[0][number]
    if kind is Polygon or MultiPolygon in parts:
        return lambda number, pools: pools[1][number]
    if type(None) in parts and len(parts) == 2:
        value = _maker(parts[0])
        return lambda found, pools: None if found is None else value(found, pools)
    if is_dataclass(kind) or hasattr(kind, "_fields"):
        return _made_of(kind)
    if origin is Mapping:
        value = _maker(parts[1])
        return lambda found, pools: {name: value(item, pools) for name, item in found.items()}
    if origin is tuple and parts[-1] is Ellipsis:
        item = _maker(parts[0])
        return lambda found, pools: tuple([item(one, pools) for one in found])
    if origin is tuple:
        return lambda found, _: tuple(found)
    return lambda found, _: found


def _made_of(kind: Any) -> _Maker:
    """Return the maker of a dataclass, stored as a mapping, or of a named tuple, stored as a
    list."""
    hints = get_type_hints(kind)
    if hasattr(kind, "_fields"):
        return lambda found, _: kind(*found)
    makers = [
        (field.name, _maker(hints[field.name]))
        for field in fields(kind)
        if field.init and field.name[0] != "_"
    ]
    return lambda found, pools: kind(**{name: make(found[name], pools) for name, make in makers})


_FIELDS: Final = tuple(name for name in StreetMap.__dataclass_fields__ if not name.startswith("_"))


def _key(name: str, net: bytes) -> str:
    return hashlib.sha256(
        f"{_READER} {name}\0".encode() + hashlib.sha256(net).digest()
    ).hexdigest()[:32]


_READER_FOLDERS: Final = (
    Path(sumo_nets.__file__).parent,
    *(Path(cosim.__file__).parent / room for room in ("core", "place")),
)
_READER: Final = f"{sources_hash(*_READER_FOLDERS)} {shapely.geos_version_string}"
"""Hash of the source and the libraries that build a StreetMap from a net."""


@contextmanager
def _without_gc() -> Iterator[None]:
    """Pause the garbage collector: scanning thousands of live new objects would double the time."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()
