"""Ground behind walls: where a scan shows the backs of surfaces and not their fronts.

A scan has the fronts of surfaces towards the side from which it was taken. Ground that is drawn
behind them, such as behind house fronts, was not walked.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from cosim.place.scan import HeightGrid, ScanMesh
from physics.scans.ground import STANDING_M, samples_of
from physics.scans.mesh_distance import unit_normals

_DIRECTIONS: Final = ((0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1), (-1, 0), (-1, 1))
"""Steps by row and column in which the nearest wall is searched."""
_UPRIGHT: Final = 0.5
"""Largest vertical component of a unit normal of a wall."""
_FACING: Final = 0.3
"""Least cosine between a wall's normal and a direction in which its front or back is seen."""
_AGREEING: Final = 0.6
"""Least length of the mean of the unit normals at a lattice point; walls with two fronts have
less."""
_BACKS: Final = 3
"""Least number of directions in which ground behind walls shows backs."""


def behind_walls(mesh: ScanMesh, grid: HeightGrid) -> NDArray[np.bool_]:
    """Return which lattice points are behind walls, (H, W).

    There, the nearest walls in eight directions show their backs in at least three, and in twice as
    many as their fronts.
    """
    normals = _wall_normals(mesh, grid)
    backs, fronts = (np.zeros(grid.blocked.shape, dtype=np.int8) for _ in range(2))
    for step in _DIRECTIONS:
        facing = _nearest(grid.blocked, normals, step)
        backs += facing > _FACING
        fronts += facing < -_FACING
    return (backs >= _BACKS) & (backs >= 2 * fronts)


def _wall_normals(mesh: ScanMesh, grid: HeightGrid) -> Floats:
    """Return the mean horizontal normal of the walls at each lattice point, (2, H, W); 0 where
    there are none or they disagree."""
    corners = mesh.vertices.astype(np.float64)[mesh.triangles]
    normals = unit_normals(corners)
    ground = grid.heights.ravel().astype(np.float64)
    rows, columns = grid.heights.shape
    low, high = corners[..., 2].min(axis=1), corners[..., 2].max(axis=1)
    upright = np.abs(normals[:, 2]) < _UPRIGHT
    upright &= (high > ground.min() + STANDING_M[0]) & (low < ground.max() + STANDING_M[1])
    indices, walls = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    for points, owners in samples_of(corners[upright], grid.step_m):
        at = np.rint((points[:, :2] - grid.origin) / grid.step_m).astype(np.int64)
        index = np.clip(at[:, 1], 0, rows - 1) * columns + np.clip(at[:, 0], 0, columns - 1)
        above = points[:, 2] - ground[index]
        standing = (above > STANDING_M[0]) & (above < STANDING_M[1])
        indices.append(index[standing])
        walls.append(owners[standing])
    index, turned = np.concatenate(indices), normals[upright][np.concatenate(walls)]
    counts = np.maximum(np.bincount(index, minlength=ground.size), 1)
    mean = np.stack(
        [np.bincount(index, turned[:, axis], minlength=ground.size) / counts for axis in (1, 0)]
    )
    mean[:, np.hypot(*mean) < _AGREEING] = 0.0
    return mean.reshape(2, rows, columns)


def _nearest(blocked: NDArray[np.bool_], normals: Floats, step: tuple[int, int]) -> Floats:
    """Return the cosine between a direction and the normal of the nearest blocked point in it.

    It is positive where the back is seen, and 0 where nothing is blocked up to the edge.
    """
    length = float(np.hypot(*step))
    here = (normals[0] * step[0] + normals[1] * step[1]) / length
    found = np.zeros(blocked.shape)
    rows, columns = blocked.shape
    # Sweeps go against the direction, so that the neighbour in it is known already.
    if step[0]:
        for row in range(rows)[:: -step[0]]:
            ahead = row + step[0]
            if 0 <= ahead < rows:
                known = np.where(blocked[ahead], here[ahead], found[ahead])
                found[row] = _moved(known, step[1])
        return found
    for column in range(columns)[:: -step[1]]:
        ahead = column + step[1]
        if 0 <= ahead < columns:
            found[:, column] = np.where(blocked[:, ahead], here[:, ahead], found[:, ahead])
    return found


def _moved(values: Floats, by: int) -> Floats:
    """Return values whose index is greater by `by`, 0 beyond the edge."""
    moved = np.zeros_like(values)
    if by > 0:
        moved[:-by] = values[by:]
    elif by < 0:
        moved[-by:] = values[:by]
    else:
        moved[:] = values
    return moved
