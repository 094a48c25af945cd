"""What a building shows to its street: its style, and what it draws of it by its name, such as shop
windows."""

from __future__ import annotations

import zlib
from typing import NamedTuple

import numpy as np

from cosim.place.street_map import StreetMap
from physics.street.buildings import Building
from physics.street.placement import street_style
from physics.textures.facades import BAY_VARIANTS, DOORS, STREETS, WALL_STYLES, Front, WallStyle

NARROWEST_FRONT_M = 2.2
"""A narrower wall has no windows."""


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
