"""Every measurement by its name; each is taken in a fresh process, of this checkout or of another
one."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Final

import msgspec

from cosim.core.errors import EngineError, UsageError, unknown
from cosim.core.progress import Progress
from scenarios.tools.bench import batched as together
from scenarios.tools.bench import (
    cameras,
    coordinating,
    driving,
    episodes,
    growth,
    places,
    serving,
    starting,
    street,
)
from scenarios.tools.bench.figures import MORE, Figure

ROOT: Final = Path(__file__).resolve().parents[3]
ENVIRONMENT: Final = (
    "driving",
    "large pictures",
    "towns",
    "starting",
    "street 50",
    "street 150",
    "places",
    "reactive",
)
"""Taken by `cosim bench`."""
ON_REQUEST: Final = (
    "ten environments",
    "200 episodes",
    "serving",
    "200 workers",
    "two processes",
    "first episode",
)
"""Taken by `cosim bench` when they are named: for a machine of many cores, and for minutes."""
_ENGINES: Final = "engines"
_FIRST_ALONE: Final = "first episode alone"


def _camera(figure: cameras.Drawing) -> list[Figure]:
    return [Figure(f"{figure.name}, frames per s", 1.0 / figure.work(figure.size_m), better=MORE)]


CAMERA: Final[Mapping[str, Callable[[], list[Figure]]]] = {
    figure.name: partial(_camera, figure) for figure in cameras.FIGURES
}
"""Taken by `cosim bench camera`."""

_TAKEN: Final[Mapping[str, Callable[[], list[Figure]]]] = {
    "driving": driving.driving,
    "large pictures": driving.driving_large_pictures,
    "towns": driving.driving_in_towns,
    "street 50": partial(street.walking, 50),
    "street 150": partial(street.walking, 150),
    "places": places.places,
    "reactive": episodes.reactive,
    "ten environments": together.driving_together,
    "200 episodes": growth.growing,
    "serving": serving.asking_elsewhere,
    "200 workers": coordinating.coordinating,
    "two processes": episodes.two_processes,
    **CAMERA,
}


def figures_of(name: str, started_s: float) -> list[Figure]:
    """Take a measurement in this process, which was started at a moment of the monotonic clock."""
    if name == _ENGINES:
        return starting.engines_starting(started_s)
    if name == "starting":
        fresh, *others = starting.starting(started_s)
        (alone,) = taken(_ENGINES)
        return [
            msgspec.structs.replace(fresh, limit=alone.value, limit_is=starting.ENGINES_ALONE),
            *others,
        ]
    if name == _FIRST_ALONE:
        return starting.first_episode_alone(started_s)
    if name == "first episode":
        return starting.first_episode(started_s, lambda: taken(_FIRST_ALONE)[0])
    return _TAKEN[name]()


def taken(name: str, checkout: Path = ROOT) -> list[Figure]:
    """The figures of a measurement by a checkout of cosim, in a fresh process of its own
    environment, if it has one.

    Raises UsageError for a folder that has no such measurements, EngineError when its process
    fails.
    """
    python = checkout / ".venv" / "bin" / "python"
    with tempfile.TemporaryDirectory() as folder:
        found = Path(folder) / "figures.json"
        command = [
            str(python) if python.exists() else sys.executable,
            "-m",
            "scenarios.tools.bench.take",
            name,
        ]
        done = subprocess.run(
            [*command, repr(time.monotonic()), str(found)],
            cwd=checkout,
            env=os.environ | {"PYTHONPATH": str(checkout)},
            capture_output=True,
            text=True,
            check=False,
        )
        if found.exists():
            return msgspec.json.decode(found.read_bytes(), type=list[Figure])
    last = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
    if checkout != ROOT and not (checkout / "scenarios" / "bench" / "take.py").is_file():
        raise UsageError(
            f"{checkout} cannot be compared: it holds no cosim with scenarios/tools/bench/take.py"
        )
    raise EngineError(f"measurement '{name}' failed in {checkout}: {last}")


def chosen(only: Sequence[str], names: Sequence[str]) -> list[str]:
    """Those of some measurements that are asked for: all where none is."""
    for name in only:
        if name not in names:
            raise unknown("measurement", name, names)
    return [name for name in names if name in only or not only]


def take_rounds(
    names: Sequence[str], checkouts: Sequence[Path], rounds: int, progress: Progress
) -> list[dict[str, list[Figure]]]:
    """For each checkout its figures by name, a value a round. The checkouts take turns, and who
    begins changes."""
    found: list[dict[str, list[Figure]]] = [{} for _ in checkouts]
    for k in range(rounds):
        for name in names:
            order = list(enumerate(checkouts))
            for i, checkout in order[:: -1 if k % 2 else 1]:
                where = "" if len(checkouts) == 1 else f" in {checkout}"
                progress(f"measuring: round {k + 1} of {rounds}: {name}{where}")
                for figure in taken(name, checkout):
                    found[i].setdefault(figure.name, []).append(figure)
    return found
