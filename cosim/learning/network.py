"""Network from recent pictures, goal and speeds to a plan; parameters are a dictionary.

It has no normalisation layers, so the exported graph holds the trained parameters and any bundle
can be trained further. Residual blocks start close to the identity instead.

The plan is (B, WAYPOINTS, 4): x ahead and y left in metres, speed in m/s, turn in rad/s. Speed and
turn are the same in every row. Stopping is a separate decision: if its probability is above one
half, all four are 0.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import Final, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

Parameters = Mapping[str, Tensor]

HISTORY: Final = 4
"""Number of pictures in the input, the newest last."""
PICTURE_INTERVAL: Final = 1
"""Policy steps between two pictures of the input."""
WIDTH_PX: Final = 160
HEIGHT_PX: Final = 90
WAYPOINTS: Final = 8
GOAL_UNIT_M: Final = 10.0
GOAL_MOST_M: Final = 20.0
SPEED_MEAN_MPS: Final = 1.0
SPEED_UNIT_MPS: Final = 0.5
TURN_UNIT_RADPS: Final = 0.65
CRUISE_MPS: Final = 1.5
"""Unit of the network's speed output."""
TURN_BINS: Final = 27
"""Number of turn rates, full left to full right; bins avoid averaging both ways around a thing."""
SHARPNESS: Final = 2.0
"""Factor on the log odds of the bins before their mean is computed."""

_MIDDLE: Final = 256
_SHAPES: Final[Mapping[str, tuple[int, ...]]] = {
    "stem": (16, 3 * HISTORY, 5, 5),
    "down1": (48, 16, 3, 3),
    "down2": (64, 48, 3, 3),
    "block2a": (64, 64, 3, 3),
    "block2b": (64, 64, 3, 3),
    "down3": (96, 64, 3, 3),
    "block3a": (96, 96, 3, 3),
    "block3b": (96, 96, 3, 3),
    "narrow": (40, 96, 1, 1),
    "told": (32, 4),
    "seen": (_MIDDLE, 40 * 6 * 10),
    "joined": (_MIDDLE, _MIDDLE + 32),
    "speed": (1, _MIDDLE),
    "turn": (TURN_BINS, _MIDDLE),
    "stop": (1, _MIDDLE),
    "way": (2 * WAYPOINTS, _MIDDLE),
}
"""Shapes of the weights: convolutions (out, in, height, width), linear layers (out, in).

Multiples of 16 channels are the fastest on CPUs.
"""
STRIDES: Final[Mapping[str, int]] = {"stem": 2, "down1": 2, "down2": 2, "down3": 2}
"""Strides of the convolutions; 1 if missing."""


class NetworkOutput(NamedTuple):
    """Raw outputs of the network.

    speed: (B,) in units of CRUISE_MPS, of a robot that does not stop
    turn: (B, TURN_BINS) log odds
    stop: (B,) log odds
    way: (B, WAYPOINTS, 2) m
    """

    speed: Tensor
    turn: Tensor
    stop: Tensor
    way: Tensor


def new_parameters(seed: int) -> dict[str, Tensor]:
    """Draw float32 parameters from a seed, named "stem.weight", "stem.bias" and so on."""
    draws = torch.Generator().manual_seed(seed)
    parameters: dict[str, Tensor] = {}
    for name, shape in _SHAPES.items():
        quiet = name.endswith("b") or name in ("speed", "turn", "stop", "way")
        scale = 0.02 if quiet else math.sqrt(2.0 / math.prod(shape[1:]))
        parameters[f"{name}.weight"] = scale * torch.randn(shape, generator=draws)
        parameters[f"{name}.bias"] = torch.zeros(shape[0])
    parameters["speed.bias"] += 0.8
    return parameters


def turns_radps(device: str | torch.device = "cpu") -> Tensor:
    """Return (TURN_BINS,) the turn rates of the bins, from left to right."""
    return torch.linspace(TURN_UNIT_RADPS, -TURN_UNIT_RADPS, TURN_BINS, device=device)


def convolution(parameters: Parameters, strides: Mapping[str, int], x: Tensor, name: str) -> Tensor:
    """Apply a layer's convolution to x (B, C, H, W), with zeros beyond the border.

    strides: of layers by name, 1 for others
    """
    weight, bias = parameters[f"{name}.weight"], parameters[f"{name}.bias"]
    return functional.conv2d(x, weight, bias, strides.get(name, 1), weight.shape[-1] // 2)


def linear_layer(parameters: Parameters, x: Tensor, name: str) -> Tensor:
    """Apply a linear layer to x (..., K)."""
    return functional.linear(x, parameters[f"{name}.weight"], parameters[f"{name}.bias"])


def forward(
    parameters: Parameters, pictures: Tensor, goal: Tensor, speeds: Tensor
) -> NetworkOutput:
    """Compute the raw outputs of the network.

    pictures: (B, 3 HISTORY, HEIGHT_PX, WIDTH_PX), 0 to 1, oldest first
    goal: (B, 2), x and y in GOAL_UNIT_M
    speeds: (B, 2), v minus its mean in SPEED_UNIT_MPS, w in TURN_UNIT_RADPS
    """
    convolved = partial(convolution, parameters, STRIDES)
    linear = partial(linear_layer, parameters)
    x = (pictures - 0.5) * 4.0
    for name in ("stem", "down1", "down2"):
        x = convolved(x, name).relu()
    x = x + convolved(convolved(x, "block2a").relu(), "block2b")
    x = convolved(x.relu(), "down3").relu()
    x = x + convolved(convolved(x, "block3a").relu(), "block3b")
    x = convolved(x.relu(), "narrow").relu()
    image = linear(x.flatten(1), "seen").relu()
    inputs = linear(torch.cat([goal, speeds], 1), "told").relu()
    joined = linear(torch.cat([image, inputs], 1), "joined").relu()
    return NetworkOutput(
        linear(joined, "speed").squeeze(1),
        linear(joined, "turn"),
        linear(joined, "stop").squeeze(1),
        linear(joined, "way").unflatten(1, (WAYPOINTS, 2)),
    )


def plan(output: NetworkOutput) -> Tensor:
    """Convert raw outputs to a plan (B, WAYPOINTS, 4), see the module."""
    turn = (SHARPNESS * output.turn).softmax(1) @ turns_radps(output.turn.device)
    speeds = torch.stack([CRUISE_MPS * output.speed.relu(), turn], 1)
    rows = torch.cat([output.way, speeds[:, None].expand(-1, WAYPOINTS, -1)], 2)
    return rows * (output.stop <= 0.0).float()[:, None, None]
