"""Weather: a table of named conditions, which change friction, light, pictures and people."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

import msgspec

from cosim.core.errors import SpecError, listed, nearest

CLEAR: Final = "clear"
"""Name of the default weather, which changes nothing."""


class Weather(msgspec.Struct, frozen=True, kw_only=True):
    """A kind of weather. The defaults are those of `clear`: nothing is changed.

    summary: one line for lists
    rain_mm_h: rain rate; the AMS glossary calls 2.6 to 7.6 mm/h moderate, and more heavy
    snow_mm_h: rate of snowfall as water
    wetness: 0 (dry) to 1 (soaked): dark, reflecting surfaces
    puddles: share of walkable ground under water
    snow: 0 to 1, cover of surfaces that face upwards
    visibility_m: meteorological visibility; None for that of the scenario's light
    fog_top_m: height of the fog over the ground
    cloud_cover: 0 to 1; None for that of the scenario's light
    sun_deg: elevation of the sun at its azimuth of the scenario's hour; None for the scenario's own
    grip: factor of every coefficient of friction of the ground, for wheels and feet
    hurry: factor of the walking speed of people in the crowd
    benches: share of the residents who are outside
    children: share of the scenario's children who are outside
    """

    name: str
    summary: str = ""
    rain_mm_h: float = 0.0
    snow_mm_h: float = 0.0
    wetness: float = 0.0
    puddles: float = 0.0
    snow: float = 0.0
    visibility_m: float | None = None
    fog_top_m: float = 60.0
    cloud_cover: float | None = None
    sun_deg: float | None = None
    grip: float = 1.0
    hurry: float = 1.0
    benches: float = 1.0
    children: float = 1.0

    @property
    def precipitates(self) -> bool:
        """Whether rain or snow falls."""
        return self.rain_mm_h > 0.0 or self.snow_mm_h > 0.0


WET_GRIP: Final = 0.6
"""Friction of wet ground as a share of dry ground.

Tyres keep some 0.5 to 0.75 of their friction on wet asphalt and wet paving.
"""
SNOW_GRIP: Final = 0.35
"""Friction of trodden snow as a share of dry ground.

C.-G. Wallman and H. Astrom, VTI meddelande 911A (2001), measure 0.8 to 1.0 on dry asphalt, 0.2 to
0.5 on loose snow and 0.2 to 0.3 on packed snow.
"""
_RAIN_HURRY: Final = 1.08
"""People in rain walk faster; a middle value, as published speeds differ by a few percent."""

_NIGHT_DEG: Final = -16.0
_OUT_AT_NIGHT: Final = 0.1
"""Share of children and of people on benches that is outside at night; an assumption."""

WEATHERS: Final[Mapping[str, Weather]] = MappingProxyType(
    {
        one.name: one
        for one in (
            Weather(name=CLEAR, summary="the scenario's own light, dry"),
            Weather(name="overcast", summary="closed clouds, dry", cloud_cover=1.0),
            Weather(
                name="rain",
                summary="moderate rain, puddles",
                rain_mm_h=4.0,
                wetness=0.85,
                puddles=0.12,
                visibility_m=2000.0,
                cloud_cover=1.0,
                grip=WET_GRIP,
                hurry=_RAIN_HURRY,
                benches=0.0,
            ),
            Weather(
                name="heavy_rain",
                summary="heavy rain, large puddles, drops on the lens",
                rain_mm_h=20.0,
                wetness=1.0,
                puddles=0.25,
                visibility_m=500.0,
                cloud_cover=1.0,
                grip=WET_GRIP,
                hurry=_RAIN_HURRY,
                benches=0.0,
                children=0.5,
            ),
            Weather(name="fog", summary="dense fog", visibility_m=70.0, cloud_cover=1.0),
            Weather(
                name="low_sun",
                summary="sun at 7 degrees through thin fog",
                visibility_m=250.0,
                fog_top_m=14.0,
                cloud_cover=0.1,
                sun_deg=7.0,
            ),
            Weather(
                name="snow",
                summary="snowfall on trodden snow",
                snow_mm_h=1.5,
                snow=0.9,
                visibility_m=500.0,
                cloud_cover=1.0,
                grip=SNOW_GRIP,
                benches=0.0,
            ),
            Weather(
                name="dusk",
                summary="sun at the horizon, lamps on, dry",
                cloud_cover=0.3,
                sun_deg=-2.5,
                benches=0.5,
            ),
            Weather(
                name="night",
                summary="dark, lamps on, dry",
                cloud_cover=0.2,
                sun_deg=_NIGHT_DEG,
                benches=_OUT_AT_NIGHT,
                children=_OUT_AT_NIGHT,
            ),
            Weather(
                name="rainy_night",
                summary="dark, lamps on, rain, puddles",
                rain_mm_h=6.0,
                wetness=1.0,
                puddles=0.2,
                visibility_m=900.0,
                cloud_cover=1.0,
                sun_deg=_NIGHT_DEG,
                grip=WET_GRIP,
                hurry=_RAIN_HURRY,
                benches=0.0,
                children=_OUT_AT_NIGHT,
            ),
        )
    }
)
"""Every weather by name."""


def weather_called(name: str) -> Weather:
    """Return the weather with a name. Raises SpecError with the valid names.

    >>> weather_called("rain").grip
    0.6
    """
    if fault := weather_fault(name):
        raise SpecError(fault)
    return WEATHERS[name]


def weather_fault(name: str) -> str:
    """Return the error of a weather's name; "" if it is valid."""
    if name in WEATHERS:
        return ""
    valid = [*WEATHERS]
    return (
        f"unknown weather '{name[:40]}'. Valid choices: {listed(name, valid)}."
        f"{nearest(name, valid)}"
    )


def direction_at(elevation_deg: float, east: float, north: float) -> tuple[float, float, float]:
    """Return the unit vector towards the sun at an elevation.

    east, north: horizontal direction of the sun; south if both are 0
    """
    flat = math.hypot(east, north)
    east, north = (east / flat, north / flat) if flat > 1e-9 else (0.0, -1.0)
    up = math.radians(elevation_deg)
    return math.cos(up) * east, math.cos(up) * north, math.sin(up)
