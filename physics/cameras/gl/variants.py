"""Variants of all programs: what the light of a picture consists of."""

from __future__ import annotations

from enum import IntFlag


class Variant(IntFlag):
    """Flags of a program. Equal to a bool: True reads the shadow maps, False does not.

    SHADOWS: `show` reads the shadow maps
    WEATHER: colours are linear radiances, toned by `physics.cameras.gl.air`; fog glows at the sun
    LAMPS: street lamps and headlights light the surfaces
    WET, SNOW: surfaces are wet, or covered by snow
    LAYERS: one draw fills many pictures, each a layer of an array texture
    """

    NONE = 0
    SHADOWS = 1
    WEATHER = 2
    LAMPS = 4
    WET = 8
    SNOW = 16
    LAYERS = 32

    @property
    def defines(self) -> str:
        """Lines that select the variant in a shader."""
        return "".join(f"#define {one.name}\n" for one in Variant if one and one in self)
