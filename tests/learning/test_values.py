"""Weights of a learner's own commands by the returns of their episodes; needs no PyTorch."""

from __future__ import annotations

import numpy as np

from cosim.learning.values import MAX_WEIGHT, weights_of


def test_weights_follow_actions_and_not_scenes() -> None:
    """Good actions weigh more and easy scenes do not; the mean weight is 1, and none exceeds the
    bound."""
    draws = np.random.default_rng(5)
    scene = draws.normal(size=(4000, 6)).astype(np.float32)
    good = draws.random(4000) < 0.5
    returns = 8.0 * scene[:, 0] + 3.0 * scene[:, 1] + 2.0 * good
    episode = np.arange(4000) // 20
    learned = draws.random(200)[episode] < 0.9
    found = weights_of(scene, returns, episode, learned, 1.0)
    assert found.weight[good].mean() > 2.0 * found.weight[~good].mean()
    easy = scene[:, 0] > 0.0
    assert abs(found.weight[easy].mean() - found.weight[~easy].mean()) < 0.1
    assert abs(found.weight[learned].mean() - 1.0) < 1e-5
    assert found.explained > 0.9 and 0.3 < found.effective < 1.0
    milder = weights_of(scene, returns, episode, learned, 10.0)
    assert milder.weight.std() < 0.3 * found.weight.std()
    returns[0] = 1e4
    bounded = weights_of(scene, returns, episode, learned, 1.0).weight
    assert 0.9 < bounded[0] / np.median(bounded) / MAX_WEIGHT < 1.1


def test_an_uninformed_value_does_not_hide_advantages() -> None:
    """With more features than episodes and random returns the value is near the mean, and lucky
    episodes keep their weight."""
    draws = np.random.default_rng(7)
    episode = np.arange(2000) // 20
    features = draws.normal(size=(100, 150))[episode].astype(np.float32)
    luck = draws.normal(size=100)[episode]
    learned = episode % 5 != 0
    found = weights_of(features, luck, episode, learned, 1.0)
    assert found.explained > -0.2
    lucky = found.weight[learned & (luck > 1.0)].mean()
    assert lucky > 3.0 * found.weight[learned & (luck < -1.0)].mean()
