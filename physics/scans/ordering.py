"""Order meshes and splats by content, so that the order in their files never matters."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cosim.place.scan import ScanMesh, Splats

_CELL_M: Final = 0.01
"""Side of a cell of the Morton code in metres."""
_BITS: Final = 21
"""Bits of the Morton code per axis: 10 km around the origin."""


def morton_codes(points: NDArray[np.float32]) -> NDArray[np.uint64]:
    """Return the Morton codes of (N, 3) points in metres."""
    half = 1 << (_BITS - 1)
    cells = np.floor(points.astype(np.float64) / _CELL_M) + half
    cells = np.clip(cells, 0, 2 * half - 1).astype(np.uint64)
    one, two = np.uint64(1), np.uint64(2)
    return np.asarray(
        _spread(cells[:, 0]) | _spread(cells[:, 1]) << one | _spread(cells[:, 2]) << two
    )


def order_of(points: NDArray[np.float32], *more: NDArray[Any]) -> NDArray[np.int64]:
    """Return the order by Morton code, then by the bytes of the points and of more arrays."""
    codes = morton_codes(points)
    order = np.argsort(codes, kind="stable")
    ordered = codes[order]
    equal = ordered[1:] == ordered[:-1]
    tied = np.zeros(len(order), dtype=bool)
    tied[1:] |= equal
    tied[:-1] |= equal
    places = np.flatnonzero(tied)
    if not len(places):
        return order
    rows = order[places]
    keys = [_as_bytes(array[rows]) for array in (points, *more)]
    columns = [column for key in keys for column in key.T]
    order[places] = rows[np.lexsort([*columns[::-1], codes[rows]])]
    return order


def order_splats(splats: Splats) -> Splats:
    """Return splats in their order."""
    order = order_of(splats.centres, splats.covariances, splats.rgba)
    return take_splats(splats, order)


def take_splats(splats: Splats, rows: NDArray[Any]) -> Splats:
    """Return some splats, by indices or a mask."""
    return Splats(
        splats.centres[rows], splats.covariances[rows], splats.rgba[rows], splats.ground[rows]
    )


def order_mesh(
    vertices: NDArray[np.float32], triangles: NDArray[Any], colours: NDArray[np.uint8]
) -> ScanMesh:
    """Return a mesh without double vertices and flat triangles, in its order, labelled 0.

    vertices: (V, 3) m. triangles: (T, 3). colours: (V, 3) sRGB.
    """
    vertices = vertices + np.float32(0.0)  # -0.0 becomes 0.0
    order = order_of(vertices, colours)
    vertices, colours = vertices[order], colours[order]
    new = np.ones(len(order), dtype=bool)
    new[1:] = (vertices[1:] != vertices[:-1]).any(axis=1) | (colours[1:] != colours[:-1]).any(
        axis=1
    )
    index = np.empty(len(order), dtype=np.int64)
    index[order] = np.cumsum(new) - 1
    held = _rotated(index[triangles])
    a, b, c = held.T
    held = held[(a != b) & (b != c) & (a != c)]
    vertices, colours = vertices[new], colours[new]
    held = held[_double_areas(vertices, held) > 0.0]
    held = held[np.lexsort(held.T[::-1])]
    first = np.ones(len(held), dtype=bool)
    first[1:] = (held[1:] != held[:-1]).any(axis=1)
    held = held[first]
    used = np.zeros(len(vertices), dtype=bool)
    used[held] = True
    held = (np.cumsum(used) - 1)[held]
    return ScanMesh(
        vertices[used],
        held.astype(np.int32),
        colours[used],
        np.zeros(len(held), dtype=np.uint8),
    )


def _rotated(triangles: NDArray[Any]) -> NDArray[Any]:
    """Return triangles that start with their lowest vertex, with the same winding."""
    start = np.argmin(triangles, axis=1)
    return np.take_along_axis(triangles, (start[:, None] + np.arange(3)) % 3, axis=1)


def _double_areas(vertices: NDArray[np.float32], triangles: NDArray[Any]) -> NDArray[np.float64]:
    a, b, c = (vertices[triangles[:, k]].astype(np.float64) for k in range(3))
    (ux, uy, uz), (vx, vy, vz) = (b - a).T, (c - a).T
    x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    return np.asarray(np.sqrt(x * x + y * y + z * z))


def _as_bytes(array: NDArray[Any]) -> NDArray[np.uint8]:
    """Return the bytes of each row, (N, B)."""
    return np.ascontiguousarray(array).view(np.uint8).reshape(len(array), -1)


def _spread(value: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Return 21 bits of each value with two zero bits between neighbours."""
    for step, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        value = (value | value << np.uint64(step)) & np.uint64(mask)
    return value
