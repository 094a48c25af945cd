"""System calls of a sandbox's set-up, and how a process gives up its rights."""

from __future__ import annotations

import ctypes
import os
import platform
import struct
from contextlib import suppress
from typing import Any, Final

from scenarios.ipc import seccomp

_LIBC: Final = ctypes.CDLL(None, use_errno=True)
DEATH_SIGNAL, DUMPABLE, _KEEP_CAPABILITIES, _DROP_BOUND, _NO_PRIVILEGES, _AMBIENT = (
    *(1, 4, 8),
    *(24, 38, 47),
)
"""Operations of `prctl`."""
_READ_ANY: Final = 2
"""The capability to read files of any user."""


class SandboxError(Exception):
    """A step of the set-up that failed, with its reason."""


def call(step: str, name: str, *arguments: Any) -> int:
    """Make a system call. Raises SandboxError that names the step."""
    numbers = seccomp.NUMBERS[name]
    number = numbers[seccomp.MACHINES[platform.machine()][0]]
    sent = [ctypes.c_long(one) if isinstance(one, int) else one for one in arguments]
    made: int = _LIBC.syscall(ctypes.c_long(number or -1), *sent)
    if made < 0:
        raise SandboxError(f"{step}: {os.strerror(ctypes.get_errno())}")
    return made


def prctl(step: str, *arguments: int) -> None:
    """Set a property of this process. Raises SandboxError that names the step."""
    if _LIBC.prctl(*map(ctypes.c_ulong, (*arguments, *[0] * (5 - len(arguments))))) != 0:
        raise SandboxError(f"{step}: {os.strerror(ctypes.get_errno())}")


def drop_privileges(user: int | None) -> None:
    """Give up all rights of this process permanently.

    Root becomes a user without an account. This user may read files of any user that the sandbox
    shows, if root may.
    """
    retained = 0 if user is None else (1 << _READ_ANY) & _permitted()
    for capability in range(64):
        if not retained >> capability & 1:
            with suppress(SandboxError):  # of an older kernel, or not root's
                prctl("drop capabilities", _DROP_BOUND, capability)
    if user is not None:
        prctl("keep a capability", _KEEP_CAPABILITIES, 1)
        os.setgroups([])
        os.setresgid(user, user, user)
        os.setresuid(user, user, user)
    head = ctypes.create_string_buffer(struct.pack("Ii", 0x20080522, 0))
    sets = ctypes.create_string_buffer(struct.pack("6I", retained, retained, retained, 0, 0, 0))
    if _LIBC.capset(head, sets) != 0:
        raise SandboxError(f"drop capabilities: {os.strerror(ctypes.get_errno())}")
    if retained:
        prctl("keep a capability", _AMBIENT, 2, _READ_ANY)
    prctl("forbid new privileges", _NO_PRIVILEGES, 1)


def _permitted() -> int:
    """Return the lower 32 permitted capabilities of this process, as bits."""
    head = ctypes.create_string_buffer(struct.pack("Ii", 0x20080522, 0))
    sets = ctypes.create_string_buffer(24)
    return int(struct.unpack("6I", sets.raw)[1]) if _LIBC.capget(head, sets) == 0 else 0


def filter_calls(rules: list[seccomp.Rule]) -> None:
    """Deny system calls to this process and all that it starts. Raises SandboxError."""
    try:
        seccomp.installed(rules, platform.machine())
    except OSError as error:
        raise SandboxError(f"filter system calls (seccomp): {error.strerror}") from None
