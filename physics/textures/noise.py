"""Noise that tiles: every field here continues over its edges, so that a texture made of it has no
seams.

All fields are (S, S), float32 where it matters for speed, with S a power of two; rows run down the
picture.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Field = NDArray[np.floating[Any]]
Ids = NDArray[np.int32]


class Noise:
    """The noise of one layer: shared fields, each call moved and turned afresh by the layer's own
    generator."""

    def __init__(self, size: int, seed: tuple[int, ...]) -> None:
        self.size = size
        self.rng = np.random.default_rng(seed)

    def clouds(self, cells: int) -> Field:
        """Fractal noise of zero mean and unit deviation; its largest features are 1/`cells` of the
        side: 2, 4 .. 64."""
        return self._moved(_clouds(self.size, cells))

    def grain(self, soft_px: float = 0.0) -> Field:
        """White noise of zero mean and unit deviation, blurred over `soft_px` pixels of a 512 px
        texture."""
        return self._moved(_grain(self.size, soft_px))

    def _moved(self, field: Field) -> Field:
        dy, dx = self.rng.integers(0, self.size, 2)
        moved = np.roll(field, (int(dy), int(dx)), axis=(0, 1))
        turn = int(self.rng.integers(4))
        return np.ascontiguousarray(moved[:: 1 - 2 * (turn & 1), :: 1 - (turn & 2)])

    def streaks(self, cells: int, stretch: int, axis: int = 0) -> Field:
        """Noise drawn out `stretch` times along an axis (0 down, 1 across): run marks, wood grain,
        brushed metal."""
        size = self.size
        grid = self.rng.standard_normal((max(2, cells // stretch), cells)).astype(np.float32)
        field = _resized(grid if axis == 0 else np.ascontiguousarray(grid.T), size)
        return np.asarray(field / max(float(field.std()), 1e-6), dtype=np.float32)

    def warped(self, field: Field, by: float, cells: int) -> Field:
        """A field whose points are moved by about `by` of the side."""
        dx, dy = (self.clouds(cells) * np.float32(by * self.size) for _ in range(2))
        return remapped(field, dx, dy)


@dataclass(frozen=True, slots=True)
class Cells:
    """A division into cells around scattered points. id: (S, S) which cell; edge: distance to the
    nearest border as a share of the side; n: number of cells."""

    id: Ids
    edge: Field
    n: int


def cells(noise: Noise, across: int, jitter: float = 0.8) -> Cells:
    """Cells around the points of a jittered grid of `across` x `across` (Worley's cellular
    pattern)."""
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


def remapped(field: Field, dx_px: Field, dy_px: Field) -> Field:
    """A tiling field read at points moved by (S, S) pixels."""
    size = len(field)
    across, down = np.meshgrid(np.arange(size, dtype=np.float32), np.arange(size, dtype=np.float32))
    return np.asarray(
        cv2.remap(field, across + dx_px, down + dy_px, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    )


def blurred(field: Field, sigma_px: float) -> Field:
    """A tiling field, blurred."""
    if sigma_px <= 0.05:
        return field
    margin = min(len(field), int(4 * sigma_px) + 1)
    wide = cv2.copyMakeBorder(field, *(margin,) * 4, cv2.BORDER_WRAP)
    soft = cv2.GaussianBlur(wide, (0, 0), sigma_px)
    return np.ascontiguousarray(soft[margin:-margin, margin:-margin])


def step(low: float, high: float, field: Field) -> Field:
    """Smooth step from 0 at `low` to 1 at `high`."""
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
    # Bent a little by other noise, so that the grid it was drawn on does not show.
    bend = [np.float32(0.10 * size / cells) * _resized(_grid(rng, cells), size) for _ in range(2)]
    total = remapped(total, bend[0], bend[1])
    return _locked((total - total.mean()) / total.std())


def _grid(rng: np.random.Generator, cells: int) -> Field:
    return rng.standard_normal((cells, cells)).astype(np.float32)


@lru_cache(maxsize=16)
def _grain(size: int, soft_px: float) -> Field:
    # Drawn at 512 and scaled, so that a laptop's texture is a smaller picture of the same thing.
    rng = np.random.default_rng([7, round(100 * soft_px)])
    field = blurred(rng.standard_normal((512, 512)).astype(np.float32), soft_px)
    if size != 512:
        field = cv2.resize(
            field, (size, size), interpolation=cv2.INTER_AREA if size < 512 else cv2.INTER_LINEAR
        )
        # An area's mean is calmer than its points; half of what is lost is given back.
        field *= np.float32(np.sqrt(1.0 / max(float(field.std()), 1e-6)))
    return _locked(field / max(1.0, float(field.std())) if soft_px == 0.0 else field / field.std())


def _resized(grid: Field, size: int) -> Field:
    """A grid of random values, drawn smoothly over `size` pixels, its edges joined."""
    rows, columns = grid.shape
    wide = cv2.copyMakeBorder(grid, 3, 3, 3, 3, cv2.BORDER_WRAP)
    fy, fx = size // rows, size // columns
    drawn = cv2.resize(wide, ((columns + 6) * fx, (rows + 6) * fy), interpolation=cv2.INTER_CUBIC)
    return np.asarray(drawn[3 * fy : 3 * fy + size, 3 * fx : 3 * fx + size])


def _locked(field: NDArray[np.floating]) -> Field:
    whole = np.ascontiguousarray(field, dtype=np.float32)
    whole.flags.writeable = False
    return whole
