"""The settings of a training, and the rules for continuing one. Needs no PyTorch."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

from cosim.core.errors import RunError, UsageError

PLANNED_STEPS: Final = 20_000
"""A training has so many steps unless others are asked for."""
_LOOKS: Final = 20
"""The held-out episodes are looked at so often in a training, at least _STEPS_APART steps apart: a
look takes as long as thirty steps or more."""
_STEPS_APART: Final = 200
_WARM_UP: Final = 0.03
"""The rate of learning rises during this share of the steps."""
CPU_WHEEL: Final = "pip install torch --index-url https://download.pytorch.org/whl/cpu"
"""How PyTorch's own documentation installs the build without CUDA."""
TO_INSTALL: Final = (
    f"{CPU_WHEEL} (0.8 GB on disk; without --index-url pip installs the build for NVIDIA GPUs, 7 "
    "GB), then pip install -e '.[train]' in the checkout"
)


@dataclass(frozen=True, kw_only=True)
class Training:
    """How a training is done. Raises UsageError.

    steps: in all, from the first one on; None for those of the training that is continued, else
    PLANNED_STEPS. batch: examples a step. rate: the highest rate of learning. device: "" for the
    GPU if there is one. begin: a bundle whose parameters it begins with; None for new ones. name:
    of the policy. minutes: it stops after so long, with a bundle of what it has learned by then,
    and can be continued.
    """

    steps: int | None = None
    seed: int = 0
    batch: int = 256
    rate: float = 1e-3
    device: str = ""
    begin: Path | None = None
    minutes: float = math.inf
    name: str = "small"

    def __post_init__(self) -> None:
        for field in ("steps", "batch", "rate", "minutes"):
            value = getattr(self, field)
            if value is not None and not value > 0:
                raise UsageError(f"--{field} must be above 0, not {value:g}")

    @property
    def spec(self) -> dict[str, Any]:
        """Return what must be the same when a training is continued."""
        return {
            name: value for name, value in asdict(self).items() if name in ("seed", "batch", "rate")
        }


class Reached(NamedTuple):
    """How far a training has come: steps done, and planned in all."""

    step: int
    steps: int

    @property
    def whole(self) -> bool:
        return self.step == self.steps


def looks_after(step: int, steps: int) -> bool:
    """Return whether the held-out episodes are looked at when so many of all steps are done."""
    return step % max(steps // _LOOKS, _STEPS_APART) == 0 or step == steps


def rate_share(step: int, steps: int) -> float:
    """Return the share of the highest rate by which a step learns: it rises, then falls as a cosine
    to 0 at the end."""
    return min(
        (step + 1) / max(1.0, _WARM_UP * steps), 0.5 * (1.0 + math.cos(math.pi * step / steps))
    )


def planned_steps(path: Path, asked: int | None, planned: int, done: int) -> int:
    """Return how many steps a continued training has in all: those asked for, else those planned
    before.

    Raises RunError where more are done already.
    """
    steps = planned if asked is None else asked
    if steps < done:
        raise RunError(
            f"{path}: {done} steps are done, and --steps asks for {steps} in all: give more "
            f"than {done}"
        )
    return steps


def refuse_another(path: Path, was: Mapping[str, Any], spec: Mapping[str, Any]) -> None:
    """Raise RunError with the differences where a checkpoint is of another training."""
    if different := [name for name in spec if was.get(name) != spec[name]]:
        told = ", ".join(f"{name} {was.get(name)}, not {spec[name]}" for name in different)
        raise RunError(
            f"{path}: of another training: {told}: continue it as it was begun, or choose "
            f"another folder"
        )


def state_in_words(step: int, plans: Sequence[int]) -> str:
    """Return what the source of a bundle adds about its training: nothing where it ended as it was
    first planned.

    >>> state_in_words(100, [100]), state_in_words(40, [100]), state_in_words(300, [100, 300])
    ('', '; step 40 of 100', '; 100 steps, continued to 300')
    """
    added = "".join(f", continued to {steps}" for steps in plans[1:])
    if step < plans[-1]:
        return f"; step {step} of {plans[-1]}"
    return f"; {plans[0]} steps{added}" if added else ""


def fits_in_words(
    training: Training, step: int, steps: int, since_s: float, per_step_s: float
) -> str:
    """Return how many of the steps fit in the minutes that there are; "" where all do. since_s:
    from the start on.

    >>> fits_in_words(Training(minutes=1.0), 4, 20_000, since_s=10.0, per_step_s=0.5)
    'about 104 of 20000 steps fit in --minutes 1: with --steps 104 a training would end by then'
    """
    left_s = 60.0 * training.minutes - since_s
    if left_s >= per_step_s * (steps - step):
        return ""
    fits = step + max(0, int(left_s / per_step_s))
    return (
        f"about {fits} of {steps} steps fit in --minutes {training.minutes:g}: "
        f"with --steps {fits} a training would end by then"
    )


def outcome_in_words(folder: Path, reached: Reached) -> str:
    """Return how a training ended: what the folder holds, and how to continue."""
    bundle = f"a bundle: --policy onnx:{folder}"
    if reached.whole:
        return f"{folder}: {bundle}; more steps: --resume --steps {2 * reached.steps}"
    return (
        f"{folder}: {bundle}, stopped at step {reached.step} of {reached.steps}. Continue with "
        f"--resume, or to an earlier end with --resume --steps N, at least {reached.step + 1}"
    )
