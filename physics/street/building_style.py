"""What a building shows to its street: its style, and what it draws of it by its name, such as shop
windows."""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from cosim.place.street_map import StreetMap
from physics.street.buildings import Building
from physics.street.placement import street_style
from physics.textures.facade_canvas import BAY_M
from physics.textures.facades import BAY_VARIANTS, DOORS, STREETS, WALL_STYLES, Front, WallStyle

NARROWEST_FRONT_M = 2.2
"""A narrower wall has no windows."""
_DISPLAYS = ("shop-window", "cafe")
"""Bays between the doors of a front that are large windows with something behind them to look
at."""


class Face(NamedTuple):
    """What a building drew: names of the layers of its wall, roof and upper storeys, the number of
    its bays' variant, its ground floor, and which of its bays has the first door. tint: of the
    wall, None for its own colour."""

    wall: str
    roof: str
    upper: str
    number: int
    front: Front
    first_door: int
    tint: tuple[float, float, float] | None
    chance: tuple[int, int]


class ShopWindow(NamedTuple):
    """The middle of a shop window on the ground, in metres; heading_rad: from the street straight
    into it."""

    x_m: float
    y_m: float
    heading_rad: float


def style_of(building: Building, street_map: StreetMap) -> WallStyle:
    """What a building looks like: drawn by its name from those that its street has."""
    strip = street_map.strips.get(building.id.removeprefix("building:").rpartition(":")[0])
    names = STREETS.get(street_style(strip.street_class) if strip is not None else "", STREETS[""])
    return WALL_STYLES[names[zlib.crc32(f"style:{building.id}".encode()) % len(names)]]


def face_of(building: Building, style: WallStyle) -> Face:
    """What a building of a style draws by its name."""
    rng = np.random.default_rng(zlib.crc32(building.id.encode()))
    wall, roof, upper = (
        str(rng.choice(style.walls)),
        str(rng.choice(style.roofs)),
        str(rng.choice(style.uppers)),
    )
    number = int(rng.integers(BAY_VARIANTS))
    front = DOORS[str(rng.choice(style.fronts))]
    first_door = int(rng.integers(front.every))
    tint = style.tints[int(rng.integers(len(style.tints)))] if style.tints else None
    some, other = rng.integers(0, 256, 2).tolist()
    return Face(wall, roof, upper, number, front, first_door, tint, (some, other))


def shop_windows(building: Building, street_map: StreetMap) -> Iterator[ShopWindow]:
    """The shop windows of a building: the bays without a door of its ground floor, where that is a
    shop or a cafe."""
    face = face_of(building, style_of(building, street_map))
    if face.front.between not in _DISPLAYS:
        return
    for x0, y0, x1, y1 in (
        building.walls if building.outline is not None else [_street_wall(building)]
    ):
        width = math.hypot(x1 - x0, y1 - y0)
        if width < NARROWEST_FRONT_M:
            continue
        count = max(round(width / BAY_M), 1)
        into = math.atan2(x1 - x0, -(y1 - y0))  # the outside is to the right of the wall
        for k in range(count):
            if k % face.front.every != face.first_door:
                share = (k + 0.5) / count
                yield ShopWindow(x0 + share * (x1 - x0), y0 + share * (y1 - y0), into)


def _street_wall(building: Building) -> tuple[float, float, float, float]:
    """The wall of a box that looks to the street, which is to its right."""
    cos, sin = math.cos(building.heading_rad), math.sin(building.heading_rad)
    half, away = 0.5 * building.size_m[0], 0.5 * building.size_m[1]
    x = building.x_m + away * sin
    y = building.y_m - away * cos
    return x - half * cos, y - half * sin, x + half * cos, y + half * sin
