"""Baked motions of all families: the joint matrices of every frame in one array for renderers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.core.cache import Arrays, mapped_arrays, sources_hash
from cosim.core.geometry import Floats
from cosim.people.gait import PACES_MPS
from physics.people.families import FAMILIES, Family, skeleton
from physics.people.gaits import CYCLE_FRAMES as STRIDE_FRAMES
from physics.people.gaits import gait
from physics.people.gestures import GESTURE_FRAMES as LOOP_FRAMES
from physics.people.gestures import GESTURES, LOOP_S, gesture
from physics.people.skeleton import Skeleton, forward, model_pose, skinning

STOOP_RAD: Final[Mapping[Family, float]] = MappingProxyType(
    {"man": 0.0, "woman": 0.0, "child": 0.0, "elder": 0.34}
)
"""Bend of the back by family, rad."""
_MADE_BY: Final = sources_hash(Path(__file__).parent, Path(__file__).parents[2] / "cosim/people")


@dataclass(frozen=True, slots=True)
class Clips:
    """Baked motions.

    matrices: (R, 24, 3, 4) float32, one row per frame, loops one after another
    gaits: (families, paces) first rows of strides of `stride_frames` frames
    gestures: name -> (families,) first rows of loops of `loop_frames` frames and `loop_s` seconds
    loops: the same as (gestures, families), in the order of GESTURES

    A matrix maps a vertex as modelled to the posed body in the body frame.
    The body frame is x ahead, y left, z up, with the ground at 0.
    """

    matrices: NDArray[np.float32]
    gaits: NDArray[np.intp]
    gestures: Mapping[str, NDArray[np.intp]]
    loops: NDArray[np.intp]
    stride_frames: int = STRIDE_FRAMES
    loop_frames: int = LOOP_FRAMES
    loop_s: float = LOOP_S


@lru_cache(maxsize=1)
def own_clips() -> Clips:
    """Return the baked motions of the built-in bodies."""
    arrays = mapped_arrays("clips", _MADE_BY, _made)
    gestures = {name: arrays[name] for name in GESTURES}
    return Clips(arrays["matrices"], arrays["gaits"], gestures, np.stack(list(gestures.values())))


def _made() -> Arrays:
    """Build every gait and gesture of the built-in bodies.

    Returns skeleton, stoop, and the (24, 3, 3) rotations of the modelled pose of each.
    """
    bodies = [(skeleton(family), STOOP_RAD[family], model_pose()) for family in FAMILIES]
    rows: list[NDArray[np.float32]] = []
    walking = np.zeros((len(bodies), len(PACES_MPS)), dtype=np.intp)
    standing = {name: np.zeros(len(bodies), dtype=np.intp) for name in GESTURES}
    at = 0
    for k, (body, stoop_rad, modelled) in enumerate(bodies):
        bind = bind_of(body, modelled)
        for knot in range(len(PACES_MPS)):
            walking[k, knot] = at
            rows.append(skinning(*forward(*gait(knot, body, stoop_rad), body), bind))
            at += len(rows[-1])
        for name, first in standing.items():
            first[k] = at
            rows.append(skinning(*forward(*gesture(name, body, stoop_rad), body), bind))
            at += len(rows[-1])
    return {"matrices": np.concatenate(rows), "gaits": walking, **standing}


def bind_of(body: Skeleton, modelled: Floats) -> tuple[Floats, Floats]:
    """Return the bind pose of a body: joint rotations (24, 3, 3) and positions (24, 3)."""
    rotation, position = forward(modelled[None], body.rest_m[:1], body)
    return rotation[0], position[0]
