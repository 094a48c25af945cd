"""Height grid of a scan: ground, holes and obstacles on a lattice.

The lowest surface that faces up is the candidate for the ground. A progressive morphological
filter removes what is above the surrounding ground: roofs, vehicles, tree crowns and bridges.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import MapError
from cosim.core.geometry import Floats
from cosim.place.scan import HeightGrid, ScanMesh, Splats

STEPS_M: Final = (0.1, 0.25)
"""Smallest and largest distance of lattice points, in metres."""
STANDING_M: Final = (0.2, 1.8)
"""Heights above the ground between which an obstacle blocks a lattice point, in metres."""
_MAX_POINTS: Final = 40_000_000
"""Largest number of lattice points: 600 x 600 m at 0.1 m."""
_FACING_UP: Final = 0.5
"""Least vertical component of a unit normal of ground, 60 degrees from vertical."""
_SAME_SURFACE_M: Final = 0.15
"""Height above the lowest surface up to which further surfaces count as the same, in metres."""
_PIT_M: Final = 0.4
"""Depth of a pit in metres from which it is noise below the ground."""
_PIT_WIDTH_M: Final = 1.0
"""Largest width of such a pit in metres."""
_WINDOWS_M: Final = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
"""Widths of the morphological openings in metres; the largest exceeds a house or bridge."""
_RISE_M: Final = 0.2
"""Rise in metres that belongs to the ground at any window: curbs, noise."""
_HILL: Final = 0.12
"""Grade of hills, which stay ground under large windows."""
_MAX_RISE_M: Final = 1.2
_OPAQUE: Final = 128
"""Least opacity of splats that count as a surface, of 255."""
_SPLATS: Final = 3
"""Least number of opaque splats at a lattice point without mesh."""
_SAMPLES: Final = 3
"""Least number of samples of standing surfaces that block a lattice point."""
_CHUNK: Final = 1 << 16
_BASE_M: Final = 0.5
"""Length over which slopes are measured, in metres."""


@dataclass(frozen=True, slots=True)
class Holes:
    """Closed holes of the measured ground.

    area_m2: of all of them together.
    """

    count: int
    area_m2: float


@dataclass(frozen=True, slots=True)
class _Lattice:
    """Lattice over a mesh.

    shape: rows and columns.
    """

    origin: Floats
    step_m: float
    shape: tuple[int, int]

    def index(self, xy: Floats) -> NDArray[np.int64]:
        """Return the flat index of the lattice point nearest to each (N, 2) point, (N,)."""
        at = np.rint((xy - self.origin) / self.step_m).astype(np.int64)
        column = np.clip(at[:, 0], 0, self.shape[1] - 1)
        row = np.clip(at[:, 1], 0, self.shape[0] - 1)
        return row * self.shape[1] + column


def height_grid(mesh: ScanMesh, splats: Splats | None, step_m: float) -> HeightGrid:
    """Return the ground of a scan on a lattice.

    splats: opaque ones give the ground where the mesh has none.
    step_m: distance of lattice points, 0.1 to 0.25 m.

    Raises MapError for an empty mesh, another step, or too large a scan. Equal inputs give equal
    bits.
    """
    if not STEPS_M[0] <= step_m <= STEPS_M[1]:
        raise MapError(
            f"step of the height grid: {step_m:g} m, but it must be {STEPS_M[0]:g} to "
            f"{STEPS_M[1]:g} m"
        )
    corners = _corners(mesh)
    lattice = _lattice(corners, step_m)
    point, height = _upward_hits(corners, lattice)
    if not len(point):
        raise MapError("the mesh has no ground: no triangle of it faces up: check its up axis")
    low = _lowest_surface(point, height, lattice)
    if splats is not None:
        low = np.where(np.isnan(low), _splat_ground(splats, lattice), low)
    low[_pits(low, step_m)] = np.nan
    ground = _ground_of(low, step_m)
    measured = ~np.isnan(ground)
    heights = _filled(_without_noise(ground)).astype(np.float32)
    blocked = _standing(corners, heights, lattice)
    return HeightGrid(lattice.origin, step_m, heights, measured, blocked)


def closed_holes(grid: HeightGrid) -> Holes:
    """Count the holes of the measured ground that do not reach the edge of the grid."""
    from scipy import ndimage

    labels, count = ndimage.label(~grid.measured)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    edge = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
    closed = np.setdiff1d(np.arange(1, count + 1), edge)
    return Holes(len(closed), float(sizes[closed].sum()) * grid.step_m**2)


def slope(grid: HeightGrid) -> NDArray[np.float32]:
    """Return the grade of the ground at each lattice point, (H, W), over half a metre."""
    from scipy import ndimage

    reach = max(1, round(_BASE_M / (2.0 * grid.step_m)))
    smooth = ndimage.uniform_filter(grid.heights.astype(float), 2 * reach + 1, mode="nearest")
    run_m = 2.0 * reach * grid.step_m
    rises = [
        (_shifted(smooth, reach, axis) - _shifted(smooth, -reach, axis)) / run_m for axis in (0, 1)
    ]
    return np.hypot(*rises).astype(np.float32)


def _shifted(values: Floats, by: int, axis: int) -> Floats:
    """Return values moved along an axis; the edge continues."""
    index = np.clip(np.arange(values.shape[axis]) + by, 0, values.shape[axis] - 1)
    return np.take(values, index, axis=axis)


def _corners(mesh: ScanMesh) -> Floats:
    """Return the corners of all triangles, (T, 3, 3) float64."""
    corners: Floats = mesh.vertices.astype(float)[mesh.triangles]
    if not len(corners):
        raise MapError("the mesh of the scan has no triangles: give a mesh with faces")
    return corners


def _lattice(corners: Floats, step_m: float) -> _Lattice:
    low, high = corners[..., :2].min(axis=(0, 1)), corners[..., :2].max(axis=(0, 1))
    origin = np.floor(low / step_m) * step_m
    columns, rows = (np.ceil((high - origin) / step_m).astype(int) + 1).tolist()
    if rows * columns > _MAX_POINTS:
        raise MapError(
            f"the scan is {high[0] - low[0]:.0f} x {high[1] - low[1]:.0f} m, too large for a step "
            f"of {step_m:g} m: cut it, or use a larger step"
        )
    return _Lattice(origin, step_m, (rows, columns))


def _upward_hits(
    corners: Floats, lattice: _Lattice
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the lattice points over triangles that face up, and the heights there, sorted."""
    edges = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(*edges)
    length = np.sqrt((normal * normal).sum(axis=1))
    up = corners[normal[:, 2] > _FACING_UP * np.maximum(length, 1e-12)]
    points, heights = [np.empty(0, np.int64)], [np.empty(0)]
    for part in _chunks(up):
        for point, height in _rasterised(part, lattice):
            points.append(point)
            heights.append(height)
    point, height = np.concatenate(points), np.concatenate(heights)
    order = np.lexsort((height, point))
    return point[order], height[order]


def _chunks(corners: Floats) -> Iterator[Floats]:
    return (corners[i : i + _CHUNK] for i in range(0, len(corners), _CHUNK))


def _rasterised(
    corners: Floats, lattice: _Lattice
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.float64]]]:
    """Yield the lattice points in the plan of triangles, with heights, a row of each at a time."""
    at = (corners[..., :2] - lattice.origin) / lattice.step_m
    first = np.maximum(np.ceil(at.min(axis=1) - 1e-9), 0).astype(np.int64)
    last = np.floor(at.max(axis=1) + 1e-9).astype(np.int64)
    (ax, ay), (bx, by), (cx, cy) = at[:, 0].T, at[:, 1].T, at[:, 2].T
    double = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
    z = corners[..., 2]
    rows = last[:, 1] - first[:, 1] + 1
    spans = np.maximum(last[:, 0] - first[:, 0] + 1, 0) * np.maximum(rows, 0)
    # Triangles with many points are split into blocks of bounded size.
    of_many = np.flatnonzero((spans > 0) & (double > 1e-12))
    order = of_many[np.argsort(spans[of_many], kind="stable")]
    begin = 0
    while begin < len(order):
        ends = np.cumsum(spans[order[begin:]])
        count = max(1, int(np.searchsorted(ends, 4_000_000)))
        some = order[begin : begin + count]
        begin += count
        owner = np.repeat(some, spans[some])
        offset = np.arange(len(owner)) - np.repeat(
            np.cumsum(spans[some]) - spans[some], spans[some]
        )
        width = last[owner, 0] - first[owner, 0] + 1
        column = first[owner, 0] + offset % width
        row = first[owner, 1] + offset // width
        px, py = column.astype(float), row.astype(float)
        v = ((px - ax[owner]) * (cy - ay)[owner] - (cx - ax)[owner] * (py - ay[owner])) / double[
            owner
        ]
        w = ((bx - ax)[owner] * (py - ay[owner]) - (px - ax[owner]) * (by - ay)[owner]) / double[
            owner
        ]
        inside = (v >= -1e-9) & (w >= -1e-9) & (v + w <= 1.0 + 1e-9)
        inside &= (column < lattice.shape[1]) & (row < lattice.shape[0])
        v, w, owner = v[inside], w[inside], owner[inside]
        height = z[owner, 0] + v * (z[owner, 1] - z[owner, 0]) + w * (z[owner, 2] - z[owner, 0])
        yield row[inside] * lattice.shape[1] + column[inside], height


def _lowest_surface(
    point: NDArray[np.int64], height: NDArray[np.float64], lattice: _Lattice
) -> Floats:
    """Return the median height of the lowest surface at each lattice point, NaN without one.

    point, height: sorted by point, then by height.
    """
    start = np.flatnonzero(np.diff(point, prepend=-1))
    owner = np.repeat(np.arange(len(start)), np.diff(start, append=len(point)))
    same = height <= height[start][owner] + _SAME_SURFACE_M
    counts = np.bincount(owner, weights=same, minlength=len(start)).astype(np.int64)
    low = np.full(lattice.shape, np.nan)
    low.ravel()[point[start]] = height[start + (counts - 1) // 2]
    return low


def _splat_ground(splats: Splats, lattice: _Lattice) -> Floats:
    """Return the tenth percentile of the heights of opaque splats at each lattice point."""
    opaque = np.asarray(splats.rgba[:, 3]) >= _OPAQUE
    centres = np.asarray(splats.centres)[opaque].astype(float)
    at = (centres[:, :2] - lattice.origin) / lattice.step_m
    inside = ((at > -0.5) & (at < np.array(lattice.shape[::-1]) - 0.5)).all(axis=1)
    point, height = lattice.index(centres[inside, :2]), centres[inside, 2]
    order = np.lexsort((height, point))
    point, height = point[order], height[order]
    start = np.flatnonzero(np.diff(point, prepend=-1))
    counts = np.diff(start, append=len(point))
    enough = counts >= _SPLATS
    found = np.full(lattice.shape, np.nan)
    found.ravel()[point[start[enough]]] = height[(start + counts // 10)[enough]]
    return found


def _pits(low: Floats, step_m: float) -> NDArray[np.bool_]:
    """Return which points are noise below the ground: deep, narrow pits."""
    from scipy import ndimage

    whole = np.where(np.isnan(low), -np.inf, low)
    window = _odd(_PIT_WIDTH_M / step_m)
    closed = ndimage.minimum_filter(ndimage.maximum_filter(whole, window), window)
    with np.errstate(invalid="ignore"):
        return np.asarray(closed - low > _PIT_M)


def _odd(cells: float) -> int:
    return 2 * max(1, round(cells / 2.0)) + 1


def _ground_of(low: Floats, step_m: float) -> Floats:
    """Return the surface without what is above the surrounding ground, NaN there."""
    from scipy import ndimage

    ground = low.copy()
    surface = np.where(np.isnan(low), np.inf, low)
    before_m = 0.0
    for window_m in _WINDOWS_M:
        window = _odd(window_m / step_m)
        eroded = ndimage.minimum_filter(surface, window, mode="nearest")
        opened = ndimage.maximum_filter(
            np.where(np.isinf(eroded), -np.inf, eroded), window, mode="nearest"
        )
        opened = np.where(np.isinf(opened), surface, opened)
        rise_m = min(_RISE_M + _HILL * (window_m - before_m), _MAX_RISE_M)
        with np.errstate(invalid="ignore"):
            above = surface - opened > rise_m
        ground[above] = np.nan
        surface = np.where(np.isinf(surface), surface, np.minimum(surface, opened))
        before_m = window_m
    return ground


def _without_noise(ground: Floats) -> Floats:
    """Return the ground with a median over 3 x 3 points, which preserves curbs."""
    padded = np.pad(ground, 1, constant_values=np.nan)
    rows, columns = ground.shape
    around = np.stack(
        [padded[i : i + rows, j : j + columns] for i in range(3) for j in range(3)], axis=-1
    )
    measured = ~np.isnan(ground)
    out = ground.copy()
    values = np.sort(around[measured], axis=1)  # NaN last
    counts = (~np.isnan(values)).sum(axis=1)
    every = np.arange(len(values))
    out[measured] = 0.5 * (values[every, (counts - 1) // 2] + values[every, counts // 2])
    return out


def _filled(ground: Floats) -> Floats:
    """Return the ground with holes interpolated smoothly, by averages of ever larger cells."""
    known = ~np.isnan(ground)
    if known.all():
        return ground
    coarse_shape = tuple((n + 1) // 2 for n in ground.shape)
    if max(ground.shape) > 2:
        padded = np.full((2 * coarse_shape[0], 2 * coarse_shape[1]), np.nan)
        padded[: ground.shape[0], : ground.shape[1]] = ground
        cells = np.stack([padded[i::2, j::2] for i in (0, 1) for j in (0, 1)])
        counts = (~np.isnan(cells)).sum(axis=0)
        sums = np.where(np.isnan(cells), 0.0, cells).sum(axis=0)
        coarse = _filled(np.where(counts > 0, sums / np.maximum(counts, 1), np.nan))
        rows, columns = (np.arange(n) for n in ground.shape)
        guess = coarse[rows // 2][:, columns // 2]
    else:
        guess = np.full(ground.shape, np.nanmean(ground))
    out = np.where(known, ground, guess)
    for _ in range(16):
        padded = np.pad(out, 1, mode="edge")
        mean = padded[:-2, 1:-1] + padded[2:, 1:-1] + padded[1:-1, :-2] + padded[1:-1, 2:]
        out = np.where(known, ground, 0.25 * mean)
    return out


def _standing(
    corners: Floats, heights: NDArray[np.float32], lattice: _Lattice
) -> NDArray[np.bool_]:
    """Return where surfaces of any direction are between STANDING_M above the ground."""
    counts = np.zeros(heights.size, dtype=np.int64)
    ground = heights.ravel()
    low, high = corners[..., 2].min(axis=1), corners[..., 2].max(axis=1)
    middle = ground[lattice.index(corners[..., :2].mean(axis=1))]
    # Large triangles may pass over changing ground, so the test for them has a margin.
    near = (high > middle + STANDING_M[0] - 1.0) & (low < middle + STANDING_M[1] + 1.0)
    for part in _chunks(corners[near]):
        for samples, _ in samples_of(part, 0.5 * lattice.step_m):
            point = lattice.index(samples[:, :2])
            above = samples[:, 2] - ground[point]
            standing = (above > STANDING_M[0]) & (above < STANDING_M[1])
            counts += np.bincount(point[standing], minlength=len(counts))
    return np.asarray((counts >= _SAMPLES).reshape(lattice.shape))


def samples_of(corners: Floats, step_m: float) -> Iterator[tuple[Floats, NDArray[np.int64]]]:
    """Yield points on triangles, at most `step_m` apart along their edges, (N, 3), and the index of
    the triangle of each, (N,)."""
    sides = corners - np.roll(corners, 1, axis=1)
    longest = np.sqrt((sides * sides).sum(axis=2)).max(axis=1)
    parts = np.clip(np.ceil(longest / step_m), 1, 4096).astype(np.int64)
    for count in np.unique(parts).tolist():
        owners = np.flatnonzero(parts == count)
        some = corners[owners]
        j, k = np.meshgrid(np.arange(count + 1), np.arange(count + 1), indexing="ij")
        inside = j + k <= count
        v, w = (j[inside] / count)[None, :, None], (k[inside] / count)[None, :, None]
        rows = max(1, 2_000_000 // v.size)
        for i in range(0, len(some), rows):
            a, b, c = (some[i : i + rows, None, n] for n in range(3))
            points = (a + v * (b - a) + w * (c - a)).reshape(-1, 3)
            yield points, np.repeat(owners[i : i + rows], v.size)
