"""Network with a memory: the last two pictures, goal, speeds and its memory to a plan.

A convolutional encoder sees each picture with the one before it. A gated recurrent unit (Cho et
al., 2014) carries what was seen. Like `network`, it has no normalisation layers, so the exported
graph holds the trained parameters, and residual blocks start close to the identity.

Auxiliary heads predict the labels of `cosim collect --labels`. They shape the features in training,
and are outputs of the graph.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Final, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from cosim.core.packed_demos import FREE_RAYS
from cosim.learning.network import (
    TURN_BINS,
    WAYPOINTS,
    NetworkOutput,
    Parameters,
    convolution,
    linear_layer,
)

SIZE_PX: Final = (320, 180)
"""Width and height of a picture."""
PICTURES: Final = 2
"""Number of pictures in the input, the newest last."""
MEMORY: Final = 256
"""Numbers in the memory."""
NEAR: Final = 4
"""Number of the nearest people that are predicted."""
NEAR_VALUES: Final = 6
"""Values of a person: log odds of presence and of a hand held out; x, y, vx, vy in their units."""
SIGNALS: Final = 3
"""Classes of signals: none, walk, wait."""
EVENTS: Final = 9
"""Classes of events: none, and the eight kinds."""
DOINGS: Final = 12
"""Classes of activities of people, see `scenarios/episodes/labels.py`."""

HALVED: Final = 2
"""Pixels of a picture in a pixel of the whole view, along each side."""
DETAIL: Final = (slice(8, 72), slice(80, 240))
"""Rows and columns of the part that is seen at full size: ahead and above the horizon.

There are the hands of people at 2 m and more, and lamps.
"""

_IMAGE: Final = 320
_INPUTS: Final = 64
_JOINED: Final = 320
_SHAPES: Final[Mapping[str, tuple[int, ...]]] = {
    "stem": (24, 3 * PICTURES, 5, 5),
    "down1": (48, 24, 3, 3),
    "block2a": (48, 48, 3, 3),
    "block2b": (48, 48, 3, 3),
    "down2": (96, 48, 3, 3),
    "block3a": (96, 96, 3, 3),
    "block3b": (96, 96, 3, 3),
    "block4a": (96, 96, 3, 3),
    "block4b": (96, 96, 3, 3),
    "down3": (160, 96, 3, 3),
    "block5a": (160, 160, 3, 3),
    "block5b": (160, 160, 3, 3),
    "narrow": (64, 160, 1, 1),
    "seen": (_IMAGE, 64 * 6 * 10),
    "upper": (_IMAGE, 64 * 4 * 10),
    "inputs": (_INPUTS, 4),
    "joined": (_JOINED, _IMAGE + _INPUTS),
    "arriving": (3 * MEMORY, _JOINED),
    "recurrent": (3 * MEMORY, MEMORY),
    "known": (_JOINED, _JOINED + MEMORY),
    "speed": (1, _JOINED),
    "turn": (TURN_BINS, _JOINED),
    "stop": (1, _JOINED),
    "way": (2 * WAYPOINTS, _JOINED),
    "near": (NEAR * NEAR_VALUES, _JOINED),
    "free": (FREE_RAYS, _JOINED),
    "signal": (SIGNALS, _JOINED),
    "event": (EVENTS, _JOINED),
    "doing": (NEAR * DOINGS, _JOINED),
}
"""Shapes of the weights: convolutions (out, in, height, width), linear layers (out, in)."""
HEADS: Final = ("speed", "turn", "stop", "way", "near", "free", "signal", "event", "doing")
GROWN: Final = ("upper", "doing")
"""Layers that earlier bundles lack; they start at 0 there.

In version 3, a layer `detail` of the shape of `upper` saw another part of the picture. It is not
continued.
"""
AUXILIARY: Final = ("near", "free", "signal", "event", "doing")
"""Heads of the labels, which are outputs of the graph."""
STRIDES: Final[Mapping[str, int]] = {"stem": 2, "down1": 2, "down2": 2, "down3": 2}
"""Strides of the convolutions; 1 if missing."""
STAGES: Final[tuple[tuple[str, ...], ...]] = (
    ("stem", "down1"),
    ("block2a", "block2b"),
    ("down2",),
    ("block3a", "block3b"),
    ("block4a", "block4b"),
    ("down3",),
    ("block5a", "block5b"),
    ("narrow",),
)
"""Convolutions in order; a pair that ends in a and b is a residual block."""


def is_block(stage: tuple[str, ...]) -> bool:
    """Return whether a stage is a residual block."""
    return stage[0].startswith("block")


class Views(NamedTuple):
    """What the network sees of pictures: (..., C, H, W) or (..., H, W, C), each with its own H, W.

    whole: the picture at 1 / HALVED of its size
    detail: the part DETAIL at full size
    """

    whole: Tensor
    detail: Tensor

    def each(self, change: Callable[[Tensor], Tensor]) -> Views:
        """Return both views changed alike."""
        return Views(change(self.whole), change(self.detail))


class MemoryOutput(NamedTuple):
    """Raw outputs at N = B T steps, see `network.NetworkOutput` for the plan.

    near: (N, NEAR, NEAR_VALUES)
    free: (N, FREE_RAYS) in units of the labels' range
    signal: (N, SIGNALS) log odds
    event: (N, EVENTS) log odds
    doing: (N, NEAR, DOINGS) log odds of the activity of each person
    memory: (B, MEMORY) after the last step
    known: (N, _JOINED) features that all heads get
    """

    plan: NetworkOutput
    near: Tensor
    free: Tensor
    signal: Tensor
    event: Tensor
    doing: Tensor
    memory: Tensor
    known: Tensor


def new_memory_parameters(seed: int) -> dict[str, Tensor]:
    """Draw float32 parameters from a seed, named "stem.weight", "stem.bias" and so on."""
    draws = torch.Generator().manual_seed(seed)
    parameters: dict[str, Tensor] = {}
    for name, shape in _SHAPES.items():
        quiet = name.endswith("b") or name in HEADS
        gates = name in ("arriving", "recurrent")
        fan = math.prod(shape[1:])
        scale = 0.02 if quiet else math.sqrt((1.0 if gates else 2.0) / fan)
        parameters[f"{name}.weight"] = scale * torch.randn(shape, generator=draws)
        parameters[f"{name}.bias"] = torch.zeros(shape[0])
    parameters["speed.bias"] += 0.8
    parameters["recurrent.bias"][MEMORY : 2 * MEMORY] += 1.0  # at first the memory mostly stays
    return parameters


def views(pictures: Tensor) -> Views:
    """Return both views of pictures (N, C, 180, 320)."""
    return Views(functional.avg_pool2d(pictures, HALVED), pictures[..., *DETAIL])


def picture_of(seen: Views) -> Tensor:
    """Return pictures (N, C, 180, 320) with these views.

    Outside the detail, each pixel of the whole is repeated.
    """
    pictures = seen.whole.repeat_interleave(HALVED, 2).repeat_interleave(HALVED, 3)
    pictures[..., *DETAIL] = seen.detail
    return pictures


def encoded(parameters: Parameters, seen: Views) -> Tensor:
    """Return (N, _IMAGE) features of views (N, 3 PICTURES, H, W), 0 to 1."""
    whole = linear_layer(parameters, _convolved(parameters, seen.whole), "seen")
    detail = linear_layer(parameters, _convolved(parameters, seen.detail), "upper")
    return (whole + detail).relu()


def _convolved(parameters: Parameters, pictures: Tensor) -> Tensor:
    convolved = partial(convolution, parameters, STRIDES)
    x = (pictures - 0.5) * 4.0
    for stage in STAGES:
        if is_block(stage):
            x = (x + convolved(convolved(x, stage[0]).relu(), stage[1])).relu()
        else:
            for name in stage:
                x = convolved(x, name).relu()
    return x.flatten(1)


def remembered(parameters: Parameters, joined: Tensor, memory: Tensor, carries: bool) -> Tensor:
    """Return (B, T, MEMORY) the memory after each step. carries: False clears it at each step."""
    arriving = linear_layer(parameters, joined, "arriving")
    found = []
    for step in arriving.unbind(1):
        recurrent = linear_layer(parameters, memory, "recurrent")
        reset, update = (step[:, : 2 * MEMORY] + recurrent[:, : 2 * MEMORY]).sigmoid().chunk(2, 1)
        new = (step[:, 2 * MEMORY :] + reset * recurrent[:, 2 * MEMORY :]).tanh()
        after = update * memory + (1.0 - update) * new
        found.append(after)
        memory = after if carries else memory
    return torch.stack(found, 1)


def forward_steps(
    parameters: Parameters,
    seen: Views,
    goal: Tensor,
    speeds: Tensor,
    memory: Tensor,
    carries: bool = True,
) -> MemoryOutput:
    """Compute the raw outputs of T steps.

    seen: views (B, T, 3 PICTURES, H, W) of the pictures, 0 to 1, oldest first
    goal, speeds: (B, T, 2), see `network.forward`
    memory: (B, MEMORY) before the first step, 0 at the start of an episode
    carries: whether the memory is carried from step to step
    """
    batch, steps = goal.shape[:2]
    image = encoded(parameters, seen.each(lambda one: one.flatten(0, 1)))
    inputs = linear_layer(parameters, torch.cat([goal, speeds], 2).flatten(0, 1), "inputs").relu()
    joined = linear_layer(parameters, torch.cat([image, inputs], 1), "joined").relu()
    after = remembered(parameters, joined.unflatten(0, (batch, steps)), memory, carries)
    both = torch.cat([joined, after.flatten(0, 1)], 1)
    known = linear_layer(parameters, both, "known").relu()
    raw = {name: linear_layer(parameters, known, name).float() for name in HEADS}
    return MemoryOutput(
        NetworkOutput(
            raw["speed"].squeeze(1),
            raw["turn"],
            raw["stop"].squeeze(1),
            raw["way"].unflatten(1, (WAYPOINTS, 2)),
        ),
        raw["near"].unflatten(1, (NEAR, NEAR_VALUES)),
        raw["free"],
        raw["signal"],
        raw["event"],
        raw["doing"].unflatten(1, (NEAR, DOINGS)),
        after[:, -1] if carries else torch.zeros_like(memory),
        known,
    )
