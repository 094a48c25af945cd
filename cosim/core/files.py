"""Write files and folders atomically, lock them, and read files with a size limit."""

from __future__ import annotations

import errno
import fcntl
import os
import secrets
import shutil
import stat
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

if TYPE_CHECKING:
    from filelock import FileLock

UNFINISHED_PREFIX: Final = ".making-"
"""Prefix of unfinished folders, and of unfinished files that several processes write."""
_LOCK_FILE: Final = ".held"
"""File in a temporary folder that its process locks."""
_OLD: Final = ".old"
"""Folder in a temporary folder that holds the replaced folder."""
_OCCUPIED: Final = (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR)
"""Errors of renaming a folder to a name that is in use. By now it may be free again."""
_IN_USE_S: Final = 3600.0
"""Age in seconds below which an unfinished file or unlocked folder counts as in use."""


def lock(path: Path, *, wait: bool = True) -> FileLock:
    """Return a file lock; the file is created. The lock is released when its process ends.

    wait: block until the lock is free. Otherwise acquiring it raises TimeoutError.
    """
    from filelock import FileLock

    timeout_s = -1.0 if wait else 0.0
    return FileLock(path, timeout=timeout_s, thread_local=False, poll_interval=0.01)


def is_locked(path: Path) -> bool:
    """Return whether a process holds the lock of a file. The file only has to be readable."""
    try:
        descriptor = os.open(path, os.O_RDONLY)
    except FileNotFoundError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(descriptor)
    return False


@contextmanager
def atomic_file(path: Path, *, shared: bool = False) -> Iterator[Path]:
    """Yield a path to write to; it replaces `path` at the end of the block, or is removed on error.

    shared: several processes may write the file at once. It is not flushed to disk, as for a file
        that can be made again.
    """
    part = path.with_name(
        UNFINISHED_PREFIX + secrets.token_hex(8) if shared else f"{path.name}.part"
    )
    try:
        yield part
        if not shared:
            with part.open("rb") as file:
                os.fsync(file.fileno())
        part.replace(path)
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)


def write_atomic(path: Path, data: bytes, *, shared: bool = False) -> None:
    """Write a file atomically. `shared` is as in `atomic_file`. Raises OSError."""
    with atomic_file(path, shared=shared) as part:
        part.write_bytes(data)


@contextmanager
def temp_folder(prefix: str, parent: Path | None = None) -> Iterator[Path]:
    """Yield a temporary folder, removed at the end of the block or by the next process that makes
    one.

    prefix: start of the names of such folders, and of no others in `parent`.
    parent: by default the system's temporary folder.
    """
    parent = parent or Path(tempfile.gettempdir())
    parent.mkdir(parents=True, exist_ok=True)
    remove_dead(parent, prefix)
    with tempfile.TemporaryDirectory(prefix=prefix, dir=parent, ignore_cleanup_errors=True) as name:
        folder = Path(name)
        new = folder / f"{_LOCK_FILE}.new"
        with lock(new):
            new.rename(folder / _LOCK_FILE)  # locked before other processes can see it
            try:
                yield folder
            finally:
                _restore(folder)


@contextmanager
def atomic_folder(
    target: Path, *, existing: Literal["replace", "keep", "refuse"] = "replace"
) -> Iterator[Path]:
    """Yield an empty folder that becomes `target` at the end of the block, or is removed on error.

    existing: policy for a folder that exists by then: replace it, keep it, or raise OSError. An
        empty one is always replaced.
    """
    with temp_folder(UNFINISHED_PREFIX, target.parent) as scratch:
        made = scratch / target.name
        made.mkdir()
        yield made
        old = scratch / _OLD / target.name
        while True:  # other processes may create it at any moment
            try:
                made.rename(target)
                return
            except OSError as error:
                if existing == "refuse" or error.errno not in _OCCUPIED:
                    raise
            if existing == "keep":
                if target.exists():
                    return
                continue
            shutil.rmtree(old, ignore_errors=True)
            old.parent.mkdir(exist_ok=True)
            with suppress(FileNotFoundError):
                target.rename(old)


def folder_holds(target: Path, name: str) -> bool:
    """Return whether a folder of `atomic_folder` holds a file, after waiting for a replacement."""
    for _ in range(100):
        if (target / name).exists():
            return True
        if not any(
            (one / _OLD / target.name).exists()
            for one in target.parent.glob(f"{UNFINISHED_PREFIX}*")
        ):
            break
        remove_dead(target.parent, UNFINISHED_PREFIX)
        time.sleep(0.01)
    return (target / name).exists()


def remove_dead(parent: Path, prefix: str) -> None:
    """Remove unfinished files and temporary folders whose processes have ended.

    A folder that such a process was replacing is restored.
    """
    for leftover in parent.glob(f"{prefix}*"):
        with suppress(OSError):
            recent = time.time() - leftover.stat().st_mtime < _IN_USE_S
            if not leftover.is_dir():
                if not recent:
                    leftover.unlink()
            elif not (
                is_locked(leftover / _LOCK_FILE) if (leftover / _LOCK_FILE).exists() else recent
            ):
                _restore(leftover)
                shutil.rmtree(leftover)


def _restore(scratch: Path) -> None:
    """Restore a folder that was moved away and has no successor."""
    for old in (scratch / _OLD).glob("*"):
        target = scratch.parent / old.name
        if not target.exists():
            with suppress(OSError):
                old.rename(target)


def checked_size(path: Path, max_bytes: int) -> int:
    """Return the size of a file in bytes. Raises OSError.

    Raises ValueError for a larger file, and for a folder, a pipe or a device.
    """
    about = path.stat()
    if not stat.S_ISREG(about.st_mode):
        raise ValueError("is no regular file")
    if about.st_size > max_bytes:
        raise ValueError(f"holds {about.st_size} bytes; at most {max_bytes} are read")
    return about.st_size


def read_limited(path: Path, max_bytes: int) -> bytes:
    """Read a whole file, unless it is too large. Raises as `checked_size` does."""
    checked_size(path, max_bytes)
    return path.read_bytes()
