"""The paths that a command is given: one that no file system takes is refused before anything is done."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

from cosim.core.errors import too_long


def with_paths_checked(command: Any) -> Any:
    """The same command of Typer's, and those below it; each raises UsageError first where a path it is given is too
    long."""
    if command.callback is not None:
        command.callback = _checked(command.callback)
    for below in getattr(command, "commands", {}).values():
        with_paths_checked(below)
    return command


def _checked(does: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(does)
    def checks_first(**given: Any) -> Any:
        for value in given.values():
            for one in value if isinstance(value, list | tuple) else (value,):
                if isinstance(one, Path):
                    _check(one)
        return does(**given)

    return checks_first


def _check(path: Path) -> None:
    """Raises UsageError where a name in a path, or all of it, is too long."""
    try:
        os.lstat(path)
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            raise too_long(path) from None
