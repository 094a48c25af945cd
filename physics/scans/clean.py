"""Remove floaters and sky from splats, and mark those of the ground."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from cosim.core.geometry import Floats
from cosim.place import overlay
from cosim.place.scan import HeightGrid, ScanArea, ScanMesh, Splats
from physics.scans.ordering import take_splats

MIN_OPACITY: Final = 0.02
"""Opacity below which a splat is removed."""
LARGEST_M: Final = 2.0
"""Standard deviation in metres above which a splat near the walkable ground is removed."""
NEAR_M: Final = 30.0
"""Distance to the walkable ground in metres within which large splats are removed."""
NEIGHBOURS: Final = 3
"""Least number of other splats within NEIGHBOUR_M."""
NEIGHBOUR_M: Final = 1.0
BELOW_M: Final = 0.3
"""Depth below the ground in metres from which a splat is removed."""
FREE_M: Final = (0.15, 2.0)
"""Heights in metres above free walkable ground between which splats are removed."""
SKY_M: Final = 300.0
"""Distance from the mesh in metres beyond which splats are sky."""
GROUND_M: Final = 0.12
"""Distance from the ground in metres up to which splats belong to it."""

RULES: Final = {
    "sky": f"over {SKY_M:g} m from the mesh: sky, which is drawn otherwise",
    "faint": f"opacity under {MIN_OPACITY:g}",
    "large": f"over {LARGEST_M:g} m in size within {NEAR_M:g} m of walkable ground",
    "alone": f"fewer than {NEIGHBOURS} neighbours within {NEIGHBOUR_M:g} m",
    "below": f"over {BELOW_M:g} m below the ground",
    "free": f"{FREE_M[0]:g} to {FREE_M[1]:g} m above free walkable ground",
}
"""Rules by which splats are removed. The first that applies counts."""


@dataclass(frozen=True, slots=True)
class Cleaned:
    """Splats that are left, and what was removed.

    counts: removed splats by rule.
    floaters: (K, 3) float32 centres of removed splats, without sky and faint ones.
    """

    splats: Splats
    counts: dict[str, int]
    floaters: NDArray[np.float32]


def clean(
    splats: Splats, mesh: ScanMesh, heights: HeightGrid, areas: Sequence[ScanArea]
) -> Cleaned:
    """Return splats without floaters and sky, with those of the ground marked.

    splats: in their order, which is preserved.
    """
    counts = {}
    floaters = [np.empty((0, 3), dtype=np.float32)]
    walkable = walkable_area(areas)
    for rule in RULES:
        removed = _removed(rule, splats, mesh, heights, walkable)
        counts[rule] = int(np.count_nonzero(removed))
        if rule not in ("sky", "faint"):
            floaters.append(splats.centres[removed])
        splats = take_splats(splats, ~removed)
    above_m, known = above_ground(heights, splats.centres)
    ground = known & (np.abs(above_m) <= GROUND_M)
    marked = Splats(splats.centres, splats.covariances, splats.rgba, ground)
    return Cleaned(marked, counts, np.concatenate(floaters))


def walkable_area(areas: Sequence[ScanArea]) -> BaseGeometry:
    """Return the union of sidewalks and crossings without obstacles."""
    walked = [area.polygon for area in areas if area.kind in ("sidewalk", "crossing")]
    obstacles = [area.polygon for area in areas if area.kind == "obstacle"]
    found: BaseGeometry = overlay.difference(
        overlay.union_all(walked), overlay.union_all(obstacles)
    )
    return found


def grid_cells(
    grid: HeightGrid, xy: NDArray[Any]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """Return rows and columns of the nearest lattice points, and whether they are on the grid."""
    at = np.rint((xy[:, :2].astype(np.float64) - grid.origin) / grid.step_m)
    rows, columns = grid.heights.shape
    inside = (at >= 0).all(axis=1) & (at[:, 0] < columns) & (at[:, 1] < rows)
    at = np.where(inside[:, None], at, 0).astype(np.int64)
    return at[:, 1], at[:, 0], inside


def above_ground(grid: HeightGrid, points: NDArray[Any]) -> tuple[Floats, NDArray[np.bool_]]:
    """Return heights of (N, 3) points above the ground in metres, and whether it is measured."""
    row, column, inside = grid_cells(grid, points)
    above = points[:, 2].astype(np.float64) - grid.heights[row, column]
    return above, inside & grid.measured[row, column]


def largest_m(splats: Splats) -> Floats:
    """Return the largest standard deviation of each splat in metres, (N,)."""
    xx, xy, xz, yy, yz, zz = splats.covariances.astype(np.float64).T
    mean = (xx + yy + zz) / 3.0
    a, b, c = xx - mean, yy - mean, zz - mean
    spread = np.sqrt((a * a + b * b + c * c + 2.0 * (xy * xy + xz * xz + yz * yz)) / 6.0)
    safe = np.maximum(spread, 1e-30)
    a, b, c = a / safe, b / safe, c / safe
    d, e, f = xy / safe, xz / safe, yz / safe
    half = 0.5 * (a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e))
    angle = np.arccos(np.clip(half, -1.0, 1.0)) / 3.0
    return np.asarray(np.sqrt(np.maximum(mean + 2.0 * spread * np.cos(angle), 0.0)))


def _removed(
    rule: str, splats: Splats, mesh: ScanMesh, heights: HeightGrid, walkable: BaseGeometry
) -> NDArray[np.bool_]:
    """Return which splats a rule removes."""
    if rule == "sky":
        low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
        far = (splats.centres < low - SKY_M) | (splats.centres > high + SKY_M)
        return np.asarray(far.any(axis=1))
    if rule == "faint":
        return np.asarray(splats.rgba[:, 3] < MIN_OPACITY * 255.0)
    if rule == "large":
        large = largest_m(splats) > LARGEST_M
        large[large] = _within(walkable, splats.centres[large], NEAR_M)
        return large
    if rule == "alone":
        return _alone(splats.centres)
    above_m, known = above_ground(heights, splats.centres)
    if rule == "below":
        return known & (above_m < -BELOW_M)
    found = known & (above_m > FREE_M[0]) & (above_m < FREE_M[1])
    found[found] = ~_near_blocked(heights, splats.centres[found])
    found[found] = _within(walkable, splats.centres[found], 0.0)
    return found


def _within(area: BaseGeometry, points: NDArray[np.float32], reach_m: float) -> NDArray[np.bool_]:
    """Return which points are in an area, or within a distance of it."""
    if reach_m:
        area = shapely.buffer(area, reach_m, quad_segs=8)
    shapely.prepare(area)
    return shapely.contains_xy(area, points[:, 0].astype(float), points[:, 1].astype(float))


def _near_blocked(grid: HeightGrid, points: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return which points are at, or next to, a lattice point with an obstacle."""
    from scipy.ndimage import binary_dilation

    around = max(1, round(0.25 / grid.step_m))
    blocked = binary_dilation(grid.blocked, np.ones((3, 3), dtype=bool), iterations=around)
    row, column, inside = grid_cells(grid, points)
    return inside & blocked[row, column]


def _alone(centres: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return which splats have too few neighbours."""
    from scipy.spatial import cKDTree

    if not len(centres):
        return np.zeros(0, dtype=bool)
    # Points in a cube of half a metre are neighbours; only the others are queried.
    cells = np.floor(centres.astype(np.float64) / (0.5 * NEIGHBOUR_M)).astype(np.int64)
    cells -= cells.min(axis=0)
    size = cells.max(axis=0) + 1
    keys = (cells[:, 0] * size[1] + cells[:, 1]) * size[2] + cells[:, 2]
    _, inverse, counts = np.unique(keys, return_inverse=True, return_counts=True)
    alone = counts[inverse] <= NEIGHBOURS
    if alone.any():
        found, _ = cKDTree(centres).query(
            centres[alone], k=NEIGHBOURS + 1, distance_upper_bound=NEIGHBOUR_M, workers=-1
        )
        alone[alone] = ~np.isfinite(np.asarray(found)[:, -1])
    return alone
