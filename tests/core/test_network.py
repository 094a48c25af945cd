"""Layers of small networks: their formulas, batches and bits."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
from numpy.typing import NDArray

from cosim.core.network import Dense, Gru, sigmoid, softmax

PROCESS = """
import cosim
from tests.core.test_network import outputs
print(outputs().tobytes().hex())
"""


def normal(seed: int, *shape: int) -> NDArray[np.float32]:
    return (0.5 * np.random.default_rng(seed).normal(size=shape)).astype(np.float32)


def gru() -> Gru:
    return Gru(normal(1, 7, 15), normal(2, 5, 15), normal(3, 15), normal(4, 15))


def outputs() -> NDArray[np.float32]:
    """Return shares of a batch of three after ten steps of a recurrent layer and a dense one."""
    output, layer = np.zeros((3, 5), np.float32), Dense(normal(5, 5, 4), normal(6, 4), "tanh")
    for k in range(10):
        output = gru().remember(normal(20 + k, 3, 7), output)
    return softmax(layer.answer(output))


def test_a_gated_recurrent_unit_follows_its_formula() -> None:
    """The formula is that of PyTorch, in float64."""
    layer, output = gru(), normal(8, 5)
    given = normal(9, 7).astype(float) @ layer.weight + layer.bias
    own = output.astype(float) @ layer.own_weight + layer.own_bias
    reset, update = (1.0 / (1.0 + np.exp(-(given + own)[i : i + 5])) for i in (0, 5))
    new = np.tanh(given[10:] + reset * own[10:])
    expected = (1.0 - update) * new + update * output
    assert np.abs(layer.remember(normal(9, 7), output) - expected).max() < 1e-6


def test_a_batch_has_the_bits_of_its_rows() -> None:
    """Batches equal their rows in a dense and in a recurrent layer."""
    rows, memory = normal(10, 6, 7), normal(11, 6, 5)
    dense = Dense(normal(12, 7, 9), normal(13, 9), "relu")
    assert (dense.answer(rows) == [dense.answer(row) for row in rows]).all()
    singly = [gru().remember(row, one) for row, one in zip(rows, memory, strict=True)]
    assert (gru().remember(rows, memory) == singly).all()


def test_shares_sum_to_one() -> None:
    """Shares are proportional to the exponentials, however large these are."""
    x = np.array([[1000.0, 1001.0, 900.0], [0.0, 0.0, 0.0]], np.float32)
    expected = [[1.0 / (1.0 + np.e), np.e / (1.0 + np.e), 0.0], 3 * [1.0 / 3.0]]
    assert np.abs(softmax(x) - expected).max() < 1e-7
    assert np.abs(sigmoid(x[1] + 2.0) - 1.0 / (1.0 + np.exp(-2.0))).max() < 1e-7


def test_batches_have_the_same_bits_without_fused_multiply_adds() -> None:
    """The bits are the same without FMA and without AVX2."""
    done = subprocess.run(
        [sys.executable, "-c", PROCESS],
        env={**os.environ, "NPY_DISABLE_CPU_FEATURES": "X86_V3"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == outputs().tobytes().hex()
