"""How fast many environments drive together, drawn for by one renderer that asks one policy for all
of them."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import suppress
from typing import Final

import msgspec
import numpy as np

from cosim.core.errors import EngineError
from cosim.core.state import Command
from cosim.episode.interfaces import Observation
from cosim.policies.baselines import Straight
from cosim.spec.camera import CameraSpec
from cosim.spec.manifest import Manifest
from scenarios.tools.bench.figures import MORE, Figure

ENVIRONMENTS: Final = 10
_WARM_UP_S: Final = 5.0
_MEASURED_S: Final = 30.0
"""Simulated seconds of each environment, on average, that the figure is taken from."""


class StraightTogether(Straight):
    """Drives straight on in all episodes at once, slower where it is dark: all pictures go into one
    array, as a model would want them."""

    manifest = Manifest("straight-together", rate_hz=4.0, camera=CameraSpec(96, 96))

    def act_batch(self, observations: Sequence[Observation]) -> list[Command]:
        pictures = np.stack([one.rgb for one in observations if one.rgb is not None])
        paces = np.clip(pictures.mean(axis=(1, 2, 3)) / 64.0, 0.5, 1.0).tolist()
        return [
            Command(pace * one.robot.cruise_mps, 0.0)
            for one, pace in zip(observations, paces, strict=True)
        ]


def driving_together(environments: int = ENVIRONMENTS, *, shared: bool = True) -> list[Figure]:
    """Simulated seconds a second, of all environments in all, once each has warmed up:
    long-horizon, 96x96 at 4 Hz.

    shared: by one renderer and one policy for all of them; else each environment has its own of
    both."""
    from cosim.spec.options import EpisodeOptions
    from cosim.spec.scenario import Suite
    from scenarios.runs.run import run
    from scenarios.suites.catalog import load_suite

    shipped = load_suite("long-horizon").scenarios
    picked = [
        msgspec.structs.replace(shipped[i % len(shipped)], id=f"together-{i}", seed=i)
        for i in range(environments)
    ]
    suite = Suite(name="together", version="1", scenarios=tuple(picked))
    name = f"{__name__}:{StraightTogether.__name__}"
    watch = _Watch(environments)
    options = EpisodeOptions(seed=0, camera="gl")
    with suppress(_Enough):
        run(
            suite, name, jobs=environments, shared_renderer=shared, options=options, tell=watch.hear
        )
    how = (
        "shared renderer and batched policy" if shared else "each with its own renderer and policy"
    )
    rate = watch.rate()
    reach = 60.0 if shared and environments == ENVIRONMENTS else None
    return [
        Figure(
            f"{environments} environments, {how}, simulated s per s in all",
            rate,
            reach=reach,
            better=MORE,
        )
    ]


class _Enough(Exception):
    """The figure can be taken."""


class _Watch:
    """Hears how far every environment is."""

    def __init__(self, environments: int) -> None:
        self._environments = environments
        self._at_s: dict[str, float] = {}
        self._began: tuple[float, float] | None = None
        self._ended: tuple[float, float] | None = None

    def hear(self, message: object) -> None:
        """Raises _Enough at the end of the time to measure."""
        from scenarios.ipc.messages import Progress

        if not isinstance(message, Progress):
            return
        self._at_s[message.scenario] = message.time_s
        so_far = time.perf_counter(), sum(self._at_s.values())
        if self._began is None:
            if len(self._at_s) == self._environments and min(self._at_s.values()) >= _WARM_UP_S:
                self._began = so_far
        elif so_far[1] - self._began[1] >= _MEASURED_S * self._environments:
            self._ended = so_far
            raise _Enough

    def rate(self) -> float:
        """Simulated seconds a second. Raises EngineError when the environments ended before it
        could be taken."""
        if self._began is None or self._ended is None:
            raise EngineError(
                "the environments ended before their speed could be taken: they crashed"
            )
        return (self._ended[1] - self._began[1]) / (self._ended[0] - self._began[0])
