"""The files of a bundle: where they are, that they are the right ones, and a hash of all that decides its answers."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from platformdirs import user_data_path

from cosim.core.errors import UsageError
from cosim.policies.onnx.graph_file import external_files, weights_not_finite
from cosim.policies.onnx.manifest import BundleManifest, FileFacts, file_facts

WEIGHTS_VARIABLE: Final = "COSIM_WEIGHTS"
_MOST_BYTES: Final = 8_000_000_000


@dataclass(frozen=True)
class BundleFiles:
    """A graph's file, and the BLAKE2b of it, of the files that it names, and of those that the manifest names."""

    graph: Path
    digest: str


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
                f"{path}: {found.bytes} bytes, BLAKE2b {found.blake2b}; wanted is {self.name} of {self.source}: "
                f"{self.facts.in_words}"
            )


def weight_folders() -> list[Path]:
    """Where weights are looked for that do not lie beside their manifest: $COSIM_WEIGHTS, then a folder of the user's
    data."""
    named = os.environ.get(WEIGHTS_VARIABLE, "")
    return [*([Path(named)] if named else []), user_data_path("sidewalk-cosim") / "weights"]


def weights_file(policy: str, name: str, facts: FileFacts | None, source: str, beside: Sequence[Path] = ()) -> Path:
    """Where a policy's file is: in one of the folders `beside`, or of weights. Raises UsageError where it is in none,
    saying where it is to be had."""
    places = [*beside, *weight_folders()]
    for place in places:
        if (place / name).is_file():
            return place / name
    size = f", {facts.in_words}" if facts else ""
    wanted = f": from {source}" if source else ""
    looked = ", ".join(map(str, places))
    raise UsageError(
        f"policy '{policy}': {name} is missing{size}{wanted}. Looked for in {looked} (set {WEIGHTS_VARIABLE})"
    )


def bundle_files(folder: Path, manifest: BundleManifest) -> BundleFiles:
    """The files of the bundle in a folder. Raises UsageError for one that is missing, saying where it is to be had, or
    is another than its manifest says; for a graph that is none, or has weights that are no numbers."""
    graph = _found(folder, manifest, manifest.model)
    data = _read(graph)
    try:
        beside = external_files(data)
        bad = weights_not_finite(data)
    except (ValueError, RecursionError) as error:
        raise UsageError(
            f"{graph}: is no ONNX graph: {error}; {len(data)} bytes of another format, or cut off"
        ) from None
    if bad:
        more = f" and {len(bad) - 3} more" if len(bad) > 3 else ""
        raise UsageError(f"{graph}: weights are NaN or infinite: {', '.join(bad[:3])}{more}; export it anew")
    digest = hashlib.blake2b(digest_size=32)
    for name in dict.fromkeys([manifest.model, *beside, *manifest.files]):
        if name in beside and (not name or Path(name).name != name):
            raise UsageError(f"{graph}: has weights in '{name}': a file of a bundle lies beside its graph")
        path = graph.with_name(name) if name in beside else _found(folder, manifest, name)
        held = data if path == graph else _read(path)
        _check(path, held, manifest)
        digest.update(f"{name}\0{len(held)}\0".encode() + held)
    return BundleFiles(graph, digest.hexdigest())


def _found(folder: Path, manifest: BundleManifest, name: str) -> Path:
    """Where a file of a bundle is."""
    return weights_file(manifest.name, name, manifest.files.get(name), manifest.source, [folder])


def _read(path: Path) -> bytes:
    try:
        if (size := path.stat().st_size) > _MOST_BYTES:
            raise UsageError(f"{path}: holds {size} bytes; at most {_MOST_BYTES} are read")
        return path.read_bytes()
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {error.strerror}") from error


def _check(path: Path, data: bytes, manifest: BundleManifest) -> None:
    """Raises UsageError for a file that is another than its manifest says."""
    said = manifest.files.get(path.name)
    if said is None:
        return
    found = file_facts(data)
    told = {name: one for name, one in {"bytes": said.bytes, **said.hashes}.items() if one != ""}
    if off := [name for name, one in told.items() if one != getattr(found, name)]:
        what = off[0]
        raise UsageError(
            f"{path}: is another file than the manifest of '{manifest.name}' says: files.{path.name}.{what} is "
            f"{getattr(said, what)} there, {getattr(found, what)} found"
        )
