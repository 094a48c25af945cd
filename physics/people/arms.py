"""Lofts of arms and hands on the man of 1.75 m, along a straight arm in the A pose."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from physics.people.companions import bar, elbow_of
from physics.people.families import man_rest_m
from physics.people.figure import LIMB, SMALL, Build, Sleeve
from physics.people.lofted_mesh import Joints, Piece, Ring, ball, scaled_vector
from physics.people.skeleton import INDEX, REACH_RAD

Holds = Mapping[str, tuple[float, float, float] | None]
"""Place of the wrist, by side, of arms that hold an object in place of swinging."""


def arms(
    build: Build, sleeve: Sleeve, loose: float = 0.0, holds: Holds | None = None
) -> list[Piece]:
    """Return both arms in sleeves, and the hands."""
    pieces: list[Piece] = []
    for side, left in (("left", 1.0), ("right", -1.0)):
        wrist_m = None if holds is None else holds[side]
        if wrist_m is not None:
            pieces += _holding(build, sleeve, loose, left, wrist_m)
            continue
        collar, shoulder, elbow, wrist = (
            f"{side}_{part}" for part in ("collar", "shoulder", "elbow", "wrist")
        )
        keys = (
            # distance along the arm from the shoulder, half depth, half width across, weights
            (-0.020, 0.020, 0.014, {"spine3": 0.1, collar: 0.5, shoulder: 0.4}),
            (-0.008, 0.037, 0.027, {collar: 0.5, shoulder: 0.5}),
            (0.014, 0.050, 0.039, {collar: 0.35, shoulder: 0.65}),
            (0.050, 0.054, 0.048, {collar: 0.1, shoulder: 0.9}),
            (0.110, 0.052, 0.050, {shoulder: 1.0}),
            (0.190, 0.045, 0.045, {shoulder: 1.0}),
            (0.245, 0.041, 0.041, {shoulder: 0.78, elbow: 0.22}),
            (0.280, 0.040, 0.040, {shoulder: 0.48, elbow: 0.52}),
            (0.315, 0.041, 0.040, {shoulder: 0.18, elbow: 0.82}),
            (0.370, 0.039, 0.038, {elbow: 1.0}),
            (0.450, 0.032, 0.031, {elbow: 0.95, wrist: 0.05}),
            (0.510, 0.027, 0.025, {elbow: 0.7, wrist: 0.3}),
            (0.540, 0.027, 0.022, {elbow: 0.35, wrist: 0.65}),
        )
        f = build.limb
        skin = [(t, a * f, s * f, j) for t, a, s, j in keys]
        cloth = [
            (t, a * f + 0.005 + 0.7 * loose, s * f + 0.005 + 0.7 * loose, j) for t, a, s, j in keys
        ]
        if sleeve == "long":
            pieces.append(_arm(cloth[:-1], side, left, "top", (22, 11, 9, 7)))
            pieces.append(_arm(skin[-3:], side, left, "skin", (3, 2, 0, 0), SMALL))
        else:
            short = [*cloth[:5], (0.165, 0.056 * f + loose, 0.054 * f + loose, {shoulder: 1.0})]
            pieces.append(_arm(short, side, left, "top", (10, 6, 4, 4)))
            pieces.append(_arm(skin[3:], side, left, "skin", (18, 10, 8, 6)))
        pieces += _hand(side, left)
    return pieces


def _arm(
    keys: Sequence[tuple[float, float, float, Joints]],
    side: str,
    left: float,
    coat: str,
    kept: tuple[int, ...],
    sides: tuple[int, ...] = LIMB,
) -> Piece:
    rings = [
        on_arm(t, 0.0, -0.008 * max(1.0 - max(t, 0.0) / 0.1, 0.0), a, s, joints, left, 2.0, 0.4)
        for t, a, s, joints in keys
    ]
    return Piece(coat, tuple(rings), sides, kept)


def _holding(
    build: Build, sleeve: Sleeve, loose: float, left: float, wrist_m: tuple[float, float, float]
) -> list[Piece]:
    """Return an arm bent towards an object; it moves with the chest."""
    chest = {"spine3": 1.0}
    x, y, z = man_rest_m()[INDEX["left_shoulder"]].tolist()
    shoulder = (x, left * (y + 0.012), z - 0.012)
    elbow = elbow_of(shoulder, wrist_m, 0.28, 0.255)
    f, more = build.limb, 0.005 + 0.7 * loose
    mid = [0.5 * (a + b) for a, b in zip(shoulder, elbow, strict=True)]
    low = [0.4 * a + 0.6 * b for a, b in zip(elbow, wrist_m, strict=True)]
    keys = [
        (shoulder, 0.050),
        (tuple(mid), 0.047),
        (elbow, 0.041),
        (tuple(low), 0.036),
        (wrist_m, 0.026),
    ]
    skin = bar("skin", [at for at, _ in keys[1:]], 0.031 * f, chest)
    bent = bar("top", [at for at, _ in keys], 1.0, chest)
    rings = tuple(
        replace(
            ring,
            ahead=scaled_vector(ring.ahead, r * f + more),
            side=scaled_vector(ring.side, r * f + more),
        )
        for ring, (_, r) in zip(bent.rings, keys, strict=True)
    )
    shown = rings if sleeve == "long" else rings[:2]
    pieces = [
        Piece("top", shown, LIMB, (9, 6, 4, 3) if sleeve == "long" else (5, 3, 2, 2)),
        ball("skin", wrist_m, (0.045, 0.036, 0.040), chest, (10, 8, 6, 4)),
    ]
    if sleeve == "short":
        pieces.append(replace(skin, sides=LIMB, rings_kept=(7, 4, 3, 3)))
    return pieces


def _hand(side: str, left: float) -> list[Piece]:
    """Return palm, four fingers and thumb. Coarse levels merge the fingers with the palm."""
    wrist = {f"{side}_wrist": 1.0}
    hand = {f"{side}_wrist": 0.25, f"{side}_hand": 0.75}
    palm = (
        (0.525, 0.0, 0.024, 0.019, wrist),
        (0.550, 0.0, 0.032, 0.018, wrist),
        (0.580, 0.0, 0.041, 0.017, wrist),
        (0.615, 0.0, 0.042, 0.016, wrist),
        (0.640, 0.0, 0.038, 0.013, {f"{side}_wrist": 0.7, f"{side}_hand": 0.3}),
    )
    whole = (
        *palm[:-1],
        (0.650, 0.0, 0.037, 0.012, hand),
        (0.685, -0.002, 0.033, 0.010, hand),
        (0.704, -0.004, 0.020, 0.007, hand),
    )
    pieces = [
        Piece(
            "skin",
            tuple(on_arm(t, x, 0.0, a, s, j, left, 2.5) for t, x, a, s, j in palm),
            (12, 0, 0, 0),
            (7, 0, 0, 0),
        ),
        Piece(
            "skin",
            tuple(on_arm(t, x, 0.0, a, s, j, left, 2.5) for t, x, a, s, j in whole),
            (0, 8, 6, 4),
            (0, 6, 4, 4),
        ),
    ]
    for x, length, spread in (
        (0.0315, 0.068, 0.16),
        (0.0105, 0.078, 0.05),
        (-0.0105, 0.073, -0.05),
        (-0.031, 0.058, -0.17),
    ):
        rings = [
            on_arm(
                0.628 + length * share,
                x + spread * length * share,
                -0.010 * share**2,
                thick,
                0.93 * thick,
                hand,
                left,
            )
            for share, thick in ((0.0, 0.0095), (0.45, 0.0095), (0.85, 0.0080), (1.0, 0.0045))
        ]
        pieces.append(Piece("skin", tuple(rings), (6, 0, 0, 0), (4, 0, 0, 0)))
    thumb = [
        on_arm(
            0.560 + 0.078 * share, 0.030 + 0.052 * share, -0.008 * share, thick, thick, wrist, left
        )
        for share, thick in ((0.0, 0.015), (0.35, 0.0135), (0.75, 0.0105), (1.0, 0.006))
    ]
    pieces.append(Piece("skin", tuple(thumb), (6, 5, 4, 0), (4, 3, 3, 0)))
    return pieces


def on_arm(
    way: float,
    ahead: float,
    palm: float,
    deep: float,
    across: float,
    joints: Joints,
    left: float,
    square: float = 2.0,
    fat: float = 0.0,
) -> Ring:
    """Return a ring on the arm.

    way: distance along the arm from the shoulder
    ahead, palm: offsets from the arm's axis, forwards and to the back of the hand
    """
    x, y, z = man_rest_m()[INDEX["left_shoulder"]].tolist()
    cos, sin = math.cos(float(REACH_RAD)), math.sin(float(REACH_RAD))
    at = (
        x + ahead - 0.01 * math.sin(math.pi * min(max(way, 0.0) / 0.55, 1.0)),
        y + way * cos + palm * sin,
        z - way * sin + palm * cos,
    )
    return Ring(
        (at[0], left * at[1], at[2]),
        (deep, 0.0, 0.0),
        (0.0, left * across * sin, across * cos),
        joints,
        1.0,
        square,
        fat,
    )
