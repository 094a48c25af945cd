"""Which kind of bundle lies in a place: ours, with a manifest, or an export of visnavkit."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from cosim.core.errors import UsageError
from cosim.policies.onnx.manifest import EXAMPLE_FILE, MANIFEST_FILE, BundleManifest, read_bundle_manifest
from cosim.policies.onnx.visnavkit import EXAMPLE, METADATA, exports_in, manifest_of_export


@dataclass(frozen=True)
class FoundBundle:
    """A bundle: its folder, its manifest, and where an example of it would be."""

    folder: Path
    manifest: BundleManifest
    example: Path


def read_bundle(place: Path) -> FoundBundle:
    """The bundle in a folder; or visnavkit's export, in a folder or as the path of its graph. Raises UsageError where
    there is none, or several; SpecError for a manifest with faults."""
    if (place / MANIFEST_FILE).exists():
        return FoundBundle(place, read_bundle_manifest(place), place / EXAMPLE_FILE)
    if place.is_file() and (place.parent / MANIFEST_FILE).exists():
        raise UsageError(f"{place}: is a file of the bundle {place.parent}: name that")
    exports = [place] if place.is_file() else exports_in(place)
    if len(exports) > 1:
        raise UsageError(f"{place}: has several bundles: name one of {', '.join(map(str, exports))}")
    if not exports:
        raise UsageError(f"{place}: no bundle: has no {MANIFEST_FILE}, and no graph with a {METADATA} beside it")
    return FoundBundle(exports[0].parent, manifest_of_export(exports[0]), exports[0].with_suffix(EXAMPLE))
