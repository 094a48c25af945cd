"""Poses of all people in a snapshot: per person, the baked frames to blend and their weights."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from cosim.core.state import Doing, People
from cosim.people.gait import PACES_MPS, first_stride, relative_pace, stature_m
from physics.people.appearance import family_of
from physics.people.clips import Clips, own_clips
from physics.people.families import FAMILIES, Family
from physics.people.gestures import GESTURES

_PACES: Final = np.array(PACES_MPS)
_APART: Final = np.diff(_PACES)
_STANDING_MPS: Final = (0.04, PACES_MPS[0])
"""Range of paces in which a gesture blends into the slowest walk, m/s."""
_LOOPS: Final = {name: row for row, name in enumerate(GESTURES)}


@dataclass(frozen=True, slots=True)
class Poses:
    """Poses of N people.

    rows: (N, 4) frames in the baked array
    weights: (N, 4) float32, with sum 1
    scale: (N,) factor on the body's size
    """

    rows: NDArray[np.intp]
    weights: NDArray[np.float32]
    scale: Floats

    def matrices(self, clips: Clips) -> NDArray[np.float32]:
        """Return (N, 24, 3, 4) joint matrices, blended like in a renderer and without the scale."""
        frames = clips.matrices.reshape(len(clips.matrices), -1)[self.rows]
        blend = np.matmul(self.weights[:, None, :], frames)
        return np.asarray(blend.reshape(len(self.rows), 24, 3, 4))


def poses(people: People, time_s: float, clips: Clips | None = None) -> Poses:
    """Compute the pose of every person at `time_s` as a function of the snapshot alone.

    Walking people blend the strides of the two nearest paces, at the phase of their own strides.
    People on the spot play the gesture of `people.doing`.
    While a person starts or stops, both are blended.
    """
    bodies = bodies_of(people.ids, people.age.tobytes())
    loops = loops_of(people.doing)
    return poses_of(
        bodies, people.pace, people.strides, loops, time_s, own_clips() if clips is None else clips
    )


def poses_of(
    bodies: Floats,
    pace: Floats,
    strides: Floats,
    loops: NDArray[np.intp],
    time_s: float | Floats,
    clips: Clips,
) -> Poses:
    """Compute the poses of N people, from any number of streets.

    bodies: (N, 4), from `bodies_of`
    pace, strides: (N,), as in `People`
    loops: (N,), from `loops_of`
    time_s: common to all, or (N,)
    """
    family = bodies[:, 0].astype(np.intp)
    size = bodies[:, 2]
    offset = bodies[:, 3]
    pace = pace * bodies[:, 1]
    knot = _PACES[1:-1].searchsorted(pace, side="right")
    faster = np.minimum(np.maximum((pace - _PACES[knot]) / _APART[knot], 0.0), 1.0)

    frame = strides % 1.0 * clips.stride_frames
    frames = clips.stride_frames
    low = np.minimum(frame.astype(np.intp), frames - 1)
    late = frame - low
    first = clips.gaits[family, knot]
    second = clips.gaits[family, knot + 1]
    after = (low + 1) % frames
    rows = np.empty((len(low), 4), dtype=np.intp)
    weights = np.empty((len(low), 4))
    rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3] = (
        first + low,
        first + after,
        second + low,
        second + after,
    )
    early, slower = 1.0 - late, 1.0 - faster
    weights[:, 0], weights[:, 1] = early * slower, late * slower
    weights[:, 2], weights[:, 3] = early * faster, late * faster

    slow = (pace < _PACES[0]).nonzero()[0]
    if len(slow):
        # People on the spot: the second half of the frames is a gesture.
        start, end = _STANDING_MPS
        share = np.minimum(np.maximum((pace[slow] - start) / (end - start), 0.0), 1.0)
        walk = share * share * (3.0 - 2.0 * share)
        now_s = time_s[slow] if isinstance(time_s, np.ndarray) else time_s
        frame = (now_s / clips.loop_s + offset[slow]) % 1.0 * clips.loop_frames
        low = np.minimum(frame.astype(np.intp), clips.loop_frames - 1)
        late = frame - low
        first = clips.loops[loops[slow], family[slow]]
        rows[slow, 2], rows[slow, 3] = first + low, first + (low + 1) % clips.loop_frames
        weights[slow, :2] *= walk[:, None]
        weights[slow, 2], weights[slow, 3] = (1.0 - walk) * (1.0 - late), (1.0 - walk) * late
    return Poses(rows, weights.astype(np.float32), size)


@lru_cache(maxsize=256)
def loops_of(doing: tuple[Doing, ...]) -> NDArray[np.intp]:
    """Return (N,) rows in GESTURES of the activities of people on the spot."""
    return np.array([_LOOPS["stand" if what == "walk" else what] for what in doing], dtype=np.intp)


@lru_cache(maxsize=256)
def bodies_of(names: tuple[str, ...], ages: bytes) -> Floats:
    """Return (N, 4) body parameters of people.

    Columns: row of the family, factor on the pace to that of the reference person, factor on the
    size.
    The last column is the position in a loop at time 0.
    """
    return np.array([_body_of(name, age) for name, age in zip(names, ages, strict=True)]).reshape(
        -1, 4
    )


@lru_cache(maxsize=65536)
def _body_of(name: str, age: int) -> tuple[float, float, float, float]:
    family: Family = family_of(name, age)
    stature = stature_m(name, age)
    pace = float(relative_pace(1.0, stature))
    return float(FAMILIES.index(family)), pace, stature / _STATURES[family], first_stride(name)


_STATURES: Final[dict[Family, float]] = {"man": 1.75, "woman": 1.64, "child": 1.25, "elder": 1.66}
