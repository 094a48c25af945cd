"""Training examples from packed demonstrations, split into training and held-out episodes.

Batches are augmented: half is mirrored, brightness and tint vary, pictures are shifted. Rows in
which the expert stops or starts are oversampled.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cosim.core.errors import RunError
from cosim.core.packed_demos import Packed, read_packed
from cosim.learning.network import (
    CRUISE_MPS,
    GOAL_MOST_M,
    GOAL_UNIT_M,
    HEIGHT_PX,
    HISTORY,
    PICTURE_INTERVAL,
    SPEED_MEAN_MPS,
    SPEED_UNIT_MPS,
    TURN_UNIT_RADPS,
    WAYPOINTS,
    WIDTH_PX,
)
from cosim.learning.packed_checks import check_pictures, check_rows, common_meta

HELD_OUT: Final = 0.1
"""Share of episodes that are held out."""
STOPS_MPS: Final = 0.3
"""Speed below which a robot is at rest, and a command a stop of the network `small`."""
DARK: Final = 0.6
BRIGHT: Final = 1.5
"""Least and largest factor of the brightness of augmented pictures."""
TINT: Final = 0.12
"""Largest logarithm of the factor of one colour."""
SHIFT_PX: Final = 3
"""Largest shift of augmented pictures."""
_HIDDEN_SPEEDS: Final = 0.8
"""Share of rows whose speeds are hidden.

A network that sees its own low speed takes it as the reason to stop. It would then fail to stop
when it approaches a person fast.
"""
_FROZEN: Final = 0.5
"""Share of rows whose older pictures equal the newest, as at the start of an episode."""
CHANGE_SHARE: Final = 0.3
"""Share of a batch in which the expert stops a moving robot or starts a resting one.

Only one row in fifty is such a change; trained on the others alone, a network keeps its speed.
"""
_ROUNDING: Final = 1e-4
_SAME_META: Final = ("camera", "rate_hz", "waypoint_s", "goal", "robot")


@dataclass(frozen=True)
class Batch:
    """Batch of network inputs and targets.

    pictures, goal, speeds: inputs, see `network.answers`
    speed: (B,) in units of CRUISE_MPS
    turn: (B,) rad/s
    stop: (B,) 0 or 1
    way: (B, WAYPOINTS, 2) m
    driven: (B, WAYPOINTS) 1 for waypoints that were driven, else 0
    """

    pictures: Tensor
    goal: Tensor
    speeds: Tensor
    speed: Tensor
    turn: Tensor
    stop: Tensor
    way: Tensor
    driven: Tensor


class Examples:
    """All demonstrations, on the device.

    learned, held_out: rows (M,) of training and held-out episodes
    meta: common metadata of the files, with policy and learner of all of them
    """

    def __init__(self, paths: Sequence[Path], seed: int, device: torch.device) -> None:
        packed = [_checked(path) for path in paths]
        self.meta = common_meta(paths, packed, _SAME_META)
        first_rows = np.cumsum([0, *(len(one) for one in packed)])
        first_episodes = np.cumsum([0, *(int(one.episode[-1]) + 1 for one in packed)])
        history = np.concatenate(
            [
                one.history(HISTORY, PICTURE_INTERVAL) + n
                for one, n in zip(packed, first_rows, strict=False)
            ]
        )
        episode = np.concatenate(
            [one.episode + n for one, n in zip(packed, first_episodes, strict=False)]
        )
        held_out = np.random.default_rng([seed, 0x4E1D]).random(int(episode[-1]) + 1) < HELD_OUT
        if held_out.all() or not held_out.any():
            held_out[:] = False
            held_out[-1] = True
        rows = np.arange(len(episode))
        self.learned = rows[~held_out[episode]]
        self.held_out = rows[held_out[episode]]
        self.episodes = len(held_out) - int(held_out.sum()), int(held_out.sum())

        def joined(arrays: Sequence[NDArray[Any]]) -> Tensor:
            parts = [torch.from_numpy(array) for array in arrays]
            whole = torch.empty(
                (len(rows), *parts[0].shape[1:]), dtype=parts[0].dtype, device=device
            )
            for place, part in zip(
                torch.split(whole, [len(part) for part in parts]), parts, strict=True
            ):
                place.copy_(part)
            return whole

        self._frames = joined([one.frames for one in packed])
        self._history = torch.from_numpy(history).to(device)
        self._state = joined([one.state for one in packed])
        self._goal = joined([one.goal for one in packed])
        self._command = joined([one.command for one in packed])
        self._way = joined([one.waypoints[:, :WAYPOINTS] for one in packed])
        self._driven = joined([one.driven for one in packed])
        changes = np.concatenate(
            [(one.command[:, 0] < STOPS_MPS) != (one.state[:, 0] < STOPS_MPS) for one in packed]
        )
        found = self.learned[changes[self.learned]]
        self._changes = found if len(found) else self.learned
        self._device = device

    def drawn(self, seed: int, step: int, size: int) -> Batch:
        """Draw the augmented batch of a step: a function of seed and step."""
        draws = np.random.default_rng([seed, 0xBA7C4, step])
        change = draws.random(size) < CHANGE_SHARE
        batch = self.rows(
            np.where(change, draws.choice(self._changes, size), draws.choice(self.learned, size))
        )
        mirrored = torch.from_numpy(draws.random(size) < 0.5).to(self._device)
        light = draws.uniform(np.log(DARK), np.log(BRIGHT), (size, 1)) + draws.uniform(
            -TINT, TINT, (size, 3)
        )
        gain = np.tile(np.exp(light), (1, HISTORY)).astype(np.float32)[:, :, None, None]
        visible = torch.from_numpy((draws.random(size) >= _HIDDEN_SPEEDS).astype(np.float32)).to(
            self._device
        )
        off_px = torch.from_numpy(draws.integers(0, 2 * SHIFT_PX + 1, (2, size, 1, 1))).to(
            self._device
        )
        newest = (
            batch.pictures.unflatten(1, (HISTORY, -1))[:, -1:]
            .expand(-1, HISTORY, -1, -1, -1)
            .flatten(1, 2)
        )
        frozen = torch.from_numpy(draws.random(size) < _FROZEN).to(self._device)
        pictures = torch.where(frozen[:, None, None, None], newest, batch.pictures)
        lit = (shifted(pictures, off_px) * torch.from_numpy(gain).to(self._device)).clamp(max=1.0)
        augmented = Batch(
            lit,
            batch.goal,
            batch.speeds * visible[:, None],
            batch.speed,
            batch.turn,
            batch.stop,
            batch.way,
            batch.driven,
        )
        return _select(mirrored, mirror(augmented), augmented)

    def first_inputs(self) -> dict[str, NDArray[np.float32]]:
        """Return the inputs of the graph at the first held-out row."""
        batch = self.rows(self.held_out[:1])
        return {
            name: getattr(batch, name).cpu().numpy().astype(np.float32)
            for name in ("pictures", "goal", "speeds")
        }

    def rows(self, rows: NDArray[np.int64]) -> Batch:
        """Return the examples at some rows, without augmentation."""
        at = torch.from_numpy(rows).to(self._device)
        frames = self._frames[self._history[at]]  # (B, HISTORY, H, W, 3)
        pictures = frames.permute(0, 1, 4, 2, 3).flatten(1, 2).float() / 255.0
        command = self._command[at]
        return Batch(
            pictures=pictures,
            goal=scaled_goal(self._goal[at]),
            speeds=scaled_speeds(self._state[at]),
            speed=command[:, 0] / CRUISE_MPS,
            turn=command[:, 1],
            stop=(command[:, 0] < STOPS_MPS).float(),
            way=self._way[at],
            driven=(
                torch.arange(WAYPOINTS, device=self._device) < self._driven[at][:, None]
            ).float(),
        )


def scaled_goal(goal: Tensor) -> Tensor:
    """Return goals (..., 2) in m as the network's input."""
    far = goal.norm(dim=-1, keepdim=True)
    return goal * (GOAL_MOST_M / far.clamp(min=GOAL_MOST_M)) / GOAL_UNIT_M


def scaled_speeds(state: Tensor) -> Tensor:
    """Return speeds (..., 2) in m/s and rad/s as the network's input."""
    mean = torch.tensor([SPEED_MEAN_MPS, 0.0], device=state.device)
    unit = torch.tensor([SPEED_UNIT_MPS, TURN_UNIT_RADPS], device=state.device)
    return (state - mean) / unit


def mirror(batch: Batch) -> Batch:
    """Mirror a batch: left and right exchanged."""
    other_side = torch.tensor([1.0, -1.0], device=batch.goal.device)
    return Batch(
        pictures=batch.pictures.flip(3),
        goal=batch.goal * other_side,
        speeds=batch.speeds * other_side,
        speed=batch.speed,
        turn=-batch.turn,
        stop=batch.stop,
        way=batch.way * other_side,
        driven=batch.driven,
    )


def shifted(pictures: Tensor, off_px: Tensor) -> Tensor:
    """Shift pictures (B, C, H, W), repeating their edge.

    off_px: (2, B, 1, 1) down and right, from 0 to 2 SHIFT_PX; SHIFT_PX is no shift
    """
    count, _, high, wide = pictures.shape
    one = torch.arange(count, device=pictures.device).view(-1, 1, 1)
    row = (torch.arange(high, device=pictures.device).view(1, -1, 1) + off_px[0] - SHIFT_PX).clamp(
        0, high - 1
    )
    column = (
        torch.arange(wide, device=pictures.device).view(1, 1, -1) + off_px[1] - SHIFT_PX
    ).clamp(0, wide - 1)
    return pictures.permute(0, 2, 3, 1)[one, row, column].permute(0, 3, 1, 2)


def _select(first: Tensor, one: Batch, other: Batch) -> Batch:
    """Select rows from `one` where `first` (B,) is true, else from `other`."""
    mixed = {
        name: torch.where(
            first.view(-1, *[1] * (getattr(one, name).ndim - 1)), getattr(one, name), value
        )
        for name, value in vars(other).items()
    }
    return Batch(**mixed)


def _checked(path: Path) -> Packed:
    """Load a file. Raises RunError if this network cannot learn from it."""
    packed = read_packed(path)
    check_rows(path, packed)
    check_pictures(path, packed.frames, (WIDTH_PX, HEIGHT_PX))
    if (fastest := float(np.abs(packed.command[:, 1]).max())) > TURN_UNIT_RADPS + _ROUNDING:
        raise RunError(
            f"{path}: the expert turns at {fastest:.2f} rad/s, and this network at "
            f"{TURN_UNIT_RADPS:g} at most: cosim collect with the courier"
        )
    return packed
