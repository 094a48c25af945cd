"""Loading of user-supplied skies: equirectangular Radiance pictures."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import SpecError
from cosim.core.files import read_limited
from cosim.core.geometry import Floats
from physics.cameras.clearsky import LUMINANCE

_Image = NDArray[np.float32]

ROWS_MAX = 512
"""Rows above which pictures are averaged down; a sky appears blurred anyway."""
_MAX_BYTES = 1 << 30
_SPOT_RAD = math.radians(4.0)


def read_hdri(path: str) -> _Image:
    """Load (H, 2H, 3) linear radiance of a Radiance .hdr picture.

    Raises SpecError naming the file and the fault.
    """
    file = Path(path)
    if not file.is_file():
        raise SpecError(f"hdri '{path}' does not exist")
    try:
        data = np.frombuffer(read_limited(file, _MAX_BYTES), np.uint8)
    except (OSError, ValueError) as error:
        raise SpecError(
            f"hdri '{path}' cannot be read: {getattr(error, 'strerror', error)}"
        ) from error
    if data[:2].tobytes() != b"#?":
        raise SpecError(f"hdri '{path}' is no Radiance picture: it does not begin with '#?'")
    try:
        picture = cv2.imdecode(data, cv2.IMREAD_ANYDEPTH | cv2.IMREAD_COLOR)
    except cv2.error:
        picture = None
    if picture is None or picture.size == 0:
        raise SpecError(f"hdri '{path}' cannot be decoded: it is cut short or damaged")
    rows, columns = picture.shape[:2]
    if columns != 2 * rows or rows < 16:
        raise SpecError(
            f"hdri '{path}' is {columns} x {rows} pixels; an equirectangular sky is 2:1, "
            f"from 32 x 16"
        )
    rgb = np.asarray(picture[..., ::-1], dtype=np.float32)
    if not np.isfinite(rgb).all() or rgb.min() < 0.0:
        raise SpecError(f"hdri '{path}' holds values that are not finite or below 0")
    if not rgb[: rows // 2].max() > 0.0:
        raise SpecError(f"hdri '{path}' is black above the horizon: there is no light in it")
    if rows > ROWS_MAX:
        rgb = cv2.resize(rgb, (2 * ROWS_MAX, ROWS_MAX), interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(rgb)


def brightest(picture: _Image, ways: Floats) -> tuple[Floats, Floats, _Image]:
    """Find the brightest spot above the horizon and remove it from the picture.

    Returns its direction (3,), its light (3,), and the picture without it.
    The light is the radiance of a white surface that faces the spot.
    Removal subtracts the excess over the ring around the spot.
    """
    rows = len(picture)
    light = picture.astype(float) @ LUMINANCE
    light[rows // 2 :] = 0.0
    soft = cv2.GaussianBlur(light, (0, 0), max(rows / 256.0, 0.8), borderType=cv2.BORDER_REFLECT)
    top = np.unravel_index(int(np.argmax(soft)), soft.shape)
    near = ways @ ways[top] > math.cos(_SPOT_RAD)
    weight = np.where(near, light, 0.0)
    towards = (ways * weight[..., None]).sum(axis=(0, 1))
    towards /= np.linalg.norm(towards)
    apart = np.arccos(np.clip(ways @ towards, -1.0, 1.0))
    spot = apart < _SPOT_RAD
    ring = (apart >= _SPOT_RAD) & (apart < 2.0 * _SPOT_RAD)
    around = np.median(picture[ring], axis=0)
    more = np.where(spot[..., None], np.maximum(picture - around, 0.0), 0.0)
    solid = (math.pi / rows) ** 2 * np.sqrt(np.maximum(1.0 - ways[..., 2] ** 2, 0.0))
    beam = (more * solid[..., None]).sum(axis=(0, 1)) / math.pi
    return towards, beam.astype(float), (picture - more).astype(np.float32)
