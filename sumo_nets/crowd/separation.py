"""Keep the displayed pedestrians apart."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from cosim.people.steering import SHOULDER_TO_SHOULDER_M


def pairs_within(xy: Floats, reach_m: float) -> NDArray[np.intp]:
    """Return the index pairs (P, 2) of points (N, 2) within `reach_m`, the lower index first."""
    order = np.argsort(xy[:, 0], kind="stable")
    x_m = xy[order, 0]
    # In the order of x, candidates follow each point: count them, then list them.
    ahead = np.searchsorted(x_m, x_m + 1.001 * reach_m, side="right") - np.arange(1, len(xy) + 1)
    one = np.repeat(np.arange(len(xy)), ahead)
    other = one + 1 + np.arange(len(one)) - np.repeat(np.cumsum(ahead) - ahead, ahead)
    pairs = np.sort(np.column_stack([order[one], order[other]]), axis=1)
    gap = xy[pairs[:, 0]] - xy[pairs[:, 1]]
    return np.asarray(pairs[(gap * gap).sum(axis=1) <= reach_m * reach_m])


SHOULDERS_M: Final = SHOULDER_TO_SHOULDER_M
"""Smallest distance between the middles of two people, metres: shoulders touch. SUMO's queues,
0.465 m apart, are unchanged."""

_NEAR_M: Final = 0.6
"""Pairs within this distance are processed, since giving way may bring them closer, metres."""

_MARGIN_M: Final = 1.0
"""Additional search distance for near pairs, metres; the search is repeated after half of it."""

ROUNDS: Final = 8
"""Largest number of rounds of pushes."""

MAX_OVERLAP_M: Final = 0.01
"""Rounds end when the largest overlap is smaller, metres."""
BENDS: Final = 2
"""Number of first rounds in which pushes are bent aside."""

BEND: Final = 0.6
"""Sideways share of a push between two people who walk towards each other."""

MIN_GAIN_M: Final = 0.002
"""A standing person moves only if it gets closer to its goal by this distance, metres."""

Rows = NDArray[np.intp]
Complex = NDArray[np.complex128]
"""Points of the plane, x + iy in metres, for rotations and distances in single operations."""


@dataclass(slots=True)
class NearPairs:
    """Finds near pairs of people, with a cache of candidates from step to step."""

    _at: Complex = field(default_factory=lambda: np.zeros(0, dtype=np.complex128))
    _one: Rows = field(default_factory=lambda: np.zeros(0, dtype=np.intp))
    _other: Rows = field(default_factory=lambda: np.zeros(0, dtype=np.intp))

    def of(self, xy: Floats, unyielding: NDArray[np.bool_]) -> tuple[Rows, Rows]:
        """Return the indices of near pairs, two arrays (P,) in order; empty if no pair is too near.

        xy: (N, 2) positions, metres.
        unyielding: (N,) whether a person does not give way.
        """
        at = _points(xy)
        if len(at) != len(self._at) or (
            np.maximum.reduce(np.abs(at - self._at), initial=0.0) > 0.49 * _MARGIN_M
        ):
            self._search(at)
        gap = at.take(self._one)
        gap -= at.take(self._other)
        x_m, y_m = gap.real, gap.imag
        far_m2 = x_m * x_m
        far_m2 += y_m * y_m
        if 1 in (far_m2 < SHOULDERS_M * SHOULDERS_M).tobytes():
            near = far_m2 <= _NEAR_M * _NEAR_M
            one, other = self._one[near], self._other[near]
            moves = ~(unyielding[one] & unyielding[other])
            if (moves & (far_m2[near] < SHOULDERS_M * SHOULDERS_M)).any():
                return one[moves], other[moves]
        return self._one[:0], self._other[:0]

    def _search(self, at: Complex) -> None:
        pairs = pairs_within(np.column_stack([at.real, at.imag]), _NEAR_M + _MARGIN_M)
        self._one, self._other = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))].T.copy()
        self._at = at


def separated_positions(
    before: Floats,
    preferred: Floats,
    unyielding: NDArray[np.bool_],
    reach_m: float,
    standing: NDArray[np.bool_] | None = None,
    pairs: tuple[Rows, Rows] | None = None,
) -> Floats:
    """Return positions (N, 2) close to `preferred` at which people do not overlap, metres.

    before, preferred: (N, 2) current and preferred positions, metres.
    unyielding: (N,) whether a person does not give way.
    reach_m: largest step, metres.
    standing: (N,) whether a person wants to stand; it does not move unless that brings it closer to
        its goal.
    pairs: near pairs at `preferred`, if they are known already.
    """
    one, other = NearPairs().of(preferred, unyielding) if pairs is None else pairs
    if not len(one):
        return preferred
    goal, start = _points(preferred), _points(before)
    share_one = np.where(unyielding[one], 0.0, np.where(unyielding[other], 1.0, 0.5))
    shares = share_one, np.where(unyielding[other], 0.0, np.where(unyielding[one], 1.0, 0.5))
    apart = start[other] - start[one]
    bend = _bend(apart, goal[other] - goal[one] - apart)
    at = _pushed(goal, one, other, shares, apart, bend)
    if standing is not None and standing.any():
        nowhere = standing & (np.abs(goal - at) > np.abs(goal - start) - MIN_GAIN_M)
        at = _pushed(np.where(nowhere, start, at), one, other, shares, apart, None)
    step = at - start
    at = np.where(unyielding, goal, start + step * (reach_m / np.maximum(np.abs(step), reach_m)))
    return np.column_stack([at.real, at.imag])


def _pushed(
    at: Complex,
    one: Rows,
    other: Rows,
    shares: tuple[Floats, Floats],
    before: Complex,
    bend: Complex | None,
) -> Complex:
    """Push apart people at `at` (N,), each by its share of `shares` (P,) of the overlap.

    before: (P,) vectors from first to second of each pair at the start of the step.
    bend: see `_bend`; None for straight pushes.
    """
    at = at.copy()
    for k in range(ROUNDS):
        apart = at[other] - at[one]
        far = np.abs(apart)
        if not (far > 1e-6).all():
            # Two people at one position separate along their previous offset.
            apart = np.where(far > 1e-6, apart, np.where(np.abs(before) > 1e-6, before, 1.0 + 0j))
        lost = np.maximum(SHOULDERS_M - far, 0.0)
        push = lost * apart / np.abs(apart)
        if bend is not None and k < BENDS:
            push = push * bend
        np.add.at(at, other, shares[1] * push)
        np.subtract.at(at, one, shares[0] * push)
        if lost.max() < MAX_OVERLAP_M:
            break
    return at


def _points(xy: Floats) -> Complex:
    points: Complex = np.ascontiguousarray(xy).view(np.complex128)[:, 0]
    return points


def _bend(apart: Complex, step: Complex) -> Complex:
    """Return factors (K,) that turn pushes towards the passing side, 1 for pairs that move
    apart."""
    turned = apart.conj() * step
    side = np.where(turned.imag >= 0.0, 1.0, -1.0)
    return np.where(turned.real < 0.0, 1.0 + 1j * BEND * side, 1.0 + 0j)
