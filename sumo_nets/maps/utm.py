"""UTM: the projection that netconvert gives every OpenStreetMap file."""

from __future__ import annotations

import math
import re

import numpy as np

from cosim.core.geometry import Floats

_AXIS_M = 6378137.0
_FLATTENING = 1.0 / 298.257223563
_SCALE = 0.9996
_EASTING_M = 500_000.0
_SOUTHERN_M = 10_000_000.0


def utm_zone(proj: str) -> tuple[int, bool] | None:
    """Zone and whether it is a southern one, of a net's `projParameter`; None for any other projection."""
    zone = re.search(r"\+zone=(\d+)\b", proj)
    if "+proj=utm" not in proj or zone is None or not 1 <= int(zone[1]) <= 60:
        return None
    return int(zone[1]), "+south" in proj


def utm_xy(lonlat: Floats, zone: int, south: bool) -> Floats:
    """(N, 2) metres, east and north, of (N, 2) longitudes and latitudes in degrees, WGS 84.

    The transverse Mercator series of L. Krüger (Konforme Abbildung des Erdellipsoids in der Ebene, 1912) to the third
    order of the third flattening: exact to a millimetre within a zone.
    """
    n = _FLATTENING / (2.0 - _FLATTENING)
    radius_m = _AXIS_M / (1.0 + n) * (1.0 + n**2 / 4.0 + n**4 / 64.0)
    series = (
        n / 2.0 - 2.0 * n**2 / 3.0 + 5.0 * n**3 / 16.0,
        13.0 * n**2 / 48.0 - 3.0 * n**3 / 5.0,
        61.0 * n**3 / 240.0,
    )
    east = np.radians(lonlat[:, 0] - (6.0 * zone - 183.0))
    sine = np.sin(np.radians(lonlat[:, 1]))
    e = 2.0 * math.sqrt(n) / (1.0 + n)
    t = np.sinh(np.arctanh(sine) - e * np.arctanh(e * sine))
    xi, eta = np.arctan2(t, np.cos(east)), np.arctanh(np.sin(east) / np.sqrt(1.0 + t**2))
    x, y = eta.copy(), xi.copy()
    for j, weight in enumerate(series, 1):
        x += weight * np.cos(2 * j * xi) * np.sinh(2 * j * eta)
        y += weight * np.sin(2 * j * xi) * np.cosh(2 * j * eta)
    scale = _SCALE * radius_m
    return np.column_stack([_EASTING_M + scale * x, (_SOUTHERN_M if south else 0.0) + scale * y])
