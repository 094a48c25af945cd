"""Union, difference and intersection of ground, also of shapes that GEOS gives up on.

Foreign maps hold slivers, and the mitred outline of a sliver can cross itself; GEOS refuses to
overlay such shapes. What it refuses is repaired and, if need be, snapped to a grid. What it accepts
keeps its bits.
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
"""Grids that repaired shapes are snapped to, one after another."""

_NUMBER = r"-?\d+(?:\.\d+)?(?:e[-+]?\d+)?"

Shapes = NDArray[np.object_]


def union(a: Any, b: Any) -> Any:
    """The union of two shapes, or of (N,) pairs of them. Raises MapError with the place where
    nothing helps."""
    return _pairs(shapely.union, a, b)


def difference(a: Any, b: Any) -> Any:
    """Shapes without other shapes, as in `union`."""
    return _pairs(shapely.difference, a, b)


def intersection(a: Any, b: Any) -> Any:
    """What shapes have in common, as in `union`."""
    return _pairs(shapely.intersection, a, b)


def union_all(shapes: Sequence[shapely.Geometry] | Shapes) -> Polygon | MultiPolygon:
    """The union of all shapes, areas as a rule. Raises MapError with the place where nothing
    helps."""
    every = np.asarray(shapes, dtype=object)

    def whole(pieces: Shapes, grid_size: float | None = None) -> Any:
        return shapely.union_all(pieces, grid_size=grid_size)

    united: Polygon | MultiPolygon = _tried(whole, every)
    return united


def where_geos_failed(error: Exception) -> str:
    """Where GEOS failed, in words: " near (12.3, 45.6)", or nothing when it does not say."""
    found = re.search(rf"at ({_NUMBER}) ({_NUMBER})", str(error))
    return f" near ({float(found[1]):.1f}, {float(found[2]):.1f})" if found else ""


def _pairs(operation: Callable[..., Any], a: Any, b: Any) -> Any:
    try:
        return operation(a, b)
    except shapely.errors.GEOSException:
        if isinstance(a, shapely.Geometry) and isinstance(b, shapely.Geometry):
            return _tried(operation, a, b)
    one, other = np.broadcast_arrays(np.asarray(a, dtype=object), np.asarray(b, dtype=object))
    out = np.empty(one.shape, dtype=object)
    for at in np.ndindex(one.shape):
        out[at] = _tried(operation, one[at], other[at])
    return out


def _tried(operation: Callable[..., Any], *shapes: Any) -> Any:
    """The operation on the shapes as they are, else repaired, else snapped to coarser and coarser
    grids as well."""
    try:
        return operation(*shapes)
    except shapely.errors.GEOSException as error:
        refusal = error
    mended = [
        shapely.make_valid(shape, method="structure", keep_collapsed=False) for shape in shapes
    ]
    for grid_m in (None, *GRIDS_M):
        try:
            return operation(*mended, grid_size=grid_m)
        except shapely.errors.GEOSException as error:
            refusal = error
    raise MapError(
        f"the ground{where_geos_failed(refusal)} is too tangled to be put together: {refusal}"
    ) from refusal
