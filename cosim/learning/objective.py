"""Loss of a plan against the expert's commands, and its errors on held-out episodes."""

from __future__ import annotations

import math
from typing import Final, Protocol

import torch
from torch import Tensor
from torch.nn import functional

from cosim.learning.network import CRUISE_MPS, TURN_BINS, NetworkOutput, plan, turns_radps

PLAN_WEIGHTS: Final = {"speed": 4.0, "turn": 1.0, "stop": 1.0, "way": 0.5}
"""Weights of the parts of the loss."""
_TURN_SPREAD_RADPS: Final = 0.04


class PlanTargets(Protocol):
    """Targets of N rows.

    speed: (N,) in units of CRUISE_MPS
    turn: (N,) rad/s
    stop: (N,) 0 or 1
    way: (N, WAYPOINTS, 2) m
    driven: (N, WAYPOINTS) 1 for waypoints that were driven, else 0
    """

    @property
    def speed(self) -> Tensor: ...
    @property
    def turn(self) -> Tensor: ...
    @property
    def stop(self) -> Tensor: ...
    @property
    def way(self) -> Tensor: ...
    @property
    def driven(self) -> Tensor: ...


def plan_losses(
    output: NetworkOutput, targets: PlanTargets, weight: Tensor | None = None
) -> dict[str, Tensor]:
    """Return the parts of the loss.

    Speed and turn count only if the expert does not stop; waypoints only if they were driven.

    weight: (N,) of the rows; None for equal ones
    """
    weight = torch.ones_like(targets.speed) if weight is None else weight
    moves = weight * (1.0 - targets.stop)
    driven = weight[:, None] * targets.driven
    per_moving = 1.0 / moves.sum().clamp(min=1.0)
    turn_errors = turns_radps(targets.turn.device) - targets.turn[:, None]
    # The bin of the expert's turn, and its neighbours with less weight.
    shares = (-0.5 * (turn_errors / _TURN_SPREAD_RADPS) ** 2).softmax(1)
    turn = -(shares * output.turn.log_softmax(1)).sum(1)
    speed = functional.smooth_l1_loss(output.speed, targets.speed, reduction="none", beta=0.1)
    stop = functional.binary_cross_entropy_with_logits(output.stop, targets.stop, reduction="none")
    way = functional.smooth_l1_loss(output.way, targets.way, reduction="none", beta=0.2).sum(2)
    return {
        "speed": (speed * moves).sum() * per_moving,
        "turn": (turn * moves).sum() * per_moving / math.log(TURN_BINS),
        "stop": (stop * weight).sum() / weight.sum().clamp(min=1.0),
        "way": (way * driven).sum() / driven.sum().clamp(min=1.0),
    }


class PlanErrors:
    """Sums of errors over parts of the held-out rows."""

    def __init__(self) -> None:
        self._sums: dict[str, float] = {}
        self._rows = 0

    def add(self, output: NetworkOutput, targets: PlanTargets, loss: float) -> None:
        """Add the rows of a part. loss: their mean loss."""
        stops = output.stop > 0.0
        both = (targets.stop == 0.0) & ~stops
        speeds = plan(output)[:, 0, 2:] - torch.stack([CRUISE_MPS * targets.speed, targets.turn], 1)
        off_m = (output.way[:, -1] - targets.way[:, -1]).norm(dim=1)
        rows = len(targets.speed)
        self._rows += rows
        for name, value in (
            ("loss", loss * rows),
            ("moving", both.sum()),
            ("speed", speeds[both, 0].abs().sum()),
            ("turn", speeds[both, 1].abs().sum()),
            ("stops", targets.stop.sum()),
            ("stops_found", (stops & (targets.stop > 0.0)).sum()),
            ("stops_predicted", stops.sum()),
            ("ends", targets.driven[:, -1].sum()),
            ("way", (off_m * targets.driven[:, -1]).sum()),
        ):
            self._sums[name] = self._sums.get(name, 0.0) + float(value)

    def means(self) -> dict[str, float]:
        """Return the mean loss and errors.

        These are mean errors of speed and turn if both move, the mean error of the last waypoint,
        and recall and precision of stops. A mean over no rows is NaN.
        """
        sums = self._sums
        return {
            "held_out_loss": mean(sums["loss"], self._rows),
            "speed_error_mps": mean(sums["speed"], sums["moving"]),
            "turn_error_radps": mean(sums["turn"], sums["moving"]),
            "way_error_m": mean(sums["way"], sums["ends"]),
            "stops_found": mean(sums["stops_found"], sums["stops"]),
            "stops_right": mean(sums["stops_found"], sums["stops_predicted"]),
        }


def mean(total: float, count: float) -> float:
    """Return the mean, NaN of nothing."""
    return total / count if count else math.nan
