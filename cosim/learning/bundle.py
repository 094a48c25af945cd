"""The bundle of a trained network: `model.onnx`, `manifest.json`, `example.npz`, as `--policy onnx:FOLDER` takes it."""

from __future__ import annotations

import hashlib
import io
import json
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from cosim.core.errors import RunError
from cosim.core.whole_file import write_whole
from cosim.learning.examples import Examples
from cosim.learning.graph import INPUTS, PLAN, graph_of, run_graph
from cosim.learning.network import (
    EVERY,
    GOAL_MOST_M,
    GOAL_UNIT_M,
    HEIGHT_PX,
    HISTORY,
    SPEED_MEAN_MPS,
    SPEED_UNIT_MPS,
    TURN_UNIT_RADPS,
    WIDTH_PX,
    Parameters,
    answers,
    plan,
)

MODEL: Final = "model.onnx"
_TOLERANCE: Final = 1e-4


def write_bundle(folder: Path, parameters: Parameters, examples: Examples, name: str, seed: int) -> None:
    """Write it, with the first held-out example. Raises RunError where the graph does not answer as the network does,
    or what it answers is no number."""
    graph = graph_of(parameters)
    batch = examples.rows(examples.held_out[:1])
    inputs = {key: getattr(batch, key).cpu().numpy().astype(np.float32) for key in INPUTS}
    held = {key: value.cpu() for key, value in parameters.items()}
    with torch.no_grad():
        wanted = plan(answers(held, *(torch.from_numpy(inputs[key]) for key in INPUTS))).numpy()
    off = float(np.abs(run_graph(graph, inputs) - wanted).max())
    if not off <= _TOLERANCE:
        raise RunError(f"{folder}: the graph answers {off:g} otherwise than the network: train anew, at a lower --rate")
    example = io.BytesIO()
    np.savez_compressed(example, **{**inputs, f"expected.{PLAN}": wanted})
    manifest = {**manifest_of(name, examples.meta, seed), "files": {MODEL: _facts(graph)}}
    write_whole(folder / MODEL, graph)
    write_whole(folder / "example.npz", example.getvalue())
    write_whole(folder / "manifest.json", (json.dumps(manifest, indent=2) + "\n").encode())


def _facts(data: bytes) -> dict[str, Any]:
    """Size and hash of a file, as manifests have them."""
    return {"bytes": len(data), "blake2b": hashlib.blake2b(data, digest_size=32).hexdigest()}


def manifest_of(name: str, meta: dict[str, Any], seed: int) -> dict[str, Any]:
    """What the graph wants and answers, by what the demonstrations say of themselves."""
    experts, learners = (", ".join(dict.fromkeys(filter(None, meta[name]))) for name in ("policy", "learner"))
    taught = f", and would have done where {learners} drove" if learners else ""
    camera = {field: meta["camera"].get(field) for field in ("width", "height", "fov_deg", "mount", "crop")}
    return {
        "format": 1,
        "name": name,
        "version": "1",
        "licence": "Apache-2.0",
        "source": f"cosim train, seed {seed}, on what {experts} drove{taught}",
        "rate_hz": meta["rate_hz"],
        "goal": meta["goal"],
        "camera": camera,
        "inputs": {
            "pictures": {
                "what": "picture",
                "frames": HISTORY,
                "every": EVERY,
                "size": [WIDTH_PX, HEIGHT_PX],
                "layout": "N(TC)HW",
            },
            "goal": {"what": "goal_point", "values": ["x", "y"], "unit_m": GOAL_UNIT_M, "most_m": GOAL_MOST_M},
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
