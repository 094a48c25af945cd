"""Appearance of people: body, clothes and colours as a fixed function of name and age."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.core.state import Age
from cosim.people.gait import is_woman
from physics.people.body import COATS, Outfit
from physics.people.families import Family
from physics.people.figure import Build

_MAN: Final = Build()
_STOUT: Final = Build(belly_m=0.045, limb=1.08)
_WOMAN: Final = Build(woman=1.0, limb=0.92)
_ROUND: Final = Build(woman=1.0, belly_m=0.025, limb=1.03)
_CHILD: Final = Build(woman=0.3, limb=0.92, head=1.25)
_OLD: Final = Build(woman=0.3, belly_m=0.03, limb=0.96)
_OLD_WOMAN: Final = Build(woman=0.9, belly_m=0.03, limb=0.96)

OUTFITS: Final[dict[str, tuple[Outfit, ...]]] = {
    "man": (
        Outfit("man", _MAN, "trousers", "short", "short"),
        Outfit("man", _MAN, "trousers", "long", "crop", loose_m=0.012, carried="backpack"),
        Outfit("man", _MAN, "coat", "long", "short", loose_m=0.014),
        Outfit("man", _STOUT, "trousers", "long", "short", loose_m=0.008, carried="phone"),
        Outfit("man", _MAN, "shorts", "short", "short", cap=True, bare=True),
        Outfit("man", _STOUT, "trousers", "short", "crop", carried="bag"),
    ),
    "woman": (
        Outfit("woman", _WOMAN, "trousers", "long", "long", carried="bag"),
        Outfit("woman", _WOMAN, "skirt", "short", "bob", bare=True),
        Outfit("woman", _WOMAN, "coat", "long", "long", loose_m=0.010),
        Outfit("woman", _WOMAN, "trousers", "short", "tail", carried="backpack"),
        Outfit("woman", _ROUND, "skirt", "long", "bun", bare=True),
        Outfit("woman", _ROUND, "trousers", "long", "bob", loose_m=0.006, carried="phone"),
    ),
    "child": (
        Outfit("child", _CHILD, "trousers", "short", "short", carried="backpack"),
        Outfit("child", _CHILD, "skirt", "short", "tail", bare=True),
        Outfit("child", _CHILD, "shorts", "short", "short", cap=True, bare=True),
    ),
    "elder": (
        Outfit("elder", _OLD, "trousers", "long", "crop", cap=True, loose_m=0.012),
        Outfit(
            "elder", _OLD_WOMAN, "skirt", "long", "bun", bare=True, loose_m=0.008, carried="bag"
        ),
        Outfit("elder", _OLD, "coat", "long", "crop", loose_m=0.012),
    ),
}
"""Available outfits by family."""

ALL: Final = tuple(outfit for family in OUTFITS.values() for outfit in family)

_SKINS: Final = ("f1cfb8", "e6b898", "d9a37e", "c68c66", "a9714d", "8a573a", "6b4029", "4f2e20")
_HAIRS: Final = ("1a1512", "2c1f18", "4a3122", "6d4a2f", "9a7446", "c7a468", "7b3b22", "3a3a3c")
_GREYS: Final = ("8f8f8f", "b8b6b2", "d8d6d2", "6e6d6c")
_TOPS: Final = (
    "b3312c",
    "24508f",
    "d9b341",
    "2f7d51",
    "e4e2dc",
    "4a356b",
    "26282c",
    "c8708c",
    "7ea7c9",
    "8c9a5b",
    "d77a3c",
    "5a6470",
    "a3b8a0",
    "7a2f3b",
    "efd9c0",
    "3b7f86",
)
_COATS: Final = ("2b2e36", "6b5845", "8a8172", "1f3247", "5c2f2c", "3d4a3a", "b59a77", "47484c")
_BOTTOMS: Final = (
    "26303f",
    "3f5878",
    "40392f",
    "1b1c1e",
    "6d6353",
    "8e8878",
    "54585c",
    "2e3a2f",
    "a79d88",
    "6a3d3a",
)
_SHOES: Final = ("1c1a19", "4b3324", "e6e4df", "35383d", "7a5b3d", "9c2f2a")
_BAGS: Final = ("3a2a1f", "1f2226", "8c3b2e", "2f5d62", "b08d57", "51437a", "d0b49a", "3d5a36")

_Colour = tuple[int, int, int]


@dataclass(frozen=True, slots=True)
class Look:
    """Appearance of a person.

    outfit: row of ALL
    colours: (10, 3) uint8, in the order of COATS
    girth_m: offset of the surface by body fat, metres
    """

    outfit: int
    colours: NDArray[np.uint8]
    girth_m: float


def family_of(name: str, age: int) -> Family:
    """Return the skeleton family of the person of this `Age`."""
    if age == Age.CHILD:
        return "child"
    if age == Age.ELDERLY:
        return "elder"
    return "woman" if is_woman(name) else "man"


@lru_cache(maxsize=65536)
def look_of(name: str, age: int, seed: int = 0) -> Look:
    """Return the look of the person of this `Age` called `name`.

    seed: changes clothes and colours, but not stature
    """
    family = family_of(name, age)
    choices = [outfit for outfit in OUTFITS[family] if _fits(outfit, name)]
    outfit = choices[_draw(name, seed, "outfit") % len(choices)]
    skin = _pick(_SKINS, name, seed, "skin")
    colours = {
        "skin": skin,
        "hair": _pick(_GREYS if family == "elder" else _hairs(skin), name, seed, "hair"),
        "white": (206, 200, 194),
        "dark": (34, 28, 26),
        "top": _pick(_COATS if outfit.legs == "coat" else _TOPS, name, seed, "top"),
        "bottom": _pick(_BOTTOMS, name, seed, "bottom"),
        "shoes": _pick(_SHOES, name, seed, "shoes"),
        "bag": _pick(_BAGS, name, seed, "bag"),
        "cap": _pick(_TOPS, name, seed, "cap"),
    }
    red, green, blue = colours["skin"]
    colours["lips"] = (int(red * 0.86), int(green * 0.62), int(blue * 0.62))
    table = np.array([colours[coat] for coat in COATS], dtype=np.uint8)
    table.flags.writeable = False
    return Look(
        ALL.index(outfit), table, 0.022 * (_draw(name, seed, "girth") % 1001 / 1000.0) - 0.006
    )


def _hairs(skin: _Colour) -> tuple[str, ...]:
    """Return the hair colours for a skin colour: darker skin has darker hair."""
    return _HAIRS if skin[0] > 0xB0 else _HAIRS[:3]


def _fits(outfit: Outfit, name: str) -> bool:
    """Return whether an outfit suits the person. Old men and women share a family, not clothes."""
    return outfit.family != "elder" or (outfit.legs == "skirt") == is_woman(name)


def _pick(palette: tuple[str, ...], name: str, seed: int, what: str) -> _Colour:
    """Pick a colour of a palette and vary its brightness slightly."""
    draw = _draw(name, seed, what)
    shade = 0.88 + 0.24 * (draw >> 16 & 0xFF) / 255.0
    code = palette[draw % len(palette)]
    red, green, blue = (min(int(int(code[i : i + 2], 16) * shade), 255) for i in (0, 2, 4))
    return red, green, blue


def _draw(name: str, seed: int, what: str) -> int:
    return zlib.crc32(f"{what} {seed} {name}".encode())
