"""Training by behaviour cloning; each step is a function of seed, data and the previous step.

A checkpoint (`checkpoint.pt`) is written every minute. A resumed training therefore ends like an
uninterrupted one on the same device. The bundle is written at the end and at the time limit.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
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
from cosim.core.units import duration
from cosim.learning.bundle import MODEL, bundle_facts, source_of, write_bundle
from cosim.learning.curve import CURVE, draw_curve, write_curve
from cosim.learning.examples import Batch, Examples
from cosim.learning.graph import load_parameters
from cosim.learning.network import (
    CRUISE_MPS,
    TURN_BINS,
    Parameters,
    forward,
    new_parameters,
    plan,
    turns_radps,
)
from cosim.learning.settings import (
    PLANNED_STEPS,
    StepsReached,
    Training,
    fits_in_words,
    is_evaluated,
    outcome_in_words,
    planned_steps,
    rate_share,
    refuse_another,
    state_in_words,
)

CHECKPOINT: Final = "checkpoint.pt"
_CHECKPOINT_EVERY_S: Final = 60.0
"""Time between checkpoints, seconds."""
_TIMED_STEPS: Final = (1, 4)
"""Steps after which progress is reported, to estimate the time of all steps."""
_MAX_HELD_OUT: Final = 4096
_AVERAGE_DECAY: Final = 0.999
"""Decay of the moving average of the parameters, which the bundle holds."""
_WEIGHT_DECAY: Final = 0.01
_TURN_SPREAD_RADPS: Final = 0.04
_WEIGHTS: Final = {"speed": 4.0, "turn": 1.0, "stop": 1.0, "way": 0.5}
"""Weights of the parts of the loss."""


@dataclass
class _State:
    """State of a training.

    averaged: moving averages of the parameters
    curve: one row per evaluation
    plans: planned total steps, at first and after each change
    """

    parameters: dict[str, Tensor]
    averaged: dict[str, Tensor]
    optimiser: torch.optim.AdamW
    step: int
    curve: list[dict[str, float]]
    plans: list[int]


def train(
    paths: Sequence[Path], folder: Path, training: Training, resume: bool, progress: Progress
) -> StepsReached:
    """Train on packed demonstrations; write curve and bundle into a folder, also at the time limit.

    resume: continue the training in the folder, if any; with more steps also a finished one

    Raises RunError for unusable data, a folder with another training or one not to be resumed, and
    diverging losses; MachineError if the folder cannot be written.
    """
    try:
        return _train(paths, folder, training, resume, progress)
    except OSError as error:
        raise unwritable(folder, error) from error


def _train(
    paths: Sequence[Path], folder: Path, training: Training, resume: bool, progress: Progress
) -> StepsReached:
    device = _device(training.device)
    torch.manual_seed(training.seed)
    torch.backends.cudnn.deterministic = True
    torch.backends.cudnn.allow_tf32 = torch.backends.cuda.matmul.allow_tf32 = True
    began_s = time.monotonic()
    checkpoint = folder / CHECKPOINT
    if checkpoint.exists() and not resume:
        raise RunError(
            f"{folder}: holds a training: continue it by --resume, or choose another folder"
        )
    begin = (
        None
        if training.begin is None or checkpoint.exists()
        else load_parameters(training.begin / MODEL)
    )
    base = None if training.begin is None else bundle_facts(training.begin)
    examples = Examples(paths, training.seed, device)
    folder.mkdir(parents=True, exist_ok=True)
    spec = training.spec | {
        "data": ", ".join(map(packed_digest, paths)),
        "from": base and base.digest,
    }
    state = (
        _read_checkpoint(checkpoint, training, spec, device)
        if checkpoint.exists()
        else _new_state(training, begin, device)
    )
    steps = state.plans[-1]
    first = state.step
    saved_s = time.monotonic()
    over = False
    while state.step < steps and not over:
        loss_parts = _take_step(state, examples, training, steps)
        state.step += 1
        over = time.monotonic() - began_s > 60.0 * training.minutes
        scheduled = is_evaluated(state.step, steps)
        if scheduled or over:
            parts = {f"{name}_loss": float(part) for name, part in loss_parts.items()}
            row = {"step": float(state.step), **parts, **_errors(state.averaged, examples)}
            if not math.isfinite(sum(row.values())):
                raise RunError(
                    f"{folder}: nothing is learned any more at step {state.step}: train "
                    f"anew, at a lower --rate"
                )
            write_curve(folder, [*state.curve, row])
            # An evaluation at the time limit is only in the file, so that a resumed training
            # gives the same curve as an uninterrupted one.
            if scheduled:
                state.curve.append(row)
            progress(_step_in_words(state.step, steps, row), state.step / steps)
        if not over and time.monotonic() - saved_s > _CHECKPOINT_EVERY_S:
            _write_checkpoint(checkpoint, state, spec)
            saved_s = time.monotonic()
            progress(_step_in_words(state.step, steps), state.step / steps)
        elif state.step - first in _TIMED_STEPS:
            progress(_step_in_words(state.step, steps), state.step / steps)
    _write_checkpoint(checkpoint, state, spec)
    source = source_of(examples.meta, training.seed, base) + state_in_words(state.step, state.plans)
    write_bundle(folder, state.averaged, examples, training.name, source)
    return StepsReached(state.step, steps)


def _step_in_words(step: int, steps: int, row: Mapping[str, float] = MappingProxyType({})) -> str:
    """Return a step in words, with its errors on the held-out episodes if measured."""
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


def _new_state(training: Training, begin: dict[str, Tensor] | None, device: torch.device) -> _State:
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
    return torch.optim.AdamW(parameters.values(), lr=training.rate, weight_decay=_WEIGHT_DECAY)


def _take_step(
    state: _State, examples: Examples, training: Training, steps: int
) -> dict[str, Tensor]:
    """Take one step and return the parts of its loss."""
    step = state.step
    for group in state.optimiser.param_groups:
        group["lr"] = training.rate * rate_share(step, steps)
    parts = losses(state.parameters, examples.drawn(training.seed, step, training.batch))
    state.optimiser.zero_grad(set_to_none=True)
    torch.stack([_WEIGHTS[name] * part for name, part in parts.items()]).sum().backward()
    torch.nn.utils.clip_grad_norm_(state.parameters.values(), 1.0)
    state.optimiser.step()
    decay = min(_AVERAGE_DECAY, (1.0 + step) / (10.0 + step))
    with torch.no_grad():
        torch._foreach_lerp_(
            list(state.averaged.values()),
            [one.detach() for one in state.parameters.values()],
            1.0 - decay,
        )
    return {name: part.detach() for name, part in parts.items()}


def losses(parameters: Parameters, batch: Batch) -> dict[str, Tensor]:
    """Return the parts of the loss.

    Speed and turn count only if the expert does not stop; waypoints only if they were driven.
    """
    output = forward(parameters, batch.pictures, batch.goal, batch.speeds)
    moves = 1.0 - batch.stop
    per_moving = 1.0 / moves.sum().clamp(min=1.0)
    turn_errors = turns_radps(batch.turn.device) - batch.turn[:, None]
    # The bin of the expert's turn, and its neighbours with less weight.
    targets = (-0.5 * (turn_errors / _TURN_SPREAD_RADPS) ** 2).softmax(1)
    turn = -(targets * output.turn.log_softmax(1)).sum(1)
    speed = functional.smooth_l1_loss(output.speed, batch.speed, reduction="none", beta=0.1)
    way = functional.smooth_l1_loss(output.way, batch.way, reduction="none", beta=0.2).sum(2)
    return {
        "speed": (speed * moves).sum() * per_moving,
        "turn": (turn * moves).sum() * per_moving / math.log(TURN_BINS),
        "stop": functional.binary_cross_entropy_with_logits(output.stop, batch.stop),
        "way": (way * batch.driven).sum() / batch.driven.sum().clamp(min=1.0),
    }


def _errors(parameters: Parameters, examples: Examples) -> dict[str, float]:
    """Return errors on the held-out episodes.

    These are mean errors of speed and turn if both move, recall and precision of stops, and the
    mean error of the last waypoint.
    """
    rows = examples.held_out
    rows = rows[:: max(1, -(-len(rows) // _MAX_HELD_OUT))]
    sums: dict[str, float] = dict.fromkeys(
        ("loss", "goers", "speed", "turn", "stops", "seen", "said", "ends", "way"), 0
    )
    with torch.no_grad():
        for part in np.array_split(rows, max(1, len(rows) // 512)):
            batch = examples.rows(part)
            output = forward(parameters, batch.pictures, batch.goal, batch.speeds)
            planned = plan(output)
            stops = output.stop > 0.0
            both = (batch.stop == 0.0) & ~stops
            speeds = planned[:, 0, 2:] - torch.stack([CRUISE_MPS * batch.speed, batch.turn], 1)
            off_m = (output.way[:, -1] - batch.way[:, -1]).norm(dim=1)
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


def _write_checkpoint(path: Path, state: _State, spec: dict[str, Any]) -> None:
    checkpoint = {
        "spec": spec,
        "step": state.step,
        "curve": state.curve,
        "plans": state.plans,
        "parameters": {name: value.detach() for name, value in state.parameters.items()},
        "averaged": state.averaged,
        "optimiser": state.optimiser.state_dict(),
    }
    with atomic_file(path) as part:
        torch.save(checkpoint, part)


def _read_checkpoint(
    path: Path, training: Training, spec: dict[str, Any], device: torch.device
) -> _State:
    """Load a checkpoint. Raises RunError if it is from another training."""
    try:
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
        was, curve = checkpoint["spec"], checkpoint["curve"]
        plans = checkpoint["plans"] if "plans" in checkpoint else [was["steps"]]
        parameters = {
            name: value.to(device).requires_grad_()
            for name, value in checkpoint["parameters"].items()
        }
        optimiser = _optimiser(parameters, training)
        optimiser.load_state_dict(checkpoint["optimiser"])
        averaged = {name: value.to(device) for name, value in checkpoint["averaged"].items()}
        step = checkpoint["step"]
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


def train_and_report(
    paths: Sequence[Path],
    folder: Path,
    training: Training,
    resume: bool,
    say: Callable[[str], None],
) -> bool:
    """Train a small policy on packed demonstrations and print its progress.

    Returns whether the last step was reached.
    """
    started_s = began_s = time.monotonic()
    steps = training.steps or PLANNED_STEPS
    first_share = 0.0
    warned = resume

    def show(stage: str, share: float | None = None, /) -> None:
        nonlocal began_s, first_share, warned
        now_s = time.monotonic()
        done = share or 0.0
        if not first_share:
            first_share, began_s = done, now_s
        per_share_s = (now_s - began_s) / (done - first_share) if done > first_share else 0.0
        say(
            f"{stage}, about {duration(per_share_s * (1.0 - done))} left"
            if per_share_s and done < 1.0
            else stage
        )
        if per_share_s and not warned:
            warned = True
            if words := fits_in_words(
                training, round(done * steps), steps, now_s - started_s, per_share_s / steps
            ):
                say(words)

    reached = train(paths, folder, training, resume, show)
    if find_spec("matplotlib") and (folder / CURVE).exists():
        draw_curve(folder)
    say(outcome_in_words(folder, reached))
    return reached.whole
