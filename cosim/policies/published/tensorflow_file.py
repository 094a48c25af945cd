"""Read the variables of TensorFlow checkpoints without TensorFlow.

A checkpoint has an index, a sorted table of names and places, and a file of numbers. The table is
that of LevelDB: blocks of entries whose keys share beginnings, and a footer with the place of the
block of blocks. Values of the table are protocol buffers. Only uncompressed tables of one data file
and variables of float32 are read, as TensorFlow 1 writes them.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

_MAGIC: Final = 0xDB4775248B80FB57
"""Last eight bytes of a table."""
_FOOTER_BYTES: Final = 48
_FLOAT32: Final = 1
"""Number of the type float32 in a checkpoint."""
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
"""Forms of a field in a protocol buffer."""
_TYPE, _SHAPE, _SHARD, _OFFSET, _SIZE = 1, 2, 3, 4, 5
"""Numbers of the fields of a variable's entry."""
_Field = tuple[int, int | bytes]


class _Entry(NamedTuple):
    """Place of a variable in the file of numbers."""

    kind: int
    shape: tuple[int, ...]
    shard: int
    offset: int
    size: int


def read_checkpoint(index: bytes, numbers: bytes) -> dict[str, NDArray[np.float32]]:
    """Return the float32 variables of a checkpoint by name, such as "layer1/kernel:0".

    index: content of the file `.index`.
    numbers: content of the file `.data-00000-of-00001`.
    Raises ValueError for other or damaged files.
    """
    try:
        entries = {name: _entry(value) for name, value in _table(index) if name}
    except (IndexError, struct.error, UnicodeDecodeError, TypeError) as error:
        raise ValueError(f"is no index of a TensorFlow checkpoint: {error}") from None
    return {
        name: _variable(name, one, numbers) for name, one in entries.items() if one.kind == _FLOAT32
    }


def _variable(name: str, entry: _Entry, numbers: bytes) -> NDArray[np.float32]:
    found = numbers[entry.offset : entry.offset + entry.size]
    if entry.shard or len(found) != entry.size:
        raise ValueError(f"'{name}' is not in the checkpoint's first data file")
    array = np.frombuffer(found, "<f4")
    if array.size != int(np.prod(entry.shape)):
        raise ValueError(f"'{name}' has {array.size} numbers, and shape {entry.shape}")
    return array.reshape(entry.shape)


def _table(data: bytes) -> Iterator[tuple[str, bytes]]:
    """Yield the keys and values of a table."""
    if len(data) < _FOOTER_BYTES or struct.unpack("<Q", data[-8:])[0] != _MAGIC:
        raise ValueError("is no index of a TensorFlow checkpoint: it ends otherwise")
    footer = data[-_FOOTER_BYTES:]
    _, at = _place(footer, 0)  # of the block of metadata
    blocks, _ = _place(footer, at)
    for _, handle in _block(data, *blocks):
        place, _ = _place(handle, 0)
        for key, value in _block(data, *place):
            yield key.decode(), value


def _place(data: bytes, at: int) -> tuple[tuple[int, int], int]:
    """Return the offset and size of a block, and the position after them."""
    offset, at = _varint(data, at)
    size, at = _varint(data, at)
    return (offset, size), at


def _block(data: bytes, offset: int, size: int) -> Iterator[tuple[bytes, bytes]]:
    """Yield the keys and values of a block; a key repeats the beginning of the last one."""
    if data[offset + size]:
        raise ValueError("is a compressed index of a TensorFlow checkpoint")
    block = data[offset : offset + size]
    (restarts,) = struct.unpack("<I", block[-4:])
    end = size - 4 * (restarts + 1)
    at, key = 0, b""
    while at < end:
        shared, at = _varint(block, at)
        own, at = _varint(block, at)
        length, at = _varint(block, at)
        key = key[:shared] + block[at : at + own]
        at += own
        yield key, block[at : at + length]
        at += length


def _entry(value: bytes) -> _Entry:
    fields = dict(_fields(value))
    shape = fields.get(_SHAPE, b"")
    if not isinstance(shape, bytes):
        raise ValueError("is no index of a TensorFlow checkpoint: a shape is no message")
    sides = tuple(
        int(dict(_fields(side)).get(1, 0))
        for number, side in _fields(shape)
        if number == 2 and isinstance(side, bytes)
    )
    kind, shard, offset, size = (
        int(fields.get(number, 0)) for number in (_TYPE, _SHARD, _OFFSET, _SIZE)
    )
    return _Entry(kind, sides, shard, offset, size)


def _fields(message: bytes) -> Iterator[_Field]:
    """Yield the numbers and values of a protocol buffer's fields."""
    at = 0
    while at < len(message):
        tag, at = _varint(message, at)
        number, form = tag >> 3, tag & 7
        if form == _VARINT:
            value, at = _varint(message, at)
            yield number, value
        elif form == _BYTES:
            length, at = _varint(message, at)
            yield number, message[at : at + length]
            at += length
        elif form in (_FIXED32, _FIXED64):
            at += 4 if form == _FIXED32 else 8
        else:
            raise ValueError(
                f"is no index of a TensorFlow checkpoint: it has a field of form {form}"
            )


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """Return a number of variable length and the position after it."""
    number = shift = 0
    while True:
        byte = data[at]
        number |= (byte & 0x7F) << shift
        at += 1
        if byte < 0x80:
            return number, at
        shift += 7
