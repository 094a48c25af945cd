"""Labels of a scan's triangles: ground by the drawn areas, the rest by its height."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import shapely
from numpy.typing import NDArray

from cosim.core.state import LABELS
from cosim.place.scan import AreaKind, HeightGrid, ScanArea, ScanMesh
from physics.scans.clean import grid_cells
from physics.scans.mesh_distance import unit_normals

_ON_GROUND_M: Final = 0.2
"""Height over the ground in metres up to which triangles that face up belong to it."""
_BUILDING_M: Final = 2.5
"""Height of the highest triangle in a column above which the column is a building."""
_COLUMN_M: Final = 1.0
_LABEL_OF: Final[dict[AreaKind, str]] = {
    "verge": "verge",
    "road": "road",
    "sidewalk": "sidewalk",
    "crossing": "crosswalk",
}
"""Labels of areas; later ones cover earlier ones."""


def label_mesh(mesh: ScanMesh, heights: HeightGrid, areas: Sequence[ScanArea]) -> ScanMesh:
    """Return a mesh with labels.

    Ground has the label of its area, "ground" outside of all. What stands on it is a building
    where it is higher than 2.5 m, else a prop.
    """
    corners = mesh.vertices.astype(np.float64)[mesh.triangles]
    middle = corners.mean(axis=1)
    row, column, inside = grid_cells(heights, middle)
    above = middle[:, 2] - heights.heights[row, column]
    ground = (np.abs(above) < _ON_GROUND_M) & (np.abs(unit_normals(corners)[:, 2]) > 0.5) & inside
    top = corners[:, :, 2].max(axis=1) - heights.heights[row, column]
    labels = np.where(_columns_high(middle, top), LABELS["building"], LABELS["prop"])
    labels[ground] = _ground_labels(middle[ground], areas)
    return ScanMesh(mesh.vertices, mesh.triangles, mesh.colours, labels.astype(np.uint8))


def _columns_high(middle: NDArray[np.float64], top: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which triangles are in a column of a square metre that reaches high."""
    cells = np.floor(middle[:, :2] / _COLUMN_M).astype(np.int64)
    cells -= cells.min(axis=0)
    keys = cells[:, 0] * (cells[:, 1].max() + 1) + cells[:, 1]
    unique, inverse = np.unique(keys, return_inverse=True)
    highest = np.full(len(unique), -np.inf)
    np.maximum.at(highest, inverse, top)
    return np.asarray(highest[inverse] > _BUILDING_M)


def _ground_labels(points: NDArray[np.float64], areas: Sequence[ScanArea]) -> NDArray[np.int64]:
    labels = np.full(len(points), LABELS["ground"], dtype=np.int64)
    for kind, label in _LABEL_OF.items():
        shape = shapely.union_all([area.polygon for area in areas if area.kind == kind])
        if not shape.is_empty:
            shapely.prepare(shape)
            labels[shapely.contains_xy(shape, points[:, 0], points[:, 1])] = LABELS[label]
    return labels
