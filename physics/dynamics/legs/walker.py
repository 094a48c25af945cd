"""Convert the published network of the humanoid to plain arrays.

    python -m physics.dynamics.legs.walker motion.pt [-o FOLDER]

It needs no PyTorch. The network is an LSTM of 64 cells and a layer of 32 units, by Unitree.
"""

from __future__ import annotations

import io
import sys
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cosim.core.network import Dense, Lstm, Network
from cosim.policies.onnx.converting import Converter, PublishedArrays
from cosim.policies.onnx.manifest import FileFacts
from cosim.policies.onnx.torch_file import read_torch_file
from cosim.policies.onnx.weights import NetworkFile
from cosim.spec.robot import WALKER
from physics.dynamics.legs.gait_manifest import read_gait_manifest
from physics.robots import gait_path

_INPUTS: Final = 47
_CELLS: Final = 64
_UNITS: Final = 32
_JOINTS: Final = 12


def walker_network(arrays: Mapping[str, NDArray[Any]]) -> Network:
    """Return the network of the published arrays. Raises ValueError for others."""
    published = PublishedArrays(arrays)
    gates = 4 * _CELLS
    given = published.take("memory.weight_ih_l0", (gates, _INPUTS))
    own = published.take("memory.weight_hh_l0", (gates, _CELLS))
    bias = published.take("memory.bias_ih_l0", (gates,)) + published.take(
        "memory.bias_hh_l0", (gates,)
    )
    layers: list[Lstm | Dense] = [
        Lstm(np.ascontiguousarray(np.concatenate([given, own], axis=1).T), bias)
    ]
    for number, shape in ((0, (_UNITS, _CELLS)), (2, (_JOINTS, _UNITS))):
        weight = np.ascontiguousarray(published.take(f"actor.{number}.weight", shape).T)
        bias = published.take(f"actor.{number}.bias", shape[:1])
        layers.append(Dense(weight, bias, "elu" if number == 0 else "linear"))
    published.check_all_used(lambda name: name.endswith("_state"))
    return Network(tuple(layers))


def walker_file(data: bytes) -> bytes:
    """Return the .npz of the network of a published file."""
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, **walker_network(read_torch_file(data)).arrays())
    return file.getvalue()


def _arrays_of_gait() -> NetworkFile:
    manifest = read_gait_manifest(gait_path(WALKER))
    return NetworkFile(manifest.model, manifest.source, manifest.files.get(manifest.model))


WALKER_NETWORK: Final = Converter(
    "physics.dynamics.legs.walker",
    NetworkFile(
        "motion.pt",
        "https://github.com/unitreerobotics/unitree_rl_gym/raw/"
        "276801e46c5d433564f24658bac64f254b7d2d4b/deploy/pre_train/g1/motion.pt (BSD-3-Clause)",
        FileFacts(
            bytes=145745,
            blake2b="30e7ee957aeff4191286b3c9d1a3452608b9492d8fb7c59609bef8a9b77a1d49",
            sha256="cf668f75b90d1abf73d2b87612a6e76bccc61ff7e083b63582d3f6aaa3c1759d",
        ),
    ),
    walker_file,
    _arrays_of_gait,
    "this numpy writes it otherwise than versions 2.0 to 2.4",
)
"""Command that makes `walker.npz` of the published file."""

if __name__ == "__main__":
    WALKER_NETWORK.command(sys.argv[1:])
