"""State of a process that a policy may change for later episodes."""

from __future__ import annotations

import errno
import os
import resource
import sys
from contextlib import suppress
from typing import Final, NamedTuple, NoReturn

_LIMITS: Final = (
    resource.RLIMIT_AS,
    resource.RLIMIT_CPU,
    resource.RLIMIT_DATA,
    resource.RLIMIT_FSIZE,
    resource.RLIMIT_NOFILE,
    resource.RLIMIT_NPROC,
    resource.RLIMIT_STACK,
)
"""Limits of a process that the simulator needs."""
_MAX_TRIED: Final = 1 << 13
"""Number of descriptors that are tried where /proc cannot be read."""


class ProcessState(NamedTuple):
    """State of this process outside of Python. A process whose state changes is replaced.

    limits: soft and hard limits of resources.
    outputs: device and inode of standard output and standard error, if they are open; a file that
        was opened since may have the descriptor of a closed one.
    umask: permissions that new files lack.
    few_descriptors_left: whether more than half of the permitted descriptors are open.
    """

    limits: tuple[tuple[int, int], ...]
    outputs: tuple[tuple[int, int], ...]
    umask: int
    few_descriptors_left: bool

    @classmethod
    def now(cls) -> ProcessState:
        """Return the current state."""
        outputs = []
        for descriptor in (1, 2):
            with suppress(OSError):
                status = os.fstat(descriptor)
                outputs.append((status.st_dev, status.st_ino))
        os.umask(mask := os.umask(0o077))
        limits = tuple(resource.getrlimit(limit) for limit in _LIMITS)
        return cls(limits, tuple(outputs), mask, _few_descriptors_left())


def end_at_once() -> NoReturn:
    """End this process, without what a policy has left for its end: threads and exit functions."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(Exception):
            stream.flush()
    os._exit(0)


def _few_descriptors_left() -> bool:
    most, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    try:
        return len(os.listdir("/proc/self/fd")) > most / 2  # noqa: PTH208  only counted
    except OSError as error:
        if error.errno in (errno.EMFILE, errno.ENFILE):  # not one more can be opened
            return True
    numbers = range(min(most, _MAX_TRIED))  # a sandbox may have no /proc
    return sum(map(_is_open, numbers)) > len(numbers) / 2


def _is_open(descriptor: int) -> bool:
    with suppress(OSError):
        os.fstat(descriptor)
        return True
    return False
