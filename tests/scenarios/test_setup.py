"""Set-up of an episode: its imports, and independence from earlier episodes of the process."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.conftest import PATIENCE_S
from tests.support.episode_order import COUNT, SAMPLE

NOT_DRIVEN_WITH = (
    "pandas",
    "pyproj",
    "scipy",
    "sumo_nets.maps.importer",
    "sumo_nets.net.net_file",
    "sumolib",
    "traci",
    "trimesh",
)


def test_an_episode_imports_only_what_it_needs() -> None:
    """Making an Episode imports no map reader, no SUMO tools and no pandas, and SUMO only when it
    simulates."""
    code = (
        f"import sys, cosim\ncosim.Episode\nprint(sorted(set({NOT_DRIVEN_WITH}) & "
        "set(sys.modules)), 'sumo_nets.engine' in sys.modules)\nfrom sumo_nets.engine import "
        "sumo\nimport libsumo\nprint(libsumo.person is sumo.person and libsumo.isLibsumo())"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=PATIENCE_S
    )
    assert done.returncode == 0, done.stderr
    first, *_, last = (
        done.stdout.splitlines()
    )  # between them libsumo may say what it makes of other packages
    assert (first, last) == ("[] False", "True")


@pytest.mark.engine
def test_later_episodes_of_a_process_equal_first_ones(
    request: pytest.FixtureRequest,
) -> None:
    """Seven episodes (30 with --whole) of two cities with many crowds, grounds, robots and lights
    have the same states and pictures in random order."""
    whole = request.config.getoption("--whole")
    count, only = (COUNT, []) if whole else (len(SAMPLE), ["--sample"])
    command = [sys.executable, "-m", "tests.support.episode_order", *only]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split("\n")[-2] == f"[] {count} {count}", done.stderr
