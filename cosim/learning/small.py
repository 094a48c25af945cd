"""Row of the network `small`: four pictures at once, without a memory."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cosim.learning.examples import Batch, Examples
from cosim.learning.graph import INPUTS, PLAN, build_graph
from cosim.learning.kind import GOAL_INPUT, SPEEDS_INPUT, Arrays, Network, pictures_input
from cosim.learning.network import (
    HEIGHT_PX,
    HISTORY,
    PICTURE_INTERVAL,
    WIDTH_PX,
    Parameters,
    forward,
    new_parameters,
)
from cosim.learning.network import plan as planned
from cosim.learning.objective import PLAN_WEIGHTS, PlanErrors, plan_losses
from cosim.learning.settings import Training

_MAX_HELD_OUT: Final = 4096


def _examples(paths: Sequence[Path], training: Training, device: torch.device) -> Examples:
    return Examples(paths, training.seed, device)


def _losses(parameters: Parameters, batch: Batch, training: Training) -> dict[str, Tensor]:
    return plan_losses(forward(parameters, batch.pictures, batch.goal, batch.speeds), batch)


def _errors(parameters: Parameters, examples: Examples, training: Training) -> dict[str, float]:
    """Return errors on the held-out episodes, see `PlanErrors.means`."""
    rows = examples.held_out
    rows = rows[:: max(1, -(-len(rows) // _MAX_HELD_OUT))]
    found = PlanErrors()
    with torch.no_grad():
        for part in np.array_split(rows, max(1, len(rows) // 512)):
            batch = examples.rows(part)
            output = forward(parameters, batch.pictures, batch.goal, batch.speeds)
            parts = plan_losses(output, batch)
            loss = sum(PLAN_WEIGHTS[name] * float(value) for name, value in parts.items())
            found.add(output, batch, loss)
    return found.means()


def _graph(parameters: Parameters, training: Training) -> bytes:
    return build_graph(parameters)


def _answers(
    parameters: Parameters, inputs: Arrays, training: Training
) -> dict[str, NDArray[np.float32]]:
    tensors = (torch.from_numpy(inputs[name]) for name in INPUTS)
    return {PLAN: planned(forward(parameters, *tensors)).numpy()}


SMALL: Final = Network(
    examples=_examples,
    new_parameters=new_parameters,
    losses=_losses,
    weights=PLAN_WEIGHTS,
    errors=_errors,
    graph=_graph,
    answers=_answers,
    inputs={
        "pictures": pictures_input(HISTORY, PICTURE_INTERVAL, (WIDTH_PX, HEIGHT_PX)),
        "goal": GOAL_INPUT,
        "speeds": SPEEDS_INPUT,
    },
)
