"""Settings of a training, and the rules for continuing one; needs no PyTorch."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, NamedTuple

from cosim.core.errors import RunError, UsageError, unknown


class NetworkDefaults(NamedTuple):
    """Row of a network.

    batch: default number of examples or windows per step
    has_ablations: whether it has the settings of ablations, and `values`
    """

    batch: int
    has_ablations: bool = False


NETWORK_DEFAULTS: Final[Mapping[str, NetworkDefaults]] = MappingProxyType(
    {"small": NetworkDefaults(256), "sidewalk": NetworkDefaults(48, has_ablations=True)}
)
"""Table of the networks; `cosim.learning.networks` has what needs PyTorch."""
PLANNED_STEPS: Final = 20_000
"""Default number of steps of a training."""
_EVALUATIONS: Final = 20
"""Number of evaluations on the held-out episodes in a training."""
_MIN_STEPS_BETWEEN: Final = 200
"""Least number of steps between evaluations; one takes as long as thirty steps or more."""
_WARM_UP: Final = 0.03
"""Share of the steps in which the learning rate rises."""
CPU_WHEEL: Final = "pip install torch --index-url https://download.pytorch.org/whl/cpu"
"""Command that PyTorch documents for the build without CUDA."""
TO_INSTALL: Final = (
    f"{CPU_WHEEL} (0.8 GB on disk; without --index-url pip installs the build for NVIDIA GPUs, 7 "
    "GB), then pip install -e '.[train]' in the checkout"
)


_ABLATIONS: Final = ("share", "memory", "auxiliary", "decoys", "weather", "values")


def batches_in_words() -> str:
    """Return the default numbers of examples of all networks.

    >>> batches_in_words()
    '256 of small, 48 of sidewalk'
    """
    return ", ".join(f"{one.batch} of {name}" for name, one in NETWORK_DEFAULTS.items())


@dataclass(frozen=True, kw_only=True)
class Training:
    """Settings of a training. Raises UsageError.

    network: a name in NETWORK_DEFAULTS
    steps: total number; None for those of the continued training, else PLANNED_STEPS
    batch: examples or windows per step; None for that of NETWORK_DEFAULTS
    rate: highest learning rate
    device: "" for the GPU if available
    begin: bundle with the initial parameters; None for new ones
    minutes: time limit; the training then writes its bundle and can be continued
    name: of the policy; "" for that of the network

    Ablations of `sidewalk`:

    share: share of the training episodes that are used
    memory, auxiliary: whether it has a memory, and auxiliary heads
    decoys, weather: whether decoys and episodes in other weather than clear are used

    Fine-tuning of `sidewalk` on rewards, from the network that drove:

    values: temperature of the weights of rows with rewards, see `values.py`; 0 for equal weights
    """

    network: str = "small"
    steps: int | None = None
    seed: int = 0
    batch: int | None = None
    rate: float = 1e-3
    device: str = ""
    begin: Path | None = None
    minutes: float = math.inf
    name: str = ""
    share: float = 1.0
    memory: bool = True
    auxiliary: bool = True
    decoys: bool = True
    weather: bool = True
    values: float = 0.0

    def __post_init__(self) -> None:
        if self.network not in NETWORK_DEFAULTS:
            raise unknown("network", self.network, NETWORK_DEFAULTS)
        if self.share > 1.0:
            raise UsageError(f"--share must be at most 1, not {self.share:g}")
        changed = [name for name, _ in self.ablations]
        if changed and not NETWORK_DEFAULTS[self.network].has_ablations:
            able = " or ".join(name for name, one in NETWORK_DEFAULTS.items() if one.has_ablations)
            raise UsageError(f"--network {self.network} has no {', '.join(changed)}: use {able}")
        if not 0.0 <= self.values < math.inf:
            raise UsageError(f"--values must be a temperature such as 1, not {self.values:g}")
        if self.values and self.begin is None:
            raise UsageError("--values needs --from, the bundle that drove with --explore")
        for field in ("steps", "batch", "rate", "minutes", "share"):
            value = getattr(self, field)
            if value is not None and not value > 0:
                raise UsageError(f"--{field} must be above 0, not {value:g}")

    @property
    def size(self) -> int:
        """Return the number of examples or windows per step."""
        return NETWORK_DEFAULTS[self.network].batch if self.batch is None else self.batch

    @property
    def called(self) -> str:
        """Return the name of the policy."""
        return self.name or self.network

    @property
    def ablations(self) -> list[tuple[str, Any]]:
        """Return name and value of the settings that make an ablation."""
        return [
            (name, getattr(self, name))
            for name in _ABLATIONS
            if getattr(self, name) != type(self).__dataclass_fields__[name].default
        ]

    @property
    def spec(self) -> dict[str, Any]:
        """Return the settings that must not change when a training is continued."""
        same = {name: getattr(self, name) for name in ("network", "seed", "rate", *_ABLATIONS)}
        return same | {"batch": self.size}


class StepsReached(NamedTuple):
    """Steps of a training: done, and planned in total."""

    step: int
    steps: int

    @property
    def whole(self) -> bool:
        return self.step == self.steps


def is_evaluated(step: int, steps: int) -> bool:
    """Return whether the held-out episodes are evaluated after a step."""
    return step % max(steps // _EVALUATIONS, _MIN_STEPS_BETWEEN) == 0 or step == steps


def rate_share(step: int, steps: int) -> float:
    """Return the learning rate of a step as a share of the highest: warm-up, then a cosine to 0."""
    return min(
        (step + 1) / max(1.0, _WARM_UP * steps), 0.5 * (1.0 + math.cos(math.pi * step / steps))
    )


def planned_steps(path: Path, asked: int | None, planned: int, done: int) -> int:
    """Return the total steps of a continued training: the requested ones, else those planned
    before.

    Raises RunError if more are already done.
    """
    steps = planned if asked is None else asked
    if steps < done:
        raise RunError(
            f"{path}: {done} steps are done, and --steps asks for {steps} in all: give more "
            f"than {done}"
        )
    return steps


def refuse_another(path: Path, was: Mapping[str, Any], spec: Mapping[str, Any]) -> None:
    """Raise RunError with the differences if a checkpoint is from another training."""
    if different := [name for name in spec if was.get(name) != spec[name]]:
        differences = ", ".join(f"{name} {was.get(name)}, not {spec[name]}" for name in different)
        raise RunError(
            f"{path}: of another training: {differences}: continue it as it was begun, or choose "
            f"another folder"
        )


def state_in_words(step: int, plans: Sequence[int]) -> str:
    """Return what the source of a bundle adds about its training; "" if it ended as first planned.

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
    """Return how many steps fit in the time limit; "" if all do.

    since_s: time since the start

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


def outcome_in_words(folder: Path, reached: StepsReached) -> str:
    """Return how a training ended: content of the folder, and how to continue."""
    bundle = f"a bundle: --policy onnx:{folder}"
    if reached.whole:
        return f"{folder}: {bundle}; more steps: --resume --steps {2 * reached.steps}"
    return (
        f"{folder}: {bundle}, stopped at step {reached.step} of {reached.steps}. Continue with "
        f"--resume, or to an earlier end with --resume --steps N, at least {reached.step + 1}"
    )
