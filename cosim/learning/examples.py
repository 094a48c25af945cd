"""Demonstrations as examples: put together from packed files, divided into those to learn from and
those held out, and drawn in batches, of which a half is mirrored, and each is lit otherwise and
shaken a little; the moments in which the expert stops or drives off are drawn more often than they
come."""

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
    EVERY,
    GOAL_MOST_M,
    GOAL_UNIT_M,
    HEIGHT_PX,
    HISTORY,
    SPEED_MEAN_MPS,
    SPEED_UNIT_MPS,
    TURN_UNIT_RADPS,
    WAYPOINTS,
    WIDTH_PX,
)

HELD_OUT: Final = 0.1
"""Of the episodes."""
STOPS_MPS: Final = 0.3
"""Who is told to drive slower than this is told to stop, and who drives slower stands."""
_DARK = 0.6
_BRIGHT = 1.5
_TINT: Final = 0.12
_SHAKEN_PX: Final = 3
_FORGOTTEN: Final = 0.8
_FROZEN: Final = 0.5
"""So often the robot's speeds are not told, and older pictures are the newest one, as when an
episode begins: who sees that it is slow takes that for the reason to stop, and does not where it
comes fast to somebody for whom it should."""
_CHANGES: Final = 0.3
"""Of a batch such a share is of rows in which the expert stops while the robot drives, or drives
off while it stands. They are one in fifty of what was driven, and who is asked for the others alone
goes on as it is going."""
_ROUNDING: Final = 1e-4
_LISTED: Final = ("policy", "learner")
_ALIKE: Final = ("camera", "rate_hz", "waypoint_s", "goal", "robot")


@dataclass(frozen=True)
class Batch:
    """What goes into the network, and what is wanted of it. pictures, goal, speeds: as
    `network.answers` takes them; speed: (B,) in units of CRUISE_MPS; turn: (B,) rad/s; stop: (B,) 0
    or 1; way: (B, WAYPOINTS, 2) m, driven: which of these were."""

    pictures: Tensor
    goal: Tensor
    speeds: Tensor
    speed: Tensor
    turn: Tensor
    stop: Tensor
    way: Tensor
    driven: Tensor


class Examples:
    """All demonstrations, on the device. learned, held_out: rows (M,) of the episodes that are
    learned from, and of those that are not; meta: of the files, where these agree; policy and
    learner of all of them."""

    def __init__(self, paths: Sequence[Path], seed: int, device: torch.device) -> None:
        packed = [_checked(path) for path in paths]
        self.meta: dict[str, Any] = dict(packed[0].meta)
        for path, other in zip(paths[1:], packed[1:], strict=True):
            for field in _ALIKE:
                if other.meta.get(field) != self.meta.get(field):
                    raise RunError(
                        f"{path}: {field} is {other.meta.get(field)}, and {self.meta.get(field)} "
                        f"in {paths[0]}: train on demonstrations that were collected alike"
                    )
        self.meta |= {
            name: [value for one in packed for value in one.meta.get(name, [])] for name in _LISTED
        }
        before = np.cumsum([0, *(len(one) for one in packed)])
        episodes = np.cumsum([0, *(int(one.episode[-1]) + 1 for one in packed)])
        history = np.concatenate(
            [one.history(HISTORY, EVERY) + n for one, n in zip(packed, before, strict=False)]
        )
        episode = np.concatenate(
            [one.episode + n for one, n in zip(packed, episodes, strict=False)]
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
        """The batch of a step: a function of seed and step alone."""
        draws = np.random.default_rng([seed, 0xBA7C4, step])
        change = draws.random(size) < _CHANGES
        batch = self.rows(
            np.where(change, draws.choice(self._changes, size), draws.choice(self.learned, size))
        )
        mirrored = torch.from_numpy(draws.random(size) < 0.5).to(self._device)
        light = draws.uniform(np.log(_DARK), np.log(_BRIGHT), (size, 1)) + draws.uniform(
            -_TINT, _TINT, (size, 3)
        )
        gain = np.tile(np.exp(light), (1, HISTORY)).astype(np.float32)[:, :, None, None]
        told = torch.from_numpy((draws.random(size) >= _FORGOTTEN).astype(np.float32)).to(
            self._device
        )
        off_px = torch.from_numpy(draws.integers(0, 2 * _SHAKEN_PX + 1, (2, size, 1, 1))).to(
            self._device
        )
        newest = (
            batch.pictures.unflatten(1, (HISTORY, -1))[:, -1:]
            .expand(-1, HISTORY, -1, -1, -1)
            .flatten(1, 2)
        )
        frozen = torch.from_numpy(draws.random(size) < _FROZEN).to(self._device)
        pictures = torch.where(frozen[:, None, None, None], newest, batch.pictures)
        lit = (_shaken(pictures, off_px) * torch.from_numpy(gain).to(self._device)).clamp(max=1.0)
        whole = Batch(
            lit,
            batch.goal,
            batch.speeds * told[:, None],
            batch.speed,
            batch.turn,
            batch.stop,
            batch.way,
            batch.driven,
        )
        return _either(mirrored, mirror(whole), whole)

    def rows(self, rows: NDArray[np.int64]) -> Batch:
        """The examples at some rows, as they are."""
        at = torch.from_numpy(rows).to(self._device)
        frames = self._frames[self._history[at]]  # (B, HISTORY, H, W, 3)
        pictures = frames.permute(0, 1, 4, 2, 3).flatten(1, 2).float() / 255.0
        state, command, goal = self._state[at], self._command[at], self._goal[at]
        mean = torch.tensor([SPEED_MEAN_MPS, 0.0], device=self._device)
        unit = torch.tensor([SPEED_UNIT_MPS, TURN_UNIT_RADPS], device=self._device)
        far = goal.norm(dim=1, keepdim=True)
        return Batch(
            pictures=pictures,
            goal=goal * (GOAL_MOST_M / far.clamp(min=GOAL_MOST_M)) / GOAL_UNIT_M,
            speeds=(state - mean) / unit,
            speed=command[:, 0] / CRUISE_MPS,
            turn=command[:, 1],
            stop=(command[:, 0] < STOPS_MPS).float(),
            way=self._way[at],
            driven=(
                torch.arange(WAYPOINTS, device=self._device) < self._driven[at][:, None]
            ).float(),
        )


def mirror(batch: Batch) -> Batch:
    """What the same street would ask for, left and right exchanged."""
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


def _shaken(pictures: Tensor, off_px: Tensor) -> Tensor:
    """Each picture a little aside; what comes in is what was at its edge. off_px: (2, B, 1, 1),
    down and to the right, from 0 to twice what is the most to either side."""
    count, _, high, wide = pictures.shape
    one = torch.arange(count, device=pictures.device).view(-1, 1, 1)
    row = (
        torch.arange(high, device=pictures.device).view(1, -1, 1) + off_px[0] - _SHAKEN_PX
    ).clamp(0, high - 1)
    column = (
        torch.arange(wide, device=pictures.device).view(1, 1, -1) + off_px[1] - _SHAKEN_PX
    ).clamp(0, wide - 1)
    return pictures.permute(0, 2, 3, 1)[one, row, column].permute(0, 3, 1, 2)


def _either(first: Tensor, one: Batch, other: Batch) -> Batch:
    """Of one batch where `first` (B,) is true, of the other elsewhere."""
    mixed = {
        name: torch.where(
            first.view(-1, *[1] * (getattr(one, name).ndim - 1)), getattr(one, name), value
        )
        for name, value in vars(other).items()
    }
    return Batch(**mixed)


def _checked(path: Path) -> Packed:
    """The demonstrations of a file. Raises RunError where this network cannot learn from them."""
    packed = read_packed(path)
    size = packed.frames.shape[1:3]
    ahead = packed.waypoints.shape[1]
    if not len(packed):
        raise RunError(f"{path}: holds no demonstration: collect more episodes")
    if size != (HEIGHT_PX, WIDTH_PX):
        raise RunError(
            f"{path}: pictures of {size[1]} x {size[0]} pixels, wanted are {WIDTH_PX} x "
            f"{HEIGHT_PX}: cosim collect --camera {WIDTH_PX}x{HEIGHT_PX}"
        )
    if ahead < WAYPOINTS:
        raise RunError(f"{path}: {ahead} waypoints a row, wanted are {WAYPOINTS}")
    if (fastest := float(np.abs(packed.command[:, 1]).max())) > TURN_UNIT_RADPS + _ROUNDING:
        raise RunError(
            f"{path}: the expert turns at {fastest:.2f} rad/s, and this network at "
            f"{TURN_UNIT_RADPS:g} at most: cosim collect with the courier"
        )
    if np.isnan(packed.goal).any():
        raise RunError(
            f"{path}: goals are no points ({packed.meta.get('goal')}): cosim collect --goal "
            f"route_point"
        )
    return packed
