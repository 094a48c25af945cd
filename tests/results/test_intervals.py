"""Intervals against published values, and counts where there are too few episodes."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from cosim.results.intervals import (
    MIN_N,
    RARE,
    bootstrap,
    counts_in_words,
    estimate_of_mean,
    estimate_of_rate,
    estimate_of_share,
    garwood,
    wilson,
)
from cosim.results.table import estimate_of


@pytest.mark.parametrize(
    ("counted", "n", "low", "high"),
    [
        (0, 10, 0.0, 0.2775),
        (10, 10, 0.7225, 1.0),
        (5, 10, 0.2366, 0.7634),
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ],
)
def test_wilson_is_as_published(counted: int, n: int, low: float, high: float) -> None:
    """The four cases of Newcombe (1998), table I, method 3, agree, and the same formula by hand."""
    assert wilson(counted, n) == pytest.approx((low, high), abs=6e-5)


@pytest.mark.parametrize(
    ("counted", "low", "high"),
    [
        (0, 0.0, 3.6889),
        (1, 0.0253, 5.5716),
        (3, 0.6187, 8.7673),
        (10, 4.7954, 18.3904),
        (19, 11.4393, 29.6709),
    ],
)
def test_garwood_is_as_published(counted: int, low: float, high: float) -> None:
    """Exact limits of a Poisson count equal the published tables."""
    assert garwood(counted) == pytest.approx((low, high), abs=6e-5)


def test_the_interval_of_a_share_covers_the_true_share() -> None:
    """For 20 episodes with true shares of 0.02 to 0.98 it does so in 93 to 97 of 100 runs."""
    rng = np.random.default_rng(5)
    true = rng.uniform(0.02, 0.98, 4000)
    bounds = [wilson(k, 20) for k in rng.binomial(20, true).tolist()]
    covered = [low <= share <= high for share, (low, high) in zip(true, bounds, strict=True)]
    assert 0.93 <= np.mean(covered) <= 0.97


def test_a_rate_has_an_exact_interval_for_few_failures_else_a_bootstrap() -> None:
    """Three failures on 1000 m give Garwood's limits by ten; from RARE failures on episodes are
    resampled."""
    counts, metres = np.array([1.0, 0.0, 2.0, 0.0, 0.0]), np.full(5, 200.0)
    few = estimate_of_rate(counts, metres)
    assert (few.mean, few.n, few.counted, few.metres) == (0.3, 5, 3.0, 1000.0)
    assert (few.low, few.high) == pytest.approx((0.06187, 0.87673), abs=1e-5)
    none = estimate_of_rate(np.zeros(5), metres)
    assert (none.low, none.high) == pytest.approx((0.0, 0.36889), abs=1e-5)
    many = np.array([0.0, 0.0, 0.0, 0.0, float(RARE)])
    drawn = estimate_of_rate(many, metres)
    assert (drawn.low, drawn.high) == bootstrap(100.0 * many, metres)
    assert (drawn.low, drawn.high) != pytest.approx([c / 10 for c in garwood(RARE)])


def test_means_have_a_bootstrap_interval() -> None:
    """It is the bootstrap of the mean of values, and with equal weights the same."""
    values = np.array([0.0, 0.5, 1.0, 1.0, 0.2, 1.0])
    unweighted = estimate_of_mean(values)
    assert (unweighted.low, unweighted.high) == bootstrap(values) == bootstrap(values, np.ones(6))
    assert 0.0 <= unweighted.low < values.mean() < unweighted.high <= 1.0


@pytest.mark.parametrize("n", range(MIN_N + 1))
def test_below_five_episodes_there_are_only_counts(n: int) -> None:
    """Shares give solved of all, rates failures in metres, means the value; from five on all have
    an interval."""
    shares = estimate_of_share((np.arange(n) < 3).astype(float))
    means = estimate_of_mean(np.full(n, 2.5))
    assert {shares.has_interval, means.has_interval} == {n >= MIN_N}
    if not n:
        assert (shares.in_words, means.in_words, shares.interval_in_words()) == ("-", "-", "-")
        return
    rates = estimate_of_rate((np.arange(n) < 2).astype(float), np.full(n, 100.2))
    assert rates.has_interval == (n >= MIN_N)
    if n < MIN_N:
        assert shares.in_words == shares.counts == f"{min(n, 3)}/{n}"
        assert rates.in_words == rates.counts == f"{min(n, 2)} in {100.2 * n:.0f} m"
        assert means.in_words == "2.50" and means.counts == ""
        assert {e.interval_in_words() for e in (shares, rates, means)} == {"-"}
    else:
        assert (shares.in_words, shares.interval_in_words()) == ("0.60", "0.23 to 0.88")
        assert rates.interval_in_words("..") == "0.05..1.44"


def test_metrics_have_the_interval_of_their_kind() -> None:
    """Success is a share by definition, and a route completion of only 0 and 1 is not."""
    values = [1.0, 1.0, 1.0, 1.0, 0.0, 1.0]
    table = pd.DataFrame({"status": "done", "success": values, "route_completion": values})
    success, completion = (estimate_of(table, name) for name in ("success", "route_completion"))
    assert success.mean == completion.mean == 5 / 6
    assert (success.low, success.high) == wilson(5, 6) and completion.counts == ""
    assert (completion.low, completion.high) == bootstrap(np.array(values))
    assert success.counts == counts_in_words(5, 6) == "5/6"
