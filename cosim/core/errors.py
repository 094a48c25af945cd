"""The errors of the project, in one tree, and the exit codes of the command line, one meaning each.

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
SOME_CRASHED = 1
"""The run ended, but not all of it is scored."""
WRONG_USE = 2
BROKEN_MACHINE = 3
INTERRUPTED = 130
UNREAD = 141
"""Nobody reads standard output any more; shells give this code to a program that a closed pipe has
ended."""

MOST_LISTED = 30
"""Of more valid choices than these, five are listed: those most like what was asked for, else the
first."""


_MOST_LETTERS = 100
"""Of a name that is compared with valid ones."""
_SHOWN_LETTERS = 60
"""Of a path that is too long."""
_LONGEST_NAME_BYTES = 255
_LONGEST_PATH_BYTES = 4095


class CosimError(Exception):
    """Root of every error this project raises on purpose. The message says what to do.

    >>> try:
    ...     raise unknown("suite", "long-horizont", ["long-horizon", "reactive"])
    ... except CosimError as error:
    ...     print(error.exit_code, str(error)[:29])
    2 unknown suite 'long-horizont'
    """

    exit_code: ClassVar[int] = BROKEN_MACHINE


class UsageError(CosimError):
    """A name or option that does not exist; the message lists the valid choices."""

    exit_code = WRONG_USE


class SpecError(CosimError, ValueError):
    """A spec that contradicts itself or the place it stands in."""

    exit_code = WRONG_USE


class MapError(CosimError):
    """A street net that cannot be read, built or walked on."""

    exit_code = WRONG_USE


class RunError(CosimError):
    """A run folder that is in use, broken, or belongs to another run."""

    exit_code = WRONG_USE


class AccessError(CosimError):
    """Certificates that do not fit, or a right that this end of a session lacks: trying again
    changes nothing."""

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
    """The shared renderer has ended, or left this environment. number: which renderer of the run it
    was, 0 where that is unknown; asked: what its policy was being asked for this environment, as
    "act at 3.20 s", "" if nothing."""

    def __init__(self, number: int, asked: str = "") -> None:
        super().__init__(
            "the shared renderer has ended: its log in logs/ of the run folder says more"
        )
        self.number = number
        self.asked = asked


class PolicyServerLost(EngineError):
    """The server of a remote policy is gone, or was begun anew: what it knew of the episode is
    lost."""


class MachineError(CosimError):
    """The machine lacks something: room on the disk, a folder that can be written, a library, a
    program."""

    exit_code = BROKEN_MACHINE


def too_long(path: str | Path) -> UsageError:
    """The error for the path of a file or folder that no file system takes."""
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


def of_file(error: OSError) -> CosimError:
    """The error for a file that the system refuses, where nothing more is known of it than its
    path."""
    name = (
        os.fsdecode(error.filename)
        if isinstance(error.filename, str | bytes)
        else str(error.filename)
    )
    return (
        too_long(name)
        if error.errno == errno.ENAMETOOLONG
        else MachineError(f"{name}: {error.strerror}")
    )


def unwritable(path: Path, error: OSError, remedy: str = "") -> MachineError | UsageError:
    """The error for a file or folder that cannot be written. Where its path leads through a file,
    or is one and should be a folder, that is the reason; and unless there is a remedy, another path
    is. Its name may be too long."""
    if error.errno == errno.ENAMETOOLONG:
        return too_long(path)
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
                remedy = remedy or f"choose a place beside it, {beside}"
                break
    return MachineError(
        f"{path}: cannot be written: {reason}: {remedy or 'choose another place, or make room'}"
    )


def unknown(what: str, name: str, choices: Iterable[str]) -> UsageError:
    """The error for a `name` that is none of the `choices`, which it lists: unknown("suite", "x",
    ["unit"])."""
    valid = sorted(choices)
    return UsageError(
        f"unknown {what} '{name}'. Valid choices: {listed(name, valid)}.{nearest(name, valid)}"
    )


def listed(name: str, choices: Iterable[str]) -> str:
    """All choices, or of many how many there are, and those most like the name: "a, b", "312, among
    them a, b"."""
    valid = sorted(choices)
    if len(valid) <= MOST_LISTED:
        return ", ".join(valid) or "none"
    near = get_close_matches(name, valid, n=5, cutoff=0.5)
    return f"{len(valid)}, among them {', '.join(sorted(near) or valid[:5])}"


def nearest(name: str, valid: Iterable[str]) -> str:
    """The question whether the valid name most like this one was meant; "" where none is like
    it."""
    near = get_close_matches(name[:_MOST_LETTERS], sorted(valid), n=1, cutoff=0.5)
    return f" Did you mean {near[0]}?" if near else ""
