"""Training: behaviour cloning in steps, each a function of the seed, the data and the step before.

What it has learned is kept every minute in the folder (`checkpoint.pt`), so that a training that
was stopped continues where it was and ends as one in one piece would, on the same device. At its
end, and where its time is over, the bundle is written there.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from cosim.core.errors import RunError, UsageError, unwritable
from cosim.core.files import atomic_file
from cosim.core.packed_demos import packed_digest
from cosim.core.progress import Progress
from cosim.learning.bundle import MODEL, bundle_facts, source_of, write_bundle
from cosim.learning.curve import write_curve
from cosim.learning.examples import Batch, Examples
from cosim.learning.graph import parameters_of
from cosim.learning.network import (
    CRUISE_MPS,
    TURN_BINS,
    Parameters,
    answers,
    new_parameters,
    plan,
    turns_radps,
)
from cosim.learning.settings import (
    PLANNED_STEPS,
    Reached,
    Training,
    looks_after,
    planned_steps,
    rate_share,
    refuse_another,
    state_in_words,
)

CHECKPOINT: Final = "checkpoint.pt"
_KEPT_EVERY_S: Final = 60.0
_TIMED_STEPS: Final = (1, 4)
"""From the first of these steps to the second it is measured how long all of them take."""
_MOST_HELD_OUT: Final = 4096
_AVERAGED: Final = 0.999
"""What is shipped are the parameters' moving averages, of so much of the step before."""
_DECAY: Final = 0.01
_NARROW_RADPS: Final = 0.04
_WEIGHTS: Final = {"speed": 4.0, "turn": 1.0, "stop": 1.0, "way": 0.5}
"""Of the parts of the loss."""


@dataclass
class _State:
    """The state of a training. averaged: of the parameters; curve: a row for each look at the
    held-out episodes; plans: how many steps were planned in all, at first and whenever that was
    changed."""

    parameters: dict[str, Tensor]
    averaged: dict[str, Tensor]
    optimiser: torch.optim.AdamW
    step: int
    curve: list[dict[str, float]]
    plans: list[int]


def train(
    paths: Sequence[Path], folder: Path, training: Training, resume: bool, progress: Progress
) -> Reached:
    """Train on packed demonstrations, and write curve and bundle into a folder, also where time is
    over before the last step. resume: continue what is there, if anything is; a training that came
    to its end continues with more steps.

    Raises RunError for data that do not do, for a folder that holds a training that is not to be
    continued, or another one, and where nothing is learned any more; MachineError where the folder
    cannot be written.
    """
    try:
        return _train(paths, folder, training, resume, progress)
    except OSError as error:
        raise unwritable(folder, error) from error


def _train(
    paths: Sequence[Path], folder: Path, training: Training, resume: bool, progress: Progress
) -> Reached:
    device = _device(training.device)
    torch.manual_seed(training.seed)
    torch.backends.cudnn.deterministic = True
    torch.backends.cudnn.allow_tf32 = torch.backends.cuda.matmul.allow_tf32 = True
    began_s = time.monotonic()
    kept = folder / CHECKPOINT
    if kept.exists() and not resume:
        raise RunError(
            f"{folder}: holds a training: continue it by --resume, or choose another folder"
        )
    begin = (
        None if training.begin is None or kept.exists() else parameters_of(training.begin / MODEL)
    )
    begun = None if training.begin is None else bundle_facts(training.begin)
    examples = Examples(paths, training.seed, device)
    folder.mkdir(parents=True, exist_ok=True)
    spec = training.spec | {
        "data": ", ".join(map(packed_digest, paths)),
        "from": begun and begun.digest,
    }
    state = (
        _read(kept, training, spec, device) if kept.exists() else _begun(training, begin, device)
    )
    steps = state.plans[-1]
    first = state.step
    saved_s = time.monotonic()
    over = False
    while state.step < steps and not over:
        lost = _stepped(state, examples, training, steps)
        state.step += 1
        over = time.monotonic() - began_s > 60.0 * training.minutes
        planned = looks_after(state.step, steps)
        if planned or over:
            parts = {f"{name}_loss": float(part) for name, part in lost.items()}
            row = {"step": float(state.step), **parts, **_errors(state.averaged, examples)}
            if not math.isfinite(sum(row.values())):
                raise RunError(
                    f"{folder}: nothing is learned any more at step {state.step}: train "
                    f"anew, at a lower --rate"
                )
            write_curve(folder, [*state.curve, row])
            # a look because time is over is in the file alone: continued, the curve is that of one
            # piece
            if planned:
                state.curve.append(row)
            progress(_step_in_words(state.step, steps, row), state.step / steps)
        if not over and time.monotonic() - saved_s > _KEPT_EVERY_S:
            _write(kept, state, spec)
            saved_s = time.monotonic()
            progress(_step_in_words(state.step, steps), state.step / steps)
        elif state.step - first in _TIMED_STEPS:
            progress(_step_in_words(state.step, steps), state.step / steps)
    _write(kept, state, spec)
    source = source_of(examples.meta, training.seed, begun) + state_in_words(
        state.step, state.plans
    )
    write_bundle(folder, state.averaged, examples, training.name, source)
    return Reached(state.step, steps)


def _step_in_words(step: int, steps: int, row: Mapping[str, float] = MappingProxyType({})) -> str:
    """Return a step, with the errors of the held-out episodes if they were measured."""
    errors = ", ".join(
        f"{name.replace('_', ' ')} {value:.3f}" for name, value in row.items() if name != "step"
    )
    return f"step {step} of {steps}" + (f": {errors}" if errors else "")


def _device(name: str) -> torch.device:
    if not name:
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        raise UsageError(
            f"device '{name}' is not to be had: {str(error).splitlines()[0]}: try cpu"
        ) from error
    return device


def _begun(training: Training, begin: dict[str, Tensor] | None, device: torch.device) -> _State:
    drawn = new_parameters(training.seed) if begin is None else begin
    parameters = {name: value.to(device).requires_grad_() for name, value in drawn.items()}
    averaged = {name: value.detach().clone() for name, value in parameters.items()}
    return _State(
        parameters,
        averaged,
        _optimiser(parameters, training),
        0,
        [],
        [training.steps or PLANNED_STEPS],
    )


def _optimiser(parameters: Mapping[str, Tensor], training: Training) -> torch.optim.AdamW:
    return torch.optim.AdamW(parameters.values(), lr=training.rate, weight_decay=_DECAY)


def _stepped(
    state: _State, examples: Examples, training: Training, steps: int
) -> dict[str, Tensor]:
    """Take one step; return the parts of its loss."""
    step = state.step
    for group in state.optimiser.param_groups:
        group["lr"] = training.rate * rate_share(step, steps)
    parts = losses(state.parameters, examples.drawn(training.seed, step, training.batch))
    state.optimiser.zero_grad(set_to_none=True)
    torch.stack([_WEIGHTS[name] * part for name, part in parts.items()]).sum().backward()
    torch.nn.utils.clip_grad_norm_(state.parameters.values(), 1.0)
    state.optimiser.step()
    kept = min(_AVERAGED, (1.0 + step) / (10.0 + step))
    with torch.no_grad():
        torch._foreach_lerp_(
            list(state.averaged.values()),
            [one.detach() for one in state.parameters.values()],
            1.0 - kept,
        )
    return {name: part.detach() for name, part in parts.items()}


def losses(parameters: Parameters, batch: Batch) -> dict[str, Tensor]:
    """The parts of the loss. Speed and turn count where the expert does not stop; the way where it
    was driven."""
    said = answers(parameters, batch.pictures, batch.goal, batch.speeds)
    goes = 1.0 - batch.stop
    per_goer = 1.0 / goes.sum().clamp(min=1.0)
    off = turns_radps(batch.turn.device) - batch.turn[:, None]
    near = (-0.5 * (off / _NARROW_RADPS) ** 2).softmax(
        1
    )  # the bin of the expert's turn, and a little its neighbours
    turn = -(near * said.turn.log_softmax(1)).sum(1)
    speed = functional.smooth_l1_loss(said.speed, batch.speed, reduction="none", beta=0.1)
    way = functional.smooth_l1_loss(said.way, batch.way, reduction="none", beta=0.2).sum(2)
    return {
        "speed": (speed * goes).sum() * per_goer,
        "turn": (turn * goes).sum() * per_goer / math.log(TURN_BINS),
        "stop": functional.binary_cross_entropy_with_logits(said.stop, batch.stop),
        "way": (way * batch.driven).sum() / batch.driven.sum().clamp(min=1.0),
    }


def _errors(parameters: Parameters, examples: Examples) -> dict[str, float]:
    """Of the held-out episodes: mean errors of speed and turn where both go, share of right and of
    missed stops, and the last waypoint's mean error."""
    rows = examples.held_out
    rows = rows[:: max(1, -(-len(rows) // _MOST_HELD_OUT))]
    sums: dict[str, float] = dict.fromkeys(
        ("loss", "goers", "speed", "turn", "stops", "seen", "said", "ends", "way"), 0
    )
    with torch.no_grad():
        for part in np.array_split(rows, max(1, len(rows) // 512)):
            batch = examples.rows(part)
            said = answers(parameters, batch.pictures, batch.goal, batch.speeds)
            planned = plan(said)
            stops = said.stop > 0.0
            both = (batch.stop == 0.0) & ~stops
            speeds = planned[:, 0, 2:] - torch.stack([CRUISE_MPS * batch.speed, batch.turn], 1)
            off_m = (said.way[:, -1] - batch.way[:, -1]).norm(dim=1)
            parts = losses(parameters, batch)
            whole = sum(_WEIGHTS[name] * float(value) for name, value in parts.items())
            for name, value in (
                ("loss", whole * len(part)),
                ("goers", both.sum()),
                ("speed", speeds[both, 0].abs().sum()),
                ("turn", speeds[both, 1].abs().sum()),
                ("stops", batch.stop.sum()),
                ("seen", (stops & (batch.stop > 0.0)).sum()),
                ("said", stops.sum()),
                ("ends", batch.driven[:, -1].sum()),
                ("way", (off_m * batch.driven[:, -1]).sum()),
            ):
                sums[name] += float(value)
    goers, ends = max(sums["goers"], 1.0), max(sums["ends"], 1.0)
    return {
        "held_out_loss": sums["loss"] / max(len(rows), 1),
        "speed_error_mps": sums["speed"] / goers,
        "turn_error_radps": sums["turn"] / goers,
        "way_error_m": sums["way"] / ends,
        "stops_found": sums["seen"] / max(sums["stops"], 1.0),
        "stops_right": sums["seen"] / max(sums["said"], 1.0),
    }


def _write(path: Path, state: _State, spec: dict[str, Any]) -> None:
    held = {
        "spec": spec,
        "step": state.step,
        "curve": state.curve,
        "plans": state.plans,
        "parameters": {name: value.detach() for name, value in state.parameters.items()},
        "averaged": state.averaged,
        "optimiser": state.optimiser.state_dict(),
    }
    with atomic_file(path) as part:
        torch.save(held, part)


def _read(path: Path, training: Training, spec: dict[str, Any], device: torch.device) -> _State:
    """Read a checkpoint. Raises RunError where it is of another training."""
    try:
        held = torch.load(path, map_location="cpu", weights_only=True)
        was, curve = held["spec"], held["curve"]
        plans = held["plans"] if "plans" in held else [was["steps"]]
        parameters = {
            name: value.to(device).requires_grad_() for name, value in held["parameters"].items()
        }
        optimiser = _optimiser(parameters, training)
        optimiser.load_state_dict(held["optimiser"])
        averaged = {name: value.to(device) for name, value in held["averaged"].items()}
        step = held["step"]
    except Exception as error:
        raise RunError(f"{path}: cannot be continued: {error}: delete it and train anew") from error
    refuse_another(path, was, spec)
    steps = planned_steps(path, training.steps, plans[-1], step)
    return _State(
        parameters,
        averaged,
        optimiser,
        step,
        curve,
        plans if steps == plans[-1] else [*plans, steps],
    )
