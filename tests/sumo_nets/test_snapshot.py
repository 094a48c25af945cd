"""Snapshots of street maps: they restore the map exactly, and results do not depend on them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import shapely

from cosim.core.errors import MapError
from cosim.spec.scenario import City
from sumo_nets.city.store import city_net
from sumo_nets.net.net_file import read_net
from sumo_nets.net.snapshot import SNAPSHOT_FOLDER, map_as_bytes, map_from_bytes, street_map_of


@pytest.fixture(scope="module")
def net() -> Path:
    return city_net(City(seed=3, size_m=300.0))


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache" / SNAPSHOT_FOLDER


def test_a_snapshot_holds_every_value_of_the_map(net: Path) -> None:
    """Ids, numbers, lines and polygons are restored equal to the bit, in the same order."""
    read = read_net(net)
    back = map_from_bytes(map_as_bytes(read))
    assert map_as_bytes(back) == map_as_bytes(read)
    assert (back.name, back.bounds, back.net_hash, back.left_hand) == (
        read.name,
        read.bounds,
        read.net_hash,
        read.left_hand,
    )
    assert list(back.strips) == list(read.strips) and list(back.lanes) == list(read.lanes)
    for name, strip in read.strips.items():
        again = back.strips[name]
        assert np.array_equal(again.line, strip.line)
        assert shapely.equals_exact(again.polygon, strip.polygon, 0.0)
        assert (again.corners, again.driveways, again.width_m) == (
            strip.corners,
            strip.driveways,
            strip.width_m,
        )
    for name, corner in read.corners.items():
        assert back.corners[name].ports == corner.ports
        assert type(back.corners[name].polygon) is type(corner.polygon)


def test_the_second_reading_comes_from_the_snapshot(
    net: Path, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a snapshot the net itself is not parsed again."""
    first = street_map_of(net)
    assert len(list(cache.iterdir())) == 1
    monkeypatch.setattr("sumo_nets.net.net_file.read_net", lambda _: pytest.fail("parsed again"))
    assert map_as_bytes(street_map_of(net)) == map_as_bytes(first)


def test_a_damaged_snapshot_is_replaced(net: Path, cache: Path) -> None:
    """A flipped bit or a truncated file costs another parse, and never gives a wrong map."""
    expected = map_as_bytes(street_map_of(net))
    (snapshot,) = cache.iterdir()
    undamaged = snapshot.read_bytes()
    flipped = bytearray(undamaged)
    flipped[len(undamaged) // 2] ^= 16
    for bad in (bytes(flipped), undamaged[:1000], b""):
        snapshot.write_bytes(bad)
        assert map_as_bytes(street_map_of(net)) == expected
        assert snapshot.read_bytes() == undamaged


def test_another_net_has_another_snapshot(net: Path, cache: Path, tmp_path: Path) -> None:
    """The name of a snapshot has a hash of the net's bytes, so an edited net is parsed again."""
    street_map_of(net)
    edited = tmp_path / net.name
    edited.write_bytes(net.read_bytes().replace(b'"frontage_m" value="', b'"frontage_m" value="1'))
    assert map_as_bytes(street_map_of(edited)) != map_as_bytes(street_map_of(net))
    assert len(list(cache.iterdir())) == 2


def test_a_missing_net_is_an_error_that_names_it(tmp_path: Path, cache: Path) -> None:
    """The message is the reader's own."""
    with pytest.raises(MapError, match="nowhere"):
        street_map_of(tmp_path / "nowhere.net.xml")
