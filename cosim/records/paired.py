"""Paired differences: what changed between two runs of the same scenarios, and how far chance alone may be the reason.

Scenarios are drawn again in pairs, as many as there are, BOOTSTRAP times, always the same draws: of each draw the
difference is taken, and the interval holds the middle 95 % of these. At so few scenarios that this is too narrow the
tails are those of Student's t (Hesterberg 2015, doi 10.1080/00031305.2015.1089789, expanded percentiles), which brings
the coverage of a mean from 0.90 to 0.94 at ten scenarios, and changes nothing at hundreds.

A difference is within noise where its interval holds 0. Where it does not, but fewer than six scenarios changed at all,
these are too few: were both runs alike, five would all go the same way once in sixteen times (2 / 2**5 = 0.06). Of a
rate those are counted that had a failure: nearly every way is some millimetres longer in one run than in the other.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, stdtrit

from cosim.core.geometry import Floats
from cosim.judge.metrics import RATE_NEEDS_M
from cosim.records.results import BOOTSTRAP, CONFIDENCE

FEWEST_CHANGED: Final = 6
PairedVerdict = Literal["within noise", "too few", "better", "worse", "differs"]


class PairedDifference(NamedTuple):
    """before, after: over the pairs in which both have a value; NaN where none has one. low, high: of after - before.
    n: such pairs; changed: those of them that are not the same in both, and of a rate had something counted in one."""

    before: float
    after: float
    low: float
    high: float
    n: int
    changed: int

    @property
    def difference(self) -> float:
        return self.after - self.before

    def verdict(self, higher_is_better: bool | None) -> PairedVerdict:
        """In words, of a metric of which more is better, worse, or neither (None)."""
        if not self.n or self.low <= 0.0 <= self.high:
            return "within noise"
        if self.changed < FEWEST_CHANGED:
            return "too few"
        if higher_is_better is None:
            return "differs"
        return "better" if (self.low > 0.0) == higher_is_better else "worse"


def difference_of_means(before: Floats, after: Floats) -> PairedDifference:
    """Of two runs of the same (N,) scenarios, NaN where a value does not exist: such a pair is left out."""
    both = ~(np.isnan(before) | np.isnan(after))
    before, after = before[both], after[both]
    n, changes = len(before), after - before
    if not n:
        return PairedDifference(math.nan, math.nan, math.nan, math.nan, 0, 0)
    low, high = _interval(changes[_draws(n)].sum(axis=1) / n, n) if changes.any() else (0.0, 0.0)
    return PairedDifference(float(before.mean()), float(after.mean()), low, high, n, int(np.count_nonzero(changes)))


def difference_of_rates(
    before: tuple[Floats, Floats], after: tuple[Floats, Floats], per: float = 100.0
) -> PairedDifference:
    """Of pooled rates: of each run what was counted (N,) and the metres (N,) it is counted on. All that was counted on
    all metres of the scenarios that are drawn, in both runs the same ones."""
    columns = np.array([*before, *after])
    columns = columns[:, ~np.isnan(columns).any(axis=0)]
    n = columns.shape[1]
    if not n or min(columns[1].sum(), columns[3].sum()) < RATE_NEEDS_M:
        return PairedDifference(math.nan, math.nan, math.nan, math.nan, 0, 0)
    counted, metres, counted_after, metres_after = columns
    rates = per * counted.sum() / metres.sum(), per * counted_after.sum() / metres_after.sum()
    apart = (counted != counted_after) | (metres != metres_after)
    changed = int((apart & ((counted > 0.0) | (counted_after > 0.0))).sum())
    if not apart.any() or not (counted.any() or counted_after.any()):
        return PairedDifference(*rates, 0.0, 0.0, n, 0)
    drawn = [column[_draws(n)].sum(axis=1) for column in columns]
    moved = (drawn[1] > 0.0) & (drawn[3] > 0.0)
    counted, metres, counted_after, metres_after = (column[moved] for column in drawn)
    low, high = _interval(per * (counted_after / metres_after - counted / metres), n)
    return PairedDifference(*rates, low, high, n, changed)


def _interval(differences: Floats, n: int) -> tuple[float, float]:
    """The middle of what was drawn of n pairs; none for one pair, which has no spread."""
    if n < 2 or not len(differences):
        return math.nan, math.nan
    t = stdtrit(n - 1, 0.5 + CONFIDENCE / 2)
    tail = float(ndtr(-t * math.sqrt(n / (n - 1))))
    low, high = np.quantile(differences, [tail, 1.0 - tail])
    return float(low), float(high)


@lru_cache(maxsize=8)
def _draws(n: int) -> NDArray[np.int64]:
    """(BOOTSTRAP, n) which of n pairs are drawn."""
    draws = np.random.default_rng(0).integers(n, size=(BOOTSTRAP, n))
    draws.flags.writeable = False
    return draws
