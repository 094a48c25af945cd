"""Bundle of a trained network for `--policy onnx:FOLDER`: `model.onnx`, `manifest.json`,
`example.npz`."""

from __future__ import annotations

import hashlib
import io
import json
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import torch

from cosim.core.errors import RunError
from cosim.core.files import write_atomic
from cosim.learning.examples import Examples
from cosim.learning.graph import INPUTS, PLAN, build_graph, run_graph
from cosim.learning.network import (
    GOAL_MOST_M,
    GOAL_UNIT_M,
    HEIGHT_PX,
    HISTORY,
    PICTURE_INTERVAL,
    SPEED_MEAN_MPS,
    SPEED_UNIT_MPS,
    TURN_UNIT_RADPS,
    WIDTH_PX,
    Parameters,
    forward,
    plan,
)

MODEL: Final = "model.onnx"
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
    folder: Path, parameters: Parameters, examples: Examples, name: str, source: str
) -> None:
    """Write a bundle with the first held-out example.

    source: description of the training data

    Raises RunError if the graph and the network give different or non-finite plans.
    """
    graph = build_graph(parameters)
    batch = examples.rows(examples.held_out[:1])
    inputs = {key: getattr(batch, key).cpu().numpy().astype(np.float32) for key in INPUTS}
    on_cpu = {key: value.cpu() for key, value in parameters.items()}
    with torch.no_grad():
        expected = plan(forward(on_cpu, *(torch.from_numpy(inputs[key]) for key in INPUTS))).numpy()
    error = float(np.abs(run_graph(graph, inputs) - expected).max())
    if not error <= _TOLERANCE:
        raise RunError(
            f"{folder}: the graph answers {error:g} otherwise than the network: train anew, at "
            f"a lower --rate"
        )
    example = io.BytesIO()
    np.savez_compressed(example, **{**inputs, f"expected.{PLAN}": expected})
    manifest = {**manifest_of(name, examples.meta, source), "files": {MODEL: _facts(graph)}}
    write_atomic(folder / MODEL, graph)
    write_atomic(folder / "example.npz", example.getvalue())
    write_atomic(folder / "manifest.json", (json.dumps(manifest, indent=2) + "\n").encode())


def _facts(data: bytes) -> dict[str, Any]:
    """Return size and hash of a file, as in manifests."""
    return {"bytes": len(data), "blake2b": hashlib.blake2b(data, digest_size=32).hexdigest()}


def source_of(meta: dict[str, Any], seed: int, begun: BundleFacts | None = None) -> str:
    """Describe the training data by the metadata of the demonstrations."""
    experts, learners = (
        ", ".join(dict.fromkeys(filter(None, meta[name]))) for name in ("policy", "learner")
    )
    corrections = f", and would have done where {learners} drove" if learners else ""
    return f"cosim train, seed {seed}, on what {experts} drove{corrections}" + (
        f"; begun with {begun.name}" if begun else ""
    )


def manifest_of(name: str, meta: dict[str, Any], source: str) -> dict[str, Any]:
    """Return the manifest of the graph, from the metadata of the demonstrations."""
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
        "inputs": {
            "pictures": {
                "what": "picture",
                "frames": HISTORY,
                "every": PICTURE_INTERVAL,
                "size": [WIDTH_PX, HEIGHT_PX],
                "layout": "N(TC)HW",
            },
            "goal": {
                "what": "goal_point",
                "values": ["x", "y"],
                "unit_m": GOAL_UNIT_M,
                "most_m": GOAL_MOST_M,
            },
            "speeds": {
                "what": "speeds",
                "values": ["v", "w"],
                "mean": [SPEED_MEAN_MPS, 0.0],
                "std": [SPEED_UNIT_MPS, TURN_UNIT_RADPS],
            },
        },
        "output": {
            "what": "waypoints",
            "name": PLAN,
            "columns": ["x", "y", "speed", "turn"],
            "follow": "speeds",
            "index": 0,
            "dt_s": meta["waypoint_s"],
        },
    }
