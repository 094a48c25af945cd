"""Falls of legged robots: when they count, and how they follow from a trajectory."""

from __future__ import annotations

import dataclasses
import io
import math
from pathlib import Path

import msgspec
import numpy as np
import pytest
from rich.console import Console

from cosim.cli.results import print_episode
from cosim.core.errors import RunError
from cosim.core.state import LegState
from cosim.episode.loop import Step
from cosim.results.log import Log
from cosim.results.metrics import EpisodeFacts, compute_metrics
from cosim.results.record import Record, StateHash
from cosim.results.referee import Failure, Referee, Verdict
from cosim.results.rejudge import contradictions
from cosim.spec.scenario import Scenario
from tests.results.test_metrics import episode, log
from tests.results.test_referee import (
    judge_all,
    new_referee,
    people,
    stand_still,
    step,
    stopping_hand,
    touch,
)
from tests.support.driven_runs import driven, episode_of, failure_at, short_way


def as_fallen(upright: Step) -> Step:
    return dataclasses.replace(upright, motion=dataclasses.replace(upright.motion, down=True))


@pytest.mark.parametrize("ends", [True, False])
def test_a_robot_that_is_down_for_a_tenth_of_a_second_has_fallen_once(ends: bool) -> None:
    """Two ticks are a stumble; the third is a fall, which ends a short episode and resets the robot
    on a long route."""
    referee = new_referee(ends_on_failure=ends)
    ticks = [step(0, 20.0), *(as_fallen(step(t, 20.0)) for t in (1, 2)), step(3, 20.0)]
    ticks += [as_fallen(step(t, 23.0)) for t in (4, 5, 6)]
    verdicts = judge_all(referee, ticks)
    assert [failure.kind for v in verdicts for failure in v.failures] == ["fall"]
    assert (verdicts[-1].ended == "failure", verdicts[-1].reset is None) == (ends, ends)
    if not ends:
        assert not judge_all(referee, [as_fallen(step(t, 25.0)) for t in (7, 8)])[-1].failures


def test_a_fall_that_follows_from_a_collision_is_not_counted() -> None:
    """The collision resets the robot, which then has to be down for 0.1 s again."""
    referee = new_referee(ends_on_failure=False)
    hit = as_fallen(step(1, 20.0, contacts=[touch("bin", "object")]))
    verdicts = judge_all(
        referee, [as_fallen(step(0, 20.0)), hit, *(as_fallen(step(t, 20.0)) for t in (2, 3))]
    )
    assert [failure.kind for v in verdicts for failure in v.failures] == ["collision"]


@pytest.mark.parametrize("ends", [True, False])
def test_a_robot_that_a_person_pushes_over_has_not_failed(ends: bool) -> None:
    """The fall is recorded with the contact, the robot is reset, and the episode continues."""
    crowd = people((20.5, 0.0), heading=math.pi, speed=1.3)
    referee = new_referee(ends_on_failure=ends)
    stand_still(referee, 19)
    assert referee.judge(step(19, 20.0, speed=0.0, contacts=[touch("c0")], crowd=crowd)).walked_into
    verdict = judge_all(
        referee, [as_fallen(step(t, 20.0, speed=0.0, crowd=crowd)) for t in (25, 26, 27)]
    )[-1]
    assert [(into.kind, into.other) for into in verdict.walked_into] == [("fall", "c0")]
    assert (verdict.failures, verdict.ended) == ((), None) and verdict.reset is not None


def pushed_over(referee: Referee, from_tick: int, ticks: int = 3) -> Verdict:
    """Return the last verdict after a person walks into the standing robot, which then lies."""
    crowd = people((20.5, 0.0), heading=math.pi, speed=1.3)
    stand_still(referee, from_tick)
    referee.judge(step(from_tick, 20.0, speed=0.0, contacts=[touch("c0")], crowd=crowd))
    lying = (
        as_fallen(step(from_tick + k, 20.0, speed=0.0, crowd=crowd)) for k in range(1, ticks + 1)
    )
    return judge_all(referee, [*lying])[-1]


def test_a_fall_after_a_reset_is_not_a_push() -> None:
    """A fall right after the reset that follows a push is the robot's own."""
    referee = new_referee(ends_on_failure=False)
    assert pushed_over(referee, 19).reset is not None
    verdict = judge_all(referee, [as_fallen(step(t, 15.0)) for t in (23, 24, 25)])[-1]
    assert [failure.kind for failure in verdict.failures] == ["fall"]


@pytest.mark.parametrize(("contact_ends", "kind"), [(59, "pushed"), (30, "failed")])
def test_a_push_lasts_as_long_as_the_person_touches_the_robot(contact_ends: int, kind: str) -> None:
    """A fall during the contact, or less than 1 s after its end, is the person's, and a later one
    the robot's own."""
    crowd = people((20.5, 0.0), heading=math.pi, speed=1.3)
    referee = new_referee(ends_on_failure=False)
    stand_still(referee, 19)
    for tick in range(19, 60):
        contacts = [touch("c0")] if tick <= contact_ends else []
        referee.judge(step(tick, 20.0, speed=0.0, contacts=contacts, crowd=crowd))
    verdict = judge_all(
        referee, [as_fallen(step(t, 20.0, speed=0.0, crowd=crowd)) for t in (60, 61, 62)]
    )[-1]
    assert bool(verdict.failures) == (kind == "failed")
    assert bool(verdict.walked_into) == (kind == "pushed")


def test_a_robot_that_is_down_reaches_no_goal() -> None:
    """When it slides into the goal while it falls, the fall is counted and no goal is reached."""
    referee = new_referee(ends_on_failure=True)
    verdicts = judge_all(referee, [as_fallen(step(t, 99.8 + 0.1 * t)) for t in range(3)])
    assert [verdict.ended for verdict in verdicts] == [None, None, "failure"]


def test_a_robot_that_is_down_makes_no_stop() -> None:
    """The time stopped before a person counts from when it is up again."""
    event, reply = stopping_hand()
    referee = new_referee(ends_at="stop", ends_on_failure=True, events=(event,))
    before = [step(t, 9.2, speed=0.0, events=reply) for t in range(39)]
    assert judge_all(referee, before)[-1].ended is None
    assert referee.judge(as_fallen(step(39, 9.2, speed=0.0, events=reply))).ended is None
    later = [step(40 + t, 9.2, speed=0.0, events=reply) for t in range(40)]
    ended = [verdict.ended for verdict in judge_all(referee, later)]
    assert ended == [None] * 39 + ["stop"]


@pytest.mark.parametrize("x_m", [18.0, 23.0])
def test_a_push_gains_no_progress(x_m: float) -> None:
    """A pushed robot continues where it fell or behind it, even if the nearest waypoint is ahead,
    after any number of pushes."""
    referee = new_referee(ends_on_failure=False)
    for again in range(4):
        begin = again * 40
        crowd = people((x_m + 0.5, 0.0), heading=math.pi, speed=1.3)
        for tick in range(begin, begin + 25):
            referee.judge(step(tick, x_m, speed=0.0, crowd=people((50.0, 0.0))))
        hit = [touch("c0")]
        referee.judge(step(begin + 25, x_m, speed=0.0, contacts=hit, crowd=crowd))
        ticks = [as_fallen(step(begin + k, x_m, speed=0.0, crowd=crowd)) for k in (26, 27, 28)]
        verdict = judge_all(referee, ticks)[-1]
        assert not verdict.failures and verdict.reset is not None
        assert x_m - 0.7 < verdict.reset.route_s_m <= x_m - 0.5
        far = people((60.0, 0.0))
        for tick in range(begin + 29, begin + 40):
            referee.judge(step(tick, x_m, speed=0.0, crowd=far))
    own = judge_all(referee, [as_fallen(step(160 + t, x_m)) for t in range(3)])[-1]
    assert own.failures and own.reset is not None and abs(own.reset.route_s_m - x_m) < 2.6


def test_a_state_hash_holds_the_attitude_of_the_trunk() -> None:
    """Roll, pitch and lying change the hash with legs, and on wheels the hash is unchanged."""

    def hash_of(robot_step: Step) -> str:
        found = StateHash()
        found.add(robot_step)
        return found.hexdigest()

    def walking(roll_rad: float, pitch_rad: float, knee_rad: float) -> Step:
        robot_step = step(0, 20.0)
        legs = LegState(roll_rad, pitch_rad, (0.0, knee_rad))
        robot = dataclasses.replace(robot_step.motion.robot, legs=legs)
        return dataclasses.replace(
            robot_step, motion=dataclasses.replace(robot_step.motion, robot=robot)
        )

    upright = walking(0.0, 0.0, 0.0)
    others = [walking(*row) for row in np.eye(3).tolist()]
    assert len({hash_of(robot_step) for robot_step in (upright, as_fallen(upright), *others)}) == 5
    assert hash_of(step(0, 20.0)) == "d1c778b35eb57669455504ff5ec1cef4"


def with_legs(wheeled: Log, ticks_down: range) -> Log:
    rows = np.zeros((len(wheeled), 16), np.float32)
    rows[list(ticks_down), 0] = 1.0
    return dataclasses.replace(wheeled, legs=rows)


def test_falls_follow_from_the_trajectory() -> None:
    """A recorded fall is where the robot was down for 0.1 s; a missing or added one contradicts the
    trajectory."""
    way = short_way("s", robot="dog", ends_on_failure=False, time_limit_s=5.0)
    walked = with_legs(driven(way, [1.0] * 100, {30: 0.0}), range(28, 31))
    fall = failure_at(walked, 30, "fall")
    record = msgspec.structs.replace(
        episode_of(way, "h")[0], status="done", ended="timeout", ticks=100, failures=(fall,)
    )
    assert [*contradictions(record, way, walked)] == []
    early = with_legs(walked, range(20, 24))
    assert [difference.what for difference in contradictions(record, way, early)] == [
        "falls at tick 22"
    ]
    never = with_legs(walked, range(0))
    assert [difference.what for difference in contradictions(record, way, never)] == [
        "falls at tick 30"
    ]


def test_wheels_have_no_number_of_falls() -> None:
    """With legs falls are counted, from 0; with wheels there is no number."""
    walked = log([0.1 * (i + 1) for i in range(1000)])
    fall = Failure("fall", 5, 0.0, 0.0, 0.0, 0.0)
    wheels = compute_metrics(episode(walked))
    assert (wheels["falls"], wheels["falls_per_100m"]) == (None, None)
    legs = compute_metrics(episode(with_legs(walked, range(0))))
    assert (legs["falls"], legs["falls_per_100m"]) == (0.0, 0.0)
    fallen = compute_metrics(episode(with_legs(walked, range(0)), fall))
    assert (fallen["falls"], fallen["failures"]) == (1.0, 1.0)
    assert fallen["falls_per_100m"] == fallen["failures_per_100m"] == pytest.approx(1.0)


def test_the_goal_of_a_robot_that_is_down_contradicts_the_trajectory() -> None:
    """The goal is reached in the last tick, and not if the robot is down in it."""
    way = short_way("s", robot="dog")
    record, reached = episode_of(way, "h")
    assert reached is not None
    assert [*contradictions(record, way, with_legs(reached, range(0)))] == []
    lying = with_legs(reached, range(len(reached) - 1, len(reached)))
    assert [difference.what for difference in contradictions(record, way, lying)] == ["ended"]


def test_a_reset_beyond_a_pushed_fall_contradicts_the_trajectory() -> None:
    """A record whose push gains progress is refused."""
    way = short_way("s", robot="dog", ends_on_failure=False, time_limit_s=5.0)
    for to_m, contradicted in ((1.0, 0), (4.0, 1)):
        walked = with_legs(driven(way, [1.0] * 30 + [0.0] * 70, {65: to_m}), range(63, 66))
        walked = with_person(walked, range(100))
        assert len([*contradictions(pushed(way, walked, 55, 65), way, walked)]) == contradicted


def with_person(alone: Log, near: range) -> Log:
    """The log with a person at the robot in some ticks, and far away in the others."""
    clearance_m = np.full(len(alone), 3.0)
    clearance_m[list(near)] = 0.05
    return dataclasses.replace(alone, clearance_m=clearance_m)


def pushed(way: Scenario, log: Log, contact: int, fall: int) -> Record:
    """The record of a robot that a person walks into and pushes over, at these ticks."""
    into = {"other": "c0", "other_kind": "pedestrian", "fault": "pedestrian_at_fault"}
    found = [
        dataclasses.replace(failure_at(log, tick, kind), **into)  # type: ignore[arg-type]
        for tick, kind in ((contact, "collision"), (fall, "fall"))
    ]
    return msgspec.structs.replace(
        episode_of(way, "h")[0],
        status="done",
        ended="timeout",
        ticks=len(log),
        walked_into=tuple(found),
    )


def test_a_push_follows_from_the_trajectory() -> None:
    """Only a person who walked into the standing robot less than 1 s before, or stayed near until
    then, can have pushed it."""
    way = short_way("s", robot="dog", ends_on_failure=False, time_limit_s=5.0)
    speeds = [1.0] * 10 + [0.0] * 90

    def found(contact: int, near_until: int, fall: int = 60) -> list[str]:
        walked = with_legs(driven(way, speeds, {fall: 0.0}), range(fall - 2, fall + 1))
        walked = with_person(walked, range(min(contact, 60), near_until + 1))
        record = pushed(way, walked, contact, fall)
        return [difference.what for difference in contradictions(record, way, walked)]

    assert found(40, 40) == found(30, 40) == []
    contradicted = ["walked_into: fall at tick 60"]
    assert found(39, 39) == found(30, 39) == found(61, 99) == contradicted
    assert found(29, 99) == found(50, 49) == contradicted


def test_a_fall_of_the_robot_is_not_a_push() -> None:
    """A failure that is moved to `walked_into` contradicts the trajectory, in the last tick by the
    episode's end."""
    way = short_way("s", robot="dog", ends_on_failure=True)
    walked = with_person(with_legs(driven(way, [0.0] * 50), range(47, 50)), range(50))
    fall = failure_at(walked, 49, "fall")
    record = msgspec.structs.replace(
        episode_of(way, "h")[0], status="done", ended="failure", ticks=50, failures=(fall,)
    )
    assert [*contradictions(record, way, walked)] == []
    forged = msgspec.structs.replace(pushed(way, walked, 40, 49), ended="failure")
    assert [difference.what for difference in contradictions(forged, way, walked)] == ["ended"]
    moved = msgspec.structs.replace(forged, walked_into=(forged.walked_into[1],), ended="timeout")
    assert {difference.what for difference in contradictions(moved, way, walked)} == {
        "walked_into: fall at tick 49",
        "ended",
    }


def test_a_fall_on_wheels_contradicts_the_trajectory() -> None:
    """A robot on wheels has no falls, whatever the fault."""
    way = short_way("s", ends_on_failure=False, time_limit_s=5.0)
    rolled = with_person(driven(way, [0.0] * 100, {60: 0.0}), range(100))
    found = [
        difference.what for difference in contradictions(pushed(way, rolled, 50, 60), way, rolled)
    ]
    assert found == ["falls at tick 60"]


def test_a_trajectory_must_have_the_columns_of_its_robot(tmp_path: Path) -> None:
    """Legs need four columns and one per joint, wheels none, and arrays of one dimension are
    refused."""
    for robot, columns, contradicted in (
        ("dog", 16, []),
        ("dog", 0, ["columns of legs"]),
        ("dog", 15, ["columns of legs"]),
        ("courier", 16, ["columns of legs"]),
        ("courier", 0, []),
    ):
        way = short_way("s", robot=robot)
        record, reached = episode_of(way, "h")
        assert reached is not None
        walked = dataclasses.replace(reached, legs=np.zeros((len(reached), columns), np.float32))
        assert [
            difference.what for difference in contradictions(record, way, walked)
        ] == contradicted
    path = tmp_path / "trajectory.npz"
    flat = dataclasses.replace(reached, legs=np.zeros(len(reached), np.float32))
    path.write_bytes(flat.encoded())
    with pytest.raises(RunError, match="'legs' is float32"):
        Log.load(path)


def test_a_push_over_is_one_contact_and_is_shown_as_a_push() -> None:
    """`walked_into` counts the contact alone, and the episode is printed with both."""
    way = short_way("s", robot="dog", ends_on_failure=False, time_limit_s=5.0)
    walked = with_legs(driven(way, [0.0] * 100, {60: 0.0}), range(58, 61))
    record = pushed(way, walked, 45, 60)
    assert compute_metrics(EpisodeFacts.of(record, way, walked))["walked_into"] == 1.0
    text = io.StringIO()
    print_episode(Console(file=text, width=120), record)
    assert "walked into by c0" in text.getvalue() and "pushed over by c0" in text.getvalue()
