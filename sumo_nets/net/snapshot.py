"""What was read from a net, kept: the second reading of a net takes a fifth of the time of the
first.

A snapshot lies in the cache folder under a name that says what it depends on: the net's bytes, the
source of the reader and the libraries that made its polygons. It holds plain data only, sealed by a
hash; a damaged one is read anew.
"""

from __future__ import annotations

import gc
import hashlib
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import fields, is_dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final, get_args, get_origin, get_type_hints

import msgspec
import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import MultiPolygon, Polygon

import cosim
import sumo_nets
from cosim.core.cache import cache_folder, make_room, say_not_kept, use_entry
from cosim.place.street_map import StreetMap

SNAPSHOT_FOLDER: Final = "read"
_SEAL_BYTES: Final = 32

_Pools = tuple[list[NDArray[Any]], list[shapely.Geometry]]
_Maker = Callable[[Any, _Pools], Any]


class _Snapshot(msgspec.Struct, array_like=True):
    """body: the map as msgpack, with numbers in place of arrays and geometries. arrays: their
    bytes, one after the other, as dtype, shape and offset tell; geometries: WKB."""

    body: bytes
    arrays: bytes
    forms: list[tuple[str, tuple[int, ...], int]]
    geometries: list[bytes]


def street_map_of(path: Path) -> StreetMap:
    """The StreetMap of a net: from its snapshot, else by `read_net`, which may raise MapError.

    A cache that cannot be written is no error: the net is read, and nothing kept.
    """
    try:
        net = path.read_bytes()
    except OSError:
        return _read(path)
    made_of = _key(path.name, net)
    kept = cache_folder() / SNAPSHOT_FOLDER / f"{made_of}.map"
    use_entry(kept)
    with suppress(OSError, ValueError, msgspec.DecodeError, shapely.errors.GEOSException):
        return thawed(kept.read_bytes()).read_of(made_of)
    street_map = _read(path).read_of(made_of)
    try:
        make_room()
        _write(kept, map_as_bytes(street_map))
    except OSError as error:
        say_not_kept(kept.parent, error)
    return street_map


def _read(path: Path) -> StreetMap:
    from sumo_nets.net.net_file import (
        read_net,
    )  # with all that reading takes: most nets were read before

    return read_net(path)


def map_as_bytes(street_map: StreetMap) -> bytes:
    """A StreetMap as bytes: equal maps give equal bytes."""
    arrays: list[NDArray[Any]] = []
    geometries: list[shapely.Geometry] = []

    def numbered(value: Any) -> int:
        if isinstance(value, np.ndarray):
            arrays.append(value)
            return len(arrays) - 1
        if isinstance(value, Polygon | MultiPolygon):
            geometries.append(value)
            return len(geometries) - 1
        raise TypeError(f"a StreetMap cannot be kept with a {type(value).__name__} in it")

    bare = {name: getattr(street_map, name) for name in _FIELDS}
    body = msgspec.msgpack.encode(bare, enc_hook=numbered)
    ends = np.cumsum([0, *(a.nbytes for a in arrays)]).tolist()
    forms = [(a.dtype.str, a.shape, at) for a, at in zip(arrays, ends[:-1], strict=True)]
    wkb = shapely.to_wkb(np.array(geometries, dtype=object)).tolist() if geometries else []
    held = _Snapshot(body, b"".join(np.ascontiguousarray(a).tobytes() for a in arrays), forms, wkb)
    data = msgspec.msgpack.encode(held)
    return hashlib.sha256(data).digest() + data


def thawed(data: bytes) -> StreetMap:
    """The StreetMap in bytes of `map_as_bytes`. Raises ValueError when they are not whole."""
    if hashlib.sha256(memoryview(data)[_SEAL_BYTES:]).digest() != data[:_SEAL_BYTES]:
        raise ValueError("a damaged snapshot")
    with _without_gc():
        held = msgspec.msgpack.decode(memoryview(data)[_SEAL_BYTES:], type=_Snapshot)
        arrays = [
            np.ndarray(shape, dtype, buffer=held.arrays, offset=at)
            for dtype, shape, at in held.forms
        ]
        geometries = shapely.from_wkb(np.array(held.geometries, dtype=object)).tolist()
        made: StreetMap = _maker(StreetMap)(msgspec.msgpack.decode(held.body), (arrays, geometries))
        return made


@cache
def _maker(kind: Any) -> _Maker:
    """How a value of this type is made of plain data and the pools."""
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
    """The maker of a dataclass or a named tuple: the one is kept as a mapping, the other as a
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
        _READER + name.encode() + b"\0" + hashlib.sha256(net).digest()
    ).hexdigest()[:32]


def _reader() -> bytes:
    """What makes a StreetMap of a net: the source of this package and of the words it uses, and the
    libraries."""
    rooms = [
        Path(sumo_nets.__file__).parent,
        *(Path(cosim.__file__).parent / room for room in ("core", "place")),
    ]
    sources = [source for room in rooms for source in sorted(room.rglob("*.py"))]
    libraries = [
        *(version(name) for name in ("numpy", "scipy", "shapely")),
        shapely.geos_version_string,
    ]
    seen = hashlib.sha256(" ".join(libraries).encode())
    for source in sources:
        seen.update(source.read_bytes())
    return seen.digest()


_READER: Final = _reader()
"""As it was imported: who edits it later does not change what this process reads."""


def _write(path: Path, data: bytes) -> None:
    """In one move: several processes may keep the same map at once."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=".writing-")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
        Path(name).replace(path)
    except OSError:
        Path(name).unlink(missing_ok=True)
        raise


@contextmanager
def _without_gc() -> Iterator[None]:
    """Thousands of new objects, none of them garbage: looking for some would double the time."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()
