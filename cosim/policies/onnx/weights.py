"""Find the files of a bundle, check them against the manifest, and hash them."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from platformdirs import user_data_path

from cosim.core.errors import UsageError
from cosim.core.files import checked_size, read_limited
from cosim.policies.onnx.graph_file import external_files, non_finite_weights
from cosim.policies.onnx.manifest import BundleManifest, FileFacts, file_facts, file_name_fault

WEIGHTS_VARIABLE: Final = "COSIM_WEIGHTS"
"""Environment variable with a folder of weights."""
_MAX_BYTES: Final = 8_000_000_000
"""Largest size of a file of a bundle in bytes."""
_MAX_GRAPH_BYTES: Final = 2 << 30
"""Largest size of an ONNX file in bytes, the limit of a protobuf message."""
_PIECE_BYTES: Final = 1 << 20
"""Bytes read at once while hashing."""


@dataclass(frozen=True)
class BundleFiles:
    """Files of a bundle.

    graph: Path of the ONNX file.
    digest: BLAKE2b of the graph, its external files and the files of the manifest.
    size: Total size in bytes.
    """

    graph: Path
    digest: str
    size: int


@dataclass(frozen=True)
class NetworkFile:
    """File of a network: name, origin, and its size and hash; None if it is generated here."""

    name: str
    source: str
    facts: FileFacts | None

    def check(self, path: Path, data: bytes) -> None:
        """Raise UsageError unless the data of the file at `path` has this size and hash."""
        if self.facts is None:
            return
        found = file_facts(data)
        if differences := self.facts.differences(found):
            of = f" of {self.source}" if self.source else ""
            raise UsageError(
                f"{path}: {found.in_words}; expected {self.name}{of}: {self.facts.in_words}. "
                f"Different: {', '.join(differences)}"
            )


def weight_folders() -> list[Path]:
    """Return the folders of weights: $COSIM_WEIGHTS, then one in the user's data folder."""
    named = os.environ.get(WEIGHTS_VARIABLE, "")
    return [*([Path(named)] if named else []), user_data_path("sidewalk-cosim") / "weights"]


def weights_file(
    user: str, name: str, facts: FileFacts | None, source: str, first: Sequence[Path] = ()
) -> Path:
    """Return the path of a file of weights.

    user: what needs it, such as "policy 'follow'".
    first: folders that are searched before the folders of weights.

    Raises UsageError with the file's origin if it is missing.
    """
    places = [*first, *weight_folders()]
    for place in places:
        if (place / name).is_file():
            return place / name
    size = f", {facts.in_words}" if facts else ""
    wanted = f": from {source}" if source else ""
    looked = ", ".join(map(str, places))
    raise UsageError(
        f"{user}: {name} is missing{size}{wanted}. Looked for in {looked} (set {WEIGHTS_VARIABLE})"
    )


def bundle_files(folder: Path, manifest: BundleManifest) -> BundleFiles:
    """Find and check the files of the bundle in a folder.

    Raises UsageError if a file is missing or differs from its manifest, or the graph is invalid or
    has weights that are not finite.
    """
    graph = _found(folder, manifest, manifest.model)
    data = read_file(graph)
    try:
        beside = external_files(data)
        bad = non_finite_weights(data)
    except (ValueError, RecursionError) as error:
        raise UsageError(
            f"{graph}: is no ONNX graph: {error}; {len(data)} bytes of another format, or cut off"
        ) from None
    if bad:
        more = f" and {len(bad) - 3} more" if len(bad) > 3 else ""
        raise UsageError(
            f"{graph}: weights are NaN or infinite: {', '.join(bad[:3])}{more}; export it again"
        )
    digest = hashlib.blake2b(digest_size=32)
    size = 0
    for name in dict.fromkeys([manifest.model, *beside, *manifest.files]):
        if name in beside and (refusal := file_name_fault(name)):
            raise UsageError(f"{graph}: has weights in a file beside it: {refusal}")
        path = (
            _inside(graph.with_name(name), graph.parent)
            if name in beside
            else _found(folder, manifest, name)
        )
        size += _digested(path, name, manifest, digest)
    return BundleFiles(graph, digest.hexdigest(), size)


def _found(folder: Path, manifest: BundleManifest, name: str) -> Path:
    """Return the path of a file.

    Raises UsageError for a link that leads out of the bundle's folder.
    """
    path = weights_file(
        f"policy '{manifest.name}'", name, manifest.files.get(name), manifest.source, [folder]
    )
    return _inside(path, folder) if path.parent == folder else path


def _inside(path: Path, folder: Path) -> Path:
    """Return a path in a bundle's folder. Raises UsageError for a link that leads out of it."""
    if path.is_symlink() and not path.resolve().is_relative_to(folder.resolve()):
        raise UsageError(
            f"{path}: is a link that leads out of its bundle: put the file there, or in a folder "
            f"of weights ({WEIGHTS_VARIABLE})"
        )
    return path


def read_file(path: Path, max_bytes: int = _MAX_GRAPH_BYTES) -> bytes:
    """Read a file. Raises UsageError if it is not a regular file or larger than max_bytes."""
    with _read_in_words(path):
        return read_limited(path, max_bytes)


@contextmanager
def _read_in_words(path: Path) -> Iterator[None]:
    """Convert errors of reading a file to UsageError."""
    try:
        yield
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise UsageError(f"{path}: {error}") from error


def _digested(path: Path, name: str, manifest: BundleManifest, digest: hashlib.blake2b) -> int:
    """Add a file to a digest and return its size.

    Raises UsageError if it differs from the manifest.
    """
    facts = manifest.files.get(path.name)
    wanted: dict[str, int | str] = {} if facts is None else {"bytes": facts.bytes, **facts.hashes}

    def check(what: str, found: int | str) -> None:
        if wanted.get(what, "") not in ("", found):
            raise UsageError(
                f"{path}: is another file than the manifest of '{manifest.name}' says: "
                f"files.{path.name}.{what} is {wanted[what]} there, {found} found"
            )

    blake2b = hashlib.blake2b(digest_size=32)
    sha256 = hashlib.sha256()
    with _read_in_words(path):
        size = checked_size(path, _MAX_BYTES)
        check("bytes", size)
        digest.update(f"{name}\0{size}\0".encode())
        with path.open("rb") as file:
            while piece := file.read(_PIECE_BYTES):
                digest.update(piece)
                if wanted:
                    blake2b.update(piece)
                    sha256.update(piece)
    check("blake2b", blake2b.hexdigest())
    check("sha256", sha256.hexdigest())
    return size
