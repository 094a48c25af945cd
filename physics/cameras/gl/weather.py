"""Weather of a picture for shaders: what it changes, and the uniform block `Weather`."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import Final

import moderngl
import msgspec
import numpy as np

from cosim.core.clock import Clock
from cosim.core.geometry import Floats
from cosim.spec.scenario import Light
from cosim.spec.weather import Weather, direction_at
from physics.cameras.gl.lamps import Lamps
from physics.cameras.gl.variants import Variant
from physics.cameras.gl.walls import LIT_SHARE
from physics.cameras.gl.weather_shaders import LAMPS_MAX, WEATHER_BINDING
from physics.cameras.sky import Sky, sky_of
from physics.cameras.sun import sun_direction

_CLOCK: Final = Clock()
_ROWS: Final = 64
"""Rows (vec4) of a block, of which 52 are used; graphics cards require aligned starts of blocks."""
_PEOPLE_ROW: Final = 4 + 3 * LAMPS_MAX
_FULL_RAIN_MM_H: Final = 20.0
_FULL_SNOW_MM_H: Final = 2.0
_NIGHT_NOISE: Final = 2.0e-4
"""Sensor noise at night: variance of a pixel per light, where 1 is the white level."""
_SNOW_EXPOSURE: Final = 0.45
"""Relative increase of the exposure on snow, which would otherwise be grey."""
_WET_EXPOSURE: Final = 0.3
"""The same on wet ground, which is darker than dry ground."""
_LIT_BY_HOUR: Final = (
    *((0.0, 0.14), (1.5, 0.06), (4.5, 0.04), (6.5, 0.28), (8.0, 0.35)),
    *((16.0, 0.35), (18.0, 0.45), (21.0, 0.52), (22.5, 0.38), (24.0, 0.14)),
)
"""Share of lit windows by hour; an assumption."""
_GLOW_FROM_PER_M: Final = 0.004
"""Extinction from which fog glows around the sun, 1/m."""


@dataclass(frozen=True, slots=True)
class WeatherLook:
    """Constants of a camera's weather.

    variant: of all programs
    surface, falling, night: rows of the block
    noise: of the sensor
    brightness: of lamps, 0 to 1
    seed: 0 to 1, of drops and noise
    """

    variant: Variant
    surface: tuple[float, float, float, float]
    falling: tuple[float, float, float, float]
    night: tuple[float, float, float, float]
    noise: float
    brightness: float
    seed: float


def weathered(light: Light, weather: Weather) -> Light:
    """Return a light with the clouds and the fog of a weather."""
    fog = [m for m in (light.fog_m, weather.visibility_m) if m is not None]
    cover = light.cloud_cover if weather.cloud_cover is None else weather.cloud_cover
    return msgspec.structs.replace(light, fog_m=min(fog, default=None), cloud_cover=cover)


def weathered_sky(light: Light, weather: Weather, seed: int) -> Sky:
    """Return the sky of a light in a weather."""
    to_sun = None
    if weather.sun_deg is not None:
        east, north, _ = sun_direction(light.hour, light.day_of_year, light.latitude_deg).tolist()
        to_sun = direction_at(weather.sun_deg, east, north)
    return sky_of(weathered(light, weather), seed, to_sun, weather.fog_top_m)


def exposed(weather: Weather) -> float:
    """Return the factor of the exposure on ground that is brighter or darker than dry ground."""
    return 1.0 + _SNOW_EXPOSURE * weather.snow + _WET_EXPOSURE * weather.wetness


def lit_share(hour: float) -> float:
    """Return the share of windows that are lit at an hour of the night."""
    hours, shares = zip(*_LIT_BY_HOUR, strict=True)
    return float(np.interp(hour % 24.0, hours, shares))


def weather_look(
    weather: Weather, sky: Sky, seed: int, shadows: bool, hour: float | None = None
) -> WeatherLook | None:
    """Return what weather and night change in pictures besides the sky; None without a change.

    shadows: shadow maps are drawn
    hour: of a night; None where the weather makes the night, at any hour
    """
    glows = sky.fog_per_m > _GLOW_FROM_PER_M and float(sky.sun_colour.max()) > 0.0
    variant = Variant.NONE
    variant |= Variant.LAMPS if sky.lamps > 0.0 else Variant.NONE
    variant |= Variant.WET if weather.wetness > 0.0 else Variant.NONE
    variant |= Variant.SNOW if weather.snow > 0.0 else Variant.NONE
    if not (variant or weather.precipitates or glows):
        return None
    variant |= Variant.WEATHER | (Variant.SHADOWS if shadows else Variant.NONE)
    share = LIT_SHARE if hour is None else lit_share(hour)
    rain = min(weather.rain_mm_h / _FULL_RAIN_MM_H, 1.0) ** 0.5
    drops = max(0.0, 2.0 * rain - 1.0)
    bloom = 0.03 + 0.10 * sky.lamps * (1.0 + rain)
    # Air scatters the light of lamps towards the eye; rain and snow as the fog of their visibility.
    scattering = sky.lamps * min(0.6 * sky.fog_per_m, 0.02)
    clear = 1.0 if weather.cloud_cover is None else 1.0 - weather.cloud_cover
    return WeatherLook(
        variant,
        (weather.wetness, weather.puddles, weather.snow, share),
        (rain, min(weather.snow_mm_h / _FULL_SNOW_MM_H, 1.0), drops, bloom),
        (scattering, sky.lamps * clear, float(glows), 0.0),
        _NIGHT_NOISE * sky.lamps,
        sky.lamps,
        zlib.crc32(f"weather {seed}".encode()) / 2.0**32,
    )


class WeatherBlocks:
    """Uniform blocks `Weather` of the pictures of a batch, uploaded together."""

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context
        self._rows = np.zeros((0, _ROWS, 4), dtype=np.float32)
        self._buffer: moderngl.Buffer | None = None

    def room(self, count: int) -> None:
        """Ensure space for at least `count` blocks."""
        if count > len(self._rows):
            self.release()
            self._rows = np.zeros((2 * count, _ROWS, 4), dtype=np.float32)
            self._buffer = self._context.buffer(reserve=self._rows.nbytes)

    def put(
        self,
        place: int,
        look: WeatherLook,
        lamps: Lamps | None,
        people: Floats,
        anchor: Floats,
        tick: int,
    ) -> None:
        """Set one block.

        lamps: None without night
        people: (N, 4) feet in world metres and height of those that cast shadows
        """
        rows = self._rows[place]
        count = 0 if lamps is None else len(lamps.at)
        rows[0], rows[1] = look.surface, look.falling
        rows[2] = _CLOCK.time_s(tick), look.seed, look.noise, count
        rows[3] = look.night
        if lamps is not None:
            rows[4:_PEOPLE_ROW] = lamps.rows(anchor, look.brightness).reshape(-1, 4)
        rows[3, 3] = len(people)
        rows[_PEOPLE_ROW : _PEOPLE_ROW + len(people)] = people - (*anchor.tolist(), 0.0, 0.0)

    def upload(self) -> None:
        if self._buffer is not None:
            self._buffer.write(self._rows)

    def bind(self, place: int) -> None:
        """Bind a block, as uploaded last, for later draws."""
        assert self._buffer is not None
        each = self._rows[0].nbytes
        self._buffer.bind_to_uniform_block(WEATHER_BINDING, offset=place * each, size=each)

    def release(self) -> None:
        if self._buffer is not None:
            self._buffer.release()
            self._buffer = None
