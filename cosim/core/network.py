"""Evaluate small neural networks with the same bits on every processor.

Matrix products are sums in a fixed order, because those of BLAS depend on the processor. The
exponential function consists of sums and products, because that of numpy depends on it, too. A
decision of the walker takes about 0.05 ms.

`Network` evaluates layers in order. Networks with other structures call the layers themselves:
inputs of a layer have shape (inputs,) or (batch, inputs).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

Floats32 = NDArray[np.float32]
Activation = Literal["linear", "elu", "relu", "tanh"]
ACTIVATIONS: Final[tuple[Activation, ...]] = get_args(Activation)
"""Names of the activation functions."""
Memory = tuple[Floats32, ...]
"""State of all recurrent layers: output and cell of each, in the order of the layers."""

_LSTM: Final = "lstm"
_SQUARINGS: Final = 10
"""Squarings in `exponential`, whose argument is divided by 2 to this power first."""
_COEFFICIENTS: Final = (1 / 120, 1 / 24, 1 / 6, 1 / 2, 1.0)
"""Coefficients of the exponential series, from the fifth power down to the first."""
_SMALLEST: Final = -40.0
"""Argument below which the exponential function is taken as constant."""


@dataclass(frozen=True, eq=False)
class Dense:
    """Fully connected layer.

    weight: (inputs, outputs).
    bias: (outputs,).
    """

    weight: Floats32
    bias: Floats32
    activation: Activation

    @property
    def sizes(self) -> tuple[int, int]:
        """Numbers of inputs and outputs."""
        inputs, outputs = self.weight.shape
        return inputs, outputs

    def answer(self, numbers: Floats32) -> Floats32:
        """Return the outputs, (outputs,) or (batch, outputs)."""
        return _activated(self.activation, _product(self.weight, numbers) + self.bias)


@dataclass(frozen=True, eq=False)
class Lstm:
    """Long short-term memory of one layer; gates are input, forget, cell and output.

    weight: (inputs + outputs, 4 * outputs), rows of the inputs first.
    bias: (4 * outputs,).
    """

    weight: Floats32
    bias: Floats32

    @property
    def sizes(self) -> tuple[int, int]:
        """Numbers of inputs and outputs."""
        outputs = self.weight.shape[1] // 4
        return self.weight.shape[0] - outputs, outputs

    def remember(
        self, numbers: Floats32, output: Floats32, cell: Floats32
    ) -> tuple[Floats32, Floats32]:
        """Return the next output and cell, (outputs,) each."""
        size = self.sizes[1]
        gates = _product(self.weight, np.concatenate((numbers, output))) + self.bias
        half = np.float32(0.5)
        gates[: 2 * size] *= half
        gates[3 * size :] *= half
        bent = tanh(gates)
        shares = half * bent + half  # sigmoid(x) = tanh(x / 2) / 2 + 1 / 2
        cell = shares[size : 2 * size] * cell + shares[:size] * bent[2 * size : 3 * size]
        return shares[3 * size :] * tanh(cell), cell


@dataclass(frozen=True, eq=False)
class Gru:
    """Gated recurrent unit of one layer, as PyTorch defines it; gates are reset, update and new.

    weight: (inputs, 3 * outputs), of the inputs.
    own_weight: (outputs, 3 * outputs), of the last output.
    bias, own_bias: (3 * outputs,).
    """

    weight: Floats32
    own_weight: Floats32
    bias: Floats32
    own_bias: Floats32

    def remember(self, numbers: Floats32, output: Floats32) -> Floats32:
        """Return the next output, (outputs,) or (batch, outputs)."""
        size = self.own_weight.shape[0]
        given = _product(self.weight, numbers) + self.bias
        own = _product(self.own_weight, output) + self.own_bias
        shares = sigmoid(given[..., : 2 * size] + own[..., : 2 * size])
        reset, update = shares[..., :size], shares[..., size:]
        new = tanh(given[..., 2 * size :] + reset * own[..., 2 * size :])
        return new + update * (output - new)


Layer = Dense | Lstm


@dataclass(frozen=True, eq=False)
class Network:
    """Layers that are evaluated in order.

    Raises ValueError if there are none, the sizes do not match, or weights are not finite.
    """

    layers: tuple[Layer, ...]

    def __post_init__(self) -> None:
        if not self.layers:
            raise ValueError("has no layers")
        for i, layer in enumerate(self.layers):
            _check(i, layer)
            if i and layer.sizes[0] != self.layers[i - 1].sizes[1]:
                raise ValueError(
                    f"layer {i} takes {layer.sizes[0]} numbers, and layer {i - 1} has "
                    f"{self.layers[i - 1].sizes[1]} outputs"
                )

    @property
    def sizes(self) -> tuple[int, int]:
        """Numbers of inputs and outputs."""
        return self.layers[0].sizes[0], self.layers[-1].sizes[1]

    def empty_memory(self) -> Memory:
        """Return the memory before the first evaluation."""
        sizes = [layer.sizes[1] for layer in self.layers if isinstance(layer, Lstm)]
        return tuple(np.zeros(size, np.float32) for size in sizes for _ in range(2))

    def answer(self, given: Floats32, memory: Memory) -> tuple[Floats32, Memory]:
        """Return the outputs for inputs of shape (inputs,), and the next memory."""
        state = iter(memory)
        after: list[Floats32] = []
        numbers = given
        for layer in self.layers:
            if isinstance(layer, Lstm):
                numbers, cell = layer.remember(numbers, next(state), next(state))
                after += numbers, cell
            else:
                numbers = layer.answer(numbers)
        return numbers, tuple(after)

    def arrays(self) -> dict[str, Floats32]:
        """Return all weights; `network_of` reads them. A name has index, kind and field."""
        return {
            f"{i}.{layer.activation if isinstance(layer, Dense) else _LSTM}.{field}": numbers
            for i, layer in enumerate(self.layers)
            for field, numbers in (("weight", layer.weight), ("bias", layer.bias))
        }


def network_of(arrays: Mapping[str, NDArray[Any]]) -> Network:
    """Return the network with the arrays of `Network.arrays`. Raises ValueError for others."""
    layers: list[Layer] = []
    for i in range(len(arrays) // 2):
        found = [kind for kind in ACTIVATIONS if f"{i}.{kind}.weight" in arrays]
        begin = f"{i}.{found[0] if found else _LSTM}"
        weight, bias = (arrays.get(f"{begin}.{field}") for field in ("weight", "bias"))
        if weight is None or bias is None:
            raise ValueError(f"has no weight and bias of layer {i}")
        if weight.dtype != np.float32 or bias.dtype != np.float32:
            raise ValueError(f"layer {i} has {weight.dtype} and {bias.dtype}; expected float32")
        layers.append(Dense(weight, bias, found[0]) if found else Lstm(weight, bias))
    if len(arrays) != 2 * len(layers):
        raise ValueError(f"has {len(arrays)} arrays, an odd number")
    return Network(tuple(layers))


def exponential(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return exp(x) for x <= 0, with a relative error below 1e-10 above exp(-20).

    A polynomial near 0 is squared repeatedly. All operations are exactly rounded on every
    processor.
    """
    small = np.maximum(x, _SMALLEST) * 0.5**_SQUARINGS
    power = small * _COEFFICIENTS[0]
    for coefficient in _COEFFICIENTS[1:]:
        power += coefficient
        power *= small
    power += 1.0
    for _ in range(_SQUARINGS):
        power *= power
    return power


def tanh(x: Floats32) -> Floats32:
    """Return the hyperbolic tangent, rounded to float32."""
    wide = x.astype(np.float64)
    power = exponential(-2.0 * np.abs(wide))
    return np.copysign((1.0 - power) / (1.0 + power), wide).astype(np.float32)


def elu(x: Floats32) -> Floats32:
    """Return the exponential linear unit with alpha 1, rounded to float32."""
    below = exponential(np.minimum(x, 0.0).astype(np.float64)) - 1.0
    return np.where(x > 0.0, x, below.astype(np.float32))


def sigmoid(x: Floats32) -> Floats32:
    """Return the logistic function, rounded to float32."""
    half = np.float32(0.5)
    return half * tanh(half * x) + half


def softmax(x: Floats32) -> Floats32:
    """Return shares of sum 1 along the last axis, proportional to exp(x)."""
    power = exponential((x - x.max(axis=-1, keepdims=True)).astype(np.float64))
    total = sum(power[..., i] for i in range(power.shape[-1]))
    shares: Floats32 = (power / np.asarray(total)[..., None]).astype(np.float32)
    return shares


def _product(weight: Floats32, numbers: Floats32) -> Floats32:
    """Return numbers @ weight, summed over the inputs in their order."""
    if numbers.ndim == 1:
        product: Floats32 = np.add.reduce(weight * numbers[:, None], axis=0)
        return product
    products: Floats32 = numbers[:, :1] * weight[0]
    part = np.empty_like(products)
    for i in range(1, len(weight)):
        products += np.multiply(numbers[:, i : i + 1], weight[i], out=part)
    return products


def _activated(activation: Activation, numbers: Floats32) -> Floats32:
    if activation == "elu":
        return elu(numbers)
    if activation == "tanh":
        return tanh(numbers)
    return np.maximum(numbers, np.float32(0.0)) if activation == "relu" else numbers


def _check(index: int, layer: Layer) -> None:
    """Raise ValueError if a layer has arrays of other shapes, or numbers that are not finite."""
    weight, bias = layer.weight, layer.bias
    if weight.ndim != 2 or bias.shape != weight.shape[1:] or 0 in weight.shape:
        raise ValueError(f"layer {index} has a weight {weight.shape} and a bias {bias.shape}")
    if isinstance(layer, Lstm) and (bias.size % 4 or layer.sizes[0] < 1):
        raise ValueError(f"layer {index} is no LSTM: its weight is {weight.shape}")
    if not (np.isfinite(weight).all() and np.isfinite(bias).all()):
        raise ValueError(f"layer {index} has weights that are NaN or infinite")
