"""Pack collections of the format raw, in parts, by several processes.

A collection may be unfinished: its finished episodes are packed. An episode in which the robot was
put back becomes several ones, which begin there.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import RunError
from cosim.core.packed_demos import EXTRAS, Packed
from cosim.core.progress import Progress, ignore
from cosim.results.run_folder import DEMONSTRATION
from cosim.spec.scenario import Scenario, read_suite
from scenarios.episodes.clip import read_pictures
from scenarios.episodes.demonstration import Demonstration
from scenarios.ipc.parallel_map import parallel_map
from scenarios.tools.dataset.collected import ABOUT, RUNS, packed_meta, refuse_unlike

_STAGE: Final = "packing"


class _Stored(NamedTuple):
    """Demonstration on the disk. source: number of its collection."""

    source: int
    path: Path
    scenario: str
    structure: str
    weather: str


class Part(NamedTuple):
    """File of a part. episodes, rows: their numbers."""

    path: Path
    episodes: int
    rows: int


def is_raw(folder: Path) -> bool:
    """Return whether a folder is a collection of the format raw."""
    return (folder / ABOUT).exists()


def pack_raw(
    folders: Sequence[Path],
    output: Path,
    size: tuple[int, int] | None = None,
    *,
    part: int = 250,
    jobs: int = 1,
    progress: Progress = ignore,
) -> list[Part]:
    """Write collections in parts NAME-000.npz and so on, and return these.

    Further parts of this name, which an earlier call wrote, are deleted.

    size: width and height of the pictures, instead of their own.
    part: episodes in a part.

    Raises RunError for a folder without episodes, SpecError for collections that do not match, and
    MachineError if a process is killed.
    """
    abouts = [_about(folder) for folder in folders]
    refuse_unlike(list(zip(folders, abouts, strict=True)))
    stored = [one for number, folder in enumerate(folders) for one in _stored(number, folder)]
    if not stored:
        raise RunError(f"{folders[0]}: no episode is finished: continue the collection by --resume")
    parts = [stored[first : first + part] for first in range(0, len(stored), part)]
    paths = [output.with_name(f"{output.stem}-{number:03d}.npz") for number in range(len(parts))]
    work = list(zip(paths, parts, strict=True))
    rows = parallel_map(partial(_write, abouts, size), work, jobs, progress, _STAGE)
    for old in _parts_of(output):
        if old not in paths:
            old.unlink()
    return [Part(path, len(of), count) for (path, of), count in zip(work, rows, strict=True)]


def _parts_of(output: Path) -> list[Path]:
    """Return the existing parts of an output."""
    name = re.compile(re.escape(output.stem) + r"-[0-9]{3,}\.npz")
    return [path for path in output.parent.iterdir() if name.fullmatch(path.name)]


def _about(folder: Path) -> dict[str, Any]:
    try:
        return dict(json.loads((folder / ABOUT).read_bytes()))
    except (OSError, ValueError) as error:
        raise RunError(
            f"{folder}: no collection of the format raw: {error}: give collections of one format"
        ) from error


def _stored(number: int, folder: Path) -> list[_Stored]:
    """Return the stored demonstrations of a collection, in the order of its scenarios."""
    found = []
    runs = (folder / RUNS).glob("*/scenarios.json")
    for run in sorted(runs, key=lambda path: int(path.parent.name)):
        for scenario in read_suite(run).scenarios:
            path = run.parent / "episodes" / scenario.id / DEMONSTRATION
            if path.exists():
                found.append(_of(number, path, scenario))
    return found


def _of(number: int, path: Path, scenario: Scenario) -> _Stored:
    return _Stored(number, path, scenario.id, scenario.structure, scenario.conditions.name)


def _write(
    abouts: Sequence[dict[str, Any]],
    size: tuple[int, int] | None,
    part: tuple[Path, Sequence[_Stored]],
) -> int:
    """Write a part; return the number of its rows."""
    path, stored = part
    demos = [Demonstration.decoded(one.path.read_bytes(), one.path) for one in stored]
    lengths = [length for demo in demos for length in demo.lengths]
    sources = dict.fromkeys(one.source for one in stored)
    listed = [
        {"scenario": one.scenario, "structure": one.structure, "weather": one.weather}
        for one, demo in zip(stored, demos, strict=True)
        for _ in demo.lengths
    ]

    def joined(name: str) -> NDArray[Any]:
        rows = np.concatenate([getattr(demo, name) for demo in demos])
        return rows.reshape(len(rows), abouts[0]["lidar"]["rings"], -1) if name == "scan" else rows

    extras = [name for name in EXTRAS if all(name in demo.extras for demo in demos)]
    packed = Packed(
        frames=np.concatenate([_pictures(demo, size) for demo in demos]),
        state=joined("state"),
        goal=joined("goal"),
        command=joined("command"),
        waypoints=joined("waypoints"),
        driven=joined("driven").astype(np.int32),
        disturbed=joined("disturbed").astype(bool),
        episode=np.repeat(np.arange(len(lengths), dtype=np.int32), lengths),
        frame=np.concatenate([np.arange(length, dtype=np.int32) for length in lengths]),
        meta=packed_meta([abouts[number] for number in sources], listed),
        **{name: joined(name) for name in extras},
    )
    packed.save(path)
    return len(packed)


def _pictures(demo: Demonstration, size: tuple[int, int] | None) -> NDArray[np.uint8]:
    """Return the pictures (n, H, W, 3) of a demonstration, resized if wanted."""
    drawn = [rgb for _, rgb in read_pictures(demo.clip.tobytes())]
    if len(drawn) != len(demo):
        raise RunError(f"{len(drawn)} pictures and {len(demo)} rows: collect the episode again")
    if size is None or drawn[0].shape[1::-1] == size:
        return np.stack(drawn)
    return np.stack([cv2.resize(rgb, size, interpolation=cv2.INTER_AREA) for rgb in drawn])
