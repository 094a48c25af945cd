"""Folders that appear whole or not at all: made in a scratch folder, then moved into place.

A process that dies leaves its scratch folder behind; whoever comes next sweeps it away.
"""

from __future__ import annotations

import fcntl
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

PREFIX = ".making-"
HELD = ".held"
YOUNG_S = 3600.0
"""A scratch folder that nobody holds may be one that was made a moment ago."""


@contextmanager
def scratch_in(folder: Path) -> Iterator[Path]:
    """A scratch folder inside `folder`, gone at the end; those of processes that died go first.
    OSError passes."""
    folder.mkdir(parents=True, exist_ok=True)
    sweep(folder)
    with tempfile.TemporaryDirectory(prefix=PREFIX, dir=folder) as name:
        scratch = Path(name)
        with (scratch / HELD).open("wb") as held:
            fcntl.flock(held, fcntl.LOCK_EX)
            yield scratch


def move_in(ready: Path, target: Path, *, in_place: bool = True) -> None:
    """Move a finished folder, which lies in a scratch folder, to where it is used.

    in_place: of the one that is there; else that one stays.
    """
    with moving(target.parent):
        if target.exists() and not in_place:
            return
        if target.exists():
            old = ready.parent / "old"
            old.mkdir(exist_ok=True)
            target.rename(old / target.name)
        ready.rename(target)


@contextmanager
def moving(folder: Path) -> Iterator[None]:
    """Only one process at a time moves finished folders in `folder`; others wait the moment that it
    takes."""
    with (folder.parent / f".{folder.name}.lock").open("wb") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def sweep(folder: Path) -> None:
    """Remove the scratch folders that no process holds any more; what was being replaced when one
    died is put back."""
    for scratch in folder.glob(f"{PREFIX}*"):
        with suppress(OSError):
            if not (scratch / HELD).exists() and time.time() - scratch.stat().st_mtime < YOUNG_S:
                continue
            with (scratch / HELD).open("ab") as held:
                fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
                with moving(folder):
                    for old in (scratch / "old").glob("*"):
                        if not (folder / old.name).exists():
                            old.rename(folder / old.name)
                shutil.rmtree(scratch)
