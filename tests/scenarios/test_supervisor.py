"""A worker: how long it waits for a run, and what it leaves behind."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

import pytest

from cosim.core.errors import MachineError
from cosim.spec.connection import Connection
from scenarios.runs import zenoh_worker
from scenarios.runs.passing_folder import passing_folder
from scenarios.runs.zenoh_worker import work
from tests.scenarios.test_many_workers import Run, until

HOLDS = """
import sys, time
from scenarios.runs.passing_folder import passing_folder
with passing_folder("cosim-test-") as folder:
    (folder / "0.log").write_text("printed")
    print(folder, flush=True)
    time.sleep(3600)
"""


@pytest.mark.engine
def test_a_worker_for_one_run_does_not_wait_for_ever(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It ends, and says why, when it was cut off from a run that is over, and when none was ever
    there."""
    monkeypatch.setattr(zenoh_worker, "_LOOKS_S", 0.0)
    run = Run(tmp_path)
    said = list[str]()

    def over_unheard() -> None:
        until(lambda: ": is connected" in run.log)
        monkeypatch.setattr(zenoh_worker, "GIVEN_UP_S", 0.5)
        run.kill()

    other = threading.Thread(target=over_unheard)
    other.start()
    at = Connection(role="worker", connect=run.endpoint)
    with pytest.raises(MachineError, match=r"no run was heard of at .* for 0\.5 s: is it over\?"):
        work(at, 1, said.append, once=True)
    other.join()
    assert any(line.startswith("works for run") for line in said)
    run.over()
    with pytest.raises(MachineError, match="no run was heard of"):
        work(at, 1, said.append, once=True)


def test_the_folder_of_a_process_that_was_killed_is_removed_by_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """That of one who lives stays, and one's own is gone when it is left."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    there = []
    for _ in range(2):
        process = subprocess.Popen(
            [sys.executable, "-c", HOLDS],
            env=os.environ | {"TMPDIR": str(tmp_path)},
            stdout=subprocess.PIPE,
            text=True,
        )
        assert process.stdout is not None
        there.append((process, Path(process.stdout.readline().strip())))
    (dies, left), (lives, stays) = there
    try:
        dies.kill()
        dies.wait()
        assert left.is_dir()
        with passing_folder("cosim-test-") as mine:
            assert {*tmp_path.iterdir()} == {stays, mine}
        assert {*tmp_path.iterdir()} == {stays}
    finally:
        lives.kill()
        lives.wait()
