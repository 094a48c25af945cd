"""The published networks of `follow`, where they are at hand."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from cosim.policies.follow.espnetv2 import read_torch_file, street_graph
from cosim.policies.follow.networks import ESPNET_GRAPH, ESPNET_WEIGHTS, YOLOX_NANO

WEIGHTS = Path(os.environ.get("COSIM_WEIGHTS") or Path(__file__).parents[3] / "shared" / "weights")


def make_weights(folder: Path) -> Path:
    """Fill a folder with both graphs, one of them made anew; the test is skipped without them."""
    if missing := [
        one.name for one in (ESPNET_WEIGHTS, YOLOX_NANO) if not (WEIGHTS / one.name).is_file()
    ]:
        pytest.skip(
            f"the published weights {', '.join(missing)} are not in {WEIGHTS} (COSIM_WEIGHTS)"
        )
    (folder / YOLOX_NANO.name).symlink_to(WEIGHTS / YOLOX_NANO.name)
    (folder / ESPNET_GRAPH.name).write_bytes(
        street_graph(read_torch_file((WEIGHTS / ESPNET_WEIGHTS.name).read_bytes()))
    )
    return folder
