"""Event pedestrians as pure state machines."""

from __future__ import annotations

import itertools
import math

import msgspec
import numpy as np
import pytest

from cosim.core.errors import SpecError
from cosim.spec.events import Actor, Event, EventQuery, EventReply, EventState
from scenarios.events import EVENT_KINDS, react
from scenarios.events.frontal import COMMIT_M
from scenarios.events.standing import QUEUE_M

TICK_MS = 50
PEOPLE = {"conversing": 3, "queueing": 3, "ped_crossing": 4}


def event(kind: str, **fields: object) -> Event:
    """Return an event 50 m along a route on the x axis, on a sidewalk 4 m wide."""
    known = {
        "id": "e0",
        "kind": kind,
        "x_m": 50.0,
        "y_m": 0.0,
        "heading_rad": 0.0,
        "route_s_m": 50.0,
    }
    known |= {"half_width_m": 2.0, "speed_mps": 1.2, "people": PEOPLE.get(kind, 1)}
    known |= {"half_length_m": 5.0} if kind == "ped_crossing" else {}
    return Event(**known | fields)  # type: ignore[arg-type]


def reply_to_robot(
    planned: Event,
    tick: int,
    x_m: float,
    y_m: float = 0.0,
    states: tuple[EventState, ...] = (),
    v_mps: float = 1.0,
) -> EventReply:
    """Return the reply to a robot on the x axis that faces +x."""
    query = EventQuery(
        episode="t",
        tick=tick,
        tick_ms=TICK_MS,
        robot_x_m=x_m,
        robot_y_m=y_m,
        robot_heading_rad=0.0,
        robot_v_mps=v_mps,
        robot_w_radps=0.0,
        route_s_m=x_m,
        robot_length_m=0.7,
        robot_width_m=0.55,
        events=(planned,),
        states=states,
    )
    return react(query)


def drive(
    planned: Event, ticks: int, speed_mps: float, start_m: float = 0.0
) -> list[tuple[float, EventState, Actor | None]]:
    """Return (robot x, state, actor) at every tick of a robot that drives along the x axis."""
    states: tuple[EventState, ...] = ()
    out = []
    for tick in range(ticks):
        x_m = start_m + speed_mps * tick * TICK_MS / 1000
        reply = reply_to_robot(planned, tick, x_m, states=states, v_mps=speed_mps)
        states = reply.states
        out.append((x_m, reply.states[0], reply.actors[0] if reply.actors else None))
    return out


@pytest.mark.parametrize(
    ("kind", "trigger_m"),
    [
        ("obstructing", 10.0),
        ("conversing", 10.0),
        ("queueing", 10.0),
        ("gesturing", 10.0),
        ("frontal", 20.0),
        ("lateral", 4.0),
        ("overtaking", -1.0),
        ("ped_crossing", 5.0),
    ],
)
def test_an_event_triggers_at_its_distance(kind: str, trigger_m: float) -> None:
    """The trigger fires at the first tick at which the robot is within the distance of the paper's
    table; overtaking at the last such tick behind the robot, a crossing at the end of its
    crosswalk."""
    track = drive(event(kind), 1100, 1.0)
    first = next(i for i, (_, state, _) in enumerate(track) if state.phase != "waiting")
    x_m, state, _ = track[first]
    early_m, late_m = (0.051, 1e-9) if kind == "overtaking" else (1e-9, 0.051)
    assert -early_m <= x_m - (50.0 - trigger_m) <= late_m
    assert state.triggered_tick == first
    assert state.trigger_distance_m == pytest.approx(50.0 - x_m)


def test_an_obstructing_pedestrian_waits_aside_then_stands_in_the_middle_and_leaves() -> None:
    """It stands at the edge, walks to the middle when triggered, looks around, and steps back when
    the robot is 3 m past."""
    track = drive(event("obstructing"), 1400, 0.4, start_m=35.0)
    waiting = [state for _, state, _ in track if state.phase == "waiting"]
    assert {(s.walkers[0].x_m, round(s.walkers[0].y_m, 9)) for s in waiting} == {(50.0, 1.6)}
    acting = [(x, state, actor) for x, state, actor in track if state.phase == "acting"]
    assert (acting[-1][1].walkers[0].x_m, acting[-1][1].walkers[0].y_m) == (50.0, 0.0)
    assert acting[-1][2] is not None and acting[-1][2].doing == "look"
    turns = [s.walkers[0].heading_rad for _, s, _ in acting[40:]]
    assert max(turns) - min(turns) > 1.0
    assert acting[-1][0] == pytest.approx(53.0, abs=0.021)
    assert track[-1][1].phase == "over" and track[-1][1].walkers[0].y_m == pytest.approx(1.6)


def test_a_frontal_pedestrian_walks_at_the_robot_until_it_commits_to_a_line() -> None:
    """It aims ahead of the robot according to their distance, keeps its speed, and keeps its line
    within the commitment distance."""
    planned = event("frontal")
    states: tuple[EventState, ...] = ()
    headings = []
    gaps = []
    for tick in range(400):
        x_m = 31.0 + 0.02 * tick
        y_m = 0.004 * tick
        acted = bool(states) and states[0].phase == "acting"
        before = states[0].walkers[0] if states else None
        reply = reply_to_robot(planned, tick, x_m, y_m, states)
        states = reply.states
        now = states[0].walkers[0]
        if before is not None and acted and not now.blocked_ticks:
            gap = math.hypot(before.x_m - x_m, before.y_m - y_m)
            moved = math.hypot(now.x_m - before.x_m, now.y_m - before.y_m)
            assert moved == pytest.approx(1.2 * 0.05)
            if gap > COMMIT_M:
                lead_m = min((gap - 0.7) / 2.3, 1.0)
                aim = math.atan2(y_m - before.y_m, x_m + lead_m - before.x_m)
                assert math.cos(now.heading_rad - aim) == pytest.approx(1.0)
            else:
                headings.append(now.heading_rad)
            gaps.append(gap)
    assert min(gaps) < 1.0
    assert len({round(h, 12) for h in headings[1:]}) == 1


def test_event_pedestrians_keep_their_speed_limit_and_never_jump() -> None:
    """Between two ticks no event pedestrian moves farther than its speed allows."""
    for kind in EVENT_KINDS:
        fastest = {"lateral": 2.0, "overtaking": 2.7}.get(kind, 1.2)
        states = [state for _, state, _ in drive(event(kind), 1500, 1.3)]
        for a, b in itertools.pairwise(states):
            for old, new in zip(a.walkers, b.walkers, strict=True):
                assert math.hypot(new.x_m - old.x_m, new.y_m - old.y_m) <= fastest * 0.05 + 1e-9


def test_the_director_is_stateless() -> None:
    """The same query gives the same reply, and the returned states are all that the next tick
    needs."""
    planned = event("frontal")
    first = reply_to_robot(planned, 0, 32.0)
    assert msgspec.json.encode(reply_to_robot(planned, 0, 32.0)) == msgspec.json.encode(first)
    again = reply_to_robot(planned, 1, 32.1, states=first.states)
    restarted = reply_to_robot(
        planned,
        1,
        32.1,
        states=msgspec.json.decode(msgspec.json.encode(first.states), type=tuple[EventState, ...]),
    )
    assert restarted == again


def test_an_event_with_an_invalid_id_is_refused() -> None:
    """The message names the reserved prefix of ids."""
    with pytest.raises(SpecError, match="ids of event pedestrians start with 'e'"):
        event("frontal", id="x1")
    with pytest.raises(SpecError, match="'ei-' begins the ids of injected pedestrians"):
        event("frontal", id="ei-anna")


def test_a_frontal_pedestrian_does_not_push_the_robot() -> None:
    """It stops at a robot that does not move, and after its patience walks round it, never inside
    its outline."""
    planned = event("frontal")
    states: tuple[EventState, ...] = ()
    gaps = []
    for tick in range(900):
        reply = reply_to_robot(planned, tick, 35.0, states=states)
        states = reply.states
        away = np.abs([states[0].walkers[0].x_m - 35.0, states[0].walkers[0].y_m]) - (0.35, 0.275)
        gaps.append(float(np.hypot(*np.maximum(away, 0.0))) - 0.3)
    assert -0.065 < min(gaps) <= 0.01
    assert sum(gap <= 0.01 for gap in gaps) == pytest.approx(50, abs=8)
    assert states[0].phase == "gone" and states[0].walkers[0].x_m < 33.0


def test_an_obstructing_pedestrian_does_not_step_into_the_robot() -> None:
    """When the robot already stands in the middle, the pedestrian comes near without touching
    it."""
    planned = event("obstructing")
    states: tuple[EventState, ...] = ()
    for tick in range(200):
        states = reply_to_robot(planned, tick, 50.0, states=states).states
        away = np.abs([states[0].walkers[0].x_m - 50.0, states[0].walkers[0].y_m]) - (0.35, 0.275)
        assert float(np.hypot(*np.maximum(away, 0.0))) - 0.3 > 0.0
    assert states[0].phase == "acting"


def test_talkers_stand_in_a_circle_and_face_each_other() -> None:
    """Once in place they have equal distances from the middle of the sidewalk, and all of them face
    it."""
    for people in (2, 3, 4):
        track = drive(event("conversing", people=people), 400, 0.3, start_m=39.0)
        walkers = track[-1][1].walkers
        radii = [math.hypot(w.x_m - 50.0, w.y_m) for w in walkers]
        assert max(radii) - min(radii) < 1e-9 and 0.5 < radii[0] < 0.8
        for w in walkers:
            assert math.cos(w.heading_rad - math.atan2(-w.y_m, 50.0 - w.x_m)) == pytest.approx(1.0)
        assert (
            min(
                math.dist((a.x_m, a.y_m), (b.x_m, b.y_m))
                for a, b in itertools.combinations(walkers, 2)
            )
            > 0.7
        )


def test_a_queue_is_a_line_from_one_side() -> None:
    """The line is even across the sidewalk from its edge, faces that edge, and leaves the other
    side open."""
    for side in (-1, 1):
        walkers = drive(event("queueing", side=side), 400, 0.3, start_m=39.0)[-1][1].walkers
        assert all(w.x_m == pytest.approx(50.0) for w in walkers)
        left = [side * w.y_m for w in walkers]
        assert left == pytest.approx([1.7, 1.7 - QUEUE_M, 1.7 - 2 * QUEUE_M])
        assert all(math.sin(w.heading_rad) == pytest.approx(side) for w in walkers)


@pytest.mark.parametrize("speed_mps", [0.7, 1.0, 1.5, 2.2])
@pytest.mark.parametrize("side", [-1, 1])
def test_a_lateral_pedestrian_meets_a_robot_that_keeps_its_velocity(
    speed_mps: float, side: int
) -> None:
    """It walks evenly at a right angle to the robot's path, and without contact would meet its
    centre."""
    planned = event("lateral", side=side)
    track = drive(planned, int(60 / speed_mps * 20), speed_mps)
    acting = [(x, state.walkers[0]) for x, state, _ in track if state.phase == "acting"]
    assert all(w.x_m == pytest.approx(50.0) for _, w in acting)
    _, first = acting[0]
    assert first.pace_mps is not None and first.aim_rad == pytest.approx(-side * math.pi / 2)
    in_s = (50.0 - acting[0][0]) / speed_mps
    assert abs(first.y_m + side * first.pace_mps * 0.05) / first.pace_mps == pytest.approx(in_s)
    gaps = []
    for x, w in acting:
        away = np.abs([w.x_m - x, w.y_m]) - (0.35, 0.275)
        gaps.append(float(np.hypot(*np.maximum(away, 0.0))) - 0.3)
    assert min(gaps) < 0.02


def test_an_overtaking_pedestrian_passes_beside_the_robot_and_cuts_in() -> None:
    """It starts behind the robot, is faster, passes without a touch, and slows down on the robot's
    line."""
    track = drive(event("overtaking"), 900, 1.2, start_m=40.0)
    acting = [(x, s.walkers[0]) for x, s, _ in track if s.phase == "acting"]
    assert -1.0 <= acting[0][1].x_m - acting[0][0] < -0.85
    passing = [(x, w) for x, w in acting if w.pace_mps is None]
    lead = [w.x_m - x for x, w in passing]
    assert lead[-1] > 1.4 and all(b > a - 1e-9 for a, b in itertools.pairwise(lead))
    assert min(abs(w.y_m) for x, w in passing if abs(w.x_m - x) < 0.65) > 0.275 + 0.3
    x, slow = next((x, w) for x, w in acting if w.pace_mps is not None)
    assert slow.pace_mps == pytest.approx(0.6) and abs(slow.y_m) < 0.15 and slow.x_m - x < 2.5


def test_people_cross_from_both_ends_of_the_crosswalk() -> None:
    """They wait outside it, start when the robot enters, one of them on the robot's line, and reach
    the other side."""
    track = drive(event("ped_crossing"), 1000, 0.3, start_m=40.0)
    waiting = track[0][1].walkers
    assert [w.x_m > 55.0 for w in waiting] == [True, False, True, False]
    assert all(not 45.0 <= w.x_m <= 55.0 for w in waiting) and waiting[0].y_m == pytest.approx(0.0)
    first = next(i for i, (_, s, _) in enumerate(track) if s.phase == "acting")
    assert track[first][0] == pytest.approx(45.0, abs=0.02)
    assert track[first - 1][1].walkers == waiting
    last = track[-1][1].walkers
    assert [w.x_m < 45.0 for w in last] == [True, False, True, False]
    assert all(w.x_m > 55.0 for w in last[1::2])


def test_a_gesturing_pedestrian_faces_the_robot_throughout() -> None:
    """It holds up the hand in its place, and turns with a robot that drives past."""
    planned = event("gesturing")
    track = drive(planned, 700, 0.5, start_m=39.0)
    shown = [(x, s.walkers[0], a) for x, s, a in track if s.phase == "acting"][80:]
    assert {a.doing for _, _, a in shown if a is not None} == {"stop"}
    for x, w, _ in shown:
        if abs(x - w.x_m) > 1.5:
            assert math.cos(w.heading_rad - math.atan2(-w.y_m, x - w.x_m)) == pytest.approx(
                1.0, abs=1e-3
            )
