"""The referee's rules, on steps made by hand."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from shapely.geometry import box

from cosim.core.clock import Clock
from cosim.core.geometry import Pose
from cosim.core.state import (
    NO_VEHICLES,
    STILL,
    Command,
    Contact,
    Motion,
    People,
    RobotState,
    Signal,
    Street,
    Vehicles,
    write_protected_copy,
)
from cosim.episode.loop import Step
from cosim.place.street_map import WalkableArea
from cosim.results.referee import FREE_OF_OBSTACLES_M, Referee, Verdict
from cosim.spec.events import Event, EventReply, EventState, Walker
from cosim.spec.obstacle import Obstacle
from cosim.spec.scenario import Barrier, City, RouteCrossing, Scenario

CLOCK = Clock()
AREA = WalkableArea(box(-5, -2, 105, 2))
NOTHING = EventReply(episode="t", tick=0, states=(), actors=())


def scenario(**fields: object) -> Scenario:
    """A straight route of 100 m along the x axis."""
    known: dict[str, object] = {
        "id": "t",
        "suite": "test",
        "place": City(seed=0),
        "seed": 0,
        "start": (0.0, 0.0, 0.0),
        "goal": (100.0, 0.0),
        "route": ((0.0, 0.0), (100.0, 0.0)),
    }
    return Scenario(**known | fields)  # type: ignore[arg-type]


def new_referee(**fields: object) -> Referee:
    return Referee(scenario(**fields), AREA, (0.7, 0.55), CLOCK)


def people(*at: tuple[float, float], heading: float = 0.0, speed: float = 0.0) -> People:
    ids = tuple(f"c{i}" for i in range(len(at)))
    return People.of(ids, at, [heading] * len(at), [speed] * len(at), ("walk",) * len(at))


def step(
    tick: int,
    x_m: float,
    y_m: float = 0.0,
    *,
    contacts: Sequence[Contact] = (),
    crowd: People | None = None,
    speed: float = 1.0,
    red: Sequence[str] = (),
    cars: Vehicles = NO_VEHICLES,
    events: EventReply = NOTHING,
    w_radps: float = 0.0,
    command: Command = STILL,
) -> Step:
    """A step that ends at (x, y), which is also the robot's place on the route."""
    robot = RobotState(Pose(x_m, y_m, 0.0), speed, w_radps)
    street = Street(tick, crowd or people(), cars, {name: Signal(False) for name in red})
    motion = Motion(
        robot, write_protected_copy([[x_m, y_m, 0.0]] * CLOCK.substeps), tuple(contacts)
    )
    return Step(tick, robot, street, x_m, None, command, events, motion, street, x_m)


def judge_all(referee: Referee, steps: Sequence[Step]) -> list[Verdict]:
    return [referee.judge(s) for s in steps]


def touch(other: str, kind: str = "pedestrian") -> Contact:
    return Contact(kind, other, 0)  # type: ignore[arg-type]


def test_a_collision_is_one_event_until_they_have_been_apart() -> None:
    """A lasting contact counts once, and after 1 s apart the same person counts again."""
    referee = new_referee(ends_on_failure=False)
    far = people((50.0, 0.0))
    assert referee.judge(step(0, 20.0, contacts=[touch("c0")], crowd=far)).failures
    touching = [
        referee.judge(step(t, 20.0 + t * 0.1, contacts=[touch("c0")], crowd=far))
        for t in range(1, 30)
    ]
    assert not any(v.failures for v in touching)
    apart = [referee.judge(step(t, 20.0 + t * 0.1, crowd=far)) for t in range(30, 52)]
    assert not any(v.failures for v in apart)
    again = referee.judge(step(52, 30.0, contacts=[touch("c0")], crowd=far)).failures
    assert [(failure.kind, failure.other) for failure in again] == [("collision", "c0")]


def test_a_person_within_ten_centimetres_has_not_parted() -> None:
    """A person who stays near after a contact does not collide again, however long it takes."""
    referee = new_referee()
    near = people((20.0 + 0.35 + 0.3 + 0.05, 0.0))
    assert referee.judge(step(0, 20.0, contacts=[touch("c0")], crowd=near)).failures
    for tick in range(1, 100):
        referee.judge(step(tick, 20.0, crowd=near))
    assert referee.judge(step(100, 20.0, contacts=[touch("c0")], crowd=near)).failures == ()


def test_the_fault_of_a_contact_follows_who_moved() -> None:
    """The robot has hit a standing person; both share the fault when both move or the robot has
    only just stopped."""

    def fault(robot_mps: float, person_mps: float) -> str | None:
        crowd = people((20.5, 0.0), heading=math.pi, speed=person_mps)
        (failure,) = (
            new_referee()
            .judge(step(0, 20.0, contacts=[touch("c0")], crowd=crowd, speed=robot_mps))
            .failures
        )
        return failure.fault

    assert fault(0.0, 1.3) == "shared"
    assert fault(1.0, 0.0) == "robot_at_fault"
    assert fault(1.0, 1.3) == "shared"


def stand_still(referee: Referee, ticks: int, **speeds: float) -> None:
    """Steps of a robot that stands, or turns, at x = 20."""
    for tick in range(ticks):
        assert not referee.judge(step(tick, 20.0, speed=0.0, **speeds)).failures


@pytest.mark.parametrize("ends", [True, False])
def test_a_person_who_walks_into_a_standing_robot_is_at_fault(
    ends: bool,
) -> None:
    """After 1 s of standing the contact is counted without end or reset, and after less it is a
    collision."""
    crowd = people((20.5, 0.0), heading=math.pi, speed=1.3)
    hit = {"contacts": [touch("c0")], "crowd": crowd, "speed": 0.0}
    referee = new_referee(ends_on_failure=ends)
    stand_still(referee, 19)
    verdict = referee.judge(step(19, 20.0, **hit))  # type: ignore[arg-type]
    assert (verdict.failures, verdict.reset, verdict.ended) == ((), None, None)
    assert [(into.fault, into.other) for into in verdict.walked_into] == [
        ("pedestrian_at_fault", "c0")
    ]
    assert not referee.judge(step(20, 20.0, **hit)).walked_into  # type: ignore[arg-type]
    other = new_referee(ends_on_failure=ends)
    stand_still(other, 18)
    verdict = other.judge(step(18, 20.0, **hit))  # type: ignore[arg-type]
    assert [failure.fault for failure in verdict.failures] == ["shared"] and not verdict.walked_into
    assert (verdict.ended == "failure", verdict.reset is None) == (ends, ends)


def test_a_contact_beside_a_turning_robot_is_the_movers_fault() -> None:
    """A walker is; the robot is when its corner swings into a standing person, or before 1 s of
    turning."""
    corner = {"contacts": [touch("c0")], "speed": 0.0}

    def fault(mps: float, w_radps: float, ticks: int = 19) -> str | None:
        referee = new_referee()
        crowd = people((20.3, 0.55), heading=-math.pi / 2, speed=mps)
        stand_still(referee, ticks, w_radps=w_radps)
        verdict = referee.judge(step(ticks, 20.0, w_radps=w_radps, crowd=crowd, **corner))  # type: ignore[arg-type]
        (contact,) = verdict.failures or verdict.walked_into
        assert bool(verdict.walked_into) == (contact.fault == "pedestrian_at_fault")
        return contact.fault

    assert fault(1.3, 0.6) == fault(1.3, -0.6) == "pedestrian_at_fault"
    assert fault(0.0, 0.6) == "robot_at_fault"
    assert fault(0.1, 0.6) == fault(1.3, 0.6, ticks=18) == "shared"
    referee = new_referee()
    crowd = people((20.3, 0.55), heading=-math.pi / 2, speed=1.3)
    stand_still(referee, 19, w_radps=-0.6)
    assert referee.judge(step(19, 20.0, w_radps=-0.6, crowd=crowd, **corner)).walked_into  # type: ignore[arg-type]
    away = step(20, 20.0, w_radps=-0.6, crowd=crowd, command=Command(0.0, -0.6), **corner)  # type: ignore[arg-type]
    assert not referee.judge(away).failures
    into = step(
        21, 20.0, w_radps=0.6, crowd=people((20.3, 0.55)), command=Command(0.0, 0.6), **corner
    )  # type: ignore[arg-type]
    (failure,) = referee.judge(into).failures
    assert failure.fault == "robot_at_fault"


def test_a_robot_that_drives_through_a_person_who_touched_it_collides() -> None:
    """Standing until a touch excuses no later driving, and a robot that is only pushed has not
    driven."""
    crowd = people((20.5, 0.0))
    hit = {"contacts": [touch("c0")], "crowd": crowd}
    referee = new_referee(ends_on_failure=True)
    stand_still(referee, 19)
    assert referee.judge(step(19, 20.0, speed=0.0, **hit)).walked_into  # type: ignore[arg-type]
    assert not referee.judge(step(20, 20.0, speed=0.2, **hit)).failures  # type: ignore[arg-type]
    (failure,) = referee.judge(step(21, 20.0, speed=0.2, command=Command(0.4, 0.0), **hit)).failures  # type: ignore[arg-type]
    assert failure.fault == "robot_at_fault"


def test_several_contacts_in_one_tick_are_several_collisions_and_one_reset() -> None:
    """Two people and a bin are three failures in the order of contacts, one of them counted once."""
    hit = [touch("c0"), touch("bin", "object"), touch("c0"), touch("c1")]
    verdict = new_referee().judge(
        step(0, 23.0, contacts=hit, crowd=people((23.4, 0.0), (23.4, 0.4)))
    )
    assert [failure.other for failure in verdict.failures] == ["c0", "bin", "c1"]
    assert verdict.reset is not None and verdict.ended is None
    ended = new_referee(ends_on_failure=True).judge(step(0, 23.0, contacts=hit))
    assert len(ended.failures) == 3 and ended.ended == "failure"


def test_waiting_is_no_failure_in_an_episode_that_ends_on_failure() -> None:
    """Before its goal a robot may stand until the time limit, and on a long way it freezes."""
    for ends, ended in ((True, "timeout"), (False, "timeout")):
        referee = new_referee(ends_on_failure=ends, time_limit_s=60.0)
        verdicts = judge_all(referee, [step(t, 20.0, speed=0.0) for t in range(1200)])
        assert sum(len(v.failures) for v in verdicts) == (0 if ends else 5)
        assert verdicts[-1].ended == ended


def test_out_of_lane_is_the_base_centre_outside_the_walkable_area() -> None:
    """Beside a half width of 2 m, 1.99 m is inside, and 2.01 m resets the robot to the route."""
    referee = new_referee()
    assert referee.judge(step(0, 23.0, 1.99)).failures == ()
    verdict = referee.judge(step(1, 23.0, 2.01))
    assert [failure.kind for failure in verdict.failures] == ["out_of_lane"]
    assert verdict.reset is not None and verdict.reset.pose == (25.0, 0.0, 0.0)


def test_out_of_lane_is_exact_at_every_step_across_the_edge() -> None:
    """In 800 steps of all lengths it holds exactly where the base centre is outside."""
    rng = np.random.default_rng(6)
    referee = new_referee()
    y_m = 0.0
    failed = []
    for tick in range(800):
        y_m = float(np.clip(y_m + rng.normal(0.0, 0.3) * rng.random() ** 3, -2.3, 2.3))
        failed.append(bool(referee.judge(step(tick, 20.0 + 0.05 * tick, y_m)).failures))
        assert failed[-1] is not AREA.contains(20.0 + 0.05 * tick, y_m)
    assert 50 < sum(failed) < 750


def test_freezing_is_half_a_metre_in_ten_seconds() -> None:
    """A robot that moves less than half a metre in 10 s freezes, and then the count restarts."""
    still = judge_all(new_referee(), [step(t, 20.0) for t in range(402)])
    frozen_at = [t for t, v in enumerate(still) if v.failures]
    assert frozen_at == [200, 401]
    creeping = judge_all(new_referee(), [step(t, 20.0 + 0.06 * t * 0.05) for t in range(600)])
    assert not any(v.failures for v in creeping)


def test_going_to_and_fro_is_not_freezing() -> None:
    """A robot that left and returned to the same spot within the window has moved."""
    track = [20.0 + 1.0 * math.sin(2 * math.pi * t / 200) for t in range(600)]
    assert not any(
        v.failures for v in judge_all(new_referee(), [step(t, x) for t, x in enumerate(track)])
    )


def test_waiting_before_a_red_crossing_is_not_freezing() -> None:
    """Within 4 m of a red crossing of the route time does not count, and at green it does."""
    crossing = RouteCrossing(id=":x_c0", enter_s_m=30.0, leave_s_m=40.0, signalised=True)
    referee = new_referee(crossings=(crossing,))
    waiting = judge_all(referee, [step(t, 29.0, red=[":x_c0"]) for t in range(500)])
    assert all(v.waits_at_red and not v.failures for v in waiting)
    green = judge_all(referee, [step(t, 29.0) for t in range(500, 702)])
    assert [t for t, v in enumerate(green) if v.failures] == [200]
    elsewhere = judge_all(
        new_referee(crossings=(crossing,)), [step(t, 20.0, red=[":x_c0"]) for t in range(202)]
    )
    assert elsewhere[200].failures


def test_entering_a_crossing_at_red_is_noted_once() -> None:
    """The tick on which the robot gets onto a red crossing of its route is a red-light entry."""
    crossing = RouteCrossing(id=":x_c0", enter_s_m=30.0, leave_s_m=40.0, signalised=True)
    referee = new_referee(crossings=(crossing,))
    entries = [
        v.red_light_entry
        for v in judge_all(referee, [step(t, 29.0 + t * 0.1, red=[":x_c0"]) for t in range(60)])
    ]
    assert [e for e in entries if e] == [":x_c0"]
    assert entries.index(":x_c0") == 11


def test_a_reset_keeps_off_obstacles() -> None:
    """It moves on to the next waypoint free of obstacles, or to the nearest if none is."""

    def bin_at(x_m: float, y_m: float = 0.0) -> Obstacle:
        return Obstacle(kind="bin", x_m=x_m, y_m=y_m, heading_rad=0.0)

    def reset_m(*obstacles: Obstacle) -> float:
        verdict = new_referee(obstacles=obstacles).judge(step(0, 21.0, 3.0))
        assert verdict.reset is not None
        return verdict.reset.route_s_m

    reach_m = math.hypot(0.35, 0.275) + FREE_OF_OBSTACLES_M + 0.5 * 0.55
    assert reset_m() == reset_m(bin_at(22.5)) == reset_m(bin_at(20.0, reach_m + 0.01)) == 20.0
    assert reset_m(bin_at(20.0)) == reset_m(bin_at(20.0, reach_m - 0.01)) == 25.0
    assert reset_m(bin_at(20.0), bin_at(25.0)) == 15.0
    assert reset_m(*(bin_at(5.0 * k) for k in range(21))) == 20.0


def test_the_third_hit_of_an_obstacle_before_the_goal_resets_beyond_it() -> None:
    """Beyond the last waypoint the robot is put between the bin and the goal, rather than before
    the bin again."""
    for bin_m, beyond_m in ((96.0, 96.8), (97.4, 98.2)):
        referee = new_referee(
            obstacles=(Obstacle(kind="bin", x_m=bin_m, y_m=0.0, heading_rad=0.0),)
        )
        hit = [touch("bin", "object")]
        at = [referee.judge(step(60 * t, bin_m - 0.7, contacts=hit)).reset for t in range(3)]
        assert [reset.route_s_m for reset in at if reset is not None] == pytest.approx(
            [95.0, 95.0, beyond_m], abs=0.11
        )


def test_a_reset_goes_to_the_nearest_free_waypoint() -> None:
    """Waypoints are 5 m apart; one with a person is skipped, and so is one on a crossing."""
    crossing = RouteCrossing(id=":x_c0", enter_s_m=28.0, leave_s_m=36.0, signalised=False)
    verdict = new_referee().judge(step(0, 23.0, 3.0, crowd=people((25.3, 0.0))))
    assert verdict.reset is not None and verdict.reset.route_s_m == 20.0
    verdict = new_referee(crossings=(crossing,)).judge(step(0, 31.0, 3.0))
    assert verdict.reset is not None and verdict.reset.route_s_m == 25.0


def test_three_failures_in_one_place_carry_the_robot_beyond_it() -> None:
    """The third within 10 m of the route resets the robot to the first waypoint at least 1 m beyond
    them."""
    referee = new_referee()
    resets = [referee.judge(step(t, x, 3.0)).reset for t, x in enumerate((21.0, 24.0, 22.0, 25.0))]
    assert [r.route_s_m for r in resets if r is not None] == [20.0, 25.0, 30.0, 25.0]
    stuck = new_referee()
    at = [stuck.judge(step(t, 24.9999, 3.0)).reset for t in range(4)]
    assert [r.route_s_m for r in at if r is not None] == [25.0, 25.0, 30.0, 25.0]
    far = [new_referee().judge(step(t, 20.0 * t, 3.0)).reset for t in range(3)]
    assert [r.route_s_m for r in far if r is not None] == [0.0, 20.0, 40.0]


def test_a_robot_that_never_moves_is_carried_along_the_route_but_never_to_its_goal() -> None:
    """Frozen at every place, it is reset further and further, and the episode ends by time."""
    referee = new_referee(time_limit_s=1500.0)
    x_m = 0.0
    ended = None
    tick = 0
    while ended is None:
        verdict = referee.judge(step(tick, x_m, speed=0.0))
        x_m = verdict.reset.route_s_m if verdict.reset else x_m
        ended = verdict.ended
        tick = tick + 1
    assert ended == "timeout" and 90.0 <= x_m <= 98.0


def test_a_vehicle_collides_again_only_after_it_has_been_away() -> None:
    """A car within 0.1 m has not parted, and one that returns has."""
    referee = new_referee()
    near = Vehicles.of(("v0",), [[20.0, 1.9]], [0.0], [0.0], [[4.5, 1.8]])
    hit = [Contact("vehicle", "v0", 0)]
    assert referee.judge(step(0, 20.0, contacts=hit)).failures
    for tick in range(1, 60):
        referee.judge(step(tick, 20.0 + 0.001 * tick, 0.65, cars=near))
    assert referee.judge(step(60, 20.0, contacts=hit)).failures == ()
    for tick in range(61, 90):
        referee.judge(step(tick, 20.0 + 0.03 * tick))
    assert referee.judge(step(90, 25.0, contacts=hit)).failures


def test_a_crossing_can_be_entered_at_red_after_it_was_left() -> None:
    """Entered at green, left backwards by half a metre, and entered again at red, it is an entry at
    red."""
    crossing = RouteCrossing(id=":x_c0", enter_s_m=30.0, leave_s_m=40.0, signalised=True)
    referee = new_referee(crossings=(crossing,))
    at = [(30.2, False), (29.9, False), (29.5, False), (29.6, True), (30.1, True)]
    verdicts = [
        referee.judge(step(t, x, red=[":x_c0"] if red else [])) for t, (x, red) in enumerate(at)
    ]
    assert [v.red_light_entry for v in verdicts] == [None, None, None, None, ":x_c0"]


def test_time_before_and_after_a_red_signal_adds_up_to_freezing() -> None:
    """Waiting at red pauses the count of a freezing, and does not restart it."""
    crossing = RouteCrossing(id=":x_c0", enter_s_m=30.0, leave_s_m=40.0, signalised=True)
    referee = new_referee(crossings=(crossing,))
    reds = [120 <= t < 400 for t in range(500)]
    verdicts = [
        referee.judge(step(t, 29.0, red=[":x_c0"] if red else [])) for t, red in enumerate(reds)
    ]
    assert [t for t, v in enumerate(verdicts) if v.failures] == [480]


def test_the_episode_ends_at_the_goal_or_at_its_time() -> None:
    """The goal radius is the goal, the limit is a timeout, and a unit scenario ends at its first
    failure."""
    assert new_referee().judge(step(0, 98.9)).ended is None
    assert new_referee().judge(step(0, 99.1)).ended == "goal"
    assert new_referee(time_limit_s=10.0).judge(step(198, 50.0)).ended is None
    assert new_referee(time_limit_s=10.0).judge(step(199, 50.0)).ended == "timeout"
    first = new_referee(ends_on_failure=True).judge(step(0, 50.0, 3.0))
    assert (first.ended, first.reset) == ("failure", None)


def test_a_goal_near_the_start_of_a_round_route_counts_only_at_its_end() -> None:
    """A route that ends at its start is not over before it has been driven."""
    loop = ((0.0, 0.0), (50.0, 0.0), (50.0, 1.0), (0.5, 1.0))
    referee = new_referee(route=loop, goal=(0.5, 1.0))
    assert referee.judge(step(0, 0.5, 0.4)).ended is None


HAIRPIN = {
    "route": ((0.0, -1.0), (50.0, -1.0), (50.0, 1.0), (0.0, 1.0)),
    "goal": (0.0, 1.0),
    "start": (0.0, -1.0, 0.0),
}


@pytest.mark.parametrize(
    ("y_m", "more", "ended"),
    [
        (0.2, {}, "goal"),
        (-0.2, {}, None),
        (
            0.2,
            {
                "barriers": (
                    Barrier(x_m=0.0, y_m=0.5, heading_rad=1.5708, length_m=9.0, strip="s", end=0),
                )
            },
            None,
        ),
        (
            0.2,
            {
                "barriers": (
                    Barrier(x_m=9.0, y_m=0.5, heading_rad=1.5708, length_m=9.0, strip="s", end=0),
                )
            },
            "goal",
        ),
    ],
    ids=["at it", "too far", "behind a fence", "beside a fence"],
)
def test_a_robot_that_skipped_a_part_of_the_route_reaches_the_goal(
    y_m: float, more: dict[str, object], ended: str | None
) -> None:
    """On a route that returns along a touching strip a robot that crosses over is at the goal."""
    referee = Referee(scenario(**HAIRPIN | more), AREA, (0.7, 0.55), CLOCK)
    across = step(0, 0.3, y_m)
    assert referee.judge(across).ended == ended
    apart = WalkableArea(AREA.polygon.difference(box(-5, 0.4, 55, 0.5)))
    assert (
        Referee(scenario(**HAIRPIN | more), apart, (0.7, 0.55), CLOCK).judge(across).ended is None
    )


@pytest.mark.parametrize("kind", ["vehicle", "wall", "object"])
def test_collisions_with_every_kind_of_obstacle_count(kind: str) -> None:
    """Walls, fences and vehicles are collisions too, without a pedestrian's fault class."""
    (failure,) = new_referee().judge(step(0, 20.0, contacts=[touch("b", kind)])).failures
    assert (failure.other_kind, failure.fault) == (kind, None)


def test_people_are_seen_from_the_footprint_not_from_the_centre() -> None:
    """The gap to a person is measured from the robot's outline to the person's disk."""
    from cosim.results.referee import person_gaps

    gaps = person_gaps(step(0, 0.0, crowd=people((1.35, 0.0), (0.0, 1.275))), (0.35, 0.275))
    assert list(gaps) == ["c0", "c1"]
    assert np.allclose(list(gaps.values()), [0.7, 0.7])


def stopping_hand(phase: str = "acting") -> tuple[Event, EventReply]:
    """A person who holds out a hand at x = 12, in the middle of the sidewalk."""
    event = Event(
        id="e0",
        kind="gesturing",
        x_m=12.0,
        y_m=0.0,
        heading_rad=0.0,
        route_s_m=12.0,
        half_width_m=1.5,
    )
    walker = Walker(x_m=12.0, y_m=0.0, heading_rad=math.pi)
    state = EventState(phase=phase, since_tick=0, walkers=(walker,))  # type: ignore[arg-type]
    return event, EventReply(episode="t", tick=0, states=(state,), actors=())


@pytest.mark.parametrize(
    ("x_m", "speed", "ended"), [(9.2, 0.0, "stop"), (8.8, 0.0, None), (9.2, 0.06, None)]
)
def test_a_stop_before_the_hand_is_a_success(x_m: float, speed: float, ended: str | None) -> None:
    """It needs two seconds within 3 m in front, slower than 0.05 m/s; farther away or rolling does
    not count."""
    event, reply = stopping_hand()
    referee = new_referee(ends_at="stop", ends_on_failure=True, events=(event,))
    verdicts = judge_all(referee, [step(t, x_m, speed=speed, events=reply) for t in range(45)])
    first = next((t for t, v in enumerate(verdicts) if v.ended), None)
    assert (None if first is None else verdicts[first].ended) == ended
    assert ended is None or first == 39


def test_a_stop_must_be_uninterrupted_and_after_the_trigger() -> None:
    """It needs two seconds in one piece, while the hand is held out."""
    event, reply = stopping_hand()
    referee = new_referee(ends_at="stop", ends_on_failure=True, events=(event,))
    steps = [step(t, 9.2, speed=0.5 if t == 30 else 0.0, events=reply) for t in range(60)]
    assert all(v.ended is None for v in judge_all(referee, steps))
    _, waiting = stopping_hand("waiting")
    other = new_referee(ends_at="stop", ends_on_failure=True, events=(event,))
    assert all(
        v.ended is None
        for v in judge_all(other, [step(t, 9.2, speed=0.0, events=waiting) for t in range(60)])
    )


def test_passing_the_hand_is_a_failure() -> None:
    """A robot beyond the pedestrian cannot stop for it any more, also at the goal."""
    event, reply = stopping_hand()
    referee = new_referee(ends_at="stop", ends_on_failure=True, events=(event,))
    assert referee.judge(step(0, 11.9, events=reply)).ended is None
    verdict = referee.judge(step(1, 12.1, events=reply))
    assert verdict.ended == "failure" and not verdict.failures
