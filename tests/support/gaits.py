"""Gaits as files: manifests and graphs of small random networks."""

from __future__ import annotations

import json
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from onnx import helper

from cosim.policies.onnx.torch_file import read_torch_file
from cosim.spec.robot import DOG, Legs
from tests.support.documents import blocks
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
"""Manifest of a gait of the dog with small movements."""


def layers_graph(seed: int = 0, sizes: tuple[int, ...] = (45, 16, 12), scale: float = 0.1) -> bytes:
    """Return a graph of random layers with ELU between them."""
    rng = np.random.default_rng(seed)
    return graph_of_layers(
        [
            (
                (scale * rng.normal(size=(answered, given))).astype(np.float32),
                (scale * rng.normal(size=answered)).astype(np.float32),
            )
            for given, answered in pairwise(sizes)
        ]
    )


def graph_of_layers(layers: Sequence[tuple[NDArray[np.float32], NDArray[np.float32]]]) -> bytes:
    """Return a graph of layers with weights (outputs, inputs) and biases, with ELU between them."""
    nodes, weights, name = [], {}, "obs"
    for k, (weight, bias) in enumerate(layers):
        last = k == len(layers) - 1
        weights |= {f"w{k}": weight, f"b{k}": bias}
        out = "actions" if last else f"x{k}"
        nodes.append(helper.make_node("Gemm", [name, f"w{k}", f"b{k}"], [out], transB=1))
        name = out
        if not last:
            nodes.append(helper.make_node("Elu", [out], [f"y{k}"]))
            name = f"y{k}"
    ends = [port("obs", 1, layers[0][0].shape[1])], [port("actions", 1, layers[-1][1].size)]
    return graph_bytes(nodes, *ends, weights)


def robot_lab_gait(folder: Path, published: Path) -> Path:
    """Write the published network of a Go2 as a gait of the dog, with the manifest of the
    documents."""
    arrays = read_torch_file((published / "policy.pt").read_bytes())
    graph = graph_of_layers(
        [(arrays[f"actor.{k}.weight"], arrays[f"actor.{k}.bias"]) for k in (0, 2, 4, 6)]
    )
    (manifest,) = blocks("json", "docs/robots.md")
    path = folder / "walk.onnx"
    path.write_bytes(graph)
    path.with_suffix(".json").write_text(manifest.text)
    return path


def written_gait(folder: Path, graph: bytes | None = None, **changes: Any) -> Path:
    """Write a graph with its manifest beside it, and return the graph's path."""
    path = folder / "tiny.onnx"
    path.write_bytes(layers_graph() if graph is None else graph)
    path.with_suffix(".json").write_text(json.dumps(MANIFEST | changes))
    return path
