"""Frame: from a file's unit and axes to the net's frame, in float64.

The net's frame: metres, x east, y north, z up, with its origin near the scan.
No matrix products of numpy are used: their rounding depends on the machine.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

import msgspec
import numpy as np
import pyproj
from numpy.typing import NDArray

from cosim.core.errors import MapError
from cosim.core.geometry import Floats
from cosim.place.scan import Georeference, Splats
from physics.scans.read_splats import RawSplats

Matrix = tuple[tuple[float, ...], ...]
"""4 x 4 matrix by rows, for column vectors x, y, z, 1."""

UP_AXES: Final[dict[str, Matrix]] = {
    "+z": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "-z": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    "+y": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "-y": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "+x": ((0, 1, 0), (0, 0, 1), (1, 0, 0)),
    "-x": ((0, 1, 0), (0, 0, -1), (-1, 0, 0)),
}
"""Rotation that turns each axis up."""
FAR_M: Final = 2000.0
"""Distance of a scan from its origin beyond which it gets a local origin: float32 keeps 0.1 mm."""
_SHEAR: Final = 0.01
"""Largest difference of a transform from a similarity, as a share of its scale."""
_LAST: Final = (0.0, 0.0, 0.0, 1.0)
_PROBE_M: Final = 100.0
"""Distance over which the direction of north is measured in a coordinate system."""


class Placing(msgspec.Struct, frozen=True, kw_only=True):
    """Place of a scan on earth: of its origin in degrees, or of its coordinates in a system.

    heading_deg: compass heading of +y of the scan, clockwise from north; 0 is assumed if None.
    crs: name for pyproj, such as "EPSG:25833". Coordinates plus `offset` are metres in it.
    """

    latitude_deg: float | None = None
    longitude_deg: float | None = None
    heading_deg: float | None = None
    crs: str = ""
    offset: tuple[float, float] = (0.0, 0.0)


def file_matrix(scale: float, up: str, transform: Sequence[Sequence[float]] | None) -> Matrix:
    """Return the matrix from a file's coordinates to metres with z up.

    transform: replaces scale and up, if given.
    Raises MapError for a transform that mirrors, shears, or is no 4 x 4 matrix.
    """
    if transform is None:
        rows = [(*(scale * one for one in row), 0.0) for row in UP_AXES[up]]
        return (*rows, (0.0, 0.0, 0.0, 1.0))
    check_similarity(transform)
    return tuple(tuple(float(one) for one in row) for row in transform)


def check_similarity(transform: Sequence[Sequence[float]]) -> None:
    """Check that a matrix is a rotation, a scale and a translation. Raises MapError."""
    if [len(row) for row in transform] != [4, 4, 4, 4] or not all(
        math.isfinite(one) for row in transform for one in row
    ):
        raise MapError("transform: must be 4 rows of 4 finite numbers")
    if max(abs(a - b) for a, b in zip(transform[3], (0, 0, 0, 1), strict=True)) > 1e-9:
        raise MapError(
            f"transform: its last row is {list(transform[3])} and must be [0, 0, 0, 1]: give it "
            "by rows, for column vectors (transposed?)"
        )
    determinant = _determinant(transform)
    size = abs(determinant) ** (1.0 / 3.0)
    if size < 1e-9:
        raise MapError(f"transform: its determinant is {determinant:.3g}: it flattens the scan")
    if determinant < 0.0:
        raise MapError(
            f"transform: it mirrors: its determinant is {determinant:.4g}, and must be positive: "
            "negate one of its first three columns"
        )
    for i in range(3):
        for j in range(i, 3):
            dot = sum(transform[k][i] * transform[k][j] for k in range(3)) / size**2
            if abs(dot - (i == j)) > _SHEAR:
                raise MapError(
                    f"transform: its columns {i + 1} and {j + 1} have the product {dot:.3f} in "
                    f"place of {int(i == j)}: it shears or stretches; give a rotation with one "
                    "scale"
                )


def scale_of(matrix: Sequence[Sequence[float]]) -> float:
    """Return the metres per unit of a matrix."""
    return float(abs(_determinant(matrix)) ** (1.0 / 3.0))


def levelling(normal: Floats) -> Matrix:
    """Return the shortest rotation that turns a unit normal up."""
    x, y, z = (float(one) for one in normal)
    if z < -1.0 + 1e-9:
        return (1.0, 0.0, 0.0, 0.0), (0.0, -1.0, 0.0, 0.0), (0.0, 0.0, -1.0, 0.0), _LAST
    k = 1.0 / (1.0 + z)
    first = 1.0 - k * x * x, -k * x * y, -x, 0.0
    second = -k * x * y, 1.0 - k * y * y, -y, 0.0
    return first, second, (x, y, z, 0.0), _LAST


def unplaced(direction: Floats, placing: Matrix) -> Floats:
    """Return a direction of the net's frame before a placing, which turns and shifts."""
    return np.array([sum(placing[i][k] * direction[i] for i in range(3)) for k in range(3)])


def combine(second: Matrix, first: Matrix) -> Matrix:
    """Return the matrix that applies `first`, then `second`."""
    return tuple(
        tuple(math.fsum(second[i][k] * first[k][j] for k in range(4)) for j in range(4))
        for i in range(4)
    )


def move(points: NDArray[Any], matrix: Matrix) -> Floats:
    """Return (N, 3) points after a matrix, float64."""
    x, y, z = (points[:, k].astype(np.float64) for k in range(3))
    return np.column_stack([a * x + b * y + c * z + d for a, b, c, d in matrix[:3]])


def move_splats(raw: RawSplats, matrix: Matrix) -> Splats:
    """Return splats after a matrix, in the order of the file, none marked as ground."""
    w, x, y, z = raw.quaternions.T
    turn = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    axes = [
        [
            (matrix[i][0] * turn[0][k] + matrix[i][1] * turn[1][k] + matrix[i][2] * turn[2][k])
            * raw.scales[:, k]
            for k in range(3)
        ]
        for i in range(3)
    ]
    covariances = [
        axes[i][0] * axes[j][0] + axes[i][1] * axes[j][1] + axes[i][2] * axes[j][2]
        for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
    ]
    return Splats(
        move(raw.centres, matrix).astype(np.float32),
        np.column_stack(covariances).astype(np.float32),
        raw.rgba,
        np.zeros(len(raw), dtype=bool),
    )


def place(low: Floats, high: Floats, placing: Placing | None) -> tuple[Matrix, Georeference | None]:
    """Return the matrix from metres with z up to the net's frame, and the place of its origin.

    low, high: (3,) bounds of the scan in metres, z up.
    Raises MapError for coordinates outside of their system, or an unknown system.
    """
    origin = local_origin(low, high)
    if placing is None:
        return shift(-origin), None
    if not placing.crs:
        if placing.latitude_deg is None or placing.longitude_deg is None:
            raise MapError(
                "georeference: give latitude_deg and longitude_deg of the origin, or crs"
            )
        there = Georeference(latitude_deg=placing.latitude_deg, longitude_deg=placing.longitude_deg)
        turned = _to_north(placing.heading_deg or 0.0)
        if np.any(origin[:2]):
            ((east, north, _),) = move(origin[None], turned).tolist()
            lon, lat = _local(there)(east, north, inverse=True)
            there = Georeference(latitude_deg=lat, longitude_deg=lon)
        return combine(turned, shift(-origin)), there
    if placing.heading_deg is not None:
        raise MapError(
            f"georeference: heading_deg is {placing.heading_deg:g}, but {placing.crs} has its own "
            "north: leave it out, or give latitude and longitude in place of crs"
        )
    return _place_in_system(low, high, placing)


def _to_north(heading_deg: float) -> Matrix:
    """Return the matrix that turns +y from a compass heading to north. Raises MapError."""
    if not -360.0 <= heading_deg <= 360.0:
        raise MapError(
            f"georeference: heading_deg is {heading_deg:g}, but must be -360 to 360: the compass "
            "heading of +y of the scan, in degrees clockwise from north"
        )
    a, b = math.cos(math.radians(heading_deg)), math.sin(math.radians(heading_deg))
    return (a, b, 0.0, 0.0), (-b, a, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0)


def local_origin(low: Floats, high: Floats) -> Floats:
    """Return the origin of a local frame, whole metres; zero if the scan is near its own origin."""
    if max(np.abs(low).max(), np.abs(high).max()) <= FAR_M:
        return np.zeros(3)
    return np.array([*np.rint((low[:2] + high[:2]) / 2.0), np.floor(low[2])])


def shift(offset: Floats) -> Matrix:
    """Return the matrix of a translation, metres."""
    x, y, z = (float(one) for one in offset)
    return (1.0, 0.0, 0.0, x), (0.0, 1.0, 0.0, y), (0.0, 0.0, 1.0, z), (0.0, 0.0, 0.0, 1.0)


def _place_in_system(
    low: Floats, high: Floats, placing: Placing
) -> tuple[Matrix, Georeference | None]:
    try:
        system = pyproj.CRS.from_user_input(placing.crs)
        unit_m = system.axis_info[0].unit_conversion_factor
        to_degrees = pyproj.Transformer.from_crs(system, "EPSG:4326", always_xy=True)
    except (pyproj.exceptions.ProjError, IndexError) as error:
        raise MapError(
            f"georeference: '{placing.crs}' is no coordinate system: give one such as "
            "EPSG:25833, or latitude and longitude"
        ) from error
    if not system.is_projected:
        raise MapError(
            f"georeference: '{placing.crs}' is in degrees: give a projected system such as "
            "EPSG:25833, or latitude and longitude of the origin"
        )
    origin = local_origin(low, high)
    east, north = (float(origin[k]) + placing.offset[k] for k in range(2))
    lon, lat = to_degrees.transform(east / unit_m, north / unit_m)
    if not (math.isfinite(lon) and math.isfinite(lat)):
        raise MapError(
            f"georeference: ({east:.0f}, {north:.0f}) m is outside of {placing.crs}: check the "
            "system and its offset"
        )
    there = Georeference(latitude_deg=lat, longitude_deg=lon)
    local = _local(there)

    def displaced(x: float, y: float) -> tuple[float, float]:
        found = to_degrees.transform((east + x) / unit_m, (north + y) / unit_m)
        return local(*found)

    (xx, xy), (yx, yy) = displaced(_PROBE_M, 0.0), displaced(0.0, _PROBE_M)
    a, b = (xx + yy) / (2.0 * _PROBE_M), (xy - yx) / (2.0 * _PROBE_M)
    turned = (a, -b, 0.0, 0.0), (b, a, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0)
    return combine(turned, shift(-origin)), there


def _local(there: Georeference) -> pyproj.Proj:
    """Return the projection of the net's frame around a place."""
    return pyproj.Proj(
        proj="tmerc", lat_0=there.latitude_deg, lon_0=there.longitude_deg, ellps="WGS84", k=1
    )


def _determinant(m: Sequence[Sequence[float]]) -> float:
    return (
        m[0][0] * (m[1][1] * m[2][2] - m[1][2] * m[2][1])
        - m[0][1] * (m[1][0] * m[2][2] - m[1][2] * m[2][0])
        + m[0][2] * (m[1][0] * m[2][1] - m[1][1] * m[2][0])
    )
