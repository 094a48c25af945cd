"""Choice of a building's style, wall, roof, windows and ground floor."""

from __future__ import annotations

import zlib
from typing import NamedTuple

import numpy as np

from cosim.place.street_map import StreetMap
from physics.street.buildings import Building
from physics.street.placement import street_style
from physics.textures.facades import (
    BAY_VARIANTS,
    FRONTS_BY_NAME,
    STREET_STYLES,
    WALL_STYLES,
    Front,
    WallStyle,
)

WINDOW_WALL_MIN_M = 2.2
"""Smallest width in metres of a wall with windows."""


class BuildingAppearance(NamedTuple):
    """Appearance of one building.

    wall, roof: names of texture layers
    upper: style of the upper storeys
    number: variant of the bays
    front: ground floor
    first_door: index of the first bay with a door
    tint: sRGB colour of the wall, None for the layer's own
    chance: two random bytes for the shader
    """

    wall: str
    roof: str
    upper: str
    number: int
    front: Front
    first_door: int
    tint: tuple[float, float, float] | None
    chance: tuple[int, int]


def wall_style_of(building: Building, street_map: StreetMap) -> WallStyle:
    """Return the style of a building, chosen by its name among the styles of its street."""
    strip = street_map.strips.get(building.id.removeprefix("building:").rpartition(":")[0])
    names = STREET_STYLES.get(
        street_style(strip.street_class) if strip is not None else "", STREET_STYLES[""]
    )
    return WALL_STYLES[names[zlib.crc32(f"style:{building.id}".encode()) % len(names)]]


def building_appearance(building: Building, style: WallStyle) -> BuildingAppearance:
    """Return the appearance of a building, drawn from its style by its name."""
    rng = np.random.default_rng(zlib.crc32(building.id.encode()))
    wall, roof, upper = (
        str(rng.choice(style.walls)),
        str(rng.choice(style.roofs)),
        str(rng.choice(style.uppers)),
    )
    number = int(rng.integers(BAY_VARIANTS))
    front = FRONTS_BY_NAME[str(rng.choice(style.fronts))]
    first_door = int(rng.integers(front.every))
    tint = style.tints[int(rng.integers(len(style.tints)))] if style.tints else None
    some, other = rng.integers(0, 256, 2).tolist()
    return BuildingAppearance(wall, roof, upper, number, front, first_door, tint, (some, other))
