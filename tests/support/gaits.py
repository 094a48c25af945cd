"""Gaits as files: manifests and graphs of small random networks."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from onnx import helper

from cosim.spec.robot import DOG, Legs
from tests.support.graphs import graph_bytes, port

assert isinstance(DOG.drive, Legs)
JOINTS = {
    name: {"rest_rad": rest, "kp": 174, "kd": 2, "scale": 0.05}
    for name, rest in zip(DOG.drive.joints, DOG.drive.rest_rad, strict=True)
}
OBSERVATION = [
    {"what": "angular_velocity", "scale": 0.25},
    {"what": "gravity"},
    {"what": "command", "scales": [2.0, 2.0, 0.25]},
    {"what": "joint_angles"},
    {"what": "joint_speeds", "scale": 0.05},
    {"what": "actions"},
]
MANIFEST: dict[str, Any] = {
    "format": 1,
    "name": "tiny",
    "robot": "dog",
    "model": "tiny.onnx",
    "rate_hz": 50,
    "joints": JOINTS,
    "observation": OBSERVATION,
}
"""Of a dog that hardly moves its joints."""


def layers_graph(seed: int = 0, sizes: tuple[int, ...] = (45, 16, 12), scale: float = 0.1) -> bytes:
    """Layers with ELU between them."""
    rng = np.random.default_rng(seed)
    nodes, weights, name = [], {}, "obs"
    for k, (given, told) in enumerate(zip(sizes, sizes[1:], strict=False)):
        last = k == len(sizes) - 2
        weights[f"w{k}"] = (scale * rng.normal(size=(told, given))).astype(np.float32)
        weights[f"b{k}"] = (scale * rng.normal(size=told)).astype(np.float32)
        out = "actions" if last else f"x{k}"
        nodes.append(helper.make_node("Gemm", [name, f"w{k}", f"b{k}"], [out], transB=1))
        name = out
        if not last:
            nodes.append(helper.make_node("Elu", [out], [f"y{k}"]))
            name = f"y{k}"
    ends = [port("obs", 1, sizes[0])], [port("actions", 1, sizes[-1])]
    return graph_bytes(nodes, *ends, weights)


def written_gait(folder: Path, graph: bytes | None = None, **changes: Any) -> Path:
    """The graph's file, with its manifest beside it."""
    path = folder / "tiny.onnx"
    path.write_bytes(layers_graph() if graph is None else graph)
    path.with_suffix(".json").write_text(json.dumps(MANIFEST | changes))
    return path
