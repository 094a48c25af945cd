"""`place.file` of a scenario's file may name any file: of one that is no map nothing is printed."""

from __future__ import annotations

import gzip
from pathlib import Path

import pytest

from tests.conftest import Cosim

SECRET = "hunter2-SECRET"
OTHERS: dict[str, bytes] = {
    "text": f"{SECRET}:x:0:0".encode(),
    "binary": b"\xfe\xff" + SECRET.encode(),
    "json": b'{"key": "%s"}' % SECRET.encode(),
    "toml": f'hunter2 = "{SECRET}"'.encode(),
    "xml": f"<config><password>{SECRET}</password></config>".encode(),
    "root": f"<{SECRET}/>".encode(),
    "name space": f"<n:{SECRET} xmlns:n='{SECRET}'/>".encode(),
    "entity": f"<!DOCTYPE {SECRET} [<!ENTITY {SECRET} '{SECRET}'>]><osm/>".encode(),
    "encoding": f"<?xml version='1.0' encoding='{SECRET}'?><osm/>".encode(),
    "cut XML": f"<html><title>{SECRET}</title>".encode(),
    "packed": gzip.compress(SECRET.encode()),
    "PBF": f"OSMHeader{SECRET}".encode(),
}


@pytest.mark.parametrize(
    ("name", "ending"),
    [
        *((name, "") for name in OTHERS),
        ("text", ".net.xml"),
        ("xml", ".net.xml"),
        ("packed", ".osm"),
    ],
)
def test_of_a_file_that_is_no_map_nothing_is_printed(
    tmp_path: Path, cosim: Cosim, name: str, ending: str
) -> None:
    """Text, other XML, packed data: it is said that it is no map, with its path and no byte of
    it."""
    (tmp_path / f"other{ending}").write_bytes(OTHERS[name])
    own = f'name = "mine"\n[place]\nfile = "other{ending}"\n[way]\nkind = "straight"\n'
    (tmp_path / "mine.toml").write_text(own)
    said = cosim("scenario", "check", "mine.toml", cwd=tmp_path)
    assert said.returncode == 2 and f"place.file: {tmp_path}/other{ending}: " in said.stderr, said
    assert "hunter2" not in said.stderr + said.stdout and "Traceback" not in said.stderr, said
