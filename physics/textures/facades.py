"""Facade layers of one bay by one storey, and building styles that combine them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

from physics.textures.facade_canvas import BAY_M, STOREY_M, FacadeCanvas
from physics.textures.layers import Layers, Picture, Recipe, stack_layers
from physics.textures.noise import Noise
from physics.textures.shop_fronts import FRONTS
from physics.textures.windows import WINDOW_STYLES

BAY_VARIANTS: Final = 3
"""Number of layers per bay style, named "sash-0", "sash-1" and so on."""


@lru_cache(maxsize=4)
def facade_layers(size_px: int = 256, seed: int = 0) -> Layers:
    """Return every bay layer: upper storeys, then ground floors. 256 pixels are 12 mm each."""
    styles = {**WINDOW_STYLES, **FRONTS}
    recipes = {
        f"{name}-{k}": Recipe((BAY_M, STOREY_M), _generator(style, k))
        for name, style in styles.items()
        for k in range(BAY_VARIANTS)
    }
    return stack_layers("facades", recipes, size_px, seed)


def _generator(style: Callable[[FacadeCanvas], None], number: int) -> Callable[[Noise], Picture]:
    """Return a generator that draws a variant of a style."""

    def make(noise: Noise) -> Picture:
        canvas = FacadeCanvas(noise, number)
        style(canvas)
        return canvas.picture()

    return make


@dataclass(frozen=True, slots=True)
class WallStyle:
    """Style of buildings.

    walls, roofs: names of wall layers
    uppers: styles of upper bays
    fronts: keys of `DOORS`
    tints: sRGB wall colours; empty keeps the wall's own colour

    A building has one wall, roof, upper style, front and tint. The variant of the upper style
    changes from bay to bay.
    """

    walls: tuple[str, ...]
    uppers: tuple[str, ...]
    fronts: tuple[str, ...]
    roofs: tuple[str, ...]
    tints: tuple[tuple[float, float, float], ...] = ()


@dataclass(frozen=True, slots=True)
class Front:
    """Arrangement of a ground floor.

    between: bay style between doors
    door: bay style with a door
    every: a door in every n-th bay, at most 15
    """

    between: str
    door: str
    every: int


FRONTS_BY_NAME: Final[Mapping[str, Front]] = {
    "shop": Front("shop-window", "shop", 3),
    "shop-awning": Front("shop-awning", "shop", 4),
    "cafe": Front("cafe", "cafe-door", 4),
    "entrance": Front("home", "entrance", 4),
    "home": Front("home", "entrance", 6),
    "garage": Front("garage", "blank", 4),
    "lobby": Front("lobby", "lobby", 1),
    "blank": Front("blank", "entrance", 7),
}
"""Ground floors by name."""

_SHOPS: Final = ("shop", "shop-awning", "cafe", "shop", "entrance")
"""Ground floors in streets with shops."""

_HOMES: Final = ("entrance", "home", "home", "blank", "garage")
"""Ground floors of residential buildings."""

_PASTELS: Final = (
    (0.84, 0.80, 0.72),
    (0.82, 0.74, 0.60),
    (0.77, 0.66, 0.54),
    (0.74, 0.75, 0.70),
    (0.80, 0.70, 0.64),
    (0.86, 0.84, 0.80),
    (0.68, 0.70, 0.72),
    (0.78, 0.77, 0.66),
)
"""sRGB colours of plaster."""

WALL_STYLES: Final[Mapping[str, WallStyle]] = {
    "plaster-old": WallStyle(
        walls=("plaster-smooth", "plaster-stained", "plaster-crazed"),
        uppers=("casement", "casement-brown", "shutters", "shutters-brown", "french", "sash"),
        fronts=_SHOPS,
        roofs=("roof-tiles", "roof-slate"),
        tints=_PASTELS,
    ),
    "plaster-new": WallStyle(
        walls=("plaster-smooth", "plaster-rough"),
        uppers=("square", "square-white", "wide", "french-dark", "pair"),
        fronts=_HOMES,
        roofs=("roof-gravel", "roof-felt"),
        tints=_PASTELS,
    ),
    "brick-old": WallStyle(
        walls=("brick-flemish", "brick-english", "brick-pale"),
        uppers=("sash", "sash-fine", "arched", "pair", "pair-green"),
        fronts=(*_SHOPS, "home"),
        roofs=("roof-slate", "roof-tiles"),
    ),
    "brick-new": WallStyle(
        walls=("brick-stretcher", "brick-dark", "brick-pale"),
        uppers=("square", "square-white", "wide", "french-dark"),
        fronts=_HOMES,
        roofs=("roof-gravel", "roof-felt"),
    ),
    "brick-painted": WallStyle(
        walls=("brick-painted",),
        uppers=("sash-fine", "casement", "shutters"),
        fronts=_SHOPS,
        roofs=("roof-slate",),
        tints=_PASTELS,
    ),
    "stone": WallStyle(
        walls=("stone-ashlar", "stone-rubble"),
        uppers=("casement", "casement-brown", "arched", "sash"),
        fronts=_SHOPS,
        roofs=("roof-slate", "roof-metal"),
    ),
    "office": WallStyle(
        walls=("concrete-panels", "metal-panels", "tiles-glazed"),
        uppers=("ribbon", "office", "office-light", "wide"),
        fronts=("lobby", "shop", "lobby"),
        roofs=("roof-gravel",),
        tints=((0.72, 0.71, 0.69), (0.58, 0.59, 0.61), (0.66, 0.62, 0.56)),
    ),
    "slab": WallStyle(
        walls=("concrete-panels", "concrete-boarded"),
        uppers=("balcony", "balcony-railed", "wide", "pair"),
        fronts=("entrance", "home", "blank"),
        roofs=("roof-felt", "roof-gravel"),
        tints=((0.70, 0.69, 0.66), (0.76, 0.72, 0.64), (0.64, 0.66, 0.68)),
    ),
    "wood": WallStyle(
        walls=("wood-siding", "wood-upright"),
        uppers=("sash", "sash-fine", "square-white", "pair-green"),
        fronts=("home", "entrance", "home"),
        roofs=("roof-tiles", "roof-slate"),
        tints=(
            (0.60, 0.55, 0.47),
            (0.80, 0.79, 0.76),
            (0.52, 0.36, 0.31),
            (0.54, 0.58, 0.59),
            (0.72, 0.69, 0.60),
        ),
    ),
    "shed": WallStyle(
        walls=("metal-corrugated", "metal-panels"),
        uppers=("blank-upper", "ribbon"),
        fronts=("garage", "blank", "garage"),
        roofs=("roof-metal",),
        tints=((0.62, 0.64, 0.66), (0.52, 0.57, 0.60), (0.70, 0.68, 0.62)),
    ),
}
"""Building styles by name."""

_OLD: Final = ("plaster-old", "brick-old", "brick-painted", "stone")
"""Styles of old buildings."""

STREET_STYLES: Final[Mapping[str, tuple[str, ...]]] = {
    "commercial": (*_OLD, *_OLD, "plaster-old", "brick-painted", "office"),
    "narrow": (*_OLD, *_OLD, "plaster-old", "plaster-old", "wood"),
    "avenue": (*_OLD, "plaster-old", "office", "office", "plaster-new", "slab"),
    "boulevard": (*_OLD, "stone", "plaster-old", "office", "plaster-new"),
    "ring": ("office", "office", "slab", "shed", "plaster-new", "brick-new"),
    "residential": (
        "plaster-new",
        "plaster-new",
        "brick-new",
        "brick-new",
        "wood",
        "slab",
        "plaster-old",
        "brick-old",
    ),
    "": (
        "plaster-old",
        "plaster-old",
        "plaster-new",
        "plaster-new",
        "brick-old",
        "brick-new",
        "stone",
        "slab",
    ),
}
"""Building styles by street class, repeated by frequency; "" is the default class."""
