"""Sun, sky light, clouds, fog and exposure of a scenario's light, as values for a camera.

Radiance is linear sRGB; 1 is a white matt surface that faces the sun outside the air. A camera
draws

    L = albedo * (ambient(n) + sun_colour * max(0, n . sun) * lit)
    L = mix(fog_colour, L, exp(-fog_per_m * distance))
    pixel = sRGB(filmic(L * exposure))

By day exposure is metered on the ground of a street.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cosim.core.cache import mapped_arrays, sources_hash
from cosim.core.geometry import Floats
from cosim.core.state import write_protect
from cosim.spec.scenario import Light
from physics.cameras.clearsky import LUMINANCE, clear_sky
from physics.cameras.clouds import clouded
from physics.cameras.hdri import brightest, read_hdri
from physics.cameras.sun import sun_direction, transmittance
from physics.textures import noise

HORIZON_FADE: Final = 0.06
"""Sine of the angle over which the horizon fades into the ground below it."""
SKY_SIZE: Final = (256, 512)
"""Rows and columns of a procedural sky."""
TURBIDITY: Final = 3.0
GROUND_ALBEDO: Final = 0.2
HOUSES: Final = 0.4
"""Share of the sky over a street hidden by houses and trees, cosine-weighted.

It assumes a street 1.5 times as wide as its houses are high. A photographed sky includes its own
houses.
"""
HOUSE_ALBEDO: Final = 0.4

_FULL_KLX: Final = 128.0
_CLEAR_M: Final = 30_000.0
FOG_TOP_M: Final = 60.0
_ADAPTED: Final = 0.85
"""Exponent of the light that exposure compensates; cameras and eyes do not fully adapt to
darkness.
"""
_KEY: Final = 0.85
_GROUND_KEY: Final = 0.68
"""Brightness of the ground by day, where exposure is metered on the lower half of a picture."""
_IN_SUN: Final = 0.5
"""Share of the ground of a street that the sun reaches, for metering."""
STREET_LAMPLIGHT: Final = 2.2e-4 * np.array([1.0, 0.82, 0.62])
"""Light of a lamp-lit street at night, some 28 lx."""
_NIGHT: Final = 2.2e-4 * np.array([0.62, 0.72, 1.0])
"""Radiance scale of the glow of a city's sky."""

_MADE_BY: Final = sources_hash(Path(__file__).parent, Path(noise.__file__).parent)

_Image = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Sky:
    """Light on a scene. Arrays are write-protected.

    sun: (3,) unit vector towards the sun, x east, y north, z up
    sun_colour: (3,), 0 when the sun is below the horizon or covered
    ambient: (3, 3) radiance of a white surface that faces up, sideways, down, without the sun
    radiance: (H, 2H, 3) float32 equirectangular picture
    fog_per_m: extinction per metre
    lamps: 0 by day to 1 at night
    shadows: the sun casts shadows
    scan_exposure: exposure of generated scans, whose colours belong to maps of a frozen suite

    Row 0 of `radiance` is the zenith, the middle column looks east, and right is clockwise:
    u = 0.5 - atan2(y, x) / 2 pi, v = 0.5 - asin(z) / pi.
    """

    sun: Floats
    sun_colour: Floats
    ambient: Floats
    radiance: _Image
    fog_colour: Floats
    fog_per_m: float
    exposure: float
    lamps: float
    shadows: bool
    scan_exposure: float


@lru_cache(maxsize=8)
def sky_of(
    light: Light,
    seed: int = 0,
    to_sun: tuple[float, float, float] | None = None,
    fog_top_m: float = FOG_TOP_M,
) -> Sky:
    """Compute the sky of a light.

    seed: of the clouds
    to_sun: direction of the sun in place of that of the light's hour
    fog_top_m: height of the fog over the ground

    The sky of a scenario's default light is baked.
    Raises SpecError naming a broken picture of the user's.
    """
    if light != Light() or to_sun is not None:
        return _photographed(light) if light.hdri else _procedural(light, seed, to_sun, fog_top_m)

    def make() -> dict[str, NDArray[Any]]:
        return {
            field: np.asarray(value) for field, value in asdict(_procedural(light, seed)).items()
        }

    kept = mapped_arrays(f"sky-{seed}", _MADE_BY, make)
    sky: dict[str, Any] = {
        f: np.asarray(value) if value.size > 1 else value.item() for f, value in kept.items()
    }
    return Sky(**sky)


@lru_cache(maxsize=2)
def directions(rows: int) -> Floats:
    """Return (rows, 2 rows, 3) unit vectors of an equirectangular picture's pixels,
    write-protected."""
    rise = (0.5 - (np.arange(rows) + 0.5) / rows)[:, None] * math.pi
    turn = (0.5 - (np.arange(2 * rows) + 0.5) / (2 * rows))[None, :] * 2.0 * math.pi
    flat = np.cos(rise)
    ways = np.stack([flat * np.cos(turn), flat * np.sin(turn), np.sin(rise) + 0.0 * turn], axis=-1)
    return write_protect(ways)


def irradiance(radiance: NDArray[np.floating], towards: Floats) -> Floats:
    """Return (3,) radiance of a white matt surface facing `towards`.

    radiance: equirectangular (H, 2H, 3) picture that lights it
    """
    rows = len(radiance)
    ways = directions(rows)
    solid = (math.pi / rows) ** 2 * np.cos((0.5 - (np.arange(rows) + 0.5) / rows) * math.pi)
    weight = np.maximum(ways @ np.asarray(towards, dtype=float), 0.0) * solid[:, None] / math.pi
    return np.asarray(np.tensordot(weight, radiance.astype(float), axes=2))


def _procedural(
    light: Light,
    seed: int,
    to_sun: tuple[float, float, float] | None = None,
    fog_top_m: float = FOG_TOP_M,
) -> Sky:
    sun = sun_direction(light.hour, light.day_of_year, light.latitude_deg)
    if to_sun is not None:
        sun = np.array(to_sun)
    rise = math.asin(float(np.clip(sun[2], -1.0, 1.0)))
    ways = directions(SKY_SIZE[0])
    beam = transmittance(rise, TURBIDITY)
    clear = clear_sky(ways, sun, TURBIDITY) / (_FULL_KLX / math.pi)
    sky, seen = clouded(clear, ways, sun, beam, light.cloud_cover, seed)
    fog_per_m = -math.log(0.05) / (light.fog_m if light.fog_m is not None else _CLEAR_M)
    foggy_per_m = fog_per_m if light.fog_m is not None else 0.0
    sky, beam = _fogged(sky, ways, sun, beam * seen, foggy_per_m, fog_top_m)
    lamps = float(np.clip(0.5 - math.degrees(rise) / 8.0, 0.0, 1.0))
    sky += lamps * _NIGHT * (0.05 + 0.16 * np.exp(-np.maximum(ways[..., 2:], 0.0) / 0.25))
    return _assembled(light, sun, beam, sky, lamps, fog_per_m)


def _fogged(
    sky: Floats, ways: Floats, sun: Floats, beam: Floats, per_m: float, top_m: float
) -> tuple[Floats, Floats]:
    """Attenuate sky and sun by a layer of fog.

    Most of the attenuated light still arrives, from all directions.
    """
    if per_m == 0.0:
        return sky, beam
    left = np.exp(-per_m * top_m / np.maximum(ways[..., 2:], 0.02))
    through = math.exp(-per_m * top_m / max(float(sun[2]), 0.05))
    up = irradiance(np.where(ways[..., 2:] > 0.0, sky, 0.0), np.array([0.0, 0.0, 1.0]))
    grey = 0.75 * (up + (1.0 - through) * beam * max(float(sun[2]), 0.0))
    grey = 0.6 * float(grey @ LUMINANCE) + 0.4 * grey
    return left * sky + (1.0 - left) * grey, beam * through


def _assembled(
    light: Light, sun: Floats, beam: Floats, sky: Floats, lamps: float, fog_per_m: float
) -> Sky:
    ways = directions(len(sky))
    above = ways[..., 2:] > 0.0
    up = irradiance(np.where(above, sky, 0.0), np.array([0.0, 0.0, 1.0])) + lamps * STREET_LAMPLIGHT
    ground = GROUND_ALBEDO * (up + beam * max(float(sun[2]), 0.0))
    horizon = _horizon(sky, len(sky) // 2)
    near = np.exp(-np.maximum(-ways[..., 2:], 0.0) / HORIZON_FADE)
    floor = sky if light.hdri else ground + (horizon - ground) * near
    whole = np.where(above, sky, floor).astype(np.float32)
    compass = ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0])
    side = (
        np.mean([irradiance(whole, np.array(way)) for way in compass], axis=0)
        + 0.7 * lamps * STREET_LAMPLIGHT
    )
    glare = _disc(ways, sun, beam)
    over = (
        up
        if light.hdri
        else (1.0 - HOUSES) * up + HOUSES * HOUSE_ALBEDO * (side + _on_walls(sun, beam))
    )
    ambient = np.stack([over, side, ground])
    direct = beam * max(float(sun[2]), 0.0)
    # Metered light: by day on the ground of a street, at night also on the sky over it.
    bright = float((up + direct + 0.5 * horizon) @ LUMINANCE)
    below = float((over + _IN_SUN * direct) @ LUMINANCE)
    metered = [
        key * max(one, 1e-5) ** -_ADAPTED for key, one in ((_GROUND_KEY, below), (_KEY, bright))
    ]
    exposure = 2.0**light.exposure_ev * (metered[0] + lamps * (metered[1] - metered[0]))
    whole += np.where(above, glare, 0.0).astype(np.float32)
    for array in (sun, beam, ambient, whole, horizon):
        array.flags.writeable = False
    shadows = light.shadows and float(beam @ LUMINANCE) > 0.02
    seen = fog_per_m, exposure, lamps, shadows, 2.0**light.exposure_ev * metered[1]
    return Sky(sun, beam, ambient, whole, horizon, *seen)


def _on_walls(sun: Floats, beam: Floats) -> Floats:
    """Return (3,) sunlight on a wall, averaged over all wall orientations."""
    up = max(float(sun[2]), 0.0)
    return (
        np.asarray(beam * math.sqrt(max(1.0 - up * up, 0.0)) / math.pi) if up > 0.0 else np.zeros(3)
    )


def _horizon(sky: Floats, row: int) -> Floats:
    """Return (3,) mean colour of the sky just over the horizon."""
    return np.asarray(sky[row - max(1, len(sky) // 40) : row].mean(axis=(0, 1)), dtype=float)


def _disc(ways: Floats, sun: Floats, beam: Floats) -> Floats:
    """Return the visible glare of the sun.

    Its light is `sun_colour` and not part of the ambient.
    """
    apart = np.arccos(np.clip(ways @ sun, -1.0, 1.0))[..., None]
    return beam * (30.0 * np.exp(-((apart / 0.018) ** 2)) + 0.6 * np.exp(-apart / 0.10))


def _photographed(light: Light) -> Sky:
    """Load the user's picture as a sky, scaled so that a white horizontal surface has radiance
    1.
    """
    picture = read_hdri(light.hdri)
    sun, spot, rest = brightest(picture, directions(len(picture)))
    up = irradiance(
        np.where(directions(len(rest))[..., 2:] > 0.0, rest, 0.0), np.array([0.0, 0.0, 1.0])
    )
    scale = 1.0 / max(float((up + spot * max(float(sun[2]), 0.0)) @ LUMINANCE), 1e-9)
    fog_per_m = -math.log(0.05) / (light.fog_m if light.fog_m is not None else _CLEAR_M)
    beam = spot * scale
    sky = rest.astype(float) * scale
    if light.fog_m is not None:
        sky, beam = _fogged(sky, directions(len(sky)), sun, beam, fog_per_m, FOG_TOP_M)
    return _assembled(light, sun, beam, sky, 0.0, fog_per_m)
