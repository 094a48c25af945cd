"""Read map files of users within bounds, and hash nets by their content.

Only regular files are read. Pipes, gzip bombs and deeply nested XML are refused before they fill
disk or memory.
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
"""Largest size of an unpacked file, bytes; larger maps must be cropped first."""
TIMES_PACKED = 200
"""Largest ratio of unpacked to packed size, for files above SMALL_BYTES."""
SMALL_BYTES = 64 * 1024**2
"""Unpacked size in bytes up to which TIMES_PACKED is not checked."""
DEEPEST = 40
"""Largest nesting depth of XML elements; nets and OpenStreetMap files need 5."""
LONGEST_BYTES = 16 * 1024**2
"""Largest size of a single tag or comment, bytes."""
PIECE_BYTES = 1 << 20
"""Size of the chunks in which files are read, bytes."""
KNOWN_ROOTS = ("additional", "gpx", "html", "kml", "osmChange", "routes", "svg", "tlLogics")
"""Root elements of other file types that may be named in errors. Other names are not repeated:
the file may be any private file of the user."""
BLANK = b"\xef\xbb\xbf\xff\xfe\x00 \t\r\n"
"""Bytes that may precede the first element, byte order marks included."""

OPENERS: Mapping[str, Callable[[Path], Any]] = {
    "": io.FileIO,
    "gzip": gzip.GzipFile,
    "bzip2": bz2.BZ2File,
}
UNPACK_ERRORS = (EOFError, zlib.error, lzma.LZMAError)


def read_head(path: Path) -> bytes:
    """Return the first 64 bytes of a regular file. Raises MapError for anything else."""
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


def unpack_file(source: Path, packing: str, target: Path) -> None:
    """Write `source`, unpacked, to `target`. Raises MapError if it is damaged, too large or not
    XML."""
    with file_chunks(source, packing) as unpacked:
        try:
            with target.open("wb") as out:
                for piece in unpacked:
                    out.write(piece)
        except OSError as error:
            raise unwritable(
                target.parent, error, "set COSIM_CACHE to another folder, or make room"
            ) from error


def net_bytes(path: Path) -> bytes:
    """Return the XML of a .net.xml or .net.xml.gz. Raises MapError if it cannot be read."""
    packing = "gzip" if read_head(path)[:2] == b"\x1f\x8b" else ""
    whole = io.BytesIO()
    with file_chunks(path, packing) as unpacked:
        for piece in unpacked:
            whole.write(piece)
    return whole.getvalue()


@contextmanager
def file_chunks(source: Path, packing: str) -> Iterator[Iterator[bytes]]:
    """Yield the content of a file in chunks.

    packing: "", "gzip" or "bzip2".
    """
    try:
        with OPENERS[packing](source) as stream:
            yield _bounded(source, stream, source.stat().st_size)
    except UNPACK_ERRORS as error:
        raise MapError(
            f"{source}: broken {packing} file, probably cut short: {error}: get it again"
        ) from error
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise MapError(f"{source}: cannot be unpacked ({packing or 'plain'}): {reason}") from error


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
    """Feed an XML file to a parser whose handlers are set. Raises ValueError with the line
    number."""
    parsed = 0
    try:
        with path.open("rb") as file:
            while piece := file.read(PIECE_BYTES):
                parser.Parse(piece, False)
                parsed += len(piece)
                if parsed - parser.CurrentByteIndex > LONGEST_BYTES:
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


def describe_root(tag: str) -> str:
    """Describe the root element of an XML file that is not a map."""
    return f"its root element is <{tag}>" if tag in KNOWN_ROOTS else "its root element is another"


def root_of(path: Path) -> str:
    """Return the root element of an XML file after reading all of it. Raises ValueError if it is
    damaged or malicious."""
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
    """Return a net's XML without comments, which hold netconvert's time, version and paths."""
    return re.sub(rb"<!--.*?-->\s*", b"", net, flags=re.DOTALL) if b"<!--" in net else net


def net_content_hash(path: Path) -> str:
    """Return the SHA-256 (16 hex digits) of a net, without comments, schema location and line
    ends."""
    return net_xml_hash(net_bytes(path))


def net_xml_hash(data: bytes) -> str:
    """Return the content hash of a net's XML, see `net_content_hash`."""
    bare = without_comments(data)
    # Searching for plain bytes first is much faster than the regular expression.
    if _SCHEMA in bare:
        pieces = re.split(_SCHEMA + rb'="[^"]*"', bare)
        bare = b"".join([piece.rstrip() for piece in pieces[:-1]] + pieces[-1:])
    return hashlib.sha256(bare.replace(b"\r\n", b"\n").strip()).hexdigest()[:16]
