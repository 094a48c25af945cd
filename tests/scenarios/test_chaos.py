"""Workers and a coordinator, started as a user starts them, that are killed and stopped during a
run."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from cosim.results.run_folder import read_records
from tests.support.chaos import PlannedFault, chaos, differences, tiny_suite, undisturbed
from tests.support.coordinating import serve_fabricated

PLAN = [
    PlannedFault(1, "kill worker"),
    PlannedFault(2, "stop worker"),
    PlannedFault(3, "kill process"),
    PlannedFault(4, "kill coordinator"),
    PlannedFault(5, "end worker"),
]
"""Early enough that episodes are left for the last fault, where several end between two polls."""
SEED = 143
"""With this seed the paused worker is paused for 0.6 s."""


@pytest.mark.engine
def test_killed_workers_and_coordinators_change_no_result(
    tmp_path: Path,
) -> None:
    """Ten real episodes by three workers give the table and the state hashes of an undisturbed run,
    and the scenario that kills its processes is named. One worker is killed, one paused and one
    terminated; an environment process and the coordinator are killed."""
    tiny_suite(tmp_path, 10)
    with ThreadPoolExecutor(1) as executor:
        reference_run = executor.submit(undisturbed, tmp_path, jobs=1)
        found = chaos(tmp_path, "chaos", 3, PLAN, seed=SEED, replaced=False)
    reference = reference_run.result()
    logs = (tmp_path / "chaos.log").read_text() + (tmp_path / "chaos-workers.log").read_text()
    assert found.wrong == [] and sum(found.faults.values()) == len(PLAN), logs
    assert differences(reference, tmp_path / "chaos") == [], logs
    assert found.episodes == 10 and "Traceback" not in logs
    (poison,) = [record for record in read_records(tmp_path / "chaos") if record.status != "done"]
    assert poison.scenario.id == "tiny-005" and poison.status == "crashed"
    assert "was killed by SIGKILL in the policy's reset, 2 times" in poison.reason
    assert len(read_records(reference)) == 10


@pytest.mark.engine
def test_a_coordinator_receives_every_fabricated_result() -> None:
    """Three workers with immediate results serve thirty jobs, the run ends, and a round takes a
    positive time."""
    served = serve_fabricated(workers=3, jobs=30)
    assert served.jobs == 30 and served.wall_s > served.round_s > 0.0
