"""Low-poly parts of scenario obstacles that are not street furniture.

The frame is that of `furniture_shapes`: x along the length, y to the left, z up from the foot. Each
    function takes the size and returns at most about a hundred triangles.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from physics.ground.mesh import Mesh, Part, box, join, quads
from physics.street.furniture_shapes import METAL, WHITE, Size

_RUBBER: Final = (0.07, 0.07, 0.08)
_RED: Final = (0.82, 0.10, 0.09)
_CONCRETE: Final = (0.50, 0.50, 0.48)
_FRAME: Final = (0.33, 0.24, 0.16)
_PAPER: Final = (0.90, 0.88, 0.80)
_WHEEL_SIDES: Final = 10
"""Corners of a wheel."""

_BOARD_M: Final = 0.30
"""Length in metres of the red and white fields of a fence."""


def wheeled_bin(size: Size) -> tuple[Part, ...]:
    """Return a wheeled bin that opens to +x; its wheels are at the back."""
    length, depth, h = size
    body = _tapered((0.36 * length, 0.38 * depth), (0.46 * length, 0.48 * depth), 0.06, 0.9 * h)
    lid = [
        _tapered((0.5 * length, 0.5 * depth), (0.42 * length, 0.42 * depth), 0.9 * h, h),
        box((0.05, 0.8 * depth, 0.05), (-0.5 * length + 0.025, 0.0, 0.9 * h - 0.02)),
    ]
    wheels = [_ring(0.1, 0.1, 0.099, (-0.3 * length, s * 0.32 * depth, 0.1)) for s in (-1, 1)]
    return Part(body, None), Part(join(lid), METAL), Part(join(wheels), _RUBBER)


def bike(size: Size) -> tuple[Part, ...]:
    """Return a bicycle on its stand, with the front wheel towards +x."""
    length, depth, h = size
    r = 0.335
    rear = (-0.5 * length + r, r)
    front = (0.5 * length - r, r)
    pedals = (-0.08, 0.30)
    seat = (-0.20, 0.76)
    head = (front[0] - 0.16, 0.80)
    frame = [
        _tube(rear, pedals, 0.04),
        _tube(pedals, (-0.22, 0.86), 0.045),
        _tube(pedals, head, 0.05),
        _tube(seat, head, 0.045),
        _tube(rear, seat, 0.035),
        _tube((head[0] - 0.05, h - 0.04), front, 0.04),
    ]
    dark = [
        box((0.26, 0.16, 0.07), (-0.24, 0.0, 0.90)),
        box((0.05, depth, 0.04), (head[0] - 0.06, 0.0, h - 0.02)),
        box((0.10, 0.30, 0.03), (pedals[0], 0.0, pedals[1])),
        box((0.03, 0.12, 0.32), (rear[0] + 0.12, 0.07, 0.16)),
    ]
    tyres = [_ring(r, 0.045, 0.04, (x, 0.0, z)) for x, z in (rear, front)]
    return Part(join(frame), None, "metal-painted"), Part(join([*dark, *tyres]), _RUBBER)


def sandwich_board(size: Size) -> tuple[Part, ...]:
    """Return an A-board with one face to the front and one to the back."""
    length, depth, h = size
    lean = math.atan2(0.5 * length - 0.03, h)
    tall = (h - 0.02) / math.cos(lean)
    boards = []
    faces = []
    text_lines = []
    for side in (-1, 1):
        foot = side * (0.5 * length - 0.03)
        pivot = (foot, 0.0, 0.0)
        boards.append(
            box((0.03, depth, tall), (foot, 0.0, 0.5 * tall + 0.005)).tilted(-side * lean, pivot)
        )
        plate = box(
            (0.006, depth - 0.10, 0.78 * tall),
            (foot + side * 0.018, 0.0, 0.55 * tall),
            skip=("bottom",),
        )
        faces.append(plate.tilted(-side * lean, pivot))
        for k, share in enumerate((0.6, 0.45, 0.5)):
            line = (
                (0.008, share * depth, 0.07 * tall),
                (foot + side * 0.020, 0.0, (0.78 - 0.17 * k) * tall),
            )
            text_lines.append(box(*line, skip=("bottom", "top")).tilted(-side * lean, pivot))
    return Part(join(boards), _FRAME), Part(join(faces), None), Part(join(text_lines), _PAPER)


def construction_fence(size: Size) -> tuple[Part, ...]:
    """Return the parts of a fence: a red and white board over bars and uprights, on two feet.

    size: length, depth and height in metres.
    """
    length, depth, h = size
    count = max(2 * round(length / _BOARD_M / 2.0) + 1, 3)
    step = length / count
    fields = [
        box((step, 0.05, 0.25), ((k + 0.5) * step - 0.5 * length, 0.0, h - 0.125))
        for k in range(count)
    ]
    bars = [box((length, 0.04, 0.04), (0.0, 0.0, z)) for z in (0.2, 0.55)]
    uprights = np.linspace(-0.5, 0.5, max(round(length / 0.3), 2) + 1) * (length - 0.06)
    bars += [
        box((0.035, 0.035, h - 0.35), (float(x), 0.0, 0.5 * (h - 0.1)), skip=("top", "bottom"))
        for x in uprights
    ]
    feet = [
        box((0.16, depth, 0.10), (s * (0.5 * length - 0.12), 0.0, 0.05), skip=("bottom",))
        for s in (-1, 1)
    ]
    return (
        Part(join(fields[1::2]), _RED),
        Part(join(fields[::2]), WHITE),
        Part(join(bars), None),
        Part(join(feet), _CONCRETE),
    )


def _tapered(
    low_m: tuple[float, float], high_m: tuple[float, float], from_m: float, to_m: float
) -> Mesh:
    """Return a box without a bottom that widens or narrows upwards.

    low_m, high_m: half length and half depth at the two heights
    from_m, to_m: heights
    """
    turns = np.array([(1, -1), (1, 1), (-1, 1), (-1, -1)])
    low = np.column_stack([turns * low_m, np.full(4, from_m)])
    high = np.column_stack([turns * high_m, np.full(4, to_m)])
    sides = [[low[k], low[(k + 1) % 4], high[(k + 1) % 4], high[k]] for k in range(4)]
    return quads(np.array([*sides, high]))


def _tube(one: tuple[float, float], other: tuple[float, float], thick_m: float) -> Mesh:
    """Return a square bar between two points (x, z) of the centre plane."""
    (x0, z0) = one
    (x1, z1) = other
    far = math.hypot(x1 - x0, z1 - z0)
    bar = box((far, thick_m, thick_m), (x0 + 0.5 * far, 0.0, z0), skip=("front", "back"))
    return bar.tilted(-math.atan2(z1 - z0, x1 - x0), (x0, 0.0, z0))


def _ring(
    radius_m: float, wide_m: float, thick_m: float, centre_m: tuple[float, float, float]
) -> Mesh:
    """Return a wheel that rolls along x, open at the hub: tread and two sides."""
    angle = 2.0 * np.pi * np.arange(_WHEEL_SIDES + 1) / _WHEEL_SIDES
    circle = np.column_stack([np.cos(angle), np.zeros_like(angle), np.sin(angle)])
    half = np.array([0.0, 0.5 * wide_m, 0.0])
    outer = radius_m * circle
    inner = (radius_m - thick_m) * circle
    left = np.stack([inner[:-1], inner[1:], outer[1:], outer[:-1]], axis=1) + half
    right = np.stack([inner[:-1], outer[:-1], outer[1:], inner[1:]], axis=1) - half
    tread = np.stack(
        [outer[:-1] - half, outer[:-1] + half, outer[1:] + half, outer[1:] - half], axis=1
    )
    return quads(np.concatenate([left, right, tread]) + np.asarray(centre_m))
