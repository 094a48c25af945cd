"""Walking and running: captured trunk, head and arms over legs solved for feet without sliding.

A gait is one stride, from one touch of the left heel to the next.
Its frames are evenly spaced by distance along the ground.
A foot on the ground moves back under the body by exactly this distance.
It rolls about its heel, rests flat, and rolls about its ball.
A body drawn at the phase of its walked distance therefore does not slide.
Stance times, foot roll and the motion of trunk, head and arms come from the captures.
Their amplitude depends on the stride length.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from cosim.core.geometry import Floats
from cosim.people.gait import PACES_MPS, REFERENCE_M, STRIDES_M
from physics.people.captures import capture
from physics.people.limbs import about_y, about_z, set_leg
from physics.people.skeleton import INDEX, MIRRORED, Skeleton, axis_angle, rodrigues

CYCLE_FRAMES: Final = 32
"""Frames in a stride."""

_HARMONICS: Final = 4
_UPPER: Final = tuple(
    INDEX[name]
    for name in (
        "pelvis",
        "spine1",
        "spine2",
        "spine3",
        "neck",
        "head",
        "left_shoulder",
        "right_shoulder",
        "left_elbow",
        "right_elbow",
    )
)
_SPINE: Final = (INDEX["spine1"], INDEX["spine2"], INDEX["spine3"])
_CLOSER_RAD: Final = 0.09
"""Angle by which arms are closer to the body than in the slimmer captured figure, rad."""
_HEEL_M: Final = (-0.065, -0.095)
"""Contact point of the heel, ahead of and above the ankle, on the reference body, metres."""


@dataclass(frozen=True, slots=True)
class _Style:
    """Parameters that a gait takes from its capture.

    frames: number of frames in a stride
    touch: frame in which the left heel touches the ground
    stride_m: stride length in the capture
    stance: share of the stride with a foot on the ground
    roll: (phase, degrees the toes are up) of the left foot
    lift_m: additional height of the foot in swing
    lean: fraction of the capture's mean lean that is used
    """

    name: str
    frames: int
    touch: float
    stride_m: float
    stance: float
    roll: tuple[tuple[float, float], ...]
    lift_m: float
    lean: float
    behind: float
    bounce: float
    swing: float


_WALK: Final = _Style(
    "walk",
    38,
    18.0,
    1.45,
    0.61,
    (
        (0.0, 17.0),
        (0.09, 0.0),
        (0.30, 0.0),
        (0.46, -17.0),
        (0.61, -54.0),
        (0.70, -48.0),
        (0.84, 0.0),
        (0.93, 15.0),
    ),
    0.035,
    0.35,
    0.058,
    1.3,
    1.0,
)
_RUN: Final = _Style(
    "run",
    24,
    10.5,
    2.3,
    0.36,
    (
        (0.0, 9.0),
        (0.07, 0.0),
        (0.15, 0.0),
        (0.36, -56.0),
        (0.52, -68.0),
        (0.72, -25.0),
        (0.90, 10.0),
    ),
    0.20,
    0.30,
    0.09,
    0.8,
    0.75,
)
_RUNS_FROM_MPS: Final = 2.1


@dataclass(frozen=True, slots=True)
class _Cycle:
    """Capture as one smooth stride with equal left and right sides.

    mean: (24, 3) axis-angle vectors
    change: (FRAMES, 24, 3) offsets from the mean
    bob_m, sway_m: (FRAMES,) motion of the pelvis, up and to the left
    """

    mean: Floats
    change: Floats
    bob_m: Floats
    sway_m: Floats


def gait(knot: int, skeleton: Skeleton, stoop_rad: float = 0.0) -> tuple[Floats, Floats]:
    """Compute the stride at the pace `cosim.people.gait.PACES_MPS[knot]`.

    stoop_rad: bend of the back

    Returns rotations (FRAMES, 24, 3, 3) and pelvis (FRAMES, 3) in metres. The body stays above the
    origin.
    """
    style = _RUN if PACES_MPS[knot] > _RUNS_FROM_MPS else _WALK
    cycle = _cycle(style)
    scale = skeleton.height_m / REFERENCE_M
    stride_m = STRIDES_M[knot] * scale
    share = min(STRIDES_M[knot] / style.stride_m, 1.25)
    mean = cycle.mean.copy()
    mean[INDEX["pelvis"], 1] *= style.lean
    mean[list(_SPINE), 1] += stoop_rad * np.array([0.25, 0.35, 0.4])
    mean[INDEX["neck"], 1] -= 0.45 * stoop_rad
    mean[INDEX["head"], 1] -= 0.35 * stoop_rad
    turns = rodrigues(mean + share * style.swing * cycle.change)
    for side, left in (("left", 1.0), ("right", -1.0)):
        shoulder = INDEX[f"{side}_shoulder"]
        turns[:, shoulder] = rodrigues([-_CLOSER_RAD * left, 0.0, 0.0]) @ turns[:, shoulder]
    pelvis = np.zeros((CYCLE_FRAMES, 3))
    pelvis[:, 1] = scale * cycle.sway_m
    stance = style.stance + (0.06 * (1.0 - share) if style is _WALK else 0.0)
    feet = {
        side: _foot(style, side, stride_m, stance, share, scale, skeleton)
        for side in ("left", "right")
    }
    pelvis[:, 2] = _height(style, cycle, feet, turns, pelvis, share, scale, skeleton)
    for side, (ankle, foot, toe) in feet.items():
        set_leg(turns, pelvis, side, ankle, foot, toe, skeleton)
    return turns, pelvis


def _foot(
    style: _Style,
    side: str,
    stride_m: float,
    stance: float,
    share: float,
    scale: float,
    skeleton: Skeleton,
) -> tuple[Floats, Floats, Floats]:
    """Compute the motion of a foot over a stride.

    Returns ankle (FRAMES, 3) in metres, foot rotation (FRAMES, 3, 3) and toe bend (FRAMES,) in rad.
    """
    phase = (np.arange(CYCLE_FRAMES) / CYCLE_FRAMES + (0.0 if side == "left" else 0.5)) % 1.0
    left = 1.0 if side == "left" else -1.0
    warped = np.where(
        phase < stance,
        phase * style.stance / stance,
        1.0 - (1.0 - phase) * (1.0 - style.stance) / (1.0 - stance),
    )
    roll = np.deg2rad(_periodic(style.roll, warped)) * min(share**0.8, 1.1)
    down = phase < stance
    swing = np.clip((phase - stance) / (1.0 - stance), 0.0, 1.0)
    back = 0.5 * stride_m * stance
    speed = stride_m * (1.0 - stance)
    h = swing
    ahead = (2 * h**3 - 3 * h**2 + 1) * -back + (h**3 - 2 * h**2 + h) * -0.2 * speed
    ahead += (-2 * h**3 + 3 * h**2) * back + (h**3 - h**2) * -0.6 * speed
    x = np.where(down, back - stride_m * phase, ahead) - style.behind * stride_m
    lift = np.where(
        down, 0.0, style.lift_m * scale * np.sqrt(share) * np.sin(np.pi * swing**0.85) ** 1.5
    )
    ankle_rest = skeleton.rest_m[INDEX[f"{side}_ankle"]]
    ball = skeleton.rest_m[INDEX[f"{side}_foot"]] - ankle_rest
    heel = np.array([_HEEL_M[0] * scale, 0.0, -ankle_rest[2]])
    out = np.full(CYCLE_FRAMES, left * np.deg2rad(6.0))
    foot = about_z(out) @ about_y(-roll)
    flat = about_z(out)
    pivot = np.where(roll[:, None] > 0.0, heel, ball)
    apart_m = scale * (0.050 + 0.035 * (1.0 - min(share, 1.0)) if style is _WALK else 0.030)
    place = np.column_stack([x, np.full(CYCLE_FRAMES, left * apart_m), ankle_rest[2] + lift])
    ankle = place + (flat @ pivot[:, :, None] - foot @ pivot[:, :, None])[:, :, 0]
    relaxed = np.clip(1.0 - swing / 0.35, 0.0, 1.0)
    toe = np.maximum(-roll, 0.0) * np.where(down, 1.0, relaxed)
    return ankle, foot, np.minimum(toe, 0.75)


def _height(
    style: _Style,
    cycle: _Cycle,
    feet: dict[str, tuple[Floats, Floats, Floats]],
    turns: Floats,
    pelvis: Floats,
    share: float,
    scale: float,
    skeleton: Skeleton,
) -> Floats:
    """Return (FRAMES,) pelvis heights: the capture's bob, limited by the reach of the legs."""
    bob = style.bounce * cycle.bob_m * scale * share**2
    room = np.full(CYCLE_FRAMES, np.inf)
    for side, (ankle, _, _) in feet.items():
        phase = (np.arange(CYCLE_FRAMES) / CYCLE_FRAMES + (0.0 if side == "left" else 0.5)) % 1.0
        hip, knee, foot = (INDEX[f"{side}_{part}"] for part in ("hip", "knee", "ankle"))
        rest = skeleton.rest_m
        leg = np.linalg.norm(rest[knee] - rest[hip]) + np.linalg.norm(rest[foot] - rest[knee])
        offset = turns[:, 0] @ skeleton.offsets_m[hip]
        aside = ankle[:, :2] - pelvis[:, :2] - offset[:, :2]
        reach = (0.997 * leg) ** 2 - np.sum(aside**2, axis=1)
        free = ankle[:, 2] - offset[:, 2] + np.sqrt(np.maximum(reach, 0.0))
        room = np.minimum(room, np.where(phase < style.stance, free, np.inf))
    return np.asarray(np.min(room - bob) + bob)


@lru_cache(maxsize=4)
def _cycle(style: _Style) -> _Cycle:
    taken = capture(style.name)
    vectors = axis_angle(taken.turns[: style.frames + 1])
    pelvis = taken.pelvis_m[: style.frames + 1]
    curves = np.concatenate([vectors.reshape(len(vectors), -1), pelvis[:, 1:]], axis=1)
    curves = _smooth_loop(curves, style)
    turns = curves[:, :72].reshape(CYCLE_FRAMES, 24, 3)
    (sway, bob) = curves[:, 72:].T
    other = np.roll(turns[:, list(MIRRORED)] * (-1.0, 1.0, -1.0), CYCLE_FRAMES // 2, axis=0)
    both = 0.5 * (turns + other)
    mean = both.mean(axis=0)
    change = np.zeros_like(both)
    change[:, list(_UPPER)] = (both - mean)[:, list(_UPPER)]
    kept = np.zeros_like(mean)
    kept[list(_UPPER)] = mean[list(_UPPER)]
    half = CYCLE_FRAMES // 2
    bob = 0.5 * (bob + np.roll(bob, half))
    sway = 0.5 * (sway - np.roll(sway, half))
    return _Cycle(kept, change, bob - bob.mean(), sway - sway.mean())


def _smooth_loop(curves: Floats, style: _Style) -> Floats:
    """Return (FRAMES, C) one stride from the touch of the left heel, as a short Fourier series.

    curves: (frames + 1, C) of the capture; the gap between end and start is spread over the stride
    """
    frames = style.frames
    closed = curves[:-1] - (curves[-1] - curves[0]) * (np.arange(frames) / frames - 0.5)[:, None]
    series = np.fft.rfft(closed, axis=0) / frames
    order = np.arange(_HARMONICS + 1)
    phase = np.arange(CYCLE_FRAMES) / CYCLE_FRAMES + style.touch / frames
    waves = np.exp(2j * np.pi * phase[:, None] * order) * np.where(order == 0, 1.0, 2.0)
    return np.asarray((waves @ series[: _HARMONICS + 1]).real)


def _periodic(keys: ArrayLike, phase: Floats) -> Floats:
    """Interpolate (phase, value) keys as a smooth loop without overshoot.

    The interpolation is cubic and level at its extremes (Fritsch-Carlson).
    """
    table = np.asarray(keys, dtype=float)
    x = np.concatenate([table[-1:, 0] - 1.0, table[:, 0], table[:2, 0] + 1.0])
    y = np.concatenate([table[-1:, 1], table[:, 1], table[:2, 1]])
    slope = np.diff(y) / np.diff(x)
    product = slope[:-1] * slope[1:]
    inner = np.where(
        product > 0.0, 2.0 * product / np.where(product > 0.0, slope[:-1] + slope[1:], 1.0), 0.0
    )
    tangent = np.concatenate([[0.0], inner, [0.0]])
    k = np.clip(np.searchsorted(x, phase, side="right") - 1, 0, len(x) - 2)
    width = x[k + 1] - x[k]
    t = (phase - x[k]) / width
    value = (1 + 2 * t) * (1 - t) ** 2 * y[k] + t**2 * (3 - 2 * t) * y[k + 1]
    return np.asarray(
        value + width * (t * (1 - t) ** 2 * tangent[k] - t**2 * (1 - t) * tangent[k + 1])
    )
