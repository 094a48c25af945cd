"""Shared steps of surface textures: bonds of bricks and stones, joints, grain and dirt."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from physics.textures.layers import Colour, Picture, Rgb
from physics.textures.noise import Cells, Field, Ids, Noise, blur_field, pixel_centres, smooth_step


@dataclass(frozen=True, slots=True)
class Bond:
    """A tileable pattern of bricks, slabs or stones.

    id: (S, S) index of the unit
    edge: (S, S) distance in metres to the centre of the nearest joint
    n: number of units
    """

    id: Ids
    edge: Field
    n: int


def courses(
    size: int, side_m: float, rows: int, unit_m: Sequence[float], shift: Sequence[float]
) -> Bond:
    """Return rows of units of equal height.

    unit_m: repeating lengths of the units in a row
    shift: repeating offsets of the rows, as fractions of the pattern
    """
    pattern = np.asarray(unit_m, dtype=float)
    period = float(pattern.sum())
    times = round(side_m / period)
    ends = np.concatenate([[0.0], np.cumsum(np.tile(pattern, times))]) * (side_m / (period * times))
    return _rows(
        size, side_m, np.linspace(0.0, side_m, rows + 1), [ends] * rows, [s * period for s in shift]
    )


def random_courses(
    rng: np.random.Generator,
    size: int,
    side_m: float,
    heights_m: Sequence[float],
    length_m: tuple[float, float],
) -> Bond:
    """Return rows of given heights with units of random lengths."""
    tops = np.concatenate([[0.0], np.cumsum(heights_m)])
    ends = []
    for _ in heights_m:
        n = round(side_m / (0.5 * sum(length_m)))
        lengths = rng.uniform(*length_m, n)
        ends.append(np.concatenate([[0.0], np.cumsum(lengths)]) * (side_m / lengths.sum()))
    shift = rng.uniform(0.0, side_m, len(heights_m)).tolist()
    return _rows(size, side_m, tops * (side_m / tops[-1]), ends, shift)


def herringbone(size: int, side_m: float, width_m: float) -> Bond:
    """Return a herringbone of bricks twice as long as wide.

    The side must be a multiple of four widths.
    """
    i, j, fx, fy = _grid(size, side_m, width_m)
    k = (i - j) % 4
    lying = k < 2
    x = np.where(lying, fx + (k == 1), fx) * width_m
    y = np.where(lying, fy, fy + (k == 2)) * width_m
    long, wide = np.where(lying, x, y), np.where(lying, y, x)
    first = np.stack([i - (k == 1), j - (k == 2)])
    cells = round(side_m / width_m)
    number = (first[0] % cells) * cells + first[1] % cells
    edge = np.minimum(np.minimum(long, 2 * width_m - long), np.minimum(wide, width_m - wide))
    return Bond(number.astype(np.int32), edge.astype(np.float32), cells * cells)


def basket(size: int, side_m: float, width_m: float) -> Bond:
    """Return pairs of bricks in a basket weave.

    The side must be a multiple of four widths.
    """
    i, j, fx, fy = _grid(size, side_m, width_m)
    lying = ((i // 2 + j // 2) % 2) == 0
    long = (np.where(lying, i % 2 + fx, j % 2 + fy)) * width_m
    wide = np.where(lying, fy, fx) * width_m
    cells = round(side_m / width_m)
    number = np.where(lying, (i // 2 * 2) * cells + j, i * cells + j // 2 * 2)
    edge = np.minimum(np.minimum(long, 2 * width_m - long), np.minimum(wide, width_m - wide))
    return Bond(number.astype(np.int32), edge.astype(np.float32), cells * cells)


def _rows(
    size: int, side_m: float, tops: np.ndarray, ends: Sequence[np.ndarray], shift: Sequence[float]
) -> Bond:
    """Return the bond of rows between `tops` with units between `ends`."""
    at = (np.arange(size) + 0.5) / size * side_m
    row = np.clip(np.searchsorted(tops, at, side="right") - 1, 0, len(tops) - 2)
    down = np.minimum(at - tops[row], tops[row + 1] - at).astype(np.float32)
    most = max(len(e) for e in ends)
    number = np.zeros((len(ends), size), np.int32)
    across = np.zeros((len(ends), size), np.float32)
    for k, end in enumerate(ends):
        x = (at - shift[k % len(shift)]) % side_m
        unit = np.clip(np.searchsorted(end, x, side="right") - 1, 0, len(end) - 2)
        number[k] = unit + k * most
        across[k] = np.minimum(x - end[unit], end[unit + 1] - x)
    return Bond(number[row], np.minimum(across[row], down[:, None]), most * len(ends))


def _grid(size: int, side_m: float, width_m: float) -> tuple[Ids, Ids, Field, Field]:
    """Return (S, S) columns and rows of a square grid, and each pixel's position in its square."""
    at = pixel_centres(size) * round(side_m / width_m)
    whole = np.floor(at).astype(np.int32)
    part = (at - whole).astype(np.float32)
    i, j = np.meshgrid(whole, whole)
    fx, fy = np.meshgrid(part, part)
    return i, j, fx, fy


def plain_colour(
    noise: Noise, colour: Colour, clouds: float = 0.02, grain: float = 0.03, cells: int = 8
) -> Rgb:
    """Return one colour with soft patches and fine grain.

    clouds, grain: standard deviations of sRGB
    """
    tone = np.float32(clouds) * noise.clouds(cells) + np.float32(grain) * noise.grain()
    return np.asarray(
        np.asarray(colour, dtype=np.float32)
        * (1.0 + tone[..., None] / max(sum(colour) / 3.0, 0.1)),
        dtype=np.float32,
    )


def blend_colours(one: Rgb | Colour, two: Rgb | Colour, share: Field) -> Rgb:
    """Blend from `one` at share 0 to `two` at share 1."""
    a, b = np.asarray(one, dtype=np.float32), np.asarray(two, dtype=np.float32)
    return np.asarray(a + (b - a) * share[..., None], dtype=np.float32)


def relief_shading(height: Field, strength: float) -> Field:
    """Return brightness factors of a height field lit from the upper left, about 1."""
    slope = np.roll(height, (-1, -1), (0, 1)) - np.roll(height, (1, 1), (0, 1))
    return np.asarray(1.0 + np.clip(np.float32(strength) * slope, -0.35, 0.35), dtype=np.float32)


def draw_bond(
    noise: Noise,
    bond: Bond,
    side_m: float,
    colours: Sequence[Colour],
    joint: Colour,
    *,
    joint_m: float = 0.006,
    bevel_m: float = 0.004,
    spread: float = 0.05,
    wobble_m: float = 0.0015,
    grain: float = 0.025,
    clouds: float = 0.02,
    joint_tint: float = 0.35,
) -> Picture:
    """Draw a bond of stones and joints.

    colours: sRGB colours of units, chosen randomly
    joint: sRGB colour of joints
    spread: deviation of brightness between units
    wobble_m: unevenness of edges
    joint_tint: fraction of the tint in joints
    """
    pixel_m = side_m / noise.size
    width = max(joint_m, 0.9 * pixel_m)
    edge = bond.edge + np.float32(wobble_m) * noise.clouds(32) if wobble_m else bond.edge
    soft = max(bevel_m, pixel_m)
    face = smooth_step(0.5 * width - 0.5 * soft, 0.5 * width + 0.5 * soft, edge)
    # A joint narrower than a pixel is drawn one pixel wide with less contrast.
    face = 1.0 - (1.0 - face) * np.float32(min(1.0, joint_m / width + 0.25))
    palette = np.asarray(colours, dtype=np.float32)[noise.rng.integers(len(colours), size=bond.n)]
    palette *= (1.0 + noise.rng.normal(0.0, spread, (bond.n, 1))).astype(np.float32)
    tone = 1.0 + np.float32(clouds) * noise.clouds(8) + np.float32(grain) * noise.grain()
    worn = smooth_step(0.0, 4.0 * soft + 0.004, edge - np.float32(0.5 * width))
    tone *= 0.90 + 0.10 * worn
    tone *= relief_shading(blur_field(face, 0.7), 0.10)
    stone = palette[bond.id] * tone[..., None]
    bed = plain_colour(noise, joint, 0.02, grain)
    return Picture(
        blend_colours(bed, stone, face),
        np.float32(joint_tint) + np.float32(1.0 - joint_tint) * face,
    )


def bond_from_cells(found: Cells, side_m: float) -> Bond:
    """Return Voronoi cells as a bond."""
    return Bond(found.id, found.edge * np.float32(side_m), found.n)


def cracks(noise: Noise, found: Cells, width: float, wiggle: float = 0.012) -> Field:
    """Return the intensity of cracks along some cell borders, 0 to 1.

    width: width of a crack as a fraction of the side
    """
    edge = noise.distort(found.edge, wiggle, 8)
    line = 1.0 - smooth_step(0.25 * width, width, edge)
    return np.asarray(line * smooth_step(0.2, 0.9, noise.clouds(4)), dtype=np.float32)


def add_dirt(rgb: Rgb, noise: Noise, depth: float = 0.10, cells: int = 8) -> Rgb:
    """Darken soft patches as by dirt."""
    dirt = smooth_step(-0.4, 2.4, noise.clouds(cells))
    return np.asarray(rgb * (1.0 - np.float32(depth) * dirt[..., None]), dtype=np.float32)


def add_water_streaks(rgb: Rgb, noise: Noise, depth: float) -> Rgb:
    """Darken vertical streaks as by water."""
    runs = smooth_step(-0.6, 3.2, noise.streaks(64, 16) + 0.6 * noise.clouds(8))
    return np.asarray(rgb * (1.0 - np.float32(depth) * runs[..., None]), dtype=np.float32)


def sharpen(rgb: Rgb, amount: float, soft_px: float = 2.0) -> Rgb:
    """Raise the contrast of details smaller than about `soft_px` pixels of a 256 px texture."""
    sigma = soft_px * len(rgb) / 256.0
    soft = np.stack([blur_field(np.ascontiguousarray(rgb[..., c]), sigma) for c in range(3)], -1)
    return np.asarray(rgb + np.float32(amount) * (rgb - soft), dtype=np.float32)


def scale_brightness(rgb: Rgb, factor: Field) -> Rgb:
    """Multiply an image by (S, S) factors."""
    return np.asarray(rgb * factor[..., None], dtype=np.float32)
