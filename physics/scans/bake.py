"""Bake a texture to colours of vertices, after edges are split."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from physics.textures.layers import LINEAR_OF_SRGB_BYTE, linear_to_srgb

EDGE_M: Final = 0.1
"""Length in metres above which edges are split, unless there would be too many triangles."""
MAX_TRIANGLES: Final = 1_000_000
"""Number of triangles of a mesh above which edges are left longer."""
_PLACES: Final = (
    *((0.94, 0.03, 0.03), (0.7, 0.25, 0.05), (0.7, 0.05, 0.25)),
    *((0.52, 0.42, 0.06), (0.52, 0.06, 0.42), (0.44, 0.28, 0.28)),
)
"""Barycentric places at which a corner samples its texture, inside of its triangle."""
_LINEAR: Final = np.rint(LINEAR_OF_SRGB_BYTE.astype(np.float64) * 65535.0).astype(np.int64)
"""(256,) linear values of sRGB bytes in 1/65535, so that sums are exact in any order."""
_ROUNDS: Final = 16


@dataclass(frozen=True, slots=True)
class Baked:
    """A mesh with colours of vertices.

    edge_m: longest edge that was left, metres.
    """

    vertices: Floats
    triangles: NDArray[np.int64]
    colours: NDArray[np.uint8]
    edge_m: float


def bake_texture(
    vertices: Floats,
    triangles: NDArray[np.int64],
    uv: Floats,
    pixels: NDArray[np.uint8],
    unit_m: float,
) -> Baked:
    """Return a mesh whose vertices have the mean colour of the texture around them.

    Edges are left longer where the mesh would have more than MAX_TRIANGLES triangles.

    uv: (V, 2) texture coordinates, v up; they repeat outside of 0 to 1.
    pixels: (H, W, 3) uint8 sRGB.
    unit_m: metres per unit of the vertices.
    """
    edge_m = EDGE_M
    areas = _areas(vertices, triangles) * unit_m * unit_m
    while (areas / (0.25 * edge_m * edge_m)).sum() + len(triangles) > max(
        MAX_TRIANGLES, len(triangles) + 1
    ):
        edge_m *= 1.25
    joined = np.column_stack([vertices, uv])
    joined, triangles = split_edges(joined, triangles, edge_m / unit_m)
    colours = _sampled(joined[:, 3:], triangles, pixels)
    return Baked(joined[:, :3], triangles, colours, edge_m)


def split_edges(
    values: Floats, triangles: NDArray[np.int64], longest: float
) -> tuple[Floats, NDArray[np.int64]]:
    """Split edges in the middle until none is longer than `longest`; neighbours stay joined.

    values: (V, K) of the vertices, of which the first three are the place.
    Returns the values of all vertices, and the triangles.
    """
    for _ in range(_ROUNDS):
        edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]], axis=2)
        keys = edges[:, :, 0] * len(values) + edges[:, :, 1]
        unique, inverse = np.unique(keys.ravel(), return_inverse=True)
        first, second = values[unique // len(values)], values[unique % len(values)]
        x, y, z = (second - first)[:, :3].T
        split = x * x + y * y + z * z > longest * longest
        if not split.any():
            break
        middle = np.full(len(unique), -1, dtype=np.int64)
        middle[split] = len(values) + np.arange(np.count_nonzero(split))
        values = np.concatenate([values, 0.5 * (first[split] + second[split])])
        triangles = _divided(triangles, middle[inverse].reshape(-1, 3))
    return values, triangles


def _divided(triangles: NDArray[np.int64], middle: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return triangles cut at the middles of their split edges.

    middle: (T, 3) new vertices on the edges 0-1, 1-2 and 2-0, -1 where an edge is whole.
    """
    cut = middle >= 0
    count = cut.sum(axis=1)
    parts = [triangles[count == 0]]
    # Corners are rotated so that the cut edge, or the whole one, comes first.
    for number, start in ((1, np.argmax(cut, axis=1)), (2, np.argmin(cut, axis=1))):
        here = np.flatnonzero(count == number)
        turn = (start[here, None] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(triangles[here], turn, axis=1).T
        ab, bc, ca = np.take_along_axis(middle[here], turn, axis=1).T
        if number == 1:
            pieces: tuple[tuple[Any, Any, Any], ...] = ((a, ab, c), (ab, b, c))
        else:
            pieces = ((c, ca, bc), (a, b, bc), (a, bc, ca))
        parts += [np.column_stack(piece) for piece in pieces]
    here = np.flatnonzero(count == 3)
    a, b, c = triangles[here].T
    ab, bc, ca = middle[here].T
    for piece in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)):
        parts.append(np.column_stack(piece))
    return np.concatenate(parts)


def _sampled(
    uv: Floats, triangles: NDArray[np.int64], pixels: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    """Return (V, 3) sRGB means of the samples of all corners at each vertex."""
    height, width = pixels.shape[:2]
    sums = np.zeros((len(uv), 3), dtype=np.int64)
    counts = np.zeros(len(uv), dtype=np.int64)
    for corner in range(3):
        own, second, third = (triangles[:, (corner + k) % 3] for k in range(3))
        for a, b, c in _PLACES:
            at = a * uv[own] + b * uv[second] + c * uv[third]
            column = np.floor(at[:, 0] % 1.0 * width).astype(np.int64) % width
            row = np.floor((1.0 - at[:, 1]) % 1.0 * height).astype(np.int64) % height
            linear = _LINEAR[pixels[row, column]]
            for k in range(3):
                found = np.bincount(own, weights=linear[:, k], minlength=len(uv))
                sums[:, k] += found.astype(np.int64)
            counts += np.bincount(own, minlength=len(uv))
    mean = sums / (65535.0 * np.maximum(counts, 1)[:, None])
    colours: NDArray[np.uint8] = np.rint(linear_to_srgb(mean) * 255.0).astype(np.uint8)
    return colours


def _areas(vertices: Floats, triangles: NDArray[np.int64]) -> Floats:
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    (ux, uy, uz), (vx, vy, vz) = (b - a).T, (c - a).T
    x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    areas: Floats = 0.5 * np.sqrt(x * x + y * y + z * z)
    return areas
