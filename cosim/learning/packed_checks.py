"""Requirements of both networks for packed demonstrations."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import RunError
from cosim.core.packed_demos import Packed
from cosim.learning.network import WAYPOINTS

_LISTED: Final = ("policy", "learner", "explorer")
"""Metadata with a value for each data set."""


def common_meta(
    paths: Sequence[Path], packed: Sequence[Packed], same: Sequence[str]
) -> dict[str, Any]:
    """Return the metadata of all files, with the drivers of all of them.

    same: fields that must be equal. Raises RunError if one is not.
    """
    meta = dict(packed[0].meta)
    for path, other in zip(paths[1:], packed[1:], strict=True):
        for field in same:
            if other.meta.get(field) != meta.get(field):
                raise RunError(
                    f"{path}: {field} is {other.meta.get(field)}, and {meta.get(field)} in "
                    f"{paths[0]}: train on demonstrations that were collected alike"
                )
    return meta | {
        name: [value for one in packed for value in one.meta.get(name, [])] for name in _LISTED
    }


def check_rows(path: Path, packed: Packed) -> None:
    """Raise RunError if a file has no rows, too few waypoints or goals that are no points."""
    if not len(packed):
        raise RunError(f"{path}: holds no demonstration: collect more episodes")
    ahead = packed.waypoints.shape[1]
    if ahead < WAYPOINTS:
        raise RunError(f"{path}: {ahead} waypoints a row, wanted are {WAYPOINTS}")
    if np.isnan(packed.goal).any():
        raise RunError(
            f"{path}: goals are no points ({packed.meta.get('goal')}): cosim collect --goal "
            f"route_point"
        )


def check_pictures(path: Path, frames: NDArray[np.uint8], size_px: tuple[int, int]) -> None:
    """Raise RunError if pictures (N, H, W, 3) have another size than the network's input.

    size_px: width and height
    """
    high, wide = frames.shape[1:3]
    if (wide, high) != size_px:
        raise RunError(
            f"{path}: pictures of {wide} x {high} pixels, wanted are {size_px[0]} x {size_px[1]}: "
            f"cosim collect --camera {size_px[0]}x{size_px[1]}"
        )
