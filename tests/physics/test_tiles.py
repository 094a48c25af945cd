"""The ground and the buildings, as pure functions of a street map."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

from physics.ground.tiles import (
    CURB_M,
    TILE_M,
    Key,
    Tile,
    build_tile,
    tile_at,
    tile_bounds,
    tiles_within,
)
from physics.street.buildings import BuildingRows
from tests.support.tiny_street import KEYS, assert_no_cracks, plan_areas, tiny_map, triangles

MAP = tiny_map()


@pytest.fixture(scope="module")
def tiles() -> dict[Key, Tile]:
    """Return the tiles around the crossing."""
    return {key: build_tile(MAP, key) for key in KEYS}


def test_a_tile_is_covered_once(tiles: dict[Key, Tile]) -> None:
    """The triangles of every tile, seen from above, fill its square exactly, and none faces
    down."""
    for tile in tiles.values():
        areas = np.concatenate([plan_areas(triangles(tile, name)) for name in tile.parts])
        assert areas.min() > -1e-9
        assert abs(areas.sum() - TILE_M**2) < 1e-6


def test_neighbouring_triangles_share_their_corners(tiles: dict[Key, Tile]) -> None:
    """Within a tile every edge off the border is shared by two triangles, also at walls and their
    feet."""
    for key, tile in tiles.items():
        assert_no_cracks(key, np.concatenate([triangles(tile, name) for name in tile.parts]))


def test_heights_meet_at_tile_borders(tiles: dict[Key, Tile]) -> None:
    """Two tiles agree on the height of points on their common border, also on ramps."""
    left = tiles[(-1, -1)]
    right = tiles[(0, -1)]
    x = tile_bounds((0, -1))[0]
    border = np.column_stack([np.full(400, x), np.linspace(-20.0, -1e-3, 400)])
    assert np.allclose(left.height(border), right.height(border), atol=1e-9)


def test_the_curb_ramp_rises_one_in_twelve() -> None:
    """From the end of the crossing the corner climbs 1:12 to the curb's height, and so do the
    flares."""
    tile = build_tile(MAP, tile_at(0.0, 5.0))
    ahead = tile.height([[0.0, 3.5 + d] for d in (0.001, 0.36, 0.72, 1.44, 2.0)])
    assert np.allclose(ahead, [0.0, 0.03, 0.06, 0.12, 0.12], atol=2e-4)
    mesh = tile.parts["ramp"]
    assert np.allclose(
        mesh.vertices[:, 2], tile.height(mesh.vertices[:, :2] + [0.0, 1e-9]), atol=1e-6
    )


def test_the_kinds_of_ground_lie_where_the_map_says(tiles: dict[Key, Tile]) -> None:
    """The middles of triangles of a kind lie on strips, the crossing, lanes or the verge."""
    where = {
        "road": shapely.box(-80, -3.5, 80, 3.5),
        "stripe": shapely.box(-1.6, -3.5, 1.6, 3.5),
        "crossing": shapely.box(-1.6, -3.5, 1.6, 3.5),
        "sidewalk": shapely.box(-80, -8, 80, 6.5),
        "verge": shapely.box(-80, -5, 80, -3.5),
    }
    for tile in tiles.values():
        for name, area in where.items():
            if name in tile.parts:
                middle = triangles(tile, name).mean(axis=1)
                assert shapely.contains_xy(area, middle[:, 0], middle[:, 1]).all()
                assert np.allclose(triangles(tile, name)[..., 2] <= CURB_M + 1e-9, True)


def test_tiles_do_not_depend_on_the_order(tiles: dict[Key, Tile]) -> None:
    """A tile built alone equals the same tile built after others."""
    again = build_tile(tiny_map(), (0, -1))
    for name, mesh in tiles[(0, -1)].parts.items():
        assert np.array_equal(mesh.vertices, again.parts[name].vertices)
        assert np.array_equal(mesh.triangles, again.parts[name].triangles)


def test_buildings_line_the_street_and_keep_off_it() -> None:
    """Both sides have buildings at the frontage distance, none over walkable ground or road."""
    frontage = BuildingRows(MAP, seed=4)
    built = [b for key in tiles_within(0.0, 0.0, 100.0) for b in frontage.in_tile(key)]
    street = shapely.box(-80, -8, 80, 6.5)
    assert len(built) > 12
    assert {b.id.split(":")[1] for b in built} == {"nw", "ne", "sw", "se"}
    gaps = [shapely.distance(b.polygon, street) for b in built]
    assert np.allclose(gaps, 2.0)
    assert all(6.0 <= b.size_m[2] <= 25.0 for b in built)


def test_buildings_do_not_depend_on_the_order_but_on_the_seed() -> None:
    """Tiles in any order hold the same buildings, and another seed gives others."""
    one, two, other = BuildingRows(MAP, 4), BuildingRows(MAP, 4), BuildingRows(MAP, 5)
    forward = {key: one.in_tile(key) for key in KEYS}
    backward = {key: two.in_tile(key) for key in reversed(KEYS)}
    assert forward == backward
    assert forward != {key: other.in_tile(key) for key in KEYS}
    ids = [b.id for buildings in forward.values() for b in buildings]
    assert len(ids) == len(set(ids))
