"""How many short episodes environment processes drive: two an hour, and two beside one."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from typing import Final

from cosim.core.errors import EngineError
from cosim.spec.options import EpisodeOptions
from scenarios.tools.bench.figures import MORE, Figure

_EPISODES: Final = 32
_JOBS: Final = 2
_COMPARED: Final = 48
_WARM: Final = 4
"""So many of those that are compared end before the clock runs: engines are loaded, places are
read."""


def reactive() -> list[Figure]:
    """The first scenarios of the reactive suite, four of each event, driven by `straight` as a user
    would."""
    with tempfile.TemporaryDirectory() as folder:
        words = [
            "run",
            "reactive",
            "--policy",
            "straight",
            "--episodes",
            str(_EPISODES),
            "--jobs",
            str(_JOBS),
        ]
        began = time.monotonic()
        done = subprocess.run(
            [sys.executable, "-m", "cosim", *words, "--out", f"{folder}/run"],
            env=os.environ,
            capture_output=True,
            text=True,
            check=False,
        )
        hours = (time.monotonic() - began) / 3600.0
    if done.returncode:
        raise EngineError(
            f"`cosim {' '.join(words)}` ended with exit code {done.returncode}: "
            f"{done.stderr[-300:]}"
        )
    name = f"reactive, {_JOBS} processes, episodes per hour"
    return [Figure(name, _EPISODES / hours, reach=1500.0, better=MORE)]


def two_processes() -> list[Figure]:
    """Short episodes a second, by two local processes beside one, once these have warmed up."""
    one, two = _episodes_per_s(1), _episodes_per_s(2)
    name = "reactive, two processes, episodes per s"
    return [Figure(name, two, one, "one process", 1.85, MORE, reach_ratio=True)]


def _episodes_per_s(jobs: int) -> float:
    from scenarios.ipc.messages import Done
    from scenarios.runs.run import run

    ends_s: list[float] = []

    def hear(message: object) -> None:
        if isinstance(message, Done):
            ends_s.append(time.monotonic())

    run(
        "reactive",
        "straight",
        episodes=_COMPARED,
        jobs=jobs,
        options=EpisodeOptions(seed=1),
        tell=hear,
    )
    return (_COMPARED - _WARM) / (ends_s[-1] - ends_s[_WARM - 1])
