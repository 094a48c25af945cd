"""Groups of standing people: talking, queueing, or too close for the robot to pass between them.

A group is one obstacle made of lines between its members, each as wide as a person. No path leads
between two members without crossing a line.
"""

from __future__ import annotations

import itertools
from typing import Final

import numpy as np

from cosim.core.geometry import Floats
from cosim.core.state import PERSON_RADIUS_M, People

STANDING_MPS: Final = 0.15
"""Speed in m/s below which a person stands."""
_GAP_M: Final = 0.9
"""Metres between shoulders below which the robot does not pass between two people."""
GROUP_M: Final = 2.5
"""Metres within which talking or queueing people form a group."""


def is_standing(people: People) -> np.ndarray:
    """Return (N,) whether each person stands."""
    still: np.ndarray = people.speed < STANDING_MPS
    return still


def groups(people: People) -> list[list[int]]:
    """Return rows of standing people, group by group; a person alone is a group of one."""
    rows = np.flatnonzero(is_standing(people)).tolist()
    left = set(rows)
    found = []
    for row in rows:
        if row not in left:
            continue
        left.discard(row)
        group = [row]
        todo = [row]
        while todo:
            one = todo.pop()
            near = sorted(other for other in left if _together(people, one, other))
            left.difference_update(near)
            group += near
            todo += near
        found.append(sorted(group))
    return found


def _together(people: People, a: int, b: int) -> bool:
    apart_m = float(np.hypot(*(people.xy[a] - people.xy[b])))
    if apart_m < 2 * PERSON_RADIUS_M + _GAP_M:
        return True
    return (
        people.doing[a] == people.doing[b]
        and people.doing[a] in ("talk", "queue")
        and apart_m < GROUP_M
    )


def lines(people: People) -> Floats:
    """Return (M, 2, 2) in metres: lines between all pairs of each group.

    A person alone gives a line of length zero.
    """
    ends = [
        (people.xy[a], people.xy[b])
        for group in groups(people)
        for a, b in (itertools.combinations(group, 2) if len(group) > 1 else [(group[0], group[0])])
    ]
    return np.array(ends, dtype=float).reshape(-1, 2, 2)


def distances(points: Floats, ends: Floats) -> Floats:
    """Return (..., M) distances in metres from points (..., 2) to lines (M, 2, 2)."""
    start = ends[:, 0]
    along = ends[:, 1] - ends[:, 0]
    away = points[..., None, :] - start
    share = (away * along).sum(axis=-1) / np.maximum((along**2).sum(axis=-1), 1e-12)
    rest = away - np.clip(share, 0.0, 1.0)[..., None] * along
    gaps: Floats = np.hypot(rest[..., 0], rest[..., 1])
    return gaps
