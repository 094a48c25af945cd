"""Tileable noise fields.

Fields are (S, S) with S a power of two and rows from the top. They wrap at the edges, so textures
have no seams.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cosim.core.state import write_protected_float32

Field = NDArray[np.floating[Any]]
"""(S, S) values."""

Ids = NDArray[np.int32]
"""(S, S) indices."""


class Noise:
    """Noise generator of one layer.

    Cached fields are shifted and mirrored randomly at each call.
    """

    def __init__(self, size: int, seed: tuple[int, ...]) -> None:
        self.size = size
        self.rng = np.random.default_rng(seed)

    def clouds(self, cells: int) -> Field:
        """Return fractal noise with zero mean and unit deviation.

        cells: largest features per side: 2, 4 .. 64
        """
        return self._shifted(_clouds(self.size, cells))

    def grain(self, soft_px: float = 0.0) -> Field:
        """Return white noise with zero mean and unit deviation.

        soft_px: blur in pixels of a 512 px texture
        """
        return self._shifted(_grain(self.size, soft_px))

    def _shifted(self, field: Field) -> Field:
        """Return a field shifted and mirrored randomly."""
        dy, dx = self.rng.integers(0, self.size, 2)
        moved = np.roll(field, (int(dy), int(dx)), axis=(0, 1))
        turn = int(self.rng.integers(4))
        return np.ascontiguousarray(moved[:: 1 - 2 * (turn & 1), :: 1 - (turn & 2)])

    def streaks(self, cells: int, stretch: int, axis: int = 0) -> Field:
        """Return noise stretched along an axis, for run marks, wood grain or brushed metal.

        axis: 0 down, 1 across
        """
        size = self.size
        grid = self.rng.standard_normal((max(2, cells // stretch), cells)).astype(np.float32)
        field = _resized(grid if axis == 0 else np.ascontiguousarray(grid.T), size)
        return np.asarray(field / max(float(field.std()), 1e-6), dtype=np.float32)

    def distort(self, field: Field, by: float, cells: int) -> Field:
        """Return a field distorted by about `by` of the side."""
        dx, dy = (self.clouds(cells) * np.float32(by * self.size) for _ in range(2))
        return warp(field, dx, dy)


@dataclass(frozen=True, slots=True)
class Cells:
    """Voronoi cells.

    id: (S, S) index of the cell
    edge: (S, S) distance to the nearest border as a fraction of the side
    n: number of cells
    """

    id: Ids
    edge: Field
    n: int


def cells(noise: Noise, across: int, jitter: float = 0.8) -> Cells:
    """Return Voronoi cells of a jittered grid of `across` x `across` points."""
    size = noise.size
    n = across * across
    at = (
        np.stack(np.meshgrid(np.arange(across), np.arange(across)), axis=-1)
        .reshape(-1, 2)
        .astype(float)
    )
    at[:, 0] += 0.5 * (at[:, 1] % 2) * (across % 2 == 0)
    at += 0.5 + jitter * noise.rng.uniform(-0.5, 0.5, at.shape)
    pixel = np.floor(at / across * size).astype(int) % size
    margin = min(size // 2, 3 * size // (2 * across) + 2)
    grown = size + 2 * margin
    seeds = np.full((size, size), 255, np.uint8)
    number = np.zeros((size, size), np.int32)
    seeds[pixel[:, 1], pixel[:, 0]] = 0
    number[pixel[:, 1], pixel[:, 0]] = np.arange(n)
    wide = np.pad(seeds, margin, mode="wrap")
    _, labels = cv2.distanceTransformWithLabels(
        wide, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    table = np.zeros(int(labels.max()) + 1, np.int32)
    table[labels[wide == 0]] = np.pad(number, margin, mode="wrap")[wide == 0]
    whole = table[labels]
    border = np.zeros((grown, grown), np.uint8)
    border[:, 1:] |= whole[:, 1:] != whole[:, :-1]
    border[1:] |= whole[1:] != whole[:-1]
    edge = cv2.distanceTransform(1 - border, cv2.DIST_L2, 5)
    middle = slice(margin, margin + size)
    return Cells(whole[middle, middle], np.asarray(edge[middle, middle] / np.float32(size)), n)


def warp(field: Field, dx_px: Field, dy_px: Field) -> Field:
    """Return a field sampled at points shifted by (S, S) pixels."""
    size = len(field)
    across, down = np.meshgrid(np.arange(size, dtype=np.float32), np.arange(size, dtype=np.float32))
    return np.asarray(
        cv2.remap(field, across + dx_px, down + dy_px, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    )


def pixel_centres(size: int) -> Field:
    """Return the (size,) positions of pixel centres along a side, 0 to 1."""
    return (np.arange(size, dtype=np.float32) + 0.5) / size


def blur_field(field: Field, sigma_px: float) -> Field:
    """Return a field with a Gaussian blur."""
    if sigma_px <= 0.05:
        return field
    margin = min(len(field), int(4 * sigma_px) + 1)
    wide = cv2.copyMakeBorder(field, *(margin,) * 4, cv2.BORDER_WRAP)
    soft = cv2.GaussianBlur(wide, (0, 0), sigma_px)
    return np.ascontiguousarray(soft[margin:-margin, margin:-margin])


def smooth_step(low: float, high: float, field: Field) -> Field:
    """Return a smooth step from 0 at `low` to 1 at `high`."""
    t = np.clip((field - np.float32(low)) / np.float32(high - low), 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t), dtype=np.float32)


@lru_cache(maxsize=64)
def _clouds(size: int, cells: int) -> Field:
    rng = np.random.default_rng([size, cells, 1])
    total = np.zeros((size, size), np.float32)
    share = 1.0
    n = cells
    while n <= size // 2:
        total += np.float32(share) * _resized(_grid(rng, n), size)
        share, n = 0.55 * share, 2 * n
    # Warping hides the grid of the random values.
    bend = [np.float32(0.10 * size / cells) * _resized(_grid(rng, cells), size) for _ in range(2)]
    total = warp(total, bend[0], bend[1])
    return write_protected_float32((total - total.mean()) / total.std())


def _grid(rng: np.random.Generator, cells: int) -> Field:
    return rng.standard_normal((cells, cells)).astype(np.float32)


@lru_cache(maxsize=16)
def _grain(size: int, soft_px: float) -> Field:
    # Generated at 512 px and resized, so that all sizes show the same pattern.
    rng = np.random.default_rng([7, round(100 * soft_px)])
    field = blur_field(rng.standard_normal((512, 512)).astype(np.float32), soft_px)
    if size != 512:
        field = cv2.resize(
            field, (size, size), interpolation=cv2.INTER_AREA if size < 512 else cv2.INTER_LINEAR
        )
        # Averaging lowers the contrast; the square root restores half of the loss.
        field *= np.float32(np.sqrt(1.0 / max(float(field.std()), 1e-6)))
    return write_protected_float32(
        field / max(1.0, float(field.std())) if soft_px == 0.0 else field / field.std()
    )


def _resized(grid: Field, size: int) -> Field:
    """Resize a grid of random values to `size` pixels with wrapped cubic interpolation."""
    rows, columns = grid.shape
    wide = cv2.copyMakeBorder(grid, 3, 3, 3, 3, cv2.BORDER_WRAP)
    fy, fx = size // rows, size // columns
    drawn = cv2.resize(wide, ((columns + 6) * fx, (rows + 6) * fy), interpolation=cv2.INTER_CUBIC)
    return np.asarray(drawn[3 * fy : 3 * fy + size, 3 * fx : 3 * fx + size])
