"""Inverse kinematics of legs and arms: joint rotations from target poses of feet and hands."""

from __future__ import annotations

import numpy as np

from cosim.core.geometry import Floats
from physics.people.skeleton import INDEX, Skeleton


def unit(vectors: Floats) -> Floats:
    """Normalize (..., 3) vectors to length 1."""
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12))


def set_leg(
    turns: Floats,
    pelvis_m: Floats,
    side: str,
    ankle_m: Floats,
    foot: Floats,
    toe_rad: Floats,
    skeleton: Skeleton,
) -> Floats:
    """Set hip, knee, ankle and toes of (F, 24, 3, 3) turns in place to reach an ankle position.

    ankle_m: (F, 3)
    foot: (F, 3, 3) rotation of the foot
    toe_rad: (F,) bend of the toes upwards, relative to the foot

    The knee points in the direction of foot and pelvis.
    Returns (F,) metres by which the leg is too short.
    """
    hip, knee, ankle, toes = (INDEX[f"{side}_{part}"] for part in ("hip", "knee", "ankle", "foot"))
    thigh, shank = (
        skeleton.rest_m[knee] - skeleton.rest_m[hip],
        skeleton.rest_m[ankle] - skeleton.rest_m[knee],
    )
    l1, l2 = float(np.linalg.norm(thigh)), float(np.linalg.norm(shank))
    pelvis = turns[:, 0]
    start = pelvis_m + pelvis @ skeleton.offsets_m[hip]
    line = ankle_m - start
    wanted = np.linalg.norm(line, axis=1)
    far = np.clip(wanted, 0.3 * (l1 + l2), 0.9995 * (l1 + l2))
    down = unit(line)
    ahead = pelvis[:, :, 0] + foot[:, :, 0] * (1.0, 1.0, 0.0)
    bend = unit(ahead - down * np.sum(ahead * down, axis=1, keepdims=True))
    cosine = np.clip((l1**2 + far**2 - l2**2) / (2.0 * l1 * far), -1.0, 1.0)[:, None]
    joint = start + l1 * (cosine * down + np.sqrt(1.0 - cosine**2) * bend)
    end = start + far[:, None] * down
    hinge = np.cross(bend, down)
    upper = _bone(unit(joint - start), hinge) @ _bone(unit(thigh), np.array([0.0, 1.0, 0.0])).T
    lower = _bone(unit(end - joint), hinge) @ _bone(unit(shank), np.array([0.0, 1.0, 0.0])).T
    turns[:, hip] = np.swapaxes(pelvis, 1, 2) @ upper
    turns[:, knee] = np.swapaxes(upper, 1, 2) @ lower
    turns[:, ankle] = np.swapaxes(lower, 1, 2) @ foot
    turns[:, toes] = about_y(-toe_rad)
    return np.asarray(wanted - far)


def set_arm(
    turns: Floats, side: str, upper: Floats, fore: Floats, fingers: Floats, thumb: Floats
) -> None:
    """Set shoulder, elbow and wrist of (F, 24, 3, 3) turns in place.

    upper, fore, fingers, thumb: (F, 3) directions in the body frame

    The forearm takes half of the hand's twist.
    """
    collar, shoulder, elbow, wrist = (
        INDEX[f"{side}_{part}"] for part in ("collar", "shoulder", "elbow", "wrist")
    )
    outward = 1.0 if side == "left" else -1.0
    base = turns[:, 0]
    for joint in (INDEX["spine1"], INDEX["spine2"], INDEX["spine3"], collar):
        base = base @ turns[:, joint]
    upper, fore, fingers = unit(upper), unit(fore), unit(fingers)
    crook = fore - upper * np.sum(upper * fore, axis=1, keepdims=True)
    first = _arm_frame(outward * upper, crook)
    hand = _arm_frame(outward * fingers, thumb)
    across = unit(thumb - fore * np.sum(thumb * fore, axis=1, keepdims=True))
    middle = _arm_frame(outward * fore, unit(np.cross(outward * fore, first[:, :, 2])) + across)
    turns[:, shoulder] = np.swapaxes(base, 1, 2) @ first
    turns[:, elbow] = np.swapaxes(first, 1, 2) @ middle
    turns[:, wrist] = np.swapaxes(middle, 1, 2) @ hand


def about_y(angle_rad: Floats) -> Floats:
    """Return (F, 3, 3) rotations about the y axis; a positive angle lowers the x axis."""
    cos, sin, o = np.cos(angle_rad), np.sin(angle_rad), np.zeros_like(angle_rad)
    rows = [
        np.stack([cos, o, sin], -1),
        np.stack([o, o + 1.0, o], -1),
        np.stack([-sin, o, cos], -1),
    ]
    return np.stack(rows, axis=-2)


def about_z(angle_rad: Floats) -> Floats:
    """Return (F, 3, 3) rotations about the vertical axis."""
    cos, sin, o = np.cos(angle_rad), np.sin(angle_rad), np.zeros_like(angle_rad)
    rows = [
        np.stack([cos, -sin, o], -1),
        np.stack([sin, cos, o], -1),
        np.stack([o, o, o + 1.0], -1),
    ]
    return np.stack(rows, axis=-2)


def _bone(along: Floats, hinge: Floats) -> Floats:
    """Return (..., 3, 3) frames with -z along `along` and y as close as possible to `hinge`."""
    z = -along
    x = unit(np.cross(np.broadcast_to(hinge, z.shape), z))
    return np.stack([x, np.cross(z, x), z], axis=-1)


def _arm_frame(y: Floats, x: Floats) -> Floats:
    """Return (F, 3, 3) frames with the given y, and their x as close as possible to `x`."""
    x = unit(x - y * np.sum(x * y, axis=1, keepdims=True))
    return np.stack([x, y, np.cross(x, y)], axis=-1)
