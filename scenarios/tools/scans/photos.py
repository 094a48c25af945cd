"""Photos of a COLMAP model: undistorted and scaled, split, and compared with drawings."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import MapError, UsageError
from cosim.core.geometry import Floats
from scenarios.tools.scans.colmap import Camera, ColmapModel, View

EACH: Final = 8
"""One photo in so many is held out."""
FIRST: Final = 2
"""Index of the first photo that is held out: the ends of a walked path are seen by few others."""
Picture = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Photo:
    """An undistorted photo.

    rgb: (H, W, 3).
    intrinsics: (3, 3) in pixels; the middle of the first pixel is at 0.5, 0.5.
    matrix: (4, 4) from the model's frame to the camera's: x right, y down, z ahead.
    points: (M,) indices of the model's points that the photo shows.
    """

    name: str
    rgb: Picture
    intrinsics: Floats
    matrix: Floats
    points: NDArray[np.int64]


def photo_folder(folder: Path) -> Path:
    """Return the folder of the photos: `images` in the folder or above it. Raises MapError."""
    for one in (folder, *folder.absolute().parents[:2]):
        if (one / "images").is_dir():
            return one / "images"
    raise MapError(f"{folder}: the folder 'images' with the photos is missing: give --images")


def read_photos(
    model: ColmapModel, folder: Path, size: int, leave_out: Collection[str] = ()
) -> list[Photo]:
    """Return the photos of a model, by name. Raises MapError for a missing or other photo.

    size: longest side in pixels, to which larger photos are scaled.
    leave_out: names of photos to leave out. Raises UsageError for a name that is none.
    """
    names = [view.name for view in model.views]
    if unknown := sorted(set(leave_out) - set(names)):
        raise UsageError(
            f"--leave-out {unknown[0]}: not in the model, which has {', '.join(names)}"
        )
    return [
        _photo(view, model.cameras[view.camera], folder / view.name, size)
        for view in model.views
        if view.name not in leave_out
    ]


def _photo(view: View, camera: Camera, path: Path, size: int) -> Photo:
    import cv2

    raw = cv2.imread(str(path))
    if raw is None:
        raise MapError(f"{path}: is missing or no picture that can be read: give --images")
    if raw.shape[:2] != (camera.height, camera.width):
        raise MapError(
            f"{path}: is {raw.shape[1]} x {raw.shape[0]} pixels, and its camera "
            f"{camera.width} x {camera.height}: give the photos from which the model was made"
        )
    rgb = cv2.cvtColor(raw, cv2.COLOR_BGR2RGB)
    found = np.array(
        [[camera.focal[0], 0, camera.centre[0]], [0, camera.focal[1], camera.centre[1]], [0, 0, 1]]
    )
    if any(camera.distortion):
        rgb, found = _undistorted(rgb, found, camera.distortion)
    scale = size / max(rgb.shape[:2])
    if scale < 1.0:
        height, width = (round(side * scale) for side in rgb.shape[:2])
        found[0] *= width / rgb.shape[1]
        found[1] *= height / rgb.shape[0]
        rgb = cv2.resize(rgb, (width, height), interpolation=cv2.INTER_AREA)
    return Photo(view.name, np.asarray(rgb, dtype=np.uint8), found, view.matrix, view.points)


def _undistorted(
    rgb: Picture, intrinsics: Floats, distortion: Sequence[float]
) -> tuple[Picture, Floats]:
    """Return a photo as a pinhole camera sees it, without empty borders, and its intrinsics."""
    import cv2

    half = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])  # OpenCV's first pixel is at 0, 0
    height, width = rgb.shape[:2]
    bent = np.array(distortion)
    flat, _ = cv2.getOptimalNewCameraMatrix(intrinsics - half, bent, (width, height), 0.0)
    maps = cv2.initUndistortRectifyMap(
        intrinsics - half, bent, None, flat, (width, height), cv2.CV_32FC1
    )
    return cv2.remap(rgb, *maps, interpolation=cv2.INTER_LINEAR), flat + half


def split(photos: Sequence[Photo]) -> tuple[list[Photo], list[Photo]]:
    """Return the photos to train on and those that are held out. Raises MapError for too few."""
    held_out = list(photos[FIRST::EACH])
    if not held_out:
        raise MapError(f"{len(photos)} photos; at least {FIRST + 1} are needed to hold one out")
    names = {photo.name for photo in held_out}
    return [photo for photo in photos if photo.name not in names], held_out


def psnr_db(one: NDArray[np.float32], other: NDArray[np.float32]) -> float:
    """Return the peak signal-to-noise ratio of two pictures with values from 0 to 1, in dB."""
    error = float(np.mean((one.astype(np.float64) - other) ** 2))
    return math.inf if error == 0.0 else -10.0 * math.log10(error)


def fitted(drawn: NDArray[np.float32], photo: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return a drawing (H, W, 3) after the gain and bias per channel that fit it to its photo."""
    found = np.empty_like(drawn)
    for k in range(3):
        x, y = drawn[..., k].ravel().astype(np.float64), photo[..., k].ravel()
        spread = float(x.var())
        gain = float(np.mean((x - x.mean()) * (y - y.mean()))) / spread if spread > 0.0 else 0.0
        found[..., k] = np.clip(gain * (drawn[..., k] - x.mean()) + y.mean(), 0.0, 1.0)
    return found
