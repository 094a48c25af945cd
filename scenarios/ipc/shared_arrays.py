"""Memory that a policy's process reads observations from: sealed, so that it cannot be shrunk under
the writer's hands.

Each question lays its arrays from the beginning; nothing is ever read back from it here.
"""

from __future__ import annotations

import fcntl
import mmap
import os
from typing import Any, Final

import numpy as np

from bridge.policy_server import PackedArray
from cosim.spec.camera import CameraSpec
from cosim.spec.goal import most_goal_bytes
from cosim.spec.manifest import Manifest

_ALIGNED_BYTES: Final = 64
_SEALS: Final = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL
_PER_PIXEL_BYTES: Final = 8
"""Colours, a label and a depth."""


class ObservationMemory:
    """The writer's end. descriptor: to be handed over."""

    def __init__(self, size: int) -> None:
        self.descriptor = os.memfd_create(
            "cosim-observation", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING
        )
        os.ftruncate(self.descriptor, size)
        fcntl.fcntl(self.descriptor, fcntl.F_ADD_SEALS, _SEALS)
        self._map = mmap.mmap(self.descriptor, size)
        self._bytes = np.frombuffer(self._map, np.uint8)

    def lay(self, arrays: dict[str, np.ndarray[Any, Any]]) -> dict[str, PackedArray]:
        """Lay arrays down, and say where. Raises ValueError where there is no room."""
        told = {}
        at = 0
        for name, array in arrays.items():
            flat = np.ascontiguousarray(array).reshape(-1).view(np.uint8)
            self._bytes[at : at + len(flat)] = flat
            told[name] = PackedArray(array.dtype.str, array.shape, at=at)
            at += -(-len(flat) // _ALIGNED_BYTES) * _ALIGNED_BYTES
        return told

    def close(self) -> None:
        del self._bytes
        self._map.close()
        os.close(self.descriptor)


def room_for(manifest: Manifest | None) -> int:
    """Bytes of the largest observation that a policy may ask for; of none for a policy that is not
    asked."""
    if manifest is None:
        return mmap.PAGESIZE
    cameras: list[CameraSpec] = [
        *([] if manifest.camera is None else [manifest.camera]),
        *manifest.cameras.values(),
    ]
    sizes = [width * height for width, height in (camera.size for camera in cameras)]
    arrays = 3 * len(sizes) + 1
    goal = most_goal_bytes(manifest.picture_size)
    return mmap.PAGESIZE + _PER_PIXEL_BYTES * sum(sizes) + goal + _ALIGNED_BYTES * arrays
