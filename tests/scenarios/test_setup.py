"""Setting up an episode: what it imports, and that what a process keeps from episode to episode changes nothing."""

from __future__ import annotations

import subprocess
import sys

from tests.conftest import PATIENCE_S

NOT_DRIVEN_WITH = (
    "pandas",
    "pyproj",
    "sumo_nets.maps.importer",
    "sumo_nets.net.netfile",
    "sumolib",
    "traci",
    "trimesh",
)


def test_an_episode_imports_only_what_it_drives_with() -> None:
    """Neither what reads maps, nor SUMO's tools in Python, nor tables; who imports libsumo besides gets all of it."""
    code = (
        "import sys, cosim\n"
        "cosim.Episode\n"
        f"print(sorted(set({NOT_DRIVEN_WITH}) & set(sys.modules)))\n"
        "from sumo_nets.engine import sumo\n"
        "import libsumo\n"
        "print(libsumo.person is sumo.person and libsumo.isLibsumo())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=PATIENCE_S)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split("\n")[-3:-1] == ["[]", "True"]
