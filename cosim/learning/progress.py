"""What a training says while it goes on, and its curve as a picture where matplotlib is installed."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path

from cosim.core.telling import duration
from cosim.learning.training import CURVE, Training, train


def trained(paths: Sequence[Path], folder: Path, training: Training, resume: bool, say: Callable[[str], None]) -> bool:
    """Train a small policy on packed demonstrations; whether it came to its end. What it says are lines."""
    began_s, first = time.monotonic(), 0

    def tell(step: int, row: Mapping[str, float]) -> None:
        nonlocal began_s, first
        if not first:
            first, began_s = step, time.monotonic()
        per_step_s = (time.monotonic() - began_s) / (step - first) if step > first else 0.0
        left = f", about {duration(per_step_s * (training.steps - step))} left" if per_step_s else ""
        held_out = ", ".join(f"{name.replace('_', ' ')} {value:.3f}" for name, value in row.items() if name != "step")
        say(f"step {step} of {training.steps}{left}" + (f": {held_out}" if held_out else ""))

    whole = train(paths, folder, training, resume, tell)
    if find_spec("matplotlib") and (folder / CURVE).exists():
        _draw(folder)
    say(f"{folder}: a bundle: --policy onnx:{folder}" if whole else f"{folder}: stopped: go on with --resume")
    return whole


def _draw(folder: Path) -> None:
    """The curve as `curve.png`: losses, and errors of the held-out episodes, over the steps."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    names, *rows = [line.split(",") for line in (folder / CURVE).read_text().splitlines()]
    columns = {name: [float(row[i]) for row in rows] for i, name in enumerate(names)}
    steps = columns.pop("step")
    figure, axes = plt.subplots(2, 5, figsize=(15, 5), layout="constrained")
    for axis, (name, values) in zip(axes.flat, columns.items(), strict=False):
        axis.plot(steps, values)
        axis.set_title(name.replace("_", " "))
        axis.grid(alpha=0.3)
    figure.savefig(folder / "curve.png")
    plt.close(figure)
