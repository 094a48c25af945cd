"""Textures of walls, roofs, trees and street furniture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from physics.textures.layers import Colour, Generator, Layers, Picture, Recipe, stack_layers
from physics.textures.noise import Field, Noise, blur_field, cells, pixel_centres, smooth_step
from physics.textures.surface import (
    add_dirt,
    add_water_streaks,
    blend_colours,
    bond_from_cells,
    courses,
    cracks,
    draw_bond,
    plain_colour,
    random_courses,
    relief_shading,
    scale_brightness,
)

_CLAY: Final = ((0.56, 0.34, 0.27), (0.52, 0.31, 0.25), (0.60, 0.38, 0.30), (0.47, 0.29, 0.25))
"""sRGB colours of clay bricks."""

_LIME: Final = (0.66, 0.62, 0.56)
"""sRGB colour of lime mortar."""

_STRETCHER = 0.225
"""Length of a stretcher including its joint in metres."""

_HEADER = 0.1125
"""Length of a header including its joint in metres."""


@lru_cache(maxsize=4)
def wall_layers(size_px: int = 512, seed: int = 0) -> Layers:
    """Return every layer of walls, roofs and glass."""
    return stack_layers("walls", WALLS, size_px, seed)


@lru_cache(maxsize=4)
def prop_layers(size_px: int = 512, seed: int = 0) -> Layers:
    """Return every layer for trees and street furniture."""
    return stack_layers("props", PROPS, size_px, seed)


def _plaster(rough: float, dirt: float, crazed: float = 0.0) -> Generator:
    """Return a generator of plaster.

    rough: strength of the relief
    dirt: strength of stains
    crazed: strength of cracks
    """

    def make(noise: Noise) -> Picture:
        bumps = 0.6 * noise.clouds(64) + 0.6 * noise.grain(1.2)
        rgb = plain_colour(noise, (0.80, 0.78, 0.74), 0.012 + 0.02 * dirt, 0.006 + 0.010 * rough)
        rgb = scale_brightness(rgb, relief_shading(bumps, 0.03 * rough))
        if dirt:
            rgb = add_dirt(add_water_streaks(rgb, noise, 0.14 * dirt), noise, 0.06 * dirt)
        if crazed:
            rgb = scale_brightness(
                rgb, 1.0 - 0.4 * np.float32(crazed) * cracks(noise, cells(noise, 4), 0.003)
            )
            bare = smooth_step(2.2, 2.4, noise.clouds(8) + 0.12 * noise.grain(1.2))
            rgb = blend_colours(
                rgb, plain_colour(noise, (0.66, 0.62, 0.56), 0.02, 0.03), 0.7 * bare
            )
            return Picture(rgb, 1.0 - 0.7 * bare)
        return Picture(rgb)

    return make


def _brick(
    units: Sequence[Sequence[float]],
    shift: Sequence[float],
    colours: Sequence[Colour],
    joint: Colour,
) -> Recipe:
    """Return the recipe of a 2.7 m brick wall.

    units: one or two alternating patterns of lengths for its 36 courses
    shift: offsets of the rows, see `courses`
    """

    def make(noise: Noise) -> Picture:
        bonds = [courses(noise.size, 2.7, 36, unit, shift) for unit in units]
        bond = bonds[0]
        if len(bonds) > 1:
            other = (np.arange(noise.size) * 36 // noise.size) % 2 == 1
            bond = type(bond)(
                np.where(other[:, None], bonds[1].id, bond.id),
                np.where(other[:, None], bonds[1].edge, bond.edge),
                max(b.n for b in bonds),
            )
        whole = draw_bond(
            noise, bond, 2.7, colours, joint, joint_m=0.010, spread=0.07, grain=0.03, joint_tint=0.2
        )
        return Picture(add_water_streaks(whole.rgb, noise, 0.08), whole.alpha)

    return Recipe(2.7, make)


def _panels(noise: Noise) -> Picture:
    """Draw cast panels of 3 m x 1.5 m with tie holes."""
    whole = draw_bond(
        noise,
        courses(noise.size, 3.0, 2, [3.0], [0.0]),
        3.0,
        ((0.66, 0.65, 0.63), (0.63, 0.62, 0.60)),
        (0.30, 0.30, 0.29),
        joint_m=0.018,
        bevel_m=0.012,
        spread=0.02,
        wobble_m=0.0,
        grain=0.014,
    )
    at = pixel_centres(noise.size) * 3.0
    x, y = np.meshgrid(at, at)
    hole = 1.0 - smooth_step(
        0.012, 0.022, np.hypot((x % 1.5) - 0.75, np.abs((y % 1.5) - 0.75) - 0.4)
    )
    pores = smooth_step(2.0, 2.8, noise.grain(0.5))
    rgb = scale_brightness(whole.rgb, (1.0 - 0.45 * hole) * (1.0 - 0.12 * pores))
    return Picture(add_water_streaks(rgb, noise, 0.10), whole.alpha)


def _boarded(noise: Noise) -> Picture:
    """Draw concrete with the print of formwork boards."""
    bond = courses(
        noise.size,
        2.4,
        20,
        [
            2.4,
        ],
        [0.0, 0.35, 0.7],
    )
    rgb = draw_bond(
        noise, bond, 2.4, ((0.64, 0.63, 0.61),), (0.50, 0.49, 0.47), joint_m=0.004, spread=0.03
    ).rgb
    return Picture(
        add_water_streaks(scale_brightness(rgb, 1.0 + 0.025 * noise.streaks(64, 8, 1)), noise, 0.05)
    )


def _ashlar(noise: Noise) -> Picture:
    bond = random_courses(
        noise.rng, noise.size, 3.0, [0.3, 0.4, 0.3, 0.35, 0.4, 0.3, 0.35, 0.3, 0.3], (0.45, 0.8)
    )
    return _aged(
        draw_bond(
            noise,
            bond,
            3.0,
            ((0.70, 0.66, 0.58), (0.67, 0.63, 0.56), (0.72, 0.68, 0.61)),
            (0.50, 0.47, 0.42),
            joint_m=0.007,
            bevel_m=0.008,
            spread=0.03,
            clouds=0.035,
        ),
        noise,
    )


def _rubble(noise: Noise) -> Picture:
    bond = bond_from_cells(cells(noise, 12, 0.75), 2.4)
    return _aged(
        draw_bond(
            noise,
            bond,
            2.4,
            ((0.58, 0.54, 0.48), (0.52, 0.49, 0.45), (0.63, 0.58, 0.50)),
            (0.66, 0.62, 0.55),
            joint_m=0.020,
            bevel_m=0.014,
            spread=0.08,
            wobble_m=0.006,
            clouds=0.04,
        ),
        noise,
    )


def _aged(picture: Picture, noise: Noise) -> Picture:
    return Picture(add_water_streaks(picture.rgb, noise, 0.10), picture.alpha)


def _boards(
    side_m: float, board_m: float, upright: bool, colour: Colour = (0.62, 0.54, 0.43)
) -> Recipe:
    """Return the recipe of wooden boards, each with a small shadow on the next."""

    def make(noise: Noise) -> Picture:
        rows = round(side_m / board_m)
        bond = courses(noise.size, side_m, rows, [side_m], noise.rng.random(rows).tolist())
        grain = noise.streaks(128, 32, 1) + 0.7 * noise.streaks(256, 32, 1)
        darker = tuple(0.93 * c for c in colour)
        whole = draw_bond(
            noise,
            bond,
            side_m,
            (colour, (darker[0], darker[1], darker[2])),
            (0.20, 0.17, 0.14),
            joint_m=0.005,
            bevel_m=0.005,
            spread=0.035,
            wobble_m=0.0,
            grain=0.01,
            joint_tint=0.3,
        )
        at = pixel_centres(noise.size) * rows % 1.0
        lap = np.broadcast_to(
            (1.0 - 0.22 * np.exp(-at / 0.10) + 0.05 * at)[:, None], (noise.size,) * 2
        )
        rgb = scale_brightness(whole.rgb, (1.0 + 0.03 * grain) * lap.astype(np.float32))
        alpha = np.asarray(whole.alpha)
        return Picture(rgb.transpose(1, 0, 2), alpha.T) if upright else Picture(rgb, alpha)

    return Recipe(side_m, make)


def _corrugated(noise: Noise) -> Picture:
    """Draw sheet metal with vertical waves of 0.1 m."""
    at = pixel_centres(noise.size) * 20.0
    wave = np.broadcast_to(1.0 + 0.13 * np.sin(2.0 * np.pi * at), (noise.size,) * 2).astype(
        np.float32
    )
    rgb = scale_brightness(plain_colour(noise, (0.66, 0.67, 0.68), 0.012, 0.008), wave)
    return Picture(scale_brightness(rgb, 1.0 - 0.07 * smooth_step(0.5, 2.5, noise.streaks(64, 32))))


def _cassettes(noise: Noise) -> Picture:
    """Draw flat metal panels of 1.5 m x 0.75 m with open joints."""
    bond = courses(noise.size, 3.0, 4, [1.5], [0.0])
    tone = ((0.62, 0.63, 0.65), (0.60, 0.61, 0.63))
    whole = draw_bond(
        noise,
        bond,
        3.0,
        tone,
        (0.14, 0.14, 0.15),
        joint_m=0.016,
        spread=0.015,
        wobble_m=0.0,
        grain=0.006,
        clouds=0.01,
    )
    return Picture(scale_brightness(whole.rgb, 1.0 + 0.01 * noise.streaks(128, 64)), whole.alpha)


def _glazed(noise: Noise) -> Picture:
    bond = courses(noise.size, 1.5, 10, [0.3], [0.0, 0.5])
    return draw_bond(
        noise,
        bond,
        1.5,
        ((0.72, 0.70, 0.66),),
        (0.52, 0.51, 0.49),
        joint_m=0.005,
        spread=0.03,
        wobble_m=0.0,
        grain=0.01,
    )


def _roof_tiles(noise: Noise) -> Picture:
    """Draw pantiles, 0.25 m wide with 0.3125 m visible."""
    size = noise.size
    at = pixel_centres(size)
    across, down = at * 10.0, at * 8.0
    column, row = np.floor(across).astype(int), np.floor(down).astype(int)
    tone = noise.rng.normal(1.0, 0.07, (8, 10)).astype(np.float32)[np.ix_(row, column)]
    hump = (
        0.82
        + 0.22 * np.sin(np.pi * (across % 1.0))
        + 0.06 * np.cos(2.0 * np.pi * (across % 1.0 - 0.2))
    )
    lip = 1.0 - 0.42 * np.exp(-(down % 1.0) / 0.07) + 0.06 * (down % 1.0)
    shape = (hump[None, :] * lip[:, None]).astype(np.float32)
    rgb = scale_brightness(plain_colour(noise, (0.55, 0.35, 0.28), 0.02, 0.025, 8), shape * tone)
    moss = smooth_step(1.0, 2.6, noise.clouds(8) + 0.4 * noise.grain(1.2))
    return Picture(
        blend_colours(
            rgb,
            scale_brightness(plain_colour(noise, (0.36, 0.35, 0.24), 0.02, 0.03), shape),
            0.6 * moss,
        )
    )


def _slate(noise: Noise) -> Picture:
    bond = courses(noise.size, 2.4, 12, [0.3], [0.0, 0.5])
    tones = ((0.36, 0.38, 0.41), (0.40, 0.41, 0.43), (0.33, 0.34, 0.37))
    whole = draw_bond(noise, bond, 2.4, tones, (0.18, 0.18, 0.20), joint_m=0.005, spread=0.06)
    lip = 1.0 - 0.25 * np.exp(-((np.arange(noise.size) + 0.5) / noise.size * 12.0 % 1.0) / 0.06)
    return Picture(
        scale_brightness(
            whole.rgb, np.broadcast_to(lip[:, None], (noise.size,) * 2).astype(np.float32)
        ),
        whole.alpha,
    )


def _roof_gravel(noise: Noise) -> Picture:
    bond = bond_from_cells(cells(noise, 64, 0.9), 2.0)
    return draw_bond(
        noise,
        bond,
        2.0,
        ((0.60, 0.58, 0.55), (0.52, 0.51, 0.49), (0.66, 0.64, 0.61)),
        (0.36, 0.35, 0.33),
        joint_m=0.005,
        bevel_m=0.010,
        spread=0.08,
        joint_tint=0.8,
    )


def _seamed(noise: Noise) -> Picture:
    """Draw a sheet-metal roof with a standing seam every 0.5 m."""
    at = pixel_centres(noise.size) * 4.0 % 1.0
    seam = (
        1.0
        + 0.18 * np.exp(-(((at - 0.48) / 0.012) ** 2))
        - 0.30 * np.exp(-(((at - 0.52) / 0.015) ** 2))
    )
    rgb = plain_colour(noise, (0.48, 0.51, 0.52), 0.012, 0.008)
    return Picture(
        scale_brightness(
            add_water_streaks(rgb, noise, 0.08),
            np.broadcast_to(seam, (noise.size,) * 2).astype(np.float32),
        )
    )


def _felt(noise: Noise) -> Picture:
    """Draw bitumen sheets, 1 m wide."""
    bond = courses(noise.size, 3.0, 3, [3.0], [0.0, 0.4, 0.7])
    return draw_bond(
        noise,
        bond,
        3.0,
        ((0.34, 0.34, 0.35),),
        (0.24, 0.24, 0.25),
        joint_m=0.02,
        spread=0.03,
        grain=0.04,
    )


def _glass(noise: Noise) -> Picture:
    """Draw a curtain wall of 1.5 m panes that reflect sky and street."""
    at = pixel_centres(noise.size) * 2.0 % 1.0
    x, y = np.meshgrid(at, at)
    sky = smooth_step(0.15, 0.85, 1.0 - y + 0.05 * noise.clouds(8))
    rgb = blend_colours((0.15, 0.19, 0.21), (0.44, 0.52, 0.57), sky)
    frame = smooth_step(0.02, 0.028, np.minimum(np.minimum(x, 1.0 - x), np.minimum(y, 1.0 - y)))
    finish = np.stack([frame, np.zeros_like(frame)], axis=-1)
    return Picture(blend_colours((0.25, 0.26, 0.27), rgb, frame), np.full_like(frame, 0.6), finish)


def _bark(noise: Noise) -> Picture:
    ridge = noise.streaks(32, 4) + 0.6 * noise.streaks(64, 4) + 0.4 * noise.clouds(32)
    rgb = blend_colours((0.22, 0.18, 0.15), (0.47, 0.41, 0.35), smooth_step(-1.3, 1.5, ridge))
    return Picture(
        scale_brightness(rgb, relief_shading(blur_field(np.asarray(ridge, np.float32), 1.0), 0.12))
    )


def _foliage(light: Colour, dark: Colour, leaf: int) -> Generator:
    """Return a generator of leaves.

    light, dark: sRGB colours
    leaf: number of leaves per side
    """

    def make(noise: Noise) -> Picture:
        tone = np.zeros((noise.size,) * 2, np.float32)
        for depth in (0.0, 0.45, 1.0):
            leaves = cells(noise, leaf, 1.0)
            some = noise.rng.random(leaves.n).astype(np.float32)
            blade = smooth_step(0.000, 0.25 / leaf, leaves.edge) * (some > 0.35)[leaves.id]
            shade = (0.25 + 0.75 * depth) * (0.65 + 0.5 * some[leaves.id])
            tone = np.where(blade > 0.4, shade * (0.8 + 0.2 * blade), tone).astype(np.float32)
        return Picture(
            blend_colours(dark, light, np.clip(tone * (1.0 + 0.15 * noise.clouds(4)), 0.0, 1.2))
        )

    return make


def _twigs(light: Colour, dark: Colour, leaves: int, long_px: float, wide: float) -> Generator:
    """Return a generator of 2 x 2 pictures of twigs, cut out between the leaves by alpha.

    light, dark: sRGB colours of leaves
    leaves: number of leaves of a twig
    long_px: length of a leaf in pixels of a 256 px texture
    wide: width of a leaf as a fraction of its length
    """

    def make(noise: Noise) -> Picture:
        rng, half = noise.rng, noise.size // 2
        mean = 0.5 * (np.asarray(light) + np.asarray(dark))
        rgb = np.tile(mean.astype(np.float32), (noise.size, noise.size, 1))
        alpha = np.zeros((noise.size, noise.size), np.float32)
        for corner in ((0, 0), (0, half), (half, 0), (half, half)):
            area = slice(corner[0], corner[0] + half), slice(corner[1], corner[1] + half)
            scale = noise.size / 256.0
            colour, cover = rgb[area].copy(), np.zeros((half, half), np.float32)
            for k in range(leaves):
                tone = np.float32((k + 0.5) / leaves * 0.7 + 0.3 * rng.random())
                hue = np.asarray(dark) + (np.asarray(light) - np.asarray(dark)) * tone
                leaf = _leaf(rng, half, scale * long_px, wide)
                mask = np.zeros((half, half), np.uint8)
                cv2.fillPoly(mask, [np.rint(16.0 * leaf).astype(np.int32)], 255, cv2.LINE_AA, 4)
                share = mask.astype(np.float32) / 255.0
                colour = blend_colours(colour, hue.astype(np.float32)[None, None], share)
                cover = np.maximum(cover, share)
            rgb[area], alpha[area] = colour, cover
        return Picture(rgb * (1.0 + 0.08 * noise.grain(1.0))[..., None], alpha)

    return make


def _leaf(
    rng: np.random.Generator, side_px: int, long_px: float, wide: float
) -> NDArray[np.floating]:
    """Return the (8, 2) outline of a leaf on a round twig, in pixels."""
    reach = 0.5 * side_px - 0.62 * long_px
    turn, away = rng.uniform(0.0, 2.0 * np.pi), reach * np.sqrt(rng.random())
    middle = 0.5 * side_px + away * np.array([np.cos(turn), np.sin(turn)])
    way = turn + rng.normal(0.0, 0.9)
    at = np.array([-0.5, -0.25, 0.05, 0.3, 0.5, 0.3, 0.05, -0.25])
    off = np.array([0.0, 0.42, 0.5, 0.3, 0.0, -0.3, -0.5, -0.42]) * wide * rng.uniform(0.6, 1.0)
    turned = np.array([[np.cos(way), np.sin(way)], [-np.sin(way), np.cos(way)]])
    return np.asarray(middle + long_px * rng.uniform(0.75, 1.15) * np.stack([at, off], 1) @ turned)


def _brushed(noise: Noise) -> Picture:
    tone: Field = 1.0 + 0.015 * noise.streaks(256, 64, 1) + 0.01 * noise.clouds(4)
    return Picture(scale_brightness(plain_colour(noise, (0.62, 0.63, 0.64), 0.01, 0.006), tone))


def _painted(noise: Noise) -> Picture:
    rgb = plain_colour(noise, (0.70, 0.70, 0.70), 0.010, 0.008)
    rust = smooth_step(2.5, 3.0, 0.6 * noise.clouds(16) + 0.8 * noise.grain(1.2))
    return Picture(blend_colours(rgb, (0.40, 0.26, 0.18), 0.7 * rust), 1.0 - 0.7 * rust)


WALLS: Final[Mapping[str, Recipe]] = {
    "plaster-smooth": Recipe(3.0, _plaster(0.3, 0.2)),
    "plaster-rough": Recipe(2.0, _plaster(1.6, 0.5)),
    "plaster-stained": Recipe(4.0, _plaster(0.6, 1.0)),
    "plaster-crazed": Recipe(4.0, _plaster(0.5, 0.8, crazed=1.0)),
    "brick-stretcher": _brick([[_STRETCHER]], [0.0, 0.5], _CLAY, _LIME),
    "brick-flemish": _brick([[_STRETCHER, _HEADER]], [0.0, 0.5], _CLAY, _LIME),
    "brick-english": _brick([[_STRETCHER], [_HEADER]], [0.0, 0.25], _CLAY, _LIME),
    "brick-dark": _brick(
        [[_STRETCHER]],
        [0.0, 0.33, 0.67],
        ((0.33, 0.28, 0.27), (0.38, 0.31, 0.29)),
        (0.45, 0.43, 0.41),
    ),
    "brick-pale": _brick(
        [[_STRETCHER]],
        [0.0, 0.5],
        ((0.70, 0.63, 0.51), (0.66, 0.58, 0.47), (0.73, 0.67, 0.57)),
        _LIME,
    ),
    "brick-painted": _brick([[_STRETCHER]], [0.0, 0.5], ((0.80, 0.79, 0.76),), (0.74, 0.73, 0.70)),
    "concrete-panels": Recipe(3.0, _panels),
    "concrete-boarded": Recipe(2.4, _boarded),
    "stone-ashlar": Recipe(3.0, _ashlar),
    "stone-rubble": Recipe(2.4, _rubble),
    "wood-siding": _boards(2.4, 0.15, upright=False),
    "wood-upright": _boards(2.4, 0.12, upright=True),
    "metal-corrugated": Recipe(2.0, _corrugated),
    "metal-panels": Recipe(3.0, _cassettes),
    "tiles-glazed": Recipe(1.5, _glazed),
    "glass": Recipe(3.0, _glass),
    "roof-tiles": Recipe(2.5, _roof_tiles),
    "roof-slate": Recipe(2.4, _slate),
    "roof-gravel": Recipe(2.0, _roof_gravel),
    "roof-metal": Recipe(2.0, _seamed),
    "roof-felt": Recipe(3.0, _felt),
}
"""Recipe of every wall and roof layer by name."""

PROPS: Final[Mapping[str, Recipe]] = {
    "bark": Recipe(0.6, _bark),
    "foliage": Recipe(1.5, _foliage((0.42, 0.52, 0.24), (0.10, 0.15, 0.07), 22)),
    "foliage-dark": Recipe(1.5, _foliage((0.30, 0.41, 0.22), (0.07, 0.11, 0.06), 22)),
    "foliage-autumn": Recipe(1.5, _foliage((0.62, 0.45, 0.20), (0.18, 0.12, 0.06), 22)),
    "hedge": Recipe(1.0, _foliage((0.36, 0.47, 0.23), (0.08, 0.12, 0.06), 32)),
    "leaves": Recipe(1.5, _twigs((0.46, 0.56, 0.26), (0.18, 0.25, 0.10), 74, 20.0, 0.62)),
    "leaves-long": Recipe(1.5, _twigs((0.44, 0.55, 0.27), (0.16, 0.23, 0.10), 90, 24.0, 0.34)),
    "leaves-small": Recipe(1.5, _twigs((0.36, 0.47, 0.26), (0.12, 0.18, 0.09), 130, 14.0, 0.60)),
    "planks": _boards(0.6, 0.1, upright=False, colour=(0.55, 0.41, 0.28)),
    "metal-brushed": Recipe(0.5, _brushed),
    "metal-painted": Recipe(1.0, _painted),
    "stone": Recipe(
        1.0,
        lambda noise: Picture(add_dirt(plain_colour(noise, (0.62, 0.60, 0.57), 0.03, 0.04), noise)),
    ),
}
"""Recipe of every prop layer by name."""

PANE: Final = "pane"
"""Cover of clear glass, which is no layer."""
CUT_OUT: Final = ("leaves", "leaves-long", "leaves-small")
"""Prop layers whose alpha is the visible fraction of the surface, not the fraction of tint."""
