"""How many short episodes an hour two environment processes drive."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from typing import Final

from cosim.core.errors import EngineError
from scenarios.bench.figures import MORE, Figure

_EPISODES: Final = 32
_JOBS: Final = 2


def reactive() -> list[Figure]:
    """The first scenarios of the reactive suite, four of each event, driven by `straight` as a user would."""
    with tempfile.TemporaryDirectory() as folder:
        words = ["run", "reactive", "--policy", "straight", "--episodes", str(_EPISODES), "--jobs", str(_JOBS)]
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
        raise EngineError(f"`cosim {' '.join(words)}` ended with exit code {done.returncode}: {done.stderr[-300:]}")
    name = f"reactive, {_JOBS} processes, episodes per hour"
    return [Figure(name, _EPISODES / hours, reach=1500.0, better=MORE)]
