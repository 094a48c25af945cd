"""Terrain: heights and creases by hand; cleaned, clamped or dropped elevations of nets; tiles on
the land."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.core.geometry import Pose
from cosim.place.street_map import Corner, Port
from cosim.place.terrain import (
    IMPLAUSIBLE_GRADE,
    ROBOT_GRADE_MAX,
    WALK_GRADE_MAX,
    Elevation,
    Terrain,
)
from cosim.spec.robot import COURIER
from physics.ground.tiles import CURB_M, RAMP_SLOPE, build_tile, ground_kind, tile_at, tile_bounds
from physics.street.street_surface import StreetSurface
from sumo_nets.net.elevation import (
    Course,
    CourseJunction,
    On,
    clamped,
    kind_at,
    parse_course,
    steep_ports,
    steep_strips,
    terrain_of_courses,
)
from sumo_nets.net.snapshot import map_as_bytes, map_from_bytes
from tests.support.tiny_street import KEYS, assert_no_cracks, plan_areas, tiny_map, triangles

HAND = Terrain(10.0, 20.0, 2.0, np.array([[0, 1, 2], [0, 1, 6]], dtype=np.float32))
"""One flat rise to the east, and a cell whose north-east corner is pulled up by 4 m."""


def hills(x0: float, y0: float, columns: int, rows: int) -> Terrain:
    """Return waves of some 8 %, 2 m apart, with a bend at every node."""
    x, y = np.meshgrid(x0 + 2.0 * np.arange(columns), y0 + 2.0 * np.arange(rows))
    return Terrain(
        x0,
        y0,
        2.0,
        (20.0 + 1.5 * np.sin(x / 20.0) + 1.2 * np.cos(y / 17.0 + x / 40.0)).astype(np.float32),
    )


HILLY = dataclasses.replace(tiny_map(), terrain=hills(-160.0, -160.0, 161, 161))


def test_heights_match_hand_computed_values() -> None:
    """Nodes, sides and the two triangles of a cell are exact, and beyond the lattice the heights at
    its edge continue."""
    points = [
        (10, 20),
        (12, 22),
        (11, 21),
        (14, 22),
        (13.5, 20.5),
        (12.5, 21.5),
        (100, 20),
        (12, -50),
        (14, 90),
    ]
    expected = [0, 1, 0.5, 6, 1.75 + 0.25 * 4, 1.25 + 0.25 * 4, 2, 1, 6]
    assert HAND.height(points).tolist() == expected


@given(st.lists(st.tuples(*[st.floats(-1e4, 1e4)] * 2), min_size=1, max_size=40))
def test_a_height_does_not_depend_on_other_points(points: list[tuple[float, float]]) -> None:
    """Many points at once get the same bits as each point alone."""
    terrain = HILLY.terrain
    assert terrain is not None
    assert terrain.height(points).tolist() == [
        float(terrain.height([point])[0]) for point in points
    ]


def straight(
    z: list[float], length_m: float = 100.0, y_m: float = 0.0, on: On = "street", edge: str = "e"
) -> Course:
    """Return a course eastwards with elevations at even distances, without zeros, as netconvert
    writes it."""
    at = zip(np.linspace(0.0, length_m, len(z)), z, strict=True)
    points = [f"{x:.2f},{y_m:.2f}" + ("" if h == 0.0 else f",{h:.2f}") for x, h in at]
    return parse_course(edge, " ".join(points), on)


def along(terrain: Terrain, length_m: float = 100.0, y_m: float = 0.0) -> np.ndarray:
    """Return heights above the map's zero at every metre of a street."""
    x = np.arange(0.0, length_m + 0.5)
    return terrain.height(np.column_stack([x, np.full(len(x), y_m)])) + terrain.datum_m


def test_missing_elevations_are_interpolated() -> None:
    """Missing elevations, which are 0 beside 60 m, and a spike are interpolated, and counted."""
    mixed = "0,0,60 12.5,0,61 25,0 37.5,0,0 50,0,64 62.5,0,65 75,0,95 87.5,0,67 100,0,68"
    terrain, found = terrain_of_courses([parse_course("e", mixed)])
    assert terrain is not None and found is not None
    assert (found.points, found.missing, found.clamped, found.dropped) == (9, 3, 0, "")
    assert np.abs(along(terrain) - np.linspace(60.0, 68.0, 101)).max() < 0.6


def test_a_place_at_sea_level_keeps_its_zeros() -> None:
    """A 0 that a street can descend to is an elevation."""
    terrain, found = terrain_of_courses([straight([0, 0, 1, 3, 6, 9])])
    assert terrain is not None and found is not None
    assert found.missing == 0
    assert abs(along(terrain)[0]) < 0.4


def test_the_land_is_level_across_a_street() -> None:
    """Left and right of a rising street the land is as high as on it."""
    terrain, _ = terrain_of_courses([straight([0, 10], y_m=y) for y in (-4.0, 0.0, 4.0)])
    assert terrain is not None
    spots = [(x, y) for x in range(15, 86) for y in (-5.0, 0.0, 5.0)]
    rise = terrain.gradient(spots)
    assert np.abs(rise[:, 1]).max() < 0.01
    assert rise[:, 0] == pytest.approx(0.1, abs=0.01)


def test_steep_streets_are_clamped_and_counted() -> None:
    """A fault of 6 m in the middle of a street becomes a ramp of the steepest allowed grade, and
    its ends stay."""
    terrain, found = terrain_of_courses([straight([20.0] * 20 + [26.0] * 20, 400.0)])
    assert terrain is not None and found is not None
    level = along(terrain, 400.0)
    assert np.abs(np.diff(level)).max() < WALK_GRADE_MAX + 0.01
    assert level[[0, -1]] == pytest.approx([20.0, 26.0], abs=0.05)
    assert found.clamped > 5 and 2.0 < found.moved_m < 3.1


def test_steps_stay_steep_and_do_not_move_streets() -> None:
    """Steps of 50 % between two streets do not move them, and no robot may use their strip."""
    up = parse_course("s", "50,0,10 50,20,20", "steps")
    terrain, found = terrain_of_courses([straight([10, 10]), up, straight([20, 20], y_m=20.0)])
    assert terrain is not None and found is not None and found.clamped == 0
    assert along(terrain) == pytest.approx(10.0, abs=0.2) and along(
        terrain, y_m=20.0
    ) == pytest.approx(20.0, abs=0.2)
    strip = next(iter(tiny_map().strips.values()))
    stairs = dataclasses.replace(
        strip, id="stairs", line=np.array([[50.0, 1.0], [50.0, 19.0]]), width_m=2.0
    )
    street = dataclasses.replace(
        strip, id="street", line=np.array([[0.0, 0.0], [100.0, 0.0]]), width_m=2.0
    )
    assert steep_strips(terrain, (stairs, street)) == ("stairs",)


def test_paths_up_hills_are_not_clamped() -> None:
    """Paths of 10 % and of 30 % keep their rise."""
    for rise_m in (10.0, 30.0):
        terrain, found = terrain_of_courses([straight([0.5, 0.5 + rise_m], on="path")])
        assert terrain is not None and found is not None and found.clamped == 0
        assert along(terrain)[-5] - along(terrain)[5] == pytest.approx(0.9 * rise_m, rel=0.03)


def test_false_elevations_are_dropped() -> None:
    """Spikes, steps of tens of metres, equal heights and too few heights give flat ground with the
    reason."""
    rng = np.random.default_rng(1)
    for courses, why in (
        (
            [straight(rng.uniform(0, 60, 60).tolist(), 400.0)],
            "of 60 points have one that can be true",
        ),
        ([straight(rng.uniform(0, 60, 20).repeat(3).tolist(), 400.0)], "are steeper than 25%"),
        ([straight([7.0] * 9)], "same everywhere"),
        ([straight([30.0, 31.0] + [0.0] * 7, 20.0)], "only 2 of 9 points"),
    ):
        terrain, found = terrain_of_courses(courses)
        assert terrain is None and found is not None and why in found.dropped


def test_a_flat_net_has_no_elevation() -> None:
    """Points without elevation, or with 0 only, give no terrain."""
    assert terrain_of_courses([parse_course("e", "0,0 9,9")]) == (None, None)
    assert terrain_of_courses([straight([0.0, 0.0])]) == (None, None)
    assert terrain_of_courses([]) == (None, None)


def test_bridges_steps_and_paths_are_recognised_by_type_and_params() -> None:
    """SUMO's type names, and OSM's tags in the params, are used."""
    assert kind_at("highway.secondary_tunnel", {}, False) == "raised"
    assert kind_at("highway.path", {"bridge": "yes"}, True) == "raised"
    assert (
        kind_at("highway.service", {"tunnel": "building_passage", "layer": "0"}, False) == "street"
    )
    assert kind_at("highway.steps", {}, True) == "steps"
    assert kind_at("highway.footway", {}, True) == "path"


HEIGHTS = st.one_of(
    st.just(math.nan), st.just(0.0), st.floats(-40.0, 90.0), st.floats(allow_nan=True, width=32)
)
LINES = st.lists(
    st.lists(
        st.tuples(st.floats(-90.0, 90.0), st.floats(-90.0, 90.0), HEIGHTS), min_size=1, max_size=8
    ),
    max_size=6,
)


@settings(max_examples=60)
@given(LINES, st.sampled_from(["street", "path", "steps", "raised"]), st.booleans())
def test_any_elevations_give_finite_terrain_or_a_reason(
    lines: list[list[tuple[float, float, float]]], on: On, ring: bool
) -> None:
    """Any net has a finite terrain or none, and a dropped one has its reason."""
    courses = [
        Course(f"e{i}", np.array(line), "street" if i else on, ring and i == 0)
        for i, line in enumerate(lines)
    ]
    meets = (
        [CourseJunction(0, tuple((i, i % 2) for i in range(1, len(courses))))]
        if len(courses) > 1
        else []
    )
    terrain, found = terrain_of_courses(courses, meets)
    assert terrain is None or np.isfinite(terrain.heights).all()
    assert found is None or (terrain is None) == bool(found.dropped)


@given(st.data(), st.integers(2, 30))
def test_clamped_heights_keep_their_bounds(data: st.DataObject, count: int) -> None:
    """On any graph with any heights no joint rises more than allowed, and valid heights are
    unchanged."""
    z = np.array(data.draw(st.lists(st.floats(-400.0, 5000.0), min_size=count, max_size=count)))
    joints = data.draw(
        st.lists(st.tuples(*[st.integers(0, count - 1)] * 2, st.floats(0.06, 3.0)), max_size=60)
    )
    tail, head = (np.array([j[k] for j in joints], dtype=np.intp) for k in (0, 1))
    most = np.array([j[2] for j in joints])
    level = clamped(z, tail, head, most)
    assert (np.abs(level[tail] - level[head]) <= most + 1e-4).all()
    assert clamped(level, tail, head, most + 1e-3) == pytest.approx(level)


def test_tiles_on_hills_have_no_cracks_and_lie_on_the_land() -> None:
    """Edges are shared by two triangles, and off the ramps triangles are within a millimetre of the
    land."""
    terrain = HILLY.terrain
    assert terrain is not None
    for key in [(-1, -1), (0, 0), (0, -1)]:
        tile = build_tile(HILLY, key)
        corners = np.concatenate([triangles(tile, name) for name in tile.parts])
        assert abs(plan_areas(corners).sum() - 48.0**2) < 1e-6
        assert_no_cracks(key, corners)
        for name in ("road", "sidewalk"):
            faces = triangles(tile, name)
            inside = faces[np.hypot(*(faces.mean(axis=1)[:, :2]).T) > 12.0].mean(axis=1)
            above = CURB_M if name == "sidewalk" else 0.0
            assert (
                len(inside)
                and np.abs(inside[:, 2] - terrain.height(inside[:, :2]) - above).max() < 1e-3
            )


def test_heights_on_hills_meet_at_tile_borders_and_follow_the_mesh() -> None:
    """Two tiles agree on their border, and a tile's heights are those of its own vertices."""
    left = build_tile(HILLY, (-1, -1))
    right = build_tile(HILLY, (0, -1))
    border = np.column_stack(
        [np.full(400, tile_bounds((0, -1))[0]), np.linspace(-40.0, -1e-3, 400)]
    )
    assert np.allclose(left.height(border), right.height(border), atol=1e-9)
    for name, mesh in right.parts.items():
        if ground_kind(name) in ("road", "ramp", "sidewalk"):
            middle = mesh.vertices[mesh.triangles].mean(axis=1)
            assert np.abs(right.height(middle[:, :2]) - middle[:, 2]).max() < 0.02, name


def test_ramps_rise_one_in_twelve_over_the_land() -> None:
    """Ahead of a crossing the ground is the land and the ramp's own rise, as on flat ground."""
    flat = build_tile(tiny_map(), tile_at(0.0, 5.0))
    hilly = build_tile(HILLY, tile_at(0.0, 5.0))
    assert HILLY.terrain is not None
    ahead = np.column_stack([np.zeros(60), np.linspace(3.51, 6.4, 60)])
    ramp = hilly.height(ahead) - HILLY.terrain.height(ahead)
    assert np.allclose(ramp, flat.height(ahead), atol=1e-9)
    assert np.diff(ramp).max() <= (ahead[1, 1] - ahead[0, 1]) * RAMP_SLOPE + 1e-9


def test_nothing_floats_on_a_hill() -> None:
    """Houses reach down to the lowest land around them and props to the lowest under them, and
    doors are at the street."""
    ground = StreetSurface(HILLY, 4)
    terrain = HILLY.terrain
    assert terrain is not None
    houses = [b for key in KEYS for b in ground.buildings(key)]
    assert len(houses) > 5
    for house in houses:
        around = shapely.get_coordinates(shapely.segmentize(house.polygon.exterior, 0.5))
        assert house.base_m <= terrain.height(around).min() + 0.05
        front = terrain.height(around[np.argsort(np.abs(around[:, 1]))[:3]])
        assert abs(front.mean() - house.floor_m) < 1.5
    for key in KEYS:
        for prop, z in ground.props(key):
            assert z <= float(ground.heights([(prop.x_m, prop.y_m)])[0]) + 1e-9
    z, roll, pitch = ground.road([(20.0, 1.0)], [0.0], [(4.5, 1.8)])[0]
    east, north = terrain.gradient([(20.0, 1.0)])[0]
    assert z == pytest.approx(float(terrain.height([(20.0, 1.0)])[0]), abs=0.03)
    assert (math.tan(-pitch), math.tan(roll)) == pytest.approx((east, north), abs=0.02)


def test_a_snapshot_stores_the_terrain() -> None:
    """Terrain and elevation are read back to the bit, and a flat map stays flat."""
    elevation = Elevation(1.5, 9.0, 20, 3, 0.01, 4, 0.5, ("a", "b"), (("c", 1),))
    restored = map_from_bytes(map_as_bytes(dataclasses.replace(HILLY, elevation=elevation)))
    assert (
        restored.terrain is not None
        and HILLY.terrain is not None
        and restored.elevation == elevation
    )
    assert np.array_equal(restored.terrain.heights, HILLY.terrain.heights)
    assert restored.terrain.heights.dtype == np.float32 and restored.terrain.step_m == 2.0
    assert (
        restored.steep == {"a", "b"}
        and Port("c", 1) in restored.too_steep
        and len(restored.too_steep) == 5
    )
    flat = map_from_bytes(map_as_bytes(tiny_map()))
    assert flat.terrain is None and flat.elevation is None


def test_corners_too_steep_to_cross_are_closed() -> None:
    """Of three ports the one above the others is closed, and on level land none is."""
    cliff = np.where(np.arange(40)[:, None] >= 22, 10.0, 0.0) * np.ones((1, 40))
    terrain = Terrain(-40.0, -40.0, 2.0, cliff.astype(np.float32))
    strip = next(iter(tiny_map().strips.values()))
    ends = {
        "low1": [(-20.0, 0.0), (-5.0, 0.0)],
        "low2": [(20.0, 0.0), (5.0, 0.0)],
        "high": [(0.0, 6.0), (0.0, 20.0)],
    }
    strips = {
        n: dataclasses.replace(strip, id=n, line=np.array(line), width_m=2.0)
        for n, line in ends.items()
    }
    corner = Corner(
        "w", shapely.box(-5, -2, 5, 6), (Port("low1", 1), Port("low2", 1), Port("high", 0))
    )
    assert steep_ports(terrain, strips, [corner], ()) == (("high", 0),)
    level = Terrain(-40.0, -40.0, 2.0, np.zeros((40, 40), dtype=np.float32))
    assert steep_ports(level, strips, [corner], ()) == ()


def test_flat_terrain_equals_no_terrain() -> None:
    """Without terrain a tile is at height 0, and terrain of height 0 gives the same heights and
    leans."""
    flat = StreetSurface(tiny_map(), 4)
    zero = Terrain(-200.0, -200.0, 2.0, np.zeros((200, 200), dtype=np.float32))
    level = StreetSurface(dataclasses.replace(tiny_map(), terrain=zero), 4)
    points = np.random.default_rng(2).uniform(-40.0, 40.0, (300, 2))
    assert flat.heights(points).tolist() == level.heights(points).tolist()
    pose = Pose(0.5, 4.0, 0.7)
    assert flat.lean(pose, COURIER.drive.span_m) == level.lean(pose, COURIER.drive.span_m)
    assert flat.road([(3.0, 1.0)], [1.0], [(4.0, 2.0)]).tolist() == [[0.0, 0.0, 0.0]]
    assert IMPLAUSIBLE_GRADE > ROBOT_GRADE_MAX > WALK_GRADE_MAX
