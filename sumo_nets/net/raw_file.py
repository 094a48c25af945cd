"""Files that others made, as bytes: regular files alone, unpacked within bounds, XML without traps.

What is no map must end soon, in words, and without filling disk or memory: pipes, gzip bombs, XML
nested without end.
"""

from __future__ import annotations

import bz2
import gzip
import hashlib
import io
import lzma
import re
import stat
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any
from xml.parsers import expat

from cosim.core.errors import MapError, unwritable

LARGEST_BYTES = 2 * 1024**3
"""A file that unpacks to more than this is refused: cut the area out first."""
TIMES_PACKED = 200
SMALL_BYTES = 64 * 1024**2
"""Beyond so many bytes a file may not be more than TIMES_PACKED times as large as it was packed."""
DEEPEST = 40
"""Elements of a map are not nested deeper; those of nets and OpenStreetMap are at most 5 deep."""
LONGEST_BYTES = 16 * 1024**2
"""Of a single tag or comment."""
PIECE_BYTES = 1 << 20
KNOWN_ROOTS = ("additional", "gpx", "html", "kml", "osmChange", "routes", "svg", "tlLogics")
"""What else is taken for a map. Other names are not repeated: a file that is no map may be any file
of the user's."""
BLANK = b"\xef\xbb\xbf\xff\xfe\x00 \t\r\n"
"""What may stand before the first element, marks of byte order included."""

OPENERS: Mapping[str, Callable[[Path], Any]] = {
    "": io.FileIO,
    "gzip": gzip.GzipFile,
    "bzip2": bz2.BZ2File,
}
BROKEN = (EOFError, zlib.error, lzma.LZMAError)


def head_of(path: Path) -> bytes:
    """The first 64 bytes of a regular file. Raises MapError naming what it is instead."""
    try:
        mode = path.stat().st_mode
        if not stat.S_ISREG(mode):
            what = (
                "a folder"
                if stat.S_ISDIR(mode)
                else "a pipe"
                if stat.S_ISFIFO(mode)
                else "a device or a socket"
            )
            raise MapError(f"{path}: cannot be read: it is {what}, not a file")
        with path.open("rb") as file:
            return file.read(64)
    except OSError as error:
        raise MapError(f"{path}: cannot be read: {error.strerror or error}") from error


def pour(source: Path, packing: str, target: Path) -> None:
    """Write `source`, unpacked, to `target`. Raises MapError when it is broken, too large or no
    XML."""
    with file_pieces(source, packing) as unpacked:
        try:
            with target.open("wb") as out:
                for piece in unpacked:
                    out.write(piece)
        except OSError as error:
            raise unwritable(
                target.parent, error, "set COSIM_CACHE to another folder, or make room"
            ) from error


def net_bytes(path: Path) -> bytes:
    """A .net.xml or .net.xml.gz as XML. Raises MapError when it cannot be read."""
    packing = "gzip" if head_of(path)[:2] == b"\x1f\x8b" else ""
    whole = io.BytesIO()
    with file_pieces(path, packing) as unpacked:
        for piece in unpacked:
            whole.write(piece)
    return whole.getvalue()


@contextmanager
def file_pieces(source: Path, packing: str) -> Iterator[Iterator[bytes]]:
    """The content of a file, piece by piece. packing: "", "gzip" or "bzip2"."""
    try:
        with OPENERS[packing](source) as stream:
            yield _bounded(source, stream, source.stat().st_size)
    except BROKEN as error:
        raise MapError(
            f"{source}: broken {packing} file, probably cut short: {error}: get it again"
        ) from error
    except (OSError, ValueError) as error:
        said = getattr(error, "strerror", None) or error
        raise MapError(f"{source}: cannot be unpacked ({packing or 'plain'}): {said}") from error


def _bounded(source: Path, stream: IO[bytes], packed: int) -> Iterator[bytes]:
    size = 0
    while piece := stream.read(PIECE_BYTES):
        if not size and not piece.lstrip(BLANK).startswith(b"<"):
            raise MapError(f"{source}: it holds no XML")
        size += len(piece)
        if size > LARGEST_BYTES:
            gib = LARGEST_BYTES >> 30
            raise MapError(
                f"{source}: more than {gib} GiB unpacked: cut the area of interest out first"
            )
        if size > SMALL_BYTES and size > TIMES_PACKED * packed:
            raise MapError(
                f"{source}: unpacks to more than {TIMES_PACKED} times its size: no map does: "
                f"get it again"
            )
        yield piece


def parse(parser: expat.XMLParserType, path: Path) -> None:
    """Feed a file of XML to a parser whose handlers are set. What is refused is a ValueError that
    names the line."""
    fed = 0
    try:
        with path.open("rb") as file:
            while piece := file.read(PIECE_BYTES):
                parser.Parse(piece, False)
                fed += len(piece)
                if fed - parser.CurrentByteIndex > LONGEST_BYTES:
                    raise ValueError(f"a single tag of more than {LONGEST_BYTES >> 20} MiB")
            parser.Parse(b"", True)
    except expat.ExpatError as error:
        raise ValueError(str(error)) from error
    except KeyError as error:
        raise ValueError(
            f"attribute {error} is missing: line {parser.CurrentLineNumber}"
        ) from error
    except (LookupError, ValueError) as error:
        if "encoding" in str(error):
            raise ValueError("unknown encoding: line 1") from error
        raise ValueError(f"{error}: line {parser.CurrentLineNumber}") from error


def other_root(tag: str) -> str:
    """In words, the root element of a file of XML that is no map."""
    return f"its root element is <{tag}>" if tag in KNOWN_ROOTS else "its root element is another"


def root_of(path: Path) -> str:
    """The root element of a file of XML that was read to its end. What is broken or a trap is a
    ValueError."""
    parser = expat.ParserCreate()
    root: list[str] = []
    depth = 0

    def start(tag: str, _attributes: list[str]) -> None:
        nonlocal depth
        depth += 1
        if depth > DEEPEST:
            raise ValueError(f"elements nested more than {DEEPEST} deep")
        if not root:
            root.append(tag)

    def end(_tag: str) -> None:
        nonlocal depth
        depth -= 1

    def entity(*_declared: object) -> None:
        raise ValueError("it declares an entity: no map has any")

    parser.ordered_attributes = True
    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.EntityDeclHandler = entity
    parse(parser, path)
    return root[0]


_SCHEMA = b"xsi:noNamespaceSchemaLocation"


def without_comments(net: bytes) -> bytes:
    """A net's XML without comments: netconvert's hold the time, its version and the folders of the
    machine."""
    return re.sub(rb"<!--.*?-->\s*", b"", net, flags=re.DOTALL) if b"<!--" in net else net


def net_content_hash(path: Path) -> str:
    """SHA-256 (16 hex digits) of what a net says: comments, schema location and line ends do not
    count."""
    return hash_of(net_bytes(path))


def hash_of(data: bytes) -> str:
    """Content hash of a net's XML."""
    bare = without_comments(data)
    # A search for the plain words is far quicker than the pattern that begins with white space.
    if _SCHEMA in bare:
        pieces = re.split(_SCHEMA + rb'="[^"]*"', bare)
        bare = b"".join([piece.rstrip() for piece in pieces[:-1]] + pieces[-1:])
    return hashlib.sha256(bare.replace(b"\r\n", b"\n").strip()).hexdigest()[:16]
