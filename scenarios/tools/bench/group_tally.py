"""How near to each other shown people are who walk in groups."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np

from cosim.core.state import People

APART_M: Final = 2.0
"""A group of which somebody is farther from every fellow is apart."""


def widest_gaps(groups: Iterable[Sequence[str]], people: People) -> list[float]:
    """Of each group of which two or more are shown: how far that member is from its nearest fellow,
    metres, who is farthest from its own."""
    row = {name: i for i, name in enumerate(people.ids)}
    gaps = []
    for names in groups:
        xy = people.xy[[row[name] for name in names if name in row]]
        if len(xy) > 1:
            apart = np.hypot(*(xy[:, None] - xy[None]).transpose(2, 0, 1))
            np.fill_diagonal(apart, np.inf)
            gaps.append(float(apart.min(axis=1).max()))
    return gaps
