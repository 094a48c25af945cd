"""Row of the network `sidewalk`: two pictures at once and a memory, with auxiliary heads."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from cosim.core.errors import RunError
from cosim.learning.graph import MODEL, PLAN, load_parameters
from cosim.learning.kind import GOAL_INPUT, SPEEDS_INPUT, Arrays, Network, pictures_input
from cosim.learning.memory_graph import MEMORY_INPUTS, NEXT, build_memory_graph
from cosim.learning.memory_network import (
    AUXILIARY,
    GROWN,
    MEMORY,
    NEAR,
    PICTURES,
    SIZE_PX,
    MemoryOutput,
    forward_steps,
    new_memory_parameters,
    views,
)
from cosim.learning.network import NetworkOutput, Parameters, plan
from cosim.learning.objective import PLAN_WEIGHTS, PlanErrors, mean, plan_losses
from cosim.learning.settings import Training
from cosim.learning.values import weights_of
from cosim.learning.windows import STEPS, WindowExamples, Windows

NEAR_UNIT_M: Final = 10.0
"""Unit of the predicted places of people."""
NEAR_UNIT_MPS: Final = 1.5
"""Unit of the predicted velocities of people."""
FREE_UNIT_M: Final = 10.0
"""Unit of the predicted free distances."""
_ADDED_M: Final = 1.0
"""Distance added to the true one, so that a relative error stays finite at 0 m."""
HAND: Final = 6
"""Label of the activity of a person who holds out a hand, see `scenarios/episodes/labels.py`."""
_WEIGHTS: Final = {
    **PLAN_WEIGHTS,
    "near": 0.5,
    "free": 2.0,
    "signal": 0.2,
    "event": 0.2,
    "doing": 0.5,
}
_MAX_WINDOWS: Final = 96
"""Largest number of held-out windows of an evaluation."""
_AT_ONCE: Final = 16
_MIN_REWARDED: Final = 50
"""Least number of training rows with rewards."""


def _run(parameters: Parameters, batch: Windows, training: Training) -> MemoryOutput:
    """Return the outputs at the valid steps of windows."""
    memory = torch.zeros((len(batch.goal), MEMORY), device=batch.goal.device)
    on_gpu = batch.goal.device.type == "cuda"
    with torch.autocast("cuda", dtype=torch.bfloat16, enabled=on_gpu):
        output = forward_steps(
            parameters, batch.seen, batch.goal, batch.speeds, memory, training.memory
        )
    valid = batch.places
    return MemoryOutput(
        NetworkOutput(*(one[valid] for one in output.plan)),
        near=output.near[valid],
        free=output.free[valid],
        signal=output.signal[valid],
        event=output.event[valid],
        doing=output.doing[valid],
        memory=output.memory,
        known=output.known[valid],
    )


def _losses(parameters: Parameters, batch: Windows, training: Training) -> dict[str, Tensor]:
    output = _run(parameters, batch, training)
    return _parts(output, batch, training)


def _parts(output: MemoryOutput, batch: Windows, training: Training) -> dict[str, Tensor]:
    """Return the parts of the loss; those of auxiliary heads if they are trained."""
    parts = plan_losses(output.plan, batch, batch.weight)
    if not training.auxiliary:
        return parts
    classes = batch.scene.long()
    return parts | {
        "near": near_loss(output.near, batch.near),
        "free": free_loss(output.free, batch.free),
        "signal": functional.cross_entropy(output.signal, classes[:, 0]),
        "event": functional.cross_entropy(output.event, classes[:, 1]),
        "doing": doing_loss(output.doing, batch.near),
    }


def free_loss(free: Tensor, labels: Tensor) -> Tensor:
    """Return the loss of free distances. An error counts relative to the distance plus a metre.

    So what is near counts most: it is in few rows, and an error of a metre is small far away.
    Rows outside of the free ground, with labels of 0, count like all others.

    free: (N, FREE_RAYS) predicted
    labels: (N, FREE_RAYS) of `cosim collect --labels`
    """
    true = (labels / FREE_UNIT_M).clamp(max=1.0)
    off = (free - true) / (true + _ADDED_M / FREE_UNIT_M)
    return functional.smooth_l1_loss(off, torch.zeros_like(off), beta=0.1)


def near_loss(near: Tensor, labels: Tensor) -> Tensor:
    """Return the loss of the nearest people.

    near: (N, NEAR, NEAR_VALUES) predicted
    labels: (N, LABELLED_PEOPLE, 6) of `cosim collect --labels`
    """
    labels = labels[:, :NEAR]
    present = labels[:, :, 0]
    hand = (labels[:, :, 5] == HAND).float()
    units = torch.tensor(
        [NEAR_UNIT_M] * 2 + [NEAR_UNIT_MPS] * 2, dtype=near.dtype, device=near.device
    )
    off = functional.smooth_l1_loss(
        near[:, :, 2:], labels[:, :, 1:5] / units, reduction="none", beta=0.1
    ).sum(2)
    shown = functional.binary_cross_entropy_with_logits(near[:, :, 1], hand, reduction="none")
    seen = functional.binary_cross_entropy_with_logits(near[:, :, 0], present)
    return seen + _over_people(off + shown, present)


def doing_loss(doing: Tensor, labels: Tensor) -> Tensor:
    """Return the loss of the activities of the nearest people; 0 without people.

    doing: (N, NEAR, DOINGS) log odds
    labels: (N, LABELLED_PEOPLE, 6) of `cosim collect --labels`
    """
    labels = labels[:, :NEAR]
    present = labels[:, :, 0]
    numbers = (labels[:, :, 5].long() - 1).clamp(min=0)
    off = functional.cross_entropy(doing.transpose(1, 2), numbers, reduction="none")
    return _over_people(off, present)


def _over_people(losses: Tensor, present: Tensor) -> Tensor:
    """Return the mean of losses (N, NEAR) over the people that are present; 0 without any."""
    return (losses * present).sum() / present.sum().clamp(min=1.0)


def _errors(
    parameters: Parameters, examples: WindowExamples, training: Training
) -> dict[str, float]:
    """Return errors on held-out windows: of the plan, and of auxiliary heads if they are trained.

    These are the mean errors of the place of the nearest person and of free distances, and the
    shares of right activities of that person, of right signals, and of right events, where there
    are such.
    """
    found, labels = PlanErrors(), _LabelErrors()
    starts = examples.held_out_starts(_MAX_WINDOWS)
    with torch.no_grad():
        for part in np.array_split(starts, -(-len(starts) // _AT_ONCE)):
            batch = examples.windows(part, STEPS)
            output = _run(parameters, batch, training)
            parts = _parts(output, batch, training)
            loss = sum(_WEIGHTS[name] * float(value) for name, value in parts.items())
            found.add(output.plan, batch, loss)
            if training.auxiliary:
                labels.add(output, batch)
    return found.means() | (labels.means() if training.auxiliary else {})


class _LabelErrors:
    """Sums and counts of the errors of auxiliary heads."""

    def __init__(self) -> None:
        names = ("near_error_m", "doings_right", "free_error_m", *_CLASSES)
        self._sums = dict.fromkeys(names, (0.0, 0))

    def add(self, output: MemoryOutput, batch: Windows) -> None:
        there = batch.near[:, 0, 0] > 0.0
        off = output.near[:, 0, 2:4] * NEAR_UNIT_M - batch.near[:, 0, 1:3]
        self._add("near_error_m", off[there].norm(dim=1))
        right = output.doing[:, 0].argmax(1) + 1 == batch.near[:, 0, 5].long()
        self._add("doings_right", right[there].float())
        free = (output.free * FREE_UNIT_M).clamp(0.0, FREE_UNIT_M)
        self._add("free_error_m", (free - batch.free).abs().mean(1))
        for name, odds, label in zip(
            _CLASSES, (output.signal, output.event), batch.scene.long().unbind(1), strict=True
        ):
            self._add(name, (odds.argmax(1) == label)[label > 0].float())

    def _add(self, name: str, values: Tensor) -> None:
        total, count = self._sums[name]
        self._sums[name] = total + float(values.sum()), count + len(values)

    def means(self) -> dict[str, float]:
        return {name: mean(*sums) for name, sums in self._sums.items()}


_CLASSES: Final = ("signals_right", "events_right")


def _examples(paths: Sequence[Path], training: Training, device: torch.device) -> WindowExamples:
    examples = WindowExamples(paths, training, device)
    if training.values and training.begin:
        begin = load_parameters(training.begin / MODEL, new_memory_parameters(0), GROWN)
        parameters = {name: value.to(device) for name, value in begin.items()}
        _weigh(parameters, examples, training, paths[0])
    return examples


def _weigh(
    parameters: Parameters, examples: WindowExamples, training: Training, path: Path
) -> None:
    """Weigh the rows with rewards by the values of the network that drove.

    Raises RunError without such rows.
    """
    starts = examples.rewarded_starts()
    rows = np.flatnonzero(np.isfinite(examples.returns))
    learned = np.isin(rows, examples.learned)
    if learned.sum() < _MIN_REWARDED:
        raise RunError(
            f"{path}: {learned.sum()} training rows have rewards, at least {_MIN_REWARDED} are "
            f"needed for --values: collect with cosim collect --explore"
        )
    features = []
    with torch.no_grad():
        for part in np.array_split(starts, -(-len(starts) // _AT_ONCE)):
            known = _run(parameters, examples.windows(part, STEPS), training).known
            features.append(known.float().cpu().numpy())
    found = weights_of(
        np.concatenate(features),
        examples.returns[rows],
        examples.episode[rows],
        learned,
        training.values,
    )
    examples.weight[torch.from_numpy(rows[learned])] = torch.from_numpy(found.weight[learned]).to(
        examples.weight.device
    )
    examples.meta["weighting"] = found.in_words


def _graph(parameters: Parameters, training: Training) -> bytes:
    return build_memory_graph(parameters, training.memory)


def _answers(
    parameters: Parameters, inputs: Arrays, training: Training
) -> dict[str, NDArray[np.float32]]:
    """Return the outputs of one step."""
    pictures, goal, speeds, memory = (torch.from_numpy(inputs[name]) for name in MEMORY_INPUTS)
    seen = views(pictures).each(lambda one: one[:, None])
    output = forward_steps(
        parameters, seen, goal[:, None], speeds[:, None], memory, training.memory
    )
    labels = {name: getattr(output, name).numpy() for name in AUXILIARY}
    return {PLAN: plan(output.plan).numpy(), NEXT: output.memory.numpy(), **labels}


SIDEWALK: Final = Network(
    examples=_examples,
    new_parameters=new_memory_parameters,
    losses=_losses,
    weights=_WEIGHTS,
    errors=_errors,
    graph=_graph,
    grown=GROWN,
    answers=_answers,
    inputs={
        "pictures": pictures_input(PICTURES, 1, SIZE_PX),
        "goal": GOAL_INPUT,
        "speeds": SPEEDS_INPUT,
        "memory": {"what": "state", "output": NEXT},
    },
)
