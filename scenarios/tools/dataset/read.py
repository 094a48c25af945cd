"""Read data sets of `cosim collect`, compare their rows with their pictures, and pack them."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import pyarrow.parquet as pq
from numpy.typing import NDArray

from cosim.core.errors import RunError
from cosim.core.packed_demos import EXTRAS, LABELLED_PEOPLE, Packed
from cosim.core.progress import Progress, ignore
from cosim.spec.sensors import PEOPLE_ROWS
from cosim.spec.weather import CLEAR
from scenarios.episodes.clip import read_pictures
from scenarios.episodes.demonstration import glimpse
from scenarios.tools.dataset.collected import Collected, packed_meta, refuse_unlike
from scenarios.tools.dataset.lerobot import CODEBASE_VERSION, feature_of

_READING: Final = "reading the pictures"
_ALIKE: Final = 8.0
"""Largest mean difference between the area means of a picture as read back and as drawn, of 255."""


@dataclass(frozen=True)
class DataSet:
    """Data set on the disk.

    info: content of info.json.
    about: options of its collection.
    rows: its columns.
    films: files of its videos, in order.
    episodes: `scenario`, `structure` and `weather` of each; older ones lack the weather.
    """

    folder: Path
    info: dict[str, Any]
    about: dict[str, Any]
    rows: dict[str, NDArray[Any]]
    films: tuple[Path, ...]
    episodes: tuple[dict[str, Any], ...]

    def __len__(self) -> int:
        return len(self.rows["index"])

    def pictures(self) -> Iterator[NDArray[np.uint8]]:
        """Yield (H, W, 3) for each row.

        Raises RunError if there are fewer or more, or one is not at its time.
        """
        fps = int(self.info["fps"])
        first = 0
        for film in self.films:
            shown = 0
            for time_s, rgb in read_pictures(film):
                if time_s != Fraction(shown, fps):
                    raise RunError(
                        f"{film}: picture {shown} is shown at {float(time_s):g} s, not "
                        f"{shown / fps:g} s"
                    )
                shown += 1
                yield rgb
            first += shown
        if first != len(self):
            raise RunError(
                f"{self.folder}: {first} pictures and {len(self)} rows: collect it again, in "
                f"another --out"
            )


def read_data_set(folder: Path) -> DataSet:
    """Read a data set without its pictures. Raises RunError with the missing part."""
    info_path = folder / "meta/info.json"
    try:
        info = json.loads(info_path.read_text(encoding="utf-8"))
        if info["codebase_version"] != CODEBASE_VERSION:
            raise RunError(
                f"{info_path}: codebase_version {info['codebase_version']}, this version "
                f"reads {CODEBASE_VERSION}"
            )
        about = json.loads((folder / "meta/cosim.json").read_text(encoding="utf-8"))
        table = pq.read_table(folder / info["data_path"].format(chunk_index=0, file_index=0))
        rows = {name: np.stack(table[name].to_numpy()) for name in table.column_names}
        (video_key,) = [name for name, one in info["features"].items() if one["dtype"] == "video"]
        columns = [
            "scenario",
            "structure",
            *(f"videos/{video_key}/{at}_index" for at in ("chunk", "file")),
        ]
        (path,) = sorted((folder / "meta/episodes").glob("*/*.parquet"))
        if "weather" in pq.read_schema(path).names:  # older data sets lack it
            columns.append("weather")
        episodes = pq.read_table(path, columns=columns).to_pylist()
        at = dict.fromkeys((one[columns[2]], one[columns[3]]) for one in episodes)
        names = [
            info["video_path"].format(video_key=video_key, chunk_index=c, file_index=f)
            for c, f in at
        ]
    except (OSError, ValueError, KeyError) as error:
        raise RunError(
            f"{folder}: no data set of `cosim collect`, or not whole yet: {error}"
        ) from error
    return DataSet(
        folder, info, about, rows, tuple(folder / name for name in names), tuple(episodes)
    )


@dataclass(frozen=True)
class ReadBack:
    """Result of reading a data set back.

    rows: number of rows, which is also that of pictures.
    off: mean difference of the pictures from those drawn for their rows, of 255.
    off_next: the same for the rows after these.
    """

    rows: int
    off: float
    off_next: float


def read_back(folder: Path, episodes: Sequence[Collected], progress: Progress = ignore) -> ReadBack:
    """Compare rows and pictures of a data set with the demonstrations of its episodes.

    Raises RunError if a number differs, or a picture is not that of its row.
    """
    held = read_data_set(folder)
    pictures = held.pictures()
    total = np.zeros(2)
    counts = np.zeros(2, np.int64)
    row = 0
    for index, one in enumerate(episodes):
        progress(_READING, row / len(held))
        shown = one.load()
        here = slice(row, row + len(shown))
        row += len(shown)
        same = (
            np.array_equal(held.rows["episode_index"][here], np.full(len(shown), index))
            and np.array_equal(held.rows["action"][here], shown.command)
            and np.array_equal(held.rows["observation.state"][here], shown.state)
            and np.array_equal(
                held.rows["waypoints"][here], shown.waypoints.reshape(len(shown), -1)
            )
            and all(
                np.array_equal(held.rows[feature_of(name)][here], rows.reshape(len(shown), -1))
                for name, rows in shown.extras.items()
            )
        )
        if not same:
            raise RunError(
                f"{folder}: the rows of episode {index}, {one.scenario.id}, are not those "
                f"that were stored"
            )
        seen = np.stack([glimpse(next(pictures)) for _ in range(len(shown))]).astype(float)
        off = np.abs(seen - shown.glimpses).mean(axis=(1, 2, 3))
        if off.max() > _ALIKE:
            raise RunError(
                f"{folder}: picture {int(off.argmax())} of episode {index}, {one.scenario.id}, is "
                f"not that of its row: its areas differ by {off.max():.0f} of 255"
            )
        off_next = np.abs(seen[:-1] - shown.glimpses[1:]).mean(axis=(1, 2, 3))
        total += off.sum(), off_next.sum()
        counts += len(off), len(off_next)
    for _ in pictures:
        raise RunError(f"{folder}: more pictures than rows")
    means = total / np.maximum(counts, 1)
    return ReadBack(len(held), float(means[0]), float(means[1]))


def packed_sets(
    folders: Sequence[Path], size: tuple[int, int] | None = None, progress: Progress = ignore
) -> Packed:
    """Return data sets, one after another, as arrays.

    size: width and height of the pictures, instead of their own.

    Raises RunError for a folder without a data set, SpecError for data sets that do not match.
    """
    held = [read_data_set(folder) for folder in folders]
    refuse_unlike([(one.folder, one.about) for one in held])
    wide, high = size or held[0].info["features"][_eye(held[0])]["shape"][1::-1]
    count = sum(map(len, held))
    frames = np.empty((count, high, wide, 3), np.uint8)
    row = 0
    for one in held:
        for rgb in one.pictures():
            if row % 500 == 0:
                progress(_READING, row / count)
            at_size = rgb.shape[:2] == (high, wide)
            frames[row] = (
                rgb if at_size else cv2.resize(rgb, (wide, high), interpolation=cv2.INTER_AREA)
            )
            row += 1

    def column(name: str) -> NDArray[Any]:
        return np.concatenate([one.rows[name] for one in held])

    goal = (
        column("observation.goal")
        if "observation.goal" in held[0].rows
        else np.full((count, 2), np.nan, np.float32)
    )
    first = np.cumsum([0, *(len(one.episodes) for one in held)])
    episode = [one.rows["episode_index"] + before for one, before in zip(held, first, strict=False)]
    listed = [
        {"weather": one.about.get("weather") or CLEAR} | episode
        for one in held
        for episode in one.episodes
    ]
    return Packed(
        frames=frames,
        state=column("observation.state"),
        goal=goal,
        command=column("action"),
        waypoints=column("waypoints").reshape(count, -1, 2),
        driven=column("driven").astype(np.int32),
        disturbed=column("disturbed").astype(bool),
        episode=np.concatenate(episode).astype(np.int32),
        frame=column("frame_index").astype(np.int32),
        meta=packed_meta([one.about for one in held], listed),
        **{
            name: column(feature_of(name)).reshape(count, *_shape(held[0], name))
            for name in EXTRAS
            if feature_of(name) in held[0].rows
        },
    )


def _shape(held: DataSet, name: str) -> tuple[int, ...]:
    """Return the shape of a sensor's reading."""
    if name == "scan":
        return held.about["lidar"]["rings"], held.about["lidar"]["rays"]
    return {"people": (PEOPLE_ROWS, -1), "near": (LABELLED_PEOPLE, -1)}.get(name, (-1,))


def _eye(held: DataSet) -> str:
    return next(str(name) for name, one in held.info["features"].items() if one["dtype"] == "video")
