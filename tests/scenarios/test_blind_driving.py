"""Robots that drive without looking meet the people of every event; robots that stand are not
hit."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import NamedTuple

import msgspec
import numpy as np
import pytest

from cosim.core.geometry import Pose, box_disk_gap
from cosim.results.event_monitor import passed_between
from cosim.results.go_on import overtaken_at_m
from cosim.spec.events import Event, EventQuery, EventState
from cosim.spec.scenario import City
from scenarios.events import EVENT_KINDS, react
from tests.support.blind_motion import Schedule, outcome
from tests.support.cheats import BLIND_MPS, Crawl, EdgeDriver, Stander

TICK_S = 0.05
HALF_M = (0.35, 0.275)
PEOPLE = {"conversing": (2, 3, 4), "queueing": (2, 3, 5), "ped_crossing": (1, 2, 3, 4)}
HALF_WIDTHS_M = {"queueing": {2: 1.4, 3: 1.6, 5: 2.9}}
NEAR_M = 2.0
STANDING = ("obstructing", "conversing", "queueing", "gesturing")


def event(
    kind: str, half_width_m: float = 1.9, people: int = 1, side: int = 1, speed_mps: float = 1.2
) -> Event:
    """Return an event 50 m along a route on the x axis."""
    length_m = 4.0 if kind == "ped_crossing" else 0.0
    return Event(
        id="e0",
        kind=kind,
        x_m=50.0,
        y_m=0.0,
        heading_rad=0.0,
        route_s_m=50.0,
        half_width_m=half_width_m,
        half_length_m=length_m,
        people=people,
        side=side,
        speed_mps=speed_mps,  # type: ignore[arg-type]
    )


class Driven(NamedTuple):
    """Outcome of a drive. gap_m: least gap between the robot and any person; between: whether the
    robot passed between two people of a group; state: at the end."""

    gap_m: float
    between: bool
    state: EventState
    seen: list[tuple[float, EventState]]


def drive(
    planned: Event,
    speed_at: Callable[[float], float],
    start_m: float,
    seconds: float,
    left_m: float = 0.0,
) -> Driven:
    """Drive on a line beside the x axis at a speed (m/s) that is a function of the time (s), until
    the robot touches a person or passes between the two of a conversation. Gaps are measured where
    the robot is within 2 m of a person along its way, and passing between two people is tested
    where it is beside them."""
    states: tuple[EventState, ...] = ()
    x_m = start_m
    v_mps = speed_at(0.0)
    nearest_m = math.inf
    between = False
    seen = []
    for tick in range(round(seconds / TICK_S)):
        query = EventQuery(
            episode="t",
            tick=tick,
            tick_ms=50,
            robot_x_m=x_m,
            robot_y_m=left_m,
            robot_heading_rad=0.0,
            robot_v_mps=v_mps,
            robot_w_radps=0.0,
            route_s_m=x_m,
            robot_length_m=0.7,
            robot_width_m=0.55,
            events=(planned,),
            states=states,
        )
        states = react(query).states
        before_m = x_m
        v_mps = speed_at(tick * TICK_S)
        x_m += v_mps * TICK_S
        seen.append((x_m, states[0]))
        ahead_m = [walker.x_m - x_m for walker in states[0].walkers]
        if max(ahead_m) < -NEAR_M or min(ahead_m) > NEAR_M:
            continue
        at = np.array([(walker.x_m, walker.y_m) for walker in states[0].walkers])
        gaps = box_disk_gap(np.array([Pose(x_m, left_m, 0.0)]), *HALF_M, at[None])[0] - 0.3
        nearest_m = min(nearest_m, float(gaps.min()))
        if len(at) > 1 and min(ahead_m) <= 0.0 and max(ahead_m) >= before_m - x_m:
            between |= passed_between(np.array([before_m, left_m]), np.array([x_m, left_m]), at)
        if nearest_m < 0.0 or (between and planned.kind == "conversing" and len(at) == 2):
            break
    return Driven(nearest_m, between, states[0], seen)


@pytest.mark.parametrize("v_mps", BLIND_MPS)
@pytest.mark.parametrize("kind", EVENT_KINDS)
def test_a_blind_robot_at_any_constant_speed_meets_people_of_every_event(
    kind: str, v_mps: float
) -> None:
    """It is touched after the trigger, or passes between two people of a group. Sidewalks, numbers,
    sides and speeds of people vary."""
    for people in PEOPLE.get(kind, (1,)):
        for half_m in (1.45, 1.9, 2.9):
            half_width_m = HALF_WIDTHS_M.get(kind, {}).get(people, half_m)
            for side, speed_mps in ((1, 1.1), (-1, 1.65)):
                planned = event(kind, half_width_m, people, side, speed_mps)
                before_m = (
                    2.0
                    if kind == "overtaking"
                    else 1.0 + (EVENT_KINDS[kind].trigger_m or planned.half_length_m)
                )
                start_m = 50.0 - before_m
                way_m = before_m + (16.0 if kind == "overtaking" else 14.0)
                driven = drive(planned, lambda _: v_mps, start_m, way_m / v_mps)
                assert driven.gap_m < 0.0 if (kind, people) != ("conversing", 2) else driven.between
                assert driven.between or driven.state.phase == "acting"


def stop_and_go(v_mps: float, late_s: float) -> Callable[[float], float]:
    """Return the speed (m/s) of a robot that stands for 0.8 s in every 2.4 s, and takes 0.4 s to
    start and to stop."""

    def speed_at(t_s: float) -> float:
        since_s = (t_s + late_s) % 2.4
        return v_mps * max(0.0, min(1.0, since_s / 0.4, 1.0 - (since_s - 1.2) / 0.4))

    return speed_at


@pytest.mark.parametrize("v_mps", [0.8, 1.2, 1.8])
@pytest.mark.parametrize("kind", ["lateral", "overtaking"])
def test_a_robot_that_stops_and_goes_meets_people_who_cross_or_cut_in(
    kind: str, v_mps: float
) -> None:
    """At any phase of its stops: the people slow down and stand as the robot does."""
    for side, late_s in itertools.product((-1, 1), (0.0, 0.6, 1.2, 1.8)):
        driven = drive(event(kind, side=side), stop_and_go(v_mps, late_s), 44.0, 60.0)
        assert driven.gap_m < 0.0, f"from {side}, {late_s} s late: {driven.gap_m} m"


@pytest.mark.parametrize("kind", ["lateral", "overtaking"])
def test_a_robot_that_stops_for_a_person_who_crosses_or_cuts_in_lets_it_pass(kind: str) -> None:
    """However late the robot stops near the person, if it stands until the person has passed, it is
    not touched and the event is over."""
    meets_s = len(drive(event(kind), lambda _: 1.0, 44.0, 30.0).seen) * TICK_S
    for early_s in (0.6, 1.0, 1.5):
        driven = drive(
            event(kind), lambda t_s, at_s=meets_s - early_s: float(t_s < at_s), 44.0, 40.0
        )  # type: ignore[misc]
        assert driven.gap_m > 0.0 and driven.state.phase in ("over", "gone"), f"{early_s} s before"


@pytest.mark.parametrize("left_m", [-0.9, -0.5, 0.5, 0.9])
@pytest.mark.parametrize("kind", STANDING)
def test_a_robot_on_one_side_of_the_sidewalk_meets_standing_people(
    kind: str, left_m: float
) -> None:
    """Standing people step in front of the robot; a robot near the middle is met on the middle."""
    for side in (-1, 1):
        planned = event(kind, 1.9, PEOPLE.get(kind, (1,))[0], side)
        driven = drive(planned, lambda _: 0.8, 38.0, 25.0, left_m)
        assert driven.gap_m < 0.0 or (kind == "conversing" and driven.between)
    near = drive(event(kind, 1.9, PEOPLE.get(kind, (1,))[0]), lambda _: 0.2, 39.0, 20.0, 0.25)
    middle = drive(event(kind, 1.9, PEOPLE.get(kind, (1,))[0]), lambda _: 0.2, 39.0, 20.0)
    assert near.state.walkers[0].y_m == middle.state.walkers[0].y_m


@pytest.mark.parametrize("left_m", [-0.9, -0.6, 0.6, 0.9])
@pytest.mark.parametrize("people", [1, 2, 3, 4])
def test_a_robot_on_one_side_of_a_crosswalk_meets_a_person(people: int, left_m: float) -> None:
    """The robot meets a person who comes from the front, or one who waits to follow from behind."""
    for side in (-1, 1):
        assert (
            drive(event("ped_crossing", 1.6, people, side), lambda _: 1.2, 40.0, 20.0, left_m).gap_m
            < 0.0
        )


@pytest.mark.parametrize("kind", STANDING)
def test_standing_people_stay_until_the_robot_is_three_metres_past_the_last_one(
    kind: str,
) -> None:
    """A robot that creeps past at 0.06 m/s does not make them move earlier."""
    planned = event(kind, 2.9, PEOPLE.get(kind, (1,))[0])
    driven = drive(planned, lambda t_s: 1.0 if t_s < 9.0 else 0.06, 38.0, 150.0, left_m=-4.0)
    last_m = max(walker.x_m for walker in driven.seen[200][1].walkers)
    over = [x_m for x_m, state in driven.seen if state.phase != "acting" and x_m > 41.0]
    assert over[0] == pytest.approx(last_m + 3.0, abs=0.01)
    waiting = drive(planned, lambda t_s: 1.0 if t_s < 6.0 else 0.0, 38.0, 120.0)
    assert waiting.state.phase == "acting"


def test_a_stopping_hand_is_lowered_after_the_robot_has_stood_near_it_for_two_seconds() -> None:
    """The robot must stand within 3 m; farther away, or for a shorter time, the hand stays up."""
    for stops_at_m, stands_s, obeyed in ((47.5, 2.2, True), (47.5, 1.8, False), (46.5, 9.0, False)):
        arrives_s = (stops_at_m - 38.0) / 1.0
        driven = drive(
            event("gesturing"),
            lambda t_s, a=arrives_s, s=stands_s: (
                0.0 if a < t_s < a + s else 0.1 if t_s > a else 1.0
            ),  # type: ignore[misc]
            38.0,
            arrives_s + stands_s + 1.0,
        )
        assert (driven.state.phase == "over") is obeyed


@pytest.mark.parametrize("kind", ["lateral", "overtaking", "frontal", "ped_crossing"])
def test_a_robot_that_stops_too_early_has_not_given_way(kind: str) -> None:
    """The people wait, too, and a robot that drives on after 9 s meets them."""
    meets_s = len(drive(event(kind), lambda _: 1.0, 44.0, 30.0).seen) * TICK_S
    early_s = {"overtaking": 4.5}.get(kind, 2.9)
    stops_s = meets_s - early_s
    stood = drive(event(kind), lambda t_s: float(t_s < stops_s), 44.0, stops_s + 20.0)
    assert stood.gap_m > 0.0 and stood.state.phase == "acting"
    driven = drive(
        event(kind), lambda t_s: float(not stops_s <= t_s < stops_s + 9.0), 44.0, stops_s + 40.0
    )
    assert driven.gap_m < 0.0


@pytest.mark.parametrize("speed_mps", [1.1, 1.65])
@pytest.mark.parametrize("left_m", [0.0, 0.4, -0.7])
def test_a_person_who_approaches_a_standing_robot_walks_round_it(
    left_m: float, speed_mps: float
) -> None:
    """A robot that has stopped near the walker is passed at a distance, and the walker
    continues."""
    for stops_m in (1.4, 1.9, 2.3):
        planned = event("frontal", 1.9, speed_mps=speed_mps)
        drives_s = (20.0 - stops_m) / (1.2 + speed_mps)
        driven = drive(planned, lambda t_s, d=drives_s: 1.2 if t_s < d else 0.0, 30.0, 40.0, left_m)  # type: ignore[misc]
        assert driven.gap_m > 0.02
        assert driven.state.walkers[0].x_m < 30.0


def test_a_robot_that_drives_on_after_a_distant_stop_is_approached_again() -> None:
    """Standing for a while far away does not end the event."""
    driven = drive(event("frontal"), lambda t_s: 0.0 if 1.0 < t_s < 5.0 else 1.2, 30.5, 20.0, 0.8)
    assert driven.gap_m < 0.0


@pytest.mark.parametrize("v_mps", [0.3, 0.8, 1.4, 2.0])
def test_a_robot_that_does_not_give_way_is_hit_within_the_window_of_the_rule(v_mps: float) -> None:
    """At up to 2 m/s and any offset, a robot that drives straight on hits the person who cuts in
    before the window ends."""
    kind = EVENT_KINDS["overtaking"]
    for half_m, side, left_m, speed_mps in itertools.product(
        (1.45, 2.9), (-1, 1), (-0.9, 0.0, 0.9), (1.1, 1.65)
    ):
        planned = event("overtaking", half_m, 1, side, speed_mps)
        driven = drive(planned, lambda _: v_mps, 48.0, 14.0 / v_mps, left_m)
        assert driven.gap_m < 0.0
        end_m = overtaken_at_m(planned, kind)
        assert end_m is not None and driven.seen[-1][0] < end_m


@pytest.mark.parametrize("v_mps", [0.3, 0.8, 1.5, 2.5])
def test_an_overtaking_person_is_faster_than_the_robot_and_passes_close_by(v_mps: float) -> None:
    """The person walks at up to 4.0 m/s, and is in front of a fast robot within 9 m of its way."""
    driven = drive(event("overtaking"), lambda _: v_mps, 49.0, 60.0 / v_mps)
    for (x_m, before), (_, after) in itertools.pairwise(driven.seen):
        (walker,) = after.walkers
        if after.phase == "acting" and before.phase == "acting" and walker.pace_mps is None:
            assert v_mps < math.hypot(walker.vx_mps, walker.vy_mps) < 4.0 + 1e-6
        if abs(walker.x_m - x_m) < 0.3 and after.phase == "acting":
            assert 0.575 < abs(walker.y_m) < 1.25
    slow = [x_m for x_m, state in driven.seen if state.walkers[0].pace_mps is not None]
    assert slow[0] < 51.0 + 9.0


@pytest.mark.parametrize("v_mps", [0.8, 1.5, 2.5])
def test_an_overtaking_person_is_not_touched_by_a_robot_that_slows_down(v_mps: float) -> None:
    """The person walks on in front of a slow or standing robot, or waits beside it, without a
    touch."""
    cuts_s = next(
        tick * TICK_S
        for tick, (_, state) in enumerate(
            drive(event("overtaking"), lambda _: v_mps, 49.0, 60.0).seen
        )
        if state.walkers[0].aim_rad is not None
    )
    for stops_s, slow_mps, passes in (
        (cuts_s + 0.5, 0.1, True),
        (cuts_s + 1.0, 0.0, True),
        (2.2 / v_mps, 0.0, False),
    ):
        driven = drive(
            event("overtaking"),
            lambda t_s, s=stops_s, v=slow_mps: v_mps if t_s < s else v,
            49.0,
            30.0,
        )  # type: ignore[misc]
        assert driven.gap_m > 0.05
        assert (driven.state.phase in ("over", "gone")) is passes


@pytest.mark.engine
@pytest.mark.parametrize(
    ("kind", "policy"),
    [
        ("obstructing", EdgeDriver(1.2)),
        ("overtaking", Crawl(2.5)),
        ("frontal", Stander(1.2, 5.0)),
    ],
)
def test_blind_policies_solve_no_event_and_standing_is_no_failure(kind: str, policy: Crawl) -> None:
    """Where only people are in the way, a blind policy that drives collides with fault or shared
    fault; one that stands waits until its time is up."""
    from cosim.place.walk_graph import WalkGraph
    from scenarios.episodes.run_episode import run_episode
    from scenarios.places.nets import place
    from scenarios.suites.reactive import build_reactive

    city = City(seed=5, size_m=500.0)
    _, street_map = place(city)
    drawn = build_reactive(EVENT_KINDS[kind], city, street_map, WalkGraph(street_map), 1, kind)
    stands = isinstance(policy, Stander)
    scenario = msgspec.structs.replace(
        drawn,
        obstacles=(),
        events=tuple(msgspec.structs.replace(event, free_side=0) for event in drawn.events),
        time_limit_s=25.0 if stands else drawn.time_limit_s,
    )
    record = run_episode(scenario, policy).record
    assert (record.status, record.measures["success"]) == ("done", 0.0)
    assert record.ended == ("timeout" if stands else "failure")
    assert [failure.fault in ("robot_at_fault", "shared") for failure in record.failures] == [
        True
    ] * (not stands)


SCHEDULES = {
    "one stop of 8 s": Schedule(1.5, [(10.0, 8.0)]),
    "stops every 2 m": Schedule(1.5, [(2.0 * k, 2.2) for k in range(1, 14)]),
    "one swerve": Schedule(1.5, lanes=[(7.0, -1.1), (14.0, 0.0)]),
    "slow weaving": Schedule(1.0, lanes=[(2.0 * k, 0.7 * (-1) ** k) for k in range(20)]),
    "fast swerves": Schedule(2.5, lanes=[(6.0 * k, 0.8 * (-1) ** k) for k in range(8)]),
}


@pytest.mark.parametrize("kind", ["lateral", "overtaking", "frontal", "ped_crossing"])
@pytest.mark.parametrize("schedule", SCHEDULES.values(), ids=SCHEDULES)
def test_a_schedule_of_stops_and_swerves_rarely_solves_an_event(
    kind: str, schedule: Schedule
) -> None:
    """At no more than 3 of 12 places of the event along the route does the schedule solve it,
    within the time limit of a suite."""
    rng = np.random.default_rng(5)
    solved = 0
    for before_m in np.linspace(7.0, 25.0, 12).tolist():
        planned = msgspec.structs.replace(
            event(kind, 1.6, 3 if kind == "ped_crossing" else 1, side=int(rng.choice([-1, 1]))),
            x_m=0.0,
            speed_mps=float(rng.uniform(1.1, 1.65)),
            patience_s=float(rng.uniform(2.0, 4.0)),
        )
        limit_s = 1.5 * ((before_m + 13.0) / 1.4 + 6.0) + 3.0
        solved += outcome(planned, schedule, before_m, limit_s) == "solved"
    assert solved <= 3
