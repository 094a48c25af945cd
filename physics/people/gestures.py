"""Gestures of people on the spot: idle, looking, talking, queueing, sitting, gestures of the arms.

Each is a loop of `LOOP_S` seconds over the SMPL joints, with feet on the ground.
The body breathes and shifts its weight.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Final

import numpy as np

from cosim.core.geometry import Floats
from cosim.people.gait import REFERENCE_M
from physics.people.limbs import about_y, about_z, set_arm, set_leg
from physics.people.skeleton import INDEX, Skeleton, rodrigues

GESTURE_FRAMES: Final = 64
LOOP_S: Final = 8.0

SEAT_M: Final = 0.475
"""Height of the seat under a sitting person, metres."""
SEATED_BACK_M: Final = 0.59
"""Distance of a sitting person's hips behind the person's position, metres.

The position is in front of the seat, below the legs.
"""

_PHASE: Final = 2.0 * np.pi * np.arange(GESTURE_FRAMES) / GESTURE_FRAMES


def gesture(name: str, skeleton: Skeleton, stoop_rad: float = 0.0) -> tuple[Floats, Floats]:
    """Compute the loop called `name`, one of GESTURES.

    Returns rotations (FRAMES, 24, 3, 3) and pelvis (FRAMES, 3) in metres.
    """
    scale = skeleton.height_m / REFERENCE_M
    bends = np.zeros((GESTURE_FRAMES, 24, 3))
    breath = np.sin(2.0 * _PHASE)
    shift = np.sin(_PHASE + 0.6)
    _bend(bends, "pelvis", 0.025 * shift, 0.03, 0.03 * np.sin(_PHASE))
    _bend(bends, "spine1", -0.03 * shift, -0.02 + 0.25 * stoop_rad, 0.0)
    _bend(bends, "spine2", 0.0, 0.01 + 0.35 * stoop_rad, 0.0)
    _bend(bends, "spine3", 0.0, 0.02 - 0.014 * breath + 0.4 * stoop_rad, 0.0)
    _bend(bends, "neck", 0.0, 0.10 - 0.45 * stoop_rad, 0.0)
    _bend(bends, "head", 0.0, -0.06 + 0.01 * breath - 0.35 * stoop_rad, 0.0)
    for side, left in (("left", 1.0), ("right", -1.0)):
        _bend(bends, f"{side}_collar", -0.03 * left + 0.012 * left * breath, 0.0, 0.0)
    arms = GESTURES[name](bends)
    turns = rodrigues(bends)
    pelvis = np.column_stack(
        [np.zeros(GESTURE_FRAMES), 0.014 * scale * shift, np.zeros(GESTURE_FRAMES)]
    )
    pelvis[:, 2] = (
        skeleton.rest_m[0, 2]
        - (0.004 + 0.004 * shift**2 + 0.03 * max(stoop_rad - 0.1, 0.0)) * scale
    )
    for side, (upper, fore, fingers, thumb) in arms.items():
        set_arm(
            turns,
            side,
            *(np.broadcast_to(v, (GESTURE_FRAMES, 3)) for v in (upper, fore, fingers, thumb)),
        )
    if name == "sit":
        _sit(turns, pelvis, skeleton, scale)
    else:
        _stand(turns, pelvis, skeleton, scale)
    return turns, pelvis


def _stand(turns: Floats, pelvis: Floats, skeleton: Skeleton, scale: float) -> None:
    """Set both feet flat on the ground, apart and turned out, the left one slightly ahead."""
    for side, left in (("left", 1.0), ("right", -1.0)):
        ankle = skeleton.rest_m[INDEX[f"{side}_ankle"]]
        place = np.array([ankle[0] + 0.02 * left * scale, left * 0.105 * scale, ankle[2]])
        foot = about_z(np.full(GESTURE_FRAMES, left * np.deg2rad(9.0))) @ about_y(
            np.zeros(GESTURE_FRAMES)
        )
        set_leg(
            turns,
            pelvis,
            side,
            np.tile(place, (GESTURE_FRAMES, 1)),
            foot,
            np.zeros(GESTURE_FRAMES),
            skeleton,
        )


def _sit(turns: Floats, pelvis: Floats, skeleton: Skeleton, scale: float) -> None:
    """Set the hips on a seat behind the position, the shanks upright, both feet flat on the
    ground.
    """
    rest = skeleton.rest_m
    hip = INDEX["left_hip"]
    hips_m = SEAT_M + 0.085 * scale
    pelvis[:, 0] = -SEATED_BACK_M
    pelvis[:, 1] *= 0.3
    pelvis[:, 2] = hips_m - skeleton.offsets_m[hip][2]
    for side, left in (("left", 1.0), ("right", -1.0)):
        knee, ankle = (rest[INDEX[f"{side}_{part}"]] for part in ("knee", "ankle"))
        thigh_m = float(np.linalg.norm(knee - rest[INDEX[f"{side}_hip"]]))
        fall_m = min(max(hips_m - knee[2], 0.0), 0.8 * thigh_m)
        ahead_m = np.sqrt(thigh_m**2 - fall_m**2) - SEATED_BACK_M + 0.03 * left * scale
        place = np.array([ahead_m, left * 0.125 * scale, ankle[2]])
        foot = about_z(np.full(GESTURE_FRAMES, left * np.deg2rad(10.0))) @ about_y(
            np.zeros(GESTURE_FRAMES)
        )
        set_leg(
            turns,
            pelvis,
            side,
            np.tile(place, (GESTURE_FRAMES, 1)),
            foot,
            np.zeros(GESTURE_FRAMES),
            skeleton,
        )


def _bend(
    bends: Floats, joint: str, x: Floats | float, y: Floats | float, z: Floats | float
) -> None:
    """Add axis-angle turns: x leans to the right, y forward, z turns to the left."""
    for axis, angle in enumerate((x, y, z)):
        bends[:, INDEX[joint], axis] += angle


Arm = tuple[Floats, Floats, Floats, Floats]
"""Directions of upper arm, forearm, fingers, thumb: (3,) or (FRAMES, 3), x ahead, y left, z up."""


def _ways(*ways: tuple[float, float, float]) -> Arm:
    upper, fore, fingers, thumb = (np.array(way) for way in ways)
    return upper, fore, fingers, thumb


def _hanging(left: float) -> Arm:
    return _ways(
        (-0.06, 0.16 * left, -1.0),
        (0.16, 0.07 * left, -1.0),
        (0.20, 0.0, -1.0),
        (1.0, -0.45 * left, 0.2),
    )


def _both() -> dict[str, Arm]:
    return {"left": _hanging(1.0), "right": _hanging(-1.0)}


def _standing(bends: Floats) -> dict[str, Arm]:
    _bend(bends, "head", 0.0, 0.0, 0.12 * np.sin(_PHASE + 1.0))
    return _both()


def _looking(bends: Floats) -> dict[str, Arm]:
    """Turn head and shoulders to one side, hold, and turn to the other side."""
    way = np.tanh(2.2 * np.sin(_PHASE)) / np.tanh(2.2)
    _bend(bends, "spine3", 0.0, 0.0, 0.20 * way)
    _bend(bends, "neck", 0.0, 0.0, 0.45 * way)
    _bend(bends, "head", 0.0, -0.04, 0.50 * way)
    return _both()


def _talking(bends: Floats) -> dict[str, Arm]:
    """Move both hands before the chest for half of the loop, then lower them and nod.

    The elbows stay at the sides; the right hand moves more.
    """
    speaks = 0.5 + 0.5 * np.tanh(3.0 * np.sin(_PHASE)) / np.tanh(3.0)
    beat = 0.6 * np.sin(5.0 * _PHASE) + 0.4 * np.sin(8.0 * _PHASE + 1.0)
    other = 0.6 * np.sin(4.0 * _PHASE + 2.0) + 0.4 * np.sin(7.0 * _PHASE)
    nod = 0.04 * speaks * other + 0.09 * (1.0 - speaks) * np.sin(6.0 * _PHASE)
    _bend(bends, "head", 0.05 * speaks * other, 0.03 + nod, 0.22 * np.sin(2.0 * _PHASE))
    _bend(bends, "spine3", 0.0, 0.0, 0.06 * np.sin(_PHASE))
    o = np.zeros(GESTURE_FRAMES)
    arms: dict[str, Arm] = {}
    for side, left, swing in (("left", 1.0, 0.7 * other), ("right", -1.0, beat)):
        lively = speaks * swing
        upper = np.column_stack(
            [o - 0.04 + 0.16 * speaks + 0.08 * lively, left * (0.22 + 0.06 * lively), o - 1.0]
        )
        rise = -0.75 + speaks * (1.15 + 0.55 * swing)
        fore = np.column_stack([o + 0.80, left * (-0.32 + 0.24 * speaks + 0.30 * lively), rise])
        fingers = fore + np.column_stack([o, -0.15 * left * speaks, 0.15 * speaks + 0.2 * lively])
        arms[side] = (
            upper,
            fore,
            fingers,
            np.column_stack([o + 0.3 * (1.0 - speaks), o + 0.45 * left, o + 1.0]),
        )
    return arms


def _queueing(bends: Floats) -> dict[str, Arm]:
    """Join the hands before the body, and look down and along the queue."""
    _bend(bends, "neck", 0.0, 0.12 + 0.05 * np.sin(_PHASE), 0.10 * np.sin(2.0 * _PHASE))
    _bend(bends, "head", 0.0, 0.06, 0.25 * np.sin(_PHASE))
    return {
        "left": _ways(
            (0.10, 0.22, -1.0), (0.62, -0.58, -0.62), (0.5, -0.75, -0.62), (0.5, 0.2, 0.85)
        ),
        "right": _ways(
            (0.10, -0.22, -1.0), (0.70, 0.58, -0.55), (0.55, 0.75, -0.55), (0.5, -0.2, 0.85)
        ),
    }


def _stopping(bends: Floats) -> dict[str, Arm]:
    """Raise the right arm straight ahead at shoulder height, palm forward, fingers up."""
    push = 0.02 * np.sin(4.0 * _PHASE)
    _bend(bends, "spine3", 0.0, -0.02, 0.16)
    _bend(bends, "neck", 0.0, 0.02, -0.10)
    _bend(bends, "right_collar", 0.0, 0.0, 0.18)
    o = np.zeros(GESTURE_FRAMES)
    upper = np.column_stack([o + 1.0, o - 0.36, o + 0.02 + push])
    fore = np.column_stack([o + 1.0, o - 0.32, o + 0.05 + push])
    return {
        "left": _hanging(1.0),
        "right": (upper, fore, np.array([-0.10, 0.0, 1.0]), np.array([0.0, 1.0, 0.0])),
    }


def _phoning(bends: Floats) -> dict[str, Arm]:
    """Hold a phone before the chest in the left hand and look down at it."""
    _bend(bends, "neck", 0.0, 0.30, 0.0)
    _bend(bends, "head", 0.0, 0.28 + 0.02 * np.sin(3.0 * _PHASE), -0.06)
    return {
        "left": _ways(
            (0.28, 0.06, -1.0), (0.85, -0.42, 0.42), (0.80, -0.35, 0.62), (0.25, 0.75, 0.45)
        ),
        "right": _hanging(-1.0),
    }


def _sitting(bends: Floats) -> dict[str, Arm]:
    """Lean back with the hands on the thighs, and look around the street."""
    _bend(bends, "pelvis", 0.0, -0.16, 0.0)
    _bend(bends, "spine2", 0.0, 0.06, 0.0)
    _bend(bends, "neck", 0.0, 0.06, 0.16 * np.sin(_PHASE))
    _bend(bends, "head", 0.0, 0.04, 0.22 * np.sin(_PHASE))
    return {
        "left": _ways(
            (0.30, 0.22, -1.0), (0.80, -0.14, -0.64), (1.0, -0.20, -0.30), (0.35, -0.75, 0.55)
        ),
        "right": _ways(
            (0.34, -0.20, -1.0), (0.80, 0.18, -0.62), (1.0, 0.26, -0.28), (0.35, 0.75, 0.55)
        ),
    }


def _waving(bends: Floats) -> dict[str, Arm]:
    """Raise the right hand above the head and swing the forearm from side to side."""
    swing = np.sin(8.0 * _PHASE)
    _bend(bends, "spine3", 0.0, -0.02, 0.05)
    _bend(bends, "right_collar", 0.10, 0.0, 0.0)
    o = np.zeros(GESTURE_FRAMES)
    upper = np.column_stack([o + 0.15, o - 1.0, o + 0.35])
    fore = np.column_stack([o + 0.15, -0.10 + 0.55 * swing, o + 1.0])
    fingers = np.column_stack([o + 0.05, -0.10 + 0.75 * swing, o + 1.0])
    return {"left": _hanging(1.0), "right": (upper, fore, fingers, np.array([0.0, 1.0, 0.2]))}


def _calling(bends: Floats) -> dict[str, Arm]:
    """Hold a phone to the left ear, the elbow low and aside."""
    nod = 0.03 * np.sin(3.0 * _PHASE)
    _bend(bends, "neck", -0.06, 0.04, 0.0)
    _bend(bends, "head", -0.12, 0.02 + nod, 0.18 * np.sin(_PHASE))
    return {
        "left": _ways(
            (0.45, 0.62, -0.85), (0.05, -0.45, 1.0), (-0.15, -0.25, 1.0), (0.35, -0.6, 0.5)
        ),
        "right": _hanging(-1.0),
    }


def _pointing(bends: Floats) -> dict[str, Arm]:
    """Hold the right arm straight out to the side, and look there and back."""
    way = np.tanh(2.2 * np.sin(_PHASE)) / np.tanh(2.2)
    _bend(bends, "neck", 0.0, 0.0, -0.25 + 0.25 * way)
    _bend(bends, "head", 0.0, 0.0, -0.25 + 0.25 * way)
    o = np.zeros(GESTURE_FRAMES)
    lift = 0.08 + 0.03 * np.sin(2.0 * _PHASE)
    upper = np.column_stack([o + 0.12, o - 1.0, lift])
    fore = np.column_stack([o + 0.08, o - 1.0, lift])
    return {"left": _hanging(1.0), "right": (upper, fore, fore, np.array([0.6, 0.0, 0.8]))}


def _scratching(bends: Floats) -> dict[str, Arm]:
    """Hold the right hand on the head, the elbow out to the side, and scratch."""
    rub = 0.06 * np.sin(12.0 * _PHASE)
    _bend(bends, "head", 0.10, 0.08, 0.0)
    o = np.zeros(GESTURE_FRAMES)
    upper = np.column_stack([o + 0.35, o - 1.0, o + 0.45])
    fore = np.column_stack([o - 0.30, 0.75 + rub, 0.80 + rub])
    fingers = np.column_stack([o - 0.25, 1.0 + rub, o - 0.05])
    return {"left": _hanging(1.0), "right": (upper, fore, fingers, np.array([-0.4, 0.2, -0.6]))}


GESTURES: Final[Mapping[str, Callable[[Floats], dict[str, Arm]]]] = MappingProxyType(
    {
        "stand": _standing,
        "look": _looking,
        "talk": _talking,
        "queue": _queueing,
        "stop": _stopping,
        "phone": _phoning,
        "sit": _sitting,
        "wave": _waving,
        "call": _calling,
        "point": _pointing,
        "scratch": _scratching,
    }
)
"""Function of each gesture, which turns the joints of the body and directs its arms."""
