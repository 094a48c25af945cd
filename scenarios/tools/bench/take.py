"""Takes one measurement in a process of its own: `python -m scenarios.tools.bench.take NAME STARTED
FILE`.

STARTED: time when the process was started, seconds of the monotonic clock.
FILE: JSON file for its figures.
"""

from __future__ import annotations

import sys
from pathlib import Path

import msgspec


def _main() -> None:
    """Take the measurement that the command line names."""
    name, started_s, path = sys.argv[1:]
    from scenarios.tools.bench.measurements import figures_of

    Path(path).write_bytes(msgspec.json.encode(figures_of(name, float(started_s))))


if __name__ == "__main__":
    _main()
