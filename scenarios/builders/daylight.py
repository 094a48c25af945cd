"""Daylight of drawn scenarios: any hour, season, clouds and at times fog, as long as a person can read the picture."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from cosim.spec.scenario import Light
from physics.cameras.sun import sun_direction

LOWEST_SUN_RAD: Final = math.radians(6.0)
"""The sun stands higher than this: no dusk, no night."""
FOG_M: Final = (150.0, 1500.0)
"""Thinnest and thickest fog: the other side of a street is seen in any."""
_FOGGY: Final = 0.15
"""Share of the scenarios with fog."""


def drawn_daylight(rng: np.random.Generator) -> Light:
    """A light by day: day of the year, hour and clouds evenly, fog now and then."""
    day = int(rng.integers(1, 366))
    hours = np.arange(0.0, 24.0, 0.25)
    bright = [hour for hour in hours.tolist() if sun_rises_rad(hour, day) >= LOWEST_SUN_RAD]
    hour, clouds = bright[int(rng.integers(len(bright)))], round(float(rng.uniform(0.0, 1.0)), 2)
    thin, thick = np.log(FOG_M)[::-1]
    fog_m = float(round(math.exp(rng.uniform(thick, thin)))) if rng.random() < _FOGGY else None
    return Light(hour=hour, day_of_year=day, cloud_cover=clouds, fog_m=fog_m)


def sun_rises_rad(hour: float, day_of_year: int, latitude_deg: float = Light().latitude_deg) -> float:
    """The sun's elevation above the horizon."""
    return math.asin(float(sun_direction(hour, day_of_year, latitude_deg)[2]))
