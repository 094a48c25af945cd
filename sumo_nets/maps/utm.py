"""UTM: the projection that netconvert gives every OpenStreetMap file."""

from __future__ import annotations

import re

import numpy as np

from cosim.core.geometry import Floats


def utm_zone(proj: str) -> tuple[int, bool] | None:
    """Zone and whether it is a southern one, of a net's `projParameter`; None for any other projection."""
    zone = re.search(r"\+zone=(\d+)\b", proj)
    if "+proj=utm" not in proj or zone is None or not 1 <= int(zone[1]) <= 60:
        return None
    return int(zone[1]), "+south" in proj


def utm_xy(lonlat: Floats, zone: int, south: bool) -> Floats:
    """(N, 2) metres, east and north, of (N, 2) longitudes and latitudes in degrees, WGS 84."""
    from pyproj import Proj  # only who imports a map with houses needs it

    projection = Proj(proj="utm", zone=zone, south=south, ellps="WGS84")
    return np.column_stack(projection(lonlat[:, 0], lonlat[:, 1]))
