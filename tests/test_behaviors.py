"""Event pedestrians as pure state machines."""

from __future__ import annotations

import itertools
import math

import msgspec
import numpy as np
import pytest

from cosim.errors import SpecError
from cosim.events import Actor, Event, EventQuery, EventReply, EventState, Kind
from scenarios.behaviors import BEHAVIORS, COMMIT_M, react

TICK_MS = 50


def event(kind: Kind, **fields: object) -> Event:
    """An event 50 m along a route on the x axis, on a sidewalk 4 m wide."""
    known = {"id": "e0", "kind": kind, "x_m": 50.0, "y_m": 0.0, "heading_rad": 0.0, "route_s_m": 50.0}
    return Event(**known | {"half_width_m": 2.0, "speed_mps": 1.2} | fields)  # type: ignore[arg-type]


def ask(one: Event, tick: int, x_m: float, y_m: float = 0.0, states: tuple[EventState, ...] = ()) -> EventReply:
    """The reply to a robot on the x axis that faces +x."""
    query = EventQuery(
        episode="t", tick=tick, tick_ms=TICK_MS, robot_x_m=x_m, robot_y_m=y_m, robot_heading_rad=0.0,
        robot_v_mps=1.0, robot_w_radps=0.0, route_s_m=x_m, robot_length_m=0.7, robot_width_m=0.55, events=(one,),
        states=states,
    )  # fmt: skip
    return react(query)


def drive(
    one: Event, ticks: int, speed_mps: float, start_m: float = 0.0
) -> list[tuple[float, EventState, Actor | None]]:
    """(robot x, state, actor) at every tick of a robot that drives along the x axis."""
    states: tuple[EventState, ...] = ()
    out = []
    for tick in range(ticks):
        x_m = start_m + speed_mps * tick * TICK_MS / 1000
        reply = ask(one, tick, x_m, states=states)
        states = reply.states
        out.append((x_m, reply.states[0], reply.actors[0] if reply.actors else None))
    return out


@pytest.mark.parametrize(("kind", "trigger_m"), [("obstructing", 10.0), ("frontal", 20.0)])
def test_an_event_triggers_at_its_distance(kind: Kind, trigger_m: float) -> None:
    """The trigger fires at the first tick at which the robot is within the distance of the paper's table."""
    track = drive(event(kind), 1000, 1.0)
    first = next(i for i, (_, state, _) in enumerate(track) if state.phase != "waiting")
    x_m, state, _ = track[first]
    assert 50.0 - trigger_m <= x_m < 50.0 - trigger_m + 0.051
    assert state.triggered_tick == first
    assert state.trigger_distance_m == pytest.approx(50.0 - x_m)


def test_an_obstructing_pedestrian_waits_aside_then_stands_in_the_middle_and_leaves() -> None:
    """It stands at the edge, walks to the middle when triggered, looks around, and steps back after its time."""
    track = drive(event("obstructing", hold_s=5.0), 1400, 0.2, start_m=35.0)
    waiting = [state for _, state, _ in track if state.phase == "waiting"]
    assert {(s.x_m, round(s.y_m, 9)) for s in waiting} == {(50.0, 1.6)}
    acting = [(state, actor) for _, state, actor in track if state.phase == "acting"]
    assert (acting[-1][0].x_m, acting[-1][0].y_m) == (50.0, 0.0)
    assert acting[-1][1] is not None and acting[-1][1].doing == "look"
    assert max(s.heading_rad for s, _ in acting[40:]) != min(s.heading_rad for s, _ in acting[40:])
    assert len(acting) == pytest.approx(100, abs=1)
    assert track[-1][1].phase == "over" and track[-1][1].y_m == pytest.approx(1.6)


def test_a_frontal_pedestrian_walks_at_the_robot_until_it_commits_to_a_line() -> None:
    """It aims at the robot's current place, keeps its speed, and from the commitment distance on keeps its line."""
    one = event("frontal")
    states: tuple[EventState, ...] = ()
    headings, gaps = [], []
    for tick in range(400):
        x_m, y_m = 31.0 + 0.02 * tick, 0.004 * tick
        before = states[0] if states else None
        reply = ask(one, tick, x_m, y_m, states)
        states = reply.states
        if before is not None and before.phase == "acting" and not states[0].blocked_ticks:
            gap = math.hypot(before.x_m - x_m, before.y_m - y_m)
            moved = math.hypot(states[0].x_m - before.x_m, states[0].y_m - before.y_m)
            assert moved == pytest.approx(1.2 * 0.05)
            if gap > COMMIT_M:
                aim = math.atan2(y_m - before.y_m, x_m - before.x_m)
                assert math.cos(states[0].heading_rad - aim) == pytest.approx(1.0)
            else:
                headings.append(states[0].heading_rad)
            gaps.append(gap)
    assert min(gaps) < 1.0
    assert len({round(h, 12) for h in headings[1:]}) == 1


def test_event_pedestrians_walk_no_faster_than_told_and_never_jump() -> None:
    """Between two ticks no actor moves farther than its speed allows."""
    for kind in BEHAVIORS:
        actors = [actor for _, _, actor in drive(event(kind), 1500, 1.3) if actor is not None]  # type: ignore[arg-type]
        assert len(actors) > 200
        for a, b in itertools.pairwise(actors):
            assert math.hypot(b.x_m - a.x_m, b.y_m - a.y_m) <= 1.2 * 0.05 + 1e-9


def test_the_director_is_stateless() -> None:
    """The same query gives the same reply, and its states are all that the next tick needs."""
    one = event("frontal")
    first = ask(one, 0, 32.0)
    assert msgspec.json.encode(ask(one, 0, 32.0)) == msgspec.json.encode(first)
    again = ask(one, 1, 32.1, states=first.states)
    restarted = ask(
        one, 1, 32.1, states=msgspec.json.decode(msgspec.json.encode(first.states), type=tuple[EventState, ...])
    )
    assert restarted == again


def test_a_kind_without_behaviour_is_refused_with_the_valid_ones() -> None:
    """An event that this version cannot perform is an error that lists those it can."""
    with pytest.raises(SpecError, match=r"no behaviour 'gesturing'\. Valid kinds: frontal, obstructing"):
        ask(event("gesturing"), 0, 0.0)
    with pytest.raises(SpecError, match="ids of event pedestrians start with 'e'"):
        event("frontal", id="x1")


def test_a_frontal_pedestrian_does_not_push_the_robot() -> None:
    """It runs into a standing robot, stops there, and after a while goes round it and on, never inside its outline."""
    one = event("frontal")
    states: tuple[EventState, ...] = ()
    gaps = []
    for tick in range(900):
        reply = ask(one, tick, 35.0, states=states)
        states = reply.states
        away = np.abs([states[0].x_m - 35.0, states[0].y_m]) - (0.35, 0.275)
        gaps.append(float(np.hypot(*np.maximum(away, 0.0))) - 0.3)
    assert -0.065 < min(gaps) <= 0.01
    assert sum(gap <= 0.01 for gap in gaps) == pytest.approx(40, abs=8)
    assert states[0].phase == "gone" and states[0].x_m < 33.0


def test_an_obstructing_pedestrian_does_not_step_into_the_robot() -> None:
    """When the robot already stands in the middle, the pedestrian comes near but never touches it."""
    one = event("obstructing")
    states: tuple[EventState, ...] = ()
    for tick in range(200):
        states = ask(one, tick, 50.0, states=states).states
        away = np.abs([states[0].x_m - 50.0, states[0].y_m]) - (0.35, 0.275)
        assert float(np.hypot(*np.maximum(away, 0.0))) - 0.3 > 0.0
    assert states[0].phase == "acting"
