"""The go-on rule of decoys: the end of its window, its violations, and the check of a record."""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import numpy as np
import pytest

from cosim.core.geometry import Polyline
from cosim.core.state import Command
from cosim.report.page.reasons import mishaps_of, reason_of
from cosim.results.go_on import OVERTAKEN_M, STOP_S, Passing, PassingWindow, passing_of, rule_met
from cosim.results.log import Log
from cosim.results.metrics import EpisodeFacts, success
from cosim.results.record import Record
from cosim.results.rejudge import contradictions
from cosim.spec.events import Event
from cosim.spec.manifest import Manifest
from cosim.spec.scenario import Scenario
from scenarios.episodes.episode import Episode
from scenarios.events import EVENT_KINDS
from scenarios.suites.catalog import load_suite

ROUTE = Polyline(((0.0, 0.0), (30.0, 0.0)))
EVENT = Event(
    id="e0", kind="lateral", x_m=10.0, y_m=0.0, heading_rad=0.0, route_s_m=10.0, half_width_m=1.6
)


def window_end(
    kind: str, robot_mps: float, person: Callable[[float], float | None], **fields: object
) -> int | None:
    """Return the tick after the window of a robot from 8 m on; `person` gives arc length at a time,
    None for gone."""
    event = msgspec.structs.replace(EVENT, **fields)
    window = PassingWindow(ROUTE, event, EVENT_KINDS[kind])
    for tick in range(200):
        at_s = (tick + 1) / 20
        place = person(at_s)
        people = {} if place is None else {0: np.array([place, 1.0])}
        window.update(tick, 8.0 + robot_mps * at_s, people)
    return window.end


def test_the_window_ends_one_metre_past_the_person() -> None:
    """It ends at 11 m for a person at 10 m, never for one who walks ahead, and when one leaves the
    street."""
    assert window_end("lateral", 1.0, lambda s: 10.0) == 60
    assert window_end("lateral", 1.0, lambda s: 10.0 + 1.2 * s) is None
    assert window_end("lateral", 1.0, lambda s: None if s > 2.0 else 10.0 + s) == 41
    assert window_end("lateral", 0.1, lambda s: 10.0) is None


def test_the_window_of_an_overtaking_person_ends_by_the_robots_place() -> None:
    """It ends at 18.8 m wherever the person is, and a trigger of the scenario's own counts like the
    kind's."""
    places: list[Callable[[float], float | None]] = [lambda s: 7.0 + 2.0 * s, lambda s: None]
    for place in places:
        assert window_end("overtaking", 2.0, place) == 108
        assert window_end("lateral", 2.0, place, trigger_m=-0.5) == 103
        assert window_end("overtaking", 0.9, place) is None


def test_no_motion_meets_both_the_event_rule_and_the_go_on_rule() -> None:
    """Of 500 random motions each that passes the person meets exactly one rule, and one that does
    not pass neither."""
    rng = np.random.default_rng(29)
    decoy = msgspec.structs.replace(EVENT, kind="overtaking", decoy=True)
    event = msgspec.structs.replace(decoy, decoy=False)
    met = []
    for _ in range(500):
        v_mps = np.repeat(rng.uniform(0.0, 2.0, 20) * (rng.random(20) < 0.9), 12)
        route_s_m = EVENT.route_s_m + 1.0 + np.cumsum(v_mps) * 0.05
        ends = []
        for twin, away_m in ((event, 0.9), (decoy, 4.0)):
            window = PassingWindow(ROUTE, twin, EVENT_KINDS["overtaking"])
            for tick, s_m in enumerate(route_s_m.tolist()):
                window.update(tick, s_m, {0: np.array([s_m + away_m, 0.0])})
            ends.append(window.end)
        assert ends[0] == ends[1]
        end = ends[0] or 0
        assert not end or route_s_m[end - 1] >= EVENT.route_s_m + 1.0 + OVERTAKEN_M
        passing, limit_mps = (
            passing_of(route_s_m, v_mps, 0.05, 0, end),
            float(rng.uniform(0.5, 1.5)),
        )
        rules = [rule_met(twin, passing, limit_mps) for twin in (event, decoy)]
        assert sum(rules) == (passing is not None)
        met.append((passing is not None, *rules))
    assert set(met) == {(True, True, False), (True, False, True), (False, False, False)}


def test_mean_speed_and_stops_are_those_of_the_window() -> None:
    """Ticks outside do not count, backwards is slower than a stop, and 0.45 s is no stop."""
    v_mps = np.array([0.0] * 20 + [2.0] * 10 + [0.0] * 9 + [2.0] * 21 + [0.0] * 40)
    route_s_m = np.cumsum(v_mps) * 0.05
    assert passing_of(route_s_m, v_mps, 0.05, 20, 60) == pytest.approx((3.1 / 2.0, 0.45))
    assert passing_of(route_s_m, v_mps, 0.05, 20, 101) is None
    longer = np.where(np.arange(100) == 39, -1.0, v_mps)
    found = passing_of(np.cumsum(longer) * 0.05, longer, 0.05, 20, 60)
    assert found is not None and found.stopped_s == pytest.approx(STOP_S)
    assert found.mean_mps > 1.4 and not found.goes_on(1.0)
    assert Passing(1.0, 0.45).goes_on(1.0) and not Passing(0.99, 0.0).goes_on(1.0)


def shipped(name: str = "gesturing-064-decoy") -> Scenario:
    """A scenario of `reactive`, by default a decoy with another gesture, without fences, and with
    more time for slow robots."""
    (one,) = (s for s in load_suite("reactive").scenarios if s.id == name)
    return msgspec.structs.replace(one, obstacles=(), time_limit_s=60.0)


def drive(scenario: Scenario, speed: Callable[[float, float], float]) -> tuple[Record, Log]:
    """Drive an episode straight ahead at a speed by time, s, and arc length, m."""
    with Episode(scenario, Manifest("ahead", camera=None)) as episode:
        episode.reset()
        while not episode.over:
            s_m = episode.moment.route_s_m
            episode.advance(Command(speed(episode.time_s, s_m), 0.0))
        return episode.result()


@pytest.mark.engine
def test_a_decoy_is_solved_only_by_going_on() -> None:
    """1.2 m/s solves it; a stop at any mean speed and a crawl break the rule though they reach the
    goal; the files agree."""
    scenario = shipped()
    (event,) = scenario.events
    record, log = drive(scenario, lambda time_s, s_m: 1.2)
    (passed,) = record.events
    assert (record.status, record.ended, passed.rule_met) == ("done", "goal", True), record
    assert record.measures["success"] == 1.0 and record.scenario.decoy_of == "gesturing-064"
    assert passed.passed_at_s is not None and passed.passing_mps == pytest.approx(1.2, abs=0.1)
    end = log.tick_at(passed.passed_at_s) - 1
    assert log.route_s_m[end] == pytest.approx(event.route_s_m + 1.0, abs=0.1)
    assert not [*contradictions(record, scenario, log)]

    paused: list[float] = []

    def stops(time_s: float, s_m: float) -> float:
        if s_m > event.route_s_m - 3.0 and (not paused or time_s - paused[0] < 2.0):
            paused.append(time_s)
            return 0.0
        return 2.4

    def crawls(time_s: float, s_m: float) -> float:
        return 0.55 if abs(s_m - event.route_s_m) < 8.0 else 1.2

    broken = {"stopped for": stops, "passed at 0.5": crawls}
    for words, speed in broken.items():
        record, log = drive(scenario, speed)
        (passed,) = record.events
        assert (record.status, record.ended, record.failures) == ("done", "goal", ()), words
        assert passed.rule_met is False and record.measures["success"] == 0.0
        assert record.measures["broke_rule"] == 1.0
        assert ((passed.passing_mps or 0.0) > scenario.go_on_mps) == (words == "stopped for")
        (mishap,) = mishaps_of(record)
        assert words in reason_of(scenario, record, mishap, log)
        assert not [*contradictions(record, scenario, log)]
        better = msgspec.structs.replace(passed, rule_met=True)
        edited = msgspec.structs.replace(record, events=(better,))
        assert [one.what for one in contradictions(edited, scenario, log)] == [
            "rule_met of event e0"
        ]
        faster = msgspec.structs.replace(passed, stopped_s=0.0, passing_mps=2.0, rule_met=True)
        edited = msgspec.structs.replace(record, events=(faster,))
        assert [one.what for one in contradictions(edited, scenario, log)] == [
            "passing_mps, stopped_s of event e0",
            "rule_met of event e0",
        ]
        early = msgspec.structs.replace(passed, passed_at_s=None)
        edited = msgspec.structs.replace(record, events=(early,))
        assert "passed_at_s of event e0" in [c.what for c in contradictions(edited, scenario, log)]


@pytest.mark.engine
def test_a_robot_that_never_passes_has_not_gone_on() -> None:
    """A robot that stays before the person neither meets nor breaks the rule, and does not succeed;
    without the rule there is no result."""
    scenario = msgspec.structs.replace(shipped(), time_limit_s=9.0)
    (event,) = scenario.events
    waits = lambda time_s, s_m: 0.0 if s_m > event.route_s_m - 3.0 else 1.5  # noqa: E731
    record, log = drive(scenario, waits)
    (outcome,) = record.events
    assert (record.ended, outcome.passed_at_s, outcome.rule_met) == ("timeout", None, False)
    assert outcome.triggered_at_s is not None and not [*contradictions(record, scenario, log)]
    assert (record.measures["broke_rule"], record.measures["success"]) == (0.0, 0.0)
    reached = EpisodeFacts.of(msgspec.structs.replace(record, ended="goal"), scenario, log)
    assert (success(reached), reached.rules_broken) == (0.0, 0)
    record, _ = drive(msgspec.structs.replace(scenario, go_on_mps=0.0), waits)
    assert record.events[0].rule_met is None


@pytest.mark.engine
def test_a_decoy_that_the_robot_never_saw_is_not_solved() -> None:
    """As for an event, reaching the goal does not count when the gesture begins outside the
    camera's view."""
    scenario = shipped()
    unseen = msgspec.structs.replace(scenario.events[0], trigger_m=0.2)
    scenario = msgspec.structs.replace(scenario, events=(unseen,))
    record, _ = drive(scenario, lambda time_s, s_m: 1.2)
    assert (record.status, record.ended) == ("done", "goal")
    assert record.measures["success"] == 0.0
    assert record.reason == "bypassed: nobody of event e0 (gesturing) was seen"


@pytest.mark.engine
def test_driving_past_a_person_who_holds_out_a_hand_breaks_the_rule() -> None:
    """The episode ends beside the person, and the referee counts no failure."""
    record, _ = drive(shipped("gesturing-064"), lambda time_s, s_m: 1.2)
    assert (record.ended, record.failures) == ("failure", ())
    assert (record.measures["broke_rule"], record.measures["success"]) == (1.0, 0.0)
