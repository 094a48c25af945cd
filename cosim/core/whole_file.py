"""Files written whole or not at all, whenever a process dies; and files read whole, within
bounds."""

from __future__ import annotations

import os
import stat
from pathlib import Path


def write_whole(path: Path, data: bytes) -> None:
    """Write a file beside its place, to the disk, and move it there. OSError passes."""
    temporary = path.with_name(path.name + ".part")
    with temporary.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)


def size_within(path: Path, most_bytes: int) -> int:
    """How many bytes a file holds. Raises ValueError for more, and for a folder, a pipe or a
    device; OSError passes."""
    about = path.stat()
    if not stat.S_ISREG(about.st_mode):
        raise ValueError("is no regular file")
    if about.st_size > most_bytes:
        raise ValueError(f"holds {about.st_size} bytes; at most {most_bytes} are read")
    return about.st_size


def read_within(path: Path, most_bytes: int) -> bytes:
    """All of a file, unless it is too large. Raises as `size_within` does."""
    size_within(path, most_bytes)
    return path.read_bytes()
