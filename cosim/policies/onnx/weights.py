"""The files of a bundle: where they are, that they are the right ones, and a hash of all that
decides its answers."""

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
from cosim.core.files import read_within, size_within
from cosim.policies.onnx.graph_file import external_files, weights_not_finite
from cosim.policies.onnx.manifest import BundleManifest, FileFacts, file_facts, refusal_of_name

WEIGHTS_VARIABLE: Final = "COSIM_WEIGHTS"
_MOST_BYTES: Final = 8_000_000_000
_MOST_GRAPH_BYTES: Final = 2 << 30
"""An ONNX file is a protobuf message, which holds no more; larger weights lie in files beside
it."""
_PIECE_BYTES: Final = 1 << 20


@dataclass(frozen=True)
class BundleFiles:
    """A graph's file; the BLAKE2b of it, of the files that it names, and of those that the manifest
    names; and how many bytes all of these hold."""

    graph: Path
    digest: str
    size: int


@dataclass(frozen=True)
class NetworkFile:
    """A file: its name, where it is to be had, and its facts; None where it is made here."""

    name: str
    source: str
    facts: FileFacts | None

    def check(self, path: Path, data: bytes) -> None:
        """Raises UsageError where the data of the file at `path` are not these."""
        if self.facts is None:
            return
        found = file_facts(data)
        if (found.bytes, found.blake2b) != (self.facts.bytes, self.facts.blake2b):
            raise UsageError(
                f"{path}: {found.bytes} bytes, BLAKE2b {found.blake2b}; wanted is {self.name} of "
                f"{self.source}: {self.facts.in_words}"
            )


def weight_folders() -> list[Path]:
    """Where weights are looked for that do not lie beside their manifest: $COSIM_WEIGHTS, then a
    folder of the user's data."""
    named = os.environ.get(WEIGHTS_VARIABLE, "")
    return [*([Path(named)] if named else []), user_data_path("sidewalk-cosim") / "weights"]


def weights_file(
    policy: str, name: str, facts: FileFacts | None, source: str, beside: Sequence[Path] = ()
) -> Path:
    """Where a policy's file is: in one of the folders `beside`, or of weights. Raises UsageError
    where it is in none, saying where it is to be had."""
    places = [*beside, *weight_folders()]
    for place in places:
        if (place / name).is_file():
            return place / name
    size = f", {facts.in_words}" if facts else ""
    wanted = f": from {source}" if source else ""
    looked = ", ".join(map(str, places))
    raise UsageError(
        f"policy '{policy}': {name} is missing{size}{wanted}. Looked for in {looked} (set "
        f"{WEIGHTS_VARIABLE})"
    )


def bundle_files(folder: Path, manifest: BundleManifest) -> BundleFiles:
    """The files of the bundle in a folder. Raises UsageError for one that is missing, saying where
    it is to be had, or is another than its manifest says; for a graph that is none, or has weights
    that are no numbers."""
    graph = _found(folder, manifest, manifest.model)
    data = read_file(graph)
    try:
        beside = external_files(data)
        bad = weights_not_finite(data)
    except (ValueError, RecursionError) as error:
        raise UsageError(
            f"{graph}: is no ONNX graph: {error}; {len(data)} bytes of another format, or cut off"
        ) from None
    if bad:
        more = f" and {len(bad) - 3} more" if len(bad) > 3 else ""
        raise UsageError(
            f"{graph}: weights are NaN or infinite: {', '.join(bad[:3])}{more}; export it anew"
        )
    digest = hashlib.blake2b(digest_size=32)
    size = 0
    for name in dict.fromkeys([manifest.model, *beside, *manifest.files]):
        if name in beside and (refusal := refusal_of_name(name)):
            raise UsageError(f"{graph}: has weights in a file beside it: {refusal}")
        path = (
            _inside(graph.with_name(name), graph.parent)
            if name in beside
            else _found(folder, manifest, name)
        )
        size += _digested(path, name, manifest, digest)
    return BundleFiles(graph, digest.hexdigest(), size)


def _found(folder: Path, manifest: BundleManifest, name: str) -> Path:
    """Where a file of a bundle is. Raises UsageError for one in its folder that is a link out of
    it."""
    path = weights_file(manifest.name, name, manifest.files.get(name), manifest.source, [folder])
    return _inside(path, folder) if path.parent == folder else path


def _inside(path: Path, folder: Path) -> Path:
    """A file of a bundle's folder. Raises UsageError where it is a link that leads elsewhere."""
    if path.is_symlink() and not path.resolve().is_relative_to(folder.resolve()):
        raise UsageError(
            f"{path}: is a link that leads out of its bundle: put the file there, or in a folder "
            f"of weights ({WEIGHTS_VARIABLE})"
        )
    return path


def read_file(path: Path, most_bytes: int = _MOST_GRAPH_BYTES) -> bytes:
    """All of a file, by default of a graph. Raises UsageError for what is no regular file, and for
    more bytes."""
    with _read_in_words(path):
        return read_within(path, most_bytes)


@contextmanager
def _read_in_words(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise UsageError(f"{path}: {error}") from error


def _digested(path: Path, name: str, manifest: BundleManifest, digest: hashlib.blake2b) -> int:
    """Take a file into a digest, piece by piece, and return its size. Raises UsageError for one
    that is another than its manifest says."""
    said = manifest.files.get(path.name)
    told: dict[str, int | str] = {} if said is None else {"bytes": said.bytes, **said.hashes}

    def check(what: str, found: int | str) -> None:
        if told.get(what, "") not in ("", found):
            raise UsageError(
                f"{path}: is another file than the manifest of '{manifest.name}' says: "
                f"files.{path.name}.{what} is {told[what]} there, {found} found"
            )

    blake2b = hashlib.blake2b(digest_size=32)
    sha256 = hashlib.sha256()
    with _read_in_words(path):
        size = size_within(path, _MOST_BYTES)
        check("bytes", size)
        digest.update(f"{name}\0{size}\0".encode())
        with path.open("rb") as file:
            while piece := file.read(_PIECE_BYTES):
                digest.update(piece)
                if told:
                    blake2b.update(piece)
                    sha256.update(piece)
    check("blake2b", blake2b.hexdigest())
    check("sha256", sha256.hexdigest())
    return size
