"""Low-poly models of cars, vans, lorries, buses and scooters, selected by length and name.

Vehicle frame: x forward, y left, z = 0 on the road.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from functools import cache
from typing import Final, Literal, NamedTuple

import numpy as np

from physics.ground.mesh import Mesh, Part, box, join, quads
from physics.textures.layers import Colour

Shape = Literal["sedan", "hatchback", "estate", "suv", "van", "lorry", "bus", "scooter"]

_PAINTS: Final = (
    (0.86, 0.86, 0.87),
    (0.12, 0.13, 0.15),
    (0.55, 0.57, 0.60),
    (0.62, 0.11, 0.12),
    (0.13, 0.24, 0.48),
    (0.20, 0.36, 0.28),
    (0.80, 0.68, 0.20),
    (0.34, 0.36, 0.39),
    (0.70, 0.72, 0.74),
    (0.44, 0.31, 0.22),
)
"""sRGB colours of vehicles."""

GLASS: Final = (0.16, 0.20, 0.25)
TYRE: Final = (0.07, 0.07, 0.08)
RIM: Final = (0.58, 0.59, 0.61)
LAMP: Final = (0.94, 0.94, 0.90)
REAR_LAMP: Final = (0.66, 0.05, 0.05)
SKIN: Final = (0.30, 0.31, 0.33)
_CARS: Final[tuple[Shape, ...]] = ("sedan", "hatchback", "estate", "suv")
"""Shapes of cars."""

_SHORT_M: Final = 3.0
"""Length in metres below which a vehicle is a scooter."""

_VAN_M: Final = 5.2
"""Length in metres from which a vehicle is a van."""

_LORRY_M: Final = 6.5
"""Length in metres from which a vehicle is a lorry."""

_BUS_M: Final = 9.0
"""Length in metres from which a vehicle is a bus."""

_LIFT_M: Final = 0.012
"""Distance in metres of windows and lamps in front of the body."""

_Profile = Sequence[tuple[float, float]]
"""Convex outline (x, z) as seen from the right, counter-clockwise."""


class _CarProfile(NamedTuple):
    """Side view of a car, with x as a fraction of the length and z in metres.

    lower: outline of the body
    waist: lower ends of windscreen and rear window
    roof: their upper ends
    """

    lower: _Profile
    waist: tuple[tuple[float, float], tuple[float, float]]
    roof: tuple[tuple[float, float], tuple[float, float]]


_CAR_PROFILES: Final[dict[Shape, _CarProfile]] = {
    "sedan": _CarProfile(
        (
            (-0.5, 0.30),
            (0.5, 0.28),
            (0.5, 0.58),
            (0.43, 0.74),
            (0.22, 0.88),
            (-0.34, 0.92),
            (-0.49, 0.84),
        ),
        ((0.23, 0.86), (-0.36, 0.90)),
        ((0.05, 1.42), (-0.20, 1.42)),
    ),
    "hatchback": _CarProfile(
        ((-0.5, 0.30), (0.5, 0.28), (0.5, 0.60), (0.43, 0.76), (0.25, 0.90), (-0.48, 0.94)),
        ((0.26, 0.88), (-0.48, 0.92)),
        ((0.07, 1.48), (-0.36, 1.46)),
    ),
    "estate": _CarProfile(
        ((-0.5, 0.30), (0.5, 0.28), (0.5, 0.58), (0.43, 0.74), (0.23, 0.88), (-0.49, 0.92)),
        ((0.24, 0.86), (-0.49, 0.90)),
        ((0.06, 1.45), (-0.41, 1.47)),
    ),
    "suv": _CarProfile(
        ((-0.5, 0.38), (0.5, 0.36), (0.5, 0.72), (0.45, 0.92), (0.25, 1.04), (-0.49, 1.06)),
        ((0.26, 1.02), (-0.49, 1.04)),
        ((0.10, 1.68), (-0.42, 1.70)),
    ),
}
"""Side view of each shape of car."""


def vehicle_colour(name: str) -> Colour:
    """Return the colour of a vehicle, determined by its name."""
    return _PAINTS[zlib.crc32(name.encode()) % len(_PAINTS)]


def vehicle_shape(name: str, length_m: float) -> Shape:
    """Return the shape of a vehicle, determined by its name and length."""
    if length_m < _SHORT_M:
        return "scooter"
    if length_m < _VAN_M:
        return _CARS[zlib.crc32(name.encode()) // 16 % len(_CARS)]
    return "van" if length_m < _LORRY_M else "lorry" if length_m < _BUS_M else "bus"


@cache
def vehicle_parts(vehicle_shape: Shape, length_m: float, width_m: float) -> tuple[Part, ...]:
    """Return the parts of a vehicle."""
    if vehicle_shape == "scooter":
        return _scooter(length_m, width_m)
    if vehicle_shape in _CAR_PROFILES:
        return _car(_CAR_PROFILES[vehicle_shape], length_m, width_m)
    return {"van": _van, "lorry": _lorry, "bus": _bus}[vehicle_shape](length_m, width_m)


def _car(car: _CarProfile, length_m: float, width_m: float) -> tuple[Part, ...]:
    half = 0.5 * width_m - 0.03
    lower = _hull([(x * length_m, z) for x, z in car.lower], half, half - 0.04)
    waist, roof = ([(x * length_m, z) for x, z in ends] for ends in (car.waist, car.roof))
    cabin = _hull([waist[1], waist[0], roof[0], roof[1]], half - 0.05, half - 0.20)
    wheelbase = 0.29 * length_m
    wheels = [(x, s * (half - 0.08)) for x in (wheelbase, -wheelbase) for s in (1, -1)]
    tyres, rims = _wheels(wheels, 0.33 if car.roof[0][1] > 1.6 else 0.31, 0.20)
    front = 0.5 * length_m
    low = car.lower[2][1]
    lamps = [_plate(front, s * (half - 0.26), low - 0.08, 0.34, 0.14) for s in (1, -1)]
    rear = [_plate(-front, s * (half - 0.20), car.waist[1][1] - 0.22, 0.28, 0.16) for s in (1, -1)]
    return (
        Part(join([lower, cabin]), None),
        Part(_panes(waist, roof, half - 0.05, half - 0.20), GLASS),
        Part(tyres, TYRE),
        Part(rims, RIM),
        Part(join(lamps), LAMP),
        Part(join(rear), REAR_LAMP),
    )


def _van(length_m: float, width_m: float) -> tuple[Part, ...]:
    half = 0.5 * width_m - 0.03
    front = 0.5 * length_m
    outline = [
        (-front, 0.35),
        (front, 0.32),
        (front, 0.95),
        (front - 0.9, 1.25),
        (front - 1.5, 2.25),
        (-front, 2.3),
    ]
    body = _hull(outline, half, half - 0.10)
    side = [
        _side_pane(
            [(front - 1.12, 1.25), (front - 2.2, 1.25), (front - 2.2, 1.95), (front - 1.5, 1.95)],
            s,
            half - 0.05,
        )
        for s in (1, -1)
    ]
    screen = _cross_pane((front - 0.92, 1.30), (front - 1.44, 2.15), half - 0.12, half - 0.2)
    back = _cross_pane((-front, 2.05), (-front, 1.35), half - 0.25, half - 0.25, back=True)
    return _large_vehicle(body, [*side, screen, back], length_m, half, 0.35, 0.8, 1.0)


def _lorry(length_m: float, width_m: float) -> tuple[Part, ...]:
    half = 0.5 * width_m - 0.03
    front = 0.5 * length_m
    cab = [
        (front - 1.9, 0.5),
        (front, 0.45),
        (front, 1.35),
        (front - 0.25, 2.5),
        (front - 1.9, 2.5),
    ]
    load = box((length_m - 2.1, 2.0 * half, 2.2), (-1.05, 0.0, 2.0))
    frame = box((length_m - 0.6, 1.2 * half, 0.3), (-0.2, 0.0, 0.7))
    side = [
        _side_pane(
            [(front - 0.25, 1.45), (front - 1.3, 1.45), (front - 1.3, 2.2), (front - 0.3, 2.2)],
            s,
            half - 0.02,
        )
        for s in (1, -1)
    ]
    screen = _cross_pane((front - 0.02, 1.45), (front - 0.19, 2.25), half - 0.12, half - 0.12)
    parts = _large_vehicle(
        _hull(cab, half, half - 0.04), [*side, screen], length_m, half, 0.45, 0.75, 0.95
    )
    return (*parts, Part(load, LAMP), Part(frame, SKIN))


def _bus(length_m: float, width_m: float) -> tuple[Part, ...]:
    half = 0.5 * width_m - 0.03
    front = 0.5 * length_m
    body = box((length_m, 2.0 * half, 2.65), (0.0, 0.0, 1.65))
    count = max(round((length_m - 1.6) / 1.5), 1)
    step = (length_m - 1.6) / count
    side = []
    for k in range(count):
        x = -front + 0.8 + k * step
        low = 0.55 if k in (count - 1, count // 2) else 1.3
        for s in (1, -1):
            foot = low if s < 0 else 1.3
            pane = [
                (x + step - 0.06, foot),
                (x + 0.06, foot),
                (x + 0.06, 2.5),
                (x + step - 0.06, 2.5),
            ]
            side.append(_side_pane(pane, s, half))
    screen = _cross_pane((front, 1.1), (front, 2.65), half - 0.12, half - 0.12)
    back = _cross_pane((-front, 2.5), (-front, 1.5), half - 0.25, half - 0.25, back=True)
    return _large_vehicle(body, [*side, screen, back], length_m, half, 0.48, 0.7, 0.9)


def _large_vehicle(
    body: Mesh,
    panes: Sequence[Mesh],
    length_m: float,
    half: float,
    radius_m: float,
    lamp_m: float,
    rear_m: float,
) -> tuple[Part, ...]:
    """Return a large vehicle: body, windows, wheels and lamps.

    radius_m: radius of the wheels
    lamp_m, rear_m: heights of front and rear lamps
    """
    front = 0.5 * length_m
    wheels = [
        (x, s * (half - 0.12))
        for x in (front - 0.22 * length_m, -front + 0.24 * length_m)
        for s in (1, -1)
    ]
    tyres, rims = _wheels(wheels, radius_m, 0.26)
    lamps = [_plate(front, s * (half - 0.25), lamp_m, 0.34, 0.18) for s in (1, -1)]
    rear = [_plate(-front, s * (half - 0.16), rear_m, 0.16, 0.40) for s in (1, -1)]
    return (
        Part(body, None),
        Part(join(list(panes)), GLASS),
        Part(tyres, TYRE),
        Part(rims, RIM),
        Part(join(lamps), LAMP),
        Part(join(rear), REAR_LAMP),
    )


def _scooter(length_m: float, width_m: float) -> tuple[Part, ...]:
    """Return a scooter and its rider with a helmet."""
    front = 0.5 * length_m
    body = _hull(
        [(-0.75 * front, 0.45), (0.3 * front, 0.28), (0.62 * front, 0.95), (-0.8 * front, 0.80)],
        0.16,
        0.13,
    )
    bar = box((0.06, min(width_m, 0.75), 0.06), (0.55 * front, 0.0, 1.02))
    torso = _hull([(-0.30, 0.78), (0.06, 0.78), (0.22, 1.42), (-0.08, 1.45)], 0.20, 0.22)
    legs = [box((0.42, 0.13, 0.16), (0.14, s * 0.17, 0.74)) for s in (1, -1)]
    helmet = box((0.24, 0.22, 0.26), (0.10, 0.0, 1.62))
    tyres, rims = _wheels([(0.72 * front, 0.05), (-0.72 * front, 0.05)], 0.24, 0.10)
    return (
        Part(join([body, helmet]), None),
        Part(join([torso, bar, *legs]), SKIN),
        Part(tyres, TYRE),
        Part(rims, RIM),
        Part(_plate(0.66 * front, 0.0, 0.84, 0.14, 0.12), LAMP),
        Part(_plate(-0.80 * front, 0.0, 0.70, 0.12, 0.08), REAR_LAMP),
    )


def _hull(outline: _Profile, half_low_m: float, half_high_m: float) -> Mesh:
    """Extrude a convex outline (x, z) in metres to both sides.

    half_low_m, half_high_m: half widths at the bottom and the top
    """
    z = np.array([p[1] for p in outline])
    share = (z - z.min()) / (z.max() - z.min())
    half = half_low_m + (half_high_m - half_low_m) * share
    left = np.array([(x, h, height) for (x, height), h in zip(outline, half, strict=True)])
    right = left * (1.0, -1.0, 1.0)
    n = len(left)
    after = (np.arange(n) + 1) % n
    strips = quads(np.stack([right, left, left[after], right[after]], axis=1))
    fan = np.array([(0, i, i + 1) for i in range(1, n - 1)], dtype=np.int32)
    lean = math.atan2(half_low_m - half_high_m, z.max() - z.min())
    side = np.tile([0.0, -math.cos(lean), math.sin(lean)], (n, 1))
    return join(
        [strips, Mesh(right, side, fan), Mesh(left, side * (1.0, -1.0, 1.0), fan[:, ::-1].copy())]
    )


def _panes(waist: _Profile, roof: _Profile, half_low_m: float, half_high_m: float) -> Mesh:
    """Return windscreen, rear window, and two windows on each side."""
    foot, head, brow, sill = (
        _interpolate(waist[k], roof[k], share)
        for k, share in ((0, 0.06), (0, 0.92), (1, 0.90), (1, 0.14))
    )
    front = _cross_pane(foot, head, half_low_m - 0.08, half_high_m - 0.06)
    rear = _cross_pane(brow, sill, half_high_m - 0.08, half_low_m - 0.12, back=True)
    (xf, zf), (xr, zr) = waist
    (tf, tz), (tr, _) = roof
    low = max(zf, zr) + 0.06
    high = tz - 0.08
    sides = []
    for s in (1, -1):
        share = (low - zf) / (tz - zf), (high - zf) / (tz - zf)
        ends = [[xf + (tf - xf) * k - 0.10, xr + (tr - xr) * k + 0.12] for k in share]
        middle = 0.5 * (ends[1][0] + ends[1][1]) - 0.05
        lean = (half_low_m - half_high_m) / (tz - min(zf, zr))
        base = min(zf, zr)
        for x0, x1, t0, t1 in (
            (ends[0][0], middle + 0.04, ends[1][0], middle + 0.04),
            (middle - 0.04, ends[0][1], middle - 0.04, ends[1][1]),
        ):
            y = [half_low_m - lean * (h - base) + _LIFT_M for h in (low, high)]
            corner = [
                (x0, s * y[0], low),
                (x1, s * y[0], low),
                (t1, s * y[1], high),
                (t0, s * y[1], high),
            ]
            sides.append(quads(np.array([corner if s > 0 else corner[::-1]])))
    return join([front, rear, *sides])


def _interpolate(
    a: tuple[float, float], b: tuple[float, float], share: float
) -> tuple[float, float]:
    """Interpolate between two points."""
    return a[0] + (b[0] - a[0]) * share, a[1] + (b[1] - a[1]) * share


def _cross_pane(
    low: tuple[float, float],
    high: tuple[float, float],
    half_low_m: float,
    half_high_m: float,
    back: bool = False,
) -> Mesh:
    """Return a window across the vehicle between two points (x, z), facing forward or back."""
    out = -_LIFT_M if back else _LIFT_M
    (x0, z0) = low
    (x1, z1) = high
    lift = 0.6 * _LIFT_M
    corners = [
        (x0 + out, -half_low_m, z0 + lift),
        (x0 + out, half_low_m, z0 + lift),
        (x1 + out, half_high_m, z1 + lift),
        (x1 + out, -half_high_m, z1 + lift),
    ]
    return quads(np.array([corners]))


def _side_pane(outline: _Profile, side: int, half_m: float) -> Mesh:
    """Return a window on the left (1) or right (-1) side.

    outline: (x, z) from the lower front corner backwards
    """
    corners = [(x, side * (half_m + _LIFT_M), z) for x, z in outline]
    return quads(np.array([corners if side > 0 else corners[::-1]]))


def _plate(x_m: float, y_m: float, z_m: float, width_m: float, height_m: float) -> Mesh:
    """Return a small upright plate on the front (x > 0) or rear that faces outwards."""
    out = math.copysign(_LIFT_M, x_m)
    half, tall = 0.5 * width_m, 0.5 * height_m
    corners = [
        (x_m + out, y_m - half, z_m - tall),
        (x_m + out, y_m + half, z_m - tall),
        (x_m + out, y_m + half, z_m + tall),
        (x_m + out, y_m - half, z_m + tall),
    ]
    return quads(np.array([corners if x_m > 0.0 else corners[::-1]]))


def _wheels(
    at: Sequence[tuple[float, float]], radius_m: float, width_m: float, sides: int = 8
) -> tuple[Mesh, Mesh]:
    """Return tyres and rims of wheels whose centres are at (x, y); rims face outwards."""
    angle = 2.0 * np.pi * np.arange(sides) / sides
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    fan = np.array([(0, i, i + 1) for i in range(1, sides - 1)], dtype=np.int32)
    after = (np.arange(sides) + 1) % sides
    tyres = []
    rims = []
    for x, y in at:
        out = math.copysign(1.0, y)
        rim = np.stack(
            [x + radius_m * circle[:, 0], np.zeros(sides), radius_m * (1.0 + circle[:, 1])], axis=1
        )
        outer, inner = (
            rim + np.array([0.0, y + k * out * 0.5 * width_m, 0.0]) for k in (1.0, -1.0)
        )
        left, right = (outer, inner) if out > 0.0 else (inner, outer)
        tyres.append(quads(np.stack([left, right, right[after], left[after]], axis=1)[:, ::-1]))
        turned = fan[:, ::-1].copy() if out > 0.0 else fan
        face = np.tile([0.0, out, 0.0], (sides, 1))
        tyres.append(Mesh(outer, face, turned))
        middle = np.array([x, 0.0, radius_m])
        hub = middle + (outer - middle) * (0.62, 1.0, 0.62) + np.array([0.0, out * _LIFT_M, 0.0])
        rims.append(Mesh(hub, face, turned))
    return join(tyres), join(rims)
