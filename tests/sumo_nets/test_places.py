"""Places that a user can run on: maps by name, folders of cities and maps, and nets. The store
holds only complete maps, also with concurrent or killed processes."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from cosim.core.errors import MapError, SpecError, UsageError
from cosim.spec.scenario import City, CityMap
from scenarios.events import EVENT_KINDS
from scenarios.places.nets import place
from scenarios.suites.sample import suite_on_map
from sumo_nets.city.store import NET_NAME, write_city
from sumo_nets.maps.map_store import (
    ABOUT,
    about_map,
    import_map,
    known_maps,
    map_net,
    maps_folder,
    read_map,
)
from sumo_nets.maps.place_names import resolve_place
from tests.conftest import PATIENCE_S, Cosim
from tests.sumo_nets.test_damaged_maps import TOWN


@pytest.fixture(autouse=True, scope="module")
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Store maps in a separate folder for the module."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COSIM_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield
    place.cache_clear()


@pytest.fixture(scope="module")
def city(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of `cosim city make`."""
    folder = tmp_path_factory.mktemp("cities") / "seven"
    write_city(City(seed=7, size_m=400.0), folder)
    return folder


def test_an_unknown_place_is_refused_with_a_remedy(tmp_path: Path) -> None:
    """An unknown name, another folder and a file that must be imported first each have a remedy."""
    with pytest.raises(
        UsageError, match=r"unknown map 'nowhere'.*sumo-fkk-in.*Or give a path: the folder of"
    ):
        resolve_place("nowhere")
    with pytest.raises(UsageError, match=r"a folder without city\.json or about\.json"):
        resolve_place(str(tmp_path))
    town = tmp_path / "town.osm"
    town.write_text(TOWN)
    with pytest.raises(UsageError, match=r"import it first with `cosim map import .*town\.osm`"):
        resolve_place(str(town))
    os.mkfifo(tmp_path / "pipe.net.xml")
    with pytest.raises(MapError, match="it is a pipe, not a file"):
        resolve_place(str(tmp_path / "pipe.net.xml"))
    (tmp_path / "city.json").write_text('{"city": 7}')
    with pytest.raises(MapError, match=r"city\.json: cannot be read: .*make the city again"):
        resolve_place(str(tmp_path))


def test_suites_that_cannot_be_drawn_are_refused() -> None:
    """An unknown kind of suite and an unknown event are refused with the valid ones, before the map
    is read."""
    with pytest.raises(
        UsageError, match=r"suite for --map 'static'\. Valid choices: long-horizon, reactive, unit"
    ):
        suite_on_map("static", "nowhere", 0, 1)
    with pytest.raises(UsageError, match=r"event 'ambush'\. Valid choices: .*frontal"):
        suite_on_map("reactive", "nowhere", 0, 1, events=["ambush"])


def test_names_that_lead_out_of_the_store_are_unknown() -> None:
    """A scenario cannot name a map by a path through folders."""
    for name in ("../other", "..", "a/b", "", "/etc"):
        with pytest.raises(UsageError, match="unknown map"):
            map_net(CityMap(map=name))


@pytest.mark.engine
def test_the_folder_of_a_city_is_that_city(city: Path) -> None:
    """Its place has the seed and the hash of its net, so a run needs no folder."""
    where = resolve_place(str(city), roughness=0.2)
    assert where == resolve_place(str(city / NET_NAME), roughness=0.2)
    assert isinstance(where, City) and (where.seed, where.size_m, where.roughness) == (
        7,
        400.0,
        0.2,
    )
    for kind in ("long-horizon", "reactive", "unit"):
        one, again = (suite_on_map(kind, str(city), 3, 2) for _ in range(2))
        assert one == again and len(one.scenarios) == 2
        assert all(
            s.place == City(seed=7, size_m=400.0, net_hash=where.net_hash) for s in one.scenarios
        )


@pytest.mark.engine
def test_a_changed_city_is_a_map(city: Path, tmp_path: Path) -> None:
    """If its net is not the one of its seed, the net of the folder is imported once and used."""
    mine = tmp_path / "mine"
    shutil.copytree(city, mine)
    net = (mine / NET_NAME).read_text()
    (mine / NET_NAME).write_text(re.sub(r' speed="\d[\d.]*"', ' speed="7.77"', net))
    where = resolve_place(str(mine))
    assert isinstance(where, CityMap) and about_map(where.map).source == NET_NAME
    began = (maps_folder() / where.map / ABOUT).stat().st_mtime_ns
    assert resolve_place(str(mine)) == where
    assert (maps_folder() / where.map / ABOUT).stat().st_mtime_ns == began
    (scenario,) = suite_on_map("long-horizon", str(mine), 0, 1).scenarios
    assert (
        isinstance(scenario.place, CityMap)
        and scenario.place.net_hash == read_map(where.map).net_hash
    )


@pytest.mark.engine
def test_nets_and_folders_of_maps_are_imported_under_a_name(city: Path, tmp_path: Path) -> None:
    """A net has its file's name, another of that name one with its hash, and a map's folder
    includes its buildings."""
    net = tmp_path / "street.net.xml"
    other = tmp_path / "b" / "street.net.xml"
    shutil.copy(city / NET_NAME, net)
    other.parent.mkdir()
    other.write_bytes(net.read_bytes() + b"<!-- another file -->\n")
    assert (
        resolve_place(str(net))
        == CityMap(map="street")
        == resolve_place(str(net))
        == resolve_place("street")
    )
    second = resolve_place(str(other))
    assert (
        isinstance(second, CityMap)
        and second.map.startswith("street-")
        and second.map in known_maps()
    )
    house = (
        '<way id="400"><nd ref="5"/><nd ref="6"/><nd ref="7"/><nd ref="5"/><tag k="building" '
        'v="yes"/></way>'
    )
    spots = [(5, 13.4005, 52.5005), (6, 13.4009, 52.5005), (7, 13.4009, 52.5008)]
    nodes = "".join(f'<node id="{n}" lon="{lon}" lat="{lat}"/>' for n, lon, lat in spots)
    (tmp_path / "town.osm").write_text(
        TOWN.replace('<way id="100">', nodes + '<way id="100">').replace("</osm>", house + "</osm>")
    )
    about = import_map(tmp_path / "town.osm")
    assert {f.kind for f in read_map("town").features} == {"building"}
    assert resolve_place(str(maps_folder() / "town")) == CityMap(map="town")
    elsewhere = tmp_path / "kept"
    shutil.move(maps_folder() / "town", elsewhere)
    assert (
        resolve_place(str(elsewhere)) == CityMap(map="town")
        and read_map("town").net_hash == about.net_hash
    )
    assert {f.kind for f in read_map("town").features} == {"building"}
    (elsewhere / "net.xml").write_text(
        (elsewhere / "net.xml").read_text().replace("13.89", "13.88")
    )
    with pytest.raises(MapError, match="it was changed since; import the changed net"):
        resolve_place(str(elsewhere))


@pytest.mark.engine
def test_reactive_scenarios_are_drawn_where_there_is_room() -> None:
    """Events take turns over the seeds; those without room are left out and named, or refused on
    request."""
    suite = suite_on_map("reactive", "sumo-fkk-in", 0, None)
    kinds = [s.events[0].kind for s in suite.scenarios]
    left_out = [kind for kind in EVENT_KINDS if f"No '{kind}'" in suite.description]
    assert kinds and left_out and sorted([*kinds, *left_out]) == sorted(EVENT_KINDS)
    some = suite_on_map("reactive", "sumo-fkk-in", 5, 3, events=kinds[:2])
    assert [s.events[0].kind for s in some.scenarios] == [kinds[0], kinds[1], kinds[0]]
    assert len({s.id for s in some.scenarios}) == 3 and all(
        s.place.net_hash for s in some.scenarios
    )
    with pytest.raises(SpecError, match=f"no place for '{left_out[0]}' on 'sumo-fkk-in'"):
        suite_on_map("reactive", "sumo-fkk-in", 0, 1, events=[left_out[0]])


@pytest.mark.engine
def test_a_run_on_a_users_city_is_replayed(cosim: Cosim, city: Path) -> None:
    """`cosim run reactive --map FOLDER` runs, and its replay gives the recorded hash from the run
    folder alone."""
    words = ("--map", "seven", "--event", "frontal", "--policy", "schedule:stand", "--out", "run")
    done = cosim("run", "reactive", *words, cwd=city.parent)
    assert done.returncode == 0, done.stderr
    (episode,) = (p.name for p in (city.parent / "run" / "episodes").iterdir())
    assert episode == "frontal-city-mixed-400m-7-000"
    shutil.move(city, city.parent / "gone")
    try:
        again = cosim("replay", "run", episode, cwd=city.parent)
        assert again.returncode == 0 and "as recorded" in again.stdout + again.stderr
    finally:
        shutil.move(city.parent / "gone", city)
    check = cosim("map", "check", "seven", cwd=city.parent)
    assert check.returncode == 0 and "long route" in check.stdout


IMPORTER = """
import sys
from pathlib import Path
from sumo_nets.maps.map_store import import_map, read_map
import_map(Path(sys.argv[1]), "shared")
assert read_map("shared").strips
"""


@pytest.mark.engine
def test_two_processes_import_one_name_at_once(tmp_path: Path) -> None:
    """Both end well and read a complete map, and one map and no scratch folder is left."""
    (tmp_path / "town.osm").write_text(TOWN)
    before = sorted(p.name for p in maps_folder().glob("*"))
    command = [sys.executable, "-c", IMPORTER, str(tmp_path / "town.osm")]
    both = [subprocess.Popen(command, stderr=subprocess.PIPE, text=True) for _ in range(2)]
    for process in both:
        _, errors = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 0, errors
    assert sorted(p.name for p in maps_folder().glob("*")) == sorted({*before, "shared"})
    assert about_map("shared").net_hash == read_map("shared").net_hash


def test_a_damaged_map_does_not_hide_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The list shows it as damaged, and an unknown name is refused with the known ones."""
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path))
    (maps_folder() / "broken").mkdir(parents=True)
    (maps_folder() / "broken" / "net.xml").write_text("<net/>")
    (maps_folder() / "broken" / ABOUT).write_bytes(msgspec.json.encode({"name": 1}))
    assert (
        known_maps()["broken"].source == "damaged: import it again"
        and "sumo-fkk-in" in known_maps()
    )
    with pytest.raises(
        UsageError, match=r"unknown map 'x'\. Valid choices: berlin-1, .* broken, .*sumo-"
    ):
        resolve_place("x")
