"""Elevations along the lines of a net, joined where one can walk or drive from one to the other; and their clamping."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cosim.core.geometry import Floats
from cosim.place.terrain import WALK_GRADE_MAX

SAME_LEVEL_M: Final = 1.5
"""Places side by side that differ by more are on different terraces."""

_SPACING_M = 4.0
_BESIDE_M = 5.0
_ROUNDS = 300
_NEAR_M = 1e-6

_Ints = NDArray[np.intp]
On = Literal["street", "path", "steps", "raised"]


@dataclass(frozen=True, slots=True)
class Course:
    """A line of a net with elevations. points: (N, 3) metres, NaN where the third is missing; on: what lies there,
    "path" where nothing drives, "raised" for bridges and tunnels; ring: whether it is the outline of a walking area;
    edge: SUMO edge id."""

    edge: str
    points: Floats
    on: On = "street"
    ring: bool = False


class Meeting(NamedTuple):
    """A walking area: the number of its outline among the courses, and its ports: the number of a course, and 0 for
    the start of its line or 1 for its end."""

    ring: int
    ports: tuple[tuple[int, int], ...]


def course(edge: str, shape: str, on: On = "street", ring: bool = False) -> Course:
    """A shape of points "x,y" and "x,y,z" in any mixture: netconvert leaves an elevation of 0 away, and writes 0 where
    it knows none."""
    rows = [[float(value) for value in point.split(",")] for point in shape.split()]
    points = np.array([[*row[:2], row[2] if len(row) > 2 else 0.0] for row in rows])
    return Course(edge, points, on, ring)


def what_lies_there(kind: str, params: Mapping[str, str], apart: bool) -> On:
    """What an edge leads over, as far as its type and params say. apart: nothing drives there."""
    raised = any(params.get(key, "no") not in ("no", "", "building_passage") for key in ("bridge", "tunnel"))
    if raised or params.get("layer", "0") not in ("0", "") or kind.endswith(("_bridge", "_tunnel")):
        return "raised"
    if "steps" in kind:
        return "steps"
    return "path" if apart else "street"


@dataclass(frozen=True, slots=True)
class Profile:
    """Points every few metres along all courses, joined where one can walk or drive from one to the other.

    xy: (N, 2); z: (N,) heights; street: (N,) whether WALK_GRADE_MAX holds there; tail, head, run_m: (E,) the joints.
    """

    xy: Floats
    z: Floats
    street: NDArray[np.bool_]
    tail: _Ints
    head: _Ints
    run_m: Floats

    @classmethod
    def of(cls, courses: Sequence[Course], meets: Sequence[Meeting]) -> Profile:
        rows, tails, heads, first = [], [], [], [0]
        streets: list[NDArray[np.bool_]] = []
        for c in courses:
            points = _dense(c)
            start, n = first[-1], len(points)
            rows.append(points)
            streets.append(np.full(n, c.on == "street"))
            first.append(start + n)
            if n > 1:
                tails.append(start + np.arange(n - 1))
                heads.append(start + np.arange(1, n))
        at = np.concatenate(rows)
        tree = cKDTree(at[:, :2])
        pairs = tree.query_pairs(_BESIDE_M, output_type="ndarray")
        near = np.abs(at[pairs[:, 0], 2] - at[pairs[:, 1], 2]) <= SAME_LEVEL_M
        tails.append(pairs[near, 0])
        heads.append(pairs[near, 1])
        for ring, ports in meets:
            ends = np.array([first[k + end] - end for k, end in ports if first[k] < first[k + 1]], dtype=np.intp)
            around = np.arange(first[ring], first[ring + 1])
            joined: list[tuple[int, int]] = list(combinations(ends.tolist(), 2))
            if len(around) and len(ends):
                gaps = np.hypot(*(at[ends][:, None, :2] - at[around][None, :, :2]).transpose(2, 0, 1))
                joined += zip(ends.tolist(), around[gaps.argmin(axis=1)].tolist(), strict=True)
            tails.append(np.array([pair[0] for pair in joined], dtype=np.intp))
            heads.append(np.array([pair[1] for pair in joined], dtype=np.intp))
        tail, head = np.concatenate(tails).astype(np.intp), np.concatenate(heads).astype(np.intp)
        street = np.concatenate(streets)
        both = street[tail] & street[head]
        tail, head = tail[both], head[both]
        run = np.maximum(np.hypot(*(at[tail, :2] - at[head, :2]).T), 0.5)
        return cls(at[:, :2], at[:, 2], street, tail, head, run)

    def clamped(self) -> Floats:
        """(N,) heights with no joint on streets steeper than WALK_GRADE_MAX."""
        return clamped(self.z, self.tail, self.head, WALK_GRADE_MAX * self.run_m)


def clamped(z_m: Floats, tail: _Ints, head: _Ints, most_m: Floats) -> Floats:
    """Heights near (N,) `z_m` of which those of `tail` and `head`, (E,) numbers, differ by (E,) `most_m` at most.

    First every joint that is too steep pulls its ends together, many times, which takes narrow faults away where they
    are. What is left is put half way between the highest heights below and the lowest above that keep the bounds.
    """
    z, count = z_m.copy(), len(z_m)
    joints = 1 + np.bincount(tail, minlength=count) + np.bincount(head, minlength=count)
    for _ in range(_ROUNDS):
        rise = z[head] - z[tail]
        over = rise - np.clip(rise, -most_m, most_m)
        if not over.any():
            return z
        z += (np.bincount(tail, over, count) - np.bincount(head, over, count)) / joints
    return 0.5 * (_lowered(z, tail, head, most_m) - _lowered(-z, tail, head, most_m))


def _lowered(z_m: Floats, tail: _Ints, head: _Ints, most_m: Floats) -> Floats:
    """The highest heights not above `z_m` that keep the bounds."""
    z = z_m.copy()
    while True:
        before = z.copy()
        np.minimum.at(z, head, before[tail] + most_m)
        np.minimum.at(z, tail, before[head] + most_m)
        if (before - z).max(initial=0.0) < _NEAR_M:
            return z


def _dense(c: Course) -> Floats:
    """(N, 3) points of a course every few metres, missing elevations between known ones interpolated; none at all
    where no point has one."""
    known = np.isfinite(c.points[:, 2])
    if not known.any():
        return np.zeros((0, 3))
    at = metres_along(c.points)
    count = max(int(np.ceil(at[-1] / _SPACING_M)), 1)
    s = np.unique(np.concatenate([np.linspace(0.0, at[-1], count + 1)])) if at[-1] > 0.0 else np.zeros(1)
    columns = [np.interp(s, at, c.points[:, k]) for k in (0, 1)]
    return np.column_stack([*columns, np.interp(s, at[known], c.points[known, 2])])


def metres_along(points: Floats) -> Floats:
    """(N,) metres from the first of (N, 2) points or more columns, level."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points[:, :2], axis=0).T))])
