"""The published networks of `follow` and `cosim bench realism`, if they are available."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from cosim.policies.follow.espnetv2 import read_torch_file, street_graph
from cosim.policies.follow.networks import ESPNET_GRAPH, ESPNET_WEIGHTS, YOLOX_NANO
from cosim.policies.onnx.weights import NetworkFile

WEIGHTS = Path(os.environ.get("COSIM_WEIGHTS") or Path(__file__).parents[3] / "shared" / "weights")


def make_weights(folder: Path, *more: NetworkFile) -> Path:
    """Fill a folder with the graphs of `follow` and more; skip the test without them."""
    linked = (YOLOX_NANO, *more)
    if missing := [
        one.name for one in (ESPNET_WEIGHTS, *linked) if not (WEIGHTS / one.name).is_file()
    ]:
        pytest.skip(
            f"the published weights {', '.join(missing)} are not in {WEIGHTS} (COSIM_WEIGHTS)"
        )
    for one in linked:
        (folder / one.name).symlink_to(WEIGHTS / one.name)
    (folder / ESPNET_GRAPH.name).write_bytes(
        street_graph(read_torch_file((WEIGHTS / ESPNET_WEIGHTS.name).read_bytes()))
    )
    return folder
