"""A worker: how long it waits for a run, and what it leaves behind."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from cosim.core.errors import MachineError
from cosim.spec.connection import Connection
from scenarios.runs import zenoh_worker
from scenarios.runs.zenoh_worker import work
from tests.scenarios.test_many_workers import Run, until


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
        work(at, 1, lambda line, *_: said.append(line), once=True)
    other.join()
    assert any(line.startswith("works for run") for line in said)
    run.over()
    with pytest.raises(MachineError, match="no run was heard of"):
        work(at, 1, lambda line, *_: said.append(line), once=True)
