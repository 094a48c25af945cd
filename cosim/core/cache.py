"""The cache folder: what lies in it, how large it may become, and what is forgotten.

An entry is a file or a folder that can be made again: a city's net, a street map that was read, the
tiles of a place, baked arrays. Entries are forgotten when they were not used for a month, and those
used longest ago when the folder is larger than its limit. Imported maps count for the limit and are
never forgotten.

What a living process uses stays. Each process lists its entries in a file that it holds locked for
its life; an entry of such a list that was used within the last hour is in use. Entries are listed,
and taken away, under one lock.
"""

from __future__ import annotations

import atexit
import contextlib
import fcntl
import math
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Final, NamedTuple

from platformdirs import user_cache_path

from cosim.core.errors import UsageError

MAKING: Final = ".making-"
"""Names of what is half made begin so."""
LIMIT_VARIABLE: Final = "COSIM_CACHE_LIMIT"
"""The environment variable with the limit in GB."""
_DEFAULT_GB: Final = 4.0
"""Nets and street maps of the hundred cities of the suites take 1 GB of it; the rest is for tiles
and maps."""
GB: Final = 10**9
UNUSED_S: Final = 30 * 86400.0
"""Entries that were not used for longer than this are forgotten."""
_IN_USE_S: Final = 3600.0
"""An entry that a living process has not used for longer than this is not in use."""
_LEFT_OVER_S: Final = 3600.0
"""What is half made for longer than this belongs to a process that was killed."""
_LOOK_EVERY_S: Final = 60.0
"""A process that writes looks for what to forget at first, and then no sooner than after this
time."""
_FORGOTTEN: Final = ".forgotten-"
_LISTS: Final = ".in-use"
_LOCK: Final = ".lock"
_MOST_DEAD: Final = 32
"""Of more lists than this those of dead processes are removed when a further process begins one."""


class CacheKind(NamedTuple):
    """A kind of things in the cache. pattern: of their paths; words: what they are; stays: they are
    never forgotten."""

    name: str
    pattern: str
    words: str
    stays: bool = False


CACHE_KINDS: Final = (
    CacheKind("street maps", "read/*", "what was read from nets"),
    CacheKind("cities", "*.net.xml", "nets built from a seed"),
    CacheKind(
        "tiles", "tiles/*", "ground, buildings and furniture of places, as far as robots came"
    ),
    CacheKind("baked", "baked/*", "textures, skies, motions of people"),
    CacheKind("maps", "maps/*", "imported maps, and places that come with SUMO", stays=True),
    CacheKind("times", "pace.jsonl", "how long episodes took here", stays=True),
)


class CacheEntry(NamedTuple):
    """An entry of the cache: the bytes of the disk that it takes, and when it was last used,
    seconds of the epoch."""

    path: Path
    kind: CacheKind
    size_bytes: int
    used_s: float


class Forgotten(NamedTuple):
    """What was taken away, and what was to be and is in use."""

    entries: tuple[CacheEntry, ...] = ()
    in_use: tuple[CacheEntry, ...] = ()

    @property
    def size_bytes(self) -> int:
        return sum(entry.size_bytes for entry in self.entries)


def cache_folder() -> Path:
    """Return where what was made is kept: $COSIM_CACHE, else the user's cache folder
    (~/.cache/sidewalk-cosim)."""
    return Path(os.environ.get("COSIM_CACHE") or user_cache_path("sidewalk-cosim"))


def cache_limit_bytes() -> int:
    """Return the limit of the cache folder: $COSIM_CACHE_LIMIT in GB, else 4 GB. Raises
    UsageError."""
    text = os.environ.get(LIMIT_VARIABLE) or f"{_DEFAULT_GB:g}"
    try:
        limit_gb = float(text)
    except ValueError:
        limit_gb = math.nan
    if not 0.0 <= limit_gb < math.inf:
        raise UsageError(
            f"{LIMIT_VARIABLE} is '{text}': give a number of GB from 0 on, like "
            f"{_DEFAULT_GB:g} or 0.5"
        )
    return round(limit_gb * GB)


def use_entry(entry: Path) -> None:
    """Say that this process uses an entry now, whether it is there or not: call it before you look.

    Nothing happens where the cache cannot be written.
    """
    with suppress(OSError):
        _uses(cache_folder()).add(entry)
    with suppress(OSError):
        os.utime(entry)


def make_room() -> None:
    """Forget entries, to be called before one is kept: now and then, because it takes as long as to
    make a few."""
    folder = cache_folder()
    now_s = time.monotonic()
    if now_s - _looked_s.get(folder, -math.inf) >= _LOOK_EVERY_S:
        _looked_s[folder] = now_s
        forget_entries()


_looked_s: Final[dict[Path, float]] = {}
"""When this process last looked for what to forget."""


def forget_entries(unused_s: float = UNUSED_S, limit_bytes: int | None = None) -> Forgotten:
    """Take away entries that were not used for so long, those used longest ago beyond the limit,
    and what killed processes have left half made. limit_bytes: by default `cache_limit_bytes`."""
    folder = cache_folder()
    now_s = time.time()
    room = cache_limit_bytes() if limit_bytes is None else limit_bytes
    _sweep(folder, now_s)
    doomed: list[CacheEntry] = []
    entries = cache_entries()
    room -= sum(entry.size_bytes for entry in entries if entry.kind.stays)
    for entry in sorted(entries, key=lambda one: one.used_s, reverse=True):
        if not entry.kind.stays:
            room -= entry.size_bytes
            if room < 0 or now_s - entry.used_s >= unused_s:
                doomed.append(entry)
    return _taken_away(folder, doomed) if doomed else Forgotten()


def cache_entries() -> list[CacheEntry]:
    """Return all entries of the cache folder."""
    folder = cache_folder()
    return [
        CacheEntry(path, kind, _size_bytes(path), _used_s(path))
        for kind in CACHE_KINDS
        for path in sorted(folder.glob(kind.pattern))
        if not path.name.startswith(".")
    ]


def say_not_kept(folder: Path, error: Exception) -> None:
    """Print, once in a process, that something could not be kept in the cache."""
    _say_once(f"note: {folder}: not kept for the next process, which makes it anew: {error}")


@cache
def _say_once(words: str) -> None:
    print(words, file=sys.stderr, flush=True)


class _Uses:
    """The list of the entries that this process uses."""

    def __init__(self, folder: Path) -> None:
        lists = folder / _LISTS
        lists.mkdir(parents=True, exist_ok=True)
        crowded = sum(1 for _ in os.scandir(lists)) > _MOST_DEAD
        self._folder = folder
        self._listed = set[str]()
        with _locked(folder, fcntl.LOCK_EX if crowded else fcntl.LOCK_SH):
            if crowded:
                _remove_dead(lists)
            handle, name = tempfile.mkstemp(prefix=f"{os.getpid()}-", dir=lists)
            self._file = os.fdopen(handle, "a")
            fcntl.flock(self._file, fcntl.LOCK_EX)
        atexit.register(_remove_own, Path(name), os.getpid())

    def add(self, entry: Path) -> None:
        name = entry.relative_to(self._folder).as_posix()
        if name not in self._listed:
            with _locked(self._folder, fcntl.LOCK_SH):
                self._file.write(f"{name}\n")
                self._file.flush()
                with suppress(OSError):
                    os.utime(entry)
            self._listed.add(name)


@cache
def _uses(folder: Path) -> _Uses:
    return _Uses(folder)


@contextmanager
def _locked(folder: Path, how: int) -> Iterator[None]:
    """Hold the lock of a cache folder: shared to list a use, alone to take entries away."""
    with (folder / _LOCK).open("ab") as lock:
        fcntl.flock(lock, how)
        yield


def _taken_away(folder: Path, doomed: list[CacheEntry]) -> Forgotten:
    """Move entries aside that are still as unused as they were, then remove them. Two processes do
    it in turn."""
    gone = []
    kept = []
    try:
        with contextlib.ExitStack() as stack:
            aside = Path(
                stack.enter_context(tempfile.TemporaryDirectory(prefix=_FORGOTTEN, dir=folder))
            )
            with _locked(folder, fcntl.LOCK_EX):
                listed = _listed_by_the_living(folder / _LISTS)
                now_s = time.time()
                for number, entry in enumerate(doomed):
                    used_s = _used_s(entry.path)
                    name = entry.path.relative_to(folder).as_posix()
                    if used_s > entry.used_s or (name in listed and now_s - used_s < _IN_USE_S):
                        kept.append(entry)
                        continue
                    with suppress(OSError):
                        entry.path.rename(aside / str(number))
                        gone.append(entry)
    except OSError:  # a cache that cannot be written is as large as it is
        pass
    return Forgotten(tuple(gone), tuple(kept))


def _listed_by_the_living(lists: Path) -> set[str]:
    _remove_dead(lists)
    listed: set[str] = set()
    for path in lists.iterdir() if lists.is_dir() else ():
        with suppress(OSError):
            listed.update(path.read_text().splitlines())
    return listed


def _remove_dead(lists: Path) -> None:
    """Remove the lists that no process holds locked. To be called by who holds the cache's lock
    alone."""
    for path in lists.iterdir() if lists.is_dir() else ():
        with suppress(OSError), path.open("ab") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            path.unlink()


def _remove_own(path: Path, pid: int) -> None:
    """Remove the list of a process at its end, not at that of one that was forked from it."""
    if os.getpid() == pid:
        path.unlink(missing_ok=True)


def _sweep(folder: Path, now_s: float) -> None:
    """Remove what killed processes have left half made. That of imports is removed by
    `sumo_nets.maps.scratch`."""
    for pattern in (
        f"{_FORGOTTEN}*",
        ".building-*",
        "read/.writing-*",
        f"tiles/{MAKING}*",
        f"baked/{MAKING}*",
    ):
        for path in folder.glob(pattern):
            if now_s - _used_s(path) > _LEFT_OVER_S:
                _remove(path)


def _remove(path: Path) -> None:
    shutil.rmtree(path, ignore_errors=True)
    with suppress(OSError):
        path.unlink()


def _used_s(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:  # another process has just taken it away
        return 0.0


def _size_bytes(path: Path) -> int:
    """Return the bytes that a file takes on the disk, or all files of a folder."""
    try:
        if not path.is_dir():
            return path.stat().st_blocks * 512
        return sum(_size_bytes(Path(one.path)) for one in os.scandir(path))
    except OSError:
        return 0
