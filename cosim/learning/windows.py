"""Training windows of consecutive pictures from packed demonstrations.

Windows in which the expert stops or starts, or the robot drives at something near, are oversampled.
A window is augmented as a whole: half are mirrored, brightness and tint vary, pictures are shifted,
and speeds and motion between two pictures are hidden.

The held-out episodes depend on the names of their scenarios alone. An event and its decoy are on
the same side, and a later round of DAgger never trains on what an earlier one held out.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cosim.core.errors import RunError
from cosim.core.packed_demos import FREE_RAYS, LABELS, Packed, read_frames, read_packed
from cosim.learning.examples import (
    BRIGHT,
    CHANGE_SHARE,
    DARK,
    HELD_OUT,
    SHIFT_PX,
    STOPS_MPS,
    TINT,
    scaled_goal,
    scaled_speeds,
)
from cosim.learning.memory_network import (
    DETAIL,
    EVENTS,
    HALVED,
    MEMORY,
    SIGNALS,
    SIZE_PX,
    Views,
    picture_of,
)
from cosim.learning.network import CRUISE_MPS, TURN_UNIT_RADPS, WAYPOINTS
from cosim.learning.packed_checks import check_pictures, check_rows, common_meta
from cosim.learning.settings import Training
from cosim.learning.values import discounted_returns

STEPS: Final = 40
"""Steps of a window; 8 s at 5 Hz."""
DECOY: Final = "-decoy"
"""End of the id of a decoy."""
WAITS_MPS: Final = 0.005
"""Command in m/s below which the expert waits. Turns almost on the spot are faster."""
_CLOSE_SHARE: Final = 0.25
"""Share of windows drawn around a row at which the robot drives at something near."""
_CLOSE_S: Final = 1.5
"""Something is near if the robot reaches it at its speed in less than this time, in seconds."""
_DRIVES_MPS: Final = 0.5
"""Least speed of such rows in m/s."""
_STRAIGHT_AHEAD: Final = slice(FREE_RAYS // 2 - 1, FREE_RAYS // 2 + 2)
"""Indices of the free distances within 7.5 degrees of straight ahead."""
_HIDDEN_SPEEDS: Final = 0.6
"""Share of windows whose speeds are hidden, see `examples`."""
_FROZEN: Final = 0.4
"""Share of windows whose pictures are each shown twice, as at the start of an episode.

Two equal pictures tell a network that the robot is at rest, and at rest an expert mostly waits.
In these windows it must decide by what it sees.
"""
_FROM_START: Final = 0.15
"""Share of windows that begin with an episode."""
_ROOM: Final = 0.75
"""Largest share of a GPU's free memory for pictures; more stay in the host's memory."""
_READERS: Final = 8
_MARGIN: Final = HALVED * SHIFT_PX
"""Pixels around the detail that are stored, too, so that it can be shifted."""
_WITH_MARGIN: Final = tuple(slice(one.start - _MARGIN, one.stop + _MARGIN) for one in DETAIL)
_AT_ONCE: Final = 256
"""Pictures that are halved at once."""
_SAME_META: Final = ("camera", "rate_hz", "waypoint_s", "goal")


@dataclass(frozen=True)
class Windows:
    """Batch of windows, with rows (N,) of all valid steps, N <= B T.

    seen: views (B, T, 3 PICTURES, H, W), 0 to 1
    goal, speeds: (B, T, 2) inputs
    valid: (B, T) whether a step belongs to the episode; of the fields below only such rows exist
    places: (N,) their indices in the B T steps
    speed, turn, stop, way, driven: see `objective.PlanTargets`
    weight: (N,) of the plan's loss; 1 unless rows are weighted by value
    near: (N, LABELLED_PEOPLE, 6), free: (N, FREE_RAYS), scene: (N, 2) labels; (N, 0) unless
        auxiliary heads are trained
    """

    seen: Views
    goal: Tensor
    speeds: Tensor
    valid: Tensor
    places: Tensor
    speed: Tensor
    turn: Tensor
    stop: Tensor
    way: Tensor
    driven: Tensor
    weight: Tensor
    near: Tensor
    free: Tensor
    scene: Tensor


class WindowExamples:
    """All demonstrations; pictures on the device if they fit.

    learned, held_out: rows (M,) of training and held-out episodes
    episodes: numbers of both
    episode: (M,) ascending numbers of the episodes
    returns: (M,) discounted returns, NaN without rewards
    weight: (M,) float32 on the device, of the plan's loss; all 1 at first
    meta: common metadata of the files, with the drivers of all of them
    """

    def __init__(self, paths: Sequence[Path], training: Training, device: torch.device) -> None:
        with ThreadPoolExecutor(_READERS) as readers:
            packed = list(readers.map(lambda path: _checked(path, training), paths))
        self.meta = common_meta(paths, packed, _SAME_META)
        self._device = device
        self._views = _load_views(paths, [len(one) for one in packed], device)
        firsts = np.cumsum([0, *(int(one.episode[-1]) + 1 for one in packed)])
        episode = np.concatenate([one.episode + n for one, n in zip(packed, firsts, strict=False)])
        frame = np.concatenate([one.frame for one in packed])
        self.episode = episode
        rows = np.arange(len(episode))
        self._first = rows - frame
        self._last = self._first + np.bincount(episode)[episode] - 1
        names = [name for one in packed for name in one.meta["scenarios"]]
        weathers = [
            weather
            for one in packed
            for weather in one.meta.get("weathers", ["clear"] * len(one.meta["scenarios"]))
        ]
        held_out, used = split_episodes(names, weathers, training)
        self.learned, self.held_out = rows[used[episode]], rows[held_out[episode]]
        self.episodes = int(used.sum()), int(held_out.sum())
        if not len(self.learned) or not len(self.held_out):
            raise RunError(
                f"{paths[0]}: of {len(names)} episodes {self.episodes[0]} are trained on and "
                f"{self.episodes[1]} held out: collect more episodes"
            )

        def joined(name: str) -> Tensor:
            arrays = [getattr(one, name) for one in packed]
            return torch.from_numpy(np.concatenate(arrays)).to(device)

        labels = LABELS if training.auxiliary else ()
        arrays = ("state", "goal", "command", "waypoints", "driven", *labels)
        self._rows = {name: joined(name) for name in arrays}
        command, state = (self._rows[name][:, 0].cpu().numpy() for name in ("command", "state"))
        self._changes = self._learned_where((command < WAITS_MPS) != (state < STOPS_MPS))
        rewards = [_rewards(one) for one in packed]
        self.returns = discounted_returns(
            np.concatenate(rewards), episode, 1.0 / float(self.meta["rate_hz"])
        )
        # A row with a reward has the learner's own command, which may be wrong.
        at_something = np.concatenate([_drives_at_something(one) for one in packed])
        self._close = self._learned_where(at_something & ~np.isfinite(self.returns))
        self.weight = torch.ones(len(rows), device=device)

    def _learned_where(self, which: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Return the training rows among those of a mask (M,); all training rows if none is."""
        found: NDArray[np.int64] = self.learned[which[self.learned]]
        return found if len(found) else self.learned

    def drawn(self, seed: int, step: int, size: int) -> Windows:
        """Draw the augmented batch of a step: a function of seed and step."""
        draws = np.random.default_rng([seed, 0x51DE, step])
        what = draws.random(size)
        change, any_row, close = (
            draws.choice(rows, size) for rows in (self._changes, self.learned, self._close)
        )
        row = np.select([what < CHANGE_SHARE, what > 1.0 - _CLOSE_SHARE], [change, close], any_row)
        start = np.maximum(row - draws.integers(0, STEPS, size), self._first[row])
        start = np.where(draws.random(size) < _FROM_START, self._first[row], start)
        light = draws.uniform(np.log(DARK), np.log(BRIGHT), (size, 1)) + draws.uniform(
            -TINT, TINT, (size, 3)
        )
        visible = draws.random(size) >= _HIDDEN_SPEEDS
        off_px = draws.integers(0, 2 * SHIFT_PX + 1, (2, size, 1))
        mirrored = draws.random(size) < 0.5
        frozen = draws.random(size) < _FROZEN
        changes = _Changes(np.exp(light), visible, off_px, mirrored, frozen)
        return self.windows(start, STEPS, changes)

    def windows(
        self, start: NDArray[np.int64], steps: int, changes: _Changes | None = None
    ) -> Windows:
        """Return the windows that begin at some rows.

        Steps after the end of an episode repeat its last row, and are not valid. The batch is as
        long as its longest window.

        changes: augmentation; None for none
        """
        steps = min(steps, int((self._last[start] - start).max()) + 1)
        rows = start[:, None] + np.arange(steps)
        valid = rows <= self._last[start][:, None]
        rows = np.minimum(rows, self._last[start][:, None])
        before = np.maximum(start - 1, self._first[start])[:, None]
        shown = torch.from_numpy(np.concatenate([before, rows], 1)).to(self._views.whole.device)
        frames = self._views.each(lambda one: one[shown].to(self._device))
        at = torch.from_numpy(rows).to(self._device)
        here = torch.from_numpy(rows[valid]).to(self._device)
        command = self._rows["command"][here]
        driven = self._rows["driven"][here]
        nothing = torch.zeros((len(here), 0), device=self._device)
        batch = Windows(
            seen=_seen_of(frames, changes).each(lambda one: _paired(one, changes)),
            goal=scaled_goal(self._rows["goal"][at]),
            speeds=scaled_speeds(self._rows["state"][at]),
            valid=torch.from_numpy(valid).to(self._device),
            places=torch.from_numpy(np.flatnonzero(valid)).to(self._device),
            speed=command[:, 0] / CRUISE_MPS,
            turn=command[:, 1].clamp(-TURN_UNIT_RADPS, TURN_UNIT_RADPS),
            stop=(command[:, 0] < WAITS_MPS).float(),
            way=self._rows["waypoints"][here][:, :WAYPOINTS],
            driven=(torch.arange(WAYPOINTS, device=self._device) < driven[:, None]).float(),
            weight=self.weight[here],
            **{name: self._rows[name][here] if name in self._rows else nothing for name in LABELS},
        )
        return batch if changes is None else _changed(batch, changes, np.nonzero(valid)[0])

    def _starts(self, rows: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return those of the rows at which windows begin, one after another."""
        found: NDArray[np.int64] = rows[(rows - self._first[rows]) % STEPS == 0]
        return found

    def rewarded_starts(self) -> NDArray[np.int64]:
        """Return the rows at which windows with rewards begin, one after another."""
        return self._starts(np.flatnonzero(np.isfinite(self.returns)))

    def held_out_starts(self, most: int) -> NDArray[np.int64]:
        """Return the rows at which held-out windows begin: one after another, at most `most`."""
        starts = self._starts(self.held_out)
        found: NDArray[np.int64] = starts[:: max(1, -(-len(starts) // most))]
        return found

    def first_inputs(self) -> dict[str, NDArray[np.float32]]:
        """Return the inputs of the graph at the start of the first held-out episode."""
        batch = self.windows(self.held_out[:1], 1)
        pictures = picture_of(batch.seen.each(lambda one: one[:, 0]))
        inputs = {"pictures": pictures, "goal": batch.goal[:, 0], "speeds": batch.speeds[:, 0]}
        arrays = {name: one.cpu().numpy().astype(np.float32) for name, one in inputs.items()}
        return arrays | {"memory": np.linspace(-0.5, 0.5, MEMORY, dtype=np.float32)[None]}


@dataclass(frozen=True)
class _Changes:
    """Augmentation of B windows.

    light: (B, 3) factors of red, green and blue
    visible: (B,) whether speeds are shown
    off_px: (2, B, 1) shift of the whole view down and right, from 0 to 2 SHIFT_PX
    mirrored: (B,) whether left and right are exchanged
    frozen: (B,) whether the picture before each one is replaced by it
    """

    light: NDArray[np.float64]
    visible: NDArray[np.bool_]
    off_px: NDArray[np.int64]
    mirrored: NDArray[np.bool_]
    frozen: NDArray[np.bool_]


def _seen_of(frames: Views, changes: _Changes | None) -> Views:
    """Return views (B, T, H, W, 3), 0 to 1, shifted, mirrored and lit.

    The channels stay last: GPUs convolve such pictures faster.

    frames: (B, T, H, W, 3) uint8; the detail with its margin
    """
    if changes is None:
        inner = slice(_MARGIN, -_MARGIN)
        return Views(
            frames.whole.float() / 255.0, frames.detail[:, :, inner, inner].float() / 255.0
        )
    shifts = changes.off_px - SHIFT_PX
    high, wide = frames.whole.shape[2:4]
    down, right = shifts
    row, column = (np.arange(high) + down).clip(0, high - 1), np.arange(wide) + right
    whole = _taken(frames.whole, row, column.clip(0, wide - 1), changes)
    high, wide = _sides(DETAIL)
    down, right = HALVED * shifts + _MARGIN
    detail = _taken(frames.detail, np.arange(high) + down, np.arange(wide) + right, changes)
    return Views(whole, detail)


def _taken(
    frames: Tensor, row: NDArray[np.int64], column: NDArray[np.int64], changes: _Changes
) -> Tensor:
    """Return the pixels of some rows (B, H) and columns (B, W), mirrored and lit, 0 to 1."""
    column = np.where(changes.mirrored[:, None], column[:, ::-1], column)
    there = (row[:, :, None] * frames.shape[3] + column[:, None, :]).reshape(len(row), -1)
    index = torch.from_numpy(there).to(frames.device)[:, None, :, None]
    pixels = frames.flatten(2, 3)
    taken = pixels.gather(2, index.expand(-1, pixels.shape[1], -1, 3))
    gain = torch.from_numpy(changes.light.astype(np.float32)).to(frames.device)
    lit = (taken.float() / 255.0 * gain[:, None, None]).clamp(max=1.0)
    return lit.view(*frames.shape[:2], row.shape[1], column.shape[1], 3)


def _paired(frames: Tensor, changes: _Changes | None) -> Tensor:
    """Return each picture with the one before it, (B, T, 6, H, W), of T + 1 pictures."""
    earlier, newest = frames[:, :-1], frames[:, 1:]
    if changes is not None:
        frozen = torch.from_numpy(changes.frozen).to(frames.device)
        earlier = torch.where(_shaped(frozen, earlier), newest, earlier)
    return torch.cat([earlier, newest], 4).permute(0, 1, 4, 2, 3)


def _changed(batch: Windows, changes: _Changes, window: NDArray[np.int64]) -> Windows:
    """Hide speeds and mirror windows whose pictures are changed already.

    window: (N,) window of each valid step
    """
    device = batch.goal.device
    visible = torch.from_numpy(changes.visible.astype(np.float32)).to(device)
    batch = replace(batch, speeds=batch.speeds * visible[:, None, None])
    other = mirror_windows(replace(batch, seen=batch.seen.each(lambda one: one[:, :0])))
    mirrored = torch.from_numpy(changes.mirrored).to(device)
    which = torch.from_numpy(changes.mirrored[window]).to(device)
    chosen = {
        name: torch.where(
            _shaped(mirrored if name in _PER_WINDOW else which, value),
            getattr(other, name),
            value,
        )
        for name, value in vars(batch).items()
        if name not in _UNCHANGED
    }
    return replace(batch, **chosen)


_PER_WINDOW: Final = ("goal", "speeds")
_UNCHANGED: Final = ("seen", "valid", "places", "weight")


def mirror_windows(batch: Windows) -> Windows:
    """Mirror windows: left and right exchanged."""
    side = torch.tensor([1.0, -1.0], device=batch.goal.device)
    values = {one.name: getattr(batch, one.name) for one in fields(batch)}
    values |= {
        "seen": batch.seen.each(lambda one: one.flip(4)),
        "goal": batch.goal * side,
        "speeds": batch.speeds * side,
        "turn": -batch.turn,
        "way": batch.way * side,
        "free": batch.free.flip(1),
    }
    if batch.near.ndim == 3:
        signs = torch.tensor([1.0, 1.0, -1.0, 1.0, -1.0, 1.0], device=batch.goal.device)
        values["near"] = batch.near * signs
    return Windows(**values)


def split_episodes(
    names: Sequence[str], weathers: Sequence[str], training: Training
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which episodes are held out, and which are trained on.

    The settings of an ablation leave out training episodes alone. A smaller share is a part of a
    larger one. An event, its decoy and all pieces of an episode are on one side, and used or left
    out together. Of few episodes the last scenario is held out.
    """
    base = [zlib.crc32(name.removesuffix(DECOY).encode()) for name in names]

    def drawn(purpose: int) -> NDArray[np.float64]:
        return np.array([np.random.default_rng([one, purpose]).random() for one in base])

    held_out = drawn(0x4E1D) < HELD_OUT
    if held_out.all() or not held_out.any():
        held_out = np.array([one == base[-1] for one in base])
    used = ~held_out & (drawn(0x5A4E) < training.share)
    if not training.decoys:
        used &= np.array([not name.endswith(DECOY) for name in names])
    if not training.weather:
        used &= np.array([weather == "clear" for weather in weathers])
    return held_out, used


def _shaped(which: Tensor, like: Tensor) -> Tensor:
    return which.view(-1, *[1] * (like.ndim - 1))


def _load_views(paths: Sequence[Path], counts: Sequence[int], device: torch.device) -> Views:
    """Load the views (N, H, W, 3) of all files, uint8, on the device if they fit."""
    wide, high = SIZE_PX
    sizes = (
        (sum(counts), high // HALVED, wide // HALVED, 3),
        (sum(counts), *_sides(_WITH_MARGIN), 3),
    )
    bytes_needed = sum(np.prod(size) for size in sizes)
    if device.type == "cuda" and bytes_needed > _ROOM * torch.cuda.mem_get_info(device)[0]:
        device = torch.device("cpu")
    whole = Views(*(torch.empty(size, dtype=torch.uint8, device=device) for size in sizes))
    places = zip(*(torch.split(one, list(counts)) for one in whole), strict=True)
    with ThreadPoolExecutor(_READERS) as readers:
        list(readers.map(_fill, (Views(*place) for place in places), paths))
    return whole


def _fill(place: Views, path: Path) -> None:
    """Load the views of a file's pictures. Raises RunError for another size."""
    frames = read_frames(path)
    check_pictures(path, frames, SIZE_PX)
    for first in range(0, len(frames), _AT_ONCE):
        some = slice(first, first + _AT_ONCE)
        pictures = torch.from_numpy(frames[some]).to(place.whole.device)
        squares = pictures.unflatten(1, (-1, HALVED)).unflatten(3, (-1, HALVED))
        place.whole[some] = squares.float().mean((2, 4)).round().to(torch.uint8)
        place.detail[some] = pictures[:, *_WITH_MARGIN]


def _sides(part: Sequence[slice]) -> tuple[int, ...]:
    """Return the numbers of rows and columns of a part of a picture."""
    return tuple(one.stop - one.start for one in part)


def _drives_at_something(packed: Packed) -> NDArray[np.bool_]:
    """Return (N,) whether the robot drives at something near. False without labels.

    Rows without free ground do not count: the robot is outside of it, or touches something.
    """
    if not packed.free.size:
        return np.zeros(len(packed), bool)
    speed_mps = packed.state[:, 0]
    free_m = packed.free[:, _STRAIGHT_AHEAD].min(axis=1)
    close: NDArray[np.bool_] = (
        (speed_mps > _DRIVES_MPS) & (free_m > 0.0) & (free_m < _CLOSE_S * speed_mps)
    )
    return close


def _rewards(packed: Packed) -> NDArray[np.float32]:
    """Return the rewards (N,) of a file, NaN without."""
    if packed.reward.size:
        return packed.reward[:, 0]
    return np.full(len(packed), np.nan, np.float32)


def _checked(path: Path, training: Training) -> Packed:
    """Load a file without its pictures. Raises RunError if this network cannot learn from it."""
    packed = read_packed(path, pictures=False)
    check_rows(path, packed)
    if not training.auxiliary:
        return packed
    if not packed.scene.size:
        raise RunError(
            f"{path}: has no labels for auxiliary heads: cosim collect --labels, or train with "
            f"--no-auxiliary"
        )
    if (packed.scene.max(axis=0) >= [SIGNALS, EVENTS]).any():
        raise RunError(f"{path}: labels of another version: collect it again")
    return packed
