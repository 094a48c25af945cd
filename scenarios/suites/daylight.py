"""Draw the daylight of scenarios: any hour, season and clouds, and sometimes fog.

A person can always see enough in the pictures.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from cosim.spec.scenario import Light
from physics.cameras.sun import sun_direction

LOWEST_SUN_RAD: Final = math.radians(6.0)
"""Least elevation of the sun: no dusk, no night."""
FOG_M: Final = (150.0, 1500.0)
"""Least and largest visibility in fog, in metres: the other side of a street is always visible."""
_FOGGY_EACH: Final = 7
"""Number of scenarios of which one has fog."""


def drawn_daylight(rng: np.random.Generator, number: int) -> Light:
    """Draw a light by day.

    number: of the scenario in its suite. Quarters of the year, parts of the day, skies and fog take
    turns by it, so that all are equally frequent. Everything else is drawn.
    """
    day = 1 + int((number % 4 + rng.random()) * 365 / 4)
    hours = np.arange(0.0, 24.0, 0.25)
    bright = np.array(
        [hour for hour in hours.tolist() if sun_rises_rad(hour, day) >= LOWEST_SUN_RAD]
    )
    part = np.array_split(bright, 3)[number // 4 % 3]
    clouds = (number // 12 % 3 + rng.random()) / 3
    near, far = np.log(FOG_M)
    fog_m = float(round(math.exp(rng.uniform(near, far))))
    return Light(
        hour=float(part[int(rng.integers(len(part)))]),
        day_of_year=day,
        cloud_cover=round(float(clouds), 2),
        fog_m=fog_m if number % _FOGGY_EACH == 0 else None,
    )


def sun_rises_rad(
    hour: float, day_of_year: int, latitude_deg: float = Light().latitude_deg
) -> float:
    """Return the elevation of the sun above the horizon."""
    return math.asin(float(sun_direction(hour, day_of_year, latitude_deg)[2]))
