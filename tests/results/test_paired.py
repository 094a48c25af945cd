"""Paired differences: cases worked out by hand, the coverage of intervals, and their power."""

from __future__ import annotations

import numpy as np
import pytest

from cosim.core.geometry import Floats
from cosim.results.compare import PairedDifference, difference_of_means, difference_of_rates

NAN = float("nan")


def flips(n: int, won: int, lost: int, solved: int = 0) -> PairedDifference:
    """Outcomes of n scenarios: solved by the second run alone (won), the first alone (lost), or
    both."""
    first, second = np.zeros(n), np.zeros(n)
    second[:won] = 1.0
    first[won : won + lost] = 1.0
    first[won + lost : won + lost + solved] = second[won + lost : won + lost + solved] = 1.0
    return difference_of_means(first, second)


def test_a_difference_of_means_by_hand() -> None:
    """Ten scenarios, eight won: what is drawn is binomial, ten draws of 0.8. Student's t of 9
    degrees is 2.262, times the root of 10/9 it is 2.384, which leaves 0.0086 in each tail: five or
    fewer come in 0.033 of the draws, four or fewer in 0.006, and all ten in 0.107, so the interval
    is from 0.5 to 1."""
    found = flips(10, 8, 0)
    assert (found.before, found.after, found.n, found.changed) == (0.0, 0.8, 10, 8)
    assert (
        (found.low, found.high) == (0.5, 1.0)
        and found.verdict(True) == "better"
        and found.verdict(False) == "worse"
    )
    assert found.verdict(None) == "differs"


def test_a_difference_of_rates_by_hand() -> None:
    """10 failures on 2 m and none on 4 x 400 m, against none: 1000 / 1602 less. Student's t of 4
    degrees is 2.776, times the root of 5/4 it is 3.104, which leaves 0.00096 in each tail: a draw
    holds the first five times in 0.0003 of all, four times in 0.0064, and never in 0.33."""
    metres = np.array([2.0, *[400.0] * 4])
    found = difference_of_rates((np.array([10.0, *[0.0] * 4]), metres), (np.zeros(5), metres))
    assert found.before == pytest.approx(1000 / 1602) and found.after == 0.0 and found.n == 5
    assert (found.low, found.high) == (pytest.approx(-4000 / 408), 0.0)
    assert found.verdict(False) == "within noise"


def test_pairs_are_resampled_as_pairs() -> None:
    """A small equal change among very different scenarios is found, which independent resampling
    would hide."""
    hard = np.random.default_rng(3).uniform(0.0, 100.0, 50)
    found = difference_of_means(hard, hard + np.linspace(0.01, 0.03, 50))
    assert 0.01 < found.low < found.difference < found.high < 0.03


def test_equal_runs_are_within_noise() -> None:
    """Without a change the interval is 0 to 0; below five pairs there is neither interval nor
    verdict; no pairs give nothing."""
    values = np.array([0.3, NAN, 0.7, 1.0, 0.2, 0.1])
    alike = difference_of_means(values, values)
    assert (alike.low, alike.high, alike.n, alike.changed, alike.verdict(True)) == (
        0.0,
        0.0,
        5,
        0,
        "within noise",
    )
    rates = difference_of_rates((values, values), (values, values))
    assert (rates.low, rates.high, rates.changed, rates.verdict(False)) == (
        0.0,
        0.0,
        0,
        "within noise",
    )
    for n in range(1, 5):
        for few in (
            flips(n, n, 0),
            flips(n, 0, 0),
            difference_of_rates(*[(np.ones(n), np.ones(n))] * 2),
        ):
            assert few.verdict(True) == "" and np.isnan([few.low, few.high]).all() and few.n == n
    none = difference_of_means(np.array([NAN, 1.0]), np.array([1.0, NAN]))
    assert none.n == 0 and np.isnan(none.difference) and none.verdict(True) == ""


def test_fewer_than_six_scenarios_that_changed_are_too_few() -> None:
    """Five of a thousand, all won, are no verdict, since equal runs give this once in sixteen; six
    are one in 32."""
    assert flips(1000, 5, 0).low > 0.0 and flips(1000, 5, 0).verdict(True) == "too few"
    assert (
        flips(1000, 6, 0).verdict(True) == "better" and flips(1000, 0, 6).verdict(True) == "worse"
    )


def test_a_rate_needs_six_scenarios_with_a_failure() -> None:
    """Five of a hundred, with other lengths in the other run, are too few, and six are enough."""
    metres = np.full(100, 15.0), np.linspace(15.001, 15.1, 100)
    for failures, verdict in ((5, "too few"), (6, "better")):
        counted = (np.arange(100) < failures).astype(float)
        found = difference_of_rates((counted, metres[0]), (np.zeros(100), metres[1]))
        assert found.high < 0.0 and (found.changed, found.verdict(False)) == (failures, verdict)
        assert difference_of_means(counted, np.zeros(100)).verdict(False) == verdict
    none = difference_of_rates((np.zeros(5), metres[0][:5]), (np.zeros(5), metres[1][:5]))
    assert (none.low, none.high, none.verdict(False)) == (0.0, 0.0, "within noise")


@pytest.mark.parametrize(
    ("won", "lost", "verdict"),
    [
        (0, 24, "worse"),
        (24, 0, "better"),
        (28, 52, "worse"),
        (52, 28, "better"),
        (68, 92, "within noise"),
    ],
)
def test_three_in_a_hundred_of_800_is_found_where_flips_are_few(
    won: int, lost: int, verdict: str
) -> None:
    """24 of 800 fewer solved are found with 24 or 80 flips (4.9 and 2.7 standard errors), not with
    160 (1.9)."""
    found = flips(800, won, lost, 400)
    assert abs(found.difference) == pytest.approx(0.03) and found.verdict(True) == verdict


def drawn_pairs(
    rng: np.random.Generator, n: int, flipped: float, gained: float
) -> tuple[Floats, Floats]:
    """Draw two runs of n scenarios with this share of flips, so that the second gains this much on
    average."""
    way = rng.choice(
        [1.0, -1.0, 0.0], size=n, p=[(flipped + gained) / 2, (flipped - gained) / 2, 1.0 - flipped]
    )
    return (way < 0.0).astype(float), (way > 0.0).astype(float)


def test_the_power_at_three_in_a_hundred_is_as_documented() -> None:
    """800 scenarios with a tenth flipped have a power of 0.77, and without a gain one in twenty
    gets a verdict."""
    rng = np.random.default_rng(11)
    found = [
        difference_of_means(*drawn_pairs(rng, 800, 0.1, 0.03)).verdict(True) == "better"
        for _ in range(200)
    ]
    assert 0.66 <= np.mean(found) <= 0.86
    false = [
        difference_of_means(*drawn_pairs(rng, 200, 0.1, 0.0)).verdict(True) != "within noise"
        for _ in range(300)
    ]
    assert np.mean(false) <= 0.09


@pytest.mark.parametrize("n", [10, 40])
def test_intervals_cover_the_true_difference(n: int) -> None:
    """They do in 95 of 100 runs, for a mean of correlated pairs and a pooled rate of unequal
    scenarios."""
    rng = np.random.default_rng(n)
    means = []
    rates = []
    for _ in range(500):
        hard = rng.normal(size=n)
        mean = difference_of_means(hard, hard + 0.3 + rng.normal(size=n))
        means.append(mean.low <= 0.3 <= mean.high)
        metres, harder = rng.uniform(200.0, 500.0, n), rng.gamma(2.0, 0.5, n)
        counted = [rng.poisson(per_m * metres * harder).astype(float) for per_m in (0.05, 0.04)]
        rate = difference_of_rates((counted[0], metres), (counted[1], metres))
        rates.append(rate.low <= -1.0 <= rate.high)
    assert 0.92 <= np.mean(means) <= 0.98 and 0.90 <= np.mean(rates) <= 0.98


def test_the_same_runs_give_the_same_intervals() -> None:
    """They are equal to the bit, whatever was drawn in between."""
    rng = np.random.default_rng(0)
    pair = drawn_pairs(rng, 90, 0.3, 0.1)
    first = difference_of_means(*pair)
    difference_of_means(*drawn_pairs(rng, 90, 0.3, 0.1))
    np.random.default_rng(7).random(1000)
    assert difference_of_means(*pair) == first
