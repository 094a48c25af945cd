"""Tables of the measurements; each is taken in a fresh process, of this or another checkout."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Final

from cosim.core.errors import unknown
from cosim.core.progress import Progress
from scenarios.tools.bench import cameras, environment, sensors, serving
from scenarios.tools.bench.figures import MORE, Figure, taken

_Take = Callable[[], list[Figure]]
_TakeFromStart = Callable[[float], list[Figure]]
"""Function of the time when its process was started, seconds of the monotonic clock."""

ENVIRONMENT: Final = (
    "driving",
    "large pictures",
    "towns",
    "starting",
    "street 50",
    "street 150",
    "places",
    "reactive",
    "sensors",
)
"""Taken by `cosim bench`."""
ON_REQUEST: Final = (
    "ten environments",
    "200 episodes",
    "serving",
    "two processes",
    "first episode",
    "legs",
)
"""Taken by `cosim bench` only when named: they need many cores or minutes."""


def _camera(figure: cameras.Drawing) -> list[Figure]:
    return [Figure(f"{figure.name}, frames per s", 1.0 / figure.work(figure.size_m), better=MORE)]


CAMERA: Final[Mapping[str, _Take]] = {
    figure.name: partial(_camera, figure) for figure in cameras.FIGURES
}
"""Taken by `cosim bench camera`."""

_TAKEN: Final[Mapping[str, _Take]] = {
    "driving": environment.driving,
    "large pictures": environment.driving_large_pictures,
    "towns": environment.driving_in_towns,
    "street 50": partial(environment.walking, 50),
    "street 150": partial(environment.walking, 150),
    "places": environment.places,
    "reactive": environment.reactive,
    "sensors": sensors.sensing,
    "legs": environment.driving_on_legs,
    "ten environments": environment.driving_together,
    "200 episodes": environment.growing,
    "serving": serving.policy_processes,
    "two processes": environment.two_processes,
    **CAMERA,
}
_TAKEN_FROM_START: Final[Mapping[str, _TakeFromStart]] = {
    "starting": environment.starting,
    "engines": environment.engines_starting,
    "first episode": environment.first_episode,
    "first episode alone": environment.first_episode_alone,
}


def figures_of(name: str, started_s: float) -> list[Figure]:
    """Take a measurement in this process, which was started at a moment of the monotonic clock."""
    return _TAKEN_FROM_START[name](started_s) if name in _TAKEN_FROM_START else _TAKEN[name]()


def chosen(only: Sequence[str], names: Sequence[str]) -> list[str]:
    """Return the named measurements, or all where none is named.

    Raises UsageError for an unknown name.
    """
    for name in only:
        if name not in names:
            raise unknown("measurement", name, names)
    return [name for name in names if name in only or not only]


def take_rounds(
    names: Sequence[str], checkouts: Sequence[Path], rounds: int, progress: Progress
) -> list[dict[str, list[Figure]]]:
    """Return for each checkout its figures by name, one for each round.

    Checkouts alternate, and so does the first.
    """
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
