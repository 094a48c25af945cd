"""Arrays that take long to make, kept: made once on a machine, then mapped into memory and shared
by its processes.

They lie in the cache folder under a name that says what they depend on: the source that makes them
and the libraries it stands on. What is damaged is made anew; a cache that cannot be written is done
without, and that is said.
"""

from __future__ import annotations

import hashlib
import shutil
import tempfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from cosim.core.cache import MAKING, cache_folder, make_room, say_not_kept, use_entry

Arrays = Mapping[str, NDArray[Any]]

_FOLDER: Final = "baked"
_SEAL: Final = "seal.json"
_MADE_WITH: Final = ("numpy", "opencv-python-headless", "pybullet", "scipy", "shapely")
"""Packages that what is baked depends on."""


def sources_hash(*rooms: Path) -> str:
    """16 hex digits of the sources in some folders and of the libraries. To be asked for when those
    are imported: who edits them later does not change what this process makes."""
    seen = hashlib.sha256(" ".join(version(package) for package in _MADE_WITH).encode())
    for room in rooms:
        for source in sorted(room.rglob("*.py")):
            seen.update(source.relative_to(room).as_posix().encode() + b"\0" + source.read_bytes())
    return seen.hexdigest()[:16]


def baked(name: str, made_by: str, make: Callable[[], Arrays]) -> Arrays:
    """What `make` makes, write-protected: from the cache, else made now and kept.

    name: of the file name, with everything `make` was told; made_by: the `sources_hash` of what it
    is made by.
    """
    folder = cache_folder() / _FOLDER / f"{name}-{made_by}"
    use_entry(folder)
    with suppress(OSError, ValueError, msgspec.DecodeError):
        return _read(folder)
    arrays = {key: np.ascontiguousarray(array) for key, array in make().items()}
    try:
        _keep(folder, arrays)
        return _read(folder)
    except (OSError, ValueError, msgspec.DecodeError) as error:
        say_not_kept(folder.parent, error)
    for array in arrays.values():
        array.flags.writeable = False
    return arrays


def _read(folder: Path) -> Arrays:
    """Raises OSError where there is nothing, ValueError where it is not what was kept."""
    seals = msgspec.json.decode((folder / _SEAL).read_bytes(), type=dict[str, str])
    arrays: dict[str, NDArray[Any]] = {}
    for key, seal in seals.items():
        with (folder / f"{key}.npy").open("rb") as file:
            if hashlib.file_digest(file, "sha256").hexdigest() != seal:
                raise ValueError(f"{folder / key}.npy: not what was written")
        arrays[key] = np.load(folder / f"{key}.npy", mmap_mode="r", allow_pickle=False)
    return arrays


def _keep(folder: Path, arrays: Arrays) -> None:
    """In one move: several processes may make the same at once, and the first wins."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    make_room()
    making = Path(tempfile.mkdtemp(prefix=MAKING, dir=folder.parent))
    try:
        seals = {}
        for key, array in arrays.items():
            np.save(making / f"{key}.npy", array, allow_pickle=False)
            with (making / f"{key}.npy").open("rb") as file:
                seals[key] = hashlib.file_digest(file, "sha256").hexdigest()
        (making / _SEAL).write_bytes(msgspec.json.encode(seals))
        making.chmod(0o755)
        try:
            making.rename(folder)
        except OSError:  # somebody was faster, or what is there is damaged
            with suppress(OSError, ValueError, msgspec.DecodeError):
                _read(folder)
                return
            shutil.rmtree(folder)
            making.rename(folder)
    finally:
        shutil.rmtree(making, ignore_errors=True)
