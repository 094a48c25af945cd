"""Logs of the command line, and the figures of a run."""

from __future__ import annotations

import json
import logging
from pathlib import Path

import msgspec
import pytest

from cosim.cli.console import logged
from cosim.core.errors import MachineError, UsageError
from cosim.core.log_event import log_event
from cosim.results.run_folder import read_records
from cosim.results.throughput import (
    Throughput,
    ThroughputTimer,
    append_throughput,
    median_answer_ms,
)
from tests.support.driven_runs import run_of


def test_an_event_is_logged_as_json_and_as_text(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Both have time, level, event and facts; lower levels are left out, the file is appended to,
    and logging ends with the block."""
    for _ in range(2):
        with logged("info", tmp_path / "log.jsonl") as counts:
            log_event("claimed", logging.DEBUG, scenario="s-0")
            log_event(
                "retried", logging.WARNING, scenario="s-0", why="its worker was lost", attempts=1
            )
    log_event("retried", scenario="later")
    entries = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert len(entries) == 2 and entries[0].pop("time")[10] == "T"
    assert entries[0] == {
        "level": "warning",
        "event": "retried",
        "scenario": "s-0",
        "why": "its worker was lost",
        "attempts": 1,
    }
    assert counts == {"retried": 1}
    (line, _) = capsys.readouterr().err.splitlines()
    assert (
        line.split("Z ")[1] == 'warning retried scenario=s-0 why="its worker was lost" attempts=1'
    )


def test_an_unusable_log_is_refused(tmp_path: Path) -> None:
    """An unknown level is refused with the nearest one, and so is a file in a missing folder."""
    with (
        pytest.raises(UsageError, match=r"unknown log level 'warn'.*Did you mean warning"),
        logged("warn", None),
    ):
        pass
    with pytest.raises(MachineError, match="cannot be written"), logged("", tmp_path / "none/log"):
        pass


def test_each_session_of_a_run_has_its_own_figures(tmp_path: Path) -> None:
    """The figures have this session's episodes, simulated seconds, process counts, and retries as
    logged."""
    run = run_of(tmp_path / "run", ["goal", "hit", "goal"])
    simulated_s = 0.05 * sum(
        record.ticks for record in read_records(run) if record.scenario.id != "s-000"
    )
    with logged("", None) as counts:
        go = ThroughputTimer(run, ["s-001", "s-002"], counts)
        log_event("retried", scenario="s-001")
        go.end()
    assert go.figures is not None
    append_throughput(
        run,
        msgspec.structs.replace(go.figures, wall_s=10.0, episodes_per_hour=720.0, times_real=1.6),
    )
    first, second = json.loads((run / "figures.json").read_text())
    assert (first["episodes"], first["retried"], first["given_up"]) == (2, 1, 0)
    assert first["simulated_s"] == pytest.approx(simulated_s) and second["wall_s"] == 10.0
    assert "2 episodes in" in go.figures.in_words and "1 retried, 0 given up" in go.figures.in_words
    assert first["answer_ms"] is None and "answer" not in go.figures.in_words


def test_the_answer_time_of_a_policy_is_reported(tmp_path: Path) -> None:
    """It is the median of the medians of the episodes that have one."""
    some = read_records(run_of(tmp_path / "run", ["goal", "hit", "goal", "hit"]))
    clocks = [{"answer_ms": ms} if ms else {} for ms in (2.0, 0.0, 30.0, 4.0)]
    took = [
        msgspec.structs.replace(record, clock=clock)
        for record, clock in zip(some, clocks, strict=True)
    ]
    assert median_answer_ms(took) == 4.0 and median_answer_ms(took[1:2]) is None
    figures = Throughput(
        began="",
        wall_s=1.0,
        episodes=4,
        simulated_s=1.0,
        episodes_per_hour=1.0,
        times_real=1.0,
        setup_s=0.0,
        driving_s=1.0,
        retried=0,
        given_up=0,
        answer_ms=4.123,
    )
    assert figures.in_words.endswith("; the median answer took 4.12 ms")
