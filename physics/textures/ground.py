"""Ground textures, and the choice of a texture for each surface."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Final

import numpy as np

from physics.textures.layers import Colour, Generator, Layers, Picture, Recipe, stack_layers
from physics.textures.noise import Field, Noise, blur_field, cells, pixel_centres, smooth_step
from physics.textures.surface import (
    Bond,
    add_dirt,
    basket,
    blend_colours,
    bond_from_cells,
    courses,
    cracks,
    draw_bond,
    herringbone,
    plain_colour,
    random_courses,
    relief_shading,
    scale_brightness,
    sharpen,
)

_GRASS_TINT: Final = 0.3
"""Fraction of the tint in grass, which keeps most of its own green."""
_CRISP: Final = 0.7
"""Gain of the fine detail of the ground."""
_GREY: Final = ((0.57, 0.56, 0.54), (0.55, 0.54, 0.51), (0.59, 0.58, 0.56))
_WORN: Final = (*_GREY, (0.52, 0.51, 0.48))
_RED: Final = ((0.55, 0.39, 0.33), (0.51, 0.36, 0.31), (0.58, 0.42, 0.35), (0.48, 0.35, 0.31))
_SAND: Final = (0.52, 0.49, 0.44)
_DARK: Final = (0.36, 0.35, 0.34)


@lru_cache(maxsize=4)
def ground_layers(size_px: int = 512, seed: int = 0) -> Layers:
    """Return every ground layer; 256 pixels suit a laptop."""
    crisp = {name: Recipe(one.metres, _crisp(one.make)) for name, one in GROUND_RECIPES.items()}
    return stack_layers("ground", crisp, size_px, seed)


@lru_cache(maxsize=1)
def scan_layers(size_px: int) -> Layers:
    """Return the ground layers of generated scans.

    Hashes of maps, to which a frozen suite refers, cover their colours: do not change them.
    """
    return stack_layers("scan-ground", _SCAN_RECIPES, size_px, 0)


def _crisp(make: Generator) -> Generator:
    """Return a generator with more contrast in fine detail, which filters of pictures lose."""

    def crisp(noise: Noise) -> Picture:
        plain = make(noise)
        return Picture(sharpen(np.asarray(plain.rgb, np.float32), _CRISP), plain.alpha)

    return crisp


def _asphalt(
    stone: float, tone: float = 0.33, worn: float = 0.0, patches: bool = False
) -> Generator:
    """Return a generator of asphalt.

    stone: contrast of the stones
    tone: brightness
    worn: strength of cracks and stains
    patches: add repairs
    """

    def make(noise: Noise) -> Picture:
        chips = noise.grain(0.6)
        colour = (tone, tone, 1.02 * tone)
        rgb = plain_colour(noise, colour, 0.010, 0.0, 8)
        light = smooth_step(0.9, 2.2, chips) - 0.8 * smooth_step(0.7, 2.0, -chips)
        rgb = rgb + np.float32(stone) * (light + 0.35 * noise.grain())[..., None]
        if patches:
            edge = _patches(noise)
            fresh = plain_colour(noise, (tone - 0.035,) * 3, 0.008, 0.02)
            seam = 1.0 - smooth_step(0.0, 0.006, np.abs(edge))
            rgb = scale_brightness(
                blend_colours(rgb, fresh, smooth_step(0.0, 0.005, edge)), 1.0 - 0.22 * seam
            )
        if worn:
            split = cracks(noise, cells(noise, 4), 0.004)
            rgb = scale_brightness(rgb, 1.0 - 0.48 * np.float32(worn) * split)
            rgb = add_dirt(rgb, noise, 0.10 * worn)
        return Picture(rgb)

    return make


def _patches(noise: Noise) -> Field:
    """Return the signed distance to two repairs and a trench, positive inside.

    The unit is the side of the texture.
    """
    at = pixel_centres(noise.size)
    x, y = np.meshgrid(at, at)
    repairs = ((0.27, 0.24, 0.12, 0.10), (0.70, 0.66, 0.17, 0.13), (0.50, 0.44, 0.50, 0.035))
    edges = [
        np.minimum(
            half_x - np.abs(x - mx) if half_x < 0.5 else np.float32(1.0), half_y - np.abs(y - my)
        )
        for mx, my, half_x, half_y in repairs
    ]
    return np.asarray(np.max(edges, axis=0) + 0.003 * noise.clouds(8), dtype=np.float32)


def _stones(
    side_m: float,
    lay: Callable[[int, float], Bond],
    colours: Sequence[Colour],
    joint: Colour,
    tint: float = 1.0,
    **look: float,
) -> Recipe:
    """Return the recipe of a paved surface.

    lay: bond for a size in pixels and a side in metres
    tint: fraction of the tint in the stones
    look: arguments of `draw_bond`
    """

    def make(noise: Noise) -> Picture:
        whole = draw_bond(noise, lay(noise.size, side_m), side_m, colours, joint, **look)
        return Picture(add_dirt(whole.rgb, noise, 0.08), np.float32(tint) * np.asarray(whole.alpha))

    return Recipe(side_m, make)


def _rows(
    rows: int, unit_m: Sequence[float], shift: Sequence[float] = (0.0,)
) -> Callable[[int, float], Bond]:
    """Return a function that lays rows of units."""
    return lambda size, side_m: courses(size, side_m, rows, unit_m, shift)


def _setts(noise: Noise) -> Picture:
    bond = random_courses(noise.rng, noise.size, 1.6, [0.1] * 16, (0.09, 0.15))
    return draw_bond(
        noise,
        bond,
        1.6,
        ((0.50, 0.49, 0.48), (0.44, 0.43, 0.43), (0.55, 0.53, 0.51)),
        _DARK,
        joint_m=0.013,
        bevel_m=0.016,
        spread=0.09,
        wobble_m=0.004,
        grain=0.04,
    )


def _cobbles(noise: Noise) -> Picture:
    bond = bond_from_cells(cells(noise, 14, 0.55), 1.6)
    return draw_bond(
        noise,
        bond,
        1.6,
        ((0.50, 0.48, 0.45), (0.44, 0.43, 0.42), (0.56, 0.52, 0.47)),
        (0.34, 0.32, 0.29),
        joint_m=0.016,
        bevel_m=0.022,
        spread=0.10,
        wobble_m=0.003,
        grain=0.04,
    )


def _granite(noise: Noise) -> Picture:
    bond = courses(noise.size, 1.0, 1, [1.0], [0.0])
    speck = noise.grain(0.7)
    whole = draw_bond(
        noise, bond, 1.0, ((0.63, 0.62, 0.61),), _DARK, joint_m=0.006, wobble_m=0.0, grain=0.03
    )
    return Picture(
        whole.rgb
        + 0.05 * (smooth_step(0.8, 1.6, speck) - 1.3 * smooth_step(1.0, 1.8, -speck))[..., None]
    )


def _grass(dry: float, worn: float = 0.0) -> Generator:
    def make(noise: Noise) -> Picture:
        # Warped streaks give blades without a common direction.
        one = noise.distort(noise.streaks(256, 8), 0.03, 8)
        two = noise.distort(noise.streaks(256, 8, 1), 0.03, 8)
        blades = 0.7 * np.maximum(one, two) + 0.45 * noise.grain(0.7) - 0.4
        tuft = noise.clouds(16)
        green = blend_colours(
            (0.25, 0.31, 0.16), (0.40, 0.45, 0.25), smooth_step(-1.6, 1.8, blades + 0.5 * tuft)
        )
        rgb = blend_colours(
            green,
            (0.52, 0.48, 0.32),
            np.float32(dry) * smooth_step(-0.3, 2.6, noise.clouds(8) + 0.7 * blades),
        )
        if worn:
            bare = np.float32(worn) * smooth_step(0.3, 2.0, noise.clouds(8) + 0.35 * blades)
            rgb = blend_colours(rgb, plain_colour(noise, (0.43, 0.37, 0.29), 0.02, 0.04), bare)
        rgb = scale_brightness(rgb, 1.0 + 0.04 * noise.clouds(8) + 0.06 * blades)
        return Picture(rgb, np.full_like(tuft, _GRASS_TINT))

    return make


def _planting(noise: Noise) -> Picture:
    """Draw low shrubs with leaves of a few centimetres and dark gaps."""
    leaves = cells(noise, 40, 0.9)
    tone = noise.rng.normal(1.0, 0.18, (leaves.n, 1)).astype(np.float32)
    palette = np.asarray(
        ((0.24, 0.35, 0.16), (0.20, 0.30, 0.13), (0.27, 0.36, 0.19)), dtype=np.float32
    )
    green = palette[noise.rng.integers(len(palette), size=leaves.n)] * tone
    rgb = blend_colours((0.08, 0.12, 0.06), green[leaves.id], smooth_step(0.0, 0.006, leaves.edge))
    return Picture(scale_brightness(rgb, 1.0 + 0.10 * noise.clouds(8) + 0.10 * noise.clouds(64)))


def _water(noise: Noise) -> Picture:
    ripples = noise.distort(noise.streaks(32, 8), 0.05, 8)
    return Picture(
        scale_brightness(plain_colour(noise, (0.16, 0.28, 0.36), 0.01, 0.0), 1.0 + 0.06 * ripples)
    )


def _earth(noise: Noise) -> Picture:
    rgb = add_dirt(plain_colour(noise, (0.43, 0.36, 0.28), 0.03, 0.03, 8), noise, 0.15, 8)
    pebbles = cells(noise, 40, 0.9)
    some = (noise.rng.random(pebbles.n) < 0.2).astype(np.float32)[pebbles.id]
    return Picture(
        blend_colours(rgb, (0.55, 0.50, 0.43), 0.7 * some * smooth_step(0.003, 0.008, pebbles.edge))
    )


def _gravel(noise: Noise) -> Picture:
    bond = bond_from_cells(cells(noise, 64, 0.9), 1.2)
    colours = ((0.58, 0.55, 0.50), (0.50, 0.47, 0.43), (0.64, 0.61, 0.56), (0.45, 0.43, 0.41))
    return draw_bond(
        noise,
        bond,
        1.2,
        colours,
        (0.33, 0.30, 0.27),
        joint_m=0.003,
        bevel_m=0.007,
        spread=0.10,
        joint_tint=0.8,
    )


def _tactile(bars: bool) -> Generator:
    """Return a generator of 0.3 m slabs with domes 60 mm apart, or bars 75 mm apart (ISO 23599)."""

    def make(noise: Noise) -> Picture:
        at = pixel_centres(noise.size) * 0.6
        x, y = np.meshgrid(at, at)
        if bars:
            inset = np.maximum(np.abs((y % 0.3) - 0.15) - 0.122, 0.0)
            distance = np.hypot(np.abs((x % 0.075) - 0.0375), inset)
            bump = 1.0 - smooth_step(0.011, 0.017, distance)
        else:
            bump = 1.0 - smooth_step(0.009, 0.0165, np.hypot((x % 0.06) - 0.03, (y % 0.06) - 0.03))
        colour = ((0.74, 0.66, 0.44), (0.72, 0.64, 0.42), (0.76, 0.68, 0.47))
        slab = draw_bond(
            noise,
            courses(noise.size, 0.6, 2, [0.3], [0.0]),
            0.6,
            colour,
            _DARK,
            joint_m=0.005,
            spread=0.02,
        )
        soft = blur_field(bump, 0.004 / 0.6 * noise.size)
        rgb = scale_brightness(
            slab.rgb,
            relief_shading(blur_field(bump, 1.2), 0.30)
            * (1.0 - 0.18 * np.clip(soft - bump, 0.0, 1.0)),
        )
        return Picture(scale_brightness(rgb, 1.0 + 0.05 * bump), slab.alpha)

    return make


def _paint(worn: float) -> Generator:
    """Return a generator of tinted road paint; worn parts show asphalt."""

    def make(noise: Noise) -> Picture:
        below = _asphalt(0.05)(noise).rgb
        paint = plain_colour(noise, (0.86, 0.86, 0.84), 0.015, 0.018)
        chips = 0.7 * noise.clouds(8) + 0.6 * noise.clouds(64) + 0.7 * noise.grain(0.6)
        lost = smooth_step(2.2 - 1.3 * worn, 2.9 - 1.2 * worn, chips)
        lost = np.maximum(lost, worn * cracks(noise, cells(noise, 6), 0.003))
        return Picture(blend_colours(paint, below, 0.9 * lost), 1.0 - 0.9 * lost)

    return make


def _cast(noise: Noise) -> Picture:
    """Draw cast concrete with a joint every 1.5 m."""
    bond = courses(noise.size, 3.0, 2, [1.5], [0.0])
    whole = draw_bond(
        noise,
        bond,
        3.0,
        _GREY[:1],
        (0.40, 0.39, 0.38),
        joint_m=0.012,
        spread=0.015,
        wobble_m=0.0,
        grain=0.016,
    )
    pores = smooth_step(1.9, 2.6, noise.grain(0.5))
    rgb = add_dirt(scale_brightness(whole.rgb, 1.0 - 0.16 * pores), noise, 0.08)
    return Picture(
        scale_brightness(rgb, 1.0 - 0.32 * cracks(noise, cells(noise, 3), 0.003)), whole.alpha
    )


GROUND_RECIPES: Final[Mapping[str, Recipe]] = {
    "asphalt": Recipe(3.0, _asphalt(0.065, 0.40)),
    "asphalt-worn": Recipe(4.0, _asphalt(0.070, 0.44, worn=1.0)),
    "asphalt-patched": Recipe(6.0, _asphalt(0.065, 0.42, worn=0.6, patches=True)),
    "asphalt-fine": Recipe(2.0, _asphalt(0.050, 0.45)),
    "concrete-cast": Recipe(3.0, _cast),
    "slabs-square": _stones(2.0, _rows(5, [0.4]), _GREY, _DARK, joint_m=0.007, spread=0.035),
    "slabs-running": _stones(
        2.4, _rows(6, [0.6], [0.0, 0.5]), _GREY, _DARK, joint_m=0.007, spread=0.035
    ),
    "slabs-mixed": _stones(
        2.4, _rows(6, [0.6, 0.4, 0.2], [0.0, 0.39, 0.81]), _GREY, _DARK, joint_m=0.007, spread=0.045
    ),
    "slabs-worn": _stones(
        2.0, _rows(4, [0.5]), _WORN, _SAND, joint_m=0.010, spread=0.045, clouds=0.03
    ),
    "pavers-running": _stones(
        1.6, _rows(16, [0.2], [0.0, 0.5]), _GREY, _DARK, joint_m=0.005, spread=0.05
    ),
    "pavers-herringbone": _stones(
        1.6, lambda n, m: herringbone(n, m, 0.1), _GREY, _DARK, joint_m=0.005, spread=0.05
    ),
    "pavers-basket": _stones(
        1.6, lambda n, m: basket(n, m, 0.1), _GREY, _DARK, joint_m=0.005, spread=0.05
    ),
    "pavers-mixed": _stones(
        1.8, _rows(12, [0.2, 0.15, 0.25], [0.0, 0.45, 0.2]), _WORN, _DARK, spread=0.06
    ),
    "brick-running": _stones(
        1.68, _rows(16, [0.21], [0.0, 0.5]), _RED, _SAND, 0.6, joint_m=0.007, spread=0.07
    ),
    "brick-herringbone": _stones(
        1.68, lambda n, m: herringbone(n, m, 0.105), _RED, _SAND, 0.6, joint_m=0.007, spread=0.07
    ),
    "brick-basket": _stones(
        1.68, lambda n, m: basket(n, m, 0.105), _RED, _SAND, 0.6, joint_m=0.007, spread=0.07
    ),
    "setts": Recipe(1.6, _setts),
    "cobbles": Recipe(1.6, _cobbles),
    "granite": Recipe(1.0, _granite),
    "grass": Recipe(2.0, _grass(0.25)),
    "grass-dry": Recipe(2.0, _grass(0.85)),
    "grass-worn": Recipe(2.0, _grass(0.5, 0.9)),
    "earth": Recipe(2.0, _earth),
    "gravel": Recipe(1.2, _gravel),
    "planting": Recipe(1.6, _planting),
    "water": Recipe(6.0, _water),
    "asphalt-footway": Recipe(2.0, _asphalt(0.035, 0.55)),
    "tactile-domes": Recipe(0.6, _tactile(bars=False)),
    "tactile-bars": Recipe(0.6, _tactile(bars=True)),
    "paint": Recipe(2.0, _paint(0.35)),
    "paint-worn": Recipe(2.0, _paint(1.0)),
    "plain": Recipe(1.0, lambda noise: Picture(np.full((noise.size, noise.size, 3), 0.8))),
}
"""Recipe of every ground layer by name."""

SURFACE_LAYERS: Final[Mapping[str, tuple[str, ...]]] = {
    "road": ("asphalt", "asphalt-worn", "asphalt-patched"),
    "crossing": ("asphalt", "asphalt-worn"),
    "stripe": ("paint", "paint-worn"),
    "paint": ("paint", "paint-worn"),
    "sidewalk": ("concrete-cast", "slabs-square", "slabs-running"),
    "ramp": ("concrete-cast",),
    "curb": ("granite",),
    "gutter": ("concrete-cast", "setts"),
    "tactile": ("tactile-domes",),
    "guide": ("tactile-bars",),
    "verge": ("grass", "grass-dry", "grass-worn"),
    "ground": ("grass", "grass-dry"),
    "concrete": ("slabs-square", "slabs-running", "slabs-mixed", "slabs-worn", "concrete-cast"),
    "pavers": ("pavers-running", "pavers-herringbone", "pavers-basket", "pavers-mixed"),
    "brick": ("brick-running", "brick-herringbone", "brick-basket"),
    "asphalt": ("asphalt-fine", "asphalt", "asphalt-patched"),
    "setts": ("setts", "cobbles"),
    "grass": ("grass", "grass-dry", "grass-worn"),
    "gravel": ("gravel",),
    "earth": ("earth", "gravel"),
    "footway": ("asphalt-footway",),
    "planting": ("planting",),
    "soil": ("earth",),
    "yard": ("asphalt-worn",),
    "water": ("water",),
}
"""Possible layers by kind of ground, material or kind of open ground.

Keys are from `physics.ground.tiles`, `physics.ground.materials` and `cosim.place.open_ground`.
"""


def layer_of(surface: str, seed: int = 0) -> str:
    """Return the layer of a surface name such as "sidewalk:brick:2", chosen by name and seed.

    Unknown kinds of ground are asphalt.
    """
    kind, _, rest = surface.partition(":")
    material = rest.partition(":")[0]
    choice = SURFACE_LAYERS.get(material) or SURFACE_LAYERS.get(kind) or ("asphalt",)
    if kind == "road" and material == "brick":
        choice = ("setts", "brick-running", "brick-herringbone")
    return choice[zlib.crc32(f"{surface}:{seed}".encode()) % len(choice)]


_SCAN_RECIPES: Final[Mapping[str, Recipe]] = {
    **GROUND_RECIPES,
    "asphalt": Recipe(3.0, _asphalt(0.050)),
    "asphalt-worn": Recipe(4.0, _asphalt(0.055, 0.37, worn=1.0)),
    "asphalt-patched": Recipe(6.0, _asphalt(0.050, 0.35, worn=0.6, patches=True)),
    "asphalt-fine": Recipe(2.0, _asphalt(0.035, 0.40)),
}
