"""Policies by plain name that are ONNX bundles in folders below this one."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from cosim.core.errors import UsageError
from cosim.policies.onnx.manifest import MANIFEST_FILE, read_bundle_manifest
from cosim.policies.onnx.weights import weights_file


def shipped_bundles(below: Path = Path(__file__).parent) -> Mapping[str, Path]:
    """The folders of the ONNX bundles that ship with the project, by name: `cosim/policies/*/NAME/manifest.json`."""
    return {manifest.parent.name: manifest.parent for manifest in sorted(below.glob(f"*/*/{MANIFEST_FILE}"))}


def bundle_in_words(folder: Path) -> str:
    """Where the weights of a bundle lie, or that they are missing, and in short where they come from: a run that lacks
    them tells it whole."""
    bundle = read_bundle_manifest(folder)
    facts = bundle.files.get(bundle.model)
    try:
        found = f"weights {weights_file(bundle.name, bundle.model, facts, bundle.source, [folder])}"
    except UsageError:
        found = f"weights missing ({bundle.model})"
    origin = bundle.source.partition(",")[0].partition(";")[0]
    return f"ONNX bundle, {found}" + (f"; from {origin}" if origin else "")
