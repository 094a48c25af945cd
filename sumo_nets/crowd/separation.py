"""Keep the displayed pedestrians apart."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from cosim.people.steering import SHOULDER_TO_SHOULDER_M


def pairs_within(xy: Floats, reach_m: float) -> NDArray[np.intp]:
    """(P, 2) numbers of those of (N, 2) points that are no farther apart, the lower number
    first."""
    order = np.argsort(xy[:, 0], kind="stable")
    x_m = xy[order, 0]
    # Along x everybody's neighbours follow it: how many do, and which.
    ahead = np.searchsorted(x_m, x_m + 1.001 * reach_m, side="right") - np.arange(1, len(xy) + 1)
    one = np.repeat(np.arange(len(xy)), ahead)
    other = one + 1 + np.arange(len(one)) - np.repeat(np.cumsum(ahead) - ahead, ahead)
    pairs = np.sort(np.column_stack([order[one], order[other]]), axis=1)
    gap = xy[pairs[:, 0]] - xy[pairs[:, 1]]
    return np.asarray(pairs[(gap * gap).sum(axis=1) <= reach_m * reach_m])


SHOULDERS_M: Final = SHOULDER_TO_SHOULDER_M
"""Least distance of the middles of two people: shoulders touch. SUMO's queues, 0.465 m apart, stay
as they are."""

_NEAR_M: Final = 0.6
"""Pairs nearer than this are looked at: some of them come nearer by giving way to others."""

_MARGIN_M: Final = 1.0
"""Who may come near is looked for so much farther out, and anew when somebody has moved half of
it."""

ROUNDS: Final = 8
"""One gives way to several in turn, at most so often."""

ENOUGH_M: Final = 0.01
BENDS: Final = 2
"""In the first rounds pushes bend aside."""

BEND: Final = 0.6
"""Way to the side, as a share of the way back, where two walk at each other."""

STIRS_M: Final = 0.002
"""Nobody who stands moves in order to get nearer by less."""

Rows = NDArray[np.intp]
Complex = NDArray[np.complex128]
"""Points of the plane, x + iy in metres: turning and measuring are single operations."""


@dataclass(slots=True)
class NearPairs:
    """Finds who is near whom, moment by moment, and remembers who may be soon."""

    _at: Complex = field(default_factory=lambda: np.zeros(0, dtype=np.complex128))
    _one: Rows = field(default_factory=lambda: np.zeros(0, dtype=np.intp))
    _other: Rows = field(default_factory=lambda: np.zeros(0, dtype=np.intp))

    def of(self, at: Complex, firm: NDArray[np.bool_]) -> tuple[Rows, Rows]:
        """Numbers of those who are near each other, two arrays (P,), in order; none where nobody is
        too near.

        at, firm: (N,) where they are, and who does not give way.
        """
        if len(at) != len(self._at) or np.abs(at - self._at).max(initial=0.0) > 0.49 * _MARGIN_M:
            self._look(at)
        gap = at[self._one] - at[self._other]
        far_m2 = gap.real * gap.real + gap.imag * gap.imag
        close = far_m2 < SHOULDERS_M * SHOULDERS_M
        if close.any():
            near = far_m2 <= _NEAR_M * _NEAR_M
            one, other = self._one[near], self._other[near]
            moves = ~(firm[one] & firm[other])
            if (close[near] & moves).any():
                return one[moves], other[moves]
        return self._one[:0], self._other[:0]

    def _look(self, at: Complex) -> None:
        pairs = pairs_within(np.column_stack([at.real, at.imag]), _NEAR_M + _MARGIN_M)
        self._one, self._other = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))].T.copy()
        self._at = at


def kept_apart(
    before: Floats,
    wanted: Floats,
    firm: NDArray[np.bool_],
    reach_m: float,
    stand: NDArray[np.bool_] | None = None,
    near: NearPairs | None = None,
) -> Floats:
    """Where people go who want to go from `before` to `wanted`, (N, 2) metres each.

    firm (N,): who does not give way. reach_m: the farthest that anybody goes in this step. stand
    (N,): who wants to stand, and stays where it is rather than go somewhere that is no nearer to
    where it wants to stand. near: what remembers, from step to step, who may come near whom.
    """
    goal = _points(wanted)
    one, other = (near or NearPairs()).of(goal, firm)
    if not len(one):
        return wanted
    start = _points(before)
    share_one = np.where(firm[one], 0.0, np.where(firm[other], 1.0, 0.5))
    shares = share_one, np.where(firm[other], 0.0, np.where(firm[one], 1.0, 0.5))
    apart = start[other] - start[one]
    bend = _bend(apart, goal[other] - goal[one] - apart)
    at = _pushed(goal, one, other, shares, apart, bend)
    if stand is not None and stand.any():
        nowhere = stand & (np.abs(goal - at) > np.abs(goal - start) - STIRS_M)
        at = _pushed(np.where(nowhere, start, at), one, other, shares, apart, None)
    step = at - start
    at = np.where(firm, goal, start + step * (reach_m / np.maximum(np.abs(step), reach_m)))
    return np.column_stack([at.real, at.imag])


def _pushed(
    at: Complex,
    one: Rows,
    other: Rows,
    shares: tuple[Floats, Floats],
    before: Complex,
    bend: Complex | None,
) -> Complex:
    """Where people end up who are at `at` (N,) and give way to each other by `shares` (P,) of what
    is lacking.

    before (P,): from the first of each pair to the second at the beginning of the step. bend: see
    `_bend`; None where nobody turns aside.
    """
    at = at.copy()
    for k in range(ROUNDS):
        apart = at[other] - at[one]
        far = np.abs(apart)
        if not (far > 1e-6).all():
            # Two at one place part along the line on which they came.
            apart = np.where(far > 1e-6, apart, np.where(np.abs(before) > 1e-6, before, 1.0 + 0j))
        lost = np.maximum(SHOULDERS_M - far, 0.0)
        push = lost * apart / np.abs(apart)
        if bend is not None and k < BENDS:
            push = push * bend
        np.add.at(at, other, shares[1] * push)
        np.subtract.at(at, one, shares[0] * push)
        if lost.max() < ENOUGH_M:
            break
    return at


def _points(xy: Floats) -> Complex:
    points: Complex = np.ascontiguousarray(xy).view(np.complex128)[:, 0]
    return points


def _bend(apart: Complex, step: Complex) -> Complex:
    """(K,) by what a push is turned aside: to the side on which a step passes; not where the step
    leads away."""
    turned = apart.conj() * step
    side = np.where(turned.imag >= 0.0, 1.0, -1.0)
    return np.where(turned.real < 0.0, 1.0 + 1j * BEND * side, 1.0 + 0j)
