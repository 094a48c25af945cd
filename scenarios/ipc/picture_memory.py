"""The shared memory of one environment and the renderer: its last picture, and whether its policy
is being asked.

    64 bytes      the first is 1 while the policy is asked for this environment
    H x W x 3     colours
    H x W         labels

It has no name: the renderer makes it and hands its descriptor over, so that nothing is left of it
when both have ended, however they did. Its size is sealed: no environment can shrink it under the
renderer's hands.
"""

from __future__ import annotations

import fcntl
import mmap
import os
from contextlib import suppress
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from cosim.core.state import Frame

_HEAD_BYTES: Final = 64
_SEALS: Final = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL


class PictureMemory:
    """One end. size: width, height of the pictures; (0, 0) where there are none."""

    def __init__(self, descriptor: int, size: tuple[int, int]) -> None:
        self.descriptor = descriptor
        width, height = size
        self._map = mmap.mmap(descriptor, _HEAD_BYTES + 4 * width * height)
        pixels = np.frombuffer(self._map, np.uint8, offset=_HEAD_BYTES)
        self._rgb: NDArray[np.uint8] = pixels[: 3 * width * height].reshape(height, width, 3)
        self._labels: NDArray[np.uint8] = pixels[3 * width * height :].reshape(height, width)

    @classmethod
    def new(cls, size: tuple[int, int]) -> Self:
        """Memory that nobody else has yet."""
        descriptor = os.memfd_create("cosim-picture", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        os.ftruncate(descriptor, _HEAD_BYTES + 4 * size[0] * size[1])
        fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, _SEALS)
        return cls(descriptor, size)

    def put(self, frame: Frame) -> None:
        """Lay a picture down for the other end."""
        assert frame.labels is not None
        self._rgb[:], self._labels[:] = frame.rgb, frame.labels

    def take(self) -> Frame:
        """A copy of the picture."""
        return Frame(self._rgb.copy(), self._labels.copy())

    @property
    def asked(self) -> bool:
        """Whether the policy is being asked for this environment, or was when the renderer
        ended."""
        return bool(self._map[0])

    @asked.setter
    def asked(self, now: bool) -> None:
        self._map[0] = now

    def close(self) -> None:
        """Give it up; the memory itself goes when the other end does the same."""
        with suppress(OSError):  # a policy can close it, too
            os.close(self.descriptor)
        del self._rgb, self._labels
        self._map.close()
