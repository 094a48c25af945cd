"""Picture of a scan from above: its colours, areas, blocked ground, holes, floaters, coverage."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from cosim.place.scan import AREA_KINDS, AreaKind, HeightGrid, Scan, ScanMesh
from cosim.report.above import PX_PER_M, TRACK, USUAL_PX, Bounds, Sheet
from cosim.report.legend import Image, Rgb255, legend
from cosim.report.mapsheet import draw_scale_bar

_MARGIN_M: Final = 3.0
_AREAS: Final[dict[AreaKind, Rgb255]] = {
    "sidewalk": (30, 90, 230),
    "crossing": (240, 200, 0),
    "road": (90, 90, 90),
    "verge": (40, 150, 60),
    "obstacle": (120, 60, 20),
}
_BLOCKED: Final[Rgb255] = (210, 30, 30)
_HOLE: Final[Rgb255] = (200, 60, 200)
_FLOATER: Final[Rgb255] = (255, 140, 0)
_COVERED: Final[Rgb255] = (0, 150, 90)
_TINT: Final = 0.5
_MAX_FLOATERS: Final = 20_000
_RASTER_M: Final = 0.2
"""Side of a pixel of the scan's colours in metres."""


def draw_scan(scan: Scan, eyes: Floats, shares: Floats) -> Image:
    """Draw a scan: (H, W, 3) uint8 RGB.

    eyes: (K, 3) places of views, m.
    shares: (K,) covered share of each view.
    """
    bounds = _bounds(scan)
    size_m = max(bounds[2] - bounds[0], bounds[3] - bounds[1])
    sheet = Sheet(bounds, max(PX_PER_M, USUAL_PX / size_m))
    _draw_colours(sheet, scan.mesh, bounds)
    walkable = [a.polygon for a in scan.areas if a.kind in ("sidewalk", "crossing")]
    _tint(sheet, scan.heights, scan.heights.blocked, _BLOCKED, bounds)
    hole = ~scan.heights.measured & ~scan.heights.blocked
    _tint(sheet, scan.heights, hole & _inside(scan.heights, walkable), _HOLE, bounds)
    for area in scan.areas:
        for ring in (area.polygon.exterior, *area.polygon.interiors):
            sheet.line(np.array(ring.coords)[:, :2], _AREAS[area.kind], 0.25)
    floaters = np.empty((0, 3)) if scan.floaters is None else np.asarray(scan.floaters)
    for x, y in sheet.px(floaters[:_MAX_FLOATERS, :2].astype(float)) // 16:
        cv2.circle(sheet.image, (int(x), int(y)), 1, _FLOATER, -1)
    for eye, share in zip(eyes, shares, strict=True):
        sheet.dot(eye[None, :2], _COVERED, 0.4)
        sheet.text(eye[:2].tolist(), f"{share:.0%}", _COVERED, 0.5, 0.45)
    draw_scale_bar(sheet, bounds)
    return legend(sheet.image, _legend(scan, len(floaters), shares))


def _legend(scan: Scan, floaters: int, shares: Floats) -> list[tuple[str, Rgb255]]:
    walkable_m2 = sum(a.polygon.area for a in scan.areas if a.kind in ("sidewalk", "crossing"))
    splats = 0 if scan.splats is None else len(scan.splats)
    words = (
        f"{scan.facts.name}  {len(scan.mesh.triangles)} triangles, {splats} splats, "
        f"{walkable_m2:.0f} m2 walkable"
    )
    kinds = [kind for kind in AREA_KINDS if any(area.kind == kind for area in scan.areas)]
    rows = [(words, TRACK), *((kind, _AREAS[kind]) for kind in kinds)]
    rows += [("blocked, 0.2 to 1.8 m above the ground", _BLOCKED)]
    rows += [("walkable without measured ground", _HOLE)]
    if splats:
        rows += [(f"{floaters} floaters that were removed", _FLOATER)]
    if len(shares):
        rows += [("opaque share of the view below the horizon", _COVERED)]
    return rows


def _bounds(scan: Scan) -> Bounds:
    """Return the bounds of the areas and of most of the mesh, with a margin."""
    low, high = np.percentile(scan.mesh.vertices[:, :2], [0.5, 99.5], axis=0)
    for area in scan.areas:
        x0, y0, x1, y1 = area.polygon.bounds
        low, high = np.minimum(low, [x0, y0]), np.maximum(high, [x1, y1])
    (x0, y0), (x1, y1) = (low - _MARGIN_M).tolist(), (high + _MARGIN_M).tolist()
    return x0, y0, x1, y1


def _draw_colours(sheet: Sheet, mesh: ScanMesh, bounds: Bounds) -> None:
    """Draw the highest vertex of each cell in its colour; empty cells next to others are filled."""
    x0, y0, x1, y1 = bounds
    rows, columns = int((y1 - y0) / _RASTER_M) + 1, int((x1 - x0) / _RASTER_M) + 1
    order = np.argsort(mesh.vertices[:, 2], kind="stable")
    column = ((mesh.vertices[order, 0] - x0) / _RASTER_M).astype(int)
    row = ((y1 - mesh.vertices[order, 1]) / _RASTER_M).astype(int)
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    colours = np.zeros((rows, columns, 3), dtype=np.uint8)
    known = np.zeros((rows, columns), dtype=np.uint8)
    colours[row[inside], column[inside]] = mesh.colours[order][inside]
    known[row[inside], column[inside]] = 1
    for _ in range(2):
        wider = cv2.dilate(colours, np.ones((3, 3), np.uint8))
        colours = np.where(known[..., None] > 0, colours, wider)
        known = cv2.dilate(known, np.ones((3, 3), np.uint8))
    _paste(sheet, bounds, (x0, y1), _RASTER_M, colours, known > 0, 1.0)


def _tint(
    sheet: Sheet, grid: HeightGrid, wanted: NDArray[np.bool_], colour: Rgb255, bounds: Bounds
) -> None:
    """Mix a colour into the wanted cells of a grid."""
    top = (
        float(grid.origin[0]) - 0.5 * grid.step_m,
        float(grid.origin[1]) + (wanted.shape[0] - 0.5) * grid.step_m,
    )
    colours = np.broadcast_to(np.array(colour, dtype=np.uint8), (*wanted.shape, 3))
    _paste(sheet, bounds, top, grid.step_m, colours, wanted[::-1], _TINT)


def _paste(
    sheet: Sheet,
    bounds: Bounds,
    corner: tuple[float, float],
    cell_m: float,
    colours: NDArray[np.uint8],
    wanted: NDArray[np.bool_],
    share: float,
) -> None:
    """Mix cells into the picture.

    corner: x, y of the upper left corner of the first cell, m.
    """
    height, width = sheet.image.shape[:2]
    x = bounds[0] + (np.arange(width) + 0.5) / sheet.px_per_m
    y = bounds[3] - (np.arange(height) + 0.5) / sheet.px_per_m
    column = np.floor((x - corner[0]) / cell_m).astype(int)
    row = np.floor((corner[1] - y) / cell_m).astype(int)
    inside = ((row >= 0) & (row < wanted.shape[0]))[:, None] & (
        (column >= 0) & (column < wanted.shape[1])
    )[None, :]
    row, column = row.clip(0, wanted.shape[0] - 1), column.clip(0, wanted.shape[1] - 1)
    here = inside & wanted[row[:, None], column[None, :]]
    mixed = (1.0 - share) * sheet.image[here] + share * colours[row[:, None], column[None, :]][here]
    sheet.image[here] = mixed.astype(np.uint8)


def _inside(grid: HeightGrid, shapes: list[shapely.Polygon]) -> NDArray[np.bool_]:
    """Return which points of a grid are in shapes."""
    area = shapely.union_all(shapes)
    shapely.prepare(area)
    rows, columns = grid.heights.shape
    x = grid.origin[0] + np.arange(columns) * grid.step_m
    y = grid.origin[1] + np.arange(rows) * grid.step_m
    at_x, at_y = np.meshgrid(x, y)
    return np.asarray(shapely.contains_xy(area, at_x.ravel(), at_y.ravel()).reshape(rows, columns))
