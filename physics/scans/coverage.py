"""Coverage of views by splats: the share below the horizon that is opaque."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from cosim.core.geometry import Floats
from cosim.place.scan import HeightGrid, Splats
from physics.scans.check import MIN_COVERED, lattice_points
from physics.scans.clean import above_ground
from physics.scans.findings import Finding, note, warning

EYE_M: Final = 0.6
"""Height of the eye over the ground in metres."""
VIEWS: Final = 12
"""Number of views."""
OPAQUE: Final = 0.95
"""Opacity from which a direction is covered."""
_PIXEL_RAD: Final = np.pi / 90.0
_COLUMNS: Final = 180
_ROWS: Final = 15
"""Size of a panorama: all around, and 30 degrees down from the horizon."""
_FIRST_ROW: Final = 1
"""First row that counts: ground 2 degrees below the horizon is 17 m away."""
_REACH_M: Final = 60.0
_RADII_PX: Final = (1, 2, 4, 8, 16)
"""Radii of the windows in which splats are drawn; larger ones are cut off."""
_SOFTNESS: Final = 0.1
"""Variance in square pixels that is added, so that small splats are not lost between pixels."""


def view_points(walkable: BaseGeometry, heights: HeightGrid, most: int = VIEWS) -> Floats:
    """Return eyes spread over the walkable area, (K, 3) m."""
    points = lattice_points(walkable, 0.5)
    if not len(points):
        return np.empty((0, 3))
    order = np.lexsort((points[:, 0], points[:, 1]))
    picks = np.unique(np.linspace(0, len(points) - 1, 2 * most + 1).astype(int)[1::2])
    chosen = points[order[picks]]
    ground, _ = above_ground(heights, np.column_stack([chosen, np.zeros(len(chosen))]))
    return np.column_stack([chosen, EYE_M - ground])


def coverage(splats: Splats, eyes: Floats) -> Floats:
    """Return the covered share of the view below the horizon from each of (K, 3) eyes."""
    panoramas = (_panorama(splats, eye)[_FIRST_ROW:] for eye in eyes)
    return np.array([float((found > OPAQUE).mean()) for found in panoramas])


def check_coverage(splats: Splats, eyes: Floats) -> list[Finding]:
    """Check that views from the walkable area are covered by splats."""
    if not len(eyes):
        return []
    shares = coverage(splats, eyes)
    mean, worst = float(shares.mean()), int(np.argmin(shares))
    words = (
        f"coverage: {mean:.0%} of the view below the horizon is opaque, {shares[worst]:.0%} at "
        f"({eyes[worst, 0]:.0f}, {eyes[worst, 1]:.0f})"
    )
    if mean >= MIN_COVERED:
        return [note(words)]
    return [
        warning(
            f"{words}; {MIN_COVERED:.0%} should be: pictures show holes; run with --appearance "
            "mesh, or train with closed ground"
        )
    ]


def _panorama(splats: Splats, eye: Floats) -> Floats:
    """Return the opacity of all splats together in each direction, (rows, columns)."""
    offset = splats.centres.astype(np.float64) - eye
    x, y, z = offset.T
    flat = np.sqrt(x * x + y * y)
    distance = np.sqrt(flat * flat + z * z)
    size = np.sqrt(splats.covariances[:, [0, 3, 5]].max(axis=1)) * 3.0
    seen = (distance < _REACH_M) & (flat > 0.1) & (z - size < 0.0)
    seen &= z + size > -np.tan(_ROWS * _PIXEL_RAD) * flat
    x, y, z, flat, distance = (one[seen] for one in (x, y, z, flat, distance))
    column = np.arctan2(y, x) / _PIXEL_RAD
    row = -np.arctan2(z, flat) / _PIXEL_RAD
    across = np.column_stack([-y / flat, x / flat, np.zeros(len(x))])
    down = np.column_stack([x * z / flat, y * z / flat, -flat]) / distance[:, None]
    covariances = splats.covariances[seen].astype(np.float64)
    scale = 1.0 / (distance * _PIXEL_RAD) ** 2
    cc = _quadratic(covariances, across, across) * scale * (distance / flat) ** 2 + _SOFTNESS
    cr = _quadratic(covariances, across, down) * scale * (distance / flat)
    rr = _quadratic(covariances, down, down) * scale + _SOFTNESS
    opacity = splats.rgba[seen, 3] / 255.0
    logs = np.zeros(_ROWS * _COLUMNS)
    radius = 2.5 * np.sqrt(np.maximum(cc, rr))
    level = np.minimum(np.searchsorted(_RADII_PX, radius), len(_RADII_PX) - 1)
    for k, reach in enumerate(_RADII_PX):
        here = np.flatnonzero(level == k)
        for i in range(0, len(here), 50_000 // reach):
            some = here[i : i + 50_000 // reach]
            _add(
                logs, reach, column[some], row[some], (cc[some], cr[some], rr[some]), opacity[some]
            )
    return np.asarray(1.0 - np.exp(logs)).reshape(_ROWS, _COLUMNS)


def _add(
    logs: Floats,
    reach: int,
    column: Floats,
    row: Floats,
    covariance: tuple[Any, ...],
    opacity: Floats,
) -> None:
    """Add the logarithms of the transparencies of splats to their pixels."""
    cc, cr, rr = (one[:, None, None] for one in covariance)
    steps = np.arange(-reach, reach + 1)
    at_row = np.floor(row).astype(np.int64)[:, None, None] + steps[:, None]
    at_column = np.floor(column).astype(np.int64)[:, None, None] + steps[None, :]
    dx, dy = at_column + 0.5 - column[:, None, None], at_row + 0.5 - row[:, None, None]
    determinant = np.maximum(cc * rr - cr * cr, 1e-9)
    power = (rr * dx * dx - 2.0 * cr * dx * dy + cc * dy * dy) / determinant
    alpha = np.minimum(opacity[:, None, None] * np.exp(-0.5 * power), 0.999)
    at_row, at_column = np.broadcast_arrays(at_row, at_column % _COLUMNS)
    inside = (at_row >= 0) & (at_row < _ROWS) & (alpha > 1.0 / 255.0)
    pixel = at_row[inside] * _COLUMNS + at_column[inside]
    logs += np.bincount(pixel, weights=np.log1p(-alpha[inside]), minlength=len(logs))


def _quadratic(covariances: Floats, a: Floats, b: Floats) -> NDArray[np.float64]:
    """Return a C b for each symmetric matrix, (N,)."""
    xx, xy, xz, yy, yz, zz = covariances.T
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    return np.asarray(
        xx * ax * bx
        + yy * ay * by
        + zz * az * bz
        + xy * (ax * by + ay * bx)
        + xz * (ax * bz + az * bx)
        + yz * (ay * bz + az * by)
    )
