"""Weather and perturbed starts of collected scenarios, drawn by their ids."""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterable
from typing import Final

import msgspec
import numpy as np

from cosim.core.geometry import wrap_angle
from cosim.spec.demo_options import DemoOptions
from cosim.spec.scenario import Scenario

_ASIDE_M: Final = 0.4
"""Largest distance of a perturbed start from the route."""
_TURNED_RAD: Final = math.radians(60.0)
"""Largest angle between a perturbed start and the route."""
_BACK_M: Final = 3.0
"""Distance along the route at which a perturbed reference route joins it."""


def varied(
    scenarios: Iterable[Scenario], collecting: DemoOptions, seed: int
) -> tuple[Scenario, ...]:
    """Return scenarios in drawn weathers, a share of them with a perturbed start.

    A decoy gets the weather and the start of its scenario. Raises SpecError for a weather that
    contradicts a scenario's light.
    """
    return tuple(_varied(one, collecting, seed) for one in scenarios)


def _varied(scenario: Scenario, collecting: DemoOptions, seed: int) -> Scenario:
    named = zlib.crc32((scenario.decoy_of or scenario.id).encode())
    weather, start = (np.random.default_rng([seed, named, purpose]) for purpose in range(2))
    if collecting.weathers:
        scenario = scenario.in_weather(
            collecting.weathers[weather.integers(len(collecting.weathers))]
        )
    return perturbed_start(scenario, start) if start.random() < collecting.astray else scenario


def perturbed_start(scenario: Scenario, draws: np.random.Generator) -> Scenario:
    """Return a scenario that begins aside of its route, turned away from it.

    Its reference route returns to the original one within _BACK_M.
    """
    aside_m = float(draws.uniform(-_ASIDE_M, _ASIDE_M))
    turn_rad = float(draws.uniform(-_TURNED_RAD, _TURNED_RAD))
    line, (x, y, heading) = scenario.route_line, scenario.start
    back_m = min(_BACK_M, line.length_m / 2.0)
    here = (x - aside_m * math.sin(heading), y + aside_m * math.cos(heading))
    back = tuple(map(float, line.at(back_m)[:2]))
    far_m = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(scenario.route, axis=0).T))])
    rest = [point for point, s_m in zip(scenario.route, far_m, strict=True) if s_m > back_m + 1e-6]
    return msgspec.structs.replace(
        scenario,
        start=(*here, wrap_angle(heading + turn_rad)),
        route=(here, back, *rest),
    )
