"""Nobody walks through anybody: how shown people keep apart.

SUMO's walkers change stripes through one another, and their paths over corners cross. A step that would bring two
people nearer than KEEP_M is led aside: each gives way by half, an event pedestrian not at all. Where two meet head-on,
the step bends to the side on which it would pass; that choice strengthens itself.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from cosim.people.steering import SHOULDER_TO_SHOULDER_M
from sumo_nets.crowd.near_pairs import pairs_within

SHOULDERS_M: Final = SHOULDER_TO_SHOULDER_M
"""Least distance of the middles of two people: shoulders touch. SUMO's queues, 0.465 m apart, stay as they are."""

_NEAR_M: Final = 0.6
"""Pairs nearer than this are looked at: some of them come nearer by giving way to others."""

ROUNDS: Final = 8
"""One gives way to several in turn, at most so often."""

ENOUGH_M: Final = 0.01
BENDS: Final = 2
"""In the first rounds pushes bend aside."""

BEND: Final = 0.6
"""Way to the side, as a share of the way back, where two walk at each other."""

STIRS_M: Final = 0.002
"""Nobody who stands moves in order to get nearer by less."""

Complex = NDArray[np.complex128]
"""Points of the plane, x + iy in metres: turning and measuring are single operations."""


def kept_apart(
    before: Floats, wanted: Floats, firm: NDArray[np.bool_], reach_m: float, stand: NDArray[np.bool_] | None = None
) -> Floats:
    """Where people go who want to go from `before` to `wanted`, (N, 2) metres each.

    firm (N,): who does not give way. reach_m: the farthest that anybody goes in this step. stand (N,): who wants to
    stand, and stays where it is rather than go somewhere that is no nearer to where it wants to stand.
    """
    one, other = _pairs(wanted, firm)
    if not len(one):
        return wanted
    start, goal = _points(before), _points(wanted)
    share_one = np.where(firm[one], 0.0, np.where(firm[other], 1.0, 0.5))
    shares = share_one, np.where(firm[other], 0.0, np.where(firm[one], 1.0, 0.5))
    apart = start[other] - start[one]
    bend = _bend(apart, goal[other] - goal[one] - apart)
    at = _pushed(goal, one, other, shares, apart, bend)
    if stand is not None and stand.any():
        nowhere = stand & (np.abs(goal - at) > np.abs(goal - start) - STIRS_M)
        at = _pushed(np.where(nowhere, start, at), one, other, shares, apart, np.ones_like(bend))
    step = at - start
    at = np.where(firm, goal, start + step * (reach_m / np.maximum(np.abs(step), reach_m)))
    return np.column_stack([at.real, at.imag])


def _pushed(
    at: Complex,
    one: NDArray[np.intp],
    other: NDArray[np.intp],
    shares: tuple[Floats, Floats],
    before: Complex,
    bend: Complex,
) -> Complex:
    """Where people end up who are at `at` (N,) and give way to each other by `shares` (P,) of what is lacking.

    before (P,): from the first of each pair to the second at the beginning of the step. bend: see `_bend`.
    """
    at = at.copy()
    for k in range(ROUNDS):
        if k == BENDS:
            bend = np.ones_like(bend)
        push, most_m = _push(at[other] - at[one], before, bend)
        np.add.at(at, other, shares[1] * push)
        np.subtract.at(at, one, shares[0] * push)
        if most_m < ENOUGH_M:
            break
    return at


def _points(xy: Floats) -> Complex:
    return np.ascontiguousarray(xy[:, 0] + 1j * xy[:, 1])


def _pairs(xy: Floats, firm: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Numbers of those who are near each other, two arrays (P,), in order; none where nobody is too near."""
    nobody = np.zeros(0, dtype=np.intp)
    if len(xy) < 2:
        return nobody, nobody
    pairs = pairs_within(xy, _NEAR_M)
    if not len(pairs):
        return nobody, nobody
    one, other = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))].T
    gap = xy[one] - xy[other]
    close = (gap * gap).sum(axis=1) < SHOULDERS_M * SHOULDERS_M
    moves = ~(firm[one] & firm[other])
    return (one[moves], other[moves]) if (close & moves).any() else (nobody, nobody)


def _bend(apart: Complex, step: Complex) -> Complex:
    """(K,) by what a push is turned aside: to the side on which a step passes; not where the step leads away."""
    turned = apart.conj() * step
    side = np.where(turned.imag >= 0.0, 1.0, -1.0)
    return np.where(turned.real < 0.0, 1.0 + 1j * BEND * side, 1.0 + 0j)


def _push(apart: Complex, before: Complex, bend: Complex) -> tuple[Complex, float]:
    """(K,) how to move the second of each pair so that it keeps away, and the most that is lacking in metres.

    apart, before: (K,) from the first of each pair to the second, now and at the beginning of the step.
    """
    far = np.abs(apart)
    lost = np.maximum(SHOULDERS_M - far, 0.0)
    # Two at one place part along the line on which they came.
    line = np.where(far > 1e-6, apart, np.where(np.abs(before) > 1e-6, before, 1.0 + 0j))
    push: Complex = lost * line / np.abs(line) * bend
    return push, float(lost.max(initial=0.0))
