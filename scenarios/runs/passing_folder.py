"""Folders in the temporary folder that are gone when their process is, however it ends: who comes
next removes those of the dead."""

from __future__ import annotations

import fcntl
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

_HELD: Final = "held"


@contextmanager
def passing_folder(prefix: str) -> Iterator[Path]:
    """A folder whose name begins so, for this process alone; those that dead processes left under
    such names go first.

    prefix: of folders that are made here. OSError passes."""
    for left in Path(tempfile.gettempdir()).glob(f"{prefix}*"):
        with suppress(OSError), (left / _HELD).open("rb+") as held:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(left)
    with tempfile.TemporaryDirectory(prefix=prefix, ignore_cleanup_errors=True) as name:
        folder = Path(name)
        with (folder / f"{_HELD}.part").open(
            "wb"
        ) as held:  # nobody takes it for left before it is held
            fcntl.flock(held, fcntl.LOCK_EX)
            (folder / f"{_HELD}.part").rename(folder / _HELD)
            yield folder
