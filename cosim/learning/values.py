"""Weights of a learner's own commands by how much better than expected their episodes went on.

Rows with rewards are imitated with the weight exp(A / (temperature sigma)), at most MAX_WEIGHT.
The advantage A is the discounted return minus a value, which estimates the return from what the
network sees. sigma is the standard deviation of A. This is one iteration of advantage-weighted
regression (Peng et al., 2019, arXiv 1910.00177), as in MARWIL (Wang et al., NeurIPS 2018) and CRR
(Wang et al., 2020, arXiv 2006.15134). It is a step to a better policy near the one that drove.

The value is a ridge regression on features of the network that drove. It is fitted once, before
the training, on other training episodes than those that it judges. It can be noisy where chance
decides: a lucky episode is imitated like a good one (Paster et al., 2022, arXiv 2205.15967).
Therefore exploration changes commands in every episode, and weights are bounded.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

HORIZON_S: Final = 5.0
"""Time in which the weight of a reward in a return falls by the factor e."""
MAX_WEIGHT: Final = 20.0
"""Largest weight, before weights are scaled to the mean 1."""
_RIDGES: Final = (1e-3, 1e-2, 0.1, 1.0, 10.0, 100.0)
"""Penalties of the squared coefficients of standardised features, per row, to choose from."""
_FOLDS: Final = 5
"""Number of parts of the training episodes; the value of each is fitted on the others."""
_TOGETHER: Final = 8
"""Number of consecutive episodes in a part: an event, its decoy and what follows a reset."""


def discounted_returns(
    reward: NDArray[np.float32], episode: NDArray[np.int64], period_s: float
) -> NDArray[np.float64]:
    """Return the discounted sum of rewards from each row to the end of its episode (N,).

    reward: (N,) NaN where there is none
    episode: (N,) ascending numbers

    >>> discounted_returns(np.array([1.0, 2.0, 4.0]), np.array([0, 0, 1]), 1e9).tolist()
    [1.0, 2.0, 4.0]
    >>> discounted_returns(np.array([1.0, 2.0, 4.0]), np.array([0, 0, 1]), 0.0).tolist()
    [3.0, 2.0, 4.0]
    """
    discount = math.exp(-period_s / HORIZON_S)
    ends = np.append(np.diff(episode) != 0, True).tolist()
    found = []
    total = 0.0
    for one, last in zip(reward[::-1].tolist(), ends[::-1], strict=True):
        total = one + (0.0 if last else discount * total)
        found.append(total)
    return np.array(found[::-1])


class Weighting(NamedTuple):
    """Weights of rows, and how they were found.

    weight: (N,) weights with the mean 1 on the training rows
    explained: share of the variance of held-out returns that the value explains; at most 1
    effective: share of training rows that as many equal weights would have: (sum w)^2 / sum w^2
    """

    weight: NDArray[np.float32]
    explained: float
    effective: float

    @property
    def in_words(self) -> str:
        """Return the figures in words."""
        return (
            f"the value explains {self.explained:.2f} of the variance of held-out returns, and "
            f"the weights are worth {self.effective:.2f} of the rows"
        )


def weights_of(
    features: NDArray[np.float32],
    returns: NDArray[np.float64],
    episode: NDArray[np.int64],
    learned: NDArray[np.bool_],
    temperature: float,
) -> Weighting:
    """Return the weights of rows by their advantages.

    features: (N, F) of what the network sees
    returns: (N,) discounted returns
    episode: (N,) numbers, of which neighbours may be alike
    learned: (N,) whether a row is trained on; the others judge the value
    temperature: in standard deviations of the advantage
    """
    advantage = _advantages(features, returns, episode, learned)
    others = ~learned
    variance = float(returns[others].var()) if others.any() else 0.0
    explained = 1.0 - float(np.mean(advantage[others] ** 2)) / variance if variance else math.nan
    unit = temperature * max(float(advantage[learned].std()), 1e-9)
    weight = np.exp(np.minimum(advantage / unit, math.log(MAX_WEIGHT)))
    total, squares = weight[learned].sum(), (weight[learned] ** 2).sum()
    effective = float(total**2 / squares / learned.sum())
    return Weighting((weight * (learned.sum() / total)).astype(np.float32), explained, effective)


def _advantages(
    features: NDArray[np.float32],
    returns: NDArray[np.float64],
    episode: NDArray[np.int64],
    learned: NDArray[np.bool_],
) -> NDArray[np.float64]:
    """Return the returns minus values (N,), see `weights_of`.

    The value of a training row is fitted on the other folds of training episodes: one that has
    seen the row's own return would hide its advantage. The penalty is that of the least error.
    """
    mean, spread = features[learned].mean(axis=0), features[learned].std(axis=0)
    scaled = ((features - mean) / np.where(spread > 0.0, spread, 1.0)).astype(np.float64)
    off = returns - returns[learned].mean()
    fold = np.where(learned, episode // _TOGETHER % _FOLDS, _FOLDS)
    rows = [fold == k for k in range(_FOLDS + 1)]
    squares = np.stack([scaled[of].T @ scaled[of] for of in rows[:-1]])
    products = np.stack([scaled[of].T @ off[of] for of in rows[:-1]])
    values = np.zeros((len(off), len(_RIDGES)))
    for k, of in enumerate(rows):
        others = [other for other in range(_FOLDS) if other != k]
        count = max(sum(int(rows[other].sum()) for other in others), 1)
        square, product = squares[others].sum(axis=0), products[others].sum(axis=0)
        factors = [
            np.linalg.solve(square + ridge * count * np.eye(len(square)), product)
            for ridge in _RIDGES
        ]
        values[of] = scaled[of] @ np.stack(factors, axis=1)
    errors = ((off[:, None] - values)[learned] ** 2).mean(axis=0)
    found: NDArray[np.float64] = off - values[:, int(errors.argmin())]
    return found
