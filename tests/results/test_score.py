"""Scores: recomputed from trajectories, compared with the recorded ones, and reported where they
differ."""

from __future__ import annotations

import io
import json
import os
import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pandas as pd
import pytest

from cosim.results.log import COLUMNS, Log
from cosim.results.metrics import METRICS
from cosim.results.record import Record
from cosim.results.rejudge import contradictions
from cosim.results.rescore import score_run
from cosim.results.run_folder import RunFolder, read_records, read_spec
from cosim.results.run_setup import METRIC_SCHEMA
from tests.conftest import Cosim
from tests.support.driven_runs import HIT, driven, episode_of, failure_at, run_of, short_way

Edit = Callable[[dict[str, Any]], object]


def rewrite(run: Path, scenario: str, edit: Edit) -> None:
    """Edit the record of an episode in its file and its row in the database."""
    file = run / "episodes" / scenario / "record.json"
    fields = json.loads(file.read_bytes())
    edit(fields)
    file.write_text(json.dumps(fields))
    with closing(sqlite3.connect(run / "results.sqlite")) as database, database:
        database.execute(
            "update episodes set record = ? where scenario = ?", (json.dumps(fields), scenario)
        )


def rewrite_log(run: Path, scenario: str, **columns: Callable[[Any], Any]) -> None:
    """Edit columns of a trajectory."""
    file = run / "episodes" / scenario / "trajectory.npz"
    log = Log.load(file)
    file.write_bytes(
        replace(
            log, **{name: edit(getattr(log, name).copy()) for name, edit in columns.items()}
        ).encoded()
    )


def put(index: Any, value: float) -> Callable[[Any], Any]:
    def edit(column: Any) -> Any:
        column[index] = value
        return column

    return edit


def test_a_run_scores_as_it_was_recorded(tmp_path: Path, cosim: Cosim) -> None:
    """Two driven to the goal, one that hit a wall and one crash score equal to the bit in every
    file."""
    result = cosim("score", str(run_of(tmp_path / "run", ["goal", HIT, "crashed", "goal"])))
    assert result.returncode == 0, result.stderr
    assert (
        f"3 episodes, {len(METRICS)} metrics each, by metric schema {METRIC_SCHEMA}"
        in result.stdout
    )
    assert "1 have no trajectory" in result.stdout
    assert "equal to the bit to record.json, results.sqlite, results.csv" in result.stdout


LOG_EDITS = {
    "a longer way": ({"travelled_m": put(3, 0.06)}, "failures_per_100m in record.json"),
    "another place": ({"pose": put((3, 0), 0.21)}, "route_s_m at tick 3"),
    "a shorter way": ({"travelled_m": put(3, 0.01)}, "travelled_m at tick 3"),
    "a nearer person": ({"person_m": put(3, 0.4)}, "pedestrian_distance_min_m in record.json"),
    "the last bit of one speed": (
        {"speed": put((4, 0), np.nextafter(1.0, 2.0))},
        "acceleration_mean_mps2",
    ),
    "a tick less": (
        dict.fromkeys(COLUMNS, lambda column: column[:-1]),
        "ticks in record.json: recorded 80, computed 79",
    ),
    "put back": (
        {"reset_s_m": put(9, 0.5)},
        "failures at tick 9 in record.json: recorded 0, computed 1",
    ),
}


@pytest.mark.parametrize("name", LOG_EDITS)
def test_an_edited_trajectory_is_found(tmp_path: Path, cosim: Cosim, name: str) -> None:
    """The first difference has episode, metric, recorded and recomputed value, and the exit code is
    1."""
    run = run_of(tmp_path / "run", ["goal", HIT])
    edits, expected = LOG_EDITS[name]
    rewrite_log(run, "s-001", **edits)
    result = cosim("score", str(run))
    assert result.returncode == 1 and f"different: episode s-001, {expected}" in result.stdout, (
        result
    )


RECORD_EDITS: dict[str, tuple[Edit, str]] = {
    "a better success": (
        lambda r: r["measures"].update(success=1.0),
        "success in record.json: recorded 1.0, computed",
    ),
    "no measure": (
        lambda r: r["measures"].pop("spl"),
        "spl in record.json: recorded None, computed 0.0",
    ),
    "no failure": (
        lambda r: r.update(failures=[]),
        "ended in record.json: recorded 'failure', computed 'not yet",
    ),
    "at the goal": (
        lambda r: r.update(ended="goal"),
        "ended in record.json: recorded 'goal', computed 'failure'",
    ),
    "elsewhere": (
        lambda r: r["failures"][0].update(x_m=3.0),
        "collision at tick 79: x_m, y_m, route_s_m",
    ),
    "at red elsewhere": (
        lambda r: r.update(red_light_entries=[{"tick": 5, "crossing": ":x"}]),
        "red_light_entries at tick 5 in record.json: recorded ':x'",
    ),
    "not the robot's": (
        lambda r: r.update(walked_into=r["failures"], failures=[]),
        "ended in record.json",
    ),
    "without its events": (
        lambda r: r.update(events=[{"id": "e0", "kind": "frontal", "passed": True}]),
        "events in record.json: recorded ['e0'], computed []",
    ),
    "invalid": (
        lambda r: r.update(status="invalid", reason="so"),
        "status in record.json: recorded 'invalid'",
    ),
}


@pytest.mark.parametrize("name", RECORD_EDITS)
def test_an_edited_record_is_found(tmp_path: Path, cosim: Cosim, name: str) -> None:
    """A record is compared with the trajectory, even where file and database were edited alike."""
    run = run_of(tmp_path / "run", ["goal", HIT])
    edit, expected = RECORD_EDITS[name]
    rewrite(run, "s-001", edit)
    result = cosim("score", str(run))
    assert result.returncode == 1 and f"different: episode s-001, {expected}" in result.stdout, (
        result
    )


def test_an_edited_table_is_found(tmp_path: Path, cosim: Cosim) -> None:
    """A changed digit or a missing metric of results.csv is found, and a column of a later version
    may be missing."""
    run = run_of(tmp_path / "run", ["goal", HIT])
    table = (run / "results.csv").read_text()
    speed = repr(read_records(run)[1].measures["velocity_mean_mps"])
    (run / "results.csv").write_text(table.replace(f",{speed},", f",{speed[:-1]}8,"))
    result = cosim("score", str(run))
    assert result.returncode == 1
    assert (
        f"episode s-001, velocity_mean_mps in results.csv: recorded {speed[:-1]}8, computed "
        f"{speed} (" in result.stdout
    )
    for column, expected in (
        ("spl", "spl in results.csv: recorded nothing, computed 1.0"),
        ("latency_ms", "equal to the bit"),
    ):
        pd.read_csv(io.StringIO(table), dtype=str).drop(columns=column).to_csv(
            run / "results.csv", index=False
        )
        assert expected in cosim("score", str(run)).stdout, column
    (run / "results.csv").write_text(table)


def test_the_failures_of_a_long_way_are_recomputed() -> None:
    """Added or omitted freezings, failures without a reset, and an early end contradict the
    trajectory."""
    way = short_way("s", ends_on_failure=False, time_limit_s=21.5)
    speeds = [1.0] * 60 + [0.0] * 260 + [1.0] * 110
    log = driven(way, speeds, {20: 0.0, 250: 2.0})
    both = failure_at(log, 20), failure_at(log, 250, "freezing")
    record = msgspec.structs.replace(
        episode_of(way, "h")[0], status="done", ended="timeout", ticks=430, failures=both
    )
    assert [*contradictions(record, way, log)] == []

    def differences(**fields: object) -> list[str]:
        changed = msgspec.structs.replace(record, **fields)  # type: ignore[arg-type]
        return [one.what for one in contradictions(changed, way, log)]

    assert differences(failures=both[:1]) == ["failures at tick 250", "freezings at tick 250"]
    assert differences(failures=both[1:]) == ["failures at tick 20"]
    assert (
        differences(failures=(*both, failure_at(log, 300, "freezing")))[-1]
        == "freezings at tick 300"
    )
    assert differences(ended="goal") == ["ended"]
    longer = short_way("s", ends_on_failure=False, time_limit_s=22.5)
    assert [one.what for one in contradictions(record, longer, log)] == ["ended"]


def refusal(cosim: Cosim, run: Path) -> str:
    """Return the refusal of `cosim score`, which is one line."""
    result = cosim("score", str(run))
    assert result.returncode == 2 and not result.stdout, result
    return result.stderr.splitlines()[-1]


def test_a_run_in_progress_is_refused(tmp_path: Path, cosim: Cosim) -> None:
    """The process that holds the folder is named, and nothing is read half-written."""
    run = run_of(tmp_path / "run", ["goal"])
    with RunFolder.resume(run, read_spec(run)):
        assert (
            f"error: {run} is in use by process {os.getpid()}: another cosim run is writing to it"
            in refusal(cosim, run)
        )


def test_a_run_without_an_episode_is_refused(tmp_path: Path, cosim: Cosim) -> None:
    """Without a finished episode the message says how to continue."""
    run = run_of(tmp_path / "run", ["goal"])
    with closing(sqlite3.connect(run / "results.sqlite")) as database, database:
        database.execute("delete from episodes")
    assert (
        f"{run}: no episode of it has ended: give the command of the run again with --resume"
        in refusal(cosim, run)
    )


def test_an_edited_suite_is_refused(tmp_path: Path, cosim: Cosim) -> None:
    """File and scenario are named when a goal was enlarged after the run."""
    run = run_of(tmp_path / "run", ["goal", HIT])
    file = run / "scenarios.json"
    lines = file.read_text().splitlines()
    lines[2] = lines[2].replace('"goal_radius_m":1.0', '"goal_radius_m":4.0')
    file.write_text("\n".join(lines))
    assert f"{file}: scenario 's-001' is not the one that was run, it was edited since" in refusal(
        cosim, run
    )


@pytest.mark.parametrize("name", ["record.json", "trajectory.npz"])
@pytest.mark.parametrize("damage", ["truncated", "a bit", "gone"])
def test_a_damaged_episode_is_refused_and_run_again(
    tmp_path: Path, cosim: Cosim, name: str, damage: str
) -> None:
    """File and remedy are named, and `--resume` names it and runs only this episode."""
    run = run_of(tmp_path / "run", ["goal", HIT, "goal", "crashed"])
    file = run / "episodes/s-001" / name
    data = file.read_bytes()
    if damage == "truncated":
        file.write_bytes(data[:200])
    elif damage == "a bit":
        at = data.index(b'"ticks": ') + 9 if name == "record.json" else 200
        file.write_bytes(data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :])
    else:
        file.unlink()
    message = refusal(cosim, run)
    assert (
        f"error: {file}: not " in message
        and "give the command of the run again with --resume, which" in message
    )
    with RunFolder.resume(run, read_spec(run)) as folder:
        assert folder.finished_ids() == {"s-000", "s-002", "s-003"}
        (note,) = folder.notes
        assert note.startswith(f"{file}: ") and note.endswith(". This episode is run again.")
    with RunFolder.resume(run, read_spec(run)) as again:
        assert again.finished_ids() == {"s-000", "s-002", "s-003"}


def test_an_unreadable_run_is_refused_with_a_remedy(tmp_path: Path, cosim: Cosim) -> None:
    """A bad run.json gives one line without the system's error text."""
    run = tmp_path / "run"
    run.mkdir()
    (run / "run.json").write_text("no JSON")
    message = refusal(cosim, run)
    assert (
        f"error: {run / 'run.json'}: cannot be read: " in message
        and "name another run" in message
        and "Errno" not in message
    )


def test_a_record_that_contradicts_the_database_is_refused(tmp_path: Path, cosim: Cosim) -> None:
    """`score` and `show` name the first difference when only the file was edited."""
    run = run_of(tmp_path / "run", ["goal"])
    file = run / "episodes/s-000/record.json"
    file.write_text(file.read_text().replace('"success": 1.0', '"success": 0.5'))
    message = refusal(cosim, run)
    shown = cosim("show", str(run))
    assert (
        shown.returncode == 2
        and not shown.stdout
        and shown.stderr.splitlines()[-1] == message.splitlines()[-1]
    )
    assert (
        f"{file}: not what results.sqlite has of this episode: measures.success is 0.5, "
        f"there 1.0: give the comm" in message
    )


def test_another_metric_schema_is_refused(tmp_path: Path, cosim: Cosim) -> None:
    """Measures of other or unrecorded definitions are refused, and every row has its schema."""
    run = run_of(tmp_path / "run", ["goal"])
    assert f",{METRIC_SCHEMA}," in (run / "results.csv").read_text()
    rewrite(run, "s-000", lambda record: record.update(metric_schema=METRIC_SCHEMA - 1))
    message = refusal(cosim, run)
    assert (
        f"{run}: the measures of 's-000' are of metric schema {METRIC_SCHEMA - 1}; this version has"
        in message
    )
    shown = cosim("show", str(run))
    assert shown.returncode == 0 and "its values are shown as recorded" in shown.stdout
    rewrite(run, "s-000", lambda record: record.pop("metric_schema"))
    assert "are of an earlier version, which did not record its metric schema" in refusal(
        cosim, run
    )


@pytest.mark.engine
@pytest.mark.parametrize(
    ("policy", "ends"),
    [
        ("straight", {"conversing-001": "failure"}),
        ("orca", {"gesturing-001": "stop", "static-001": "goal"}),
    ],
    ids=["straight", "orca"],
)
def test_engine_runs_score_to_the_bit(tmp_path: Path, policy: str, ends: dict[str, str]) -> None:
    """Shipped scenarios of a group, of no pedestrian, and of a stopping hand are run with real
    engines to each end."""
    from scenarios.runs.run import run
    from scenarios.suites.catalog import load_suite

    table = run(load_suite("reactive"), policy, scenarios=tuple(ends), out=tmp_path / "run")
    scored = score_run(tmp_path / "run")
    assert scored.differences == () and scored.episodes == len(ends) and scored.table
    assert set(table["metric_schema"]) == {METRIC_SCHEMA}
    for name, ended in ends.items():
        assert Record.load(tmp_path / "run/episodes" / name / "record.json").ended == ended
