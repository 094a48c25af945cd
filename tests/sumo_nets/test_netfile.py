"""The reader of street nets, on a made-up net small enough to check by hand."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest
import shapely

from cosim.core.errors import MapError
from cosim.place.street_map import Port
from cosim.spec.scenario import City
from sumo_nets.city.store import city_net
from sumo_nets.net.net_file import read_net
from sumo_nets.net.raw_file import net_content_hash
from sumo_nets.net.snapshot import street_map_of

NET = """<?xml version="1.0" encoding="UTF-8"?>
<!-- generated on 2020-01-01 in /somewhere -->
<net version="1.20">
    <location netOffset="0,0" convBoundary="0.00,0.00,110.00,50.00" origBoundary="0,0,0,0" projParameter="!"/>
    <edge id=":J_0" function="internal"><lane id=":J_0_0" index="0" disallow="pedestrian" speed="9" length="8"
        shape="50,6 58,6"/></edge>
    <edge id=":J_c0" function="crossing" crossingEdges="in out"><lane id=":J_c0_0" index="0" allow="pedestrian"
        speed="2" length="6.4" width="3.20" shape="51.6,9.6 51.6,3.2"/></edge>
    <edge id=":J_w0" function="walkingarea"><lane id=":J_w0_0" index="0" allow="pedestrian" speed="2" length="3"
        width="1.92" shape="50,0 58,0 58,3.2 50,3.2"/></edge>
    <edge id=":J_w1" function="walkingarea"><lane id=":J_w1_0" index="0" allow="pedestrian" speed="2" length="3"
        width="1.92" shape="50,9.6 58,12.8 58,9.6 50,12.8"/></edge>
    <edge id=":K_w0" function="walkingarea"><lane id=":K_w0_0" index="0" allow="pedestrian" speed="2" length="3"
        width="1.92" shape="0,0 0,3.2 0,0"/></edge>
    <edge id="in" from="K" to="J" priority="3" type="highway.residential">
        <lane id="in_0" index="0" allow="pedestrian" speed="9" length="50" width="3.20" shape="0,1.6,7 50,1.6"/>
        <lane id="in_1" index="1" disallow="all" length="50" width="1.60" type="green_verge" shape="0,4 50,4"/>
        <lane id="in_2" index="2" disallow="pedestrian" speed="9" length="50" shape="0,6.4 50,6.4"/>
        <param key="frontage_m" value="1.5"/>
    </edge>
    <edge id="path" from="J" to="L"><lane id="path_0" index="0" allow="pedestrian bicycle" speed="9" length="50"
        shape="58,1.6 108,1.6"/></edge>
    <junction id="J" type="traffic_light" x="54" y="6" incLanes="in_2" intLanes="" shape="50,0 58,0 58,12.8 50,12.8"/>
    <junction id=":J_0_0" type="internal" x="54" y="6" incLanes="" intLanes=""/>
    <connection from="in" to=":J_w0" fromLane="0" toLane="0" dir="s" state="M"/>
    <connection from=":J_w0" to="path" fromLane="0" toLane="0" dir="s" state="M"/>
    <connection from=":J_w0" to=":J_c0" fromLane="0" toLane="0" tl="J" linkIndex="1" dir="s" state="M"/>
    <connection from=":J_c0" to=":J_w1" fromLane="0" toLane="0" dir="s" state="M"/>
    <connection from=":K_w0" to="in" fromLane="0" toLane="0" dir="s" state="M"/>
</net>
"""


def written(folder: Path, text: str, name: str = "small.net.xml") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def test_trains_and_ships_have_no_road_but_trams_do(tmp_path: Path) -> None:
    """Lanes of railways, ferries and generic rail are not read, and those of trams and buses
    are."""
    row = (
        '<edge id="{0}" from="L" to="M"><lane id="{0}_0" index="0" allow="{1}" length="9" '
        'shape="900,0 909,0"/></edge>'
    )
    allowed = {
        "railway": "rail rail_electric rail_fast",
        "any": "rail_urban rail tram ship",
        "ferry": "ship",
        "light": "rail_urban",
        "tram": "tram",
        "shared": "tram bus rail",
    }
    rows = "".join(row.format(*pair) for pair in allowed.items())
    place = read_net(written(tmp_path, NET.replace("<junction", rows + "<junction", 1)))
    assert {lane.edge for lane in place.lanes.values()} & allowed.keys() == {
        "light",
        "tram",
        "shared",
    }


def test_stairs_bridges_and_tunnels_are_recognised(tmp_path: Path) -> None:
    """The type of the edge and its bridge, tunnel and layer decide; a passage through a house is
    plain."""
    edges = {
        "stairs": ("highway.footway|highway.steps", "", ""),
        "deck": ("highway.footway", "bridge", "viaduct"),
        "subway": ("highway.footway", "tunnel", "yes"),
        "above": ("highway.footway", "layer", "1"),
        "passage": ("highway.footway", "tunnel", "building_passage"),
    }
    lane = '<lane id="{0}_0" index="0" allow="pedestrian" length="9" shape="90,20 99,20"/>'
    row = (
        '<edge id="{0}" from="L" to="M" type="{1}">'
        + lane
        + '<param key="{2}" value="{3}"/></edge>'
    )
    rows = "".join(row.format(name, *words) for name, words in edges.items())
    strips = read_net(written(tmp_path, NET.replace("<junction", rows + "<junction", 1))).strips
    going = {
        "stairs": "steps",
        "deck": "bridge",
        "subway": "bridge",
        "above": "bridge",
        "passage": "plain",
    }
    assert {name: strips[name].going for name in edges} == going and strips["path"].going == "plain"


def test_edges_become_strips_lanes_and_corners(tmp_path: Path) -> None:
    """Sidewalks, shared paths and crossings are strips, verges and carriageways lanes, and walking
    areas corners."""
    place = read_net(written(tmp_path, NET))
    assert {strip.id: strip.kind for strip in place.strips.values()} == {
        ":J_c0": "crossing",
        "in": "sidewalk",
        "path": "sidewalk",
    }
    assert {lane.id: (lane.kind, lane.internal) for lane in place.lanes.values()} == {
        ":J_0_0": ("road", True),
        "in_1": ("verge", False),
        "in_2": ("road", False),
    }
    assert place.name == "small"
    assert place.junctions["J"].signalised and list(place.junctions) == ["J"]
    assert not place.left_hand


def test_a_strip_has_the_values_of_its_street(tmp_path: Path) -> None:
    """Params override defaults, a missing width is 3.2 m, elevations are dropped, and a path has no
    road."""
    place = read_net(written(tmp_path, NET))
    side, path, crossing = place.strips["in"], place.strips["path"], place.strips[":J_c0"]
    assert (side.frontage_m, side.verge_m, side.curb_m, side.road_side) == (1.5, 1.6, 0.3, 1)
    assert side.street_class == "highway.residential"
    assert side.line.tolist() == [[0.0, 1.6], [50.0, 1.6]]
    assert (path.width_m, path.road_side, path.curb_m) == (3.2, 0, 0.0)
    assert crossing.signalised and crossing.crosses == ("in", "out")
    assert place.lanes["in_1"].polygon.area == pytest.approx(80.0)


def test_ports_follow_geometry_where_connections_run_backwards(tmp_path: Path) -> None:
    """The crossing's line starts at :J_w1, though its connections start at :J_w0."""
    place = read_net(written(tmp_path, NET))
    assert place.strips[":J_c0"].corners == (":J_w1", ":J_w0")
    assert set(place.corners[":J_w0"].ports) == {Port("in", 1), Port("path", 0), Port(":J_c0", 1)}
    assert place.strips["path"].corners == (":J_w0", None)


def test_broken_walking_areas_are_repaired_and_specks_dropped(tmp_path: Path) -> None:
    """A self-intersecting ring becomes a valid polygon, and an empty area at a dead end is
    dropped."""
    place = read_net(written(tmp_path, NET))
    assert place.corners[":J_w1"].polygon.is_valid and place.corners[":J_w1"].polygon.area > 5.0
    assert ":K_w0" not in place.corners
    assert place.strips["in"].corners == (None, ":J_w0")


def test_left_hand_nets_have_the_road_on_the_other_side(tmp_path: Path) -> None:
    """lefthand="true" reverses road_side."""
    place = read_net(written(tmp_path, NET.replace("<net ", '<net lefthand="true" ')))
    assert place.left_hand and place.strips["in"].road_side == -1


def test_hash_ignores_comments_and_packing_but_not_content(tmp_path: Path) -> None:
    """Time stamps, folders, line ends and gzip do not count, and one centimetre does."""
    plain = written(tmp_path, NET)
    packed = tmp_path / "packed.net.xml.gz"
    packed.write_bytes(
        gzip.compress(NET.replace("2020-01-01", "2021-02-02").replace("\n", "\r\n").encode())
    )
    moved = written(tmp_path, NET.replace("108,1.6", "108.01,1.6"), "moved.net.xml")
    assert net_content_hash(plain) == net_content_hash(packed) == read_net(packed).net_hash
    assert len(net_content_hash(plain)) == 16
    assert net_content_hash(moved) != net_content_hash(plain)


def test_stubs_of_no_length_become_tiny_strips(tmp_path: Path) -> None:
    """A sidewalk with the same point twice has a valid polygon and a length."""
    place = read_net(written(tmp_path, NET.replace("58,1.6 108,1.6", "58,1.6 58,1.6")))
    stub = place.strips["path"]
    assert stub.polygon.is_valid and stub.polygon.area > 0.1 and stub.length_m > 0.0
    assert np.isfinite(stub.line).all()


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "broken XML: no element found"),
        (NET[:900], "broken XML"),
        ("<routes/>", "not a SUMO street net: it has no <net>"),
        ('<net version="1.20"></net>', "the street net has no edges: nothing walkable here"),
        (
            NET.replace("58,1.6 108,1.6", "58,north 108,1.6"),
            "'path_0': a shape with points that are not x,y in metres: '58,north'",
        ),
        (NET.replace("58,1.6 108,1.6", "58 108,1.6"), "points that are not x,y"),
        (NET.replace("58,1.6 108,1.6", "nan,1.6 108,1.6"), "points that are not x,y"),
        (
            NET.replace("58,1.6 108,1.6", "58,1.6 108,1e300"),
            "'path_0': a shape with points that are not x,y",
        ),
        (NET.replace("58,1.6 108,1.6", ""), "a shape without points"),
        (NET.replace('<edge id="in"', '<edge name="in"'), "<edge> '' lacks 'id': line 15"),
        (NET.replace("UTF-8", "klingon"), "broken XML: unknown encoding"),
        (NET.replace('width="3.20"', 'width="wide"'), "lane ':J_c0_0': width 'wide' is no number"),
        (
            NET.replace('width="3.20"', 'width="1e9"'),
            "lane ':J_c0_0': width '1e9' is a width of 1e+09 m",
        ),
        (
            NET.replace('fromLane="0"', 'fromLane="x"'),
            "connection from 'in' to ':J_w0': fromLane 'x' is no number",
        ),
        (NET.replace("<lane id", "<a>" * 50 + "<lane id", 1), "nested more than 40 deep: line 5"),
    ],
)
def test_broken_nets_are_refused_with_file_and_reason(
    tmp_path: Path, text: str, reason: str
) -> None:
    """For any fault inside, the error is a MapError that names the file."""
    with pytest.raises(MapError) as caught:
        read_net(written(tmp_path, text))
    assert str(caught.value).startswith(f"{tmp_path / 'small.net.xml'}: ")
    assert reason in str(caught.value)


def test_unreadable_files_are_refused(tmp_path: Path) -> None:
    """A missing file, a folder and a truncated gzip are MapErrors, too."""
    with pytest.raises(MapError, match="cannot be read: No such file"):
        read_net(tmp_path / "none.net.xml")
    with pytest.raises(MapError, match="cannot be read: it is a folder, not a file"):
        net_content_hash(tmp_path)
    cut = tmp_path / "cut.net.xml.gz"
    cut.write_bytes(gzip.compress(NET.encode())[:200])
    with pytest.raises(MapError, match="broken gzip file"):
        read_net(cut)


@pytest.mark.engine
def test_no_carriageway_is_behind_a_sidewalk() -> None:
    """Every part of a junction between its sidewalks and corners is reached by a lane, though SUMO
    draws outlines of T-junctions beyond the far sidewalk."""
    street_map = street_map_of(city_net(City(seed=2, size_m=600.0)))
    strips = [s.polygon for s in street_map.strips.values() if s.kind == "sidewalk"]
    walks = shapely.STRtree([*strips, *(c.polygon for c in street_map.corners.values())])
    lanes = shapely.union_all([lane.polygon for lane in street_map.lanes.values()])
    checked = 0
    for junction in street_map.junctions.values():
        beside = walks.geometries[walks.query(junction.polygon, predicate="intersects")]
        parts = shapely.get_parts(junction.polygon.difference(shapely.union_all(beside)))
        wide = [p for p in parts if not shapely.is_empty(p.buffer(-0.02))]
        assert all(part.distance(lanes) < 0.2 for part in wide), junction.id
        checked += len(wide)
    assert checked
