"""Exception classes of the project and exit codes of the command line.

CosimError                what a user can mend: shown as one message
├── UsageError         2  a name or option that does not exist, or a policy that cannot be loaded
├── SpecError          2  a scenario, suite or place that contradicts itself (also a ValueError)
├── MapError           2  a street net that cannot be read or built
├── RunError           2  a run folder that is locked, broken or of another run
├── AccessError        2  certificates that do not fit, or a right that is lacking
├── PolicyError        1  a policy that raised, or answered with something unusable
├── EngineError        3  SUMO, PyBullet or Zenoh failed or was misused
│   ├── DirectorLost   3  the director of the event pedestrians did not answer
│   ├── RendererLost   3  the shared renderer has ended
│   └── PolicyServerLost 3  the server of a remote policy has ended, or lost the episode
└── MachineError       3  a full disk, a folder that cannot be written, a missing library or program
"""

from __future__ import annotations

import errno
import os
from collections.abc import Iterable
from difflib import get_close_matches
from pathlib import Path
from typing import ClassVar

ALL_SCORED = 0
"""Exit code of a run whose episodes are all scored."""
SOME_CRASHED = 1
"""Exit code of a finished run in which some episodes are not scored."""
WRONG_USE = 2
"""Exit code for wrong input."""
BROKEN_MACHINE = 3
"""Exit code for a failed engine or machine."""
TIME_IS_UP = 4
"""Exit code of a collection or training that --minutes ended; --resume continues it."""
INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells use it."""
BROKEN_PIPE = 141
"""Exit code when the reader of standard output has closed the pipe, as shells use it."""

MAX_LISTED = 40
"""Maximum number of valid choices that a message lists in full; of more, it lists five."""


_MAX_LETTERS = 100
"""Maximum length of a name that is compared with valid ones, in characters."""
_SHOWN_LETTERS = 60
"""Maximum length of a too long path in a message, in characters."""
_LONGEST_NAME_BYTES = 255
"""Maximum length of a file name on Linux, in bytes."""
_LONGEST_PATH_BYTES = 4095
"""Maximum length of a path on Linux, in bytes."""


class CosimError(Exception):
    """Base class of all errors that the project raises on purpose. The message says what to do.

    >>> try:
    ...     raise unknown("suite", "long-horizont", ["long-horizon", "reactive"])
    ... except CosimError as error:
    ...     print(error.exit_code, str(error)[:29])
    2 unknown suite 'long-horizont'
    """

    exit_code: ClassVar[int] = BROKEN_MACHINE


class UsageError(CosimError):
    """A name or option that does not exist. The message lists the valid choices."""

    exit_code = WRONG_USE


class SpecError(CosimError, ValueError):
    """A spec that contradicts itself or its place."""

    exit_code = WRONG_USE


class MapError(CosimError):
    """A street net that cannot be read, built or walked on."""

    exit_code = WRONG_USE


class RunError(CosimError):
    """A run folder that is in use, broken, or belongs to another run."""

    exit_code = WRONG_USE


class AccessError(CosimError):
    """Certificates that do not match, or a missing right. A retry does not help."""

    exit_code = WRONG_USE


class PolicyError(CosimError):
    """A policy that raised, or whose answer is not a command."""

    exit_code = SOME_CRASHED


class EngineError(CosimError):
    """An engine (SUMO, PyBullet, Zenoh) that failed or was misused."""

    exit_code = BROKEN_MACHINE


class DirectorLost(EngineError):
    """The director of the event pedestrians did not answer in time."""


class RendererLost(EngineError):
    """The shared renderer has exited or closed the connection to this environment.

    number: number of the renderer in its run, 0 if unknown.
    asked: pending policy call of this environment, such as "act at 3.20 s"; "" if none.
    """

    def __init__(self, number: int, asked: str = "") -> None:
        super().__init__(
            "the shared renderer has ended: its log in logs/ of the run folder says more"
        )
        self.number = number
        self.asked = asked


class PolicyServerLost(EngineError):
    """The server of a remote policy has exited or restarted, and lost the state of the episode."""


class MachineError(CosimError):
    """The machine lacks something: disk space, a writable folder, a library, a program."""

    exit_code = BROKEN_MACHINE


def path_too_long(path: str | Path) -> UsageError:
    """Return the error for a path that is too long for any file system."""
    size = max(len(os.fsencode(part)) for part in Path(path).parts)
    shown = str(path) if len(str(path)) <= _SHOWN_LETTERS else f"{str(path)[:_SHOWN_LETTERS]}..."
    what = (
        f"a name in it has {size} bytes"
        if size > _LONGEST_NAME_BYTES
        else f"it has {len(os.fsencode(path))} bytes"
    )
    return UsageError(
        f"{shown}: the path is too long: {what}. A name may have {_LONGEST_NAME_BYTES} bytes, and "
        f"a path {_LONGEST_PATH_BYTES}: choose a shorter one"
    )


def file_error(error: OSError) -> CosimError:
    """Return the error for a file that the system refuses, when only its path is known."""
    name = (
        os.fsdecode(error.filename)
        if isinstance(error.filename, str | bytes)
        else str(error.filename)
    )
    return (
        path_too_long(name)
        if error.errno == errno.ENAMETOOLONG
        else MachineError(f"{name}: {error.strerror}")
    )


def unwritable(path: Path, error: OSError, remedy: str = "") -> MachineError | UsageError:
    """Return the error for a file or folder that cannot be written.

    If a part of its path is a file, the message says so. A name that is too long has an error of
    its own.

    remedy: advice that replaces the default one.
    """
    if error.errno == errno.ENAMETOOLONG:
        return path_too_long(path)
    reason = error.strerror or str(error)
    if isinstance(error, FileExistsError | NotADirectoryError):
        for file in (path, *path.parents):
            if file.is_file():
                reason = f"{file} is a file, no folder"
                beside = (
                    f"like {file.parent / path.relative_to(file)}"
                    if file != path
                    else "with another name"
                )
                remedy = remedy or f"choose a path next to it, {beside}"
                break
    return MachineError(
        f"{path}: cannot be written: {reason}: {remedy or 'choose another place, or make room'}"
    )


def unknown(what: str, name: str, choices: Iterable[str]) -> UsageError:
    """Return the error for a name that is none of the choices.

    what: kind of name, such as "suite".
    choices: the valid names, which the message lists.
    """
    valid = sorted(choices)
    return UsageError(
        f"unknown {what} '{name}'. Valid choices: {listed(name, valid)}.{nearest(name, valid)}"
    )


def listed(name: str, choices: Iterable[str]) -> str:
    """Return all choices in one line; of many, their number and the most similar ones."""
    valid = sorted(choices)
    if len(valid) <= MAX_LISTED:
        return ", ".join(valid) or "none"
    near = get_close_matches(name, valid, n=5, cutoff=0.5)
    return f"{len(valid)}, among them {', '.join(sorted(near) or valid[:5])}"


def nearest(name: str, valid: Iterable[str]) -> str:
    """Return a question that suggests the most similar valid name; "" if none is similar."""
    near = get_close_matches(name[:_MAX_LETTERS], sorted(valid), n=1, cutoff=0.5)
    return f" Did you mean {near[0]}?" if near else ""
