"""Decoys on the command line: selection, shards and tables."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pandas as pd
import pytest

from cosim.spec.scenario import Suite, write_suite
from tests.conftest import Cosim
from tests.support.event_ways import event_way


@pytest.fixture
def short_suite(tmp_path: Path) -> Path:
    """Two scenarios in a small city that end after a second, followed by their decoys."""
    events = [
        event_way(kind, f"{kind}-001", at_m=10.0, time_s=1.0) for kind in ("lateral", "overtaking")
    ]
    decoys = [
        msgspec.structs.replace(one, id=f"{one.id}-decoy", decoy_of=one.id, go_on_mps=0.6)
        for one in events
    ]
    path = tmp_path / "few.json"
    write_suite(Suite(name="few", version="1", scenarios=(*events, *decoys)), path)
    return path


@pytest.mark.engine
def test_decoys_run_with_their_scenarios(short_suite: Path, tmp_path: Path, cosim: Cosim) -> None:
    """Shards hold pairs and merge to D, an id selects one, --no-decoys none, and resume, score and
    list respect decoys."""

    always = ("run", short_suite.name, "--policy", "schedule:stand", "--seed", "7")

    def run(name: str, *words: str) -> set[str]:
        result = cosim(*always, "--out", name, *words, cwd=tmp_path)
        assert result.returncode == 0, result
        return {*pd.read_csv(tmp_path / name / "results.csv")["scenario"]}

    assert run("1", "--shard", "1/2") == {"lateral-001", "lateral-001-decoy"}
    assert run("2", "--shard", "2/2") == {"overtaking-001", "overtaking-001-decoy"}
    result = cosim("merge", "1", "2", "--out", "both", cwd=tmp_path)
    assert result.returncode == 0 and "decoys count in D alone, over 2 pairs" in result.stdout, (
        result
    )
    assert cosim("score", "both", cwd=tmp_path).returncode == 0
    assert run("events", "--no-decoys") == {"lateral-001", "overtaking-001"}
    assert run("one", "--scenario", "lateral-001-decoy") == {"lateral-001-decoy"}
    assert run("one", "--scenario", "lateral-001-decoy", "--resume") == {"lateral-001-decoy"}
    result = cosim(*always, "--out", "events", "--resume", cwd=tmp_path)
    assert "2 of 4 (--no-decoys), and this command has 4 of 4 (all)" in result.stderr, result
    result = cosim("list", short_suite.name, cwd=tmp_path)
    assert "decoy of" in result.stdout and "lateral-001-decoy" in result.stdout
