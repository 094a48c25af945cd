"""Walking gait of people: stature, stride length and stride count.

A body is drawn at a phase of its stride. The phase follows the walked distance, so that feet do not
slide. Strides grow with the pace, so each metre counts in strides of the current length.
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
"""Stature of the reference person in metres."""

PACES_MPS: Final = (0.25, 0.6, 1.0, 1.4, 1.9, 2.2, 2.8)
"""Paces at which the reference person's stride is given, in m/s."""
STRIDES_M: Final = (0.45, 0.86, 1.20, 1.48, 1.78, 1.75, 2.15)
"""Stride (two steps) of the reference person at each pace in metres, interpolated linearly; running
starts at 2.2 m/s.

Walking strides grow with the power 0.5 to 0.6 of the pace, as in Grieve and Gear, The relationships
between length of stride, step frequency, time of swing and speed of walking, Ergonomics 9(5), 1966.
"""

Ages = Sequence[int] | NDArray[np.int8]
_PACES_MPS = np.array(PACES_MPS)
_STRIDES_M = np.array(STRIDES_M)

PACE_TIME_CONSTANT_S: Final = 0.25
"""Time constant in seconds with which the shown pace follows the speed."""

_JUMP_M: Final = 1.0
"""Distance in metres above which a move in one tick is a teleport."""


@lru_cache(maxsize=65536)
def stature_m(name: str, age: int) -> float:
    """Return a person's height without shoes in metres, 1.15 to 1.95, determined by name and `Age`.

    Adults follow normal distributions of 1.64 m (women) and 1.77 m (men), with 0.065 m standard
    deviation.
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
    """Return whether the person with this name is drawn as a woman."""
    return bool(zlib.crc32(b"sex " + name.encode()) & 1)


def relative_pace(pace_mps: ArrayLike, stature: ArrayLike) -> Floats:
    """Return the reference person's pace with an equal Froude number, (N,) m/s."""
    return np.asarray(pace_mps, dtype=float) * _pace_scale(stature)


def stride_m(pace_mps: ArrayLike, stature: ArrayLike) -> Floats:
    """Return the stride of people of (N,) statures at (N,) paces, (N,) metres."""
    pace = relative_pace(pace_mps, stature)
    return np.asarray(_length_scale(stature) * np.interp(pace, _PACES_MPS, _STRIDES_M))


def _length_scale(stature: ArrayLike) -> Floats:
    return np.asarray(stature, dtype=float) / REFERENCE_M


def _pace_scale(stature: ArrayLike) -> Floats:
    return np.asarray(np.sqrt(REFERENCE_M / np.asarray(stature, dtype=float)))


@dataclass(slots=True)
class Strides:
    """Counts the strides of all people.

    period_s: time between two updates in seconds.
    """

    period_s: float
    _rows: RowLookup = field(default_factory=RowLookup)
    _xy: Floats = field(default_factory=lambda: np.zeros((1, 2)))
    _strides: Floats = field(default_factory=lambda: np.zeros(1))
    _pace: Floats = field(default_factory=lambda: np.zeros(1))
    _stature: Floats = field(default_factory=lambda: np.ones(1))
    _length_scale: Floats = field(default_factory=lambda: np.ones(1))
    _pace_scale: Floats = field(default_factory=lambda: np.ones(1))

    def update(
        self, ids: tuple[str, ...], xy: Floats, speed: Floats, age: Ages
    ) -> tuple[Floats, Floats]:
        """Return the strides taken so far (N,) and the shown paces (N,) m/s.

        A new person starts at a phase drawn from the name, with the current speed as pace.

        ids: ids of the people.
        xy: (N, 2) positions in metres.
        speed: (N,) m/s; for a person who turns on the spot, the shown pace.
        age: `Age` of each.
        """
        row, new = self._rows.of(ids)
        at, strides, pace = self._xy, self._strides, self._pace
        if ids and not isinstance(row, slice):
            at, strides, pace = at[row], strides[row], pace[row]
            self._stature = stature = self._stature[row]
            for i in new:
                at[i], strides[i], pace[i] = xy[i], first_stride(ids[i]), speed[i]
                stature[i] = stature_m(ids[i], age[i])
            self._length_scale, self._pace_scale = _length_scale(stature), _pace_scale(stature)
        if not ids:
            return np.zeros(0), np.zeros(0)
        change = speed - pace
        change *= min(self.period_s / PACE_TIME_CONSTANT_S, 1.0)
        pace = pace + change
        step = xy - at
        moved = np.hypot(step[:, 0], step[:, 1])
        stride = np.interp(pace * self._pace_scale, _PACES_MPS, _STRIDES_M)
        stride *= self._length_scale
        walked = moved < _JUMP_M
        if 0 in walked.tobytes():
            moved = np.where(walked, moved, 0.0)
        moved /= stride
        strides = strides + moved
        self._xy = xy
        self._strides = strides
        self._pace = pace
        return strides, pace


def first_stride(name: str) -> float:
    """Return the initial phase of a person's stride, 0 to 1."""
    return zlib.crc32(b"stride " + name.encode()) / 2**32
