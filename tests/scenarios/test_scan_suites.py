"""Suites on scans, drawn on small areas."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
import shapely

from cosim.core.errors import SpecError, UsageError
from cosim.place.scan import ScanArea
from cosim.place.street_map import StreetMap
from cosim.place.walk_graph import WalkGraph
from cosim.spec.scenario import CityMap, write_suite
from scenarios.places.chosen_areas import replace_areas
from scenarios.places.nets import place
from scenarios.places.scan_import import import_scan
from scenarios.places.scan_options import ScanOptions, read_options
from scenarios.runs.net_transfer import MapDownload, RunMaps
from scenarios.suites.catalog import one_scenario
from scenarios.suites.long_horizon import build_long_horizon
from scenarios.suites.sample import drawn_on_map, suite_on_map
from sumo_nets.maps.map_store import map_hash, map_net, maps_folder, read_map
from sumo_nets.maps.place_names import resolve_place
from tests.conftest import Cosim
from tests.support.flat_scans import flat_grid, store_flat, street_areas
from tests.support.scans import write_street

pytestmark = pytest.mark.engine

SHARED = Path(__file__).parents[3] / "shared" / "scans" / "lund-street"
CORRIDOR = [ScanArea("sidewalk", shapely.box(0.0, 0.0, 120.0, 3.0))]


@pytest.fixture(scope="module", autouse=True)
def maps(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Store a street and a corridor as maps in a separate cache."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COSIM_CACHE", str(tmp_path_factory.mktemp("cache")))
        place.cache_clear()
        store_flat("flat-street", street_areas())
        store_flat("corridor", CORRIDOR, flat_grid(-2.0, -2.0, 122.0, 5.0))
        yield
    place.cache_clear()


def _check_three_suites(name: str, events: int) -> None:
    """Check that unit scenarios, reactive ones, and a route of 100 m with a crowd can be drawn."""
    street_map = read_map(name)
    unit = suite_on_map("unit", name, 0, 3).scenarios
    assert len(unit) == 3 and len({one.id for one in unit}) == 3
    reactive = suite_on_map("reactive", name, 0, events).scenarios
    assert len({one.structure for one in reactive}) == events
    for scenario in (*unit, *reactive):
        line = shapely.LineString(scenario.route)
        assert street_map.walkable.covers(shapely.buffer(line, 0.27))
    where = resolve_place(name, 0.0)
    long = build_long_horizon(where, street_map, WalkGraph(street_map), 0, "long", length_m=100.0)
    assert long.route_line.length_m == pytest.approx(100.0, abs=3.0)
    assert long.crowd.density and long.place.net_hash == street_map.net_hash


@pytest.mark.parametrize("name", ["corridor", "flat-street"])
def test_suites_are_drawn_on_small_scans(name: str) -> None:
    """A corridor of 3 m and a street with one crossing have room for all three suites."""
    _check_three_suites(name, 4)


def test_structures_take_turns_where_they_fit() -> None:
    """Each structure is drawn on the street; on the corridor those that do not fit are left out and
    reported."""
    street = suite_on_map("unit", "flat-street", 1, None)
    assert [one.structure for one in street.scenarios] == ["straight", "curve", "crosswalk"]
    assert street == suite_on_map("unit", "flat-street", 1, None)
    corridor = suite_on_map("unit", "corridor", 0, 2)
    assert [one.structure for one in corridor.scenarios] == ["straight", "straight"]
    assert "No 'curve'" in corridor.description and "No 'crosswalk'" in corridor.description
    box = flat_grid(-1.0, -1.0, 9.0, 4.0)
    store_flat("speck", [ScanArea("sidewalk", shapely.box(0.0, 0.0, 8.0, 3.0))], box)
    with pytest.raises(SpecError, match="no unit scenario fits on 'speck'"):
        suite_on_map("unit", "speck", 0, 1)


@pytest.mark.skipif(not SHARED.is_dir(), reason="no shared scans beside the repository")
def test_suites_are_drawn_in_lund(tmp_path: Path) -> None:
    """A corridor of 3 m along the walked path in Lund has room for all three suites."""
    for name in ("lund_street_ground.glb", "lund_street_obstacles.glb"):
        shutil.copy(SHARED / name, tmp_path)
    route = json.loads((SHARED / "lund_street_route.json").read_text())
    route["route"] = route["route"][3:40]  # 10 to 130 m
    (tmp_path / "way.json").write_text(json.dumps(route))
    way = str(tmp_path / "way.json")
    import_scan(tmp_path, read_options(tmp_path, {"way": way, "width_m": 3.0, "name": "lund"}))
    _check_three_suites("lund", 4)


@pytest.fixture(scope="module")
def scan(maps: None, tmp_path_factory: pytest.TempPathFactory) -> str:
    """Store a scan with a mesh, and a draft of areas."""
    folder = write_street(tmp_path_factory.mktemp("scans") / "street")
    meshes = [path.name for path in folder.glob("*.glb")]
    import_scan(folder, read_options(folder, {"files": meshes, "name": "replaced"}))
    return "replaced"


def test_areas_of_a_stored_scan_are_replaced(cosim: Cosim, scan: str, tmp_path: Path) -> None:
    """The net, the hash and the findings follow the new areas; a refusal changes nothing."""
    before = read_map("replaced")
    draft = tmp_path / "draft.geojson"
    assert cosim("scan", "areas", "replaced", "--draft", str(draft)).returncode == 0
    features = json.loads(draft.read_text())["features"]
    assert features and features[0]["properties"]["kind"] == "sidewalk"
    x, y = before.walkable.centroid.x, before.walkable.centroid.y
    points = [[x - 6.0, y], [x + 6.0, y]]
    way = {"type": "LineString", "frame": "local", "coordinates": points}
    (tmp_path / "way.geojson").write_text(json.dumps(way))
    done = cosim(
        "scan", "areas", "replaced", "--way", str(tmp_path / "way.geojson"), "--width", "2"
    )
    assert done.returncode == 0, done.stderr
    after = read_map("replaced")
    assert after.net_hash != before.net_hash
    assert after.walkable.area == pytest.approx(24.0, rel=0.15)
    far = tmp_path / "far.geojson"
    far.write_text(draft.read_text().replace('"sidewalk"', '"lawn"'))
    refused = cosim("scan", "areas", "replaced", "--set", str(far))
    assert refused.returncode == 2 and "far.geojson: feature 0: kind is 'lawn'" in refused.stderr
    assert cosim("scan", "areas", "replaced").returncode == 2
    assert read_map("replaced").net_hash == after.net_hash
    again, findings = replace_areas("replaced", ScanOptions(areas=str(draft)))
    assert again.net_hash == map_hash(map_net("replaced")) != after.net_hash
    assert sum(words.startswith("net:") for words in again.changes) == sum(
        one.words.startswith("net:") for one in findings
    )


def test_scans_are_sent_to_workers_completely(
    scan: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A worker that lacks a scan gets its net, its drawn ground and its files."""
    where = CityMap(map=scan)
    sent: StreetMap = read_map(where)
    nets = RunMaps()
    packed = nets.packed(nets.hash_of(where))
    names = sorted(path.name for path in (maps_folder() / scan / "scan").iterdir())
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path))
    MapDownload(where, sent.net_hash).keep(packed)
    got = read_map(where)
    assert got.net_hash == sent.net_hash and got.walkable.equals(sent.walkable)
    assert sorted(p.name for p in (maps_folder() / scan / "scan").iterdir()) == names


def test_a_drawn_scenario_is_found_by_its_id(cosim: Cosim, tmp_path: Path) -> None:
    """`cosim look` draws it again with --map, or finds it in the run folder; the errors name
    both."""
    suites = {
        kind: suite_on_map(kind, "flat-street", 3, count)
        for kind, count in (("reactive", 4), ("unit", None), ("long-horizon", 1))
    }
    for suite in suites.values():
        for scenario in suite.scenarios:
            assert drawn_on_map(scenario.id, "flat-street").scenarios == (scenario,)
    with pytest.raises(
        UsageError, match=r"is none of map 'flat-street': .* straight-flat-street-0"
    ):
        drawn_on_map("frontal-corridor-003", "flat-street")
    wanted = suites["unit"].scenarios[1]
    write_suite(suites["unit"], tmp_path / "scenarios.json")
    assert one_scenario(str(tmp_path), which=wanted.id)[0].scenarios == (wanted,)
    assert one_scenario(wanted.id, str(tmp_path))[0].scenarios == (wanted,)
    picture = tmp_path / "look.png"
    options = ("--map", "flat-street", "--size", "64x36", "-o", str(picture))
    done = cosim("look", wanted.id, *options)
    assert done.returncode == 0, done.stderr
    assert picture.stat().st_size > 500 and wanted.id in done.stdout
    unknown = cosim("look", wanted.id)
    assert unknown.returncode == 2 and "give the run folder by --suite" in " ".join(
        unknown.stderr.split()
    )
