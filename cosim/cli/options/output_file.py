"""The option that names a file to be written: refused before anything is made."""

from __future__ import annotations

from pathlib import Path

from cosim.core.errors import UsageError, unwritable

PICTURES = (".png", ".jpg", ".jpeg")


def replaced(path: Path | None) -> str:
    """Asked before a file is written, what is said of it afterwards: that it took another's place, or nothing."""
    return ", in place of the one that was there" if path is not None and path.exists() else ""


def check_output(path: Path, what: str = "a picture", endings: tuple[str, ...] = PICTURES) -> None:
    """Before it is made: raises UsageError when no such file can have this name, MachineError without its folder."""
    if path.suffix.lower() not in endings:
        raise UsageError(f"{path}: cannot be written as {what}; use a name that ends in {' or '.join(endings[:2])}")
    if not path.resolve().parent.is_dir():
        raise unwritable(path, NotADirectoryError(f"no folder {path.parent}"))
