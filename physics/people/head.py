"""Lofts of neck, head and face on the man of 1.75 m."""

from __future__ import annotations

from typing import Final

from physics.people.families import man_rest_m
from physics.people.figure import SMALL, Build, upright_loft
from physics.people.lofted_mesh import Piece, Ring, ball, scaled_vector
from physics.people.skeleton import INDEX

_COARSE: Final = (8, 0, 0, 0)
_SMOOTH: Final = (8, 5, 0, 0)
"""Sides of the small balls of a face, by level of meshes and tubes."""


def neck_and_head(build: Build) -> list[Piece]:
    """Return neck, head with a face, and ears."""
    neck = [
        upright_loft((-0.030, 0.0, 1.455), 0.055, 1.0, 0.058, {"spine3": 0.6, "neck": 0.4}),
        upright_loft((-0.026, 0.0, 1.500), 0.053, 1.05, 0.055, {"spine3": 0.25, "neck": 0.75}),
        upright_loft((-0.016, 0.0, 1.540), 0.050, 1.10, 0.052, {"neck": 0.75, "head": 0.25}),
        upright_loft((-0.006, 0.0, 1.600), 0.050, 1.15, 0.052, {"neck": 0.2, "head": 0.8}),
    ]
    slim = 1.0 - 0.05 * build.woman
    profile = (
        # z, x, half depth ahead, behind, half width, squareness
        (1.526, 0.050, 0.024, 0.020, 0.020, 2.0),
        (1.533, 0.046, 0.034, 0.034, 0.032, 2.0),
        (1.550, 0.030, 0.056, 0.056, 0.050, 2.1),
        (1.580, 0.014, 0.075, 0.074, 0.062, 2.2),
        (1.615, 0.006, 0.084, 0.092, 0.069, 2.2),
        (1.650, 0.002, 0.087, 0.100, 0.073, 2.2),
        (1.680, 0.000, 0.090, 0.103, 0.0755, 2.2),
        (1.708, -0.003, 0.086, 0.101, 0.0745, 2.2),
        (1.732, -0.008, 0.070, 0.086, 0.064, 2.1),
        (1.747, -0.014, 0.044, 0.056, 0.042, 2.0),
        (1.752, -0.016, 0.020, 0.026, 0.020, 2.0),
    )
    head = [
        upright_loft((x, 0.0, z), front, behind / front, wide * slim, {"head": 1.0}, square)
        for z, x, front, behind, wide, square in profile
    ]
    pieces = [
        Piece("skin", tuple(neck), SMALL, (6, 4, 3, 2)),
        Piece("skin", tuple(head), (24, 14, 6, 4), (20, 11, 8, 7)),
        Piece("skin", tuple(_nose()), (8, 5, 4, 0), (6, 4, 3, 0)),
        ball("lips", (0.084, 0.0, 1.577), (0.010, 0.023, 0.0065), {"head": 1.0}, (8, 5, 0, 0)),
    ]
    for left in (1.0, -1.0):
        pieces += _eye_and_ear(left, slim)
    return [about_head(piece, build.head) for piece in pieces]


def _eye_and_ear(left: float, slim: float) -> list[Piece]:
    """Return white, pupil, brow and ear of one side.

    left: 1 or -1
    slim: factor on the head's width
    """
    weights = {"head": 1.0}
    return [
        ball("white", (0.0775, 0.0305 * left, 1.6475), (0.0090, 0.0125, 0.0058), weights, _COARSE),
        ball("dark", (0.0835, 0.0300 * left, 1.6475), (0.0055, 0.0065, 0.0065), weights, _SMOOTH),
        ball("hair", (0.0855, 0.0310 * left, 1.6670), (0.006, 0.0185, 0.0038), weights, _SMOOTH),
        ball(
            "skin",
            (-0.010, 0.076 * left * slim, 1.632),
            (0.017, 0.010, 0.030),
            weights,
            (8, 6, 0, 0),
        ),
    ]


def _nose() -> list[Ring]:
    keys = (
        (1.600, 0.086, 0.012, 0.014),
        (1.606, 0.092, 0.020, 0.017),
        (1.622, 0.090, 0.017, 0.012),
        (1.655, 0.082, 0.010, 0.008),
    )
    return [upright_loft((x, 0.0, z), deep, 1.0, wide, {"head": 1.0}) for z, x, deep, wide in keys]


def about_head(piece: Piece, factor: float) -> Piece:
    """Scale a piece of the head about the joint that carries it."""
    if factor == 1.0:
        return piece
    centre = man_rest_m()[INDEX["head"]]

    def scaled(ring: Ring) -> Ring:
        f = 1.0 + (factor - 1.0) * ring.joints.get("head", 0.0)
        at = tuple(float(c + f * (v - c)) for c, v in zip(centre, ring.at, strict=True))
        return Ring(
            (at[0], at[1], at[2]),
            scaled_vector(ring.ahead, f),
            scaled_vector(ring.side, f),
            ring.joints,
            ring.back,
            ring.square,
        )

    return Piece(
        piece.coat, tuple(scaled(ring) for ring in piece.rings), piece.sides, piece.rings_kept
    )
