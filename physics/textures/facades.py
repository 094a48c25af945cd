"""Facades: one bay by one storey, to be laid over a wall; which bays and walls go together in one building."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

from physics.textures.facade_canvas import BAY_M, STOREY_M, Canvas
from physics.textures.fronts import FRONTS
from physics.textures.layers import Layers, Picture, Recipe, stacked
from physics.textures.noise import Noise
from physics.textures.windows import WINDOWS

VARIANTS: Final = 3
"""Layers of each style of bay, told apart by a number: "sash-0", "sash-1" ..."""


@lru_cache(maxsize=4)
def facade_layers(size_px: int = 512, seed: int = 0) -> Layers:
    """Every bay, BAY_M wide and STOREY_M high: upper storeys, then ground floors."""
    styles = {**WINDOWS, **FRONTS}
    recipes = {
        f"{name}-{k}": Recipe((BAY_M, STOREY_M), _drawn(style))
        for name, style in styles.items()
        for k in range(VARIANTS)
    }
    return stacked(recipes, size_px, seed)


def _drawn(style: Callable[[Canvas], None]) -> Callable[[Noise], Picture]:
    def make(noise: Noise) -> Picture:
        canvas = Canvas(noise)
        style(canvas)
        return canvas.picture()

    return make


@dataclass(frozen=True, slots=True)
class WallStyle:
    """What a kind of building shows. walls, uppers, fronts: names of wall layers and of styles of bays (with -0 to
    -2 behind them), of which each building takes one wall, one upper and a few fronts. roofs: wall layers too.
    tints: sRGB colours of the wall; empty: the wall's own."""

    walls: tuple[str, ...]
    uppers: tuple[str, ...]
    fronts: tuple[str, ...]
    roofs: tuple[str, ...]
    tints: tuple[tuple[float, float, float], ...] = ()


_SHOPS: Final = ("shop", "shop-awning", "cafe", "shop", "entrance")
_HOMES: Final = ("entrance", "home", "home", "blank", "garage")
_PASTELS: Final = (
    (0.84, 0.80, 0.72), (0.82, 0.74, 0.60), (0.77, 0.66, 0.54), (0.74, 0.75, 0.70), (0.80, 0.70, 0.64),
    (0.86, 0.84, 0.80), (0.68, 0.70, 0.72), (0.78, 0.77, 0.66),
)  # fmt: skip

WALL_STYLES: Final[Mapping[str, WallStyle]] = {
    "plaster-old": WallStyle(
        ("plaster-smooth", "plaster-stained", "plaster-crazed"), ("casement", "shutters", "french", "sash"),
        _SHOPS, ("roof-tiles", "roof-slate"), _PASTELS,
    ),
    "plaster-new": WallStyle(
        ("plaster-smooth", "plaster-rough"), ("square", "wide", "french", "pair"), _HOMES, ("roof-gravel", "roof-felt"),
        _PASTELS,
    ),
    "brick-old": WallStyle(
        ("brick-flemish", "brick-english", "brick-pale"), ("sash", "arched", "pair"), (*_SHOPS, "home"),
        ("roof-slate", "roof-tiles"),
    ),
    "brick-new": WallStyle(
        ("brick-stretcher", "brick-dark", "brick-pale"), ("square", "wide", "french"), _HOMES,
        ("roof-gravel", "roof-felt"),
    ),
    "brick-painted": WallStyle(("brick-painted",), ("sash", "casement", "shutters"), _SHOPS, ("roof-slate",), _PASTELS),
    "stone": WallStyle(
        ("stone-ashlar", "stone-rubble"), ("casement", "arched", "sash"), _SHOPS, ("roof-slate", "roof-metal")
    ),
    "office": WallStyle(
        ("concrete-panels", "metal-panels", "tiles-glazed"), ("ribbon", "office", "wide"), ("lobby", "shop", "lobby"),
        ("roof-gravel",), ((0.72, 0.71, 0.69), (0.58, 0.59, 0.61), (0.66, 0.62, 0.56)),
    ),
    "slab": WallStyle(
        ("concrete-panels", "concrete-boarded"), ("balcony", "wide", "pair"), ("entrance", "home", "blank"),
        ("roof-felt", "roof-gravel"), ((0.70, 0.69, 0.66), (0.76, 0.72, 0.64), (0.64, 0.66, 0.68)),
    ),
    "wood": WallStyle(
        ("wood-siding", "wood-upright"), ("casement", "sash", "square"), ("home", "entrance", "home"),
        ("roof-tiles", "roof-slate"),
        ((0.62, 0.54, 0.43), (0.80, 0.79, 0.76), (0.52, 0.30, 0.25), (0.50, 0.56, 0.58), (0.72, 0.66, 0.46)),
    ),
    "shed": WallStyle(
        ("metal-corrugated", "metal-panels"), ("blank-upper", "ribbon"), ("garage", "blank", "garage"), ("roof-metal",),
        ((0.62, 0.64, 0.66), (0.48, 0.55, 0.60), (0.70, 0.68, 0.62)),
    ),
}  # fmt: skip
