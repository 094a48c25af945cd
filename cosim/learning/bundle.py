"""Bundle of a trained network for `--policy onnx:FOLDER`: `model.onnx`, `manifest.json`,
`example.npz`."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import torch

from cosim.core.errors import RunError
from cosim.core.files import write_atomic
from cosim.learning.graph import MODEL, PLAN, run_graph
from cosim.learning.kind import ExampleSet
from cosim.learning.network import Parameters
from cosim.learning.networks import NETWORKS
from cosim.learning.settings import Training

_TOLERANCE: Final = 1e-4


class BundleFacts(NamedTuple):
    """Name of a bundle and hash of its graph."""

    name: str
    digest: str


def bundle_facts(folder: Path) -> BundleFacts:
    """Read the facts of a bundle. Raises RunError if it cannot be read."""
    path = folder / MODEL
    try:
        digest = hashlib.blake2b(path.read_bytes(), digest_size=8).hexdigest()
        path = folder / "manifest.json"
        return BundleFacts(str(json.loads(path.read_bytes())["name"]), digest)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise RunError(
            f"{path}: cannot be read: {getattr(error, 'strerror', None) or error!r}"
        ) from error


def write_bundle(
    folder: Path, parameters: Parameters, examples: ExampleSet, training: Training, source: str
) -> None:
    """Write a bundle with the first held-out example.

    source: description of the training data

    Raises RunError if the graph and the network give different or non-finite answers.
    """
    network = NETWORKS[training.network]
    graph = network.graph(parameters, training)
    inputs = examples.first_inputs()
    on_cpu = {key: value.cpu() for key, value in parameters.items()}
    with torch.no_grad():
        expected = network.answers(on_cpu, inputs, training)
    answers = run_graph(graph, inputs, list(expected))
    error = max(float(np.abs(answers[name] - expected[name]).max()) for name in expected)
    if not error <= _TOLERANCE:
        raise RunError(
            f"{folder}: the graph answers {error:g} otherwise than the network: train again, at "
            f"a lower --rate"
        )
    example = io.BytesIO()
    arrays: dict[str, Any] = {f"expected.{name}": value for name, value in expected.items()}
    np.savez_compressed(example, **arrays, **dict[str, Any](inputs))
    manifest = manifest_of(training.called, examples.meta, source, network.inputs)
    manifest["files"] = {MODEL: _facts(graph)}
    write_atomic(folder / MODEL, graph)
    write_atomic(folder / "example.npz", example.getvalue())
    write_atomic(folder / "manifest.json", (json.dumps(manifest, indent=2) + "\n").encode())


def _facts(data: bytes) -> dict[str, Any]:
    """Return size and hash of a file, as in manifests."""
    return {"bytes": len(data), "blake2b": hashlib.blake2b(data, digest_size=32).hexdigest()}


def source_of(meta: Mapping[str, Any], seed: int, begun: BundleFacts | None = None) -> str:
    """Describe the training data by the metadata of the demonstrations."""
    experts, learners = (
        ", ".join(dict.fromkeys(filter(None, meta[name]))) for name in ("policy", "learner")
    )
    explorers = ", ".join(dict.fromkeys(filter(None, meta.get("explorer", ()))))
    corrections = f", and would have done where {learners} drove" if learners else ""
    parts = [
        *([f"on what {experts} drove{corrections}"] if experts else []),
        *([f"on what {explorers} drove with rewards"] if explorers else []),
    ]
    weighting = f"; {meta['weighting']}" if "weighting" in meta else ""
    return f"cosim train, seed {seed}, {' and '.join(parts)}{weighting}" + (
        f"; begun with {begun.name}" if begun else ""
    )


def manifest_of(
    name: str, meta: Mapping[str, Any], source: str, inputs: Mapping[str, Mapping[str, Any]]
) -> dict[str, Any]:
    """Return the manifest of a graph, from the metadata of the demonstrations."""
    camera = {
        field: meta["camera"].get(field)
        for field in ("width", "height", "fov_deg", "mount", "crop")
    }
    return {
        "format": 1,
        "name": name,
        "version": "1",
        "licence": "Apache-2.0",
        "source": source,
        "rate_hz": meta["rate_hz"],
        "goal": meta["goal"],
        "camera": camera,
        "inputs": {name: dict(one) for name, one in inputs.items()},
        "output": {
            "what": "waypoints",
            "name": PLAN,
            "columns": ["x", "y", "speed", "turn"],
            "follow": "speeds",
            "index": 0,
            "dt_s": meta["waypoint_s"],
        },
    }
