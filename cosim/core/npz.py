"""Read untrusted .npz files within size limits.

Sizes are checked before anything is read, so that neither sparse files nor zip bombs fill the
memory. Pickled objects are never loaded.
"""

from __future__ import annotations

import io
import math
import struct
import zipfile
import zlib
from collections.abc import Collection
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np
from numpy.typing import NDArray

from cosim.core.files import checked_size

MAX_NPZ_BYTES: Final = 2 << 30
"""Maximum size of a file, packed or unpacked, in bytes."""
_MAX_ARRAYS: Final = 4096
"""Maximum number of arrays in a file."""
_ENDING: Final = ".npy"
_HEADERS: Final = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}
"""Reader of the array header by version of the .npy format."""
NPZ_ERRORS: Final = (
    EOFError,
    KeyError,
    MemoryError,
    NotImplementedError,
    OverflowError,
    RuntimeError,
    SyntaxError,
    TypeError,
    ValueError,
    struct.error,
    zipfile.BadZipFile,
    zipfile.LargeZipFile,
    zlib.error,
)
"""Exceptions that zipfile and numpy raise for damaged, encrypted or foreign files."""


def read_npz(
    path: Path, only: Collection[str] | None = None, max_bytes: int = MAX_NPZ_BYTES
) -> dict[str, NDArray[Any]]:
    """Return the arrays of a file by name.

    only: names of the arrays to read; each of them must exist.
    Raises ValueError with the reason: not a regular file, not an .npz, truncated, damaged, pickled
    objects, or larger than `max_bytes`. Raises OSError.
    """
    checked_size(path, max_bytes)
    with path.open("rb") as file:
        return read_open_npz(file, only, max_bytes)


def npz_names(path: Path) -> list[str]:
    """Return the names of the arrays in a file without reading them. Raises ValueError, OSError."""
    try:
        with zipfile.ZipFile(path) as held:
            return [name.removesuffix(_ENDING) for name in held.namelist()]
    except NPZ_ERRORS as error:
        raise ValueError(f"cannot be read as .npz: {error}") from error


def read_open_npz(
    file: BinaryIO, only: Collection[str] | None = None, max_bytes: int = MAX_NPZ_BYTES
) -> dict[str, NDArray[Any]]:
    """Return the arrays of an open file by name, as `read_npz` does."""
    try:
        with zipfile.ZipFile(file) as held:
            entries = {one.filename.removesuffix(_ENDING): one for one in held.infolist()}
            size = sum(one.file_size for one in held.infolist())
            if size > max_bytes or len(held.infolist()) > _MAX_ARRAYS:
                count = len(held.infolist())
                raise ValueError(
                    f"unpacks to {count} arrays of {size} bytes; at most {max_bytes} bytes are read"
                )
            if lacking := sorted({*(only or ())} - entries.keys()):
                raise ValueError(f"has no array '{lacking[0]}'")
            names = [name for name in entries if only is None or name in only]
            return {name: _array(name, held.read(entries[name])) for name in names}
    except NPZ_ERRORS as error:
        why = f"{error}" or type(error).__name__
        raise ValueError(f"cannot be read as .npz: {why}") from error


def _array(name: str, data: bytes) -> NDArray[Any]:
    """Decode the array in the bytes of an .npy file."""
    file = io.BytesIO(data)
    version = np.lib.format.read_magic(file)
    if version not in _HEADERS:
        raise ValueError(f"'{name}' is of another version of .npy: {version}")
    shape, by_columns, dtype = _HEADERS[version](file)
    if dtype.hasobject:
        raise ValueError(
            f"'{name}' holds objects of Python, which are never unpacked: save it as an "
            f"array of numbers"
        )
    size = len(data) - file.tell()
    if math.prod(shape) * dtype.itemsize != size:
        raise ValueError(f"'{name}' should hold {shape} of {dtype}, and has {size} bytes")
    array: NDArray[Any] = np.frombuffer(bytearray(data[file.tell() :]), dtype)
    return array.reshape(shape, order="F" if by_columns else "C")
