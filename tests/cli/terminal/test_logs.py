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


def test_what_happens_is_a_line_of_json_and_a_line_of_words(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Both tell time, level, event and facts; what is below the level is left out; the file is
    appended to; nothing is said outside of the block."""
    for _ in range(2):
        with logged("info", tmp_path / "log.jsonl") as counts:
            log_event("claimed", logging.DEBUG, scenario="s-0")
            log_event(
                "retried", logging.WARNING, scenario="s-0", why="its worker was lost", attempts=1
            )
    log_event("retried", scenario="later")
    told = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert len(told) == 2 and told[0].pop("time")[10] == "T"
    assert told[0] == {
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


def test_a_log_that_cannot_be_kept_is_refused(tmp_path: Path) -> None:
    """A level that does not exist, with the nearest one; a file in no folder."""
    with (
        pytest.raises(UsageError, match=r"unknown log level 'warn'.*Did you mean warning"),
        logged("warn", None),
    ):
        pass
    with pytest.raises(MachineError, match="cannot be written"), logged("", tmp_path / "none/log"):
        pass


def test_figures_of_a_run_are_kept_for_each_time_that_it_went_on(tmp_path: Path) -> None:
    """Episodes of this go, simulated seconds, what its processes did, retries as they were
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


def test_what_the_policy_took_for_an_answer_is_told(tmp_path: Path) -> None:
    """The median of the episodes' medians, of those that tell."""
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
