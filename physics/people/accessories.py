"""Lofts of hair, caps, bags, backpacks and phones, modelled on the man of 1.75 m."""

from __future__ import annotations

from dataclasses import replace
from typing import Final, Literal

from physics.people.arms import on_arm
from physics.people.companions import bar
from physics.people.figure import SMALL, upright_loft
from physics.people.lofted_mesh import Joints, Piece, Ring, ball

Hair = Literal["short", "crop", "curls", "bob", "long", "bun", "tail", "scarf"]
Cap = Literal["", "cap", "beanie"]
Carried = Literal["", "bag", "backpack", "phone"]

_STYLES: Final[dict[Hair, tuple[float, float]]] = {
    "short": (1.585, 0.007),
    "crop": (1.600, 0.002),
    "curls": (1.570, 0.020),
    "bob": (1.515, 0.014),
    "long": (1.40, 0.013),
    "bun": (1.585, 0.004),
    "tail": (1.585, 0.004),
    "scarf": (1.44, 0.016),
}
"""Height of the lower end at the nape, and thickness, metres."""
_HEAD: Final[Joints] = {"head": 1.0}
_TRUNK: Final[Joints] = {"spine3": 0.65, "spine2": 0.35}
_HAIR: Final = (18, 11, 6, 4)


def hair(style: Hair) -> list[Piece]:
    """Return the hair of a style, down to the hairline at the front."""
    nape, full = _STYLES[style]
    coat = "trim" if style == "scarf" else "hair"
    low = (
        # z, x, half depth ahead, behind, half width
        (nape, -0.066, 0.012, 0.030, 0.050),
        (nape + 0.012, -0.064, 0.018, 0.040, 0.058),
    )
    cap = (
        (1.630, -0.040, 0.030, 0.064, 0.0745),
        (1.665, -0.030, 0.045, 0.076, 0.0770),
        (1.692, -0.022, 0.070, 0.083, 0.0785),
        (1.706, -0.010, 0.0835, 0.097, 0.0780),
        (1.726, -0.010, 0.080, 0.094, 0.0720),
        (1.748, -0.014, 0.062, 0.074, 0.0560),
        (1.762, -0.017, 0.036, 0.044, 0.0330),
        (1.766, -0.018, 0.015, 0.018, 0.0140),
    )
    rings = []
    for z, x, front, behind, wide in (*low, *cap):
        behind = behind + full
        wide = wide + full * (0.8 if z < 1.74 else 0.3)
        top = z + full * 0.5 * (z > 1.72)
        joints = _HEAD
        if z < 1.56:
            joints = (
                {"head": 0.6, "neck": 0.4}
                if z > 1.46
                else {"head": 0.2, "neck": 0.3, "spine3": 0.5}
            )
        if style in ("bob", "long", "scarf") and z < 1.6:
            front, wide = front + 0.030, wide + 0.016
        if style in ("long", "scarf") and z < 1.5:
            x = x - 0.022
            wide = wide + 0.022
        rings.append(upright_loft((x, 0.0, top), front, behind / front, wide, joints, 2.1))
    pieces = [Piece(coat, tuple(rings), _HAIR, (15, 9, 7, 5))]
    if style == "bun":
        pieces.append(
            ball("hair", (-0.125, 0.0, 1.700), (0.034, 0.038, 0.036), _HEAD, (10, 7, 6, 4))
        )
    if style == "tail":
        keys = (
            (1.690, -0.105, 0.018),
            (1.680, -0.128, 0.028),
            (1.62, -0.138, 0.032),
            (1.52, -0.128, 0.028),
            (1.44, -0.122, 0.010),
        )
        tail = [
            upright_loft((x, 0.0, z), r, 1.0, 1.15 * r, {"head": 0.8, "neck": 0.2})
            for z, x, r in keys
        ]
        pieces.append(Piece("hair", tuple(tail), SMALL, (7, 5, 4, 4)))
    return pieces


def headgear(kind: Cap) -> list[Piece]:
    """Return a cap with a visor, or a knitted hat."""
    if kind == "beanie":
        return [_beanie()]
    dome = (
        (1.676, -0.006, 0.096, 0.110, 0.083),
        (1.690, -0.006, 0.101, 0.114, 0.0865),
        (1.720, -0.008, 0.094, 0.108, 0.0810),
        (1.748, -0.014, 0.074, 0.086, 0.0660),
        (1.768, -0.018, 0.042, 0.050, 0.0380),
        (1.773, -0.019, 0.016, 0.020, 0.0160),
    )
    rings = [
        upright_loft((x, 0.0, z), front, behind / front, wide, _HEAD, 2.1)
        for z, x, front, behind, wide in dome
    ]
    visor = [
        Ring((x, 0.0, z), (0.0, 0.0, 0.005), (0.0, wide, 0.0), _HEAD, 1.0, 2.4)
        for x, z, wide in (
            (0.060, 1.690, 0.066),
            (0.100, 1.688, 0.068),
            (0.140, 1.681, 0.056),
            (0.165, 1.673, 0.026),
        )
    ]
    return [
        Piece("cap", tuple(rings), _HAIR, (9, 6, 5, 4)),
        Piece("cap", tuple(visor), (10, 8, 6, 4), (5, 4, 3, 3)),
    ]


def _beanie() -> Piece:
    keys = (
        (1.668, -0.010, 0.094, 0.112, 0.086),
        (1.672, -0.010, 0.100, 0.118, 0.091),
        (1.705, -0.010, 0.100, 0.118, 0.090),
        (1.740, -0.014, 0.086, 0.104, 0.080),
        (1.775, -0.022, 0.060, 0.074, 0.058),
        (1.792, -0.026, 0.022, 0.028, 0.022),
    )
    rings = [
        upright_loft((x, 0.0, z), front, behind / front, wide, _HEAD, 2.1)
        for z, x, front, behind, wide in keys
    ]
    return Piece("cap", tuple(rings), _HAIR, (9, 6, 5, 4))


def carried(what: Carried, loose: float = 0.0) -> list[Piece]:
    """Return a carried object: shoulder bag at the left hip, backpack, or phone in the left
    hand.
    """
    if what == "bag":
        return [_bag(), _strap(loose)]
    if what == "backpack":
        return [_backpack(), *(_shoulder_strap(left, loose) for left in (1.0, -1.0))]
    if what == "phone":
        return [_phone()]
    return []


def _bag() -> Piece:
    joints: Joints = {"pelvis": 0.8, "left_hip": 0.2}
    keys = (
        (0.735, 0.115, 0.030),
        (0.742, 0.145, 0.042),
        (0.800, 0.152, 0.048),
        (0.900, 0.148, 0.042),
        (0.955, 0.135, 0.028),
        (0.962, 0.10, 0.018),
    )
    rings = [
        upright_loft((-0.01, 0.225, z), deep, 1.0, wide, joints, 3.2) for z, deep, wide in keys
    ]
    return Piece("bag", tuple(rings), (14, 12, 6, 4), (6, 6, 5, 4))


def _strap(loose: float) -> Piece:
    """Return the strap of the shoulder bag, from the right shoulder over chest and back."""
    ahead = 0.128 + loose
    way = (
        *((0.02, 0.20, 0.95), (ahead - 0.01, 0.10, 1.10), (ahead, 0.0, 1.26)),
        *((ahead - 0.03, -0.07, 1.39), (-0.02, -0.105, 1.497 + 0.4 * loose)),
        *((-0.118 - loose, -0.06, 1.39), (-0.128 - loose, 0.03, 1.22)),
        *((-0.118 - loose, 0.13, 1.06), (-0.02, 0.20, 0.95)),
    )
    return replace(bar("bag", way, 0.013, _TRUNK), sides=(6, 4, 0, 0))


def _backpack() -> Piece:
    joints: Joints = {"spine3": 0.7, "spine2": 0.3}
    keys = (
        (1.02, 0.05, 0.09),
        (1.03, 0.08, 0.135),
        (1.10, 0.095, 0.150),
        (1.25, 0.090, 0.150),
        (1.38, 0.072, 0.135),
        (1.435, 0.040, 0.095),
        (1.44, 0.02, 0.06),
    )
    rings = [
        upright_loft((-0.175 + 0.012 * (z > 1.3), 0.0, z), deep, 1.0, wide, joints, 2.8)
        for z, deep, wide in keys
    ]
    return Piece("bag", tuple(rings), (16, 12, 6, 4), (9, 7, 6, 5))


def _shoulder_strap(left: float, loose: float) -> Piece:
    ahead = 0.118 + loose
    way = (
        *((-0.12, 0.085, 1.42), (-0.03, 0.088, 1.490 + 0.4 * loose), (ahead - 0.045, 0.090, 1.42)),
        *((ahead, 0.095, 1.28), (ahead - 0.03, 0.125, 1.14), (-0.09, 0.14, 1.06)),
    )
    points = [(x, left * y, z) for x, y, z in way]
    return replace(bar("bag", points, 0.017, _TRUNK), sides=(6, 4, 0, 0))


def _phone() -> Piece:
    """Return a phone that lies in the palm of the left hand, along the fingers."""
    rings = [
        on_arm(
            0.585 + 0.145 * share,
            0.0,
            -0.020,
            0.036 * size,
            0.006 * size,
            {"left_hand": 1.0},
            1.0,
            3.5,
        )
        for share, size in ((0.0, 0.9), (0.03, 1.0), (0.97, 1.0), (1.0, 0.9))
    ]
    return Piece("dark", tuple(rings), (10, 8, 6, 0), (4, 4, 3, 0))
