"""What is drawn of a vehicle: body, glass and tyres for a length and width; x ahead, y left, the road at z = 0."""

from __future__ import annotations

import zlib
from typing import Final

import numpy as np

from physics.mesh import Mesh, box, join, quads

_PAINTS: Final = (
    (0.86, 0.86, 0.87), (0.12, 0.13, 0.15), (0.55, 0.57, 0.60), (0.62, 0.11, 0.12), (0.13, 0.24, 0.48),
    (0.20, 0.36, 0.28), (0.80, 0.68, 0.20),
)  # fmt: skip
GLASS: Final = (0.16, 0.20, 0.25)
TYRE: Final = (0.07, 0.07, 0.08)
BUS_M: Final = 7.0
"""Vehicles longer than this are boxes with a band of windows."""


def paint(name: str) -> tuple[float, float, float]:
    """The colour of the vehicle called `name`: always the same."""
    return _PAINTS[zlib.crc32(name.encode()) % len(_PAINTS)]


def vehicle_meshes(length_m: float, width_m: float) -> tuple[Mesh, Mesh, Mesh]:
    """Painted body, glass, tyres."""
    wheels = [
        box((0.62, 0.22, 0.60), (x, y, 0.30), skip=("top",))
        for x in (0.32 * length_m, -0.32 * length_m)
        for y in (0.5 * width_m - 0.11, -0.5 * width_m + 0.11)
    ]
    tyres = join(wheels)
    if length_m > BUS_M:
        body = box((length_m, width_m - 0.06, 2.5), (0.0, 0.0, 1.6))
        glass = box((length_m + 0.04, width_m, 0.9), (0.0, 0.0, 2.0), skip=("top", "bottom"))
        return body, glass, tyres
    bonnet = 0.78 if length_m > 3.0 else 1.0
    low = box((length_m, width_m - 0.06, 0.58), (0.0, 0.0, 0.51))
    roof = box((0.36 * length_m, width_m - 0.40, 0.06), (-0.06 * length_m, 0.0, 1.45))
    return join([low, roof]), _cabin(length_m, width_m, bonnet), tyres


def _cabin(length_m: float, width_m: float, bonnet: float) -> Mesh:
    """Sloped windows between the car's waist and its roof."""
    x = np.array([0.25 * bonnet, -0.42 * bonnet, 0.11, -0.25]) * length_m
    y = np.array([0.5 * width_m - 0.08, 0.5 * width_m - 0.22])
    low = [(x[0], y[0]), (x[1], y[0]), (x[1], -y[0]), (x[0], -y[0])]
    high = [(x[2], y[1]), (x[3], y[1]), (x[3], -y[1]), (x[2], -y[1])]
    sides = [
        [(*low[i], 0.79), (*low[(i + 1) % 4], 0.79), (*high[(i + 1) % 4], 1.44), (*high[i], 1.44)] for i in range(4)
    ]
    return quads(np.array(sides))
