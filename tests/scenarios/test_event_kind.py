"""A kind of event is a table row: one that is defined only in this file is drawn, read, simulated,
judged and shown."""

from __future__ import annotations

import ast
import dataclasses
import math
from pathlib import Path

import msgspec
import pandas as pd
import pytest

from cosim.core.errors import SpecError
from cosim.core.state import Age, Command, PersonKind
from cosim.episode.loop import Step
from cosim.place.walk_graph import WalkGraph
from cosim.results.referee import Verdict
from cosim.spec.events import (
    Event,
    EventKind,
    EventKinds,
    EventQuery,
    EventState,
    SidewalkLayout,
    Walker,
)
from cosim.spec.manifest import Manifest
from cosim.spec.robot import COURIER, ROBOTS, Robot
from cosim.spec.scenario import City, CrowdSpec, Scenario, event_faults, read_suite, write_suite
from scenarios.episodes.episode import Episode
from scenarios.events import EVENT_KINDS
from scenarios.events.sight import sight_of
from scenarios.events.walking import edge_m, walk_to, walker_at, world_point
from scenarios.places.nets import place
from scenarios.suites.catalog import load_suite
from scenarios.suites.fits import check_places
from scenarios.suites.long_horizon import build_long_horizon
from scenarios.suites.sample import suite_on_map
from scenarios.tools.verify.doctor import small_scenario
from scenarios.tools.viewing.event_sheet import COLUMNS, rows_of, summary
from sumo_nets.city.store import write_city
from tests.conftest import ROOT

TRIGGER_M = 7.0


def begin(event: Event, number: int) -> Walker:
    """Return the first states of two people, at either edge of the sidewalk."""
    return walker_at(event, 0.0, (1 - 2 * number) * edge_m(event), math.pi)


def change_sides(event: Event, state: EventState, number: int, query: EventQuery) -> Walker:
    """Move the people to the other edge, and back when the event is over."""
    side = (2 * number - 1) * (1 if state.phase == "acting" else -1)
    goal = world_point(event, 0.6 * number, side * edge_m(event))
    return walk_to(state.walkers[number], *goal, event.speed_mps, sight_of(event, number, query))


def after_three_seconds(event: Event, state: EventState, query: EventQuery) -> bool:
    return (query.tick - state.since_tick) * query.tick_ms >= 3000


SWAPPING = EventKind(
    name="swapping",
    people=(2, 2),
    layout=SidewalkLayout((16.0, 18.0), (9.0, 10.0)),
    trigger_m=TRIGGER_M,
    begin=begin,
    step=change_sides,
    ends=after_three_seconds,
    pose="phone",
    age=Age.CHILD,
    passed_as_group=True,
)
NEEDS_ROOM = SidewalkLayout((16.0, 18.0), (9.0, 10.0), half_width_m=1.9)
KINDS: EventKinds = EVENT_KINDS | {SWAPPING.name: SWAPPING}  # type: ignore[operator]


def test_rows_match_the_paper_and_trigger_on_the_way() -> None:
    """There are eight kinds, and the robot starts farther from an event than its trigger
    distance."""
    assert [*EVENT_KINDS] == [
        "obstructing",
        "conversing",
        "queueing",
        "frontal",
        "lateral",
        "overtaking",
        "ped_crossing",
        "gesturing",
    ]
    for kind in EVENT_KINDS.values():
        if kind.layout is not None:
            assert kind.trigger_m is not None and abs(kind.trigger_m) < kind.layout.event_m[0]
            assert kind.layout.event_m[0] - kind.trigger_m < kind.layout.way_m[0]
        assert (kind.trigger_m is None) == (kind.layout is None) and 1 <= kind.people[
            0
        ] <= kind.people[1]


def test_only_the_file_of_a_kind_names_it() -> None:
    """No other module names a kind, except the table of the paper's figures."""
    named = [
        f"{path.relative_to(ROOT)}: {node.value}"
        for room in ("cosim", "sumo_nets", "physics", "bridge", "scenarios")
        for path in (ROOT / room).rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Constant)
        and node.value in EVENT_KINDS
        and path.parent.name != "events"
        and path.name != "paper.py"
    ]
    assert not named


@pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)
def test_long_routes_use_the_given_table_of_kinds(robot: Robot) -> None:
    """A kind with several people is placed where its layout and the robot fit, with as many people
    as its row says."""
    where = small_scenario().place
    _, street_map = place(where)
    loitering = dataclasses.replace(SWAPPING, people=(2, 4), layout=NEEDS_ROOM)
    for kinds, count in (({loitering.name: loitering}, 1), (EVENT_KINDS, 4)):
        drawn = build_long_horizon(
            where, street_map, WalkGraph(street_map), 2, "long", robot, kinds
        )
        assert len(drawn.events) == count and list(event_faults(drawn, kinds)) == []
        for event in drawn.events:
            layout = kinds[event.kind].layout
            assert (layout is None) == (event.half_length_m > 0.0)
            if layout is not None:
                assert event.half_width_m >= layout.half_width_m + robot.width_m - COURIER.width_m


def test_an_invalid_suite_made_in_python_is_refused() -> None:
    """Events that contradict the table are refused before anything runs."""
    suite = load_suite("reactive")
    first, second = suite.scenarios[:2]
    odd = [with_event(first, people=3), with_event(second, kind="swapping")]
    with pytest.raises(SpecError) as refusal:
        check_places(suite, odd)
    message = str(refusal.value)
    assert (
        f"scenario '{first.id}': event 'e0': people of '{first.events[0].kind}' must be 1, not 3"
        in message
    )
    assert (
        f"scenario '{second.id}': Invalid enum value 'swapping' - at `$.events[0].kind`. "
        f"Valid choices: obstr" in message
    )


def with_event(scenario: Scenario, **changed: object) -> Scenario:
    """Return the scenario with a changed event."""
    return msgspec.structs.replace(
        scenario, events=(msgspec.structs.replace(scenario.events[0], **changed),)
    )


@pytest.mark.engine
def test_an_event_is_defined_by_its_row_alone(tmp_path: Path) -> None:
    """A new row is sampled on a city, written, read, simulated over Zenoh, triggered, monitored and
    shown; without its row it is refused everywhere."""
    write_city(City(seed=1, size_m=500.0), tmp_path / "city")
    drawn = suite_on_map("reactive", str(tmp_path / "city"), 3, 1, events=["swapping"], kinds=KINDS)
    write_suite(drawn, tmp_path / "s.json")
    (sampled,) = read_suite(tmp_path / "s.json", KINDS).scenarios
    with pytest.raises(
        SpecError,
        match=r"'swapping' - at `\$.scenarios\[0\].events\[0\].kind`. Valid choices: obstr",
    ):
        read_suite(tmp_path / "s.json", EVENT_KINDS)
    few = CrowdSpec(persons=3, radius_m=40.0, vehicles=0)
    scenario = msgspec.structs.replace(sampled, crowd=few, obstacles=(), time_limit_s=11.0)
    (planned,) = scenario.events
    assert planned.trigger_m is not None and planned.trigger_m <= TRIGGER_M
    stops_at_m = planned.route_s_m - planned.trigger_m + 0.3
    manifest = Manifest("ahead", camera=None)
    with (
        pytest.raises(SpecError, match=f"scenario '{scenario.id}': .*'swapping'"),
        Episode(scenario, manifest),
    ):
        pass

    doing: set[tuple[str, ...]] = set()
    phases = set()

    def watch(step: Step, verdict: Verdict) -> None:
        people = step.street_after.people
        pair = people.only(people.are(PersonKind.EVENT).nonzero()[0])
        assert pair.age.tolist() == [Age.CHILD] * 2
        doing.add(pair.doing)
        phases.add(step.events.states[0].phase)

    with Episode(scenario, manifest, watches=[watch], kinds=KINDS) as episode:
        episode.reset()
        while not episode.over:
            episode.advance(Command(0.9 if episode.moment.route_s_m < stops_at_m else 0.0, 0.0))
    record, log = episode.result()
    (event,) = record.events
    assert (record.status, event.kind, event.seen, event.rule_met) == (
        "done",
        "swapping",
        True,
        True,
    ), record.reason
    assert event.trigger_distance_m == pytest.approx(planned.trigger_m, abs=0.06)
    assert (
        ("stand", "stand") in doing
        and ("walk", "walk") in doing
        and any("phone" in pair for pair in doing)
    )
    assert phases == {"waiting", "acting", "over"}
    sheet = pd.DataFrame(rows_of(scenario, record, log, KINDS), columns=list(COLUMNS))
    assert sheet["kind"].tolist() == ["swapping"] * 2
    triggers, _ = summary(sheet)
    assert triggers[["event", "stated", "off"]].to_numpy().tolist() == [
        ["swapping", f"{planned.trigger_m:.2f}", "0"]
    ]
