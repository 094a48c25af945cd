"""What a training prints, and its curve as a picture where matplotlib is installed."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from pathlib import Path

from cosim.core.units import duration
from cosim.learning.curve import CURVE, draw_curve
from cosim.learning.settings import PLANNED_STEPS, Training, fits_in_words, outcome_in_words
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
    steps = training.steps or PLANNED_STEPS
    first = 0.0
    warned = resume

    def show(stage: str, share: float | None = None, /) -> None:
        nonlocal began_s, first, warned
        now_s = time.monotonic()
        done = share or 0.0
        if not first:
            first, began_s = done, now_s
        per_share_s = (now_s - began_s) / (done - first) if done > first else 0.0
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
