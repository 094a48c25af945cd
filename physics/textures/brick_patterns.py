"""Bonds: how bricks, slabs and stones are laid. Each tells, for every pixel, which unit it shows
and how far the nearest joint is. All of them tile."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from physics.textures.noise import Field, Ids


@dataclass(frozen=True, slots=True)
class Bond:
    """A laid surface. id: (S, S) which unit; edge: (S, S) metres to the middle of the nearest
    joint; n: units."""

    id: Ids
    edge: Field
    n: int


def courses(
    size: int, side_m: float, rows: int, unit_m: Sequence[float], shift: Sequence[float]
) -> Bond:
    """Rows of units of equal height. unit_m: lengths that follow each other in a row, a whole
    number of times; shift: how far each row is moved, as a share of the pattern, repeating."""
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
    """Rows of given heights, of units of random lengths."""
    tops = np.concatenate([[0.0], np.cumsum(heights_m)])
    ends = []
    for _ in heights_m:
        n = round(side_m / (0.5 * sum(length_m)))
        lengths = rng.uniform(*length_m, n)
        ends.append(np.concatenate([[0.0], np.cumsum(lengths)]) * (side_m / lengths.sum()))
    shift = rng.uniform(0.0, side_m, len(heights_m)).tolist()
    return _rows(size, side_m, tops * (side_m / tops[-1]), ends, shift)


def herringbone(size: int, side_m: float, width_m: float) -> Bond:
    """Bricks twice as long as wide, at right angles. The side must be a multiple of four widths."""
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
    """Pairs of bricks, turned from square to square. The side must be a multiple of four widths."""
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
    """Columns and rows of a square grid, (S, S), and where in its square each pixel is."""
    at = (np.arange(size, dtype=np.float32) + 0.5) / size * round(side_m / width_m)
    whole = np.floor(at).astype(np.int32)
    part = (at - whole).astype(np.float32)
    i, j = np.meshgrid(whole, whole)
    fx, fy = np.meshgrid(part, part)
    return i, j, fx, fy
