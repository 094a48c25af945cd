"""Confidence intervals of shares, of rates and of other means over episodes.

| value                          | interval |
|--------------------------------|----------|
| share of episodes              | Wilson (1927) score interval |
| rate with fewer than RARE events | exact Poisson interval (Garwood 1936) |
| rate with more events, mean    | percentile bootstrap over episodes |
| fewer than MIN_N episodes      | none: only the counts are shown |
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from scipy.special import gammaincinv, ndtri

from cosim.core.geometry import Floats

CONFIDENCE: Final = 0.95
"""Confidence level of all intervals."""
BOOTSTRAP: Final = 2000
"""Number of bootstrap samples."""
MIN_N: Final = 5
"""Fewest episodes with an interval or a verdict: below, a bootstrap sees almost no spread."""
RATE_PER_M: Final = 100.0
"""Metres that rates refer to."""
RARE: Final = 20
"""Number of events from which on the interval of a rate is a bootstrap interval."""
_TAIL: Final = (1.0 - CONFIDENCE) / 2
"""Probability beyond either bound."""
_NONE: Final = (math.nan, math.nan)
"""Bounds without an interval."""


class Estimate(NamedTuple):
    """Mean over n episodes with its interval.

    mean: share, mean, or rate per 100 m; NaN without a value
    low, high: bounds of the interval; NaN below MIN_N episodes
    n: number of episodes with a value
    counted: of a share the episodes that count, of a rate the events; NaN for other means
    metres: of a rate, the distance; NaN for other values
    """

    mean: float
    low: float
    high: float
    n: int
    counted: float = math.nan
    metres: float = math.nan

    @property
    def has_interval(self) -> bool:
        """Whether there is an interval."""
        return not math.isnan(self.low)

    @property
    def counts(self) -> str:
        """Counts of a share or rate as text; "" for other means and without a value."""
        if not self.n or math.isnan(self.counted):
            return ""
        return counts_in_words(self.counted, self.n, self.metres)

    @property
    def in_words(self) -> str:
        """Mean with two decimals, or the counts below MIN_N; "-" without a value.

        >>> Estimate(0.75, 0.41, 0.93, 12, counted=9.0).in_words
        '0.75'
        """
        if math.isnan(self.mean):
            return "-"
        return (self.n < MIN_N and self.counts) or f"{self.mean:.2f}"

    def interval_in_words(self, to: str = " to ") -> str:
        """Return the interval with two decimals; "-" without one."""
        return f"{self.low:.2f}{to}{self.high:.2f}" if self.has_interval else "-"


NO_ESTIMATE: Final = Estimate(math.nan, math.nan, math.nan, 0)
"""Estimate of a metric without a value."""


def counts_in_words(counted: float, n: int, metres: float = math.nan) -> str:
    """Return the counts of a share or, with metres, of a rate as text.

    >>> counts_in_words(3, 4)
    '3/4'
    >>> counts_in_words(2, 3, 310.2)
    '2 in 310 m'
    """
    return f"{counted:.0f}" + (f"/{n}" if math.isnan(metres) else f" in {metres:.0f} m")


def estimate_of_share(values: Floats) -> Estimate:
    """Estimate a share from values (N,), each 0 or 1."""
    return estimate_of_counts(float(values.sum()), len(values))


def estimate_of_counts(counted: float, n: int) -> Estimate:
    """Estimate a share from the number of episodes that count, of n."""
    if not n:
        return NO_ESTIMATE
    interval = wilson(counted, n) if n >= MIN_N else _NONE
    return Estimate(counted / n, *interval, n, counted)


def estimate_of_mean(values: Floats) -> Estimate:
    """Estimate a mean from values (N,)."""
    n = len(values)
    if not n:
        return NO_ESTIMATE
    interval = bootstrap(values) if n >= MIN_N else _NONE
    return Estimate(float(values.mean()), *interval, n)


def estimate_of_rate(counts: Floats, metres: Floats) -> Estimate:
    """Estimate a pooled rate per 100 m: all events divided by all metres.

    counts, metres: events and distance of each episode (N,); some distance is above 0
    """
    n, counted, over_m = len(counts), float(counts.sum()), float(metres.sum())
    if n < MIN_N:
        interval = _NONE
    elif counted < RARE:
        low, high = garwood(counted)
        interval = RATE_PER_M * low / over_m, RATE_PER_M * high / over_m
    else:
        interval = bootstrap(RATE_PER_M * counts, metres)
    return Estimate(RATE_PER_M * counted / over_m, *interval, n, counted, over_m)


def wilson(counted: float, n: int) -> tuple[float, float]:
    """Return the Wilson score interval of the share counted / n; n > 0.

    It stays within [0, 1], and is no point where all or none of the episodes count.
    """
    z2 = float(ndtri(1.0 - _TAIL)) ** 2
    middle = (counted + z2 / 2) / (n + z2)
    half = math.sqrt(z2 * (counted * (n - counted) / n + z2 / 4)) / (n + z2)
    low = 0.0 if counted == 0 else middle - half
    high = 1.0 if counted == n else middle + half
    return low, high


def garwood(counted: float) -> tuple[float, float]:
    """Return the exact interval of the mean of a Poisson distribution with this observed count."""
    low = float(gammaincinv(counted, _TAIL)) if counted else 0.0
    return low, float(gammaincinv(counted + 1.0, 1.0 - _TAIL))


def bootstrap(values: Floats, weights: Floats | None = None) -> tuple[float, float]:
    """Return the percentile bootstrap interval of the mean of values (N,), N > 0.

    weights: if given, the interval of sum(values) / sum(weights)

    The draws are always the same.
    """
    draws = np.random.default_rng(0).integers(len(values), size=(BOOTSTRAP, len(values)))
    over = np.full(len(values), 1.0) if weights is None else weights
    drawn = over[draws].sum(axis=1)
    means = values[draws].sum(axis=1)[drawn > 0.0] / drawn[drawn > 0.0]
    low, high = np.quantile(means, [_TAIL, 1.0 - _TAIL])
    return float(low), float(high)
