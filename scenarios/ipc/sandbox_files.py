"""The files that a sandbox shows: what may be read with all below it, and the links to it."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final

Reads = Iterable[tuple[str, tuple[str, ...]]]
"""Paths that may be read, each with paths below it that may not."""
_DEVICES: Final = ("null", "zero", "full", "random", "urandom")
_OF_SYSTEM: Final = ("/sys/devices/system/cpu", "/sys/devices/system/node")
"""What libraries read of the hardware."""


def has_gpu() -> bool:
    """Return whether this machine has an NVIDIA GPU's device."""
    return Path("/dev/nvidiactl").exists()


def devices(*, gpu: bool) -> list[Path]:
    """Return the devices that a policy may use. gpu: those of NVIDIA included."""
    found = [*map(Path("/dev").joinpath, _DEVICES), *(Path("/dev").glob("nvidia*") if gpu else ())]
    return [path for path in found if path.exists()]


def visible(reads: Reads) -> tuple[list[Path], dict[Path, Path]]:
    """Return the paths that may be read with all below them, and the links on the way to them with
    their targets."""
    leaves: set[Path] = set()
    links: dict[Path, Path] = {}
    for path, without in (*reads, *((one, ()) for one in _OF_SYSTEM)):
        if not Path(path).exists():
            continue
        links |= _links_to(Path(path))
        for leaf in _leaves(Path(path).resolve(), {Path(one) for one in without}):
            if leaf.is_symlink():
                links[leaf] = leaf.readlink()
            else:
                leaves.add(leaf)
    outer = {leaf for leaf in leaves if not is_below(leaf.parent, leaves)}
    return sorted(outer), {at: to for at, to in links.items() if not is_below(at, outer)}


def is_below(path: Path, among: set[Path]) -> bool:
    """Return whether a path or a folder above it is among some."""
    return path in among or any(above in among for above in path.parents)


def linked_imports(imports: Iterable[str], leaves: list[Path], folder: Path) -> tuple[str, ...]:
    """Replace import folders that may not be listed by folders of links to what may be read of
    them.

    leaves: of `visible`.
    folder: where the folders are made.
    """
    shown = set(leaves)
    found = []
    for number, entry in enumerate(imports):
        real = Path(entry).resolve()
        if is_below(real, shown):
            found.append(entry)
            continue
        farm = folder / str(number)
        for leaf in leaves:
            if leaf.is_relative_to(real):
                link = farm / leaf.relative_to(real)
                link.parent.mkdir(parents=True, exist_ok=True)
                link.symlink_to(leaf)
        found.append(str(farm))
    return tuple(found)


def _leaves(path: Path, without: set[Path]) -> Iterator[Path]:
    """Yield a path, or where something below it may not be read, what is left of it."""
    if is_below(path, without):
        return
    if not any(one.is_relative_to(path) for one in without):
        yield path
        return
    for child in sorted(path.iterdir()):
        if child.is_symlink():
            yield child
        else:
            yield from _leaves(child, without)


def _links_to(path: Path) -> dict[Path, Path]:
    """Return the symbolic links on the way to a path, with their targets."""
    found: dict[Path, Path] = {}
    at = Path("/")
    for part in path.parts[1:]:
        step = at / part
        if step.is_symlink():
            found[step] = step.readlink()
            found |= _links_to(Path(os.path.normpath(at / found[step])))
            step = step.resolve()
        at = step
    return found
