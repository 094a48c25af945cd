"""Training by behaviour cloning; each step is a function of seed, data and the previous step.

A checkpoint (`checkpoint.pt`) is written every minute. A resumed training therefore ends like an
uninterrupted one on the same device. The bundle is written at the end and at the time limit.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import torch
from torch import Tensor

from cosim.core.errors import RunError, UsageError, unwritable
from cosim.core.files import atomic_file
from cosim.core.packed_demos import packed_digest
from cosim.core.progress import Progress
from cosim.core.units import duration
from cosim.learning.bundle import bundle_facts, source_of, write_bundle
from cosim.learning.curve import CURVE, draw_curve, write_curve
from cosim.learning.graph import MODEL, load_parameters
from cosim.learning.kind import ExampleSet
from cosim.learning.networks import NETWORKS
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
_AVERAGE_DECAY: Final = 0.999
"""Decay of the moving average of the parameters, which the bundle holds."""
_WEIGHT_DECAY: Final = 0.01


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
    network = NETWORKS[training.network]
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
        else load_parameters(training.begin / MODEL, network.new_parameters(0), network.grown)
    )
    base = None if training.begin is None else bundle_facts(training.begin)
    examples = network.examples(paths, training, device)
    if weighting := examples.meta.get("weighting"):
        progress(weighting)
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
    batches = _batches(examples, training, state.step, steps, ahead=device.type == "cuda")
    while state.step < steps and not over:
        loss_parts = _take_step(state, next(batches), training, steps)
        state.step += 1
        over = time.monotonic() - began_s > 60.0 * training.minutes
        scheduled = is_evaluated(state.step, steps)
        if over and not scheduled:  # an evaluation may outlast the time that is left
            _write_checkpoint(checkpoint, state, spec)
        if scheduled or over:
            parts = {f"{name}_loss": float(part) for name, part in loss_parts.items()}
            row = {
                "step": float(state.step),
                **parts,
                **network.errors(state.averaged, examples, training),
            }
            if not math.isfinite(sum(one for name, one in row.items() if name.endswith("_loss"))):
                raise RunError(
                    f"{folder}: losses are not finite at step {state.step}: train again, at a "
                    f"lower --rate"
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
    write_bundle(folder, state.averaged, examples, training, source)
    return StepsReached(state.step, steps)


def _step_in_words(step: int, steps: int, row: Mapping[str, float] = MappingProxyType({})) -> str:
    """Return a step in words, with its errors on the held-out episodes if measured.

    Means over no rows are left out: signals where no held-out route has one.
    """
    errors = ", ".join(
        f"{name.replace('_', ' ')} {value:.3f}"
        for name, value in row.items()
        if name != "step" and not math.isnan(value)
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
    drawn = NETWORKS[training.network].new_parameters(training.seed) if begin is None else begin
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


def _batches(
    examples: ExampleSet, training: Training, first: int, steps: int, ahead: bool
) -> Iterator[Any]:
    """Draw the batches of the steps from `first` on.

    ahead: whether a thread draws the next batch during a step, while a GPU computes
    """
    draw = partial(examples.drawn, training.seed, size=training.size)
    if not ahead:
        yield from map(draw, range(first, steps))
        return
    with ThreadPoolExecutor(1) as thread:
        drawn = thread.submit(draw, first)
        for step in range(first, steps):
            batch = drawn.result()
            if step + 1 < steps:
                drawn = thread.submit(draw, step + 1)
            yield batch


def _take_step(state: _State, batch: Any, training: Training, steps: int) -> dict[str, Tensor]:
    """Take one step and return the parts of its loss."""
    step = state.step
    for group in state.optimiser.param_groups:
        group["lr"] = training.rate * rate_share(step, steps)
    network = NETWORKS[training.network]
    parts = network.losses(state.parameters, batch, training)
    state.optimiser.zero_grad(set_to_none=True)
    torch.stack([network.weights[name] * part for name, part in parts.items()]).sum().backward()
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
        raise RunError(
            f"{path}: cannot be continued: {error}: delete it and train again"
        ) from error
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
    """Train a policy on packed demonstrations and print its progress.

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
