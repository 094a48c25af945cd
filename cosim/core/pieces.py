"""Many small sets of arrays that belong together, kept: a file for each, in a folder named by what
they depend on.

Like what `cosim.core.baked` keeps, they are made once on a machine, sealed by a hash and made anew
where they are damaged; a cache that cannot be written is done without. They are read, not mapped:
there may be more than a process may have open.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np

from cosim.core.baked import Arrays
from cosim.core.cache import MAKING, cache_folder, make_room, say_not_kept, use_entry

_SEAL_BYTES: Final = 32
_ALIGNED: Final = 16

_Table = list[tuple[str, bytes, tuple[int, ...], int]]
"""Name, dtype as JSON, shape and start of each array of a file."""


class Pieces:
    """The pieces of one thing. kind: of things, names the folder that all of the kind lie in;
    made_of: a hash of all that they depend on, "" where that is not known: then each is made when
    it is asked for, and none kept."""

    def __init__(self, kind: str, made_of: str) -> None:
        self._folder = cache_folder() / kind / made_of if made_of else None
        if self._folder is not None:
            use_entry(self._folder)

    def get(self, name: str, make: Callable[[], Arrays]) -> Arrays:
        """What `make` makes, write-protected: from the cache, else made now and kept."""
        if self._folder is None:
            return _protected(make())
        use_entry(self._folder)
        path = self._folder / name
        with suppress(OSError, ValueError, msgspec.DecodeError):
            return _read(path)
        arrays = _protected(make())
        try:
            self._keep(path, arrays)
        except OSError as error:
            say_not_kept(self._folder.parent, error)
        return arrays

    def _keep(self, path: Path, arrays: Arrays) -> None:
        """In one move: several processes may make the same at once, and the last wins."""
        path.parent.mkdir(parents=True, exist_ok=True)
        make_room()
        handle, name = tempfile.mkstemp(prefix=MAKING, dir=path.parent.parent)
        making = Path(name)
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(_as_bytes(arrays))
            making.chmod(0o644)
            making.replace(path)
        except OSError:
            making.unlink(missing_ok=True)
            raise


def _protected(arrays: Arrays) -> Arrays:
    whole = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    for array in whole.values():
        array.flags.writeable = False
    return whole


def _as_bytes(arrays: Arrays) -> bytes:
    """Seal, length of the table, table, and the arrays one after the other."""
    table: _Table = []
    at = 0
    for name, array in arrays.items():
        kind = msgspec.json.encode(array.dtype.descr if array.dtype.names else array.dtype.str)
        table.append((name, kind, array.shape, at))
        at += -(-array.nbytes // _ALIGNED) * _ALIGNED
    head = msgspec.msgpack.encode(table)
    start = _start(len(head))
    data = bytearray(start + at)
    data[_SEAL_BYTES : _SEAL_BYTES + 4] = len(head).to_bytes(4, "little")
    data[_SEAL_BYTES + 4 : _SEAL_BYTES + 4 + len(head)] = head
    for (_, _, _, offset), array in zip(table, arrays.values(), strict=True):
        data[start + offset : start + offset + array.nbytes] = array.tobytes()
    data[:_SEAL_BYTES] = hashlib.sha256(memoryview(data)[_SEAL_BYTES:]).digest()
    return bytes(data)


def _read(path: Path) -> Arrays:
    """Raises OSError where there is nothing, ValueError where it is not what was kept."""
    data = path.read_bytes()
    held = memoryview(data)
    if hashlib.sha256(held[_SEAL_BYTES:]).digest() != data[:_SEAL_BYTES]:
        raise ValueError(f"{path}: not what was written")
    size = int.from_bytes(data[_SEAL_BYTES : _SEAL_BYTES + 4], "little")
    table = msgspec.msgpack.decode(held[_SEAL_BYTES + 4 : _SEAL_BYTES + 4 + size], type=_Table)
    start = _start(size)
    return {
        name: np.ndarray(shape, _dtype(kind), data, start + at) for name, kind, shape, at in table
    }


def _start(head_bytes: int) -> int:
    """Where the arrays begin."""
    return -(-(_SEAL_BYTES + 4 + head_bytes) // _ALIGNED) * _ALIGNED


@lru_cache(maxsize=64)
def _dtype(kind: bytes) -> np.dtype[Any]:
    told = msgspec.json.decode(kind)
    return np.dtype(
        told
        if isinstance(told, str)
        else [(name, one, *map(tuple, shape)) for name, one, *shape in told]
    )
