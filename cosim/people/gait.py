"""How people walk, as far as a snapshot must know it: their statures, their strides, how far in its
stride each is.

A body is drawn at a phase of its stride. The phase follows the way walked, so that feet do not
slide, and strides grow with the pace; so what is counted are strides, each metre in strides of the
length of its moment.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cosim.core.geometry import Floats
from cosim.core.state import Age, RowLookup

REFERENCE_M: Final = 1.75
"""Stature of the person whose strides are listed."""

PACES_MPS: Final = (0.25, 0.6, 1.0, 1.4, 1.9, 2.2, 2.8)
STRIDES_M: Final = (0.45, 0.86, 1.20, 1.48, 1.78, 1.75, 2.15)
"""Stride (two steps) of the reference person at each pace, straight lines between; from 2.2 m/s on
they run.

Walking strides grow with the power 0.5 to 0.6 of the pace, as in Grieve and Gear, The relationships
between length of stride, step frequency, time of swing and speed of walking, Ergonomics 9(5), 1966.
"""

Ages = Sequence[int] | NDArray[np.int8]
_PACES_MPS, _STRIDES_M = np.array(PACES_MPS), np.array(STRIDES_M)

SETTLE_S: Final = 0.25
"""Time constant with which the shown pace follows the speed: how long a start or a stop takes."""

_JUMP_M: Final = 1.0
"""Who moves further in a tick was set there."""


@lru_cache(maxsize=65536)
def stature_m(name: str, age: int) -> float:
    """Height of the person of this `Age` called `name` without shoes: always the same; 1.15 to 1.95
    m.

    Adults are drawn from normal distributions of 1.64 m and 1.77 m +- 0.065 m (women, men).
    """
    draw = zlib.crc32(b"stature " + name.encode())
    if age == Age.CHILD:
        return 1.15 + 0.33 * (draw >> 8 & 0xFFFF) / 65535.0
    middle = 1.64 if is_woman(name) else 1.77
    bell = sum((draw >> shift & 0xFF) / 255.0 - 0.5 for shift in (0, 8, 16, 24)) / np.sqrt(
        4.0 / 12.0
    )
    return float(middle + 0.065 * np.clip(bell, -2.5, 2.5) - (0.03 if age == Age.ELDERLY else 0.0))


def is_woman(name: str) -> bool:
    return bool(zlib.crc32(b"sex " + name.encode()) & 1)


def relative_pace(pace_mps: ArrayLike, stature: ArrayLike) -> Floats:
    """(N,) pace in m/s at which the reference person would walk alike: equal Froude numbers."""
    return np.asarray(pace_mps, dtype=float) * np.sqrt(
        REFERENCE_M / np.asarray(stature, dtype=float)
    )


def stride_m(pace_mps: ArrayLike, stature: ArrayLike) -> Floats:
    """(N,) stride in metres of people of (N,) statures at (N,) paces."""
    scale = np.asarray(stature, dtype=float) / REFERENCE_M
    return np.asarray(scale * np.interp(relative_pace(pace_mps, stature), _PACES_MPS, _STRIDES_M))


@dataclass(slots=True)
class Strides:
    """Counts everybody's strides. period_s: time between two updates."""

    period_s: float
    _rows: RowLookup = field(default_factory=RowLookup)
    _xy: Floats = field(default_factory=lambda: np.zeros((1, 2)))
    _strides: Floats = field(default_factory=lambda: np.zeros(1))
    _pace: Floats = field(default_factory=lambda: np.zeros(1))
    _stature: Floats = field(default_factory=lambda: np.zeros(1))

    def update(
        self, ids: tuple[str, ...], xy: Floats, speed: Floats, age: Ages
    ) -> tuple[Floats, Floats]:
        """Strides taken so far (N,) and paces (N,) m/s, given where people (N, 2) are now and their
        speeds (N,), or the paces that those show who tread on the spot. age: of each, an `Age`.

        Who is new begins somewhere in a stride, drawn from the name, at the pace of the moment.
        """
        row, new = self._rows.of(ids)
        at = self._xy[row]
        strides = self._strides[row]
        pace = self._pace[row]
        stature = self._stature[row]
        for i in new:
            at[i], strides[i], pace[i] = xy[i], first_stride(ids[i]), speed[i]
            stature[i] = stature_m(ids[i], age[i])
        pace = pace + (speed - pace) * min(self.period_s / SETTLE_S, 1.0)
        step = xy - at
        moved = np.hypot(step[:, 0], step[:, 1])
        if ids:
            strides = strides + np.where(moved < _JUMP_M, moved, 0.0) / stride_m(pace, stature)
            self._xy = xy
            self._strides = strides
            self._pace = pace
            self._stature = stature
        return strides, pace


def first_stride(name: str) -> float:
    """Where in the stride, from 0 to 1, the person called `name` begins."""
    return zlib.crc32(b"stride " + name.encode()) / 2**32
