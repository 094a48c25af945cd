"""Buffers that many owners share: rows, meshes, and the indirect draws of a batch.

All pictures of a batch are then drawn from the same buffers, so one call can draw a material of
all of them.
"""

from __future__ import annotations

import hashlib
from bisect import insort
from collections.abc import Sequence
from typing import Final, NamedTuple

import moderngl
import numpy as np
from numpy.typing import NDArray

_ROOM_MIN: Final = 1024
NO_DRAWS: Final = np.zeros((0, 5), dtype=np.uint32)
"""Draws of nothing. Columns: count, instances, first index, first corner, first instance."""


class Pool:
    """Rows of one size in a growing buffer. The place of rows never changes.

    version: changes whenever the buffer is another one
    """

    def __init__(self, context: moderngl.Context, row_bytes: int) -> None:
        self._context = context
        self._each = row_bytes
        self._rows = _ROOM_MIN
        self._free: list[tuple[int, int]] = [(0, _ROOM_MIN)]
        self.buffer = context.buffer(reserve=_ROOM_MIN * row_bytes)
        self.version = 0

    def take(self, count: int) -> int:
        """Reserve `count` rows, and return the first."""
        if not count:
            return 0
        for i, (start, length) in enumerate(self._free):
            if length >= count:
                rest = (start + count, length - count)
                self._free[i : i + 1] = [rest] if rest[1] else []
                return start
        self._grow(count)
        return self.take(count)

    def give(self, start: int, count: int) -> None:
        """Return rows from `take`."""
        if not count:
            return
        insort(self._free, (start, count))
        merged = self._free[:1]
        for first, length in self._free[1:]:
            last, before = merged[-1]
            if last + before == first:
                merged[-1] = last, before + length
            else:
                merged.append((first, length))
        self._free = merged

    def write(self, start: int, rows: NDArray[np.generic]) -> None:
        """Upload rows to their place."""
        if len(rows):
            self.buffer.write(np.ascontiguousarray(rows), offset=start * self._each)

    def release(self) -> None:
        self.buffer.release()

    def _grow(self, count: int) -> None:
        before, self._rows = self._rows, 2 * (self._rows + count)
        larger = self._context.buffer(reserve=self._rows * self._each)
        self._context.copy_buffer(larger, self.buffer, size=before * self._each)
        self.buffer.release()
        self.buffer = larger
        self.version += 1
        self.give(before, self._rows - before)


class Piece(NamedTuple):
    """A mesh in a pool. draw: its count of indices, first index and first corner"""

    key: bytes
    corners: int
    draw: tuple[int, int, int]


class MeshPool:
    """Meshes in one vertex and one index buffer; equal meshes are held once."""

    def __init__(self, context: moderngl.Context, row_bytes: int) -> None:
        self._corners = Pool(context, row_bytes)
        self._indices = Pool(context, np.dtype(np.uint32).itemsize)
        self._held: dict[bytes, tuple[Piece, int]] = {}

    @property
    def version(self) -> int:
        """Number that changes whenever a buffer is another one."""
        return self._corners.version + self._indices.version

    @property
    def buffers(self) -> tuple[moderngl.Buffer, moderngl.Buffer]:
        """Vertex and index buffer."""
        return self._corners.buffer, self._indices.buffer

    def hold(self, rows: NDArray[np.void], triangles: NDArray[np.uint32]) -> Piece:
        """Upload a mesh unless the pool has it. `drop` it when it is not needed any more."""
        rows, triangles = np.ascontiguousarray(rows), np.ascontiguousarray(triangles)
        key = hashlib.blake2b(rows.tobytes(), digest_size=16)
        key.update(triangles.tobytes())
        piece, users = self._held.get(key.digest(), (None, 0))
        if piece is None:
            base, first = self._corners.take(len(rows)), self._indices.take(len(triangles))
            self._corners.write(base, rows)
            self._indices.write(first, triangles)
            piece = Piece(key.digest(), len(rows), (len(triangles), first, base))
        self._held[piece.key] = piece, users + 1
        return piece

    def drop(self, piece: Piece) -> None:
        """Return a mesh from `hold`; its room is free after its last user."""
        _, users = self._held.pop(piece.key)
        if users > 1:
            self._held[piece.key] = piece, users - 1
            return
        count, first, base = piece.draw
        self._corners.give(base, piece.corners)
        self._indices.give(first, count)


class PictureRange(NamedTuple):
    """Pictures of a batch that are drawn together: from `first`, below `end`.

    number: of this range in its batch
    """

    number: int
    first: int
    end: int


class Draws:
    """Indirect draws of a batch in one buffer, by step and picture."""

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context
        self._room = 0
        self._buffer: moderngl.Buffer | None = None
        self._ends: list[list[int]] = []

    def set(self, steps: Sequence[Sequence[NDArray[np.uint32]]]) -> None:
        """Upload the draws of each step, which are those of each picture."""
        counts = np.array([[len(one) for one in step] for step in steps])
        ends = np.zeros((len(steps), counts.shape[1] + 1), dtype=np.int64)
        whole = counts.cumsum().reshape(counts.shape)
        ends[:, 1:] = whole
        ends[1:, 0] = whole[:-1, -1]
        self._ends = ends.tolist()
        rows = np.concatenate([one for step in steps for one in step])
        if len(rows) > self._room:
            self.release()
            self._room = 2 * len(rows)
            self._buffer = self._context.buffer(reserve=self._room * rows.strides[0])
        if self._buffer is not None and len(rows):
            self._buffer.write(rows)

    def draw(self, array: moderngl.VertexArray, step: int, first: int, end: int) -> None:
        """Draw a step of the pictures from `first`, below `end`. Check `count` before."""
        ends = self._ends[step]
        assert self._buffer is not None
        array.render_indirect(
            self._buffer, moderngl.TRIANGLES, count=ends[end] - ends[first], first=ends[first]
        )

    def count(self, step: int, first: int, end: int) -> int:
        """Return the number of draws of a step in these pictures."""
        ends = self._ends[step]
        return ends[end] - ends[first]

    def release(self) -> None:
        if self._buffer is not None:
            self._buffer.release()
            self._buffer = None
        self._room = 0
