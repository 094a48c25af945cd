"""Maps of folds, seams, prints, skin and hair, which renderers lay over bodies.

A map covers the body of 1.75 m as modelled, seen from ahead in its left half and from behind in its
right half. Its four channels are bytes:

0  share of the second colour of the clothes
1  brightness, 128 is 1
2  lean of the normal along the body, 128 is none, 255 is 1
3  lean of the normal around the body, likewise
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.core.cache import mapped_arrays, sources_hash
from cosim.core.geometry import Floats
from physics.people.body import COATS
from physics.people.wardrobe import BOTTOM_PATTERNS, TOP_PATTERNS

SIDE_M: Final = 0.40
"""Distance from the body's middle to the border of a map, metres."""
TALL_M: Final = 1.92
"""Height of a map, metres."""
COLUMNS: Final = 2 * 96
ROWS: Final = 224
BEARDS: Final = 4
_CRUMPLE_M: Final = 0.035
_CRUMPLED: Final = 0.28
"""Size (standard deviation of Gaussian blobs, metres) and strength of light and shade on cloth.

Without such folds, networks of real streets mistake people for walls (`cosim bench realism`).
"""
_MADE_BY: Final = sources_hash(Path(__file__).parent)


class _Cloth:
    """Points of a map and what is drawn there.

    y, z: (ROWS, COLUMNS) metres, y to the left; side: its size; front: seen from ahead
    """

    def __init__(self) -> None:
        half = COLUMNS // 2
        column, row = np.meshgrid(np.arange(COLUMNS), np.arange(ROWS))
        self.y = ((column % half + 0.5) / half * 2.0 - 1.0) * SIDE_M
        self.z = (row + 0.5) / ROWS * TALL_M
        self.side = np.abs(self.y)
        self.front = column < half
        self.arm = self.side > 0.190 + 0.05 * np.maximum(1.40 - self.z, 0.0)
        self.second = np.zeros(self.y.shape)
        self.bright = np.ones(self.y.shape)
        self.along = np.zeros(self.y.shape)
        self.around = np.zeros(self.y.shape)

    def packed(self) -> NDArray[np.uint8]:
        """Return (ROWS, COLUMNS, 4) bytes."""
        table = np.stack(
            [
                255.0 * self.second,
                128.0 * self.bright,
                128.0 + 127.0 * self.along,
                128.0 + 127.0 * self.around,
            ],
            axis=-1,
        )
        return np.asarray(np.clip(np.rint(table), 0, 255).astype(np.uint8))


def layer(coat: str, pattern: str = "plain", hangs: bool = False, beard: int = 0) -> int:
    """Return the row of the map of a surface.

    pattern: of tops and bottoms
    hangs: skirts and the tails of coats
    beard: 0 to BEARDS - 1, of skin
    """
    if coat in ("top", "bottom"):
        return _NUMBERS[coat, pattern, hangs]
    return _NUMBERS[coat, "", False] + (beard if coat == "skin" else 0)


@lru_cache(maxsize=1)
def cloth_maps() -> NDArray[np.uint8]:
    """Return all maps, (layers, ROWS, COLUMNS, 4) bytes; row 0 is at the ground."""
    return mapped_arrays("cloth", _MADE_BY, lambda: {"maps": np.stack(list(_made()))})["maps"]


def _made() -> Iterator[NDArray[np.uint8]]:
    for coat, pattern, hangs in _NUMBERS:
        for beard in range(BEARDS if coat == "skin" else 1):
            cloth = _Cloth()
            if coat in ("top", "bottom"):
                _PATTERNS[pattern](cloth)
                _fold(cloth, coat, pattern, hangs)
            elif coat in ("skin", "lips"):
                _skin(cloth, beard)
            elif coat in ("hair", "fur"):
                cloth.bright += 0.22 * np.sin(cloth.y * 330.0 + 3.0 * np.sin(cloth.z * 60.0))
                cloth.bright += 0.16 * _noise(cloth, 0.02) + 0.18 * _blobs(cloth, 0.03, 1)
            elif coat == "shoes":
                cloth.bright += 0.9 * (cloth.z < 0.022) - 0.3 * (abs(cloth.z - 0.028) < 0.006)
            else:
                cloth.bright += 0.08 * _noise(cloth, 0.02) + 0.15 * _blobs(cloth, 0.04, 2)
            yield cloth.packed()


def _plain(cloth: _Cloth) -> None:
    pass


def _stripes(cloth: _Cloth) -> None:
    cloth.second += np.sin(cloth.z * 105.0) > 0.15


def _bands(cloth: _Cloth) -> None:
    cloth.second += np.abs(cloth.z - 1.30) < 0.085


def _check(cloth: _Cloth) -> None:
    cloth.second += 0.34 * (np.sin(cloth.z * 85.0) > 0.0) + 0.34 * (np.sin(cloth.y * 85.0) > 0.0)


def _print(cloth: _Cloth) -> None:
    shape = ((cloth.y / 0.095) ** 4 + ((cloth.z - 1.285) / 0.075) ** 4) < 1.0
    cloth.second += shape & cloth.front & (_noise(cloth, 0.022) > -0.25)


def _open(cloth: _Cloth) -> None:
    gap = 0.030 + 0.055 * np.clip((cloth.z - 0.95) / 0.5, 0.0, 1.0)
    trunk = cloth.front & ~cloth.arm
    cloth.second += trunk & (cloth.side < gap)
    cloth.bright -= 0.4 * (trunk & (np.abs(cloth.side - gap - 0.004) < 0.007))
    lapel = trunk & (cloth.z > 1.22) & (np.abs(cloth.side - gap - 0.045) < 0.005)
    cloth.bright -= 0.25 * lapel


def _zip(cloth: _Cloth) -> None:
    trunk = cloth.front & ~cloth.arm
    cloth.bright -= 0.45 * (trunk & (cloth.side < 0.007))
    pocket = np.abs(cloth.z - 1.06 + 0.6 * (cloth.side - 0.09)) < 0.006
    cloth.bright -= 0.35 * (trunk & pocket & (cloth.side > 0.05) & (cloth.side < 0.13))
    cloth.second += (cloth.z > 1.455) & ~cloth.arm
    cloth.along += 0.25 * np.sin(cloth.z * 70.0) * (cloth.z < 1.4)


def _buttons(cloth: _Cloth) -> None:
    trunk = cloth.front & ~cloth.arm
    cloth.bright -= 0.28 * (trunk & (np.abs(cloth.side - 0.018) < 0.005))
    buttons = (cloth.side < 0.007) & (np.abs(cloth.z % 0.09 - 0.045) < 0.007)
    cloth.bright += 0.35 * (trunk & buttons)
    cloth.bright -= 0.22 * (~cloth.front & (np.abs(cloth.z - 1.38) < 0.005))
    cloth.second += 0.85 * ((cloth.z > 1.468) & ~cloth.arm)


def _knit(cloth: _Cloth) -> None:
    cloth.bright += 0.12 * np.sign(np.sin(cloth.z * 390.0)) + 0.16 * _noise(cloth, 0.012)
    cloth.along += 0.3 * np.sin(cloth.z * 130.0) * (cloth.z < 0.96)


def _pinstripes(cloth: _Cloth) -> None:
    cloth.second += 0.6 * (np.abs(cloth.y % 0.036 - 0.018) < 0.004)


def _denim(cloth: _Cloth) -> None:
    worn = _bump(cloth.z, 0.66, 0.15) * cloth.front + 0.5 * _bump(cloth.z, 0.5, 0.05)
    cloth.bright += 0.55 * worn * _bump(cloth.side, 0.10, 0.05) + 0.12 * _noise(cloth, 0.010)
    pocket = np.abs(np.hypot(cloth.side - 0.075, cloth.z - 0.90) - 0.05) < 0.005
    cloth.bright -= 0.3 * (pocket & ~cloth.front)


def _side_stripe(cloth: _Cloth) -> None:
    cloth.second += cloth.side > 0.138


def _crease(cloth: _Cloth) -> None:
    cloth.bright += 0.16 * (np.abs(cloth.side - 0.092) < 0.006)


def _dots(cloth: _Cloth) -> None:
    cloth.second += 0.9 * (_noise(cloth, 0.030) > 0.25)


_PATTERNS: Final[dict[str, Callable[[_Cloth], None]]] = {
    "plain": _plain,
    "stripes": _stripes,
    "bands": _bands,
    "check": _check,
    "print": _print,
    "open": _open,
    "zip": _zip,
    "buttons": _buttons,
    "knit": _knit,
    "pinstripes": _pinstripes,
    "denim": _denim,
    "side stripe": _side_stripe,
    "crease": _crease,
    "dots": _dots,
}


def _fold(cloth: _Cloth, coat: str, pattern: str, hangs: bool) -> None:
    """Add folds where cloth bends, seams at the waist and mottling."""
    y, z = cloth.y, cloth.z
    x = np.sqrt(np.maximum(0.015 - 0.3 * y * y, 0.0))  # both halves meet at the sides
    if coat == "bottom":
        phase = 74.0 * z + 2.4 * np.sin(25.0 * x + 16.0 * y) + 1.3 * np.sin(17.0 * z + 33.0 * y)
        soft = 0.12 + 0.42 * _bump(z, 0.49, 0.09) + 0.30 * _bump(z, 0.85, 0.06)
        soft += 0.55 * np.clip((0.30 - z) / 0.2, 0.0, 1.0)
    else:
        phase = (
            58.0 * z + 3.0 * np.sin(15.0 * y + 12.0 * x + 4.0 * z) + 1.5 * np.sin(15 * z - 27 * y)
        )
        soft = np.where(
            cloth.arm,
            0.16 + 0.42 * _bump(z, 1.17, 0.10) + 0.25 * _bump(z, 0.93, 0.05),
            0.13 + 0.36 * _bump(z, 1.02, 0.09) + 0.20 * _bump(cloth.side, 0.17, 0.04),
        )
    soft = soft * (0.65 if pattern in ("crease", "zip") else 1.0)
    along, around = soft * np.cos(phase), 0.5 * soft * np.cos(0.6 * phase + 20.0 * y)
    if hangs:
        turn = np.arcsin(np.clip(y / 0.24, -1.0, 1.0))
        falls = np.clip((0.98 - z) / 0.3, 0.0, 1.0) * ~cloth.arm
        phase = np.where(falls > 0.0, 9.0 * turn + 2.0 * np.sin(2.0 * turn + 5.0 * z), phase)
        along, soft = along * (1.0 - falls), np.where(falls > 0.0, 0.5 * falls, soft)
        around = np.where(falls > 0.0, soft * np.cos(phase), around)
    cloth.along += along
    cloth.around += around
    cloth.bright *= 1.0 - 0.45 * soft * (0.5 - 0.5 * np.sin(phase))
    crumple = _blobs(cloth, _CRUMPLE_M, _NUMBERS[coat, pattern, hangs])
    cloth.bright *= np.exp(_CRUMPLED * crumple) * (1.0 + 0.04 * _noise(cloth, 0.009))
    if coat == "top":
        cloth.bright *= 1.0 - 0.25 * ((np.abs(z - 0.925) < 0.006) | (np.abs(z - 1.478) < 0.006))


def _skin(cloth: _Cloth, beard: int) -> None:
    y, z, side = cloth.y, cloth.z, cloth.side
    face = (cloth.front & (z > 1.53)).astype(float)
    cloth.bright -= 0.30 * face * _bump(z, 1.652, 0.014) * _bump(side, 0.031, 0.02)
    cloth.bright -= 0.10 * face * _bump(z, 1.606, 0.007) * _bump(y, 0.0, 0.02)
    cloth.bright -= 0.34 * face * _bump(z, 1.578, 0.006) * _bump(y, 0.0, 0.026)
    cloth.bright += 0.06 * face * _bump(z, 1.70, 0.03) + 0.09 * _blobs(cloth, 0.03, 3)
    fingers = cloth.arm & (z < 0.86)
    cloth.bright -= 0.10 * (fingers & (np.sin(y * 300.0) > 0.6))
    chin = (z > 1.53) & (z < 1.600) & ((side > 0.028) | (z < 1.567) | (z > 1.590))
    cloth.bright *= 1.0 - 0.52 * beard / (BEARDS - 1) * chin


def _bump(x: Floats, middle: float, wide: float) -> Floats:
    return np.asarray(1.0 / (1.0 + ((x - middle) / wide) ** 4))


def _noise(cloth: _Cloth, size_m: float) -> Floats:
    """Return random values from -1 to 1 that change over `size_m`."""
    import cv2

    rng = np.random.default_rng(round(size_m * 1e4))
    shape = max(2, round(TALL_M / size_m)), max(2, round(2.0 * SIDE_M / size_m))
    coarse = rng.uniform(-1.0, 1.0, shape).astype(np.float32)
    fine = cv2.resize(coarse, (COLUMNS // 2, ROWS), interpolation=cv2.INTER_LINEAR)
    return np.asarray(np.tile(fine, (1, 2)), dtype=float)


def _blobs(cloth: _Cloth, size_m: float, seed: int) -> Floats:
    """Return smooth random values with deviation 1, the same ahead and behind."""
    import cv2

    noise = np.random.default_rng(seed).normal(size=(ROWS, COLUMNS // 2)).astype(np.float32)
    columns, rows = size_m * COLUMNS / (4.0 * SIDE_M), size_m * ROWS / TALL_M
    smooth = cv2.GaussianBlur(noise, (0, 0), sigmaX=columns, sigmaY=rows).astype(float)
    return np.asarray(np.tile(smooth / smooth.std(), (1, 2)))


def _numbered() -> dict[tuple[str, str, bool], int]:
    numbers: dict[tuple[str, str, bool], int] = {}
    count = 0
    for coat in COATS:
        if coat in ("top", "bottom"):
            patterns = TOP_PATTERNS if coat == "top" else BOTTOM_PATTERNS
            rows = [(coat, pattern, hangs) for pattern in patterns for hangs in (False, True)]
        else:
            rows = [(coat, "", False)]
        for row in rows:
            numbers[row] = count
            count += BEARDS if coat == "skin" else 1
    return numbers


_NUMBERS: Final = _numbered()
