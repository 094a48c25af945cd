"""The oracle: its treatment of groups and of a raised hand, and every event, driven."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from shapely.geometry import box

from cosim.core.geometry import Polyline, Pose
from cosim.core.state import NO_VEHICLES, Doing, People, PersonKind, RobotState, Signal, Vehicles
from cosim.episode.interfaces import Observation, Privileged
from cosim.episode.policy_caller import PolicyCaller
from cosim.policies.body_disks import BodyDisks
from cosim.policies.privileged.orca import (
    STOP_BEFORE_M,
    Orca,
    PathState,
    best_lane_past,
    crowd_limit,
    gesture_limit,
    vehicle_violation,
)
from cosim.policies.privileged.orca_hasty import HastyOrca
from cosim.policies.privileged.people_prediction import Yielding, gaps_to_people
from cosim.policies.privileged.rollout import STEP_S, Plans, SampledPath, roll_out
from cosim.policies.privileged.route import crossing_limit
from cosim.policies.privileged.route_planner import DistanceField
from cosim.policies.privileged.standing_groups import distances, groups, lines
from cosim.spec.robot import COURIER
from cosim.spec.scenario import City, CrowdSpec
from scenarios.events import EVENT_KINDS

CITY = City(seed=1, size_m=500.0)
ROUTE = Polyline([(0.0, 0.0), (30.0, 0.0)])


def people(*rows: tuple[float, float, float, float, Doing]) -> People:
    """People given as (x, y, heading, speed, doing)."""
    xy = [row[:2] for row in rows]
    ids = tuple(f"e{i}" for i in range(len(rows)))
    doing = tuple(r[4] for r in rows)
    return People.of(
        ids, xy, [r[2] for r in rows], [r[3] for r in rows], doing, kind=PersonKind.EVENT
    )


def knowledge(
    others: People, x_m: float = 5.0, v_mps: float = 1.2, half_width_m: float = 1.7
) -> Privileged:
    """Knowledge of a robot on a straight route along x, with a walkway free for 1.7 m on either
    side."""
    robot = RobotState(Pose(x_m, 0.0, 0.0), v_mps)
    free = box(-2.0, -half_width_m, 40.0, half_width_m)
    return Privileged(robot, ROUTE, x_m, others, NO_VEHICLES, {}, (), free)


def test_talkers_are_one_group_and_passers_by_are_none() -> None:
    """Two talkers 1.9 m apart and a third too near to pass between are a group; a far one and a
    walker are not."""
    crowd = people(
        (10.0, 0.0, 0.0, 0.0, "talk"),
        (10.0, 1.9, 0.0, 0.0, "talk"),
        (10.0, 3.2, 0.0, 0.0, "stand"),
        (10.0, -2.5, 0.0, 0.0, "stand"),
        (10.0, 0.9, 0.0, 1.2, "walk"),
    )
    assert groups(crowd) == [[0, 1, 2], [3]]
    assert lines(crowd).shape == (4, 2, 2)
    between = distances(np.array([[10.0, 1.0]]), lines(crowd))
    assert between.min() < 1e-9


def test_a_group_is_passed_round_on_the_side_with_room() -> None:
    """Two talkers 1.5 m apart across the way, nearer to its left edge, are passed on the right."""
    crowd = people((11.0, 1.2, 0.0, 0.0, "talk"), (11.0, -0.3, 0.0, 0.0, "talk"))
    scene = knowledge(crowd)
    here = PathState(SampledPath(ROUTE), scene.route_s_m, DistanceField(scene.free, ROUTE))
    lane_m = best_lane_past(scene, BodyDisks.of(COURIER), here, lines(crowd), 0.0)
    assert lane_m <= -0.3 - 0.3 - 0.33 - 0.1


def test_the_oracle_stops_before_a_raised_hand_and_stays() -> None:
    """It brakes for a stopping hand and rests 2 m before it."""
    hand, nobody = (
        people((12.0, 0.2, math.pi, 0.0, "stop")),
        people((12.0, 0.2, math.pi, 0.0, "stand")),
    )
    limits = [gesture_limit(knowledge(hand, x_m)) for x_m in (3.0, 6.0, 9.0, 9.9, 10.5)]
    assert limits == sorted(limits, reverse=True) and limits[-1] == 0.0 and limits[0] > 2.0
    assert gesture_limit(knowledge(nobody, 9.9)) == math.inf
    driver = PolicyCaller(Orca())
    x_m = 3.0
    v_mps = 0.0
    for tick in range(300):
        command = driver.act(
            Observation(
                2 * tick, 0.1 * tick, None, v_mps, 0.0, COURIER, knowledge(hand, x_m, v_mps)
            )
        )
        v_mps += max(-0.2, min(0.2, command.v_mps - v_mps))
        x_m += 0.1 * v_mps
    assert v_mps == 0.0
    assert 12.0 - x_m == pytest.approx(STOP_BEFORE_M, abs=0.15)


def test_a_too_short_green_costs_the_oracle_at_most_8_s() -> None:
    """At 14 m of crossing with 13 s of green left it waits for at most 8 s until the signal turns
    red."""
    driver = PolicyCaller(Orca())
    x_m = 3.0
    v_mps = 1.4
    stood_s = 0.0
    for tick in range(130):
        signals = {":c0": Signal(True, 13.0 - 0.1 * tick)}
        here = replace(
            knowledge(people(), x_m, v_mps), crossings=((":c0", 6.0, 20.0),), signals=signals
        )
        command = driver.act(Observation(2 * tick, 0.1 * tick, None, v_mps, 0.0, COURIER, here))
        v_mps += max(-0.2, min(0.2, command.v_mps - v_mps))
        x_m += 0.1 * v_mps
        stood_s = stood_s + 0.1 if v_mps < 0.03 else 0.0
    assert v_mps == 0.0 and 4.5 < x_m < 6.0 - COURIER.length_m / 2
    assert 2.0 < stood_s < 8.0


def test_the_oracle_slows_down_for_people_right_ahead() -> None:
    """The nearer they are the slower, never below a creep; people at its side and of events do not
    count."""
    here = knowledge(people((6.0, 0.2, 0.0, 0.0, "stand")))
    crowd = replace(
        here, people=dataclasses.replace(here.people, kind=np.full(1, PersonKind.CROWD.value))
    )
    limits = [
        crowd_limit(replace(crowd, robot=RobotState(Pose(x_m, 0.0, 0.0), 1.0)), COURIER)
        for x_m in (3.0, 4.5, 5.1, 5.3)
    ]
    assert (
        limits == sorted(limits, reverse=True)
        and limits[0] > 1.5
        and limits[2] < 0.7
        and limits[3] > 0.1
    )
    assert (
        crowd_limit(replace(crowd, robot=RobotState(Pose(6.0, -0.7, 0.0), 1.0)), COURIER)
        == math.inf
    )
    assert crowd_limit(here, COURIER) == math.inf


@pytest.mark.parametrize(
    ("walk", "v_mps", "limit_mps"),
    [(False, 0.02, 0.0), (False, 1.2, math.inf), (True, 0.0, math.inf)],
)
def test_the_oracle_waits_at_red_but_drives_on_when_it_cannot_stop(
    walk: bool, v_mps: float, limit_mps: float
) -> None:
    """0.2 m before a crossing it waits for green at rest, and at speed it drives on."""
    here = replace(
        knowledge(people(), 5.0, v_mps),
        crossings=((":c0", 5.2, 12.0),),
        signals={":c0": Signal(walk, 30.0)},
    )
    assert crossing_limit(here, COURIER) == limit_mps


def test_the_robot_waits_where_no_car_turns() -> None:
    """Where cars turn directly before a crossing, it stops farther from it."""
    here = replace(
        knowledge(people(), 3.2),
        crossings=((":c0", 5.2, 12.0),),
        signals={":c0": Signal(False, 30.0)},
    )
    assert crossing_limit(here, COURIER) > 1.0
    assert crossing_limit(replace(here, waits_m=(3.2,)), COURIER) == 0.0


def test_foresight_turns_no_faster_than_the_robot() -> None:
    """Every plan respects the yaw rate and the speed of the robot, and ends in its lane."""
    plans = Plans(
        np.array([0.0, 1.0, -1.0]),
        np.array([1.4, 1.4, 0.9]),
        np.full(3, 0.9),
        np.array([0.0, 0.0, 0.6]),
    )
    ahead = roll_out(SampledPath(ROUTE), plans, COURIER, Pose(5.0, 0.0, 0.0), 5.0, (1.4, 0.0))
    turns = np.abs(np.diff(ahead.pose[:, 2], axis=0))
    moved = np.hypot(*np.moveaxis(np.diff(ahead.pose[:, :2], axis=0), 1, 0))
    assert turns.max() <= 0.65 * STEP_S + 1e-9 and moved.max() <= 1.4 * STEP_S + 1e-9
    assert ahead.pose[-1, 1] == pytest.approx([0.0, 1.0, -1.0], abs=0.15)


def test_a_braking_car_counts_where_it_stops_up_to_half_a_metre() -> None:
    """A car at 6 m/s stops in 6 m: at 12 m it does not matter, at 5 m it blocks every plan equally."""
    plans = Plans(np.array([0.0, 1.0]), np.array([1.4, 1.4]), np.full(2, 0.9), np.zeros(2))
    ahead = roll_out(SampledPath(ROUTE), plans, COURIER, Pose(5.0, 0.0, 0.0), 5.0, (1.4, 0.0))
    for far_m, nearness in ((12.0, 0.0), (5.0, 0.5)):
        cars = Vehicles.of(("v0",), [(7.0, far_m)], [-math.pi / 2], [6.0], [(4.4, 1.8)])
        scene = dataclasses.replace(
            knowledge(people()), vehicles=cars, crossings=(("c", 4.0, 12.0),)
        )
        assert vehicle_violation(scene, BodyDisks.of(COURIER), ahead)[0] == pytest.approx(nearness)


def test_the_oracle_waits_for_oncoming_people_until_they_are_past() -> None:
    """From 3.3 m, and at most 10 s in one place, it waits; not for passing, far or patient standing
    people."""
    at_it, round_it, past_it = (
        people((x_m, y_m, heading, 1.4, "walk"))
        for x_m, y_m, heading in ((8.2, 0.0, math.pi), (6.5, 0.6, 2.4), (3.5, 1.0, 2.9))
    )
    yielding = Yielding()
    assert not yielding.waits(knowledge(round_it), 0.0)
    assert [yielding.waits(knowledge(one), 1.0) for one in (at_it, round_it, past_it)] == [
        True,
        True,
        False,
    ]
    assert yielding.waits(knowledge(round_it), 9.9) and not yielding.waits(knowledge(at_it), 10.1)
    patient = Yielding()
    stays = knowledge(people((7.0, 0.0, math.pi, 0.0, "stand")))
    assert patient.waits(knowledge(at_it), 0.0)
    assert patient.waits(stays, 0.5) and patient.waits(stays, 4.8)
    assert not patient.waits(stays, 5.2)
    for x_m, heading in ((8.0, math.pi - 0.3), (8.0, 0.0), (9.0, math.pi)):
        assert not Yielding().waits(knowledge(people((x_m, 0.0, heading, 1.4, "walk"))), 1.0)


@pytest.mark.parametrize(
    ("x_m", "doing", "v_mps", "differ"),
    [(7.0, "stand", 0.0, True), (7.0, "stand", 1.2, False), (6.8, "stop", 0.0, False)],
)
def test_only_at_rest_the_hasty_oracle_moves_where_the_oracle_waits_out_of_caution(
    x_m: float, doing: Doing, v_mps: float, differ: bool
) -> None:
    """Two people 1.2 m apart stand 2 m ahead: the oracle waits, the hasty one goes round them. A
    raised hand stops both."""
    ahead = people((x_m, 0.6, math.pi, 0.0, doing), (x_m, -0.6, math.pi, 0.0, "stand"))
    known = knowledge(ahead, v_mps=v_mps)
    seen = Observation(0, 0.0, None, v_mps, 0.0, COURIER, known)
    calm, hasty = (PolicyCaller(one()).act(seen) for one in (Orca, HastyOrca))
    assert calm.v_mps == 0.0
    assert (hasty.v_mps > 0.1 and hasty.w_radps != 0.0) if differ else hasty == calm


def test_near_people_count_at_their_current_place_too() -> None:
    """A person 1.1 m ahead who is about to leave sideways counts there, too; one 4 m ahead does
    not."""
    plans = Plans(np.array([0.0, 1.5]), np.array([1.4, 0.0]), np.full(2, 0.9), np.zeros(2))
    ahead = roll_out(SampledPath(ROUTE), plans, COURIER, Pose(5.0, 0.0, 0.0), 5.0, (1.4, 0.0))
    assert np.ptp(ahead.pose[:, 2, 1]) == 0.0
    gaps = [
        gaps_to_people(
            knowledge(crowd := people((x_m, 0.3, 1.57, 2.0, "walk"))),
            COURIER,
            ahead,
            crowd,
            lines(people()),
        )[0]
        for x_m in (6.1, 9.0)
    ]
    assert gaps[0] < 0.0 < 0.3 < gaps[1]


@pytest.mark.engine
@pytest.mark.parametrize(
    ("kind", "seed"),
    [(kind, 2 if kind == "conversing" else 1) for kind in EVENT_KINDS],
)
def test_the_oracle_solves_every_event(kind: str, seed: int) -> None:
    """With real engines one scenario of each event is triggered, seen, follows its rule, and
    reaches its end."""
    from cosim.place.walk_graph import WalkGraph
    from scenarios.episodes.run_episode import run_episode
    from scenarios.places.nets import place
    from scenarios.suites.reactive import build_reactive

    _, street_map = place(CITY)
    built = build_reactive(EVENT_KINDS[kind], CITY, street_map, WalkGraph(street_map), seed, kind)
    scenario = msgspec.structs.replace(
        built, crowd=CrowdSpec(persons=10, radius_m=40.0, vehicles=4)
    )
    record = run_episode(scenario, Orca()).record
    assert (record.status, record.failures) == ("done", ())
    assert record.measures["success"] == 1.0
    assert record.ended == ("stop" if kind == "gesturing" else "goal")


@pytest.mark.engine
def test_driving_straight_on_fails_before_an_oncoming_person() -> None:
    """A blind policy collides in a scenario of `frontal`."""
    from cosim.core.state import Command
    from cosim.place.walk_graph import WalkGraph
    from cosim.spec.manifest import Manifest
    from scenarios.episodes.run_episode import run_episode
    from scenarios.places.nets import place
    from scenarios.suites.reactive import build_reactive

    class Blind:
        manifest = Manifest("blind", camera=None)

        def reset(self, scenario_id: str, seed: int) -> None:
            """Nothing to forget."""

        def act(self, observation: Observation) -> Command:
            return Command(1.2, 0.0)

    _, street_map = place(CITY)
    scenario = build_reactive(
        EVENT_KINDS["frontal"], CITY, street_map, WalkGraph(street_map), 1, "frontal"
    )
    record = run_episode(msgspec.structs.replace(scenario, obstacles=()), Blind()).record
    assert record.ended == "failure" and record.failures[0].other == "e0"
