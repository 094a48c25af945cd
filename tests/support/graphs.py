"""Small ONNX graphs, and bundles of them, as files."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import NodeProto, TensorProto, ValueInfoProto, helper, numpy_helper

PICTURE: Mapping[str, Any] = {"what": "picture", "frames": 2, "size": [8, 4], "layout": "N(TC)HW"}
POINT: Mapping[str, Any] = {"what": "goal_point", "unit_m": 10}
MANIFEST: Mapping[str, Any] = {
    "format": 1,
    "name": "tiny",
    "goal": "route_point",
    "camera": {"width": 32, "height": 32},
    "inputs": {"obs": PICTURE, "goal": POINT},
    "output": {"what": "waypoints", "name": "action", "index": 2},
}
"""Manifest of the graph `tiny_graph`."""


def port(name: str, *shape: int | str, kind: int = TensorProto.FLOAT) -> ValueInfoProto:
    """Return an input or an output; a text stands for an axis of any length."""
    return helper.make_tensor_value_info(name, kind, shape)


def graph_bytes(
    nodes: Sequence[NodeProto],
    inputs: Sequence[ValueInfoProto],
    outputs: Sequence[ValueInfoProto],
    weights: Mapping[str, np.ndarray[Any, Any]] | None = None,
    opset: int = 17,
) -> bytes:
    """Return the bytes of a graph file."""
    tensors = [numpy_helper.from_array(array, name) for name, array in (weights or {}).items()]
    graph = helper.make_graph(list(nodes), "graph", list(inputs), list(outputs), tensors)
    domains = {"": opset} | {node.domain: 1 for node in nodes if node.domain}
    opsets = [helper.make_opsetid(domain, version) for domain, version in domains.items()]
    model = helper.make_model(graph, opset_imports=opsets, ir_version=9)
    data: bytes = model.SerializeToString()
    return data


def tiny_graph(**weights: np.ndarray[Any, Any]) -> bytes:
    """Return a graph that makes five waypoints (b, 5, 2) of two frames (b, 6, 4, 8) and a point (b,
    2): the point, a fifth of the way each, and `bright` of all pixels."""
    share = np.outer(np.arange(1, 6) / 5, [1, 1]).astype(np.float32)
    held = {
        "bright": np.full((6 * 4 * 8, 1), 1e-3, np.float32),
        "share": share.reshape(1, 5, 2),
    } | weights
    nodes = [
        helper.make_node("Flatten", ["obs"], ["flat"]),
        helper.make_node("MatMul", ["flat", "bright"], ["light"]),
        helper.make_node("Add", ["goal", "light"], ["aim"]),
        helper.make_node(
            "Constant", [], ["shape"], value=numpy_helper.from_array(np.array([-1, 1, 2]))
        ),
        helper.make_node("Reshape", ["aim", "shape"], ["row"]),
        helper.make_node("Mul", ["row", "share"], ["action"]),
    ]
    return graph_bytes(
        nodes, [port("obs", "b", 6, 4, 8), port("goal", "b", 2)], [port("action", "b", 5, 2)], held
    )


def echo(*shape: int | str, kind: int = TensorProto.FLOAT, out: str = "action") -> bytes:
    """Return a graph whose output is its input `obs`."""
    return graph_bytes(
        [helper.make_node("Identity", ["obs"], [out])],
        [port("obs", *shape, kind=kind)],
        [port(out, *shape, kind=kind)],
    )


def bundle(
    folder: Path, graph: bytes, manifest: Mapping[str, Any] = MANIFEST, **fields: Any
) -> Path:
    """Write a bundle's folder; fields: values that replace those of the manifest."""
    folder.mkdir(exist_ok=True)
    (folder / "model.onnx").write_bytes(graph)
    (folder / "manifest.json").write_text(json.dumps({**manifest, **fields}))
    return folder


def external(folder: Path) -> Path:
    """Write a bundle whose weights are in a separate file."""
    bundle(folder, tiny_graph())
    model = onnx.load(folder / "model.onnx")
    onnx.save(
        model,
        folder / "model.onnx",
        save_as_external_data=True,
        location="model.onnx.data",
        size_threshold=0,
    )
    return folder
