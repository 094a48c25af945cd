"""Import of city maps: OpenStreetMap and SUMO files, complete, packed or broken; and the shared
maps if present."""

from __future__ import annotations

import bz2
import gzip
import json
import xml.etree.ElementTree as ET
from functools import cache
from itertools import groupby
from pathlib import Path

import pytest

from cosim.core.cache import cache_folder
from cosim.core.errors import MapError, UsageError
from cosim.place.route_line import through_corner
from cosim.place.street_map import Port, StreetMap
from cosim.place.walk_graph import WalkGraph
from cosim.spec.scenario import City, CityMap
from scenarios.suites.capacity import capacity_of
from scenarios.suites.catalog import load_suite
from sumo_nets.city.store import build_city
from sumo_nets.maps import importer
from sumo_nets.maps import net_steps as netsteps
from sumo_nets.maps import osm_crop as osmcrop
from sumo_nets.maps.corner_repair import repair_corners
from sumo_nets.maps.driving_side import left_hand_country
from sumo_nets.maps.importer import Options
from sumo_nets.maps.map_store import (
    ABOUT,
    about_map,
    checked_map,
    credit_of,
    delete_map,
    import_map,
    known_maps,
    map_name,
    map_net,
    outdated,
    read_map,
)
from sumo_nets.maps.signal_check import extend_greens, repair_signals
from sumo_nets.net.net_facts import crossing_signals, read_facts
from sumo_nets.net.net_file import read_net
from sumo_nets.net.netconvert import netconvert
from sumo_nets.net.signal_plans import SignalPrograms
from tests.conftest import Cosim
from tests.sumo_nets.conftest import stored_maps

pytestmark = pytest.mark.usefixtures("own_cache")

MAPS = Path(__file__).parents[3] / "shared" / "maps"
NAMES = (
    sorted(p.name for p in MAPS.glob("*") if (p / "stats.json").exists()) if MAPS.is_dir() else []
)
SAMPLE = (
    "braunschweig-bs3d",
    "frederiksted",
    "taipei",
    "west-oakland",
)
"""Small maps of each packing, for both sides of the road, with sidewalks and without; --whole
imports the others."""
BERLIN = (13.40, 52.50)
LONDON = (-0.12, 51.50)


def osm(
    at: tuple[float, float] = BERLIN,
    highway: str = "residential",
    sidewalk: str = "both",
    blocks: int = 3,
) -> str:
    """Return a grid of streets 120 m apart with a footway across one block."""
    lon, lat = at
    number = {
        (i, k): 1 + i * (blocks + 1) + k for i in range(blocks + 1) for k in range(blocks + 1)
    }
    rows = [
        f'<node id="{n}" lon="{lon + 0.0017 * i:.7f}" lat="{lat + 0.0011 * k:.7f}"/>'
        for (i, k), n in number.items()
    ]
    tags = f'<tag k="highway" v="{highway}"/><tag k="name" v="A &amp; Ö &quot;台北&quot;"/>'
    tags += f'<tag k="sidewalk" v="{sidewalk}"/>' if sidewalk else ""
    for line in range(blocks + 1):
        for way, refs in (
            (100 + line, [number[line, k] for k in range(blocks + 1)]),
            (200 + line, [number[i, line] for i in range(blocks + 1)]),
        ):
            rows.append(
                f'<way id="{way}">'
                + "".join(f'<nd ref="{ref}"/>' for ref in refs)
                + tags
                + "</way>"
            )
    corner = number[min(1, blocks), min(1, blocks)]
    rows.append(
        f'<way id="300"><nd ref="{number[0, 0]}"/><nd ref="{corner}"/><tag k="highway" '
        f'v="footway"/></way>'
    )
    rows.append(
        '<way id="301"><nd ref="1"/><nd ref="999"/><tag k="highway" v="footway"/></way><way '
        'id="302"/>'
    )
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<osm version="0.6">\n'
        + "\n".join(rows)
        + "\n</osm>\n"
    )


def written(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


@cache
def small_city() -> bytes:
    """Return the net of a city of 300 m."""
    path = cache_folder() / "small.net.xml"
    build_city(City(seed=3, size_m=300.0), path)
    return path.read_bytes()


@pytest.mark.engine
def test_an_osm_file_becomes_a_walkable_place(tmp_path: Path) -> None:
    """Streets get sidewalks, crossings and corners in one piece, and source, changes and licence
    are stored with the net."""
    about = import_map(written(tmp_path / "Kleine Stadt.osm", osm()))
    street_map, check, again = checked_map("kleine-stadt")
    assert again == about and about.source == "Kleine Stadt.osm" and about.guessed_share == 0.0
    assert street_map.name == "kleine-stadt" and street_map.net_hash == about.net_hash
    capacity = capacity_of(street_map, WalkGraph(street_map))
    assert (
        check.usable
        and capacity.routes.found
        and all(count.found for count in capacity.structures.values())
    )
    assert check.islands[0].share > 0.99 and check.crossings >= 16 and check.corners >= 16
    assert "OpenStreetMap contributors" in about.licences[0]
    assert credit_of(CityMap(map="kleine-stadt")) == "(c) OpenStreetMap contributors, ODbL"
    assert credit_of(CityMap(map="sumo-a10kw")) == credit_of(City(seed=1)) == ""
    assert any("on the right" in change for change in about.changes)
    assert known_maps()["kleine-stadt"].origin == "imported"


@pytest.mark.engine
def test_every_packing_gives_the_same_net(tmp_path: Path) -> None:
    """Plain, gzip, bzip2 and PBF files of one map become the same net."""
    import osmium

    plain = written(tmp_path / "town.osm", osm())
    (tmp_path / "town.osm.gz").write_bytes(gzip.compress(plain.read_bytes()))
    (tmp_path / "town.osm.bz2").write_bytes(bz2.compress(plain.read_bytes()))
    with osmium.SimpleWriter(str(tmp_path / "town.osm.pbf")) as writer:
        for thing in osmium.FileProcessor(str(plain)):
            writer.add(thing)
    hashes = {p.name: import_map(p, "packed").net_hash for p in sorted(tmp_path.glob("town.*"))}
    assert len(hashes) == 4 and len(set(hashes.values())) == 1, hashes


@pytest.mark.engine
def test_driving_side_follows_the_country_or_the_option(tmp_path: Path) -> None:
    """London drives on the left unless the option says otherwise, and the sidewalk is then left of
    the road."""
    source = written(tmp_path / "town.osm", osm(LONDON))
    assert "United Kingdom" in " ".join(import_map(source, "london").changes)
    left = read_map("london")
    import_map(source, "london", Options(lefthand=False))
    right = read_map("london")
    assert left.left_hand and not right.left_hand
    sides = [
        {s.road_side for s in m.strips.values() if s.kind == "sidewalk" and s.road_side}
        for m in (left, right)
    ]
    assert sides == [{-1}, {1}]


@pytest.mark.parametrize(
    ("lon", "lat", "country"),
    [
        (139.7, 35.7, "Japan"),
        (-64.88, 17.71, "Virgin Islands"),
        (151.2, -33.9, "Australia"),
        (1.85, 50.95, None),
        (1.31, 51.13, "United Kingdom and Ireland"),
        (114.06, 22.55, None),
        (126.98, 37.57, None),
        (-66.1, 18.46, None),
    ],
)
def test_left_hand_countries(lon: float, lat: float, country: str | None) -> None:
    """Capitals and border towns have the driving side of their country."""
    assert left_hand_country(lon, lat) == country


@pytest.mark.engine
def test_a_complete_net_is_imported_unchanged(tmp_path: Path) -> None:
    """A SUMO net with sidewalks and walking areas gives the same place, zones included."""
    source = tmp_path / "good.net.xml.gz"
    source.write_bytes(gzip.compress(small_city()))
    before = read_net(source)
    about = import_map(source, options=Options(sidewalk_width_m=3.0))
    after = read_map("good")
    for a, b in zip(after.strips.values(), before.strips.values(), strict=True):
        assert (a.id, a.kind, a.corners, a.signalised, a.crosses) == (
            b.id,
            b.kind,
            b.corners,
            b.signalised,
            b.crosses,
        )
        assert (a.width_m, a.frontage_m, a.curb_m, a.verge_m) == (
            b.width_m,
            b.frontage_m,
            b.curb_m,
            b.verge_m,
        )
        assert a.polygon.equals(b.polygon)
    assert [(c.id, c.ports) for c in after.corners.values()] == [
        (c.id, c.ports) for c in before.corners.values()
    ]
    assert about.guessed_share is None and about.changes[0] == "unpacked (gzip)"
    assert (
        "--sidewalk-width has no effect: the net has sidewalks of its own, none is guessed"
        in about.changes
    )


@pytest.mark.engine
def test_nets_without_sidewalks_get_walkways(tmp_path: Path) -> None:
    """The sidewalks are listed as a change, and reported as guessed."""
    source = written(tmp_path / "town.osm", osm(sidewalk=""))
    net = netconvert(["--osm-files", str(source)], tmp_path / "cars.net.xml")
    about = import_map(net)
    _, check, _ = checked_map("cars")
    assert check.usable and about.guessed_share is not None and about.guessed_share > 0.9
    assert any("crossings and walking areas added" in change for change in about.changes)


@pytest.mark.engine
def test_as_is_leaves_a_net_unchanged(tmp_path: Path) -> None:
    """With --as-is the net stays the same to the byte, and the changes say what is impossible on
    it."""
    source = written(tmp_path / "town.osm", osm(sidewalk=""))
    net = netconvert(["--osm-files", str(source)], tmp_path / "cars.net.xml")
    about = import_map(net, options=Options(as_is=True))
    assert map_net("cars").read_bytes() == net.read_bytes() and about.as_is
    assert "no crowd, no route and no scenario is possible" in about.changes[-1]
    _, check, _ = checked_map("cars")
    assert not check.usable
    with pytest.raises(UsageError, match="an OpenStreetMap file is always converted"):
        import_map(source, options=Options(as_is=True))


def streets_of_each_class() -> str:
    """Return a town of residential streets, of which one is primary and two have sidewalks with
    tagged widths."""
    text = osm(sidewalk="")
    for way, tags in (
        ("100", {"highway": "primary"}),
        ("201", {"highway": "tertiary", "sidewalk": "both", "sidewalk:both:width": "2.8 m"}),
        (
            "202",
            {"sidewalk:left:width": "1.6", "sidewalk:right:width": "13'", "sidewalk:both": "yes"},
        ),
    ):
        head, tail = text.split(f'<way id="{way}">')
        refs, rest = tail.split("</way>", 1)
        kept_tags = "" if "highway" in tags else '<tag k="highway" v="residential"/>'
        tag_rows = "".join(f'<tag k="{k}" v="{v}"/>' for k, v in tags.items())
        text = (
            f'{head}<way id="{way}">{refs[: refs.index("<tag")]}{kept_tags}{tag_rows}</way>{rest}'
        )
    return text


@pytest.mark.engine
def test_guessed_sidewalks_have_the_width_of_their_street(tmp_path: Path, cosim: Cosim) -> None:
    """Widths follow the street's class, tagged widths have priority on each side, and
    --sidewalk-width sets all others."""
    source = written(tmp_path / "town.osm", streets_of_each_class())
    about = import_map(source, "town")
    strips = read_map("town").strips
    widths = {
        name: strips[name].width_m
        for name in ("100#0", "-203#1", "201#1", "-201#1", "202#1", "-202#1", "300")
    }
    assert widths == {
        "100#0": 3.5,
        "-203#1": 2.5,
        "201#1": 2.8,
        "-201#1": 2.8,
        "202#1": 3.96,
        "-202#1": 1.6,
        "300": 2.0,
    }
    (widths_change,) = [one for one in about.changes if one.startswith("sidewalks are")]
    assert "2.5 m beside residential streets (" in widths_change
    assert "as tagged beside others (" in widths_change
    cars = netconvert(["--osm-files", str(source), "--speed.factor=0.5"], tmp_path / "cars.net.xml")
    import_map(cars)
    strips = read_map("cars").strips
    assert (strips["100#0"].width_m, strips["-203#1"].width_m) == (3.5, 2.5)
    done = cosim("map", "import", str(cars), "--sidewalk-width", "4.2")
    assert done.returncode == 0 and "4.2 m beside primary streets" in done.stdout, done.stderr
    assert {s.width_m for s in read_map("cars").strips.values() if s.road_side} == {4.2}
    done = cosim("map", "import", str(cars), "--sidewalk-width", "0.4")
    assert (
        done.returncode == 2 and "--sidewalk-width must be 1 to 10 metres, not 0.4" in done.stderr
    )


@pytest.mark.engine
@pytest.mark.parametrize("name", ["ingolstadt-1", "braunschweig-2"])
def test_shipped_places_have_the_hashes_of_their_suites(name: str) -> None:
    """Shipped places are imported to the nets on which the scenarios were drawn."""
    about = about_map(name)
    frozen = {
        s.place.net_hash for s in load_suite("unit").scenarios if s.place.name == f"map-{name}"
    }
    assert {about.net_hash} == frozen and not outdated(about)


@pytest.mark.engine
def test_a_shipped_place_of_an_older_importer_is_imported_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A place that version 3 stored in the cache is replaced on first use."""
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path))
    path = map_net("braunschweig-1").with_name(ABOUT)
    old = json.loads(path.read_bytes())
    old["versions"]["importer"] = "3"
    path.write_bytes(json.dumps(old).encode())
    assert not outdated(about_map("braunschweig-1"))
    assert json.loads(path.read_bytes())["versions"]["importer"] != "3"


@pytest.mark.engine
def test_an_imported_map_can_be_deleted(tmp_path: Path) -> None:
    """A deleted map is unknown, and maps that are not imported are refused with those that are."""
    import_map(written(tmp_path / "town.osm", osm()), "to-delete")
    folder = delete_map("to-delete")
    assert not folder.exists() and "to-delete" not in known_maps()
    for name in ("to-delete", "sumo-fkk-in", "../maps"):
        with pytest.raises(UsageError, match="unknown imported map"):
            delete_map(name)


@pytest.mark.engine
def test_maps_of_an_older_importer_stay_usable(tmp_path: Path) -> None:
    """A map of version 3 is read unchanged, its check advises a new import, and that replaces
    it."""
    source = written(tmp_path / "town.osm", osm())
    import_map(source, "old")
    path = map_net("old").with_name(ABOUT)
    kept_by_3 = json.loads(path.read_bytes()) | {"upgrade": False}
    kept_by_3["versions"]["importer"] = "3"
    del kept_by_3["as_is"]
    path.write_bytes(json.dumps(kept_by_3).encode())
    street_map, _, about = checked_map("old")
    assert street_map.strips and outdated(about) and not outdated(import_map(source, "old"))


class RecordedStages:
    """Records the stages of an import, and the shares of each."""

    def __init__(self) -> None:
        self.shares: dict[str, list[float]] = {}

    def __call__(self, stage: str, share: float | None = None, /) -> None:
        self.shares.setdefault(stage, []).extend([] if share is None else [share])


@pytest.mark.engine
def test_a_box_is_cut_out_before_the_conversion(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only the streets in the box and its margin are converted, and the result is that of cropping
    afterwards."""
    monkeypatch.setattr(osmcrop, "MARGIN_M", 130.0)
    (lon, lat) = BERLIN
    progress = RecordedStages()
    plain = written(tmp_path / "town.osm", osm(blocks=5))
    source = tmp_path / "town.osm.gz"
    source.write_bytes(gzip.compress(plain.read_bytes()))
    box = (lon + 0.0001, lat + 0.0001, lon + 0.0018, lat + 0.0012)
    about = import_map(source, "part", Options(bbox=box), progress)
    stages = list(progress.shares)
    assert stages[0] == "reading town.osm.gz" and stages[1] == "converting 8 streets and paths"
    assert set(stages) >= {
        "cropping",
        "widening sidewalks",
        "mending corners",
        "starting SUMO on the net",
    }
    done = progress.shares["converting 8 streets and paths"]
    assert done == sorted(done) and done[0] == 0.0 and done[-1] > 0.7
    part = set(read_map("part").strips)
    assert (
        about.bbox == box and 10 < len(part) < 60 and part == set(cut_afterwards(plain, box).strips)
    )


def cut_afterwards(source: Path, box: tuple[float, float, float, float]) -> StreetMap:
    """Return the part of a town that is converted completely and then cropped."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(osmcrop, "MARGIN_M", 1e6)
        import_map(source, "afterwards", Options(bbox=box))
    return read_map("afterwards")


@pytest.mark.engine
def test_a_bad_box_is_refused_with_the_bounds(
    tmp_path: Path, cosim: Cosim, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A box outside of a file, with swapped sides, or without a street is refused with the file's
    bounds."""
    monkeypatch.setattr(osmcrop, "MARGIN_M", 1.0)
    source = written(tmp_path / "town.osm", osm())
    before = stored_maps()
    done = cosim("map", "import", str(source), "--bbox", "1,1,2,2")
    assert (
        done.returncode == 2
        and "is outside of the map, which covers 13.4,52.5,13.4051,52.5033" in done.stderr
    )
    with pytest.raises(MapError, match=r"swapped\? --bbox 13.4,52.5,13.401,52.501\)"):
        import_map(source, "swapped", Options(bbox=(52.5, 13.4, 52.501, 13.401)))
    with pytest.raises(
        MapError, match=r"no street or path .* lies in --bbox .*; the file covers 13\.4,52\.5,"
    ):
        import_map(source, "empty", Options(bbox=(13.4005, 52.5003, 13.4006, 52.5004)))
    broken = written(tmp_path / "broken.osm", osm().replace('lon="13', 'lon="x13', 1))
    with pytest.raises(
        MapError, match=r"broken\.osm: cannot be cropped: wrong format for coordinate"
    ):
        import_map(broken, options=Options(bbox=(13.4, 52.5, 13.41, 52.51)))
    net = netconvert(["--osm-files", str(source)], tmp_path / "projected.net.xml")
    with pytest.raises(
        MapError, match=r"outside of the map, which covers 13\.4,52\.5,.* in degrees\)"
    ):
        import_map(net, options=Options(bbox=(1.0, 1.0, 2.0, 2.0)))
    flat = tmp_path / "flat.net.xml"
    flat.write_bytes(small_city())
    with pytest.raises(MapError, match=r"which covers .* in metres: the net has no projection\)"):
        import_map(flat, options=Options(bbox=(5000.0, 5000.0, 6000.0, 6000.0)))
    assert stored_maps() == before


@pytest.mark.engine
def test_a_slow_import_names_the_option_for_a_box(
    tmp_path: Path, cosim: Cosim, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An import that takes minutes says so at its begin, with the option that makes it faster."""
    monkeypatch.setattr(importer, "SLOW_IMPORT_EDGES", 5)
    source = written(tmp_path / "town.osm", osm(blocks=2))
    done = cosim("map", "import", str(source))
    assert (
        "converting 8 streets and paths (--bbox west,south,east,north: a part is faster) ...\n"
        in done.stderr
    )


@pytest.mark.engine
def test_lefthand_is_refused_for_a_right_hand_net(tmp_path: Path) -> None:
    """The driving side of a net is fixed by the net."""
    source = tmp_path / "good.net.xml"
    source.write_bytes(small_city())
    with pytest.raises(MapError, match="on the right in this one"):
        import_map(source, options=Options(lefthand=True))


@pytest.mark.engine
@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        pytest.param("a.osm", b"", "the file is empty", id="empty"),
        pytest.param("a.osm", b"hello", "neither XML nor a known compression", id="text"),
        pytest.param("a.osm", b"PK\x03\x04rest", "a zip archive", id="zip"),
        pytest.param("a.osm", b"<html><body/></html>", "its root element is <html>", id="html"),
        pytest.param("a.osm", b"<osm><node", "broken XML", id="cut short"),
        pytest.param("a.osm", b"<osm/>", "none of them a street or path", id="no street"),
        pytest.param("a.osm", osm((4.4e5, 5.8e6)).encode(), "reproject it to WGS 84", id="metres"),
        pytest.param(
            "a.osm",
            osm(highway="trunk", sidewalk="").replace("footway", "motorway").encode(),
            "nothing walkable",
            id="motorways",
        ),
        pytest.param(
            "a.osm", osm(blocks=0).encode(), "no street of the file survived", id="one point"
        ),
        pytest.param(
            "a.osm.gz",
            gzip.compress(osm().encode(), mtime=0)[:400],
            "broken gzip file, probably cut short",
            id="gzip cut short",
        ),
        pytest.param(
            "a.osm.bz2", bz2.compress(osm().encode())[:300], "cut short", id="bzip2 cut short"
        ),
        pytest.param(
            "a.osm.pbf",
            b"\x00\x00\x00\x0d\x0a\x09OSMHeader" + b"\x00" * 40,
            "cannot be unpacked (PBF)",
            id="no PBF",
        ),
        pytest.param("a.net.xml", b'<net version="1.20"/>', "0 edges", id="no edges"),
        pytest.param(
            "a.net.xml", b'<net version="1.20"><edge id="a">', "broken XML", id="net cut short"
        ),
        pytest.param(
            "a.net.xml.gz",
            gzip.compress(b"<net>" * 99, mtime=0)[:20],
            "broken gzip file",
            id="gzip net cut short",
        ),
    ],
)
def test_bad_files_are_refused_and_leave_nothing(
    tmp_path: Path, name: str, content: bytes, reason: str
) -> None:
    """One MapError names the file and the fault, and no partial import is left."""
    before = stored_maps()
    source = tmp_path / name
    source.write_bytes(content)
    with pytest.raises(MapError) as caught:
        import_map(source)
    assert str(caught.value).startswith(f"{source}: ") and reason in str(caught.value)
    assert stored_maps() == before


def test_missing_files_and_bad_names_are_refused(tmp_path: Path) -> None:
    """A missing file, an invalid name, a name of SUMO's nets and an invalid box are refused."""
    with pytest.raises(MapError, match="cannot be read: No such file"):
        import_map(tmp_path / "none.osm")
    with pytest.raises(MapError, match="cannot be read: it is a folder, not a file"):
        import_map(tmp_path)
    with pytest.raises(UsageError, match="cannot name a map"):
        import_map(tmp_path / "a.osm", "../a")
    with pytest.raises(UsageError, match="comes with SUMO"):
        import_map(tmp_path / "a.osm", "sumo-fkk-in")
    with pytest.raises(UsageError, match="unknown map 'atlantis'"):
        map_net(CityMap(map="atlantis"))
    with pytest.raises(UsageError, match="west < east"):
        Options(bbox=(2.0, 0.0, 1.0, 1.0))


def test_names_come_from_files() -> None:
    """Endings are removed, other letters become dashes, and generic names are replaced by the
    folder's."""
    assert map_name(Path("x/West Oakland.osm.bz2")) == "west-oakland"
    assert map_name(Path("x/fokr_bs.net.xml.gz")) == "fokr_bs"
    assert map_name(Path("/maps/Taipei/input.osm.gz")) == "taipei"
    assert map_name(Path("/maps/七.osm")) == "map"


@pytest.mark.engine
def test_a_slow_netconvert_is_stopped_with_a_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One line names the user's file and the remedy."""
    monkeypatch.setattr(netsteps, "TIMEOUT_S", 0.001)
    source = written(tmp_path / "town.osm", osm())
    with pytest.raises(MapError) as caught:
        import_map(source)
    assert (
        str(caught.value)
        == f"{source}: netconvert did not end within 0.001 s: import a part of it with --bbox"
    )


@pytest.mark.engine
def test_nets_that_come_with_sumo_are_imported_when_used() -> None:
    """They are listed, need no import, and a scenario made on another net is refused."""
    assert known_maps()["sumo-fkk-in"].origin == "sumo"
    assert about_map("sumo-fkk-in").licences[0].startswith("EPL-2.0")
    assert not read_facts(map_net("sumo-fkk-in")).never_green
    with pytest.raises(MapError, match="made on 0123"):
        map_net(CityMap(map="sumo-fkk-in", net_hash="0123"))


def test_crossings_that_never_have_green_get_a_phase() -> None:
    """The additional phase is for them alone, with yellow before it and time to clear the road
    after it; other phases stay."""
    net = """<net version="1.20"><edge id=":J_c0" function="crossing"><lane id=":J_c0_0" length="11"/></edge>
      <edge id=":J_c1" function="crossing"><lane id=":J_c1_0" length="5"/></edge>
      <tlLogic id="J" type="static" programID="0" offset="0"><phase duration="30" state="GrG"/>
      <phase duration="30" state="rrr"/><phase duration="20" state="Grr"/></tlLogic>
      <connection from=":J_w0" to=":J_c0" tl="J" linkIndex="1"/>
      <connection from=":J_w0" to=":J_c1" tl="J" linkIndex="2"/></net>"""
    root = ET.fromstring(net)
    assert crossing_signals(root).never == [":J_c0"]
    assert repair_signals(root) == [
        "signals that never let people cross got a walk phase at the end of each cycle: J"
    ]
    added = [(p.get("duration"), p.get("state")) for p in root.iter("phase")][3:]
    assert added == [("3", "yrr"), ("2", "rrr"), ("8", "rGr"), ("10", "rrr")]
    assert crossing_signals(root).never == [] and repair_signals(root) == []
    special = ET.fromstring(net.replace("static", "NEMA"))
    assert "left as they are" in repair_signals(special)[0] and crossing_signals(special).never == [
        ":J_c0"
    ]


def with_ways(ways: dict[str, tuple[list[tuple[float, float]], dict[str, str]]]) -> str:
    """Return the town of `osm` with further ways: places in blocks east and north of its corner,
    and tags."""
    (lon, lat) = BERLIN
    nodes = list[str]()
    rows = list[str]()
    number = {(float(i), float(k)): 1 + 4 * i + k for i in range(4) for k in range(4)}
    for way, (points, tags) in ways.items():
        for x, y in points:
            if (x, y) not in number:
                number[x, y] = 1000 + len(number)
                nodes.append(
                    f'<node id="{number[x, y]}" lon="{lon + 0.0017 * x:.7f}" '
                    f'lat="{lat + 0.0011 * y:.7f}"/>'
                )
        refs = "".join(f'<nd ref="{number[point]}"/>' for point in points)
        rows.append(
            f'<way id="{way}">{refs}{"".join(f"<tag k={k!r} v={v!r}/>" for k, v in tags.items())}</way>'
        )
    # netconvert reads no nodes after the first way.
    town = osm().replace("<node", "".join(nodes) + "<node", 1)
    return town.replace("</osm>", "\n".join(rows) + "</osm>")


@pytest.mark.engine
def test_a_layer_alone_closes_no_sidewalk(tmp_path: Path) -> None:
    """A layer counts with a bridge, a tunnel, a roof or a street over or under it; level and
    location count alone. A bridge closes only its own part of a street."""
    street = {"highway": "residential", "sidewalk": "both"}
    text = with_ways(
        {
            "400": ([(3.0, 0.0), (4.0, 0.0)], street | {"layer": "1"}),
            "401": ([(4.0, 0.0), (4.3, 0.0)], street | {"bridge": "yes", "layer": "1"}),
            "402": ([(4.3, 0.0), (5.0, 0.0)], street),
            "403": ([(0.0, 3.0), (0.0, 4.0), (0.5, 4.5)], {"highway": "footway", "layer": "1"}),
            "404": ([(1.0, 3.0), (1.5, 3.4), (1.5, 2.5)], {"highway": "footway", "layer": "-1"}),
            "405": (
                [(2.0, 3.0), (2.0, 4.0)],
                {"highway": "footway", "layer": "-1", "covered": "yes"},
            ),
            "406": ([(3.0, 3.0), (3.0, 4.0)], {"highway": "footway", "level": "-2"}),
            "407": (
                [(3.0, 2.0), (4.0, 2.0)],
                {"highway": "footway", "covered": "yes", "level": "0;1"},
            ),
        }
    )
    about = import_map(written(tmp_path / "levels.osm", text))
    going = {
        name.lstrip("-").split("#")[0]: s.going
        for name, s in read_map("levels").strips.items()
        if name[0] != ":"
    }
    assert {way: going[way] for way in map(str, range(400, 408))} == {
        "400": "plain",
        "401": "bridge",
        "402": "plain",
        "403": "plain",
        "404": "bridge",
        "405": "bridge",
        "406": "bridge",
        "407": "plain",
    }
    assert (
        "3 walkways with a layer are on the ground: no bridge, no tunnel, no street over or "
        "under them" in about.changes
    )
    assert any(
        change.startswith("1 walkways are above or below the ground by their level")
        for change in about.changes
    )


def test_greens_too_short_to_walk_are_lengthened() -> None:
    """Each green lasts as long as the crossing takes, with seconds of the program's long phases and
    unchanged states. A program that is not fixed is left alone, and named."""
    net = """<net version="1.20"><edge id=":J_c0" function="crossing"><lane id=":J_c0_0" length="12"/></edge>
      <edge id=":J_c1" function="crossing"><lane id=":J_c1_0" length="6"/></edge>
      <tlLogic id="J" type="static" programID="0" offset="0"><phase duration="40" state="Grr"/>
      <phase duration="3" state="yrr"/><phase duration="5" state="rGG"/><phase duration="4" state="rrr"/></tlLogic>
      <connection from=":J_w0" to=":J_c0" tl="J" linkIndex="1"/>
      <connection from=":J_w0" to=":J_c1" tl="J" linkIndex="2"/></net>"""
    root = ET.fromstring(net)
    (change,) = extend_greens(root)
    assert change.endswith("longer for 2 crossings of 1 signals, by up to 9 s; no cycle is longer")
    phases = [(p.get("duration"), p.get("state")) for p in root.iter("phase")]
    assert phases == [("31", "Grr"), ("3", "yrr"), ("14", "rGG"), ("4", "rrr")]
    assert extend_greens(root) == []
    full = ET.fromstring(net.replace('"40"', '"12"'))
    assert extend_greens(full)[0].endswith("1 cycles are up to 7 s longer")
    for other in (net.replace("static", "actuated"), net.replace('"yrr"', '"yrr" next="2"')):
        special = ET.fromstring(other)
        assert extend_greens(special) == [
            "green too short to walk at 1 signals, left as it is (not a fixed program): J"
        ] and ET.tostring(special) == ET.tostring(ET.fromstring(other))


def test_crossings_with_greens_too_short_to_walk_are_found() -> None:
    """A crossing of 12 m needs 14 s in each of its greens, also in one over the end of the
    cycle."""
    links = [{"to": ":c", "tl": "J", "linkIndex": "1"}]
    for last_s, short in ((5.0, set()), (4.9, {":c"})):
        programs = SignalPrograms()
        programs.add("tlLogic", "net", {"id": "J", "type": "actuated", "programID": "0"})
        for duration_s, state in ((5.0, "GG"), (40.0, "Gr"), (4.0, "rG"), (last_s, "rg")):
            programs.add("phase", "tlLogic", {"duration": str(duration_s), "state": state})
        assert programs.short_greens(links, {":c": 12.0}) == short
        assert not programs.short_greens(links, {":c": 0.5})


@pytest.mark.engine
def test_greens_of_imported_signals_are_long_enough(tmp_path: Path) -> None:
    """In a town of one-way streets netconvert's greens of 5 s are too short, and after the import
    none is."""
    signal = '><tag k="highway" v="traffic_signals"/></node>\n<node'
    text = osm(highway="primary", blocks=2).replace("/>\n<node", signal)
    text = text.replace(
        'v="primary"/>', 'v="primary"/><tag k="lanes" v="4"/><tag k="oneway" v="yes"/>'
    )
    about = import_map(written(tmp_path / "wide.osm", text))
    crossings = [s for s in read_map("wide").strips.values() if s.signalised and s.plan is not None]
    assert len(crossings) >= 6 and any("green too short" in change for change in about.changes)
    for strip in crossings:
        assert strip.plan is not None
        phases = zip(strip.plan.walks, strip.plan.durations_ms, strict=True)
        greens = [
            sum(ms for _, ms in run) / 1000.0
            for go, run in groupby(phases, lambda phase: phase[0])
            if go
        ]
        assert min(greens) >= strip.length_m / 1.2 + 4.0 - 0.01, strip.id


def test_broken_corners_are_repaired_and_valid_ones_unchanged(tmp_path: Path) -> None:
    """A walking area that crosses itself between two sidewalks becomes ground that a robot can
    pass."""
    net = """<net version="1.9"><location convBoundary="0,0,30,9"/>
      <edge id=":J_w0" function="walkingarea"><lane id=":J_w0_0" allow="pedestrian" length="4" width="2"
        shape="10,-1 14,1 14,-1 10,1"/></edge>
      <edge id=":K_w0" function="walkingarea"><lane id=":K_w0_0" allow="pedestrian" length="4" width="2"
        shape="24,-1 28,-1 28,1 24,1"/></edge>
      <edge id="a"><lane id="a_0" allow="pedestrian" length="10" width="2" shape="0,0 10,0"/></edge>
      <edge id="b"><lane id="b_0" allow="pedestrian" length="10" width="2" shape="14,0 24,0"/></edge>
      <edge id="c"><lane id="c_0" allow="pedestrian" length="10" width="2" shape="28,0 38,0"/></edge>
      <connection from="a" to=":J_w0" fromLane="0" toLane="0"/><connection from=":J_w0" to="b" fromLane="0" toLane="0"/>
      <connection from="b" to=":K_w0" fromLane="0" toLane="0"/><connection from=":K_w0" to="c" fromLane="0" toLane="0"/>
      </net>"""
    path = written(tmp_path / "torn.net.xml", net)
    root = ET.fromstring(net)
    leave = Port("a", 1)
    enter = Port("b", 0)
    assert read_net(path).corners[":J_w0"].polygon.buffer(-0.1).geom_type == "MultiPolygon"
    assert repair_corners(root, read_net(path)) == [
        "1 of 2 corners were torn or pinched: widened along the ways across them"
    ]
    path.write_bytes(ET.tostring(root))
    mended = read_net(path)
    assert through_corner(mended, leave, enter)[[0, -1]].tolist() == [[10.0, 0.0], [14.0, 0.0]]
    assert mended.corners[":J_w0"].polygon.buffer(-0.4).geom_type == "Polygon"
    assert [e[0].get("shape") for e in root if e.get("id") == ":K_w0"] == ["24,-1 28,-1 28,1 24,1"]
    assert repair_corners(root, mended) == []


@pytest.mark.engine
def test_command_line(tmp_path: Path, cosim: Cosim) -> None:
    """import and check have the documented output and exit codes."""
    source = written(tmp_path / "town.osm", osm())
    picture = tmp_path / "town.png"
    done = cosim("map", "import", str(source), "--name", "town")
    assert done.returncode == 0 and "long route" in done.stdout, done.stderr
    assert "converting " in done.stderr and "checking town ..." in done.stderr
    done = cosim("map", "check", "town", "--json", "-o", str(picture), "--zoom", "0,0,100,100")
    assert done.returncode == 0 and json.loads(done.stdout)["check"]["corners"] > 10
    assert picture.read_bytes().startswith(b"\x89PNG")
    done = cosim("map", "check", "nowhere")
    assert done.returncode == 2 and "unknown map 'nowhere'" in done.stderr
    cars = netconvert(["--osm-files", str(source)], tmp_path / "cars.net.xml")
    done = cosim("map", "check", str(cars))
    assert done.returncode == 2 and "NOT USABLE" in done.stdout
    done = cosim("map", "import", str(cars), "--as-is")
    assert done.returncode == 2 and "import it without --as-is" in done.stdout, done.stderr


@pytest.mark.engine
@pytest.mark.skipif(not NAMES, reason="no shared maps beside the repository")
@pytest.mark.parametrize("name", [n for n in NAMES if not n.startswith("zz-")])
def test_shared_maps_import(request: pytest.FixtureRequest, name: str) -> None:
    """Every open map imports with the measured walkable length, and can be used."""
    if name not in SAMPLE and not request.config.getoption("--whole"):
        pytest.skip("imported with --whole")
    stats = json.loads((MAPS / name / "stats.json").read_text())
    raw = MAPS / name / stats["meta"]["raw"]
    source = raw if raw.exists() else MAPS / name / stats["meta"]["net"]
    about = import_map(source, name)
    street_map, check, _ = checked_map(name)
    measured_km = stats[stats["meta"]["net"]]["stat"]["walkable_km"]
    assert check.facts is not None and check.facts.walkable_km == pytest.approx(
        measured_km, rel=0.05
    )
    assert check.walkable_km == pytest.approx(measured_km, rel=0.05)
    assert check.usable and about.licences
    assert not check.facts.never_green
    if request.config.getoption("--whole"):
        assert capacity_of(street_map, WalkGraph(street_map)).routes.found


@pytest.mark.engine
@pytest.mark.skipif(not NAMES, reason="no shared maps beside the repository")
def test_a_shared_map_without_walkable_streets_is_refused() -> None:
    """A map of which no street remains is refused with the reason."""
    with pytest.raises(MapError, match="no street of the file survived"):
        import_map(MAPS / "zz-empty-roundabout" / "input.osm.gz", "refused")
    assert "refused" not in stored_maps()
