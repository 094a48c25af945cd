"""Walking nets of scans: drawn ground, crossings, the crowd, and the map store."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import shapely

from cosim.core.errors import MapError
from cosim.core.geometry import Pose
from cosim.core.state import RobotState
from cosim.place.scan import Georeference, ScanArea
from cosim.place.scan_areas import walkable_ground
from cosim.place.street_map import Port, StreetMap, Strip
from cosim.place.walk_graph import WalkGraph
from cosim.spec.events import EventReply
from cosim.spec.scenario import CrowdSpec
from sumo_nets.crowd.crowd import (
    SumoCrowd,
    sumo,  # the engine that runs
)
from sumo_nets.maps.ground_file import GROUND_FILE, with_drawn_ground
from sumo_nets.maps.map_store import map_hash, map_net, maps_folder, read_map
from sumo_nets.maps.scan_net import build_scan_net
from sumo_nets.net.net_file import read_net
from sumo_nets.net.snapshot import street_map_of
from tests.support.flat_scans import STREET_GRID, flat_grid, store_flat, street_areas

pytestmark = pytest.mark.engine

NAME = "flat-street"


def reply(tick: int) -> EventReply:
    """Return a reply without event pedestrians."""
    return EventReply(episode="test", tick=tick, states=(), actors=())


@pytest.fixture(scope="module")
def street(own_cache: None) -> Iterator[StreetMap]:
    """Store and return the map of the drawn street."""
    findings = store_flat(NAME, street_areas())
    assert any("865 m2 are walkable" in words for words in findings)
    yield read_map(NAME)


def test_the_map_has_the_drawn_ground_and_sumo_its_inner_part(street: StreetMap) -> None:
    """Strips and corners together are the drawn ground to the square millimetre, and SUMO's lanes
    and corners are most of it."""
    drawn = walkable_ground(street_areas(), STREET_GRID)
    assert street.scanned
    assert shapely.symmetric_difference(drawn, street.walkable).area < 1e-6
    pieces = [piece.polygon for piece in (*street.strips.values(), *street.corners.values())]
    assert sum(piece.area for piece in pieces) == pytest.approx(drawn.area, abs=0.1)
    assert all(piece.is_valid for piece in pieces)
    raw = street_map_of(map_net(NAME))
    lanes = shapely.union_all(
        [piece.polygon for piece in (*raw.strips.values(), *raw.corners.values())]
    )
    both = shapely.intersection(lanes, drawn).area
    assert both / (lanes.area + drawn.area - both) > 0.75
    assert 1.0 - both / lanes.area < 0.005


def test_places_are_in_their_pieces(street: StreetMap) -> None:
    """The middle of every strip is located on it, also beside SUMO's lanes, and the road is a
    road."""
    for strip in street.strips.values():
        x, y = shapely.get_coordinates(shapely.point_on_surface(strip.polygon))[0]
        assert street.locate(x, y).edge == strip.id
    assert street.locate(20.0, 0.05).kind == "walk"
    assert street.locate(20.0, 5.0).kind == "road"
    assert street.locate(50.0, 6.5).edge.endswith("_c0")


def test_a_drawn_crossing_leads_over_the_drawn_road(street: StreetMap) -> None:
    """It crosses the edges of the road, ends at the curbs, and joins both sides."""
    (crossing,) = (strip for strip in street.strips.values() if strip.kind == "crossing")
    assert sorted(crossing.line[:, 1].tolist()) == pytest.approx([3.0, 10.0], abs=0.05)
    assert crossing.line[:, 0].tolist() == pytest.approx([50.0, 50.0], abs=0.05)
    assert len(crossing.crosses) == 2
    graph = WalkGraph(street)
    assert len(graph.main_strips) == len(street.strips)
    ends = [strip.id for strip in street.strips.values() if strip.line[:, 1].max() > 50.0]
    starts = [
        strip.id for strip in street.strips.values() if abs(strip.line[:, 1] - 1.5).max() < 0.1
    ]
    path, metres = graph.shortest(Port(starts[0], 0), Port(ends[0], 1)) or ([], 0.0)
    assert any(port.strip == crossing.id for port in path) and metres > 90.0
    assert {lane.edge for lane in street.lanes.values() if lane.cars and not lane.internal}


@pytest.mark.parametrize(
    "georeference",
    [None, Georeference(latitude_deg=51.5, longitude_deg=-0.1)],
    ids=["right", "left"],
)
def test_traffic_keeps_to_the_side_of_the_country(
    tmp_path: Path, georeference: Georeference | None
) -> None:
    """In London the lanes of a road are on the left, and the crossing exists, too."""
    net = read_net(build_scan_net(street_areas(), STREET_GRID, georeference, tmp_path).path)
    assert net.left_hand == (georeference is not None)
    east = next(
        lane
        for lane in net.lanes.values()
        if not lane.internal and lane.line[-1, 0] > lane.line[0, 0]
    )
    assert (east.line[:, 1].mean() > 6.5) == net.left_hand
    assert sum(strip.kind == "crossing" for strip in net.strips.values()) == 1


def test_the_crowd_stays_on_the_drawn_ground(street: StreetMap) -> None:
    """In a minute, SUMO's people are on it for 99.5 % of the time and the displayed ones for 99.9
    %, also on the crossing; they enter and leave at the edge of the scan."""
    spec = CrowdSpec(persons=40, radius_m=80.0, vehicles=2)
    ground = shapely.buffer(street.walkable, 1e-6)
    shapely.prepare(ground)
    pose = Pose(30.0, 1.5, 0.0)
    shown, simulated, crossed = [], [], set[str]()
    names: list[set[str]] = []
    with SumoCrowd(map_net(NAME), street, spec, 3, frozenset(), pose.xy) as crowd:
        for tick in range(1200):
            people = crowd.step(RobotState(pose), reply(tick)).people
            shown.append(people.xy)
            simulated += [sumo.person.getPosition(name) for name in people.ids]
            crossed |= {
                name
                for name, (x, y) in zip(people.ids, people.xy.tolist(), strict=True)
                if 48 < x < 52 and 4 < y < 9
            }
            names.append(set(people.ids))
    xy, raw = np.concatenate(shown), np.array(simulated)
    assert len(xy) > 20_000
    assert shapely.contains_xy(ground, xy[:, 0], xy[:, 1]).mean() >= 0.999
    assert shapely.contains_xy(ground, raw[:, 0], raw[:, 1]).mean() >= 0.995
    assert len(crossed) >= 2
    assert len(names[-1] - names[0]) >= 5 and len(names[0] - names[-1]) >= 5


def test_narrow_places_carry_the_robot_but_no_crowd(own_cache: None) -> None:
    """No person of the crowd is in a passage of 1 m, which is reported, and robots may use it."""
    box = shapely.box
    areas = [ScanArea("sidewalk", box(0, 0, 40, 3)), ScanArea("sidewalk", box(60, 0, 100, 3))]
    areas.append(ScanArea("sidewalk", box(40, 1, 60, 2)))
    (words,) = (one for one in store_flat("narrow", areas) if "narrower than 1.2 m" in one)
    assert "robots may use them, the crowd does not" in words
    street_map = read_map("narrow")
    (passage,) = (street_map.strips[name] for name in street_map.uncrowded)
    assert passage.width_m == pytest.approx(1.0, abs=0.06)
    assert passage.id in WalkGraph(street_map).main_strips
    inside = box(42, 0, 58, 3)
    spec = CrowdSpec(persons=20, radius_m=60.0, vehicles=0)
    with SumoCrowd(map_net("narrow"), street_map, spec, 1, frozenset(), (20.0, 1.5)) as crowd:
        for tick in range(400):
            robot = RobotState(Pose(20.0, 1.5, 0.0))
            people = crowd.step(robot, reply(tick)).people
            assert not shapely.contains_xy(inside, people.xy[:, 0], people.xy[:, 1]).any()
        assert len(people.ids) >= 3


def test_the_hash_covers_the_drawn_ground(street: StreetMap) -> None:
    """Another drawn ground on the same net is another map, and a damaged file is refused."""
    folder = maps_folder() / NAME
    before = map_hash(folder / "net.xml")
    assert before == street.net_hash
    data = (folder / GROUND_FILE).read_bytes()
    try:
        (folder / GROUND_FILE).write_bytes(data.replace(b'"uncrowded":[]', b'"uncrowded":["w0"]'))
        assert map_hash(folder / "net.xml") != before
        (folder / GROUND_FILE).write_bytes(data[: len(data) // 2])
        with pytest.raises(
            MapError, match=r"ground\.json: cannot be read: .*import the scan again"
        ):
            read_map(NAME)
        (folder / GROUND_FILE).write_bytes(data.replace(b'"w0":[[', b'"w99":[['))
        with pytest.raises(MapError, match="its strips are not those of the net"):
            with_drawn_ground(street_map_of(folder / "net.xml"), folder / GROUND_FILE)
    finally:
        (folder / GROUND_FILE).write_bytes(data)


def test_a_crossing_of_a_short_road_is_a_crossing(tmp_path: Path) -> None:
    """It gets a piece of road without cars, and joins both sidewalks."""
    box = shapely.box
    areas = [
        ScanArea("sidewalk", box(0, 0, 30, 3)),
        ScanArea("sidewalk", box(0, 9, 30, 12)),
        ScanArea("road", box(10, 3, 20, 9)),
        ScanArea("crossing", box(13, 3, 17, 9)),
    ]
    net = build_scan_net(areas, flat_grid(-1, -1, 31, 13), None, tmp_path)
    street_map = with_drawn_ground(read_net(net.path), tmp_path / GROUND_FILE)
    assert [strip.kind for strip in street_map.strips.values()].count("crossing") == 1
    assert WalkGraph(street_map).component.max() == 0
    over = [
        lane for lane in street_map.lanes.values() if lane.polygon.intersects(box(14, 5, 16, 7))
    ]
    assert over and not any(lane.cars for lane in over)


def test_a_crossing_that_leads_nowhere_stays_walkable(tmp_path: Path) -> None:
    """A crossing without a sidewalk at one end is walkable ground, and the finding says why."""
    box = shapely.box
    areas = [
        ScanArea("sidewalk", box(0, 0, 30, 3)),
        ScanArea("road", box(0, 3, 30, 40)),
        ScanArea("crossing", box(13, 3, 17, 30)),
    ]
    net = build_scan_net(areas, flat_grid(-1, -1, 31, 41), None, tmp_path)
    assert any("cars do not stop there: it " in words for words in net.findings), net.findings
    street_map = with_drawn_ground(read_net(net.path), tmp_path / GROUND_FILE)
    assert all(strip.kind == "sidewalk" for strip in street_map.strips.values())


def test_equal_areas_give_equal_bytes(tmp_path: Path) -> None:
    """Nets and shares depend on the areas alone."""
    made = []
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        build_scan_net(street_areas(), STREET_GRID, None, tmp_path / name)
        made.append((tmp_path / name / GROUND_FILE).read_bytes())
        strips = read_net(tmp_path / name / "net.xml").strips
        made.append(repr([_without_polygon(strip) for strip in strips.values()]).encode())
    assert made[:2] == made[2:]


def _without_polygon(strip: Strip) -> tuple[object, ...]:
    return (strip.id, strip.line.tolist(), strip.width_m, strip.corners, strip.polygon.wkt)


def test_ground_without_width_is_refused(tmp_path: Path) -> None:
    """Areas that no robot passes give no net."""
    areas = [ScanArea("sidewalk", shapely.box(0, 0, 30, 0.6))]
    with pytest.raises(MapError, match="nowhere wide enough to walk"):
        build_scan_net(areas, flat_grid(-1, -1, 31, 3), None, tmp_path)
    nothing = dataclasses.replace(STREET_GRID, measured=np.zeros_like(STREET_GRID.measured))
    with pytest.raises(MapError, match="nothing of the drawn areas is walkable"):
        build_scan_net(street_areas(), nothing, None, tmp_path)
