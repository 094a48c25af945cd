"""Snapshots of street maps: what was read is what comes back, and nothing depends on them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import shapely

from cosim.core.cache import forget_entries
from cosim.core.errors import MapError
from cosim.spec.scenario import City
from sumo_nets.city.store import city_net
from sumo_nets.net.net_file import read_net
from sumo_nets.net.snapshot import SNAPSHOT_FOLDER, map_as_bytes, street_map_of, thawed
from tests.conftest import PATIENCE_S


@pytest.fixture(scope="module")
def net() -> Path:
    return city_net(City(seed=3, size_m=300.0))


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache" / SNAPSHOT_FOLDER


def test_a_snapshot_holds_every_value_of_the_map(net: Path) -> None:
    """Ids, numbers, lines and polygons come back equal to the bit, in the same order."""
    read = read_net(net)
    back = thawed(map_as_bytes(read))
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
    """Once a snapshot lies there the net itself is not parsed again."""
    first = street_map_of(net)
    assert len(list(cache.iterdir())) == 1
    monkeypatch.setattr("sumo_nets.net.net_file.read_net", lambda _: pytest.fail("parsed again"))
    assert map_as_bytes(street_map_of(net)) == map_as_bytes(first)


def test_who_keeps_a_snapshot_makes_room_first(net: Path, cache: Path) -> None:
    """A snapshot that was not used for a month goes; the new one is in use, and stays whatever the
    limit."""
    cache.mkdir(parents=True)
    (cache / "old.map").write_bytes(b"old")
    os.utime(cache / "old.map", (0.0, 0.0))
    street_map_of(net)
    assert [path.name == "old.map" for path in cache.iterdir()] == [False]
    assert not forget_entries(limit_bytes=0).entries


def test_a_damaged_snapshot_is_made_anew(net: Path, cache: Path) -> None:
    """A flipped bit or a cut file costs a reading, not a wrong map."""
    whole = map_as_bytes(street_map_of(net))
    (kept,) = cache.iterdir()
    sound = kept.read_bytes()
    flipped = bytearray(sound)
    flipped[len(sound) // 2] ^= 16
    for bad in (bytes(flipped), sound[:1000], b""):
        kept.write_bytes(bad)
        assert map_as_bytes(street_map_of(net)) == whole
        assert kept.read_bytes() == sound


def test_another_net_has_another_snapshot(net: Path, cache: Path, tmp_path: Path) -> None:
    """The net's bytes are part of a snapshot's name: an edited net is never answered from an old
    one."""
    street_map_of(net)
    edited = tmp_path / net.name
    edited.write_bytes(net.read_bytes().replace(b'"frontage_m" value="', b'"frontage_m" value="1'))
    assert map_as_bytes(street_map_of(edited)) != map_as_bytes(street_map_of(net))
    assert len(list(cache.iterdir())) == 2


def test_a_cache_that_cannot_be_written_is_no_error(
    net: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The map is read all the same."""
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path / "file"))
    assert map_as_bytes(street_map_of(net)) == map_as_bytes(read_net(net))


def test_a_full_disk_leaves_no_half_snapshot(net: Path, tmp_path: Path) -> None:
    """The map is read all the same, one line says that it is not kept, and the next process finds
    nothing that it could take for one."""
    code = (
        "import pathlib, resource, sys\nfrom sumo_nets.net.snapshot import street_map_of\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))\n"
        "print(len(street_map_of(pathlib.Path(sys.argv[1])).strips))"
    )
    kept = tmp_path / "full"
    done = subprocess.run(
        [sys.executable, "-B", "-c", code, str(net)],
        env=os.environ | {"COSIM_CACHE": str(kept)},
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.stdout == f"{len(read_net(net).strips)}\n", done.stderr
    assert (
        done.stderr.startswith(f"note: {kept / 'read'}: not kept")
        and len(done.stderr.splitlines()) == 1
    )
    assert list((kept / "read").iterdir()) == []


def test_a_missing_net_is_an_error_that_names_it(tmp_path: Path, cache: Path) -> None:
    """The reader's own message, not the cache's."""
    with pytest.raises(MapError, match="nowhere"):
        street_map_of(tmp_path / "nowhere.net.xml")
