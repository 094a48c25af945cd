"""Ambient occlusion of a body by itself, baked per vertex.

The body is a set of balls along its bones. Each ball hides its solid angle from a vertex
(Quilez, sphere ambient occlusion), weighted by the cosine to the normal.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import numpy as np

from cosim.core.geometry import Floats
from physics.people.clips import bind_of
from physics.people.families import man_rest_m
from physics.people.skeleton import INDEX, Skeleton, model_pose

_BONES: Final = (
    # from, to, radius at both ends in metres, number of balls
    ("pelvis", "spine2", 0.120, 0.115, 4),
    ("spine2", "neck", 0.120, 0.070, 5),
    ("neck", "head", 0.050, 0.085, 3),
    *(
        (f"{side}_{start}", f"{side}_{end}", first, last, count)
        for side in ("left", "right")
        for start, end, first, last, count in (
            ("hip", "knee", 0.085, 0.055, 6),
            ("knee", "ankle", 0.055, 0.040, 6),
            ("ankle", "foot", 0.045, 0.035, 3),
            ("shoulder", "elbow", 0.050, 0.040, 5),
            ("elbow", "wrist", 0.040, 0.028, 5),
        )
    ),
)
_LEAST: Final = 0.3
_GROUND_M: Final = 0.25
"""Height over which the ground's own shade at the feet fades out, metres."""


@lru_cache(maxsize=1)
def _balls() -> tuple[Floats, Floats]:
    """Return middles (B, 3) and radii (B,) of the man as modelled."""
    _, at = bind_of(Skeleton(man_rest_m(), 1.75), model_pose())
    middles, radii = [], []
    for start, end, first, last, count in _BONES:
        share = np.linspace(0.0, 1.0, count)[:, None]
        middles.append(at[INDEX[start]] * (1.0 - share) + at[INDEX[end]] * share)
        radii.append(first + (last - first) * share[:, 0])
    return np.concatenate(middles), np.concatenate(radii)


def unshaded(vertices: Floats, normals: Floats) -> Floats:
    """Return (V,) shares of ambient light from 0 to 1 that reach the vertices of the man.

    vertices, normals: (V, 3), as modelled on the man of 1.75 m; normals may have any length

    A zero normal stands for all directions.
    """
    middles, radii = _balls()
    way = middles[None] - vertices[:, None]
    far = np.linalg.norm(way, axis=2)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    facing = np.einsum("vbi,vi->vb", way, normals / np.maximum(length, 1e-9)) / np.maximum(
        far, 1e-6
    )
    facing = np.where(length > 1e-6, np.maximum(facing, 0.0), 0.35)
    own = far < radii[None] * 1.45
    hidden = np.where(
        own, 0.0, facing * np.minimum((radii[None] / np.maximum(far, 1e-6)) ** 2, 1.0)
    )
    ground = 0.45 * np.clip(1.0 - vertices[:, 2] / _GROUND_M, 0.0, 1.0)
    light = np.prod(1.0 - 0.6 * hidden, axis=1) * (1.0 - ground)
    return np.asarray(np.clip(light, _LEAST, 1.0))
