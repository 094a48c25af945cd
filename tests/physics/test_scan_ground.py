"""Ground of scans: heights, holes, slopes and obstacles from a mesh."""

from __future__ import annotations

import time

import numpy as np
import pytest
import shapely

from cosim.core.errors import MapError
from cosim.core.geometry import Floats
from cosim.place.scan import HeightGrid, ScanArea, ScanMesh, Splats
from cosim.place.scan_areas import draft_areas, walkable_ground
from physics.scans.ground import closed_holes, height_grid, slope
from physics.scans.hidden import behind_walls

SIZE_M = 40.0
CURB_M = 0.12


def land(xy: Floats) -> Floats:
    """Return heights of a hill of 5 % with a curb at y = 20."""
    return 0.05 * xy[:, 0] + np.where(xy[:, 1] > 20.0, CURB_M, 0.0)


def sheet(x0: float, y0: float, x1: float, y1: float, step_m: float, z: float | None) -> Floats:
    """Return triangles of a surface that faces up, (T, 3, 3): of the land, or level at z."""
    columns, rows = (max(1, round(side / step_m)) + 1 for side in (x1 - x0, y1 - y0))
    grid = np.meshgrid(np.linspace(x0, x1, columns), np.linspace(y0, y1, rows))
    xy = np.column_stack([v.ravel() for v in grid])
    points = np.column_stack([xy, land(xy) if z is None else np.full(len(xy), z)])
    n = columns
    first = np.array([i for i in range(len(points) - n) if i % n < n - 1])
    return np.concatenate(
        [
            points[np.column_stack([first, first + 1, first + n + 1])],
            points[np.column_stack([first, first + n + 1, first + n])],
        ]
    )


def box(x0: float, y0: float, x1: float, y1: float, low: float, high: float) -> Floats:
    """Return walls and roof of a house without a floor, (T, 3, 3)."""
    ring = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])
    walls = []
    for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        foot_a, foot_b, top_a, top_b = ((*p, z) for z in (low, high) for p in (a, b))
        walls += [(foot_a, foot_b, top_b), (foot_a, top_b, top_a)]
    roof = sheet(x0, y0, x1, y1, 1.0, high)
    return np.concatenate([np.array(walls, dtype=float), roof])


def mesh_of(*parts: Floats) -> ScanMesh:
    corners = np.concatenate(parts)
    count = len(corners)
    return ScanMesh(
        corners.reshape(-1, 3).astype(np.float32),
        np.arange(3 * count, dtype=np.int32).reshape(-1, 3),
        np.zeros((3 * count, 3), dtype=np.uint8),
        np.zeros(count, dtype=np.uint8),
    )


def at(grid: HeightGrid, x: float, y: float) -> tuple[int, int]:
    column, row = np.rint((np.array([x, y]) - grid.origin) / grid.step_m).astype(int)
    return int(row), int(column)


def lattice(grid: HeightGrid) -> Floats:
    rows, columns = grid.heights.shape
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    return grid.origin + grid.step_m * np.column_stack([x.ravel(), y.ravel()])


@pytest.fixture(scope="module")
def street() -> HeightGrid:
    """Return land with a bridge, a roof, a tree crown and a post over it, as a perfect scanner sees
    it."""
    ground = sheet(0.0, 0.0, SIZE_M, SIZE_M, 0.5, None)
    middle = ground.mean(axis=1)
    under_house = (np.abs(middle[:, :2] - (30.0, 30.0)) < 6.0).all(axis=1)
    return height_grid(
        mesh_of(
            ground[~under_house],
            box(24.0, 24.0, 36.0, 36.0, 0.0, 8.0),
            sheet(0.0, 8.0, SIZE_M, 12.0, 1.0, 5.0),
            sheet(4.0, 24.0, 9.0, 29.0, 0.5, 3.5),
            box(12.0, 15.0, 12.3, 15.3, 0.0, 3.0),
        ),
        None,
        0.25,
    )


def test_the_ground_lies_below_bridges_roofs_and_crowns(street: HeightGrid) -> None:
    """Under them the ground is the land: measured where the scan saw it, else interpolated."""
    for x, y in ((20.0, 10.0), (6.0, 26.0), (12.15, 15.15)):
        assert street.heights[at(street, x, y)] == pytest.approx(
            0.05 * x + CURB_M * (y > 20), abs=0.03
        )
    assert street.measured[at(street, 20.0, 10.0)] and street.measured[at(street, 6.0, 26.0)]
    assert not street.measured[at(street, 30.0, 30.0)]
    assert street.heights[at(street, 30.0, 30.0)] == pytest.approx(0.05 * 30.0 + CURB_M, abs=0.15)
    holes = closed_holes(street)
    assert holes.count == 1 and holes.area_m2 == pytest.approx(144.0, rel=0.1)


def test_standing_objects_block_and_overhanging_ones_do_not(street: HeightGrid) -> None:
    """Posts and walls block; bridges, crowns and curbs do not."""
    assert street.blocked[at(street, 12.0, 15.25)] and street.blocked[at(street, 24.0, 30.0)]
    for x, y in ((20.0, 10.0), (6.0, 26.0), (20.0, 20.0), (11.0, 15.25)):
        assert not street.blocked[at(street, x, y)]


def test_slopes_are_those_of_the_land(street: HeightGrid) -> None:
    """The slope is the hill's, and that of a curb is larger."""
    grade = slope(street)
    assert grade[at(street, 15.0, 3.0)] == pytest.approx(0.05, abs=0.005)
    assert grade[at(street, 15.0, 20.0)] > 0.1


def test_noise_and_lost_triangles_cost_centimetres() -> None:
    """With 3 cm of noise, pits and 5 % of the triangles lost, heights are right to 3 cm."""
    rng = np.random.default_rng(1)
    ground = sheet(0.0, 0.0, SIZE_M, SIZE_M, 0.25, None)
    points, index = np.unique(ground.reshape(-1, 3), axis=0, return_inverse=True)
    points = points + rng.normal(0.0, 0.03, points.shape)
    points[rng.integers(0, len(points), 12), 2] -= 2.0
    spoiled = points[index.reshape(-1, 3)]
    grid = height_grid(mesh_of(spoiled[rng.random(len(spoiled)) > 0.05]), None, 0.25)
    xy = lattice(grid)
    inner = ((xy > 1.0) & (xy < SIZE_M - 1.0)).all(axis=1) & (np.abs(xy[:, 1] - 20.0) > 0.5)
    error = np.abs(grid.heights.ravel() - land(xy))[inner]
    assert error.mean() < 0.03 and np.quantile(error, 0.95) < 0.06
    assert grid.blocked.mean() < 1e-3


def test_half_a_million_triangles_take_seconds() -> None:
    """A scan of half a million triangles takes a few seconds of one core."""
    mesh = mesh_of(sheet(0.0, 0.0, SIZE_M, SIZE_M, 0.08, None))
    assert len(mesh.triangles) == 500_000
    began = time.process_time()
    grid = height_grid(mesh, None, 0.25)
    assert time.process_time() - began < 20.0
    assert grid.measured.mean() > 0.95


def test_the_order_of_triangles_changes_no_bit() -> None:
    """Height grids are equal to the bit for any order of triangles."""
    parts = np.concatenate([sheet(0.0, 0.0, 20.0, 20.0, 0.2, None), box(5, 5, 9, 9, 0.0, 3.0)])
    one, other = (
        height_grid(mesh_of(parts), None, 0.1),
        height_grid(mesh_of(parts[::-1]), None, 0.1),
    )
    for name in ("heights", "measured", "blocked"):
        assert getattr(one, name).tobytes() == getattr(other, name).tobytes()


def test_splats_are_ground_where_the_mesh_has_none() -> None:
    """Opaque splats fill a hole of the mesh, and transparent ones do not."""
    ground = sheet(0.0, 0.0, 20.0, 20.0, 0.5, 0.0)
    middle = ground.mean(axis=1)
    hole = (np.abs(middle[:, :2] - 10.0) < 3.0).all(axis=1)
    x, y = (v.ravel() for v in np.meshgrid(np.arange(7.0, 13.0, 0.1), np.arange(7.0, 13.0, 0.1)))
    count = len(x)
    rgba = np.full((count, 4), 255, dtype=np.uint8)
    rgba[x > 10.0, 3] = 20
    splats = Splats(
        np.column_stack([x, y, np.full(count, 0.01)]).astype(np.float32),
        np.zeros((count, 6), dtype=np.float32),
        rgba,
        np.ones(count, dtype=bool),
    )
    grid = height_grid(mesh_of(ground[~hole]), splats, 0.25)
    assert grid.measured[at(grid, 8.5, 10.0)] and not grid.measured[at(grid, 11.5, 10.0)]


def test_scans_without_ground_are_refused() -> None:
    """A mesh that faces down, an empty one and a wrong step are refused, with the reason."""
    ground = sheet(0.0, 0.0, 4.0, 4.0, 1.0, 0.0)
    with pytest.raises(MapError, match="no triangle of it faces up"):
        height_grid(mesh_of(ground[:, ::-1]), None, 0.25)
    with pytest.raises(MapError, match="no triangles"):
        height_grid(mesh_of(ground[:0]), None, 0.25)
    with pytest.raises(MapError, match=r"0\.5 m, but it must be 0\.1 to 0\.25 m"):
        height_grid(mesh_of(ground), None, 0.5)


def front(x0: float, x1: float, y: float, high: float) -> Floats:
    """Return a house front as an app scans it: one sheet whose front faces -y, (T, 3, 3)."""
    a, b = (x0, y), (x1, y)
    low = [(*a, -0.2), (*b, -0.2)]
    top = [(*a, high), (*b, high)]
    return np.array([(low[0], low[1], top[1]), (low[0], top[1], top[0])])


def test_ground_behind_house_fronts_is_not_drafted() -> None:
    """The draft is the ground in front of the houses, and drawn areas are not affected."""
    mesh = mesh_of(
        sheet(0.0, 0.0, 60.0, 20.0, 1.0, 0.0),
        front(0.0, 28.0, 8.0, 4.0),
        front(30.0, 60.0, 8.0, 4.0),
        box(40.0, 2.0, 40.3, 2.3, 0.0, 3.0),
    )
    grid = height_grid(mesh, None, 0.25)
    hidden = behind_walls(mesh, grid)
    (area,) = draft_areas(grid, slope(grid), hidden)
    assert area.polygon.area == pytest.approx(60.0 * 8.0, rel=0.08)
    # Of the 720 m2 behind, the part in line with the gap between the houses is in view.
    assert shapely.difference(area.polygon, shapely.box(0.0, 0.0, 60.0, 8.0)).area < 25.0
    assert not (hidden & ~grid.blocked)[: at(grid, 0.0, 7.5)[0]].any()
    (with_yard,) = draft_areas(grid, slope(grid))
    assert with_yard.polygon.area > 1000.0
    drawn = [ScanArea("sidewalk", shapely.box(5.0, 10.0, 20.0, 15.0))]
    assert walkable_ground(drawn, grid).area == pytest.approx(75.0)
