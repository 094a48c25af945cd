"""Demonstration: the rows that are stored of one episode, and the waypoints of its trajectory."""

from __future__ import annotations

import importlib.util
import io
from dataclasses import Field, dataclass, field, fields
from itertools import pairwise
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import MachineError, RunError
from cosim.core.geometry import Floats
from cosim.core.npz import read_open_npz
from cosim.core.packed_demos import EXTRAS

_GLIMPSE_PX: Final = (8, 6)
"""Width and height in pixels of the thumbnails by which stored pictures are checked."""
_STRAIGHT_RADPS: Final = 1e-6
"""Yaw rate in rad/s below which a robot drives straight, because the arc's radius diverges."""


def check_parquet() -> None:
    """Check that pyarrow, which writes and reads data sets, is installed. Raises MachineError."""
    if importlib.util.find_spec("pyarrow") is None:
        raise MachineError(
            "a data set needs pyarrow, of the extra [collect]: .venv/bin/pip install 'pyarrow<24'"
        )


def _nothing() -> NDArray[np.float32]:
    return np.zeros((0, 0), np.float32)


@dataclass(frozen=True)
class Demonstration:
    """The demonstration of one episode, with n rows, one for each picture.

    state, goal, command (n, 2), waypoints (n, K, 2), driven (n,), disturbed (n,): as in
        `cosim.core.packed_demos`.
    instruction (n,): the instruction, "" for other goals.
    glimpses (n, 6, 8, 3) uint8: thumbnails of the drawn pictures, to check the decoded ones.
    colours (3, 256) int64: histograms of red, green and blue.
    clip: the bytes of an .mp4 with n pictures.
    scan (n, R), imu (n, 6), people (n, PEOPLE_ROWS, 5): recorded sensors, as in
        `scan_row` and `people_rows` of `cosim.spec.sensors`; empty without them.
    near, free, scene: labels, as in `scenarios.episodes.labels`; empty without them.
    reward (n, 1): rewards, as in `scenarios.episodes.reward`; empty without them.
    begins (n,): whether a row is the first one, or the first after the robot was put back; empty
        for one that was never put back.
    """

    state: NDArray[np.float32]
    goal: NDArray[np.float32]
    command: NDArray[np.float32]
    waypoints: NDArray[np.float32]
    driven: NDArray[np.int32]
    disturbed: NDArray[np.bool_]
    instruction: NDArray[np.str_] = field(metadata={"key": "told"})
    glimpses: NDArray[np.uint8]
    colours: NDArray[np.int64]
    clip: NDArray[np.uint8]
    scan: NDArray[np.float32] = field(default_factory=_nothing)
    imu: NDArray[np.float32] = field(default_factory=_nothing)
    people: NDArray[np.float32] = field(default_factory=_nothing)
    near: NDArray[np.float32] = field(default_factory=_nothing)
    free: NDArray[np.float32] = field(default_factory=_nothing)
    scene: NDArray[np.float32] = field(default_factory=_nothing)
    reward: NDArray[np.float32] = field(default_factory=_nothing)
    begins: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, bool))

    def __len__(self) -> int:
        return len(self.state)

    @property
    def extras(self) -> dict[str, NDArray[np.float32]]:
        """Return the recorded sensors, labels and rewards by name."""
        rows = {name: getattr(self, name) for name in EXTRAS}
        return {name: readings for name, readings in rows.items() if readings.size}

    @property
    def lengths(self) -> list[int]:
        """Return the numbers of rows of its drives, of which each begins with `begins`."""
        starts = np.flatnonzero(self.begins).tolist() or [0]
        return [after - first for first, after in pairwise([*starts, len(self)])]

    def encoded(self) -> bytes:
        """Return the .npz; equal demonstrations have equal bytes."""
        file = io.BytesIO()
        np.savez(
            file, allow_pickle=False, **{_key(one): getattr(self, one.name) for one in fields(self)}
        )
        return file.getvalue()

    @classmethod
    def decoded(cls, data: bytes, where: object) -> Demonstration:
        """Decode a demonstration. where: the file that an error names. Raises RunError."""
        try:
            keys = {one.name: _key(one) for one in fields(cls)}
            held = read_open_npz(io.BytesIO(data), list(keys.values()))
            return cls(**{name: held[key] for name, key in keys.items()})
        except ValueError as error:
            raise RunError(
                f"{where}: no demonstration: {error}: collect it again, in another --out"
            ) from error


def _key(one: Field[Any]) -> str:
    """Return the key of a field in the .npz."""
    key: str = one.metadata.get("key", one.name)
    return key


def glimpse(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the thumbnail (6, 8, 3) of a picture (H, W, 3): the mean color of each area."""
    small: NDArray[np.uint8] = cv2.resize(rgb, _GLIMPSE_PX, interpolation=cv2.INTER_AREA)
    return small


def waypoints_ahead(
    pose: Floats,
    ticks: NDArray[np.int64],
    command: Floats,
    disturbed: NDArray[np.bool_],
    count: int,
    every: int,
    tick_s: float,
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Return the waypoints after each of n pictures, and the number that the expert drove to.

    Waypoint k is the robot's position (k + 1) * `every` ticks after the picture. From the first
    disturbed picture or the trajectory's end on, it is extrapolated by the expert's last command.

    pose (T + 1, 3): x in m, y in m and heading in rad at the start of each tick and at the end.
    ticks (n,): the tick of each picture, ascending.
    command (n, 2): the expert's command.
    disturbed (n,): whether another command was executed after the picture.
    Returns waypoints (n, count, 2) in m, x ahead and y left of the robot, and counts (n,).
    """
    until = np.full(len(ticks), len(pose) - 1)
    last = len(pose) - 1
    for row in range(len(ticks) - 1, -1, -1):
        last = int(ticks[row]) if disturbed[row] else last
        until[row] = last
    ahead = ticks[:, None] + every * np.arange(1, count + 1)
    driven = (ahead <= until[:, None]).sum(axis=1)
    known = pose[np.minimum(ahead, until[:, None])]
    after_s = np.maximum(ahead - until[:, None], 0) * tick_s
    v_mps, w_radps = command[np.searchsorted(ticks, until, side="right") - 1].T[:, :, None]
    onward = arc_ahead(v_mps, w_radps, after_s)
    world = known[..., :2] + _turned(onward, known[..., 2])
    here = pose[ticks]
    local = _turned(world - here[:, None, :2], -here[:, None, 2])
    return local.astype(np.float32), driven.astype(np.int32)


def drives_ahead(
    pose: Floats,
    resets: NDArray[np.int64],
    ticks: NDArray[np.int64],
    begins: NDArray[np.bool_],
    command: Floats,
    disturbed: NDArray[np.bool_],
    count: int,
    every: int,
    tick_s: float,
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Return what `waypoints_ahead` does, for drives that end when the robot is put back.

    pose (T + 1, 3): as there, over all drives; where the robot was put is not in it.
    resets: ticks at whose end the robot is put back, ascending.
    begins (n,): whether a picture is the first of a drive.
    """
    found = []
    starts = [*np.flatnonzero(begins).tolist(), len(ticks)]
    for first, after in pairwise(starts):
        rows, tick = slice(first, after), int(ticks[first])
        ends = resets[resets >= tick]
        drive = pose[: int(ends[0]) + 2].copy() if len(ends) else pose.copy()
        if tick - 1 in resets and tick + 1 < len(drive):
            drive[tick] = drive[tick + 1]  # at rest there, it has hardly moved a tick later
        found.append(
            waypoints_ahead(
                drive, ticks[rows], command[rows], disturbed[rows], count, every, tick_s
            )
        )
    waypoints, driven = zip(*found, strict=True)
    return np.concatenate(waypoints), np.concatenate(driven)


def arc_ahead(v_mps: Floats, w_radps: Floats, time_s: Floats) -> Floats:
    """Return the position after driving a constant command: (..., 2) in m, x ahead and y left.

    >>> arc_ahead(np.array(1.0), np.array(0.0), np.array(2.0)).tolist()
    [2.0, 0.0]
    """
    turn = w_radps * time_s
    straight = np.abs(w_radps) < _STRAIGHT_RADPS
    radius_m = v_mps / np.where(straight, 1.0, w_radps)
    x_m = np.where(straight, v_mps * time_s, radius_m * np.sin(turn))
    y_m = np.where(straight, 0.0, radius_m * (1.0 - np.cos(turn)))
    return np.stack([x_m, y_m], axis=-1)


def _turned(offset: Floats, angle_rad: Floats) -> Floats:
    """Rotate offsets (..., 2) counter-clockwise by angles (...)."""
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    x, y = offset[..., 0], offset[..., 1]
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)
