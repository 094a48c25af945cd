"""Read the bytes of a scan's file, and refuse those that are no scan."""

from __future__ import annotations

import gzip
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from cosim.core.errors import MapError
from cosim.core.files import read_limited

MAX_BYTES: Final = 4 << 30
"""Maximum size of a file in bytes."""
_HEAD_BYTES: Final = 64 << 10
"""Number of bytes at the start of a .ply file in which its header must end."""
_PLY_TYPES: Final = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
"""numpy's names of the number types of .ply files."""

SourceKind = Literal["mesh", "splats", "points"]
"""Kinds of scan files. Points are not used."""


@dataclass(frozen=True, slots=True)
class PlyElement:
    """Element of a .ply file, with its scalar properties and their numpy types.

    lists: whether it has list properties, as faces do.
    """

    name: str
    count: int
    properties: tuple[tuple[str, str], ...]
    lists: bool


@dataclass(frozen=True, slots=True)
class PlyHeader:
    """Header of a .ply file.

    size: of the header in bytes.
    """

    form: str
    elements: tuple[PlyElement, ...]
    size: int


def stem_and_ending(path: Path) -> tuple[str, str]:
    """Return a file's name without its ending, and its ending in lower case without `.gz`."""
    name = path.name[:-3] if path.name.lower().endswith(".gz") else path.name
    stem, dot, ending = name.rpartition(".")
    return (stem, f".{ending.lower()}") if dot else (name, "")


def read_source(path: Path) -> bytes:
    """Return the content of a file, unpacked if its name ends in .gz.

    Raises MapError if it cannot be read or unpacked, or is a Git LFS pointer or a web page.
    """
    try:
        data = read_limited(path, MAX_BYTES)
    except OSError as error:
        raise MapError(f"{path}: cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise MapError(f"{path}: {error}: reduce the scan, or cut it into parts") from error
    if path.name.lower().endswith(".gz") and data[:2] == b"\x1f\x8b":
        try:
            data = gzip.decompress(data)
        except (OSError, EOFError, zlib.error) as error:
            raise MapError(
                f"{path}: its packed content ends after {len(data)} bytes or is damaged ({error}): "
                "download it again"
            ) from error
    start = data[:512].lstrip(b"\xef\xbb\xbf \t\r\n").lower()
    if start.startswith(b"version https://git-lfs"):
        raise MapError(
            f"{path}: a Git LFS pointer of {len(data)} bytes in place of the scan: run "
            "`git lfs pull` where it comes from"
        )
    if start.startswith((b"<!doctype", b"<html", b"<?xml")):
        raise MapError(
            f"{path}: a web page of {len(data)} bytes in place of the scan: open the link in a "
            "browser and save the file itself"
        )
    if not data:
        raise MapError(f"{path}: an empty file: export the scan again")
    return data


def read_ply_header(path: Path, data: bytes) -> PlyHeader:
    """Return the header of a .ply file. Raises MapError if it has none."""
    head = data[:_HEAD_BYTES]
    end = head.find(b"end_header")
    line_end = head.find(b"\n", end)
    if not head.startswith(b"ply") or end < 0 or line_end < 0:
        raise MapError(
            f"{path}: not a .ply file: it starts with {head[:16]!r} in place of a header: export "
            "the scan again"
        )
    form = ""
    elements: list[PlyElement] = []
    for line in head[:end].decode("ascii", "replace").splitlines():
        words = line.split()
        try:
            if words[:1] == ["format"]:
                form = words[1]
            elif words[:1] == ["element"]:
                elements.append(PlyElement(words[1], int(words[2]), (), False))
            elif words[:1] == ["property"]:
                elements[-1] = _with_property(elements[-1], words)
        except (IndexError, KeyError, ValueError) as error:
            raise MapError(
                f"{path}: line '{line[:60]}' of its header cannot be read: export the scan again"
            ) from error
    return PlyHeader(form, tuple(elements), line_end + 1)


def _with_property(element: PlyElement, words: list[str]) -> PlyElement:
    if words[1] == "list":
        return PlyElement(element.name, element.count, element.properties, True)
    added = (*element.properties, (words[2], _PLY_TYPES[words[1]]))
    return PlyElement(element.name, element.count, added, element.lists)


def kind_of_source(path: Path, data: bytes) -> SourceKind:
    """Return the kind of a file, by its ending and, of a .ply file, by its header.

    Raises MapError for another ending.
    """
    ending = stem_and_ending(path)[1]
    if ending in (".spz", ".splat"):
        return "splats"
    if ending in (".glb", ".obj"):
        return "mesh"
    if ending != ".ply":
        raise MapError(
            f"{path}: cannot be read as a scan: give a mesh (.glb, .ply, .obj) or splats (.ply, "
            ".spz, .splat), packed with gzip (.gz) or not"
        )
    header = read_ply_header(path, data)
    names = {name for element in header.elements for name, _ in element.properties}
    if names & {"scale_0", "f_dc_0", "packed_position"}:
        return "splats"
    faces = any(element.name == "face" and element.count for element in header.elements)
    return "mesh" if faces else "points"
