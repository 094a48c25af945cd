"""Appearance of people: body, clothes and colours as a fixed function of name and age."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from hashlib import blake2b
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.core.state import Age
from cosim.people.gait import is_woman
from physics.people.body import COATS
from physics.people.cloth_maps import BEARDS, layer
from physics.people.families import Family
from physics.people.figure import Companion
from physics.people.wardrobe import (
    ALL,
    CLOTHES,
    PALETTES,
    Clothes,
    Season,
    with_companion,
)

_SKINS: Final = ("f0cdb6", "e6b898", "d9a582", "c99270", "b07c5a", "96674a", "7c5340", "64432f")
_HAIRS: Final = ("221c19", "33261f", "4e3626", "6d4c33", "96744c", "c3a26c", "7b4028", "403f41")
_GREYS: Final = ("8f8f8f", "b8b6b2", "d8d6d2", "6e6d6c")
_CAPS: Final = ("2c3f66", "b3403a", "3a3d44", "d8d2c4", "4f6b4a", "7a5a86")
_METALS: Final = ("9a9da3", "33363c", "b0413a", "2f5f8f", "3f7d5a")
_FURS: Final = ("c9a26b", "5a4030", "2b2724", "d8d0c4", "8a6a48")
_SHOES: Final = ("2a2725", "5b4030", "e6e4df", "43464c", "8a6b4a", "8c4a44", "d9d5cc")
_BAGS: Final = ("4a3a2f", "3a3d42", "84483e", "3f5f63", "a88f66", "5a5074", "c8b49f", "4a5a45")

_Colour = tuple[int, int, int]


_COMPANIONS: Final[tuple[tuple[Companion, int], ...]] = (
    ("dog", 15),
    ("pram", 10),
    ("bicycle", 10),
    ("wheelchair", 6),
)
"""Objects that people push or lead, and how many of 1000 people do."""
_UMBRELLAS: Final = 600
"""How many of 1000 people hold an umbrella in rain."""


@dataclass(frozen=True, slots=True)
class Look:
    """Appearance of a person.

    outfit: row of ALL
    colours: (coats, 3) uint8, in the order of COATS
    patterns: (coats,) uint8, rows of the map of each surface, from `cloth_maps`
    girth_m: offset of the surface by body fat, metres
    """

    outfit: int
    colours: NDArray[np.uint8]
    patterns: NDArray[np.uint8]
    girth_m: float


def family_of(name: str, age: int) -> Family:
    """Return the skeleton family of the person of this `Age`."""
    if age == Age.CHILD:
        return "child"
    if age == Age.ELDERLY:
        return "elder"
    return "woman" if is_woman(name) else "man"


@lru_cache(maxsize=65536)
def look_of(
    name: str,
    age: int,
    seed: int = 0,
    season: Season = "mild",
    rain: bool = False,
    crowd: bool = True,
) -> Look:
    """Return the look of the person of this `Age` called `name`.

    seed: changes clothes and colours, but not stature
    season: of the clothes
    rain: most people hold an umbrella
    crowd: some people push or lead something; else their hands are free for gestures
    """
    family = family_of(name, age)
    companion = companion_of(name, seed, rain, crowd)
    choices = [one for one in CLOTHES if season in one.seasons and _fits(one, family, name)]
    choices = [one for one in choices if with_companion(one.body, companion)] or choices
    clothes = choices[_draw(name, seed, "outfit") % len(choices)]
    outfit = with_companion(clothes.body, companion) or clothes.outfit
    colours = _colours(name, seed, family, clothes)
    table = np.array([colours[coat] for coat in COATS], dtype=np.uint8)
    patterns = _patterns(name, seed, clothes)
    for array in (table, patterns):
        array.flags.writeable = False
    girth_m = 0.022 * (_draw(name, seed, "girth") % 1001 / 1000.0) - 0.006
    return Look(ALL.index(outfit), table, patterns, girth_m)


def companion_of(name: str, seed: int = 0, rain: bool = False, crowd: bool = True) -> Companion:
    """Return the object that a person pushes, leads or holds, or "" for none.

    rain: most of those with free hands hold an umbrella, in the left hand
    crowd: people may push or lead something, too
    """
    draw = _draw(name, seed, "companion") % 1000
    for companion, share in _COMPANIONS if crowd else ():
        if draw < share:
            return companion
        draw -= share
    if rain and _draw(name, seed, "umbrella") % 1000 < _UMBRELLAS:
        return "umbrella"
    return ""


def _colours(name: str, seed: int, family: Family, clothes: Clothes) -> dict[str, _Colour]:
    """Return the colour of each surface."""
    skin = _pick(_SKINS, name, seed, "skin")
    red, green, blue = skin
    suit = clothes.tops == clothes.bottoms == "suits"
    inner = "light" if clothes.top in ("open", "buttons", "zip") else "bright"
    return {
        "skin": skin,
        "lips": (int(red * 0.86), int(green * 0.62), int(blue * 0.62)),
        "hair": _pick(_GREYS if family == "elder" else _hairs(skin), name, seed, "hair"),
        "white": (206, 200, 194),
        "dark": (34, 28, 26),
        "top": _pick(PALETTES[clothes.tops], name, seed, "top"),
        "bottom": _pick(PALETTES[clothes.bottoms], name, seed, "top" if suit else "bottom"),
        "shoes": _pick(_SHOES, name, seed, "shoes"),
        "bag": _pick(_BAGS, name, seed, "bag"),
        "cap": _pick(_CAPS, name, seed, "cap"),
        "trim": _pick(PALETTES[inner], name, seed, "trim"),
        "metal": _pick(_METALS, name, seed, "metal"),
        "fur": _pick(_FURS, name, seed, "fur"),
    }


def _patterns(name: str, seed: int, clothes: Clothes) -> NDArray[np.uint8]:
    """Return (coats,) maps: cloths, and skin with the beards of some men."""
    outfit = clothes.outfit
    beard = 0
    if outfit.build.woman < 0.5 and outfit.family in ("man", "elder"):
        beard = max(0, _draw(name, seed, "beard") % (BEARDS + 2) - 2)
    maps = {
        "top": layer("top", clothes.top, outfit.legs == "coat"),
        "bottom": layer("bottom", clothes.bottom, outfit.legs == "skirt"),
        "skin": layer("skin", beard=beard),
    }
    return np.array([maps[c] if c in maps else layer(c) for c in COATS], dtype=np.uint8)


def _hairs(skin: _Colour) -> tuple[str, ...]:
    """Return the hair colours for a skin colour: darker skin has darker hair."""
    return _HAIRS if skin[0] > 0xB0 else _HAIRS[:3]


def _fits(clothes: Clothes, family: Family, name: str) -> bool:
    """Return whether clothes suit the person. Old men and women share a family, not clothes."""
    outfit = clothes.outfit
    if outfit.family != family:
        return False
    return family != "elder" or (outfit.build.woman > 0.5) == is_woman(name)


def _pick(palette: tuple[str, ...], name: str, seed: int, what: str) -> _Colour:
    """Pick a colour of a palette and vary its brightness slightly."""
    draw = _draw(name, seed, what)
    shade = 0.88 + 0.24 * (draw >> 48 & 0xFF) / 255.0
    code = palette[draw % len(palette)]
    red, green, blue = (min(int(int(code[i : i + 2], 16) * shade), 255) for i in (0, 2, 4))
    return red, green, blue


def _draw(name: str, seed: int, what: str) -> int:
    """Return 64 bits, independent for each person, seed and purpose.

    A checksum such as CRC32 is not: of nearly equal strings its low bits are correlated.
    """
    return int.from_bytes(blake2b(f"{what} {seed} {name}".encode(), digest_size=8).digest(), "big")
