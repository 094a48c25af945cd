"""Map features beside streets: reading, projection, placement, storage and construction, and
invalid input."""

from __future__ import annotations

import dataclasses
import math
import os
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
import pytest
import shapely

from cosim.core.errors import MapError
from cosim.core.geometry import Pose
from cosim.core.state import Command, Street
from cosim.place.street_map import LAND_KINDS, Feature, Lane, StreetMap, Strip
from cosim.spec.scenario import CityMap
from physics.dynamics.world import BulletWorld
from physics.ground.tiles import TILE_M, tiles_within
from physics.street.buildings import BuildingRows, facade_meshes
from physics.street.clearance import clear_widths
from physics.street.furniture import footprints
from physics.street.mapped import BUILDING_EXCLUSION_M, PROP_EXCLUSION_M, MappedObjects
from physics.street.placement import props_of
from physics.street.street_surface import StreetSurface
from sumo_nets.maps.feature_file import FEATURES_FILE, read_features, with_features, write_features
from sumo_nets.maps.feature_fit import WALL_GAP_M, fit_features, utm_xy, utm_zone
from sumo_nets.maps.map_store import about_map, import_map, map_hash, map_net, read_map
from sumo_nets.maps.osm_features import (
    HIGHEST_BUILDING_M,
    LOWEST_M,
    MappedFeature,
    OsmFeatures,
    building_height_m,
    osm_features,
)
from sumo_nets.maps.osm_file import MapFile

SHARED = Path(os.environ.get("COSIM_SHARED", Path(__file__).parents[3] / "shared")) / "maps"
NEUKOELLN = SHARED / "berlin-neukoelln" / "input.osm.gz"
LON = 13.40
LAT = 52.50
Tags = dict[str, str]


@pytest.fixture(autouse=True, scope="module")
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Store maps in a separate folder for the module."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COSIM_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


class Drawing:
    """An OSM file in metres east and north of a point in Berlin."""

    def __init__(self) -> None:
        self.rows: list[str] = []
        self.count = 0

    def node(self, x: float, y: float, tags: Tags | None = None) -> int:
        self.count += 1
        lon = LON + x / (111_195.0 * math.cos(math.radians(LAT)))
        lat = LAT + y / 111_195.0
        self.rows.append(
            f'<node id="{self.count}" lon="{lon:.8f}" lat="{lat:.8f}">{_tags(tags or {})}</node>'
        )
        return self.count

    def way(self, refs: list[int], tags: Tags) -> int:
        self.count += 1
        inner = "".join(f'<nd ref="{ref}"/>' for ref in refs) + _tags(tags)
        self.rows.append(f'<way id="{self.count}">{inner}</way>')
        return self.count

    def outline(self, x0: float, y0: float, x1: float, y1: float, tags: Tags) -> int:
        refs = [self.node(x, y) for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))]
        return self.way([*refs, refs[0]], tags)

    def relation(self, members: list[tuple[int, str]], tags: Tags) -> None:
        self.count += 1
        inner = "".join(
            f'<member type="way" ref="{ref}" role="{role}"/>' for ref, role in members
        ) + _tags(tags)
        self.rows.append(f'<relation id="{self.count}">{inner}</relation>')

    def streets(self) -> None:
        """Add two streets that cross in the middle, with sidewalks."""
        middle = self.node(0, 0)
        for ends in (((-150, 0), (150, 0)), ((0, -150), (0, 150))):
            refs = [self.node(*ends[0]), middle, self.node(*ends[1])]
            self.way(refs, {"highway": "residential", "sidewalk": "both"})

    def write(self, path: Path) -> Path:
        rows = sorted(self.rows, key=lambda row: ("<node", "<way ", "<rela").index(row[:5]))
        path.write_text('<osm version="0.6">\n' + "\n".join(rows) + "\n</osm>\n", encoding="utf-8")
        return path

    def read_features(self, path: Path) -> tuple[list[MappedFeature], Counter[str]]:
        self.write(path)
        found = osm_features(MapFile(path, path, "osm", ""))
        return list(found.things), Counter(found.skipped)


def _tags(tags: Tags) -> str:
    return "".join(f"<tag k={quoteattr(k)} v={quoteattr(v)}/>" for k, v in tags.items())


@pytest.fixture(scope="module")
def drawn_map(tmp_path_factory: pytest.TempPathFactory) -> tuple[StreetMap, tuple[str, ...]]:
    """Import a small map with features in good and in bad places; return it with the changes of the
    importer."""
    drawing = Drawing()
    drawing.streets()
    for x in (30, 60, 90):
        drawing.node(x, 14.0, {"natural": "tree", "height": "7 m"})
    drawing.node(75, 14.0, {"highway": "street_lamp"})
    drawing.node(-40, 12.0, {"amenity": "bench", "direction": "S"})
    drawing.node(-60, 0.2, {"natural": "tree"})
    drawing.node(-90, 4.6, {"barrier": "bollard"})
    drawing.node(1.0, 1.0, {"amenity": "waste_basket"})
    drawing.outline(20, 20, 80, 45, {"building": "yes", "building:levels": "4"})
    outer = drawing.outline(-80, -45, -20, -3, {})
    inner = drawing.outline(-60, -35, -40, -25, {})
    drawing.relation(
        [(outer, "outer"), (inner, "inner")],
        {"type": "multipolygon", "building": "yes", "height": "50'"},
    )
    drawing.outline(60, -3, 75, 4, {"building": "yes"})
    drawing.outline(90, -60, 120, -10, {"amenity": "parking"})
    path = drawing.write(tmp_path_factory.mktemp("drawn") / "drawn.osm")
    import_map(path, "drawn")
    return read_map("drawn"), about_map("drawn").changes


def road_axis(street_map: StreetMap) -> float:
    """Return y of the middle of the street from west to east at its crossing, from its lanes."""
    lanes = [
        lane.polygon
        for lane in street_map.lanes.values()
        if lane.kind == "road" and not lane.internal
    ]
    east = [lane for lane in lanes if (b := lane.bounds)[2] - b[0] > 50.0]
    return float(shapely.union_all(east).centroid.y)


@pytest.mark.engine
def test_mapped_features_keep_their_place_beside_the_street(
    drawn_map: tuple[StreetMap, tuple[str, ...]],
) -> None:
    """A lamp 14 m from the middle line has this distance in the net, its arm points at the road,
    and a bench faces as mapped."""
    street_map, _ = drawn_map
    lanes = [
        lane for lane in street_map.lanes.values() if lane.kind == "road" and not lane.internal
    ]
    east = shapely.union_all(
        [lane.polygon for lane in lanes if abs(np.ptp(lane.line[:, 0])) > 50.0]
    )
    x0, _, x1, _ = east.bounds
    (lamp,) = (f for f in street_map.features if f.kind == "lamp")
    across = shapely.intersection(east, shapely.LineString([(lamp.x_m, -1e3), (lamp.x_m, 1e3)]))
    axis = shapely.centroid(across)
    tilt = math.radians(1.27)  # the grid's north is not the pole's
    assert x0 < lamp.x_m < x1
    assert (lamp.y_m - axis.y) * math.cos(tilt) == pytest.approx(14.0, abs=0.1)
    assert abs(lamp.heading_rad) == pytest.approx(math.pi, abs=0.05)
    (bench,) = (f for f in street_map.features if f.kind == "bench")
    assert bench.heading_rad == pytest.approx(0.0, abs=1e-3)


@pytest.mark.engine
def test_features_keep_off_streets(drawn_map: tuple[StreetMap, tuple[str, ...]]) -> None:
    """Buildings keep off all walked and driven ground and keep their courtyards; other features
    keep off roads and the middle of sidewalks. Moved, cut and dropped ones are reported."""
    street_map, changes = drawn_map
    message = " | ".join(changes)
    assert "taken from the map: 2 x building, 3 x tree" in message
    assert (
        "buildings cut back where they reached into streets (what is walked on wins): 1" in message
    )
    assert "buildings left out that lay mostly on streets or are none: 1" in message
    assert (
        "mapped things moved aside by up to 3 m, off the road or the middle of a sidewalk: 1"
        in message
    )
    assert "mapped things left out on a road, a crossing or in a narrow passage: 2" in message
    lanes = [p.polygon for p in street_map.lanes.values() if p.kind == "road"]
    walked = [p.polygon for p in (*street_map.strips.values(), *street_map.corners.values())]
    streets = shapely.union_all([*lanes, *walked])
    buildings = [f for f in street_map.features if f.kind == "building"]
    assert min(shapely.distance(f.polygon, streets) for f in buildings) > WALL_GAP_M - 0.03
    assert sorted(round(f.height_m, 2) for f in buildings) == [12.8, 15.24]
    assert sum(len(f.polygon.interiors) for f in buildings) == 1
    assert {round(math.sin(f.heading_rad)) for f in buildings} == {0}
    assert {
        (f.y_m > road_axis(street_map)) == (math.cos(f.heading_rad) > 0.9) for f in buildings
    } == {True}
    props = [p for p in props_of(street_map, 1) if p.id.startswith("prop:map")]
    assert Counter(p.kind for p in props) == {"tree": 3, "lamp": 1, "bench": 1, "bollard": 1}
    roads = shapely.union_all(lanes)
    assert min(shapely.distance(ground, roads) for ground in footprints(props)) > 0.0
    sidewalks = [s for s in street_map.strips.values() if s.kind == "sidewalk"]
    assert all(
        free >= min(1.2, bare) - 1e-6
        for free, bare in clear_widths(sidewalks, props_of(street_map, 1)).values()
    )


@pytest.mark.engine
def test_features_far_outside_of_the_map_are_dropped(
    drawn_map: tuple[StreetMap, tuple[str, ...]],
) -> None:
    """Points anywhere on earth, also where the projection has no value, add no feature."""
    location = {
        "projParameter": "+proj=utm +zone=33 +datum=WGS84",
        "netOffset": "-391000.0,-5817000.0",
    }
    spots = [
        (lon, lat)
        for lon in (-180.0, -165.0, -75.0, 0.0, 105.0, 180.0)
        for lat in (-85.0, 0.0, 52.5, 85.0)
    ]
    things = [MappedFeature("tree", (np.array([spot]),), 0.0, None) for spot in spots]
    square = np.array([(0.0, 0.0), (1e-3, 0.0), (1e-3, 1e-3), (0.0, 1e-3), (0.0, 0.0)])
    things += [
        MappedFeature(kind, (square + spot,), 9.0, None)
        for spot in spots
        for kind in ("building", "lawn")
    ]
    assert fit_features(OsmFeatures(tuple(things), {}), location, drawn_map[0]) == ((), [])


@pytest.mark.engine
def test_nothing_is_generated_near_mapped_features(
    drawn_map: tuple[StreetMap, tuple[str, ...]],
) -> None:
    """Near a mapped lamp or house no other is generated, and farther away or without features
    others are."""
    street_map, _ = drawn_map
    bare = dataclasses.replace(street_map, features=())
    (lamp,) = (f for f in street_map.features if f.kind == "lamp")
    away = [
        sorted(
            math.hypot(p.x_m - lamp.x_m, p.y_m - lamp.y_m)
            for p in props_of(place, seed)
            if p.kind == "lamp"
        )
        for place in (street_map, bare)
        for seed in range(4)
    ]
    assert all(found[0] == 0.0 and found[1] > PROP_EXCLUSION_M for found in away[:4])
    assert min(map(min, away[4:])) < PROP_EXCLUSION_M
    x0, y0, x1, y1 = street_map.bounds
    keys = tiles_within(0.5 * (x0 + x1), 0.5 * (y0 + y1), 300.0)
    rows = [
        b
        for key in keys
        for b in BuildingRows(street_map, 1, MappedObjects(street_map)).in_tile(key)
    ]
    made_up_houses = [b for b in rows if b.outline is None]
    near = shapely.union_all([f.polygon for f in street_map.features if f.kind == "building"])
    assert (
        made_up_houses
        and min(shapely.distance(b.polygon, near) for b in made_up_houses) > BUILDING_EXCLUSION_M
    )
    assert len([b for key in keys for b in BuildingRows(bare, 1).in_tile(key)]) > len(
        made_up_houses
    )


@pytest.mark.engine
def test_land_use_changes_only_looks_and_hash(
    drawn_map: tuple[StreetMap, tuple[str, ...]],
) -> None:
    """Land use changes no bit of the objects and the ground of a map."""
    street_map, changes = drawn_map
    (lot,) = (f for f in street_map.features if f.kind in LAND_KINDS)
    assert lot.kind == "yard" and "1 x yard" in " | ".join(changes)
    assert lot.polygon.area == pytest.approx(30.0 * 50.0, rel=0.01)
    bare = dataclasses.replace(
        street_map, features=tuple(f for f in street_map.features if f is not lot)
    )
    assert props_of(street_map, 1) == props_of(bare, 1)
    shown = []
    for key in tiles_within(lot.x_m, lot.y_m, 30.0):
        one, other = StreetSurface(street_map, 1), StreetSurface(bare, 1)
        chunks = [surface.chunk(key) for surface in (one, other)]
        felt = [
            [(p.name, p.friction, p.mesh.vertices.tobytes()) for p in chunk.ground]
            for chunk in chunks
        ]
        assert felt[0] == felt[1] and chunks[0].buildings == chunks[1].buildings
        shown += [patch.name for patch in one.covers(key)]
        assert "ground:yard" not in [patch.name for patch in other.covers(key)]
    assert "ground:yard" in shown


def test_land_use_is_read_from_osm_tags(tmp_path: Path) -> None:
    """Parks, woods with clearings, water, building sites and parking lots are land. Areas above or
    below the ground, and open or torn outlines, are not."""
    drawing = Drawing()
    for x, tags in enumerate(
        (
            {"leisure": "park"},
            {"landuse": "construction"},
            {"amenity": "parking", "parking": "surface"},
            {"highway": "pedestrian", "area": "yes"},
            {"natural": "water"},
            {"landuse": "residential"},
            {"amenity": "parking", "parking": "underground"},
            {"amenity": "parking", "building": "yes"},
            {"highway": "pedestrian"},
            {"leisure": "park", "layer": "1"},
            {"natural": "water", "tunnel": "culvert"},
        )
    ):
        drawing.outline(100.0 * x, 0.0, 100.0 * x + 50.0, 50.0, tags)
    outer, inner = drawing.outline(0, 100, 90, 190, {}), drawing.outline(30, 130, 60, 160, {})
    drawing.relation(
        [(outer, "outer"), (inner, "inner")], {"type": "multipolygon", "natural": "wood"}
    )
    a, b, c, d = (drawing.node(x, y) for x, y in ((0, 0), (9, 9), (9, 0), (0, 9)))
    drawing.way([a, b, c, d, a], {"leisure": "park"})
    drawing.way([a, 99_999, b, a], {"leisure": "park"})
    drawing.way([a, c, b, d], {"leisure": "park"})
    drawing.relation([(99_998, "outer")], {"type": "multipolygon", "natural": "wood"})
    things, skipped = drawing.read_features(tmp_path / "land.osm")
    lands = [thing for thing in things if thing.kind in LAND_KINDS]
    assert [thing.kind for thing in lands] == ["lawn", "soil", "yard", "yard", "water", "planting"]
    assert len(lands[-1].rings) == 2
    assert skipped == {
        "pieces of land with an open outline": 1,
        "pieces of land with missing nodes": 1,
        "pieces of land whose outline crosses itself": 1,
    }


def house(*corners: tuple[float, float], height_m: float = 9.0) -> Feature:
    polygon = shapely.Polygon(corners)
    return Feature("building", polygon.centroid.x, polygon.centroid.y, 0.0, height_m, polygon)


def lone_map(*features: Feature) -> StreetMap:
    """Return a sidewalk along x, 3 m wide, on open ground."""
    line = np.array([[-60.0, 0.0], [60.0, 0.0]])
    strip = Strip(
        "s", "sidewalk", line, 3.0, shapely.box(-60, -1.5, 60, 1.5), (None, None), road_side=0
    )
    lane = Lane("r_0", "r", "road", line - (0.0, 5.0), 3.0, shapely.box(-60, -6.5, 60, -3.5))
    return StreetMap(
        "lone", (-60, -20, 60, 20), {"s": strip}, {}, {"r_0": lane}, {}, features=features
    )


def test_a_house_is_divided_by_tiles_completely() -> None:
    """The parts cover the house once, only its own walls are walls, and the mesh has the area of
    walls and roof."""
    place = lone_map(
        house((-40, 4), (40, 4), (40, 60), (10, 60), (10, 20), (-40, 20), height_m=7.5)
    )
    things = MappedObjects(place)
    outline = place.features[0].polygon
    parts = [b for key in tiles_within(0.0, 0.0, 2.0 * TILE_M) for b in things.buildings(key)]
    assert len(parts) == 3
    assert sum(b.polygon.area for b in parts) == pytest.approx(outline.area)
    assert {b.id for b in parts} == {"building:map:0"} and len({b.facade for b in parts}) == 1
    lengths = [math.dist(w[:2], w[2:]) for b in parts for w in b.walls]
    assert sum(lengths) == pytest.approx(outline.length)
    walls = [mesh for facade, mesh in facade_meshes(tuple(parts)).items() if facade >= 0]
    area = 0.0
    for mesh in walls:
        corners = mesh.vertices[mesh.triangles]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area += 0.5 * float(np.linalg.norm(cross, axis=1).sum())
        assert np.all((cross * mesh.normals[mesh.triangles[:, 0]]).sum(axis=1) > 0.0)
        assert mesh.vertices[:, 2].max() == pytest.approx(7.62)
    assert area == pytest.approx(outline.area + 7.5 * outline.length)


@pytest.mark.engine
def test_the_robot_stops_at_a_mapped_wall() -> None:
    """A robot that drives at a slanting wall touches it as a wall and does not pass."""
    place = lone_map(house((0, 3), (14, 12), (0, 20), (-14, 12)))
    with BulletWorld(StreetSurface(place, seed=1)) as world:
        world.place(Pose(3.0, -0.5, math.pi / 2))
        motions = [world.step(Command(1.0, 0.0), Street(0), Street(0), 10) for _ in range(160)]
    assert {(c.kind, c.other.split(":")[1]) for m in motions for c in m.contacts} == {
        ("wall", "map")
    }
    assert not place.features[0].polygon.contains(shapely.Point(motions[-1].robot.pose.xy))


def test_features_survive_their_file_and_change_the_hash(tmp_path: Path) -> None:
    """Written features are read back equal, a broken file is named, and the hash of a map covers
    them."""
    lot = Feature("yard", 24.0, 4.0, polygon=shapely.box(20.0, 0.0, 29.0, 8.0))
    features = (house((0, 0), (9, 0), (9, 9), (0, 9)), Feature("tree", 3.5, -2.25, 0.1, 6.0), lot)
    path = tmp_path / FEATURES_FILE
    assert read_features(path) == () and with_features("abc", path) == "abc"
    write_features(features, path)
    assert read_features(path) == features
    assert with_features("abc", path) not in ("abc", with_features("abd", path))
    good = path.read_text()
    for broken in (
        good[:-9],
        good.replace("tree", "ufo"),
        good.replace("6.0", "-6.0"),
        good.replace("9.0", "0.0"),
        "[]",
    ):
        path.write_text(broken)
        with pytest.raises(
            MapError, match=r"features\.json: cannot be read: .*: import the map again"
        ):
            read_features(path)


@pytest.mark.engine
def test_a_scenario_of_other_features_is_refused(
    drawn_map: tuple[StreetMap, tuple[str, ...]],
) -> None:
    """The hash in a scenario's place covers net and features together."""
    street_map, _ = drawn_map
    net = map_net("drawn")
    assert street_map.net_hash == map_hash(net) == about_map("drawn").net_hash
    assert map_net(CityMap(map="drawn", net_hash=street_map.net_hash)) == net
    kept = net.with_name(FEATURES_FILE).read_bytes()
    try:
        write_features(street_map.features[1:], net.with_name(FEATURES_FILE))
        with pytest.raises(MapError, match="but the scenario was made on"):
            map_net(CityMap(map="drawn", net_hash=street_map.net_hash))
    finally:
        net.with_name(FEATURES_FILE).write_bytes(kept)


@pytest.mark.parametrize(
    ("tags", "height_m", "unread"),
    [
        ({"height": "12"}, 12.0, 0),
        ({"height": "12.5 m"}, 12.5, 0),
        ({"height": "12,5"}, 12.5, 0),
        ({"height": "40'"}, 12.192, 0),
        ({"height": "5'6\""}, LOWEST_M, 0),
        ({"building:levels": "5"}, 16.0, 0),
        ({"height": "tall"}, 9.6, 1),
        ({"height": "1e9"}, 9.6, 1),
        ({"height": "99999"}, 9.6, 1),
        ({"height": "-4"}, 9.6, 1),
        ({"height": "nan", "building:levels": "2"}, 6.4, 1),
        ({"height": "0"}, 9.6, 0),
        ({"height": "800"}, HIGHEST_BUILDING_M, 0),
        ({"building": "garage"}, 3.2, 0),
        ({"building": "house"}, 6.4, 0),
    ],
)
def test_building_heights_are_read_from_osm_tags(tags: Tags, height_m: float, unread: int) -> None:
    """Metres, feet and storeys are read; invalid values are counted, and the kind of building gives
    the height."""
    skipped: Counter[str] = Counter()
    assert building_height_m({"building": "yes"} | tags, 200.0, skipped) == pytest.approx(height_m)
    assert sum(skipped.values()) == unread


def test_invalid_building_outlines_are_dropped_and_counted(tmp_path: Path) -> None:
    """Open, crossed, tiny, torn, hanging and underground buildings are dropped, and the valid one
    stays."""
    drawing = Drawing()
    house_tags = {"building": "yes"}
    drawing.outline(0, 0, 10, 10, house_tags)
    a, b, c, d = (drawing.node(x, y) for x, y in ((0, 0), (9, 9), (9, 0), (0, 9)))
    drawing.way([a, b, c, d, a], house_tags)
    drawing.way([a, c, b, d], house_tags)
    drawing.way([a, 99_999, b, a], house_tags)
    drawing.way([], house_tags)
    drawing.outline(0, 0, 0.1, 0.1, house_tags)
    drawing.outline(0, 0, 10, 10, {"building": "roof"})
    drawing.outline(0, 0, 10, 10, {"building": "yes", "layer": "-1"})
    drawing.outline(0, 0, 10, 10, {"building": "yes", "min_height": "6"})
    half = drawing.way([a, c, b], {})
    drawing.relation([(half, "outer")], {"type": "multipolygon", "building": "yes"})
    drawing.relation(
        [(half, "outer"), (99_999, "outer")], {"type": "multipolygon", "building": "yes"}
    )
    things, skipped = drawing.read_features(tmp_path / "broken.osm")
    assert [thing.kind for thing in things] == ["building"]
    assert skipped == {
        "buildings whose outline crosses itself": 1,
        "buildings with an open outline": 4,
        "buildings with missing nodes": 1,
        "buildings too small or too large to be one": 1,
        "roofs, ruins and plans of buildings": 1,
        "buildings above or under the ground": 2,
    }


def test_the_projection_is_utm_or_none() -> None:
    """Points agree with PROJ's own test tables to the millimetre, and other projections are
    recognised."""
    proj = "+proj=utm +zone=32 +ellps=WGS84 +datum=WGS84 +units=m +no_defs"
    assert utm_zone(proj) == (32, False) and utm_zone(proj + " +south") == (32, True)
    assert (
        utm_zone("!") is None
        and utm_zone("+proj=tmerc +lat_0=0") is None
        and utm_zone("+proj=utm +zone=99") is None
    )
    on_axis = utm_xy(np.array([[9.0, 0.0], [9.0, 45.0]]), 32, False)
    assert on_axis[:, 0] == pytest.approx(500_000.0, abs=1e-6)
    assert on_axis[1, 1] == pytest.approx(4_982_950.400, abs=1e-3)
    south = utm_xy(np.array([[9.0, -45.0]]), 32, True)
    assert south[0, 1] == pytest.approx(10_000_000.0 - 4_982_950.400, abs=1e-3)


@pytest.mark.engine
@pytest.mark.skipif(not NEUKOELLN.exists(), reason="the shared maps are not here")
def test_a_detailed_place_is_built_as_mapped() -> None:
    """In Neukölln most lamps, trees and houses remain, none on a road, and every walk has its free
    width."""
    import_map(NEUKOELLN, "neukoelln")
    street_map = read_map("neukoelln")
    counts = Counter(f.kind for f in street_map.features)
    assert (
        counts["building"] > 110
        and counts["tree"] > 120
        and counts["lamp"] > 38
        and counts["bench"] > 14
    )
    props = props_of(street_map, 0)
    mapped = [p for p in props if p.id.startswith("prop:map")]
    roads = shapely.STRtree(
        [lane.polygon for lane in street_map.lanes.values() if lane.kind == "road"]
    )
    assert not len(roads.query(footprints(mapped), predicate="intersects")[0])
    sidewalks = [s for s in street_map.strips.values() if s.kind == "sidewalk"]
    assert all(
        free >= min(1.2, bare) - 1e-6 for free, bare in clear_widths(sidewalks, props).values()
    )
