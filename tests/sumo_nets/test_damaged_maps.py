"""Damaged and malicious maps: refused in one line with the place of the fault, or imported
completely, without leftovers."""

from __future__ import annotations

import bz2
import gzip
import os
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import pytest

from cosim.core.errors import WRONG_USE, MapError
from sumo_nets.maps.importer import Options
from sumo_nets.maps.map_store import checked_map, import_map, map_net
from sumo_nets.net import raw_file as rawfile
from sumo_nets.net.net_facts import read_facts
from sumo_nets.net.net_file import read_net
from tests.sumo_nets.conftest import stored_maps
from tests.support.mutate_maps import DAMAGES, damaged

pytestmark = pytest.mark.usefixtures("own_cache")

SAMPLE = 19
WHOLE = 300
"""Number of damaged maps with --whole; by default SAMPLE, one of each kind."""

TOWN = """<?xml version="1.0" encoding="UTF-8"?>
<osm version="0.6">
<node id="1" lon="13.4000000" lat="52.5000000"/>
<node id="2" lon="13.4017000" lat="52.5000000"/>
<node id="3" lon="13.4000000" lat="52.5011000"/>
<node id="4" lon="13.4017000" lat="52.5011000"/>
<way id="100"><nd ref="1"/><nd ref="3"/><tag k="highway" v="residential"/><tag k="name" v="A &amp; Ö"/></way>
<way id="101"><nd ref="2"/><nd ref="4"/><tag k="highway" v="residential"/><tag k="sidewalk" v="both"/></way>
<way id="200"><nd ref="1"/><nd ref="2"/><tag k="highway" v="residential"/><tag k="sidewalk" v="both"/></way>
<way id="201"><nd ref="3"/><nd ref="4"/><tag k="highway" v="residential"/><tag k="lanes" v="2"/></way>
<way id="300"><nd ref="1"/><nd ref="4"/><tag k="highway" v="footway"/></way>
</osm>
"""


def nested(depth: int) -> bytes:
    return b"<osm>" + b"<a>" * depth + b"</a>" * depth + b"</osm>"


def tagged(key: str, value: str) -> bytes:
    """Return the town with a tag on its first street."""
    return TOWN.replace('<tag k="name"', f'<tag k="{key}" v="{value}"/><tag k="name"').encode()


BOMB = (
    '<!DOCTYPE osm [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;&a;&a;">]>\n<osm '
    'version="0.6">&b;</osm>'
)


def packed_spaces(count: int, packed: Callable[[bytes], bytes]) -> bytes:
    """Return the begin of a map and many copies of a packed million of spaces."""
    return packed(b"<osm>\n") + packed(b" " * 1_000_000) * count


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        pytest.param(
            "a.osm", nested(100_000), "elements nested more than 40 deep: line 1", id="nested"
        ),
        pytest.param(
            "a.net.xml",
            b"<net>" + b"<a>" * 100_000,
            "nested more than 40 deep: line 1",
            id="nested-net",
        ),
        pytest.param(
            "a.osm",
            tagged("lanes", "1000000000"),
            "way 100: lanes=1000000000, but no street",
            id="lanes",
        ),
        pytest.param(
            "a.osm",
            tagged("lanes:forward", "99999"),
            "way 100: lanes:forward=99999, but",
            id="lanes-forth",
        ),
        pytest.param(
            "a.osm",
            tagged("width", "1e9"),
            "way 100: width=1e9, but no street has more",
            id="width",
        ),
        pytest.param(
            "a.osm",
            tagged("width:lanes", "3|1e9"),
            "way 100: width:lanes=3|1e9, but no",
            id="width-of-lane",
        ),
        pytest.param(
            "a.osm", BOMB.encode(), "it declares an entity: no map has any: line 1", id="entities"
        ),
        pytest.param(
            "a.osm",
            TOWN.replace("13.4017000", "nan", 1).encode(),
            "node 2 lies nowhere: lon=nan",
            id="nan",
        ),
        pytest.param(
            "a.osm",
            TOWN.replace(' lat="52.5011000"', "", 1).encode(),
            "'lat' is missing: line 5",
            id="lat",
        ),
        pytest.param(
            "a.osm", TOWN.encode("latin-1"), "not well-formed (invalid token): line 7", id="no-utf8"
        ),
        pytest.param(
            "a.osm",
            TOWN.encode() + b"<osm/>",
            "junk after document element: line 13",
            id="two-roots",
        ),
        pytest.param(
            "a.osm",
            b"<osm><!--" + b"x" * 20_000_000,
            "a single tag of more than 16 MiB",
            id="comment",
        ),
        pytest.param(
            "a.osm.gz",
            gzip.compress(b"\0" * 3_000_000, mtime=0),
            "it holds no XML",
            id="gzip-of-zeros",
        ),
        pytest.param(
            "a.osm.gz",
            packed_spaces(80, lambda d: gzip.compress(d, mtime=0)),
            "more than 200 times",
            id="gzip-bomb",
        ),
        pytest.param(
            "a.osm.bz2",
            packed_spaces(80, bz2.compress),
            "more than 200 times its size",
            id="bzip2-bomb",
        ),
    ],
)
def test_malicious_files_are_refused(
    tmp_path: Path, name: str, content: bytes, reason: str
) -> None:
    """Files that would block netconvert, or fill memory or disk, are refused before the
    conversion."""
    source = tmp_path / name
    before = stored_maps()
    source.write_bytes(content)
    with pytest.raises(MapError) as caught:
        import_map(source)
    message = str(caught.value)
    assert (
        message.startswith(f"{source}: ")
        and reason in message
        and "\n" not in message
        and len(message) < 400
    )
    assert stored_maps() == before


def test_valid_lanes_and_widths_are_accepted(tmp_path: Path) -> None:
    """Words, units and several values in a tag are left to netconvert, and so are other tags with
    lanes."""
    from sumo_nets.maps.osm_file import osm_facts, unpack_map

    path = tmp_path / "town.osm"
    for key, value in (
        ("lanes", "2;3"),
        ("lanes", "some"),
        ("width", "12'6\""),
        ("width", "3.5 m"),
        ("maxspeed:lanes", "120|100"),
        ("turn:lanes", "left|through"),
        ("width", "~4"),
        ("maxwidth", "999"),
        ("lanes:psv", "1"),
    ):
        path.write_bytes(tagged(key, value.replace('"', "&quot;")))
        assert osm_facts(unpack_map(path, tmp_path)).roads == 4


@pytest.mark.parametrize(
    "read", [import_map, read_net, read_facts], ids=["import", "read", "facts"]
)
def test_paths_that_are_no_files_are_refused(
    tmp_path: Path, read: Callable[[Path], object]
) -> None:
    """A pipe, a folder, a device, and links to themselves and to nothing are named."""
    before = stored_maps()
    pipe, loop, nothing = tmp_path / "pipe.osm", tmp_path / "loop.osm", tmp_path / "nothing.osm"
    os.mkfifo(pipe)
    loop.symlink_to(loop)
    nothing.symlink_to(tmp_path / "gone")
    for path, words in (
        (pipe, "it is a pipe, not a file"),
        (tmp_path, "it is a folder, not a file"),
        (Path("/dev/zero"), "it is a device or a socket, not a file"),
        (loop, "Too many levels of symbolic links"),
        (nothing, "No such file"),
    ):
        with pytest.raises(MapError) as caught:
            read(path)
        assert str(caught.value).startswith(f"{path}: cannot be read: ") and words in str(
            caught.value
        )
    assert stored_maps() == before


def test_a_file_that_may_not_be_read_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error of a file without read permission says so."""
    source = tmp_path / "a.osm"
    source.write_text(TOWN)

    opened = Path.open

    def closed(self: Path, *arguments: Any, **more: Any) -> IO[Any]:
        if self == source:
            raise PermissionError(13, "Permission denied", str(self))
        return opened(self, *arguments, **more)

    monkeypatch.setattr(Path, "open", closed)
    with pytest.raises(MapError, match=r"a\.osm: cannot be read: Permission denied"):
        import_map(source)


def test_memory_stays_bounded_while_a_bomb_is_read(tmp_path: Path) -> None:
    """No more of a packed net is unpacked than its size allows."""
    path = tmp_path / "bomb.net.xml.gz"
    path.write_bytes(packed_spaces(400, lambda data: gzip.compress(data, mtime=0)))
    with (
        pytest.raises(MapError, match="more than 200 times its size"),
        rawfile.file_chunks(path, "gzip") as unpack_map,
    ):
        most = 0
        for piece in unpack_map:
            most += len(piece)
    assert most <= rawfile.TIMES_PACKED * path.stat().st_size < 400_000_000 / 4


def test_damages_are_functions_of_their_number() -> None:
    """The same number gives the same damage, and every kind changes the map in most of its
    draws."""
    town = TOWN.encode()
    assert all(damaged(town, n) == damaged(town, n) for n in range(len(DAMAGES)))
    changed = Counter(damaged(town, n)[0] for n in range(WHOLE) if damaged(town, n)[1] != town)
    assert set(changed) == {damage.__name__ for damage in DAMAGES} and min(changed.values()) >= 8


@pytest.mark.engine
def test_damaged_maps_are_imported_or_refused_in_one_line(
    tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    """The line names the file, and no other file is left. By default one of each kind of damage is
    tried, with --whole 300."""
    town = tmp_path / "town.osm"
    town.write_text(TOWN)
    import_map(town)
    bases = {"osm": town.read_bytes(), "net.xml": map_net("town").read_bytes()}
    outcomes: Counter[str] = Counter()
    longest_s = 0.0
    for number in range(WHOLE) if request.config.getoption("--whole") else range(0, 2 * SAMPLE, 2):
        kind = ("osm", "net.xml")[number // len(DAMAGES) % 2]
        how, data = damaged(bases[kind], number)
        source = tmp_path / f"damaged.{kind}"
        started = time.monotonic()
        source.write_bytes(data)
        try:
            import_map(source, "damaged", Options(as_is=kind == "net.xml" and number % 3 == 0))
        except MapError as refusal:
            message = str(refusal)
            outcome = "refused"
            assert message.startswith(f"{source}: ") and "\n" not in message, (number, how, message)
            assert len(message) > len(f"{source}: ") + 15 and "did not end" not in message, (
                number,
                how,
                message,
            )
            assert refusal.exit_code == WRONG_USE
        else:
            outcome = "imported"
            street_map, _, about = checked_map("damaged")
            assert street_map.strips and street_map.net_hash == about.net_hash, (number, how)
        assert set(stored_maps()) - {".lock"} <= {"town", "damaged"}, (number, how, stored_maps())
        outcomes[outcome] += 1
        longest_s = max(longest_s, time.monotonic() - started)
    print(f"{dict(outcomes)}; the longest took {longest_s:.1f} s")
    assert outcomes["refused"] >= 5 and outcomes["imported"] >= 1
