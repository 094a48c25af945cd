"""The light of a picture, made from a scenario's light."""

from __future__ import annotations

from dataclasses import dataclass, replace

from cosim.scenario import Light


@dataclass(frozen=True, slots=True)
class Lighting:
    """The light of a picture, linear rgb. to_sun: (3,) unit vector; shadows: how dark, 0 (off) to 1.

    fog_from_m, fog_per_m, fog_most: share of the fog's colour at a distance.
    """

    to_sun: tuple[float, float, float] = (0.36, -0.52, 0.775)
    sun: tuple[float, float, float] = (0.62, 0.59, 0.54)
    sky: tuple[float, float, float] = (0.46, 0.50, 0.56)
    ground: tuple[float, float, float] = (0.26, 0.25, 0.23)
    fog: tuple[float, float, float] = (0.65, 0.72, 0.785)
    zenith: tuple[float, float, float] = (0.13, 0.31, 0.646)
    shadows: float = 1.0
    exposure: float = 1.0
    fog_from_m: float = 20.0
    fog_per_m: float = 1.0 / 110.0
    fog_most: float = 0.85


def lighting_of(light: Light) -> Lighting:
    """What a scenario's light is in a picture."""
    shadows = float(light.shadows) * (1.0 - light.cloud_cover)
    day = Lighting(shadows=shadows, exposure=2.0**light.exposure_ev)
    if light.fog_m is None:
        return day
    return replace(day, fog_from_m=0.0, fog_per_m=0.95 / light.fog_m, fog_most=1.0)
