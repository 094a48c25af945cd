"""What a training prints, and its curve as a picture where matplotlib is installed."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path

from cosim.core.telling import duration
from cosim.learning.curve import CURVE, draw_curve
from cosim.learning.settings import Training, fits_in_words, outcome_in_words
from cosim.learning.training import train


def trained(
    paths: Sequence[Path],
    folder: Path,
    training: Training,
    resume: bool,
    say: Callable[[str], None],
) -> bool:
    """Train a small policy on packed demonstrations. Returns whether it came to its last step. say:
    prints a line."""
    started_s = began_s = time.monotonic()
    first = 0
    per_step_s = 0.0
    warned = resume

    def tell(step: int, steps: int, row: Mapping[str, float]) -> None:
        nonlocal began_s, first, per_step_s, warned
        if not first:
            first = step
            began_s = time.monotonic()
        if step > first:
            per_step_s = (time.monotonic() - began_s) / (step - first)
        left = (
            f", about {duration(per_step_s * (steps - step))} left"
            if per_step_s and step < steps
            else ""
        )
        held_out = ", ".join(
            f"{name.replace('_', ' ')} {value:.3f}" for name, value in row.items() if name != "step"
        )
        say(f"step {step} of {steps}{left}" + (f": {held_out}" if held_out else ""))
        if per_step_s and not warned:
            warned = True
            if words := fits_in_words(
                training, step, steps, time.monotonic() - started_s, per_step_s
            ):
                say(words)

    reached = train(paths, folder, training, resume, tell)
    if find_spec("matplotlib") and (folder / CURVE).exists():
        draw_curve(folder)
    say(outcome_in_words(folder, reached))
    return reached.whole
