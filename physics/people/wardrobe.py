"""Clothes of people: bodies, sixty outfits by season, their patterns and colours.

An `Outfit` is a body, which renderers load once. `Clothes` dress it in cloths and colours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final, Literal

from physics.people.body import Outfit
from physics.people.figure import Build, Companion

Season = Literal["summer", "mild", "winter"]
SEASONS: Final[tuple[Season, ...]] = ("summer", "mild", "winter")

_HOTTEST: Final = 200
"""Hottest day of the year in the north."""


def season_of(day_of_year: int, latitude_deg: float) -> Season:
    """Return the season of the clothes that people wear on a day at a latitude."""
    if abs(latitude_deg) < 20.0:
        return "summer"
    warm = math.cos(2.0 * math.pi * (day_of_year - _HOTTEST) / 365.25)
    warm = math.copysign(warm, warm * latitude_deg)
    return "summer" if warm > 0.6 else "winter" if warm < -0.5 else "mild"


TOP_PATTERNS: Final = (
    *("plain", "stripes", "bands", "check", "print", "open", "zip", "buttons", "knit"),
    *("pinstripes", "dots"),
)
BOTTOM_PATTERNS: Final = ("plain", "denim", "side stripe", "crease", "check", "dots")
"""Patterns of cloth, drawn in `cloth_maps`."""

_MAN: Final = Build()
_STOUT: Final = Build(belly_m=0.045, limb=1.08)
_SLIM: Final = Build(limb=0.93)
_WOMAN: Final = Build(woman=1.0, limb=0.92)
_ROUND: Final = Build(woman=1.0, belly_m=0.025, limb=1.03)
_CHILD: Final = Build(woman=0.3, limb=0.92, head=1.25)
_OLD: Final = Build(woman=0.3, belly_m=0.03, limb=0.96)
_OLD_WOMAN: Final = Build(woman=0.9, belly_m=0.03, limb=0.96)

BODIES: Final[dict[str, Outfit]] = {
    "m tee": Outfit("man", _MAN, "trousers", "short", "short"),
    "m slim tee": Outfit("man", _SLIM, "trousers", "short", "curls", carried="backpack"),
    "m stout tee": Outfit("man", _STOUT, "trousers", "short", "crop", carried="bag"),
    "m shorts": Outfit("man", _MAN, "shorts", "short", "short", cap="cap", bare=True),
    "m shirt": Outfit("man", _SLIM, "trousers", "long", "short", loose_m=0.004),
    "m jacket": Outfit("man", _MAN, "trousers", "long", "crop", loose_m=0.012, carried="backpack"),
    "m stout jacket": Outfit(
        "man", _STOUT, "trousers", "long", "short", loose_m=0.008, carried="phone"
    ),
    "m coat": Outfit("man", _MAN, "coat", "long", "short", loose_m=0.014),
    "m padded": Outfit("man", _MAN, "trousers", "long", "short", cap="beanie", loose_m=0.024),
    "w blouse": Outfit("woman", _WOMAN, "trousers", "long", "long", carried="bag"),
    "w skirt": Outfit("woman", _WOMAN, "skirt", "short", "bob", bare=True),
    "w tee": Outfit("woman", _WOMAN, "trousers", "short", "tail", carried="backpack"),
    "w shorts": Outfit("woman", _WOMAN, "shorts", "short", "long", bare=True),
    "w long skirt": Outfit("woman", _ROUND, "skirt", "long", "bun", bare=True),
    "w jacket": Outfit("woman", _ROUND, "trousers", "long", "bob", loose_m=0.008, carried="phone"),
    "w scarf": Outfit("woman", _WOMAN, "coat", "long", "scarf", loose_m=0.006, carried="bag"),
    "w coat": Outfit("woman", _WOMAN, "coat", "long", "long", loose_m=0.010),
    "w padded": Outfit("woman", _WOMAN, "trousers", "long", "long", cap="beanie", loose_m=0.020),
    "c tee": Outfit("child", _CHILD, "trousers", "short", "short", carried="backpack"),
    "c skirt": Outfit("child", _CHILD, "skirt", "short", "tail", bare=True),
    "c shorts": Outfit("child", _CHILD, "shorts", "short", "short", cap="cap", bare=True),
    "c jacket": Outfit("child", _CHILD, "trousers", "long", "curls", loose_m=0.014),
    "c padded": Outfit("child", _CHILD, "trousers", "long", "short", cap="beanie", loose_m=0.022),
    "e jacket": Outfit("elder", _OLD, "trousers", "long", "crop", cap="cap", loose_m=0.012),
    "e coat": Outfit("elder", _OLD, "coat", "long", "crop", loose_m=0.012),
    "e shirt": Outfit("elder", _OLD, "trousers", "short", "short"),
    "e skirt": Outfit(
        "elder", _OLD_WOMAN, "skirt", "long", "bun", bare=True, loose_m=0.008, carried="bag"
    ),
    "e woman coat": Outfit("elder", _OLD_WOMAN, "coat", "long", "bob", loose_m=0.012),
}
"""Bodies by name: man, woman, child, elder, and the shape of the clothes."""


@dataclass(frozen=True, slots=True)
class Clothes:
    """An outfit with cloths.

    body: name in BODIES
    top, bottom: names of PATTERNS
    tops, bottoms: palettes
    seasons: in which it is worn
    """

    body: str
    top: str
    bottom: str
    tops: str
    bottoms: str
    seasons: tuple[Season, ...]

    @property
    def outfit(self) -> Outfit:
        return BODIES[self.body]


_ROWS: Final = """
m tee           print      denim       shirts  jeans    summer mild
m tee           stripes    plain       light   chinos   summer
m tee           plain      denim       shirts  jeans    summer mild
m slim tee      plain      denim       light   jeans    summer mild
m slim tee      bands      side stripe bright  dark     summer
m slim tee      dots       plain       shirts  chinos   summer
m stout tee     check      denim       shirts  jeans    summer mild
m stout tee     buttons    plain       light   chinos   summer
m shorts        print      plain       bright  chinos   summer
m shorts        stripes    denim       light   jeans    summer
m shorts        plain      side stripe shirts  dark     summer
m shirt         buttons    crease      light   dark     summer mild
m shirt         check      denim       shirts  jeans    mild winter
m shirt         pinstripes crease      light   dark     summer mild
m shirt         knit       plain       muted   chinos   mild winter
m jacket        open       denim       coats   jeans    mild
m jacket        zip        plain       bright  dark     mild winter
m jacket        open       crease      suits   suits    summer mild winter
m stout jacket  zip        denim       muted   jeans    mild
m stout jacket  open       plain       coats   chinos   mild winter
m coat          buttons    crease      coats   dark     winter
m coat          open       plain       coats   dark     mild winter
m padded        zip        denim       bright  jeans    winter
m padded        bands      plain       muted   dark     winter
w blouse        buttons    denim       light   jeans    summer mild
w blouse        stripes    plain       light   dark     mild
w blouse        knit       denim       muted   jeans    mild winter
w skirt         plain      dots        bright  bright   summer
w skirt         stripes    denim       light   jeans    summer
w skirt         dots       plain       shirts  muted    summer mild
w tee           print      denim       bright  jeans    summer mild
w tee           plain      side stripe shirts  dark     summer
w tee           bands      plain       light   chinos   summer mild
w shorts        plain      denim       light   jeans    summer
w shorts        print      plain       bright  chinos   summer
w long skirt    knit       check       muted   muted    mild winter
w long skirt    buttons    plain       light   dark     summer mild
w jacket        open       denim       coats   jeans    mild
w jacket        zip        plain       bright  dark     mild winter
w jacket        open       crease      suits   suits    summer mild
w scarf         plain      plain       muted   dark     summer mild winter
w coat          buttons    denim       coats   jeans    winter
w coat          open       plain       coats   dark     mild winter
w coat          check      plain       muted   dark     winter
w padded        zip        denim       bright  jeans    winter
w padded        plain      plain       muted   dark     winter
c tee           print      denim       bright  jeans    summer mild
c tee           stripes    plain       bright  chinos   summer mild
c skirt         dots       plain       bright  bright   summer mild
c shorts        print      plain       bright  chinos   summer
c jacket        zip        denim       bright  jeans    mild winter
c padded        bands      plain       bright  dark     winter
c jacket        bands      side stripe bright  dark     mild winter
e jacket        zip        plain       muted   chinos   mild winter
e jacket        check      crease      muted   dark     summer mild
e shirt         buttons    plain       light   chinos   summer mild
e shirt         check      crease      shirts  chinos   summer
e coat          buttons    crease      coats   dark     winter
e coat          open       plain       coats   dark     mild winter
e skirt         knit       plain       muted   muted    summer mild
e skirt         dots       plain       light   muted    summer mild winter
e woman coat    buttons    plain       coats   dark     mild winter
e woman coat    check      plain       muted   dark     winter
"""


def _read(row: str) -> Clothes:
    top, bottom, tops, bottoms = row[16:27], row[27:39], row[39:47], row[47:56]
    seasons = row[56:].split()
    return Clothes(
        row[:16].strip(),
        top.strip(),
        bottom.strip(),
        tops.strip(),
        bottoms.strip(),
        tuple(season for season in SEASONS if season in seasons),
    )


CLOTHES: Final = tuple(map(_read, _ROWS.strip().splitlines()))
"""Outfits that people wear."""

_VARIANTS: Final[dict[Companion, tuple[str, ...]]] = {
    "dog": ("m tee", "m jacket", "w tee", "w jacket", "e jacket", "e skirt", "w coat", "m coat"),
    "pram": ("m tee", "m jacket", "w blouse", "w tee", "w jacket", "w coat"),
    "bicycle": ("m tee", "m jacket", "m padded", "w tee", "w jacket", "w padded"),
    "wheelchair": ("m tee", "m jacket", "w blouse", "w jacket", "e jacket", "e shirt"),
    "umbrella": (
        *("m tee", "m shirt", "m jacket", "m coat", "m padded", "m shorts", "m stout jacket"),
        *("w blouse", "w tee", "w jacket", "w coat", "w skirt", "w padded", "w scarf"),
        *("c jacket", "c tee", "e jacket", "e coat", "e woman coat", "e skirt"),
    ),
}
"""Bodies that also exist with an object pushed, led or held."""


def with_companion(name: str, companion: Companion) -> Outfit | None:
    """Return a body with an object, or None where there is none."""
    if not companion:
        return BODIES[name]
    if name not in _VARIANTS[companion]:
        return None
    return replace(BODIES[name], companion=companion, carried="")


ALL: Final[tuple[Outfit, ...]] = (
    *BODIES.values(),
    *(
        outfit
        for companion, names in _VARIANTS.items()
        for outfit in (with_companion(name, companion) for name in names)
        if outfit is not None
    ),
)
"""All bodies; renderers number them by their row."""

PALETTES: Final[dict[str, tuple[str, ...]]] = {
    "shirts": ("964844", "3d5d88", "4e8466", "574a70", "3b3d42", "909fad", "92684c", "758766"),
    "light": ("d8d6d0", "b4bec9", "c6b9a4", "a5b0a1", "c0a9ab", "94a4b9", "e0ddd3", "aaa08e"),
    "bright": ("ac453f", "3f6ca3", "dfba63", "499270", "c4788d", "ce8357", "569ca9", "f1efea"),
    "muted": ("8c8f94", "776b60", "727c70", "7e5d5c", "5d6775", "aca495", "4c4f58", "98909c"),
    "coats": ("3c3f46", "766757", "979085", "38475e", "62403d", "525c4f", "bcaa91", "5a5b5e"),
    "suits": ("3e424b", "4a4a4d", "5a554c", "384253", "6d6f75"),
    "jeans": ("41536d", "546a86", "303b4f", "6d809a", "44484e"),
    "dark": ("303237", "393632", "404652", "44403e", "525458"),
    "chinos": ("84765f", "675f51", "92866f", "54574d", "5a4c3f", "64666a"),
}
"""Colours of cloth as sRGB, by the name that `Clothes` use."""
