"""Packed demonstrations: plain arrays in one .npz, for training with numpy alone.

`cosim dataset pack DIR -o FILE.npz` writes it from the output of `cosim collect`. It has N rows,
one for each picture, ordered by episode and time:

| array     | type                     | meaning                                                   |
|-----------|--------------------------|-----------------------------------------------------------|
| frames    | (N, H, W, 3) uint8       | RGB picture                                               |
| state     | (N, 2) float32           | speeds of the robot at the picture: v m/s, w rad/s        |
| goal      | (N, 2) float32           | point goal: x ahead, y left, metres; NaN without one      |
| command   | (N, 2) float32           | expert's answer within the robot's limits: v m/s, w rad/s |
| waypoints | (N, K, 2) float32        | robot after 1 .. K times `waypoint_s`: x ahead, y left    |
| driven    | (N,) int32               | number of waypoints driven by the expert alone            |
| disturbed | (N,) bool                | whether another command was driven (`--noise`)            |
| episode   | (N,) int32               | number of the episode, from 0                             |
| frame     | (N,) int32               | number of the picture in its episode, from 0              |
| scan      | (N, rings, rays) float32 | distances of the lidar, m; its range without a return     |
| imu       | (N, 6) float32           | angular speed rad/s and specific force m/s2: x, y, z each |
| people    | (N, 32, 5) float32       | nearest people: 1, x, y, vx, vy, the robot's axes; else 0 |
| near      | (N, 8, 6) float32        | label: people ahead, see `scenarios/episodes/labels.py`   |
| free      | (N, 25) float32          | label: free distances, m, from left to right              |
| scene     | (N, 2) float32           | label: signal and event ahead                             |
| reward    | (N, 1) float32           | reward until the next picture (`--explore`)               |
| meta      | () str                   | JSON, see `Packed.meta`                                   |

The file has scan, imu, people, the labels and rewards only if the data set has them. Labels are the
simulator's truth, for training alone. Waypoints are metres in the robot's frame at the picture.
Those after `driven` extrapolate the expert's command, because the episode ended or the drive was
disturbed. With rewards (`scenarios/episodes/reward.py`), commands are the learner's own.

A picture is taken frame / rate_hz seconds after the episode's start.
"""

from __future__ import annotations

import hashlib
import json
import zipfile
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import RunError, unwritable
from cosim.core.files import atomic_file
from cosim.core.npz import NPZ_ERRORS

_FORMAT: Final = 1
"""Version of the file format."""


SENSORS: Final = ("scan", "imu", "people")
"""Names of the arrays of sensors, which a file may lack."""
LABELS: Final = ("near", "free", "scene")
"""Names of the arrays of labels, which a file may lack."""
LABELLED_PEOPLE: Final = 8
"""Number of people in a row of `near`."""
FREE_RAYS: Final = 25
"""Number of bearings in a row of `free`."""
REWARD: Final = "reward"
"""Name of the array of rewards, which a file may lack."""
EXTRAS: Final = (*SENSORS, *LABELS, REWARD)


def _nothing() -> NDArray[np.float32]:
    return np.zeros((0, 0), np.float32)


@dataclass(frozen=True)
class Packed:
    """Demonstrations in memory, with the arrays of the file.

    scan, imu, people: sensors, empty (0, 0) arrays without them.
    near, free, scene: labels, empty (0, 0) arrays without them.
    reward: empty (0, 0) without rewards.
    meta: rate_hz and waypoint_s; goal, the name of its protocol or "none"; camera, as in
        `CameraSpec`; robot; lidar, imu and people, the settings of the sensors. policy, noise,
        learner and explorer are lists with one value for each data set; explorer is the learner
        of one with rewards. structures, scenarios and weathers are
        lists with the structure, the id and the weather of each episode's scenario.
    """

    frames: NDArray[np.uint8]
    state: NDArray[np.float32]
    goal: NDArray[np.float32]
    command: NDArray[np.float32]
    waypoints: NDArray[np.float32]
    driven: NDArray[np.int32]
    disturbed: NDArray[np.bool_]
    episode: NDArray[np.int32]
    frame: NDArray[np.int32]
    meta: dict[str, Any]
    scan: NDArray[np.float32] = field(default_factory=_nothing)
    imu: NDArray[np.float32] = field(default_factory=_nothing)
    people: NDArray[np.float32] = field(default_factory=_nothing)
    near: NDArray[np.float32] = field(default_factory=_nothing)
    free: NDArray[np.float32] = field(default_factory=_nothing)
    scene: NDArray[np.float32] = field(default_factory=_nothing)
    reward: NDArray[np.float32] = field(default_factory=_nothing)

    def __len__(self) -> int:
        return len(self.episode)

    def history(self, pictures: int, every: int = 1) -> NDArray[np.int64]:
        """Return the rows of the last pictures at each row, oldest first, as (N, pictures).

        Rows before the start of an episode are replaced by its first row, as a policy fills its
        memory.

        every: distance between the pictures in rows.

        >>> two = np.zeros((3, 2), np.float32)
        >>> rgb = np.zeros((3, 9, 16, 3), np.uint8)
        >>> none, driven = np.zeros(3, bool), np.zeros(3, np.int32)
        >>> episode, frame = np.array([[0, 0, 1], [0, 1, 0]], np.int32)
        >>> rows = Packed(rgb, two, two, two, two[:, None], driven, none, episode, frame, {})
        >>> rows.history(2).tolist()
        [[0, 0], [0, 1], [2, 2]]
        """
        rows = np.arange(len(self))
        back = every * np.arange(pictures - 1, -1, -1)
        found: NDArray[np.int64] = rows[:, None] - np.minimum(back, self.frame[:, None])
        return found

    def save(self, path: Path) -> None:
        """Write the file atomically. Raises MachineError."""
        arrays = {
            one.name: getattr(self, one.name)
            for one in fields(self)
            if one.name != "meta" and (one.name not in EXTRAS or getattr(self, one.name).size)
        }
        meta = json.dumps({"format": _FORMAT, **self.meta}, sort_keys=True)
        try:
            with atomic_file(path) as part, part.open("wb") as file:
                np.savez(file, allow_pickle=False, meta=np.array(meta), **arrays)
        except OSError as error:
            raise unwritable(path, error) from error


def packed_digest(path: Path) -> str:
    """Return a hash of a file's content, from the checksums in the file. Raises RunError.

    Files packed from the same data have the same hash.
    """
    try:
        with zipfile.ZipFile(path) as held:
            checksums = [(one.filename, one.file_size, one.CRC) for one in held.infolist()]
    except (OSError, *NPZ_ERRORS) as error:
        raise _unreadable(path, error) from error
    return hashlib.blake2b(repr(checksums).encode(), digest_size=8).hexdigest()


def read_packed(path: Path, pictures: bool = True) -> Packed:
    """Load the demonstrations of a file. Raises RunError.

    pictures: False for empty frames (N, 0, 0, 3); see `read_frames`.
    """
    try:
        with np.load(path, allow_pickle=False) as held:
            meta = json.loads(str(held["meta"]))
            arrays = {
                one.name: held[one.name]
                for one in fields(Packed)
                if one.name not in ("meta", "frames")
                and (one.name not in EXTRAS or one.name in held)
            }
            rows = len(arrays["episode"])
            arrays["frames"] = held["frames"] if pictures else np.zeros((rows, 0, 0, 3), np.uint8)
        if meta.pop("format") != _FORMAT or len({len(array) for array in arrays.values()}) != 1:
            raise ValueError("its arrays are of different lengths, or of another format")
    except (OSError, *NPZ_ERRORS) as error:
        raise _unreadable(path, error) from error
    return Packed(**arrays, meta=meta)


def read_frames(path: Path) -> NDArray[np.uint8]:
    """Load the pictures of a file alone. Raises RunError."""
    try:
        with np.load(path, allow_pickle=False) as held:
            frames: NDArray[np.uint8] = held["frames"]
            return frames
    except (OSError, *NPZ_ERRORS) as error:
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: Exception) -> RunError:
    return RunError(f"{path}: no packed demonstrations: {error}: make it with `cosim dataset pack`")
