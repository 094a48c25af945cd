"""Clear sky by day and at dusk: luminance and colour of every direction."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats

LUMINANCE: Final = np.array([0.2126, 0.7152, 0.0722])
"""Weights of linear sRGB in luminance."""

_XYZ_TO_RGB: Final = np.array(
    [[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]]
)
_PEREZ: Final = {
    "Y": (
        (0.1787, -1.4630),
        (-0.3554, 0.4275),
        (-0.0227, 5.3251),
        (0.1206, -2.5771),
        (-0.0670, 0.3703),
    ),
    "x": (
        (-0.0193, -0.2592),
        (-0.0665, 0.0008),
        (-0.0004, 0.2125),
        (-0.0641, -0.8989),
        (-0.0033, 0.0452),
    ),
    "y": (
        (-0.0167, -0.2608),
        (-0.0950, 0.0092),
        (-0.0079, 0.2102),
        (-0.0441, -1.6537),
        (-0.0109, 0.0529),
    ),
}
_ZENITH: Final = {
    "x": (
        (0.00166, -0.00375, 0.00209, 0.0),
        (-0.02903, 0.06377, -0.03202, 0.00394),
        (0.11693, -0.21196, 0.06052, 0.25886),
    ),
    "y": (
        (0.00275, -0.00610, 0.00317, 0.0),
        (-0.04214, 0.08970, -0.04153, 0.00516),
        (0.15346, -0.26756, 0.06670, 0.26688),
    ),
}
_HAZE: Final = 1.5 * np.array([0.92, 1.01, 1.12])
_LOWEST_RAD: Final = math.radians(3.0)
"""Sun elevation below which the daylight formula is frozen and dimmed to measured twilight."""
_TWILIGHT_DEG: Final = (-18.0, -12.0, -6.0, -4.0, -2.0, 0.0, 3.0)
_TWILIGHT_LOG: Final = (-6.0, -5.0, -2.75, -2.0, -1.25, -0.62, 0.0)
"""Common logarithm of the sky's light relative to that at 3 degrees.

It follows the usual tables of twilight illuminance: about 400 lx at sunset, 3.4 lx at -6 degrees,
0.008 lx at -12.
"""


def clear_sky(ways: Floats, sun: Floats, turbidity: float) -> Floats:
    """Return the radiance of a cloudless sky in directions (..., 3), linear sRGB in kcd/m2.

    Directions below the horizon get the value at the horizon.

    A. J. Preetham, P. Shirley and B. Smits, A practical analytic model for daylight, SIGGRAPH 1999.
    Below 3 degrees of sun elevation, the light is dimmed along the measured twilight and turned
    blue.
    It is red near the point of sunset.
    """
    rise = math.asin(float(np.clip(sun[2], -1.0, 1.0)))
    held = max(rise, _LOWEST_RAD)
    flat = np.array([sun[0], sun[1]]) / max(math.hypot(sun[0], sun[1]), 1e-9)
    at = np.array([math.cos(held) * flat[0], math.cos(held) * flat[1], math.sin(held)])
    theta_sun = 0.5 * math.pi - held
    cos_theta = np.maximum(ways[..., 2], 0.015)
    gamma = np.arccos(np.clip(ways @ at, -1.0, 1.0))
    chi = (4.0 / 9.0 - turbidity / 120.0) * (math.pi - 2.0 * theta_sun)
    zenith = {"Y": (4.0453 * turbidity - 4.9710) * math.tan(chi) - 0.2155 * turbidity + 2.4192}
    for name, rows in _ZENITH.items():
        powers = np.array([theta_sun**3, theta_sun**2, theta_sun, 1.0])
        zenith[name] = float(np.array([turbidity**2, turbidity, 1.0]) @ (np.array(rows) @ powers))
    parts = {}
    for name, coefficients in _PEREZ.items():
        terms = [slope * turbidity + offset for slope, offset in coefficients]
        parts[name] = (
            zenith[name]
            * _perez(terms, cos_theta, gamma)
            / _perez(terms, np.ones(1), np.full(1, theta_sun))
        )
    day = _rgb(parts["x"], parts["y"], parts["Y"])
    degrees = math.degrees(rise)
    # By day, the formula's horizon is pinker and dimmer than in photographs: haze is bright and
    # nearly white.
    white = (day @ LUMINANCE)[..., None] * _HAZE
    share = (
        0.8
        * np.exp(-np.maximum(ways[..., 2:], 0.0) / 0.12)
        * float(np.clip((degrees - 6.0) / 14.0, 0.0, 1.0))
    )
    day = np.asarray(day + share * (white - day))
    dim = 10.0 ** float(np.interp(degrees, _TWILIGHT_DEG, _TWILIGHT_LOG))
    blue = float(np.clip((9.0 - degrees) / 10.0, 0.0, 1.0))
    if blue == 0.0:
        return day
    return np.asarray(dim * (day + blue * (_dusk(ways, at, day) - day)))


def _dusk(ways: Floats, at: Floats, day: Floats) -> Floats:
    """Return a simple fit of civil twilight: blue above, with a warm band over the sun's
    position.
    """
    level = float((day @ LUMINANCE).mean())
    height = np.maximum(ways[..., 2:], 0.0)
    side = 0.5 + 0.5 * (ways[..., :2] @ at[:2])[..., None]
    warm = side**2 * np.exp(-height / 0.16)
    blue = np.array([0.42, 0.58, 1.0]) * (0.55 + 0.6 * np.exp(-height / 0.35))
    return np.asarray(level * (blue * (1.0 - 0.85 * warm) + warm * np.array([2.3, 1.05, 0.50])))


def _perez(
    terms: list[float], cos_theta: NDArray[np.floating], gamma: NDArray[np.floating]
) -> Floats:
    """Evaluate R. Perez's all-weather function (1993) of zenith and sun distance."""
    a, b, c, d, e = terms
    return np.asarray(
        (1.0 + a * np.exp(b / cos_theta)) * (1.0 + c * np.exp(d * gamma) + e * np.cos(gamma) ** 2),
        dtype=float,
    )


def _rgb(x: Floats, y: Floats, luminance: Floats) -> Floats:
    """Convert CIE xyY to linear sRGB, clipped at 0."""
    bright = np.maximum(luminance, 0.0)
    xyz = np.stack([bright * x / y, bright, bright * (1.0 - x - y) / y], axis=-1)
    return np.asarray(np.maximum(xyz @ _XYZ_TO_RGB.T, 0.0))
