"""Anonymous sealed memory shared by two processes of a machine, freed when both have closed it.

64 bytes   header with a few numbers
the rest   arrays of one message, each aligned to 64 bytes
"""

from __future__ import annotations

import fcntl
import math
import mmap
import os
from contextlib import suppress
from typing import Any, Final, Self

import numpy as np

from bridge.policy_server import PackedArray, unpack_array
from cosim.spec.goal import max_goal_bytes
from cosim.spec.manifest import Manifest
from cosim.spec.sensors import MAX_TRACKS

HEAD_BYTES: Final = 64
"""Bytes of the header."""
_ALIGNED_BYTES: Final = 64
"""Alignment of arrays in bytes."""
_SEALS: Final = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL
"""Seals that fix the size: a smaller file would crash the process that maps it."""
_PER_PIXEL_BYTES: Final = 8
"""Bytes of a pixel's color, label and depth."""
_PER_TRACK_BYTES: Final = 20
"""Bytes of a tracked person's id, position and velocity."""


class SharedMemory:
    """One end of shared memory. descriptor: to be passed to the other end. map: the bytes."""

    def __init__(self, descriptor: int, *, writes: bool = True) -> None:
        self.descriptor = descriptor
        protection = mmap.PROT_READ | (mmap.PROT_WRITE if writes else 0)
        self.map = mmap.mmap(descriptor, os.fstat(descriptor).st_size, prot=protection)

    @classmethod
    def new(cls, size: int = 0) -> Self:
        """Create memory with a header and space for size bytes of arrays."""
        descriptor = os.memfd_create("cosim", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        os.ftruncate(descriptor, HEAD_BYTES + size)
        fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, _SEALS)
        return cls(descriptor)

    def write_arrays(self, arrays: dict[str, np.ndarray[Any, Any]]) -> dict[str, PackedArray]:
        """Write arrays over the last ones, and return their locations. Raises ValueError without
        enough space."""
        locations = {}
        at = HEAD_BYTES
        for name, array in arrays.items():
            flat = np.ascontiguousarray(array).reshape(-1).view(np.uint8)
            if at + len(flat) > len(self.map):
                raise ValueError(
                    f"no space for {name} of shape {array.shape} in {len(self.map)} bytes"
                )
            self.map[at : at + len(flat)] = flat.data
            locations[name] = PackedArray(array.dtype.str, array.shape, at=at)
            at += -(-len(flat) // _ALIGNED_BYTES) * _ALIGNED_BYTES
        return locations

    def read_arrays(self, locations: dict[str, PackedArray]) -> dict[str, Any]:
        """Return copies of arrays. Raises ValueError for an invalid location."""
        return {name: unpack_array(array, self.map) for name, array in locations.items()}

    @property
    def busy(self) -> bool:
        """Return whether a policy call for this environment is pending, or was when the renderer
        ended."""
        return bool(self.map[0])

    @busy.setter
    def busy(self, now: bool) -> None:
        self.map[0] = now

    def close(self) -> None:
        """Unmap it and close the descriptor."""
        with suppress(OSError):  # a policy may have closed it already
            os.close(self.descriptor)
        self.map.close()


def observation_bytes(manifest: Manifest | None) -> int:
    """Return the bytes of the largest observation by a manifest; 0 without one.

    >>> observation_bytes(None)
    0
    """
    if manifest is None:
        return 0
    first = [] if manifest.camera is None else [manifest.camera]
    sizes = [math.prod(camera.size) for camera in (*first, *manifest.cameras.values())]
    goal = max_goal_bytes(manifest.picture_size)
    spec = manifest.scan
    scan = 0 if spec is None else 4 * spec.rings * spec.rays
    tracks = 0 if manifest.people == "none" else _PER_TRACK_BYTES * MAX_TRACKS
    return (
        _PER_PIXEL_BYTES * sum(sizes) + goal + scan + tracks + _ALIGNED_BYTES * (3 * len(sizes) + 5)
    )
