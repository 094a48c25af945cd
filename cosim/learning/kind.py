"""Kind of network that `cosim train` trains: what differs between the networks."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cosim.learning.network import (
    GOAL_MOST_M,
    GOAL_UNIT_M,
    SPEED_MEAN_MPS,
    SPEED_UNIT_MPS,
    TURN_UNIT_RADPS,
    Parameters,
)
from cosim.learning.settings import Training

Arrays = Mapping[str, NDArray[np.float32]]


class ExampleSet(Protocol):
    """Demonstrations on the device. meta: common metadata of their files."""

    meta: dict[str, Any]

    def drawn(self, seed: int, step: int, size: int) -> Any:
        """Draw the augmented batch of a step: a function of seed and step."""

    def first_inputs(self) -> Arrays:
        """Return the inputs of the graph at the first held-out example."""


@dataclass(frozen=True)
class Network:
    """Row of a network.

    examples: loads the demonstrations. Raises RunError.
    new_parameters: draws them from a seed.
    losses: parts of the loss of a batch, by name.
    weights: factor of each part.
    errors: errors on the held-out episodes, by name.
    graph: ONNX graph of the parameters.
    answers: outputs of the network for inputs of the graph, by name.
    inputs: inputs of a bundle's manifest.
    grown: layers that earlier bundles lack, and that begin at 0 from them.
    """

    examples: Callable[[Sequence[Path], Training, torch.device], Any]
    new_parameters: Callable[[int], dict[str, Tensor]]
    losses: Callable[[Parameters, Any, Training], dict[str, Tensor]]
    weights: Mapping[str, float]
    errors: Callable[[Parameters, Any, Training], dict[str, float]]
    graph: Callable[[Parameters, Training], bytes]
    answers: Callable[[Parameters, Arrays, Training], dict[str, NDArray[np.float32]]]
    inputs: Mapping[str, Any]
    grown: Sequence[str] = ()


GOAL_INPUT: Final[Mapping[str, Any]] = MappingProxyType(
    {
        "what": "goal_point",
        "values": ["x", "y"],
        "unit_m": GOAL_UNIT_M,
        "most_m": GOAL_MOST_M,
    }
)
SPEEDS_INPUT: Final[Mapping[str, Any]] = MappingProxyType(
    {
        "what": "speeds",
        "values": ["v", "w"],
        "mean": [SPEED_MEAN_MPS, 0.0],
        "std": [SPEED_UNIT_MPS, TURN_UNIT_RADPS],
    }
)


def pictures_input(frames: int, every: int, size_px: tuple[int, int]) -> dict[str, Any]:
    """Return the manifest's input of the last pictures, the newest last.

    size_px: width and height
    """
    return {
        "what": "picture",
        "frames": frames,
        "every": every,
        "size": [*size_px],
        "layout": "N(TC)HW",
    }
