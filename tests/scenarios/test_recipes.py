"""Recipes for clusters, tested as far as one machine allows."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

RECIPES = Path(__file__).parents[2] / "scenarios/runs/recipes"


def test_a_task_of_the_slurm_array_runs_and_resumes_its_shard(tmp_path: Path) -> None:
    """Each of three tasks runs its shard with Slurm's variables, and a requeued task resumes."""
    (tmp_path / "bin").mkdir()
    stub = tmp_path / "bin/cosim"
    stub.write_text('#!/bin/sh\necho "$@"\n')
    stub.chmod(0o755)

    def task(number: int) -> str:
        given = {
            "SLURM_ARRAY_TASK_ID": f"{number}",
            "SLURM_ARRAY_TASK_COUNT": "3",
            "SLURM_CPUS_PER_TASK": "4",
        }
        command = [RECIPES / "slurm-array.sh", "reactive", "orca", "7", "out", "--split", "test"]
        environment = os.environ | given | {"PATH": f"{stub.parent}:{os.environ['PATH']}"}
        return subprocess.run(
            command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
        ).stdout

    commands = [task(number).split() for number in (1, 2, 3)]
    assert [words[words.index("--shard") + 1] for words in commands] == ["1/3", "2/3", "3/3"]
    assert " ".join(commands[1]) == (
        "run reactive --policy orca --seed 7 --shard 2/3 --jobs 4 --out out/shard-2 --split test"
    )
    (tmp_path / "out/shard-2").mkdir()
    (tmp_path / "out/shard-2/run.json").touch()
    assert task(2).split() == [*commands[1], "--resume"]


def test_systemd_accepts_the_unit_of_a_worker(tmp_path: Path) -> None:
    """`systemd-analyze verify` reports no fault of the unit."""
    if (verify := shutil.which("systemd-analyze")) is None:
        pytest.skip("there is no systemd-analyze")
    unit = (RECIPES / "cosim-worker.service").read_text()
    (tmp_path / "cosim-worker.service").write_text(
        unit.replace("/opt/cosim/.venv/bin/cosim", "/bin/true")
    )
    done = subprocess.run(
        [verify, "verify", tmp_path / "cosim-worker.service"], capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (0, "")
