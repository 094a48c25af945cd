"""Lofts of wheelchairs, prams, dogs on leads, pushed bicycles and umbrellas.

They are modelled next to the man of 1.75 m. All but umbrellas follow the joint `GROUND`, which
moves with the person's place and heading alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from physics.people.figure import Companion, upright_loft
from physics.people.gestures import SEAT_M, SEATED_BACK_M
from physics.people.lofted_mesh import GROUND, Joints, Piece, Ring, ball

_ON_GROUND: Final[Joints] = {GROUND: 1.0}
_CHEST: Final[Joints] = {"spine3": 1.0}
_BAR: Final = (6, 4, 4, 4)
_Point = tuple[float, float, float]

HANDLES: Final[dict[Companion, tuple[_Point, _Point]]] = {
    "pram": ((0.36, 0.16, 1.00), (0.36, -0.16, 1.00)),
    "bicycle": ((0.34, 0.16, 1.00), (0.18, -0.30, 0.98)),
    "umbrella": ((0.20, 0.17, 1.20), (0.16, -0.28, 0.86)),
    "dog": ((0.02, 0.33, 0.86), (0.16, -0.28, 0.86)),
    "wheelchair": ((0.10, 0.29, 0.98), (0.10, -0.29, 0.98)),
}
"""Places of the left and right wrist, for the arms in `arms.holding`."""
FREE: Final[dict[Companion, tuple[str, ...]]] = {
    "pram": (),
    "bicycle": (),
    "umbrella": ("right",),
    "dog": ("left", "right"),
    "wheelchair": ("left", "right"),
}
"""Arms that swing as in the gait."""


def companion_pieces(what: Companion) -> list[Piece]:
    """Return the surfaces of an object."""
    return {
        "": list,
        "dog": _dog,
        "pram": _pram,
        "bicycle": _bicycle,
        "wheelchair": _wheelchair,
        "umbrella": _umbrella,
    }[what]()


def bar(coat: str, points: Sequence[_Point], radius_m: float, joints: Joints = _ON_GROUND) -> Piece:
    """Return a bent tube through two or more points."""
    places = np.array(points)
    ways = np.gradient(places, axis=0)
    rings = []
    for at, way in zip(places, ways / np.linalg.norm(ways, axis=1, keepdims=True), strict=True):
        aside = np.array((0.0, 1.0, 0.0) if abs(way[1]) < 0.8 else (1.0, 0.0, 0.0))
        first = np.cross(aside, way)
        first *= radius_m / np.linalg.norm(first)
        second = np.cross(way, first)
        rings.append(Ring(tuple(at), tuple(first), tuple(second), joints))
    count = len(rings)
    return Piece(coat, tuple(rings), _BAR, (count, count, count, count))


def wheel(at: _Point, radius_m: float, wide_m: float = 0.012) -> list[Piece]:
    """Return a wheel that rolls ahead: a tyre and spokes.

    wide_m: half its thickness.
    """
    x, y, z = at
    turns = 2.0 * np.pi * np.arange(15) / 14
    rim = [
        (x + (radius_m - wide_m) * math.cos(t), y, z + (radius_m - wide_m) * math.sin(t))
        for t in turns.tolist()
    ]
    tyre = bar("dark", rim, wide_m)
    reach_m = radius_m - wide_m
    spokes = [
        bar(
            "white",
            (
                (x - reach_m * math.cos(t), y, z - reach_m * math.sin(t)),
                (x + reach_m * math.cos(t), y, z + reach_m * math.sin(t)),
            ),
            0.004,
        )
        for t in (0.1, 0.88, 1.67, 2.45)
    ]
    return [
        replace(tyre, rings_kept=(15, 13, 11, 9)),
        *(replace(spoke, sides=(4, 3, 0, 0)) for spoke in spokes),
    ]


def _box(
    coat: str, keys: Sequence[tuple[float, float, float, float]], joints: Joints = _ON_GROUND
) -> Piece:
    """Return a boxy loft upwards.

    keys: z, x, half depth, half width.
    """
    rings = [upright_loft((x, 0.0, z), deep, 1.0, wide, joints, 3.4) for z, x, deep, wide in keys]
    count = len(rings)
    return Piece(coat, tuple(rings), (16, 8, 6, 4), (count, count, count, count))


def _pram() -> list[Piece]:
    pieces = [
        _box("bag", ((0.42, 0.78, 0.16, 0.13), (0.46, 0.78, 0.27, 0.18), (0.70, 0.78, 0.33, 0.20))),
        _box("trim", ((0.69, 0.70, 0.20, 0.17), (0.73, 0.70, 0.20, 0.17))),
        Piece(
            "bag",
            tuple(
                Ring(
                    (0.92 + 0.13 * s, 0.0, 0.72 + 0.19 * c),
                    (0.02, 0.0, 0.02),
                    (0.0, 0.20, 0.0),
                    _ON_GROUND,
                )
                for s, c in ((-0.6, 0.95), (0.1, 1.1), (0.8, 0.8), (1.2, 0.0))
            ),
            (10, 8, 6, 4),
            (4, 4, 4, 4),
        ),
        bar("metal", ((0.40, 0.20, 1.02), (0.40, -0.20, 1.02)), 0.016),
    ]
    for y in (0.19, -0.19):
        pieces.append(bar("metal", ((0.40, y, 1.02), (0.75, y, 0.56), (1.02, y, 0.14)), 0.012))
        pieces.append(bar("metal", ((0.85, y, 0.48), (0.52, y, 0.15)), 0.012))
        pieces += [*wheel((0.52, y * 1.15, 0.145), 0.145), *wheel((1.04, y * 1.05, 0.11), 0.11)]
    return pieces


def _bicycle() -> list[Piece]:
    y = -0.36
    rear, front, saddle, crank, head = (
        (-0.42, y, 0.34),
        (0.62, y, 0.34),
        (-0.14, y, 0.92),
        (0.02, y, 0.30),
        (0.46, y, 0.86),
    )
    return [
        *wheel(rear, 0.34, 0.018),
        *wheel(front, 0.34, 0.018),
        bar("metal", (rear, crank, head), 0.018),
        bar("metal", (saddle, crank), 0.016),
        bar("metal", ((-0.11, y, 0.80), head), 0.016),
        bar("metal", (rear, (-0.11, y, 0.80)), 0.011),
        bar("metal", (front, head, (0.42, y, 1.00)), 0.016),
        bar("dark", ((0.34, y + 0.30, 1.02), (0.42, y, 1.00), (0.34, y - 0.27, 1.02)), 0.016),
        bar("dark", ((-0.26, y, 0.94), (-0.02, y, 0.95)), 0.032),
    ]


def _wheelchair() -> list[Piece]:
    x = -SEATED_BACK_M
    pieces = [
        bar("dark", ((x - 0.16, 0.0, SEAT_M - 0.03), (x + 0.30, 0.0, SEAT_M - 0.03)), 0.20),
        _box("bag", ((SEAT_M, x - 0.20, 0.02, 0.20), (0.95, x - 0.25, 0.02, 0.20))),
    ]
    for y in (0.24, -0.24):
        pieces += [
            *wheel((x - 0.08, 1.12 * y, 0.30), 0.30),
            *wheel((x + 0.42, 0.85 * y, 0.09), 0.09),
        ]
        pieces.append(
            bar(
                "metal",
                (
                    (x - 0.34, y, 0.96),
                    (x - 0.22, y, 0.92),
                    (x - 0.18, y, 0.44),
                    (x + 0.36, y, 0.44),
                ),
                0.014,
            )
        )
        pieces.append(
            bar("metal", ((x - 0.2, y, 0.68), (x + 0.22, y, 0.68), (x + 0.36, y, 0.44)), 0.016)
        )
        pieces.append(bar("metal", ((x + 0.36, 0.6 * y, 0.44), (x + 0.56, 0.5 * y, 0.07)), 0.014))
    return pieces


def _dog() -> list[Piece]:
    x, y, z = 0.42, -0.42, 0.40
    keys = (
        # x, z, half height, half width
        (-0.34, 0.02, 0.03, 0.03),
        (-0.30, 0.02, 0.085, 0.075),
        (-0.16, 0.00, 0.105, 0.085),
        (0.04, -0.02, 0.125, 0.10),
        (0.20, 0.01, 0.115, 0.09),
        (0.31, 0.12, 0.07, 0.06),
        (0.37, 0.20, 0.07, 0.065),
        (0.47, 0.20, 0.055, 0.05),
        (0.58, 0.16, 0.028, 0.03),
    )
    rings = tuple(
        Ring((x + a, y, z + up), (0.0, 0.0, tall), (0.0, wide, 0.0), _ON_GROUND)
        for a, up, tall, wide in keys
    )
    pieces = [Piece("fur", rings, (12, 8, 6, 4), (12, 9, 7, 6))]
    for a, side in ((-0.24, 0.05), (-0.20, -0.05), (0.17, 0.05), (0.22, -0.05)):
        swing = 0.07 if (a < 0.0) == (side > 0.0) else -0.05
        foot = (x + a + swing, y + side, 0.02)
        pieces.append(
            bar(
                "fur", ((x + a, y + side, 0.34), (x + a + 0.3 * swing, y + side, 0.18), foot), 0.030
            )
        )
    pieces.append(bar("fur", ((x - 0.33, y, z + 0.04), (x - 0.44, y, z + 0.16)), 0.022))
    pieces += [
        ball("fur", (x + 0.37, y + side, z + 0.27), (0.02, 0.018, 0.045), _ON_GROUND, (8, 6, 4, 0))
        for side in (0.045, -0.045)
    ]
    hand = HANDLES["dog"][1]
    pieces.append(
        bar(
            "bag", (hand, (0.5 * (hand[0] + x + 0.30), -0.34, 0.58), (x + 0.30, y, z + 0.14)), 0.006
        )
    )
    return pieces


def _umbrella() -> list[Piece]:
    x, y, _ = HANDLES["umbrella"][0]
    top = 2.16
    canopy = [
        upright_loft((x, y, z), wide, 1.0, wide, _CHEST)
        for z, wide in (
            (top - 0.25, 0.46),
            (top - 0.23, 0.48),
            (top - 0.13, 0.40),
            (top - 0.03, 0.20),
            (top, 0.03),
        )
    ]
    return [
        Piece("trim", tuple(canopy), (16, 12, 8, 6), (7, 5, 5, 4)),
        bar("dark", ((x, y, 1.14), (x, y, top + 0.05)), 0.011, _CHEST),
    ]


def reach(what: Companion, side: str) -> _Point | None:
    """Return the place of a hand that holds an object, or None where the arm swings."""
    if not what or side in FREE[what]:
        return None
    left, right = HANDLES[what]
    return left if side == "left" else right


def elbow_of(shoulder: _Point, wrist: _Point, upper_m: float, fore_m: float) -> _Point:
    """Return the place of an elbow that points backwards and down."""
    start, end = np.array(shoulder), np.array(wrist)
    way = end - start
    far = min(float(np.linalg.norm(way)), 0.999 * (upper_m + fore_m))
    way = way / np.linalg.norm(way)
    along = (upper_m**2 + far**2 - fore_m**2) / (2.0 * far)
    down = np.array([-0.5, 0.15 * math.copysign(1.0, shoulder[1]), -1.0])
    down -= way * float(down @ way)
    bend = (
        start
        + way * along
        + down / np.linalg.norm(down) * math.sqrt(max(upper_m**2 - along**2, 0.0))
    )
    return float(bend[0]), float(bend[1]), float(bend[2])
