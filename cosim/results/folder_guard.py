"""Guard of a run folder: finds and repairs it if a policy of this user has moved or deleted it."""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from pathlib import Path
from typing import Final

_OWNER_RWX: Final = 0o700
"""Permissions that the owner of a run folder needs."""


class FolderGuard:
    """Guard of one open folder.

    path: where the folder must be.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._descriptor = os.open(path, os.O_PATH | os.O_DIRECTORY)

    @property
    def _opened(self) -> Path:
        """Path of the open folder, wherever it is now."""
        return Path(f"/proc/self/fd/{self._descriptor}")

    def close(self) -> None:
        os.close(self._descriptor)

    def mend(self) -> bool:
        """Move the folder back to its path if it was renamed, or create it if it was deleted.

        Returns whether its files may be lost. Raises OSError if it cannot be created.
        """
        found = _identity(self.path)
        if found is not None and found == _identity(self._opened):
            if not os.access(self.path, os.R_OK | os.W_OK | os.X_OK):
                self.path.chmod(_OWNER_RWX)
            return False
        now_at = self._opened.readlink()
        if now_at.is_dir() and _identity(now_at) == _identity(self._opened):
            self._move_back(now_at)
            return False
        self.path.mkdir(parents=True, exist_ok=True)
        os.close(self._descriptor)
        self._descriptor = os.open(self.path, os.O_PATH | os.O_DIRECTORY)
        return True

    def _move_back(self, now_at: Path) -> None:
        """Rename the folder, and add the files of the one that took its place."""
        other = now_at.with_name(f"{self.path.name}.other")
        if self.path.exists():
            self.path.rename(other)
        now_at.rename(self.path)
        for file in [one for one in other.rglob("*") if one.is_file()]:
            target = self.path / file.relative_to(other)
            with suppress(OSError):
                target.parent.mkdir(parents=True, exist_ok=True)
                if not target.exists():
                    file.rename(target)
        shutil.rmtree(other, ignore_errors=True)


def _identity(file: Path) -> tuple[int, int] | None:
    """Return device and inode of a folder; None without one."""
    try:
        status = file.stat()
    except OSError:
        return None
    return status.st_dev, status.st_ino
