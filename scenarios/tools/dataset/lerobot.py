"""Data set in the format of the lerobot package (`codebase_version` v3.0), with these files.

meta/info.json                       features by name and shape, rate, paths
meta/stats.json                      of each feature: min, max, mean, std, count and quantiles
meta/tasks.parquet                   the instructions
meta/episodes/chunk-000/file-000.parquet   of each episode: length, place of rows and pictures,
                                     statistics, scenario,
                                     structure, place, seed, weather
                                     and state hash
meta/cosim.json                      options of the collection
data/chunk-000/file-000.parquet      the rows
videos/<key>/chunk-000/file-000.mp4  the pictures, one for each row, in its order, at index / rate
                                     seconds
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from cosim.core.packed_demos import LABELS, REWARD
from scenarios.episodes.clip import CODEC, PIXELS, join_clips
from scenarios.tools.dataset.collected import Collected

CODEBASE_VERSION: Final = "v3.0"
_FILE: Final = "chunk-{chunk_index:03d}/file-{file_index:03d}"
_DATA_PATH: Final = f"data/{_FILE}.parquet"
_VIDEO_PATH: Final = f"videos/{{video_key}}/{_FILE}.mp4"
_TASK: Final = "Follow the sidewalk to the goal."
"""Task of rows whose goal is not an instruction."""
_EPISODES_PATH: Final = f"meta/episodes/{_FILE}.parquet"
_FIRST_FILE: Final = {"chunk_index": 0, "file_index": 0}
_CHUNK: Final = 1000
_MAX_ROWS_MB: Final = 100
_MAX_FILM_MB: Final = 200
_QUANTILES: Final = (0.01, 0.1, 0.5, 0.9, 0.99)
_SPEEDS: Final = ("v_mps", "w_radps")


def feature_of(extra: str) -> str:
    """Return the name of the feature of a sensor, a label or the reward.

    >>> feature_of("imu"), feature_of("free"), feature_of("reward")
    ('observation.imu', 'label.free', 'next.reward')
    """
    if extra == REWARD:
        return f"next.{REWARD}"
    return f"{'label' if extra in LABELS else 'observation'}.{extra}"


class Filmed(NamedTuple):
    """Pictures of a data set.

    eye: name of the camera.
    size: width and height.
    fps: pictures a second.
    """

    eye: str
    size: tuple[int, int]
    fps: int

    @property
    def key(self) -> str:
        """The name of the feature."""
        return f"observation.images.{self.eye}"


def write_lerobot(
    folder: Path, episodes: Sequence[Collected], filmed: Filmed, robot: str, about: dict[str, Any]
) -> None:
    """Write a data set into an empty folder. about: how it was collected."""
    rows, lengths, sizes, tasks, per_episode = _rows(episodes, filmed)
    where = _places(lengths, _films(sizes), filmed)
    for chunk, file in dict.fromkeys((one.chunk, one.file) for one in where):
        there = [index for index, one in enumerate(where) if (one.chunk, one.file) == (chunk, file)]
        path = folder / _VIDEO_PATH.format(video_key=filmed.key, chunk_index=chunk, file_index=file)
        path.parent.mkdir(parents=True, exist_ok=True)
        clips = (episodes[index].load().clip.tobytes() for index in there)
        join_clips(clips, [lengths[index] for index in there], path, filmed.fps)
    listed = [
        {
            "episode_index": index,
            "length": lengths[index],
            **place.columns,
            **_own_columns(one),
            **per_episode[index],
        }
        for index, (one, place) in enumerate(zip(episodes, where, strict=True))
    ]
    info = {
        "codebase_version": CODEBASE_VERSION,
        "robot_type": robot,
        "total_episodes": len(episodes),
        "total_frames": sum(lengths),
        "total_tasks": len(tasks),
        "chunks_size": _CHUNK,
        "data_files_size_in_mb": _MAX_ROWS_MB,
        "video_files_size_in_mb": _MAX_FILM_MB,
        "fps": filmed.fps,
        "splits": {"train": f"0:{len(episodes)}"},
        "data_path": _DATA_PATH,
        "video_path": _VIDEO_PATH,
        "features": _features(rows, filmed),
    }
    colours = np.sum([one.load().colours for one in episodes], axis=0)
    stats = {name: _stats(_numbers(column)) for name, column in rows.items()}
    stats |= {filmed.key: _colour_stats(colours, sum(lengths))}
    _write_table(folder / _DATA_PATH.format(**_FIRST_FILE), pa.table(rows))
    _write_table(folder / _EPISODES_PATH.format(**_FIRST_FILE), pa.Table.from_pylist(listed))
    tasks_table = pd.DataFrame(
        {"task_index": range(len(tasks))}, index=pd.Index(tasks, name="task")
    )
    tasks_table.to_parquet(folder / "meta/tasks.parquet")
    for name, content in (("stats", stats), ("cosim", about), ("info", info)):
        text = json.dumps(content, indent=4, ensure_ascii=False)
        (folder / f"meta/{name}.json").write_text(text + "\n", encoding="utf-8")


class _Place(NamedTuple):
    """Position of an episode in the files. columns: as in `meta/episodes`."""

    chunk: int
    file: int
    columns: dict[str, Any]


def _places(
    lengths: Sequence[int], films: Sequence[tuple[int, int]], filmed: Filmed
) -> list[_Place]:
    found = []
    rows = np.cumsum([0, *lengths]).tolist()
    for number, (first, end) in enumerate(films):
        chunk, file = divmod(number, _CHUNK)
        for index in range(first, end):
            columns = {
                "dataset_from_index": rows[index],
                "dataset_to_index": rows[index + 1],
                f"videos/{filmed.key}/chunk_index": chunk,
                f"videos/{filmed.key}/file_index": file,
                f"videos/{filmed.key}/from_timestamp": (rows[index] - rows[first]) / filmed.fps,
                f"videos/{filmed.key}/to_timestamp": (rows[index + 1] - rows[first]) / filmed.fps,
                **{f"data/{name}": at for name, at in _FIRST_FILE.items()},
                **{f"meta/episodes/{name}": at for name, at in _FIRST_FILE.items()},
            }
            found.append(_Place(chunk, file, columns))
    return found


def _own_columns(one: Collected) -> dict[str, Any]:
    """Return the columns of an episode in `meta/episodes` beyond those of the format."""
    scenario = one.scenario
    return {
        "scenario": scenario.id,
        "structure": scenario.structure,
        "place": scenario.place.name,
        "seed": scenario.seed,
        "weather": scenario.conditions.name,
        "state_hash": one.record.state_hash,
    }


def _rows(
    episodes: Sequence[Collected], filmed: Filmed
) -> tuple[dict[str, Any], list[int], list[int], list[str], list[dict[str, Any]]]:
    """Return the columns of all rows, and of each episode its length, size in bytes and statistics.

    All tasks are returned too.
    """
    parts: list[dict[str, NDArray[Any]]] = []
    lengths = list[int]()
    sizes = list[int]()
    tasks = dict[str, int]()
    per_episode: list[dict[str, Any]] = []
    before = 0
    for index, one in enumerate(episodes):
        shown = one.load()
        count = len(shown)
        instructions = [words or _TASK for words in shown.instruction.tolist()]
        numbered = [tasks.setdefault(words, len(tasks)) for words in instructions]
        part: dict[str, NDArray[Any]] = {"observation.state": shown.state}
        if not np.isnan(shown.goal).all():
            part["observation.goal"] = shown.goal
        for name, readings in shown.extras.items():
            part[feature_of(name)] = readings.reshape(count, -1)
        part |= {
            "action": shown.command,
            "waypoints": shown.waypoints.reshape(count, -1),
            "driven": shown.driven.astype(np.int64),
            "disturbed": shown.disturbed,
            "timestamp": (np.arange(count) / filmed.fps).astype(np.float32),
            "frame_index": np.arange(count),
            "episode_index": np.full(count, index),
            "index": np.arange(before, before + count),
            "task_index": np.array(numbered),
        }
        stats = {name: _stats(column) for name, column in part.items()} | {
            filmed.key: _colour_stats(shown.colours, count)
        }
        flat = {
            f"stats/{name}/{what}": value
            for name, of in stats.items()
            for what, value in of.items()
        }
        per_episode.append({"tasks": list(dict.fromkeys(instructions)), **flat})
        parts.append(part)
        lengths.append(count)
        sizes.append(len(shown.clip))
        before += count
    columns = {name: _column(np.concatenate([part[name] for part in parts])) for name in parts[0]}
    return columns, lengths, sizes, list(tasks), per_episode


def _features(rows: dict[str, Any], filmed: Filmed) -> dict[str, Any]:
    """Return the features of info.json."""
    wide, high = filmed.size
    points = rows["waypoints"].type.list_size // 2
    named: dict[str, Sequence[str]] = {
        "observation.state": _SPEEDS,
        "observation.goal": ("x_m", "y_m"),
        "observation.imu": [f"{what}_{axis}" for what in ("gyro", "accel") for axis in "xyz"],
        "action": _SPEEDS,
        "waypoints": [f"{axis}{k}_m" for k in range(1, points + 1) for axis in "xy"],
    }
    found: dict[str, Any] = {
        filmed.key: {
            "dtype": "video",
            "shape": [high, wide, 3],
            "names": ["height", "width", "channels"],
            "info": {
                "video.height": high,
                "video.width": wide,
                "video.codec": CODEC,
                "video.pix_fmt": PIXELS,
                "video.is_depth_map": False,
                "video.fps": filmed.fps,
                "video.channels": 3,
                "has_audio": False,
            },
        }
    }
    for name, column in rows.items():
        kind = column.type
        many = pa.types.is_fixed_size_list(kind)
        dtype = str(kind.value_type if many else kind)
        found[name] = {
            "dtype": {"float": "float32", "double": "float64"}.get(dtype, dtype),
            "shape": [kind.list_size if many else 1],
            "names": list(named[name]) if name in named else None,
        }
    return found


def _films(sizes: Sequence[int]) -> list[tuple[int, int]]:
    """Return the first and end episode of each film: as many as fit, at least one."""
    found = []
    first = 0
    size = 0
    for index, more in enumerate(sizes):
        if index > first and size + more > _MAX_FILM_MB * 2**20:
            found.append((first, index))
            first = index
            size = 0
        size += more
    return [*found, (first, len(sizes))]


def _column(array: NDArray[Any]) -> Any:
    """Return an Arrow column; for an array (n, k) one of lists of k."""
    if array.ndim == 1:
        return pa.array(array)
    return pa.FixedSizeListArray.from_arrays(pa.array(array.ravel()), array.shape[1])


def _numbers(column: Any) -> NDArray[Any]:
    """Return the array from which a column was made."""
    if pa.types.is_fixed_size_list(column.type):
        flat: NDArray[Any] = column.flatten().to_numpy(zero_copy_only=False)
        return flat.reshape(-1, column.type.list_size)
    plain: NDArray[Any] = column.to_numpy(zero_copy_only=False)
    return plain


def _stats(array: NDArray[Any]) -> dict[str, list[Any]]:
    """Return statistics of a feature (n,) or (n, k), as lists of 1 or k."""
    values = array.reshape(len(array), -1).astype(np.float64)
    found = {"min": values.min(axis=0), "max": values.max(axis=0), "mean": values.mean(axis=0)}
    found |= {"std": values.std(axis=0)}
    quantiles = np.quantile(values, _QUANTILES, axis=0)
    found |= {_called(share): row for share, row in zip(_QUANTILES, quantiles, strict=True)}
    return {name: row.tolist() for name, row in found.items()} | {"count": [len(array)]}


def _colour_stats(colours: NDArray[np.int64], pictures: int) -> dict[str, list[Any]]:
    """Return statistics of pictures, each channel from 0 to 1, as lists (3, 1, 1).

    colours: (3, 256) count of each value.
    """
    values = np.arange(256) / 255.0
    count = colours.sum(axis=1)
    mean = colours @ values / count
    std = np.sqrt(np.maximum(colours @ values**2 / count - mean**2, 0.0))
    there = colours > 0
    upto = colours.cumsum(axis=1)
    found: dict[str, Floats] = {
        "min": values[there.argmax(axis=1)],
        "max": values[255 - there[:, ::-1].argmax(axis=1)],
        "mean": mean,
        "std": std,
    }
    for share in _QUANTILES:
        found[_called(share)] = values[(upto >= share * count[:, None]).argmax(axis=1)]
    return {name: row.reshape(3, 1, 1).tolist() for name, row in found.items()} | {
        "count": [pictures]
    }


def _called(share: float) -> str:
    return f"q{round(100 * share):02d}"


def _write_table(path: Path, table: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table, path)
