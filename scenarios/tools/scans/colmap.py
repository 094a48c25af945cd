"""Read a sparse model of COLMAP: cameras, poses of photos and points, binary or text.

The layout is that of https://colmap.github.io/format.html.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import MapError
from cosim.core.geometry import Floats

_MODELS: Final = (
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
)
"""Camera models that are read, by their number in binary files, and their number of parameters."""
_PARTS: Final = ("cameras", "images", "points3D")


@dataclass(frozen=True, slots=True)
class Camera:
    """Intrinsics of a camera in pixels; the middle of the first pixel is at 0.5, 0.5.

    focal: fx, fy.
    centre: cx, cy.
    distortion: k1, k2, p1, p2 as in OpenCV.
    """

    width: int
    height: int
    focal: tuple[float, float]
    centre: tuple[float, float]
    distortion: tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class View:
    """Pose of a photo.

    name: of its file.
    camera: number of its camera.
    matrix: (4, 4) from the model's frame to the camera's: x right, y down, z ahead.
    points: (M,) indices of the model's points that the photo shows.
    """

    name: str
    camera: int
    matrix: Floats
    points: NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class ColmapModel:
    """A sparse model, in its own frame and unit.

    views: by the names of their photos.
    points: (N, 3).
    colours: (N, 3) uint8.
    """

    cameras: dict[int, Camera]
    views: tuple[View, ...]
    points: Floats
    colours: NDArray[np.uint8]


def model_folder(folder: Path) -> Path:
    """Return the folder of the model: `folder/sparse/0`, `folder/sparse` or `folder` itself.

    Raises MapError if none has cameras, images and points3D.
    """
    for one in (folder / "sparse" / "0", folder / "sparse", folder):
        for ending in (".bin", ".txt"):
            if all((one / f"{part}{ending}").is_file() for part in _PARTS):
                return one
    raise MapError(
        f"{folder}: holds no COLMAP model: cameras, images and points3D (.bin or .txt) must be in "
        "it, in its 'sparse' or in 'sparse/0': reconstruct the photos with COLMAP"
    )


def read_model(folder: Path) -> ColmapModel:
    """Read the model of a folder, see `model_folder`. Raises MapError."""
    where = model_folder(folder)
    binary = (where / "cameras.bin").is_file()
    ending = ".bin" if binary else ".txt"
    readers = (
        (_binary_cameras, _binary_views, _binary_points)
        if binary
        else (_text_cameras, _text_views, _text_points)
    )
    cameras = _read(where / f"cameras{ending}", readers[0])
    raw_views = _read(where / f"images{ending}", readers[1])
    ids, points, colours = _read(where / f"points3D{ending}", readers[2])
    order = np.argsort(ids, kind="stable")
    views = [_view(raw, ids[order], order) for raw in raw_views]
    for view in views:
        if view.camera not in cameras:
            known = ", ".join(map(str, sorted(cameras)))
            raise MapError(
                f"{where / f'images{ending}'}: photo '{view.name}' has the camera {view.camera}; "
                f"cameras{ending} has {known}: export the model again"
            )
    if not views or not len(points):
        raise MapError(
            f"{where}: {len(views)} photos and {len(points)} points: reconstruct the photos again"
        )
    return ColmapModel(cameras, tuple(sorted(views, key=lambda view: view.name)), points, colours)


_RawView = tuple[str, int, tuple[float, ...], NDArray[np.int64]]
"""Name, camera, rotation (w, x, y, z) with translation, and ids (M,) of points."""
_RawPoints = tuple[NDArray[np.int64], Floats, NDArray[np.uint8]]
"""Ids (N,), places (N, 3) and colours (N, 3)."""
_Content = TypeVar("_Content")


def _read(path: Path, reader: Callable[[Path, bytes], _Content]) -> _Content:
    """Apply a reader to a file. Raises MapError where it is cut off or damaged."""
    try:
        return reader(path, path.read_bytes())
    except (struct.error, ValueError, IndexError) as error:
        raise MapError(
            f"{path}: is cut off or damaged ({error}): export the model again, with `colmap "
            "model_converter`"
        ) from error


class _Reader:
    """Reads numbers of a binary file in sequence. Raises struct.error at its end."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    def take(self, layout: str) -> tuple[int | float, ...]:
        found = struct.unpack_from(layout, self._data, self._at)
        self._at += struct.calcsize(layout)
        return found

    def count(self, row: int) -> int:
        """Return the number of entries that follow, each of at least `row` bytes."""
        count = int(self.take("<Q")[0])
        if count * row > len(self._data) - self._at:
            raise ValueError(f"{count} entries promised, {len(self._data) - self._at} bytes follow")
        return count

    def word(self) -> str:
        end = self._data.index(b"\0", self._at)
        found = self._data[self._at : end].decode()
        self._at = end + 1
        return found

    def rows(self, count: int, kind: np.dtype[np.void]) -> NDArray[np.void]:
        found = np.frombuffer(self._data, kind, count, self._at)
        self._at += count * kind.itemsize
        return found

    def skip(self, size: int) -> None:
        self._at += size
        if self._at > len(self._data):
            raise ValueError("the last entry is not complete")


_SEEN: Final = np.dtype([("pixel", "<f8", 2), ("point", "<i8")])
_TRACK_BYTES: Final = 8


def _binary_cameras(path: Path, data: bytes) -> dict[int, Camera]:
    reader = _Reader(data)
    found = {}
    for _ in range(reader.count(24)):
        number, model, width, height = map(int, reader.take("<IiQQ"))
        name, size = _MODELS[model] if 0 <= model < len(_MODELS) else (f"number {model}", 0)
        found[number] = _camera(path, name, width, height, reader.take(f"<{size}d"))
    return found


def _binary_views(path: Path, data: bytes) -> list[_RawView]:
    reader = _Reader(data)
    found = []
    for _ in range(reader.count(73)):
        _, *pose, camera = reader.take("<I7dI")
        name = reader.word()
        seen = reader.rows(reader.count(_SEEN.itemsize), _SEEN)
        found.append((name, int(camera), tuple(pose), seen["point"]))
    return found


def _binary_points(path: Path, data: bytes) -> _RawPoints:
    reader = _Reader(data)
    ids, points, colours = [], [], []
    for _ in range(reader.count(51)):
        number, x, y, z, r, g, b, _ = reader.take("<Q3d3Bd")
        ids.append(int(number))
        points.append((x, y, z))
        colours.append((r, g, b))
        reader.skip(_TRACK_BYTES * reader.count(_TRACK_BYTES))
    return np.array(ids, dtype=np.int64), _rows(points, 3), _rows(colours, 3).astype(np.uint8)


def _lines(data: bytes) -> list[str]:
    """Return the lines of a text file without comments; empty lines stay."""
    return [line for line in data.decode().splitlines() if not line.startswith("#")]


def _text_cameras(path: Path, data: bytes) -> dict[int, Camera]:
    found = {}
    for line in filter(str.strip, _lines(data)):
        number, model, width, height, *rest = line.split()
        found[int(number)] = _camera(path, model, int(width), int(height), tuple(map(float, rest)))
    return found


def _text_views(path: Path, data: bytes) -> list[_RawView]:
    lines = _lines(data)
    found = []
    # Two lines a photo: its pose, then the points that it shows; the second may be empty.
    at = 0
    while at < len(lines):
        words = lines[at].split(maxsplit=9)
        at += 1
        if not words:
            continue
        seen = _rows(list(map(float, lines[at].split())) if at < len(lines) else [], 3)
        at += 1
        pose = tuple(map(float, words[1:8]))
        found.append((words[9], int(words[8]), pose, seen[:, 2].astype(np.int64)))
    return found


def _text_points(path: Path, data: bytes) -> _RawPoints:
    rows = [list(map(float, line.split()[:7])) for line in filter(str.strip, _lines(data))]
    found = _rows(rows, 7)
    return found[:, 0].astype(np.int64), found[:, 1:4], found[:, 4:].astype(np.uint8)


def _rows(values: object, columns: int) -> Floats:
    return np.array(values, dtype=np.float64).reshape(-1, columns)


def _camera(
    path: Path, model: str, width: int, height: int, parameters: tuple[float, ...]
) -> Camera:
    """Return a camera of any model that is read. Raises MapError for another one."""
    sizes = dict(_MODELS)
    if model not in sizes:
        raise MapError(
            f"{path}: the camera model {model} is not read; {', '.join(sizes)} are: undistort the "
            "photos with `colmap image_undistorter`"
        )
    if len(parameters) != sizes[model]:
        raise ValueError(f"{model} has {sizes[model]} parameters, not {len(parameters)}")
    two = model in ("PINHOLE", "OPENCV")
    fx, fy = parameters[:2] if two else (parameters[0], parameters[0])
    cx, cy, *distortion = parameters[2:] if two else parameters[1:]
    k1, k2, p1, p2 = (*distortion, 0.0, 0.0, 0.0, 0.0)[:4]
    return Camera(width, height, (fx, fy), (cx, cy), (k1, k2, p1, p2))


def _view(raw: _RawView, ids: NDArray[np.int64], order: NDArray[np.int64]) -> View:
    """Return a photo's pose. ids: sorted ids of the model's points, whose rows are `order`."""
    name, camera, (w, x, y, z, *shift), seen = raw
    length = np.sqrt(w * w + x * x + y * y + z * z)
    if not length > 0.0:
        raise MapError(f"photo '{name}' has the rotation 0, 0, 0, 0: export the model again")
    w, x, y, z = (one / length for one in (w, x, y, z))
    matrix = np.eye(4)
    matrix[:3, :3] = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    matrix[:3, 3] = shift
    at = np.minimum(np.searchsorted(ids, seen), len(ids) - 1) if len(ids) else seen * 0
    known = (ids[at] == seen) if len(ids) else np.zeros(len(seen), dtype=bool)
    return View(name, camera, matrix, order[at[known]])
