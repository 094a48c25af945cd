"""Distances of points to a mesh."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from cosim.place.scan import ScanMesh

_SPACING_M: Final = 0.25
"""Distance in metres of the samples of large triangles, unless there would be too many."""
_MAX_SAMPLES: Final = 2_000_000
_NEAREST: Final = 6
"""Number of samples whose triangles are measured exactly."""


class MeshDistance:
    """Finds the nearest triangle of a mesh."""

    def __init__(self, mesh: ScanMesh) -> None:
        from scipy.spatial import cKDTree  # takes 0.2 s

        self._corners = mesh.vertices.astype(np.float64)[mesh.triangles]
        self.normals = unit_normals(self._corners)
        samples, self._owner = _samples(self._corners)
        self._tree = cKDTree(samples)

    def to_mesh(self, points: NDArray[Any]) -> tuple[Floats, NDArray[np.int64]]:
        """Return the distance of (N, 3) points to the mesh in metres, and the nearest triangles."""
        points = points.astype(np.float64)
        _, near = self._tree.query(points, k=_NEAREST, workers=-1)
        owners = self._owner[np.minimum(near, len(self._owner) - 1)]
        distances = np.column_stack(
            [_to_triangles(points, self._corners[owners[:, k]]) for k in range(owners.shape[1])]
        )
        best = np.argmin(distances, axis=1)
        rows = np.arange(len(points))
        return distances[rows, best], owners[rows, best]

    def to_planes(self, points: Floats, reach_m: float) -> Floats:
        """Return the distance of points to the plane of a near triangle; infinity beyond reach.

        It is faster than `to_mesh`, and exact only near the middle of large surfaces.
        """
        gap, nearest = self._tree.query(points, distance_upper_bound=reach_m)
        found, near = np.isfinite(np.asarray(gap)), np.asarray(nearest)
        owner = self._owner[near[found]]
        x, y, z = (points[found] - self._tree.data[near[found]]).T
        a, b, c = self.normals[owner].T
        distances = np.full(len(points), np.inf)
        distances[found] = np.abs(a * x + b * y + c * z)
        return distances


def unit_normals(corners: Floats) -> Floats:
    """Return the unit normals of (T, 3, 3) triangles, (T, 3); zero for flat ones."""
    ux, uy, uz = (corners[:, 1] - corners[:, 0]).T
    vx, vy, vz = (corners[:, 2] - corners[:, 0]).T
    normals = np.column_stack([uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx])
    lengths = np.sqrt((normals * normals).sum(axis=1))
    return np.asarray(normals / np.maximum(lengths, 1e-30)[:, None])


def areas_of(corners: Floats) -> Floats:
    """Return the areas of (T, 3, 3) triangles, (T,)."""
    ux, uy, uz = (corners[:, 1] - corners[:, 0]).T
    vx, vy, vz = (corners[:, 2] - corners[:, 0]).T
    x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    areas: Floats = 0.5 * np.sqrt(x * x + y * y + z * z)
    return areas


def _samples(corners: Floats) -> tuple[Floats, NDArray[np.int64]]:
    """Return points on all triangles, and the triangle of each."""
    edges = corners - np.roll(corners, 1, axis=1)
    longest = np.sqrt((edges * edges).sum(axis=2).max(axis=1))
    spacing_m = _SPACING_M
    while (np.maximum(np.ceil(longest / spacing_m), 1.0) ** 2).sum() > max(
        _MAX_SAMPLES, 1.2 * len(corners)
    ):
        spacing_m *= 1.4
    parts = np.maximum(np.ceil(longest / spacing_m), 1.0).astype(np.int64)
    points, owners = [], []
    for count in np.unique(parts):
        here = np.flatnonzero(parts == count)
        u, v = np.meshgrid((np.arange(count) + 1 / 3) / count, (np.arange(count) + 1 / 3) / count)
        inside = (u + v) < 1.0
        for a, b in zip(u[inside], v[inside], strict=True):
            triangle = corners[here]
            points.append((1 - a - b) * triangle[:, 0] + a * triangle[:, 1] + b * triangle[:, 2])
            owners.append(here)
    return np.concatenate(points), np.concatenate(owners)


def _to_triangles(points: Floats, corners: Floats) -> Floats:
    """Return the distance of each (N, 3) point to its (N, 3, 3) triangle, (N,)."""
    a, b, c = (corners[:, k] for k in range(3))
    normal = unit_normals(corners)
    best = np.full(len(points), np.inf)
    inside = np.ones(len(points), dtype=bool)
    for start, end in ((a, b), (b, c), (c, a)):
        edge, away = end - start, points - start
        (ex, ey, ez), (px, py, pz), (nx, ny, nz) = edge.T, away.T, normal.T
        length = np.maximum(ex * ex + ey * ey + ez * ez, 1e-30)
        along = np.clip((ex * px + ey * py + ez * pz) / length, 0.0, 1.0)
        x, y, z = px - along * ex, py - along * ey, pz - along * ez
        best = np.minimum(best, x * x + y * y + z * z)
        side = (ny * ez - nz * ey) * px + (nz * ex - nx * ez) * py + (nx * ey - ny * ex) * pz
        inside &= side >= 0.0
    x, y, z = (points - a).T
    nx, ny, nz = normal.T
    return np.asarray(np.where(inside, np.abs(nx * x + ny * y + nz * z), np.sqrt(best)))
