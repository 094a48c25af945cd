"""Street furniture, paving and relief: places, free widths, and the shape of the ground."""

from __future__ import annotations

import dataclasses
import itertools
import math
import os
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import shapely

from cosim.core.errors import UsageError
from cosim.core.geometry import Polyline, Pose
from cosim.core.state import LABELS, Command, RobotState, Street
from cosim.place.street_map import StreetMap, Strip
from cosim.spec.camera import CameraSpec
from cosim.spec.scenario import City
from physics.cameras.bullet_camera import BulletCamera
from physics.dynamics.world import BulletWorld
from physics.ground.tiles import CURB_M, Tile, build_tile, tile_at, tiles_within
from physics.street.buildings import BuildingRows
from physics.street.clearance import clear_widths, props_on_driveways
from physics.street.furniture import (
    KINDS,
    PROP_VARIANTS,
    Prop,
    footprints,
    parts_of,
    solids_of,
)
from physics.street.placement import (
    CLEAR_HALF_M,
    PROP_END_GAP_M,
    PropPlacement,
    clear_half_m,
)
from physics.street.street_surface import StreetSurface
from sumo_nets.city.store import city_net
from sumo_nets.net.net_file import read_net
from tests.support.tiny_street import tiny_map

BASE = tiny_map()
CLASSES = {"nw": "commercial", "ne": "residential", "sw": "boulevard", "se": "narrow"}
MAP: StreetMap = dataclasses.replace(
    BASE,
    strips={
        name: dataclasses.replace(
            s, street_class=CLASSES.get(name, ""), verge_m=1.5 if name in ("sw", "se") else 0.0
        )
        for name, s in BASE.strips.items()
    },
)
EMPTY = Street(0)
SHARED = Path(os.environ.get("COSIM_SHARED", Path(__file__).parents[3] / "shared")) / "maps"


def placed(street_map: StreetMap, seed: int) -> tuple[PropPlacement, BuildingRows]:
    frontage = BuildingRows(street_map, seed)
    return PropPlacement(street_map, seed, frontage), frontage


def sidewalks(street_map: StreetMap) -> list[Strip]:
    return [s for s in street_map.strips.values() if s.kind == "sidewalk"]


def all_props(street_map: StreetMap, seed: int) -> list[Prop]:
    placement, _ = placed(street_map, seed)
    return [prop for strip in sidewalks(street_map) for prop in placement.props_of_strip(strip)]


@cache
def city(seed: int, size_m: float = 600.0) -> StreetMap:
    return read_net(city_net(City(seed=seed, size_m=size_m)))


def shared_nets() -> list[Path]:
    names = ("berlin-neukoelln", "taipei", "west-oakland")
    return [net for name in names for net in sorted((SHARED / name).glob("*.net.xml.gz"))[:1]]


@pytest.mark.parametrize("kind", KINDS.values(), ids=lambda kind: kind.name)
def test_props_have_few_triangles_and_stand_on_the_ground(kind: object) -> None:
    """Every size of a prop reaches the ground, fills its footprint below head height, and has its
    solids within it."""
    entry = KINDS[kind.name]  # type: ignore[attr-defined]
    looks = range(len(entry.paints) if entry.grown else 1)
    for variant, look in itertools.product(range(PROP_VARIANTS), looks):
        length, depth, height = entry.size_m(variant)
        parts = parts_of(entry.name, variant, look)
        vertices = np.concatenate([part.mesh.vertices for part in parts])
        most = (
            250
            if entry.name.startswith("obstacle:")
            else {"tree": 300, "car": 170}.get(entry.name, 90)
        )
        assert sum(len(part.mesh) for part in parts) <= most
        assert -1e-9 <= vertices[:, 2].min() < 0.051
        assert vertices[:, 2].max() == pytest.approx(height, abs=0.06)
        low = (
            vertices[vertices[:, 2] < 1.75]
            if entry.name != "shelter"
            else vertices[vertices[:, 2] < 2.0]
        )
        assert np.abs(low[:, 0]).max() <= 0.5 * length + 0.02
        assert np.abs(low[:, 1]).max() <= 0.5 * depth + 0.02
        for solid in solids_of(entry.name, variant):
            assert abs(solid.at_m[0]) + 0.5 * solid.size_m[0] <= 0.5 * length + 1e-9
            assert abs(solid.at_m[1]) + 0.5 * solid.size_m[1] <= 0.5 * depth + 1e-9


def test_props_overlap_no_other_object() -> None:
    """Over several seeds no prop is on a corner, a road, a crossing, another prop, a house, or near
    the end of a strip."""
    street = shapely.union_all(
        [p.polygon for p in (*MAP.corners.values(), *MAP.lanes.values()) if "_0" not in p.id]
    )
    zebra = MAP.strips[":c0"].polygon
    for seed in range(6):
        placement, frontage = placed(MAP, seed)
        props = [prop for strip in sidewalks(MAP) for prop in placement.props_of_strip(strip)]
        ground = footprints(props)
        assert len(props) > 25
        assert shapely.distance(ground, street).min() > 0.0
        assert shapely.distance(ground, zebra).min() >= PROP_END_GAP_M
        assert len(shapely.STRtree(ground).query(ground, predicate="intersects")[0]) == len(ground)
        houses = [b.polygon for key in tiles_within(0.0, 0.0, 120.0) for b in frontage.in_tile(key)]
        assert not len(shapely.STRtree(houses).query(ground, predicate="intersects")[0])
        for prop, footprint in zip(props, ground, strict=True):
            strip = MAP.strips[prop.id.split(":")[1]]
            line = Polyline(strip.line)
            along = [line.project(x, y)[0] for x, y in shapely.get_coordinates(footprint)]
            assert (
                min(along) >= PROP_END_GAP_M - 1e-6
                and max(along) <= line.length_m - PROP_END_GAP_M + 1e-6
            )


def test_the_middle_of_a_sidewalk_is_free() -> None:
    """No footprint is nearer to the middle line than the clear half width, which is at least 0.6
    m."""
    for seed in range(6):
        for prop, footprint in zip(props := all_props(MAP, seed), footprints(props), strict=True):
            strip = MAP.strips[prop.id.split(":")[1]]
            half = clear_half_m(strip)
            assert half >= CLEAR_HALF_M
            assert shapely.distance(shapely.linestrings(strip.line), footprint) >= half


def test_props_do_not_depend_on_the_order_but_on_the_seed() -> None:
    """Tiles in any order hold the same props, each prop in one tile, and another seed gives
    others."""
    keys = tiles_within(0.0, 0.0, 100.0)
    one, two, other = (placed(MAP, seed)[0] for seed in (4, 4, 5))
    forward = {key: one.in_tile(key) for key in keys}
    backward = {key: two.in_tile(key) for key in reversed(keys)}
    assert forward == backward
    assert forward != {key: other.in_tile(key) for key in keys}
    ids = [prop.id for props in forward.values() for prop in props]
    assert len(ids) == len(set(ids)) == len(all_props(MAP, 4))
    assert all(
        tile_at(prop.x_m, prop.y_m) == key for key, props in forward.items() for prop in props
    )


def test_the_checker_finds_a_prop_in_the_way() -> None:
    """The least free width is measured at the prop, and is 0 where it stands on the middle line."""
    strip = MAP.strips["nw"]
    bench = Prop("prop:nw:0", "bench", 0, -40.0, 6.2, 0.0, 0)
    width, bare = clear_widths([strip], [bench])["nw"]
    assert (width, bare) == (pytest.approx(3.0 - 0.3 - 0.225), pytest.approx(3.0))
    middle = dataclasses.replace(bench, y_m=5.0)
    assert clear_widths([strip], [middle])["nw"][0] == 0.0


@pytest.mark.engine
@pytest.mark.parametrize("seed", [11, 37, 5])
def test_generated_cities_leave_the_clear_width(seed: int) -> None:
    """Every sidewalk of a city has furniture and at least 1.2 m of free width on the final
    geometry."""
    street_map = city(seed)
    strips = sidewalks(street_map)
    props = all_props(street_map, seed)
    widths = clear_widths(strips, props)
    assert min(free for free, _ in widths.values()) >= 1.2 - 1e-6
    assert len(props) > 0.06 * sum(strip.length_m for strip in strips)


@pytest.mark.engine
@pytest.mark.parametrize("seed", [11, 37, 5])
def test_driveways_are_open(seed: int) -> None:
    """Only parked cars behind the sidewalk stand near a driveway or the flares of its ramp."""
    street_map = city(seed)
    strips = sidewalks(street_map)
    props = all_props(street_map, seed)
    assert sum(len(strip.driveways) for strip in strips) > 20
    assert props_on_driveways(strips, props) == []
    cars = [prop for prop in props if prop.kind == "car"]
    assert cars
    for car, footprint in zip(cars, footprints(cars), strict=True):
        assert shapely.distance(footprint, street_map.strips[car.id.split(":")[1]].polygon) > 0.0
    strip = next(strip for strip in strips if strip.driveways)
    x, y, heading = Polyline(strip.line).at(strip.driveways[0])
    assert props_on_driveways(strips, [Prop("prop:here:0", "bin", 0, x, y, heading, 0)]) == [
        "prop:here:0"
    ]


@pytest.mark.engine
@pytest.mark.skipif(not shared_nets(), reason="the shared maps are not here")
@pytest.mark.parametrize("path", shared_nets(), ids=lambda path: path.parent.name)
def test_imported_maps_leave_the_clear_width(path: Path) -> None:
    """Props take nothing from a sidewalk below 1.2 m; narrower ones stay as they are."""
    street_map = read_net(path)
    widths = clear_widths(sidewalks(street_map), all_props(street_map, 3))
    assert all(free >= min(1.2, bare) - 1e-6 for free, bare in widths.values())


@pytest.mark.engine
def test_a_prop_stops_the_robot_and_is_named() -> None:
    """A robot that drives at a prop of any kind touches an object with its id, and does not
    pass."""
    placement, _ = placed(MAP, 1)
    chosen = {
        prop.kind: prop for strip in sidewalks(MAP) for prop in placement.props_of_strip(strip)
    }
    assert len(chosen) > 8
    with BulletWorld(StreetSurface(MAP, seed=1)) as world:
        for prop in chosen.values():
            y = MAP.strips[prop.id.split(":")[1]].line[0, 1]
            toward = math.copysign(math.pi / 2, prop.y_m - y)
            world.place(Pose(prop.x_m + 0.2, float(y), toward))
            motions = [world.step(Command(0.6, 0.0), EMPTY, EMPTY, 10) for _ in range(120)]
            contacts = {(c.kind, c.other) for motion in motions for c in motion.contacts}
            assert contacts == {("object", prop.id)}, prop
            assert abs(motions[-1].robot.pose.y_m - y) < abs(prop.y_m - y)


@pytest.mark.engine
def test_a_prop_is_seen_where_it_stands() -> None:
    """A prop ahead is in the middle of the picture with its label, on the ground of its zone, at
    its distance."""
    placement, _ = placed(MAP, 1)
    props = [
        prop
        for strip in sidewalks(MAP)
        for prop in placement.props_of_strip(strip)
        if prop.kind in ("bin", "planter")
    ]
    assert len(props) >= 4
    with BulletCamera(
        BulletWorld(StreetSurface(MAP, seed=1)), CameraSpec(96, 96), depth=True
    ) as camera:
        for prop in props[:4]:
            y = float(MAP.strips[prop.id.split(":")[1]].line[0, 1])
            toward = math.copysign(math.pi / 2, prop.y_m - y)
            away = 3.0 * math.copysign(1.0, y - prop.y_m)
            frame = camera.render(
                RobotState(Pose(prop.x_m, prop.y_m + away, toward), z_m=0.12), EMPTY
            )
            assert frame.labels is not None and frame.depth is not None
            rows = np.flatnonzero(frame.labels[:, 48] == LABELS["prop"])
            assert len(rows) > 5
            assert frame.labels[rows.max() + 1, 48] in (LABELS["verge"], LABELS["ground"])
            nearest = 3.0 - 0.5 * prop.size_m[1] - frame.depth[rows, 48].min()
            assert 0.0 < nearest < 0.5


def rough_height(tile: Tile, xy: np.ndarray) -> np.ndarray:
    """Return heights at points on high ground from the triangles of a tile."""
    found = np.full(len(xy), np.nan)
    for name in tile.parts:
        mesh = tile.parts[name]
        corners = mesh.vertices[mesh.triangles]
        tree = shapely.STRtree(shapely.polygons(corners[:, :, :2]))
        point, triangle = tree.query(shapely.points(xy), predicate="within")
        for i, k in zip(point.tolist(), triangle.tolist(), strict=True):
            a, b, c = corners[k]
            normal = np.cross(b - a, c - a)
            found[i] = a[2] - ((xy[i] - a[:2]) @ normal[:2]) / normal[2]
    return found


def test_roughness_changes_the_ground_and_zero_does_not() -> None:
    """With roughness the mesh follows `height`, tiles meet, ramps stay, and roads get potholes; at
    0 nothing changes."""
    key = (0, 0)
    flat = build_tile(MAP, key)
    zero = build_tile(MAP, key, roughness=0.0, seed=9, roots=[(10.0, 5.0)])
    assert all(
        np.array_equal(mesh.vertices, zero.parts[name].vertices)
        for name, mesh in flat.parts.items()
    )
    rough = build_tile(MAP, key, roughness=1.0, seed=9, roots=[(10.0, 5.0)])
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(5.0, 45.0, 400), rng.uniform(3.8, 6.3, 400)])
    mesh_height = rough_height(rough, points)
    known = np.isfinite(mesh_height)
    assert known.mean() > 0.95
    assert np.abs(mesh_height - rough.height(points))[known].max() < 0.012
    assert np.ptp(mesh_height[known]) > 0.03 and np.abs(mesh_height[known] - CURB_M).max() < 0.1
    assert (
        rough.height([[10.0, 5.0]])[0]
        > build_tile(MAP, key, roughness=1.0, seed=9).height([[10.0, 5.0]])[0] + 0.02
    )
    other = build_tile(MAP, (-1, 0), roughness=1.0, seed=9)
    border = np.column_stack([np.full(50, 0.4137), np.linspace(1.0, 20.0, 50)])
    assert np.allclose(rough.height(border), other.height(border), atol=1e-9)
    ramp = np.array([[0.5, 3.5 + d] for d in (0.001, 0.01)])
    assert np.allclose(rough.height(ramp), flat.height(ramp), atol=1e-3)
    tiles = [build_tile(MAP, (i, j), roughness=1.0, seed=9) for i in (-1, 0) for j in (-1, 0)]
    road = np.concatenate([tile.parts["road"].vertices[:, 2] for tile in tiles])
    assert road.min() == pytest.approx(-0.05, abs=1e-3) and road.max() == 0.0


@pytest.mark.engine
def test_rough_ground_tilts_the_robot() -> None:
    """On rough pavement the robot makes progress with a few degrees of tilt; on flat ground it
    hardly tilts."""
    tilts = {}
    for roughness in (0.0, 1.0):
        with BulletWorld(StreetSurface(MAP, seed=3, roughness=roughness)) as world:
            world.place(Pose(8.0, 5.0, 0.0))
            robots = [world.step(Command(1.0, 0.0), EMPTY, EMPTY, 10).robot for _ in range(300)]
        assert robots[-1].pose.x_m > 20.0
        tilts[roughness] = max(robot.tilt_rad for robot in robots)
    assert tilts[0.0] < 0.01 < tilts[1.0] < 0.12


def test_roughness_has_a_range() -> None:
    """A roughness beyond 1 is refused with the range."""
    with pytest.raises(
        UsageError, match=r"roughness is 1\.5, but it lies between 0 \(flat\) and 1"
    ):
        BulletWorld(StreetSurface(MAP, seed=1, roughness=1.5))
