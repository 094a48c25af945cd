"""Measurements of events from recorded tracks: by hand, and through the command."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from cosim.results.log import Log
from cosim.results.record import Record, TriggeredEvent
from cosim.spec.events import Event
from cosim.spec.manifest import Manifest
from cosim.spec.scenario import City, CrowdSpec, Scenario, Suite, write_suite
from scenarios.events import EVENT_KINDS
from scenarios.tools.viewing.event_sheet import COLUMNS, rows_of, sheet_of_run, summary
from tests.conftest import Cosim
from tests.logs import log_with
from tests.run_specs import record_of

TICK_S = 0.05


def scenario_of(kind: str) -> Scenario:
    """A scenario of 20 m along the x axis, with the event at 12 m."""
    event = Event(
        id="e0",
        kind=kind,
        x_m=12.0,
        y_m=0.0,
        heading_rad=0.0,
        route_s_m=12.0,
        half_width_m=1.5,
        speed_mps=1.2,
    )
    return Scenario(
        id="t",
        suite="t",
        place=City(seed=1),
        seed=0,
        start=(0.0, 0.0, 0.0),
        goal=(20.0, 0.0),
        route=((0.0, 0.0), (20.0, 0.0)),
        events=(event,),
    )


def log_of(x_m: np.ndarray, tracks: np.ndarray) -> Log:
    """The log of a robot along the x axis."""
    n = len(x_m)
    pose = np.column_stack([x_m, np.zeros(n), np.zeros(n)])
    travelled = np.diff(x_m, prepend=0.0)
    never = np.full(n, np.nan)
    return log_with(
        n, pose=pose, route_s_m=x_m, travelled_m=travelled, reset_s_m=never, event_tracks=tracks
    )


def test_a_crossing_walker_is_measured_as_it_walked() -> None:
    """By hand: triggered 3.95 m ahead of a robot at 2 m/s, walking to the right at 1.2 m/s from 1 m
    left."""
    x_m = 0.1 * np.arange(1, 121) - 0.05
    tick = int(np.flatnonzero(12.0 - x_m <= 4.0)[0]) + 1
    ticks = np.arange(tick, tick + 20)
    y = 1.0 - 1.2 * TICK_S * np.arange(20)
    tracks = np.column_stack([ticks, np.zeros(20), np.zeros(20), np.full(20, 12.0), y])
    scenario = scenario_of("lateral")
    outcome = TriggeredEvent(
        id="e0", kind="lateral", passed=True, triggered_at_s=tick * TICK_S, trigger_distance_m=3.95
    )
    record = msgspec.structs.replace(
        record_of(scenario, Manifest("p", camera=None)), status="done", events=(outcome,)
    )
    (row,) = rows_of(scenario, record, log_of(x_m, tracks))
    found = dict(zip(COLUMNS, row, strict=True))
    assert found["trigger_m"] == pytest.approx(3.95) and found["error_m"] == pytest.approx(0.05)
    assert found["period_m"] == pytest.approx(0.1)
    assert found["speed_mps"] == pytest.approx(1.2) and found["stated_mps"] == 1.2
    assert found["angle_deg"] == pytest.approx(-90.0)
    assert found["left_m"] == pytest.approx(1.0 - 1.2 * TICK_S * 9.5)
    assert found["least_m"] == pytest.approx(np.hypot(12.0 - x_m[ticks], y).min())


def test_a_late_trigger_is_counted() -> None:
    """A trigger that comes half a metre late at 0.1 m a tick is counted as late."""
    import pandas as pd

    late = ("t", "frontal", 20.0, 19.5, 0.5, 0.1, 1.2, 1.2, 0.0, 180.0, 0.9)
    fine = ("u", "frontal", 20.0, 19.95, 0.05, 0.1, 1.2, 1.2, 0.0, -180.0, 1.0)
    triggers, walks = summary(pd.DataFrame([late, fine], columns=list(COLUMNS)))
    assert triggers["off"].tolist() == ["1"] and triggers["n"].tolist() == [2]
    assert triggers["trigger m"].tolist() == ["19.50..19.95"] and walks["m/s"].tolist() == ["1.20"]


@pytest.mark.engine
def test_the_command_runs_one_event_and_shows_its_sheet(tmp_path: Path, cosim: Cosim) -> None:
    """--event selects it, an unknown one is answered with the valid ones, and --events shows the
    measurements."""
    from cosim.place.walk_graph import WalkGraph
    from scenarios.places.nets import place
    from scenarios.suites.reactive import build_reactive

    city = City(seed=1, size_m=500.0)
    _, street_map = place(city)
    graph = WalkGraph(street_map)
    fields = {"crowd": CrowdSpec(persons=4, radius_m=50.0, vehicles=0), "time_limit_s": 30.0}
    made = []
    for kind in ("frontal", "gesturing"):
        scenario = build_reactive(EVENT_KINDS[kind], city, street_map, graph, 1, kind)
        made.append(
            Scenario(
                **{name: getattr(scenario, name) for name in Scenario.__struct_fields__} | fields
            )
        )
    write_suite(Suite(name="tiny", version="1", scenarios=tuple(made)), tmp_path / "tiny.json")

    words = ("run", "tiny.json", "--event", "gesturing", "--policy", "orca", "--out", "mine")
    run = cosim(*words, cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    assert "scheduled 1, scored 1" in run.stdout
    shown = cosim("show", "mine", "--events", cwd=tmp_path)
    assert shown.returncode == 0, shown.stderr
    assert (
        "gesturing" in shown.stdout
        and "frontal" not in shown.stdout
        and "trigger m" in shown.stdout
    )
    (outcome,) = Record.load(tmp_path / f"mine/episodes/{made[1].id}/record.json").events
    (row,) = sheet_of_run(tmp_path / "mine").itertuples(index=False)
    assert outcome.triggered_at_s is not None and outcome.seen
    assert row.trigger_m == pytest.approx(outcome.trigger_distance_m, abs=1e-6)
    assert row.stated_m == made[1].events[0].trigger_m and row.error_m <= row.period_m + 0.005
    beside_m = -0.9 * made[1].events[0].free_side
    assert np.isnan(row.speed_mps) and row.left_m == pytest.approx(beside_m, abs=0.01)
    assert cosim("score", "mine", cwd=tmp_path).returncode == 0
    wrong = cosim("run", "tiny.json", "--event", "frontl", cwd=tmp_path)
    assert (
        wrong.returncode == 2
        and "event 'frontl'" in wrong.stderr
        and "frontal, gesturing" in wrong.stderr
    )
