"""Who stands together: people who talk or queue, or stand so close that the robot does not fit
between them.

A group is one obstacle, passed round as a whole. It is made of the lines between its members, each
with the width of a person: nothing passes between two of them without crossing a line.
"""

from __future__ import annotations

import itertools
from typing import Final

import numpy as np

from cosim.core.geometry import Floats
from cosim.core.state import PERSON_RADIUS_M, People

STANDS_MPS: Final = 0.15
_GAP_M: Final = 0.9
"""Two who leave less than this between their shoulders are not to be passed between."""
FELLOWS_M: Final = 2.5
"""Talkers and queuers this near to each other belong together, whatever the gap."""


def who_stands(people: People) -> np.ndarray:
    """(N,) whether each of them stands."""
    still: np.ndarray = people.speed < STANDS_MPS
    return still


def groups(people: People) -> list[list[int]]:
    """Rows of those who stand, group by group; one alone is a group of one."""
    rows = np.flatnonzero(who_stands(people)).tolist()
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
        and apart_m < FELLOWS_M
    )


def lines(people: People) -> Floats:
    """(M, 2, 2) m: the lines between any two of each group; of one who stands alone, a line without
    length."""
    ends = [
        (people.xy[a], people.xy[b])
        for group in groups(people)
        for a, b in (itertools.combinations(group, 2) if len(group) > 1 else [(group[0], group[0])])
    ]
    return np.array(ends, dtype=float).reshape(-1, 2, 2)


def distances(points: Floats, ends: Floats) -> Floats:
    """Distance from points (..., 2) to lines (M, 2, 2), (..., M) metres."""
    start = ends[:, 0]
    along = ends[:, 1] - ends[:, 0]
    away = points[..., None, :] - start
    share = (away * along).sum(axis=-1) / np.maximum((along**2).sum(axis=-1), 1e-12)
    rest = away - np.clip(share, 0.0, 1.0)[..., None] * along
    gaps: Floats = np.hypot(rest[..., 0], rest[..., 1])
    return gaps
