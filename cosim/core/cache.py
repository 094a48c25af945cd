"""On-disk cache of files, arrays and array sets that can be made again, with a size limit.

Cached files start with a hash of their content; damaged files are made again. If the cache cannot
be written, a note is printed on standard error and work continues without it.

An entry is a file or a folder: a city's net, a parsed street map, the tiles of a place, an array
set. Entries unused for a month are removed. If the folder exceeds its limit, the least recently
used entries are removed. Imported maps count towards the limit but are never removed.

Entries in use are not removed. Each process lists its entries in a file that it locks while it
lives. A listed entry counts as in use for an hour after its last use.
"""

from __future__ import annotations

import atexit
import hashlib
import math
import mmap
import os
import secrets
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from functools import cache, lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeAlias, TypeVar

import msgspec
from platformdirs import user_cache_path

from cosim.core.errors import UsageError
from cosim.core.files import (
    UNFINISHED_PREFIX,
    atomic_file,
    is_locked,
    lock,
    remove_dead,
    temp_folder,
)

if TYPE_CHECKING:  # the command line starts without numpy
    import numpy as np
    from numpy.typing import NDArray

Arrays: TypeAlias = "Mapping[str, NDArray[Any]]"
_T = TypeVar("_T")

BUILDING_PREFIX: Final = ".building-"
"""Prefix of the folders in which city nets are built."""
_ARRAY_PACKAGES: Final = ("numpy", "opencv-python-headless", "pybullet", "scipy", "shapely")
"""Packages that cached arrays depend on."""
_HASH_BYTES: Final = 64
"""Length of the hexadecimal SHA-256 hash at the start of a cached file."""
_ALIGNMENT_BYTES: Final = 64
"""Alignment of arrays in a file, in bytes."""
LIMIT_VARIABLE: Final = "COSIM_CACHE_LIMIT"
"""Environment variable with the size limit in GB."""
_DEFAULT_LIMIT_GB: Final = 4.0
"""Default size limit in GB. Nets and street maps of the suites' hundred cities take 1 GB of it."""
GB: Final = 10**9
"""Bytes in one GB."""
UNUSED_S: Final = 30 * 86400.0
"""Entries unused for this long, in seconds, are removed."""
_IN_USE_S: Final = 3600.0
"""Time since its last use, in seconds, after which a listed entry no longer counts as in use."""
_CLEANUP_INTERVAL_S: Final = 60.0
"""Minimum time between two clean-ups by a process that writes, in seconds."""
_REMOVED: Final = ".forgotten-"
"""Prefix of the temporary folders into which entries are moved before deletion."""
_IN_USE_FOLDER: Final = ".in-use"
"""Folder with the lists of entries in use."""
_LOCK: Final = ".lock"
"""File that serializes changes of the lists."""
_MAX_LISTS: Final = 32
"""Number of lists above which a new process removes those of ended processes."""


class CacheKind(NamedTuple):
    """A kind of cache entry.

    pattern: glob pattern of the entries' paths.
    words: description for `cosim cache`.
    stays: True if entries are never removed.
    """

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
"""All kinds of cache entries."""


class CacheEntry(NamedTuple):
    """An entry of the cache.

    size_bytes: space on the disk.
    used_s: time of last use, in seconds since the epoch.
    """

    path: Path
    kind: CacheKind
    size_bytes: int
    used_s: float


class CleanupResult(NamedTuple):
    """Result of a clean-up: the removed entries, and those not removed because they are in use."""

    entries: tuple[CacheEntry, ...] = ()
    in_use: tuple[CacheEntry, ...] = ()

    @property
    def size_bytes(self) -> int:
        return sum(entry.size_bytes for entry in self.entries)


def cache_folder() -> Path:
    """Return the cache folder: $COSIM_CACHE, else the user's cache folder
    (~/.cache/sidewalk-cosim)."""
    return Path(os.environ.get("COSIM_CACHE") or user_cache_path("sidewalk-cosim"))


def cache_limit_bytes() -> int:
    """Return the size limit: $COSIM_CACHE_LIMIT in GB, else 4 GB. Raises UsageError."""
    text = os.environ.get(LIMIT_VARIABLE) or f"{_DEFAULT_LIMIT_GB:g}"
    try:
        limit_gb = float(text)
    except ValueError:
        limit_gb = math.nan
    if not 0.0 <= limit_gb < math.inf:
        raise UsageError(
            f"{LIMIT_VARIABLE} is '{text}': give a number of GB from 0 on, like "
            f"{_DEFAULT_LIMIT_GB:g} or 0.5"
        )
    return round(limit_gb * GB)


def use_entry(entry: Path) -> None:
    """Mark an entry as in use by this process. Call it before checking whether the entry exists.

    It does nothing if the cache cannot be written.
    """
    with suppress(OSError):
        _in_use_list(cache_folder(), os.getpid()).add(entry)
    with suppress(OSError):
        os.utime(entry)


def clean_up_if_due() -> None:
    """Remove entries if the last clean-up of this process is long ago. Call it before writing an
    entry."""
    folder = cache_folder()
    now_s = time.monotonic()
    if now_s - _last_cleanup_s.get(folder, -math.inf) >= _CLEANUP_INTERVAL_S:
        _last_cleanup_s[folder] = now_s
        clean_up()


_last_cleanup_s: Final[dict[Path, float]] = {}
"""Monotonic time of this process's last clean-up, by cache folder."""


def clean_up(unused_s: float = UNUSED_S, limit_bytes: int | None = None) -> CleanupResult:
    """Remove unused entries, the least recently used ones beyond the limit, and unfinished files.

    unused_s: remove entries unused for this long.
    limit_bytes: size limit, by default `cache_limit_bytes`.
    """
    folder = cache_folder()
    now_s = time.time()
    room = cache_limit_bytes() if limit_bytes is None else limit_bytes
    _remove_unfinished(folder)
    expired: list[CacheEntry] = []
    entries = cache_entries()
    room -= sum(entry.size_bytes for entry in entries if entry.kind.stays)
    for entry in sorted(entries, key=lambda one: one.used_s, reverse=True):
        if not entry.kind.stays:
            room -= entry.size_bytes
            if room < 0 or now_s - entry.used_s >= unused_s:
                expired.append(entry)
    return _delete_entries(folder, expired) if expired else CleanupResult()


def cache_entries() -> list[CacheEntry]:
    """Return all entries of the cache folder."""
    folder = cache_folder()
    return [
        CacheEntry(path, kind, _size_bytes(path), _used_s(path))
        for kind in CACHE_KINDS
        for path in sorted(folder.glob(kind.pattern))
        if not path.name.startswith(".")
    ]


def report_uncached(folder: Path, error: Exception) -> None:
    """Print that something could not be cached, once in a process for each message."""
    _print_once(f"note: {folder}: not cached, so that the next process computes it again: {error}")


@cache
def _print_once(words: str) -> None:
    print(words, file=sys.stderr, flush=True)


class _InUseList:
    """List file of the entries that this process uses."""

    def __init__(self, folder: Path) -> None:
        lists = folder / _IN_USE_FOLDER
        lists.mkdir(parents=True, exist_ok=True)
        self._folder = folder
        self._listed = set[str]()
        self._file = lists / f"{os.getpid()}-{secrets.token_hex(4)}"
        with lock(folder / _LOCK):
            if sum(1 for _ in os.scandir(lists)) > _MAX_LISTS:
                _remove_dead_lists(lists)
            self._held = lock(self._file)
            self._held.acquire()
        atexit.register(_remove_list_of, self._file, os.getpid())

    def add(self, entry: Path) -> None:
        name = entry.relative_to(self._folder).as_posix()
        if name not in self._listed:
            with lock(self._folder / _LOCK):
                with self._file.open("a") as file:
                    file.write(f"{name}\n")
                with suppress(OSError):
                    os.utime(entry)
            self._listed.add(name)


@cache
def _in_use_list(folder: Path, _pid: int) -> _InUseList:
    """Return this process's list. A forked child starts a list of its own."""
    return _InUseList(folder)


def _delete_entries(folder: Path, expired: list[CacheEntry]) -> CleanupResult:
    """Move entries aside that are still unused, then delete them."""
    removed = []
    in_use = []
    with suppress(OSError), temp_folder(_REMOVED, folder) as trash, lock(folder / _LOCK):
        listed = _entries_in_use(folder / _IN_USE_FOLDER)
        now_s = time.time()
        for number, entry in enumerate(expired):
            used_s = _used_s(entry.path)
            name = entry.path.relative_to(folder).as_posix()
            if used_s > entry.used_s or (name in listed and now_s - used_s < _IN_USE_S):
                in_use.append(entry)
                continue
            with suppress(OSError):
                entry.path.rename(trash / str(number))
                removed.append(entry)
    return CleanupResult(tuple(removed), tuple(in_use))


def _entries_in_use(lists: Path) -> set[str]:
    _remove_dead_lists(lists)
    listed: set[str] = set()
    for path in lists.glob("*"):
        with suppress(OSError):
            listed.update(path.read_text().splitlines())
    return listed


def _remove_dead_lists(lists: Path) -> None:
    """Remove the lists of ended processes. The caller holds the lock of the cache."""
    for path in lists.glob("*"):
        with suppress(OSError):
            if not is_locked(path):
                path.unlink()


def _remove_list_of(path: Path, pid: int) -> None:
    """Remove the list of a process when it exits, but not when a forked child exits."""
    if os.getpid() == pid:
        with suppress(OSError):
            path.unlink()


def _remove_unfinished(folder: Path) -> None:
    """Remove unfinished files of killed processes. `atomic_folder` does this for imported maps."""
    remove_dead(folder, _REMOVED)
    remove_dead(folder, BUILDING_PREFIX)
    places = {(folder / kind.pattern).parent for kind in CACHE_KINDS if not kind.stays}
    for place in (*places, *folder.glob("tiles/*")):
        remove_dead(place, UNFINISHED_PREFIX)


def _used_s(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:  # removed by another process
        return 0.0


def _size_bytes(path: str | Path) -> int:
    """Return the disk space of a file, or of all files in a folder."""
    try:
        with os.scandir(path) as found:
            entries = list(found)
    except NotADirectoryError:
        return _blocks_bytes(Path(path))
    except OSError:
        return 0
    return sum(_size_bytes(one.path) if one.is_dir() else _blocks_bytes(one) for one in entries)


def _blocks_bytes(file: Path | os.DirEntry[str]) -> int:
    try:
        return file.stat().st_blocks * 512
    except OSError:  # removed by another process
        return 0


def cached(
    path: Path,
    make: Callable[[], _T],
    encode: Callable[[_T], Iterable[bytes | memoryview]],
    decode: Callable[[memoryview], _T],
    *,
    entry: Path | None = None,
    mapped: bool = False,
) -> _T:
    """Return the value of a cached file; if the file is missing or damaged, make and write it.

    path: file name that contains everything the value depends on.
    decode: raises ValueError for bytes that it cannot read.
    entry: cache entry that the file belongs to, by default the file itself.
    mapped: map the file into memory, shared between processes, instead of reading it.
    """
    entry = entry or path
    use_entry(entry)
    with suppress(OSError, ValueError, msgspec.DecodeError):
        return decode(_read(path, mapped))
    made = make()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        clean_up_if_due()
        _write(path, [*encode(made)])
        return decode(_read(path, mapped)) if mapped else made
    except (OSError, ValueError, msgspec.DecodeError) as error:
        report_uncached(entry.parent, error)
        return made


def _read(path: Path, mapped: bool) -> memoryview:
    """Read or map a cached file. Raises OSError, or ValueError for a damaged file."""
    if mapped:
        with path.open("rb") as file:
            data = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
    else:
        data = memoryview(path.read_bytes())
    body = data[_HASH_BYTES:]
    if hashlib.sha256(body).hexdigest().encode() != data[:_HASH_BYTES]:
        raise ValueError(f"{path}: damaged")
    return body


def _write(path: Path, parts: list[bytes | memoryview]) -> None:
    """Write a cached file. If several processes write it at once, the last one wins."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part)
    with atomic_file(path, shared=True) as making, making.open("wb") as file:
        file.write(digest.hexdigest().encode())
        file.writelines(parts)


def sources_hash(*rooms: Path) -> str:
    """Return 16 hex digits of a hash of Python sources in some folders and of library versions.

    Call it when a module is imported: later edits do not change what this process makes.
    """
    seen = hashlib.sha256(_array_versions().encode())
    for room in rooms:
        for source in sorted(room.rglob("*.py")):
            seen.update(source.relative_to(room).as_posix().encode() + b"\0" + source.read_bytes())
    return seen.hexdigest()[:16]


@lru_cache(maxsize=1)
def _array_versions() -> str:
    """Return the versions of the libraries that make arrays; reading them takes milliseconds."""
    return " ".join(version(package) for package in _ARRAY_PACKAGES)


def mapped_arrays(name: str, made_by: str, make: Callable[[], Arrays]) -> Arrays:
    """Return expensive arrays, write-protected and shared by all processes.

    name: file name, with every parameter of `make`.
    made_by: `sources_hash` of the code that makes the arrays.
    """
    path = cache_folder() / "baked" / f"{name}-{made_by}.arrays"
    return cached(path, lambda: _protected(make()), _encoded, _decoded, mapped=True)


class ArrayCache:
    """On-disk cache of many small array sets; each set is a file in one folder.

    kind: folder of all caches of this kind.
    key: hash of everything that the sets depend on; "" disables caching.
    """

    def __init__(self, kind: str, key: str) -> None:
        self._folder = cache_folder() / kind / key if key else None
        if self._folder is not None:
            use_entry(self._folder)

    def get(self, name: str, make: Callable[[], Arrays]) -> Arrays:
        """Return a set of arrays, write-protected. The file is read, not mapped, because a process
        may use thousands."""
        if self._folder is None:
            return _protected(make())
        path = self._folder / name
        return cached(path, lambda: _protected(make()), _encoded, _decoded, entry=self._folder)


_Table = list[tuple[str, bytes, tuple[int, ...], int]]
"""Name, dtype as JSON, shape and offset of each array in a file."""


def _protected(arrays: Arrays) -> Arrays:
    import numpy as np

    whole = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    for array in whole.values():
        array.flags.writeable = False
    return whole


def _encoded(arrays: Arrays) -> Iterable[bytes | memoryview]:
    """Encode arrays as the table's length, the table, and the arrays one after the other."""
    import numpy as np

    table: _Table = []
    at = 0
    for name, array in arrays.items():
        kind = msgspec.json.encode(array.dtype.descr if array.dtype.names else array.dtype.str)
        table.append((name, kind, array.shape, at))
        at = _aligned(at + array.nbytes)
    head = msgspec.msgpack.encode(table)
    yield len(head).to_bytes(4, "little") + head
    yield bytes(_aligned(4 + len(head)) - 4 - len(head))
    for array in arrays.values():
        yield array.reshape(-1).view(np.uint8).data
        yield bytes(_aligned(array.nbytes) - array.nbytes)


def _decoded(body: memoryview) -> Arrays:
    import numpy as np

    size = int.from_bytes(body[:4], "little")
    table = msgspec.msgpack.decode(body[4 : 4 + size], type=_Table)
    begin = _aligned(4 + size)
    return {
        name: np.ndarray(shape, _dtype(kind), body, begin + at) for name, kind, shape, at in table
    }


def _aligned(count: int) -> int:
    return -(-count // _ALIGNMENT_BYTES) * _ALIGNMENT_BYTES


@lru_cache(maxsize=64)
def _dtype(kind: bytes) -> np.dtype[Any]:
    import numpy as np

    found = msgspec.json.decode(kind)
    if isinstance(found, str):
        return np.dtype(found)
    return np.dtype([(name, one, *map(tuple, shape)) for name, one, *shape in found])
