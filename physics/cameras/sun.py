"""Position of the sun, and its light after the atmosphere."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from cosim.core.geometry import Floats

WAVELENGTHS_UM: Final = (0.610, 0.550, 0.465)
"""Representative wavelengths of the red, green and blue of sRGB, micrometres."""


def declination_rad(day_of_year: float) -> float:
    """Return the sun's declination: P. I. Cooper, Solar Energy 12 (1969).

    The formula is 23.45 deg sin(360/365 (284 + n)).
    """
    return math.radians(23.45) * math.sin(2.0 * math.pi * (284.0 + day_of_year) / 365.0)


def sun_direction(hour: float, day_of_year: float, latitude_deg: float) -> Floats:
    """Return the (3,) unit vector towards the sun, x east, y north, z up; below the ground at
    night.

    hour: solar time, 15 degrees of hour angle each

    J. A. Duffie and W. A. Beckman, Solar Engineering of Thermal Processes, chapter 1.
    """
    turn = math.radians(15.0 * (hour - 12.0))
    tilt = declination_rad(day_of_year)
    place = math.radians(latitude_deg)
    east = -math.cos(tilt) * math.sin(turn)
    north = math.cos(place) * math.sin(tilt) - math.sin(place) * math.cos(tilt) * math.cos(turn)
    up = math.sin(place) * math.sin(tilt) + math.cos(place) * math.cos(tilt) * math.cos(turn)
    return np.array([east, north, up])


def air_mass(elevation_rad: float) -> float:
    """Return the relative air mass towards the sun, 1 at the zenith.

    F. Kasten and A. T. Young, Applied Optics 28 (1989).
    """
    degrees = max(math.degrees(elevation_rad), 0.0)
    return 1.0 / (math.sin(math.radians(degrees)) + 0.50572 * math.pow(degrees + 6.07995, -1.6364))


def transmittance(elevation_rad: float, turbidity: float) -> Floats:
    """Return the (3,) share of the sun's red, green and blue that clear air transmits.

    Rayleigh and aerosol terms as in A. J. Preetham, P. Shirley and B. Smits, SIGGRAPH 1999,
    appendix 1.
    The last degree to the horizon fades out: half of the disc is gone at 0.
    """
    mass = air_mass(elevation_rad)
    haze = 0.04608 * turbidity - 0.04586
    thick = [0.008735 * um**-4.08 + haze * um**-1.3 for um in WAVELENGTHS_UM]
    risen = min(max(0.5 + math.degrees(elevation_rad), 0.0), 1.0)
    return risen * np.exp(-mass * np.array(thick))
