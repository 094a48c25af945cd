"""Robust union, difference and intersection of areas.

Imported maps contain slivers whose outlines GEOS refuses. Such shapes are repaired and, if needed,
snapped to a grid. Results for valid shapes are those of GEOS, bit for bit.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import MultiPolygon, Polygon

from cosim.core.errors import MapError

GRIDS_M = (1e-6, 1e-3, 1e-2)
"""Grids that repaired shapes are snapped to, in metres, tried in this order."""

_NUMBER = r"-?\d+(?:\.\d+)?(?:e[-+]?\d+)?"
"""Regular expression of a number in a GEOS message."""

Shapes = NDArray[np.object_]


def union(a: Any, b: Any) -> Any:
    """Return the union of two shapes, or of (N,) pairs. Raises MapError with the place."""
    return _elementwise(shapely.union, a, b)


def difference(a: Any, b: Any) -> Any:
    """Return the first shapes without the second ones, as in `union`."""
    return _elementwise(shapely.difference, a, b)


def intersection(a: Any, b: Any) -> Any:
    """Return the intersection of shapes, as in `union`."""
    return _elementwise(shapely.intersection, a, b)


def union_all(shapes: Sequence[shapely.Geometry] | Shapes) -> Polygon | MultiPolygon:
    """Return the union of many areas. Raises MapError with the place."""
    every = np.asarray(shapes, dtype=object)

    def whole(pieces: Shapes, grid_size: float | None = None) -> Any:
        return shapely.union_all(pieces, grid_size=grid_size)

    united: Polygon | MultiPolygon = _robust(whole, every)
    return united


def grown(shape: Any, by_m: float) -> Any:
    """Return a shape grown by a positive distance.

    GEOS loses holes of some large shapes; these are grown side by side.
    """
    whole: Any = shapely.buffer(shape, by_m, quad_segs=4)
    if whole.is_valid and whole.area >= shape.area:
        return whole
    rings = [shapely.get_coordinates(ring) for ring in shapely.get_parts(shape.boundary)]
    sides = np.concatenate([np.stack([ring[:-1], ring[1:]], axis=1) for ring in rings])
    around = np.asarray(shapely.buffer(shapely.linestrings(sides), by_m, quad_segs=4))
    return union_all([shape, *around])


def where_geos_failed(error: Exception) -> str:
    """Return the place in a GEOS error as text, such as " near (12.3, 45.6)", or ""."""
    found = re.search(rf"at ({_NUMBER}) ({_NUMBER})", str(error))
    return f" near ({float(found[1]):.1f}, {float(found[2]):.1f})" if found else ""


def _elementwise(operation: Callable[..., Any], a: Any, b: Any) -> Any:
    try:
        return operation(a, b)
    except shapely.errors.GEOSException:
        if isinstance(a, shapely.Geometry) and isinstance(b, shapely.Geometry):
            return _robust(operation, a, b)
    one, other = np.broadcast_arrays(np.asarray(a, dtype=object), np.asarray(b, dtype=object))
    out = np.empty(one.shape, dtype=object)
    for at in np.ndindex(one.shape):
        out[at] = _robust(operation, one[at], other[at])
    return out


def _robust(operation: Callable[..., Any], *shapes: Any) -> Any:
    """Apply an operation to the shapes; on failure to repaired ones, then to ones snapped to a
    grid."""
    try:
        return operation(*shapes)
    except shapely.errors.GEOSException as error:
        refusal = error
    repaired = [
        shapely.make_valid(shape, method="structure", keep_collapsed=False) for shape in shapes
    ]
    for grid_m in (None, *GRIDS_M):
        try:
            return operation(*repaired, grid_size=grid_m)
        except shapely.errors.GEOSException as error:
            refusal = error
    raise MapError(
        f"the ground{where_geos_failed(refusal)} is too tangled to be put together: {refusal}"
    ) from refusal
