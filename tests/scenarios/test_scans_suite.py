"""The suite `scans`: its recipe, its real places, and a scenario on a generated scan."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from cosim.core.errors import MapError, UsageError
from cosim.spec.scenario import CityMap
from scenarios.episodes.run_episode import run_episode
from scenarios.places.nets import place
from scenarios.places.scan_import import import_scan
from scenarios.places.scan_options import read_options
from scenarios.places.scan_places import (
    SCAN_PLACES,
    GeneratedScan,
    RealScan,
    lacking_scans,
    preset_folder,
)
from scenarios.suites.catalog import SUITES, load_suite
from scenarios.suites.proofs import read_proofs
from scenarios.suites.recipes import LONG_WAY, RECIPES, SCANS_ROUTE_M
from scenarios.tools.bench.environment import StraightWithPictures
from scenarios.tools.build.claims import CLAIMS, Read
from scenarios.tools.build.place_claims import faults_in_places
from sumo_nets.maps.map_store import map_hash, maps_folder
from tests.support.flat_scans import store_flat, street_areas

SHARED = Path(__file__).parents[3] / "shared" / "scans"
LARGEST = "autzen-boulevard"
REAL = [name for name, one in SCAN_PLACES.items() if isinstance(one, RealScan)]


@pytest.fixture
def empty_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Use an empty cache."""
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path / "cache"))
    place.cache_clear()
    yield
    place.cache_clear()


def test_the_suite_has_110_short_ways_and_a_route_on_each_place() -> None:
    """Each of the five scans has short scenarios and one route, all of one split."""
    slots = RECIPES["scans"].slots
    assert {slot.where for slot in slots} == {CityMap(map=name) for name in SCAN_PLACES}
    for where in {slot.where for slot in slots}:
        here = [slot for slot in slots if slot.where == where]
        (route,) = (slot for slot in here if slot.structure == LONG_WAY)
        assert len(here) > 10 and len({slot.split for slot in here}) == 1
        assert SCANS_ROUTE_M[0] <= route.length_m <= SCANS_ROUTE_M[1]
    structures = Counter(slot.structure for slot in slots)
    assert structures == {"straight": 70, "curve": 30, "crosswalk": 10, LONG_WAY: 5}


def test_claims_depend_on_the_name_of_the_suite() -> None:
    """Under the name of another suite, the same scenarios violate the claims on split and
    structures."""
    suite = load_suite("scans")
    other = Read(msgspec.structs.replace(suite, name="unit"), read_proofs(SUITES["scans"]))
    assert all(list(CLAIMS[claim](other)) for claim in ("val and test", "structures", "events"))


def test_scenarios_of_a_structure_have_different_spots() -> None:
    """Candidates on the spot of an earlier scenario were dropped."""
    assert read_proofs(SUITES["scans"]).dropped["on the spot of another"] > 0


@pytest.mark.parametrize("name", REAL)
def test_a_missing_real_place_is_named_with_its_import(name: str, empty_cache: None) -> None:
    """The error has source, size, licence and the command of the import."""
    found = SCAN_PLACES[name]
    assert isinstance(found, RealScan)
    with pytest.raises(UsageError, match=f"cosim scan import FOLDER --preset {name}") as refused:
        place(CityMap(map=name))
    assert all(words in str(refused.value) for words in (found.size, found.licence, "github.com/"))
    assert [*lacking_scans([CityMap(map=name), CityMap(map="scan-5")])] == [name]


def test_a_preset_of_no_real_place_is_refused() -> None:
    """Generated places have no preset."""
    with pytest.raises(UsageError, match=r"preset 'scan-5'.*lund-street"):
        preset_folder("scan-5")


@pytest.mark.engine
def test_a_different_map_under_the_name_of_a_place_is_refused(empty_cache: None) -> None:
    """The error says how to get the place of the suite."""
    store_flat("scan-5", street_areas())
    store_flat("lund-street", street_areas())
    for name, remedy in (("scan-5", "and it is made again"), ("lund-street", "--preset lund-st")):
        with pytest.raises(MapError, match=remedy):
            place(CityMap(map=name, net_hash="0" * 16))


@pytest.mark.engine
@pytest.mark.parametrize("name", REAL)
def test_a_preset_gives_the_map_of_the_suite(
    name: str, empty_cache: None, request: pytest.FixtureRequest
) -> None:
    """The meshes of a real place, imported with its preset, have the hash of its scenarios. The
    largest place is imported with --whole."""
    if name == LARGEST and not request.config.getoption("--whole"):
        pytest.skip("imported with --whole")
    if not (SHARED / name).is_dir():
        pytest.skip("the scans of real places are not at hand")
    import_scan(SHARED / name, read_options(SHARED / name, {}, preset_folder(name)))
    hashes = {
        one.place.net_hash
        for one in load_suite("scans").scenarios
        if isinstance(one.place, CityMap) and one.place.map == name
    }
    assert hashes == {map_hash(maps_folder() / name / "net.xml")}


@pytest.mark.engine
def test_a_generated_scan_is_made_and_driven_on() -> None:
    """On the first scenario a policy with pictures drives to an end, and the oracle repeats its
    proof."""
    scenario = load_suite("scans").scenarios[0]
    assert isinstance(scenario.place, CityMap)
    assert isinstance(SCAN_PLACES[scenario.place.map], GeneratedScan)
    proofs = read_proofs(SUITES["scans"])
    assert list(faults_in_places([scenario], [scenario.id], proofs)) == []
    assert run_episode(scenario, StraightWithPictures()).record.status == "done"
