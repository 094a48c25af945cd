"""The ground and the buildings, as pure functions of a street map."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import shapely

from physics.ground.tiles import (
    CURB_M,
    TILE_M,
    Key,
    Tile,
    build_tile,
    distance_to,
    key_at,
    keys_within,
    square,
)
from physics.street.buildings import Frontage
from physics.street.covers import frontage_in
from physics.street.paint import paint_in
from tests.support.tiny_street import KEYS, no_cracks, plan_areas, tiny_map, triangles

MAP = tiny_map()


@pytest.fixture(scope="module")
def tiles() -> dict[Key, Tile]:
    """The tiles around the crossing."""
    return {key: build_tile(MAP, key) for key in KEYS}


def test_a_tile_is_covered_once(tiles: dict[Key, Tile]) -> None:
    """The triangles of every tile, seen from above, fill its square exactly and none looks down."""
    for tile in tiles.values():
        areas = np.concatenate([plan_areas(triangles(tile, name)) for name in tile.parts])
        assert areas.min() > -1e-9
        assert abs(areas.sum() - TILE_M**2) < 1e-6


def test_neighbouring_triangles_share_their_corners(tiles: dict[Key, Tile]) -> None:
    """Within a tile every edge off the border is shared by two triangles, walls and their feet
    included."""
    for key, tile in tiles.items():
        no_cracks(key, np.concatenate([triangles(tile, name) for name in tile.parts]))


def test_heights_meet_at_tile_borders(tiles: dict[Key, Tile]) -> None:
    """Two tiles agree on the height of points on their common border, on the ramps too."""
    left = tiles[(-1, -1)]
    right = tiles[(0, -1)]
    x = square((0, -1))[0]
    border = np.column_stack([np.full(400, x), np.linspace(-20.0, -1e-3, 400)])
    assert np.allclose(left.height(border), right.height(border), atol=1e-9)


def test_the_curb_ramp_rises_one_in_twelve() -> None:
    """From the crossing's end the corner climbs 1:12 to the curb's height; the flares follow the
    same rule."""
    tile = build_tile(MAP, key_at(0.0, 5.0))
    ahead = tile.height([[0.0, 3.5 + d] for d in (0.001, 0.36, 0.72, 1.44, 2.0)])
    assert np.allclose(ahead, [0.0, 0.03, 0.06, 0.12, 0.12], atol=2e-4)
    mesh = tile.parts["ramp"]
    assert np.allclose(
        mesh.vertices[:, 2], tile.height(mesh.vertices[:, :2] + [0.0, 1e-9]), atol=1e-6
    )


def test_the_kinds_of_ground_lie_where_the_map_says(tiles: dict[Key, Tile]) -> None:
    """Triangles' middles: sidewalk on strips, stripes on the crossing, road on lanes, verge on the
    verge."""
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


def test_keys_cover_a_disk() -> None:
    """The tiles within a radius hold every point of the disk, and each is no farther than the
    radius."""
    keys = keys_within(13.0, -7.0, 30.0)
    angle = np.linspace(0.0, 6.28, 60)
    assert {key_at(13.0 + 29.9 * np.cos(a), -7.0 + 29.9 * np.sin(a)) for a in angle} <= set(keys)
    assert all(distance_to(key, 13.0, -7.0) <= 30.0 for key in keys)


def test_buildings_line_the_street_and_keep_off_it() -> None:
    """Both sides have buildings, none over walkable ground or road, and they begin at the frontage
    distance."""
    frontage = Frontage(MAP, seed=4)
    built = [b for key in keys_within(0.0, 0.0, 100.0) for b in frontage.in_tile(key)]
    street = shapely.box(-80, -8, 80, 6.5)
    assert len(built) > 12
    assert {b.id.split(":")[1] for b in built} == {"nw", "ne", "sw", "se"}
    gaps = [shapely.distance(b.polygon, street) for b in built]
    assert np.allclose(gaps, 2.0)
    assert all(6.0 <= b.size_m[2] <= 25.0 for b in built)


def test_buildings_do_not_depend_on_the_order_but_on_the_seed() -> None:
    """Tiles asked for in any order hold the same buildings; another seed gives others."""
    one, two, other = Frontage(MAP, 4), Frontage(MAP, 4), Frontage(MAP, 5)
    forward = {key: one.in_tile(key) for key in KEYS}
    backward = {key: two.in_tile(key) for key in reversed(KEYS)}
    assert forward == backward
    assert forward != {key: other.in_tile(key) for key in KEYS}
    ids = [b.id for buildings in forward.values() for b in buildings]
    assert len(ids) == len(set(ids))


def test_paint_lies_on_its_ground() -> None:
    """Lines are on roads and domes on walkable ground, millimetres above it."""
    crossing = dataclasses.replace(MAP.strips[":c0"], signalised=True, crosses=("e", "-e"))
    street_map = dataclasses.replace(MAP, strips={**MAP.strips, ":c0": crossing})
    found: dict[str, int] = {}
    for key in keys_within(0.0, 0.0, 60.0):
        tile = build_tile(street_map, key)
        for name, mesh in paint_in(street_map, tile).items():
            middles = mesh.vertices[mesh.triangles].mean(axis=1)
            kinds = (
                ("strip", "corner") if name.startswith("tactile") else ("lane", "junction", "strip")
            )
            for x, y in middles[:, :2].tolist():
                assert any(street_map.near(kind, shapely.Point(x, y)) for kind in kinds), (
                    name,
                    x,
                    y,
                )
            above = mesh.vertices[:, 2] - tile.height(mesh.vertices[:, :2])
            assert (above.min() > 0.003 and above.max() < 0.005) or name.startswith("tactile")
            found[name] = found.get(name, 0) + len(mesh)
    assert found["tactile-domes"] >= 4 and found["paint"] >= 20


def test_domes_lie_in_the_triangles_of_the_ground() -> None:
    """Beside a crossing that meets its corner at an angle the ground bends many times: no field of
    domes is under it or more than 5 mm above it anywhere, and together they cover the fields."""
    line = np.array([[-1.4, -4.0], [1.4, 4.0]])
    askew = dataclasses.replace(
        MAP.strips[":c0"],
        line=line,
        polygon=shapely.LineString(line).buffer(1.6, cap_style="flat"),
        width_m=3.2,
    )
    street_map = dataclasses.replace(MAP, strips={**MAP.strips, ":c0": askew})
    spread = []
    checked = 0
    for key in keys_within(0.0, 0.0, 60.0):
        tile = build_tile(street_map, key)
        domes = paint_in(street_map, tile).get("tactile-domes")
        if domes is None:
            continue
        spread.append(shapely.polygons(domes.vertices[domes.triangles][:, :, :2]))
        ground = np.concatenate([mesh.vertices[mesh.triangles] for mesh in tile.parts.values()])
        flat = shapely.area(shapely.polygons(ground[:, :, :2])) > 1e-7
        ground = ground[flat]
        tree = shapely.STRtree(shapely.polygons(ground[:, :, :2]))
        for triangle in domes.vertices[domes.triangles]:
            middle = triangle.mean(axis=0)
            for k in tree.query(shapely.Point(middle[:2]), "within").tolist():
                a, b, c = ground[k]
                share = np.linalg.solve(np.column_stack([b - a, c - a])[:2], middle[:2] - a[:2])
                height = a[2] + share @ np.array([b[2] - a[2], c[2] - a[2]])
                assert 0.003 < middle[2] - height < 0.005
                checked += 1
    pieces = np.concatenate(spread)
    assert checked > 20 and shapely.area(pieces).sum() == pytest.approx(
        shapely.union_all(pieces, grid_size=1e-6).area, rel=1e-3
    )


def test_the_frontage_is_paved_where_there_are_shops(tiles: dict[Key, Tile]) -> None:
    """In a generated city it is covered before shops from the sidewalk to the houses, without holes
    or doubles, a little above the ground, with a rim down to it where it ends; a home's driveway
    reaches from its sidewalk to the houses; the ground itself stays what it was."""
    changed = {
        "nw": dataclasses.replace(MAP.strips["nw"], street_class="commercial"),
        "ne": dataclasses.replace(MAP.strips["ne"], street_class="residential", driveways=(30.0,)),
    }
    street_map = dataclasses.replace(MAP, strips={**MAP.strips, **changed}, planned=True)
    covered = []
    layers = set()
    rims = []
    for key in KEYS:
        tile = build_tile(street_map, key)
        assert set(tile.parts) - {"ramp"} == set(tiles[key].parts) - {"ramp"}
        for mesh, cover in frontage_in(street_map, tile, 3):
            layers.add(cover.layer)
            above = mesh.vertices[:, 2] - tile.height(mesh.vertices[:, :2])
            faces = mesh.vertices[mesh.triangles]
            flat = np.abs(plan_areas(faces)) > 1e-9
            assert above[mesh.triangles[flat]].min() > 0.002 and above.max() < 0.004
            rim = mesh.triangles[~flat]
            assert above.min() > -0.001 and above[rim].min(axis=1).max() < 0.001
            edge = mesh.vertices[rim].reshape(-1, 3)
            rims += np.abs(edge[np.abs(edge[:, 1] - 6.5) < 1e-3, 0]).tolist()
            covered.append(shapely.polygons(faces[flat][:, :, :2]))
    pieces = np.concatenate(covered)
    whole = shapely.union_all(pieces, grid_size=1e-6)
    assert shapely.area(pieces).sum() == pytest.approx(whole.area, rel=1e-4)
    assert whole.covers(shapely.box(-55.0, 6.51, -3.0, 8.49))
    assert whole.covers(shapely.box(30.6, 6.51, 33.4, 8.49))
    assert whole.intersection(shapely.box(-55.0, -8.0, 55.0, 6.45)).area < 1e-6
    assert len(layers) >= 2 and max(rims) > 30.0 > min(rims)
