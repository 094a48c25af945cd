"""Lofts of trunk and legs, in metres, modelled on the man of 1.75 m in the A pose.

Axes: x ahead, y left, z up, the soles at z = 0. `body` fits them to other families.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

from physics.people.lofted_mesh import Joints, Piece, Ring

LEVELS: Final = 6
"""Levels of detail: two of meshes, then two of tubes, then two of ribbons."""
MESH_LEVELS: Final = 2
RIBBONS: Final = 4
"""First level of ribbons, drawn as the outlines of the tubes of the previous level."""
RIBBON_RINGS: Final = (1.0, 0.5)
"""Share of the rings of these tubes, by level of ribbons."""
Sleeve = Literal["long", "short"]
Legs = Literal["trousers", "shorts", "skirt", "coat"]
Companion = Literal["", "dog", "pram", "bicycle", "wheelchair", "umbrella"]
"""Object that a person leads, pushes, sits in or holds up."""

TORSO: Final = (28, 14, 6, 4)
LIMB: Final = (14, 8, 6, 4)
SMALL: Final = (12, 8, 6, 4)


@dataclass(frozen=True, slots=True)
class Build:
    """Proportions of a figure.

    woman: 0 for a man's trunk, 1 for a woman's
    belly_m: protrusion of the belly, metres
    limb: factor on the thickness of limbs
    head: factor on the size of the head
    """

    woman: float = 0.0
    belly_m: float = 0.0
    limb: float = 1.0
    head: float = 1.0


def torso_pieces(build: Build, loose: float = 0.0, kind: Legs = "trousers") -> list[Piece]:
    """Return shirt, jacket or coat from the hem to the neck, and the seat of the trousers.

    loose: gap between cloth and body, metres
    """
    w, b = build.woman, build.belly_m
    rings = []
    for profile, joints in zip(_torso_profile(w, b), _TORSO_WEIGHTS, strict=True):
        z, x, front, behind, man, woman = profile
        if kind == "skirt" and z < 0.95:
            continue
        wide = man + (woman - man) * w + 0.6 * b * (0.9 < z < 1.2) + loose
        ahead = front + loose
        square = 2.5 if z < 1.4 else 2.2
        rings.append(
            upright_loft(
                (x, 0.0, z),
                ahead,
                (behind + loose) / ahead,
                wide,
                joints,
                square,
                1.0 if z < 1.3 else 0.5,
            )
        )
    if kind == "coat":
        rings = [*_tails(build, loose), *rings[1:]]
        return [
            Piece("top", (_rim(rings[0], 0.03, 0.85), *rings), TORSO, (32, 16, 12, 10)),
            _seat(build),
        ]
    return [
        Piece("top", (_rim(rings[0], -0.004, 0.93), *rings), TORSO, (26, 13, 10, 9)),
        _seat(build),
    ]


_TORSO_WEIGHTS: Final[tuple[Joints, ...]] = (
    {"pelvis": 0.9, "spine1": 0.1},
    {"pelvis": 0.65, "spine1": 0.35},
    {"pelvis": 0.25, "spine1": 0.65, "spine2": 0.1},
    {"spine1": 0.5, "spine2": 0.5},
    {"spine1": 0.1, "spine2": 0.6, "spine3": 0.3},
    {"spine2": 0.35, "spine3": 0.65},
    {"spine2": 0.1, "spine3": 0.9},
    {"spine3": 0.9, "left_collar": 0.05, "right_collar": 0.05},
    {"spine3": 0.85, "left_collar": 0.075, "right_collar": 0.075},
    {"spine3": 0.85, "neck": 0.15},
    {"spine3": 0.7, "neck": 0.3},
    {"spine3": 0.5, "neck": 0.5},
)
"""Joints that move each ring of the torso, with their weights."""


def _torso_profile(w: float, b: float) -> tuple[tuple[float, ...], ...]:
    """Return z, x, half depths ahead and behind, half widths of a man and a woman, of each ring.

    w, b: woman and belly_m of `Build`
    """
    return (
        (0.90, -0.012, 0.110 + 0.6 * b, 0.122 + 0.006 * w, 0.160, 0.176),
        (0.98, -0.012, 0.109 + 0.9 * b, 0.114 + 0.004 * w, 0.156, 0.162),
        (1.06, -0.010, 0.108 + b, 0.100 - 0.006 * w, 0.147, 0.133),
        (1.14, -0.008, 0.109 + 0.8 * b - 0.006 * w, 0.100, 0.150, 0.132),
        (1.22, -0.006, 0.117 + 0.3 * b + 0.014 * w, 0.108, 0.163, 0.146),
        (1.275, -0.006, 0.120 + 0.1 * b + 0.022 * w, 0.114, 0.172, 0.152),
        (1.34, -0.010, 0.113 + 0.006 * w, 0.114, 0.182, 0.160),
        (1.40, -0.018, 0.094, 0.104, 0.178, 0.156),
        (1.453, -0.026, 0.068, 0.082, 0.168, 0.149),
        (1.474, -0.030, 0.059, 0.070, 0.124, 0.110),
        (1.491, -0.031, 0.056, 0.064, 0.080, 0.072),
        (1.500, -0.030, 0.056, 0.060, 0.064, 0.058),
    )


def _rim(hem: Ring, up_m: float, size: float) -> Ring:
    """Return the ring that closes a hem: slightly smaller, above or below it."""
    return upright_loft(
        (hem.at[0], 0.0, hem.at[2] + up_m),
        size * hem.ahead[0],
        hem.back,
        size * hem.side[1],
        hem.joints,
        hem.square,
        hem.fat,
    )


def _tails(build: Build, loose: float) -> list[Ring]:
    """Return the part of a skirt or coat below the hips; it follows both thighs."""
    w, b = build.woman, build.belly_m
    rings = []
    for z, share in ((0.50, 0.72), (0.50 + 0.11, 0.66), (0.74, 0.52), (0.84, 0.30), (0.90, 0.10)):
        flare = max(0.90 - z, 0.0) / 0.4
        ahead = 0.112 + 0.052 * flare + loose + 0.6 * b
        wide = 0.166 + 0.014 * w + 0.062 * flare + loose + 0.4 * b
        joints = {"pelvis": 1.0 - share, "left_hip": 0.5 * share, "right_hip": 0.5 * share}
        rings.append(upright_loft((-0.012, 0.0, z), ahead, 1.12, wide, joints, 2.3, 1.0))
    return rings


def _seat(build: Build) -> Piece:
    """Return hips and crotch in trousers."""
    w, b = build.woman, build.belly_m
    keys = (
        (0.785, -0.010, 0.040, 0.050, 0.045, {"pelvis": 0.4, "left_hip": 0.3, "right_hip": 0.3}),
        (0.805, -0.012, 0.072, 0.085, 0.095, {"pelvis": 0.4, "left_hip": 0.3, "right_hip": 0.3}),
        (
            0.850,
            -0.014,
            0.096,
            0.116,
            0.150 + 0.010 * w,
            {"pelvis": 0.6, "left_hip": 0.2, "right_hip": 0.2},
        ),
        (
            0.900,
            -0.014,
            0.108 + 0.5 * b,
            0.122,
            0.163 + 0.010 * w,
            {"pelvis": 0.9, "left_hip": 0.05, "right_hip": 0.05},
        ),
        (0.960, -0.012, 0.105 + 0.8 * b, 0.110, 0.158, {"pelvis": 0.8, "spine1": 0.2}),
        (1.020, -0.010, 0.098 + 0.9 * b, 0.100, 0.148 - 0.014 * w, {"pelvis": 0.4, "spine1": 0.6}),
    )
    rings = [
        upright_loft(
            (x, 0.0, z), front, behind / front, wide + 0.5 * b * (z > 0.9), joints, 2.4, 1.0
        )
        for z, x, front, behind, wide, joints in keys
    ]
    return Piece("bottom", tuple(rings), (28, 18, 0, 0), (11, 6, 0, 0))


def legs(build: Build, kind: Legs, bare: bool, loose: float = 0.0) -> list[Piece]:
    """Return both legs and shoes.

    bare: skin shows below the cloth of shorts or skirts.
    """
    pieces: list[Piece] = []
    for side, left in (("left", 1.0), ("right", -1.0)):
        hip, knee, ankle = f"{side}_hip", f"{side}_knee", f"{side}_ankle"
        keys = (
            # z, x, y, half depth, half width, weights; of a bare leg
            (0.925, -0.010, 0.084, 0.098, 0.074, {"pelvis": 0.75, hip: 0.25}),
            (0.875, -0.010, 0.086, 0.104, 0.081, {"pelvis": 0.45, hip: 0.55}),
            (0.800, -0.008, 0.088, 0.098, 0.086, {"pelvis": 0.10, hip: 0.90}),
            (0.700, -0.002, 0.089, 0.086, 0.078, {hip: 1.0}),
            (0.600, 0.003, 0.091, 0.072, 0.066, {hip: 0.95, knee: 0.05}),
            (0.535, 0.006, 0.092, 0.064, 0.059, {hip: 0.75, knee: 0.25}),
            (0.495, 0.005, 0.092, 0.061, 0.056, {hip: 0.48, knee: 0.52}),
            (0.450, 0.000, 0.092, 0.058, 0.054, {hip: 0.2, knee: 0.8}),
            (0.370, -0.010, 0.092, 0.060, 0.056, {knee: 1.0}),
            (0.290, -0.014, 0.092, 0.055, 0.051, {knee: 1.0}),
            (0.190, -0.018, 0.092, 0.042, 0.040, {knee: 1.0}),
            (0.110, -0.022, 0.092, 0.038, 0.036, {knee: 0.7, ankle: 0.3}),
            (0.070, -0.022, 0.092, 0.038, 0.036, {knee: 0.2, ankle: 0.8}),
        )
        if kind in ("trousers", "coat") or not bare:
            cloth = [
                (
                    z,
                    x,
                    y,
                    a + 0.010 * (z < 0.5) + 0.012 * (z < 0.2),
                    s + 0.010 * (z < 0.5) + 0.012 * (z < 0.2),
                    j,
                )
                for z, x, y, a, s, j in keys[:-1]
            ]
            cloth[-1] = (0.085, -0.020, 0.092, 0.064, 0.056, {knee: 0.6, ankle: 0.4})
            pieces.append(_leg(cloth, left, build, "bottom", (22, 12, 8, 7)))
        else:
            pieces.append(
                _leg(keys if kind == "skirt" else keys[3:], left, build, "skin", (22, 12, 8, 7))
            )
            if kind == "shorts":
                wide = [(z, x, y, a + 0.012, s + 0.012, j) for z, x, y, a, s, j in keys[:6]]
                pieces.append(_leg(wide, left, build, "bottom", (10, 6, 4, 3)))
        pieces += _shoe(side, left)
    if kind == "skirt":
        pieces.append(_skirt(build, loose))
    return pieces


def _leg(
    keys: Sequence[tuple[float, float, float, float, float, Joints]],
    left: float,
    build: Build,
    coat: str,
    kept: tuple[int, ...],
) -> Piece:
    f = build.limb
    rings = [
        upright_loft((x, y * left, z), a * f, 1.0, s * f, joints, 2.15, 0.5)
        for z, x, y, a, s, joints in keys
    ]
    return Piece(coat, tuple(rings), LIMB, kept)


def _skirt(build: Build, loose: float) -> Piece:
    w, b = build.woman, build.belly_m
    waist = [
        upright_loft(
            (-0.011, 0.0, z),
            front + b + loose,
            1.03,
            man - (man - woman) * w + 0.6 * b + loose,
            joints,
            2.4,
            1.0,
        )
        for z, front, man, woman, joints in (
            (0.97, 0.118, 0.164, 0.172, {"pelvis": 0.7, "spine1": 0.3}),
            (1.05, 0.114, 0.155, 0.142, {"pelvis": 0.3, "spine1": 0.7}),
        )
    ]
    rings = [*_tails(build, loose + 0.004), *waist, _rim(waist[-1], 0.003, 0.9)]
    return Piece("bottom", (_rim(rings[0], 0.03, 0.85), *rings), TORSO, (16, 9, 7, 7))


def _shoe(side: str, left: float) -> list[Piece]:
    ankle, foot = f"{side}_ankle", f"{side}_foot"
    keys = (
        # x, half width, low, high, weight of the toes
        (-0.091, 0.018, 0.020, 0.050, 0.0),
        (-0.082, 0.031, 0.008, 0.078, 0.0),
        (-0.050, 0.038, 0.0, 0.104, 0.0),
        (-0.010, 0.039, 0.0, 0.110, 0.0),
        (0.035, 0.041, 0.0, 0.088, 0.0),
        (0.080, 0.046, 0.0, 0.066, 0.15),
        (0.115, 0.048, 0.0, 0.056, 0.55),
        (0.150, 0.044, 0.0, 0.046, 0.95),
        (0.178, 0.032, 0.004, 0.036, 1.0),
        (0.192, 0.014, 0.010, 0.026, 1.0),
    )
    rings = []
    for x, wide, low, high, toes in keys:
        joints = {name: v for name, v in ((ankle, 1.0 - toes), (foot, toes)) if v}
        half = 0.5 * (high - low)
        y = left * (0.092 + 0.06 * (x + 0.025))
        rings.append(Ring((x, y, low + half), (0.0, 0.0, half), (0.0, wide, 0.0), joints, 1.0, 2.6))
    return [Piece("shoes", tuple(rings), (12, 8, 6, 4), (14, 9, 6, 6))]


def upright_loft(
    at: tuple[float, float, float],
    ahead: float,
    back: float,
    side: float,
    joints: Joints,
    square: float = 2.0,
    fat: float = 0.0,
) -> Ring:
    return Ring(at, (ahead, 0.0, 0.0), (0.0, side, 0.0), joints, back, square, fat)
