"""What a street net says, as a hash: the same for every machine and moment it was written on."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

from sumo_nets.net.raw_file import net_bytes

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
