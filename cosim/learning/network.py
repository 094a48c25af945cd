"""The network: what the camera saw of late, the goal and the robot's speeds -> a plan; parameters
are a dictionary.

It has no normalisation layers, so that the graph that is shipped holds the same parameters as the
one that is trained: any bundle can be trained on. Residual blocks begin as the identity instead.

Its plan is (B, WAYPOINTS, 4): x ahead and y to the left in metres, speed in m/s, turn in rad/s, the
same in every row. To stop is a decision of its own, and no small speed: where it is more likely
than not all four are 0.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

Parameters = Mapping[str, Tensor]

HISTORY: Final = 4
EVERY: Final = 1
"""So many pictures are seen, so many answers apart, the newest last."""
WIDTH_PX: Final = 160
HEIGHT_PX: Final = 90
WAYPOINTS: Final = 8
GOAL_UNIT_M: Final = 10.0
GOAL_MOST_M: Final = 20.0
SPEED_MEAN_MPS: Final = 1.0
SPEED_UNIT_MPS: Final = 0.5
TURN_UNIT_RADPS: Final = 0.65
CRUISE_MPS: Final = 1.5
"""The unit of the speeds that it answers."""
TURN_BINS: Final = 27
"""Ways to turn, evenly from all to the left to all to the right: past either side of a thing, not
the mean of both."""
SHARPNESS: Final = 2.0
"""Of the odds of the bins before their mean is taken."""

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
"""Of the weights; of four axes: a convolution (out, in, high, wide), of two: a linear layer (out,
in). Multiples of 16 channels are what processors compute fastest."""
STRIDES: Final[Mapping[str, int]] = {"stem": 2, "down1": 2, "down2": 2, "down3": 2}
"""Of the convolutions; 1 where it is not said."""


class Answers(NamedTuple):
    """What the network says before it is made a plan. speed: (B,), in units of CRUISE_MPS, of a
    robot that does not stop; turn: (B, TURN_BINS) log odds; stop: (B,) log odds; way: (B,
    WAYPOINTS, 2) m."""

    speed: Tensor
    turn: Tensor
    stop: Tensor
    way: Tensor


def new_parameters(seed: int) -> dict[str, Tensor]:
    """Drawn from a seed: "stem.weight", "stem.bias" and so on, float32."""
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
    """(TURN_BINS,): the turn that each bin stands for, from the left to the right."""
    return torch.linspace(TURN_UNIT_RADPS, -TURN_UNIT_RADPS, TURN_BINS, device=device)


def answers(parameters: Parameters, pictures: Tensor, goal: Tensor, speeds: Tensor) -> Answers:
    """pictures: (B, 3 HISTORY, HEIGHT_PX, WIDTH_PX), 0 to 1, oldest first. goal: (B, 2), x and y in
    GOAL_UNIT_M. speeds: (B, 2), v less its mean and w, in their units."""

    def convolved(x: Tensor, name: str) -> Tensor:
        weight, bias = parameters[f"{name}.weight"], parameters[f"{name}.bias"]
        return functional.conv2d(x, weight, bias, STRIDES.get(name, 1), weight.shape[-1] // 2)

    def linear(x: Tensor, name: str) -> Tensor:
        return functional.linear(x, parameters[f"{name}.weight"], parameters[f"{name}.bias"])

    x = (pictures - 0.5) * 4.0
    for name in ("stem", "down1", "down2"):
        x = convolved(x, name).relu()
    x = x + convolved(convolved(x, "block2a").relu(), "block2b")
    x = convolved(x.relu(), "down3").relu()
    x = x + convolved(convolved(x, "block3a").relu(), "block3b")
    x = convolved(x.relu(), "narrow").relu()
    seen = linear(x.flatten(1), "seen").relu()
    told = linear(torch.cat([goal, speeds], 1), "told").relu()
    joined = linear(torch.cat([seen, told], 1), "joined").relu()
    return Answers(
        linear(joined, "speed").squeeze(1),
        linear(joined, "turn"),
        linear(joined, "stop").squeeze(1),
        linear(joined, "way").unflatten(1, (WAYPOINTS, 2)),
    )


def plan(said: Answers) -> Tensor:
    """(B, WAYPOINTS, 4): see above."""
    turn = (SHARPNESS * said.turn).softmax(1) @ turns_radps(said.turn.device)
    speeds = torch.stack([CRUISE_MPS * said.speed.relu(), turn], 1)
    rows = torch.cat([said.way, speeds[:, None].expand(-1, WAYPOINTS, -1)], 2)
    return rows * (said.stop <= 0.0).float()[:, None, None]
