"""The census of cities, properties of the generator over seeds and sizes, city folders and their
commands."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from cosim.cli.app import app
from cosim.core.errors import MapError, SpecError
from cosim.place.street_map import WalkableArea
from cosim.place.walk_graph import WalkGraph
from cosim.spec.scenario import City
from sumo_nets.city.census import BLOCKS, ZONES, _shape, census, clear_width_m, longest_walk_m
from sumo_nets.city.city import STYLES
from sumo_nets.city.signals import signal_faults
from sumo_nets.city.store import (
    SEEDS,
    build_city,
    city_net,
    is_undamaged,
    shipped_cities,
    write_city,
)
from sumo_nets.net.net_file import read_net
from sumo_nets.net.raw_file import net_content_hash
from sumo_nets.net.snapshot import street_map_of

pytestmark = pytest.mark.engine


@pytest.fixture(scope="module")
def large_net() -> Path:
    """Return the net of a shipped city."""
    return city_net(shipped_cities(1)[0])


def test_a_shipped_city_has_all_documented_features(large_net: Path) -> None:
    """It has seven blocks, five zones on every street, one connected piece, wide passages, long
    walks, islands, driveways, and no fault."""
    found = census(large_net)
    assert found.faults == ()
    assert list(found.blocks) == list(BLOCKS) and min(found.blocks.values()) >= 2
    assert list(found.zones) == list(ZONES) and found.missing == 0
    assert found.one_piece >= 0.99 and found.clear_m >= 1.2 and found.longest_m >= 1500.0
    assert min(found.crosswalks, found.refuges, found.driveways, found.signals) > 40
    assert all(span.low < span.high for span in found.zones.values())


def test_the_census_finds_faults(tmp_path: Path) -> None:
    """Missing zones, too narrow passages, and signals without a walk phase are faults."""
    broken = tmp_path / "broken.net.xml"
    build_city(City(seed=2, size_m=500.0), broken)
    net = broken.read_bytes()
    assert census(broken).faults == ()
    broken.write_bytes(net.replace(b'key="frontage_m"', b'key="other"').replace(b'G"/>', b'r"/>'))
    faults = census(broken).faults
    assert any("without all of the zones" in fault for fault in faults)
    assert any("never changes between walk and stop" in fault for fault in faults)
    broken.write_bytes(
        net.replace(b'width="3.20"', b'width="1.10"').replace(b'width="1.92"', b'width="1.10"')
    )
    assert any("a passage is only 1." in fault for fault in census(broken).faults)


def test_streets_are_classified_by_their_turns() -> None:
    """A line without turns is straight, one that turns one way a curve, and one that turns both
    ways an S-bend."""
    x = np.linspace(0.0, 100.0, 30)
    assert _shape(np.column_stack([x, 0.02 * x])) == "straight"
    assert _shape(np.column_stack([x, 0.004 * x * x])) == "curve"
    assert _shape(np.column_stack([x, 12.0 * np.sin(x / 16.0)])) == "s_bend"


def test_shipped_seeds_are_a_hundred_different_ones() -> None:
    """The list of seeds has no repeats, and all cities have different names."""
    assert len(SEEDS) == len(set(SEEDS)) == 100
    assert len({city.name for city in shipped_cities()}) == 100


@settings(max_examples=3)
@given(
    seed=st.integers(0, 2**31),
    size_m=st.floats(200.0, 600.0).map(lambda size: round(size, 1)),
    style=st.sampled_from(sorted(STYLES)),
)
def test_any_city_is_connected_and_reproducible(
    tmp_path_factory: pytest.TempPathFactory, seed: int, size_m: float, style: str
) -> None:
    """Any seed, size and style gives one component, reachable strips, the clear width, signals
    without fault, and the same bytes again."""
    folder = tmp_path_factory.mktemp("any")
    one, two = folder / "one.net.xml", folder / "two.net.xml"
    city = City(seed=seed, size_m=size_m, style=style)
    build_city(city, one)
    build_city(city, two)
    assert one.read_bytes() == two.read_bytes()
    assert signal_faults(one.read_bytes()) == []
    place = read_net(one)
    assert all(None not in strip.corners for strip in place.strips.values())
    graph = WalkGraph(place)
    assert set(graph.component) == {0}
    assert clear_width_m(place) >= 1.2
    assert longest_walk_m(graph) > 0.8 * size_m


def test_a_city_folder_is_equal_when_made_again(tmp_path: Path) -> None:
    """The net and its parameters are equal byte by byte, and other folders are not overwritten."""
    city = City(seed=4, size_m=260.0)
    made = [write_city(city, tmp_path / name) for name in ("a", "b")]
    assert made[0] == made[1] and made[0].net_hash == net_content_hash(
        tmp_path / "a" / "city.net.xml"
    )
    for name in ("city.net.xml", "city.json"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    assert sorted(p.name for p in (tmp_path / "a").iterdir()) == ["city.json", "city.net.xml"]
    with pytest.raises(MapError, match="is not a city's folder"):
        write_city(city, tmp_path)
    with pytest.raises(SpecError, match="size_m must be"):
        write_city(City(seed=4, size_m=20.0), tmp_path / "c")
    assert not (tmp_path / "c").exists()


@pytest.mark.parametrize(
    "damage",
    [lambda b: b[:-1], lambda b: b[: len(b) // 2], lambda b: b"", lambda b: b[:9] + b"!" + b[10:]],
)
def test_a_damaged_net_in_the_cache_is_built_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, damage: Callable[[bytes], bytes]
) -> None:
    """Truncated, emptied or altered files in the cache are noticed and replaced."""
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path))
    city = City(seed=9, size_m=200.0)
    path = city_net(city)
    undamaged = path.read_bytes()
    path.write_bytes(damage(undamaged))
    assert not is_undamaged(path)
    assert city_net(city).read_bytes() == undamaged


def test_city_commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """make, table and draw write their outputs, and invalid input ends with a message."""
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path / "cache"))
    runner = CliRunner()
    made = runner.invoke(app, ["city", "make", "--seed", "3", "--size", "250", str(tmp_path / "c")])
    assert made.exit_code == 0 and (tmp_path / "c" / "city.json").exists()
    shown = runner.invoke(app, ["city", "table", "--count", "2", "--size", "300"])
    assert shown.exit_code == 0 and "2 cities" in shown.output and "frontage" in shown.output
    drawn = runner.invoke(
        app, ["city", "draw", "3", "--size", "250", "-o", str(tmp_path / "c.png")]
    )
    assert drawn.exit_code == 0 and (tmp_path / "c.png").read_bytes()[1:4] == b"PNG"
    for zoom in ("1,2,3", "5,5,1,9", "900,900,990,990"):
        bad = runner.invoke(
            app,
            ["city", "draw", "3", "--size", "250", "-o", str(tmp_path / "d.png"), "--zoom", zoom],
        )
        assert bad.exit_code != 0 and "--zoom" in str(bad.exception)
    bad = runner.invoke(app, ["city", "draw", "3", "--size", "250", "-o", str(tmp_path / "d.gif")])
    assert "use a name that ends in .png" in str(bad.exception) and not list(tmp_path.glob("d.*"))
    assert (
        runner.invoke(
            app, ["city", "make", "--seed", "1", "--size", "9", str(tmp_path / "e")]
        ).exit_code
        != 0
    )


def test_distance_to_the_edge_equals_that_of_shapely(large_net: Path) -> None:
    """Signed distances equal shapely's distance to the whole boundary, positive inside, with holes
    and parts."""
    place = street_map_of(large_net)
    area = WalkableArea(place.walkable)
    xy = np.random.default_rng(1).uniform(0.0, 2000.0, (300, 2))
    points = shapely.points(xy)
    expected = shapely.distance(points, shapely.boundary(place.walkable))
    inside = shapely.contains(place.walkable, points)
    assert np.array_equal(area.signed_distance(xy), np.where(inside, expected, -expected))
