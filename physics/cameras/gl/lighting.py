"""Light of a picture for shaders, computed from a sky."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import moderngl
import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from physics.cameras.sky import STREET_LAMPLIGHT, Sky

HAZE_FROM_M: Final = 20.0
HAZE_PER_M: Final = 1.0 / 110.0
HAZE_MOST: Final = 0.85
"""Maximum share of haze on distant objects, in any weather and in addition to fog.

It hides the edge of the drawn world, as in the bullet camera.
"""


LAMPS_SPREAD: Final = 0.55
"""Share of the lamplight of `physics.cameras.sky` that comes from single lamps."""
NIGHT_EXPOSURE: Final = 2.4
"""Relative increase of the exposure in a street with lamps."""
_ABOVE: Final = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True)
class Lighting:
    """Linear radiances, as in physics.cameras.sky.

    to_sun: (3,)
    up, side, down: (3,) ambient of a white surface that faces this direction
    horizon: (N, 3) the sky just over the horizon, columns as in physics.cameras.sky
    lamps: 0 by day to 1 at night
    shadows: the sun casts shadows
    haze: distant objects fade into the fog
    """

    to_sun: Floats
    sun: Floats
    up: Floats
    side: Floats
    down: Floats
    fog: Floats
    horizon: Floats
    fog_per_m: float
    exposure: float
    lamps: float
    shadows: bool
    haze: bool = True

    def seen(self, heading_rad: float, half_angle_rad: float) -> Lighting:
        """Return the light of a picture whose fog has the colour of the sky behind it."""
        columns = len(self.horizon)
        turn = math.pi - 2.0 * math.pi * (np.arange(columns) + 0.5) / columns - heading_rad
        aside = np.abs((turn + math.pi) % (2.0 * math.pi) - math.pi)
        behind = aside < max(min(half_angle_rad, 0.5 * math.pi), 2.0 * math.pi / columns)
        return replace(self, fog=self.horizon[behind].mean(axis=0))

    def rows(self) -> list[tuple[float, ...]]:
        """Return the light's rows of the uniform block `Scene`, one vec4 each."""
        return [
            (*self.to_sun, float(self.shadows)),
            (*self.sun, self.exposure),
            (*self.side, self.lamps),
            (*(0.5 * (self.up - self.down)), 0.0),
            (*(0.5 * (self.up + self.down) - self.side), 0.0),
            (*self.fog, self.fog_per_m),
            (HAZE_FROM_M, HAZE_PER_M, HAZE_MOST if self.haze else 0.0, 0.0),
        ]


def lighting_of(
    sky: Sky, haze: bool = True, contact: bool = False, bright: float = 1.0
) -> Lighting:
    """Convert a sky to shader values.

    haze: of distant objects
    contact: without sun, moving objects darken the ground right below them: the shadow maps are
        then seen from straight above
    bright: factor of the exposure
    """
    up, side, down = sky.ambient
    if sky.lamps > 0.0:
        # Lamps light the street one by one; this is what its walls and ground reflect of them.
        spread = LAMPS_SPREAD * sky.lamps * STREET_LAMPLIGHT
        up, side = (np.maximum(one - spread, 0.05 * one) for one in (up, side))
    contact = contact and not sky.shadows
    return Lighting(
        _ABOVE if contact else sky.sun,
        sky.sun_colour,
        up,
        side,
        down,
        sky.fog_colour,
        _horizon(sky),
        sky.fog_per_m,
        sky.exposure * bright * (1.0 + NIGHT_EXPOSURE * sky.lamps),
        sky.lamps,
        sky.shadows or contact,
        haze,
    )


def _horizon(sky: Sky) -> Floats:
    rows = len(sky.radiance)
    around = sky.radiance[rows // 2 - max(1, rows // 40) : rows // 2].mean(axis=0, dtype=float)
    # Exclude the sun from the haze colour.
    limit = 2.0 * np.median(around, axis=0)
    return np.asarray(np.minimum(around, limit))


def sky_texels(radiance: NDArray[np.float32]) -> NDArray[np.float16]:
    """Return the texels of an equirectangular picture (H, W, 3)."""
    return np.ascontiguousarray(np.minimum(radiance, 6.0e4).astype(np.float16))


def sky_texture(context: moderngl.Context, radiance: NDArray[np.float32]) -> moderngl.Texture:
    """Upload an equirectangular picture (H, W, 3) as a texture."""
    rows, columns, _ = radiance.shape
    texture = context.texture(
        (columns, rows),
        3,
        sky_texels(radiance).tobytes(),
        dtype="f2",
        alignment=2,
    )
    texture.filter = moderngl.LINEAR, moderngl.LINEAR
    texture.repeat_x = True
    texture.repeat_y = False
    return texture
